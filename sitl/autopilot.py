"""The autopilot: modes, arming, failsafes and commands, in vehicle time.

At 100 Hz it thinks as PX4's commander does; every tick it lets `sitl.flight_control` fly.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.failsafe import ACTION_MODE, Action, TiltDetector, offboard_loss_action
from sitl.flight_control import FlightControl
from sitl.land_detector import LandDetector, LandLimits, Motion
from sitl.landing_watch import LandingWatch
from sitl.modes import (
    AVAILABLE,
    MODE_NAMES,
    NEVER_ARM,
    POSITION_MODES,
    Home,
    LandedState,
    Mode,
    Result,
    Severity,
    Text,
)
from sitl.navigator import Navigator, TakeoffState
from sitl.parameters import ParameterTable
from sitl.plant import Plant
from sitl.preflight import health_problem, mode_problem
from sitl.profile import Profile
from sitl.sensors import ORIGIN, Sensors, geodetic
from sitl.setpoints import AttitudeSetpoint, PositionSetpoint

COMMANDER_US = 10_000
READY_US = 2_000_000
"""Vehicle time until sensors and estimator count as healthy, us."""


class Autopilot:
    """Modes, arming and control of one vehicle.

    Args:
        parameters: the table it obeys, re-read whenever it changes.
        profile: rates and lateness of the loops.
        plant: what it flies; read only through what an estimator gives.
        sensors: the gyro.
    """

    def __init__(self, parameters: ParameterTable, profile: Profile, plant: Plant, sensors: Sensors) -> None:
        self.parameters = parameters
        self._plant = plant
        self._revision = parameters.revision
        self.control = FlightControl(parameters, profile, plant, sensors)
        self.land_detector = LandDetector()
        self._landing = LandingWatch(parameters)
        self._tilt = TiltDetector(parameters)
        self._now_us = 0
        self._next_commander_us = 0
        self.mode = Mode.LOITER
        self._intended = Mode.LOITER
        self._before_landing = Mode.LOITER
        self.armed = False
        self.failsafe = False
        self.terminated = False
        self.healthy = False
        self.home: Home | None = None
        self.rejection = ""
        self._armed_us = 0
        self._texts: list[Text] = []
        self._offboard_us: int | None = None
        self._takeoff_amsl_m: float | None = None
        self._tilt_warned = False
        self._land_limits = self._read_land_limits()

    @property
    def ready(self) -> bool:
        """Would it arm, here and in this mode? In flight: is it healthy?"""
        return self.healthy and (self.armed or not (self._health_problem() or self._mode_problem()))

    @property
    def state(self) -> NDArray[np.void]:
        """(1,) of CONTROL_STATE: filtered rates, integrators, set-points, motor commands."""
        return self.control.state

    @property
    def motors(self) -> tuple[float, ...]:
        """Signals sent to the motors, 0..1."""
        return self.control.motors

    @property
    def motor_count(self) -> int:
        """Number of rotors in the parameters."""
        return self.control.motor_count

    @property
    def navigator(self) -> Navigator:
        """Where the modes that hold a position want to be."""
        return self.control.navigator

    @property
    def landed_state(self) -> LandedState:
        """On the ground, in the air, taking off or landing."""
        if self.land_detector.landed:
            return LandedState.ON_GROUND
        return {Mode.TAKEOFF: LandedState.TAKEOFF, Mode.LAND: LandedState.LANDING}.get(self.mode, LandedState.IN_AIR)

    @property
    def attitude_sp_count(self) -> int:
        """How many attitude set-points there have been: cheap to watch for a new one."""
        return self.control.attitude_sp_count

    @property
    def attitude_sp(self) -> AttitudeSetpoint:
        """Attitude set-point with the rate set-point that the attitude law now makes of it."""
        return self.control.attitude_sp

    @property
    def position_sp(self) -> PositionSetpoint:
        """What the position controller was asked for last."""
        return self.control.position_sp(self._now_us, used=self.armed and self.mode in POSITION_MODES)

    def take_texts(self) -> list[Text]:
        """Texts since the last call."""
        texts, self._texts = self._texts, []
        return texts

    def say(self, severity: Severity, text: str) -> None:
        """Queue a text for the ground."""
        self._texts.append(Text(severity, text))

    # -- commands ----------------------------------------------------------------------------------------------

    def command_arm(self, arm: bool, *, force: bool = False) -> Result:
        """Arm or disarm; PX4's texts, PX4's rules (force does not skip the checks of arming)."""
        if not arm:
            if not self.armed:
                return Result.ACCEPTED
            if not self.land_detector.landed and not force:
                return self._refuse("Disarming denied: not landed")
            self._disarm("Disarmed by external command")
            return Result.ACCEPTED
        if self.armed:
            return Result.ACCEPTED
        health = self._health_problem()
        if health:
            self.say(Severity.CRITICAL, f"Preflight Fail: {health}")
        problem = health or self._mode_problem()
        if problem:
            return self._refuse("Arming denied: Resolve system health failures first", problem)
        self.armed = True
        self._armed_us = self._now_us
        self._landing.on_arm(self._now_us)
        self._set_home()
        self.navigator.on_arm(self._now_us)
        self.say(Severity.INFO, "Armed by external command")
        self._enter(self.mode)
        return Result.ACCEPTED

    def command_mode(self, mode: Mode) -> Result:
        """Switch the mode; disarmed every flown mode is accepted, armed only one that can run."""
        if self.terminated:
            return self._refuse("Switching modes denied: flight terminated")
        if mode not in AVAILABLE:
            flown = ", ".join(MODE_NAMES[m] for m in AVAILABLE)
            return self._refuse(f"Mode {MODE_NAMES[mode]} is not flown by this vehicle (flown: {flown})")
        if self.armed and mode is Mode.OFFBOARD and not self._offboard_fresh():
            return self._refuse("Switching to Offboard is currently not available", "no offboard signal")
        self._takeoff_amsl_m = None
        self._switch(mode)
        return Result.ACCEPTED

    def command_takeoff(self, altitude_amsl_m: float | None) -> Result:
        """Take off to a height, m AMSL, or to MIS_TAKEOFF_ALT above here; flies once armed."""
        if self.terminated:
            return self._refuse("Takeoff denied: flight terminated")
        self._takeoff_amsl_m = altitude_amsl_m
        self._switch(Mode.TAKEOFF)
        return Result.ACCEPTED

    def command_land(self) -> Result:
        """Land here; always accepted."""
        if self.mode is not Mode.LAND and self.armed:
            self.say(Severity.INFO, "Landing at current position")
        self._switch(Mode.LAND)
        return Result.ACCEPTED

    def command_set_home_here(self) -> Result:
        """Home is where the vehicle is now."""
        if not self.healthy:
            return self._refuse("Set home denied: no position yet")
        self._set_home()
        return Result.ACCEPTED

    def command_terminate(self, on: bool) -> Result:
        """Stop all motors for good (until disarmed); denied while disarmed or when off is asked."""
        if not on or not self.armed:
            return Result.DENIED
        self._terminate()
        return Result.ACCEPTED

    # -- offboard ----------------------------------------------------------------------------------------------

    def offboard_alive(self, kind: str) -> None:
        """A set-point came that keeps Offboard alive but carries nothing to fly. kind: for the reader."""
        self._offboard_us = self._now_us

    def offboard_attitude(
        self, quat: tuple[float, float, float, float] | None, rates: tuple[float, float, float], thrust: float
    ) -> None:
        """A SET_ATTITUDE_TARGET: keeps Offboard alive and, in Offboard, is flown as soon as the vehicle is armed.

        Args:
            quat: attitude set-point, or None for rates alone.
            rates: body rates, rad/s, NaN for ignored; with an attitude only the yaw rate counts (fed forward).
            thrust: collective, used as |thrust|.
        """
        self._offboard_us = self._now_us
        if self.mode is not Mode.OFFBOARD:
            return
        self.control.take_setpoint(self._now_us, quat, rates, abs(thrust), fly=self.armed)

    def _offboard_fresh(self) -> bool:
        if self._offboard_us is None:
            return False
        return self._now_us - self._offboard_us <= float(self.parameters.get("COM_OF_LOSS_T")) * 1e6

    # -- every tick --------------------------------------------------------------------------------------------

    def tick(self, now_us: int) -> NDArray[np.float64]:
        """One tick on the sensors' newest sample.

        Args:
            now_us: vehicle time, us.

        Returns:
            (12,) motor signals, to be held until the next tick.
        """
        self._now_us = now_us
        if self.parameters.revision != self._revision:
            self._revision = self.parameters.revision
            self._land_limits = self._read_land_limits()
            self.control.load()
        if now_us >= self._next_commander_us:
            self._next_commander_us += COMMANDER_US
            self._think()
        outputs = self.control.run()
        if self.armed and self.mode in POSITION_MODES:
            home_down = self.home.position_ned[2] if self.home else 0.0
            self.control.hold_position(now_us, self.mode, self.land_detector, home_down)
        return outputs

    def _read_land_limits(self) -> LandLimits:
        get = self.parameters.get
        return LandLimits(
            thr_min=float(get("MPC_THR_MIN")),
            hover_thrust=float(get("MPC_THR_HOVER")),
            manual_min=float(get("MPC_MANTHR_MIN")),
            z_vel_max=float(get("LNDMC_Z_VEL_MAX")),
            xy_vel_max=float(get("LNDMC_XY_VEL_MAX")),
            rot_max=math.radians(float(get("LNDMC_ROT_MAX"))),
        )

    # -- 100 Hz ------------------------------------------------------------------------------------------------

    def _think(self) -> None:
        now = self._now_us
        if not self.healthy and now >= READY_US:
            self.healthy = True
            self._set_home()
        phi, theta, _ = self._plant.euler()
        if not self.land_detector.flies(self.control.thrust_sp, self._land_limits):
            self.land_detector.update(now, self._motion(), self._land_limits, self.armed)
            self.control.set_landed(self.land_detector.maybe_landed)
        self._tilt.update(now, phi, theta, not self.control.stopped)
        if self._tilt.failed and not self.terminated:
            self._on_tilt()
        elif self._tilt_warned:
            self._tilt_warned = False
            self.failsafe = self.terminated or self.mode is not self._intended
        if not self.armed:
            return
        self._watch_offboard()
        for said in self._landing.update(now, self.land_detector.landed):
            self.say(Severity.INFO, said)
        if self._landing.disarm:
            self._disarm(self._landing.disarm)
            return
        flying = self.mode is Mode.TAKEOFF and self.navigator.state is TakeoffState.FLIGHT
        if flying and self.navigator.reached(self._plant.position_ned()[2]):
            target = self.navigator.target_down
            self._switch(Mode.LOITER)
            if target is not None:
                self.navigator.hold_ned[2] = target

    def _motion(self) -> Motion:
        fx, fy, fz = self._plant.force.tolist()
        p, q, r = self.state["rates"][0].tolist()
        n, e, d = self.control.velocity.tolist()
        held = self.mode in POSITION_MODES
        descending = held and self.navigator.descending
        return Motion(self.control.thrust_sp, (n, e, d), (p, q, r), (fx, fy, fz), held, descending)

    def _on_tilt(self) -> None:
        action = self._tilt.action(self._now_us - self._armed_us)
        if action is Action.DISARM:
            self.say(Severity.CRITICAL, "Attitude failure detected")
            self._disarm("Disarmed by failsafe")
        elif action is Action.TERMINATE:
            self.say(Severity.EMERGENCY, "Attitude failure detected: flight terminated")
            self._terminate()
        elif not self._tilt_warned:
            self._tilt_warned = self.failsafe = True
            self.say(Severity.CRITICAL, "Attitude failure detected")

    def _watch_offboard(self) -> None:
        if self._intended is not Mode.OFFBOARD or self.terminated:
            return
        fresh = self._offboard_fresh()
        if self.mode is Mode.OFFBOARD and not fresh:
            self.failsafe = True
            action = offboard_loss_action(self.parameters)
            self.say(Severity.CRITICAL, "Failsafe activated")
            if action is Action.DISARM:
                self._disarm("Disarmed by failsafe")
            elif action is Action.TERMINATE:
                self._terminate()
            else:
                self._enter(ACTION_MODE[action])
        elif self.mode is not Mode.OFFBOARD and fresh:
            self.failsafe = self._tilt_warned
            self._enter(Mode.OFFBOARD)

    # -- transitions -------------------------------------------------------------------------------------------

    def _health_problem(self) -> str:
        return health_problem(self.healthy, self.terminated, self.motor_count)

    def _mode_problem(self) -> str:
        return mode_problem(self.mode, self._offboard_fresh())

    def _refuse(self, text: str, reason: str = "") -> Result:
        self.rejection = reason or text
        self.say(Severity.CRITICAL, text)
        return Result.TEMPORARILY_REJECTED

    def _switch(self, mode: Mode) -> None:
        """The user's (or the mission's) choice of mode."""
        if self.mode not in NEVER_ARM and self.mode is not Mode.TAKEOFF:
            self._before_landing = self.mode
        if mode is not self.mode:
            self.control.forget_setpoint()
        self._intended = mode
        self.failsafe = self._tilt_warned
        self._enter(mode)

    def _enter(self, mode: Mode) -> None:
        before, self.mode = self.mode, mode
        if not self.armed:
            return
        stopped = self.control.stopped
        if mode in POSITION_MODES:
            if before is not mode and not self.land_detector.landed:
                self.navigator.airborne()
            self.control.begin_holding()
            if stopped or before not in POSITION_MODES:
                self.control.forget_position()
            if mode is Mode.TAKEOFF:
                wish_m = self._takeoff_amsl_m
                self._texts += self.navigator.aim(None if wish_m is None else ORIGIN[2] - wish_m)
        elif stopped:
            self.control.fly_setpoint()

    def _disarm(self, text: str) -> None:
        self.armed = False
        self.terminated = False
        self.failsafe = False
        self._tilt_warned = False
        self.control.stop()
        self.navigator.on_disarm()
        self.say(Severity.INFO, text)
        if self.mode in NEVER_ARM or self.mode is Mode.TAKEOFF:
            self.mode = Mode.LOITER if self._before_landing is Mode.OFFBOARD else self._before_landing
        self._intended = self.mode

    def _terminate(self) -> None:
        self.terminated = True
        self.failsafe = True
        self.mode = self._intended = Mode.TERMINATION
        self.control.stop()

    def _set_home(self) -> None:
        position = self._plant.position_ned()
        w, x, y, z = self._plant.quat.tolist()
        self.home = Home(*geodetic(position), position, (w, x, y, z))
