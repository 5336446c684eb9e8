"""The autopilot: parameters, modes, arming, failsafes and set-points, in vehicle time.

Every tick it hands the compiled control loop what to control; at 100 Hz it thinks as PX4's commander does; every
8 ms it runs the position controller in the modes that hold a position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl import control_loop
from sitl.control_loop import CONTROL_INPUT, CONTROL_SETTINGS, CONTROL_STATE, control_tick, settle_filters
from sitl.control_settings import control_settings, mix_of, position_settings, position_ticks
from sitl.failsafe import ACTION_MODE, Action, TiltDetector, offboard_loss_action
from sitl.land_detector import LandDetector, LandLimits, Motion
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
from sitl.position_control import POSITION_STATE, position_tick
from sitl.profile import Profile
from sitl.rotation import to_euler
from sitl.sensors import ORIGIN, Sensors, geodetic

COMMANDER_US = 10_000
READY_US = 2_000_000
"""Vehicle time until sensors and estimator count as healthy, us."""


@dataclass(frozen=True)
class AttitudeSetpoint:
    """The attitude and rate set-points in force.

    Attributes:
        time_us: when it came. quat: body to world. rates: (p, q, r) set-points, rad/s. thrust: 0..1.
        count: grows by one with every new set-point.
    """

    time_us: int = 0
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thrust: float = 0.0
    count: int = 0


@dataclass(frozen=True)
class PositionSetpoint:
    """The position controller's set-points, NED, m, m/s, m/s^2, rad, rad/s; NaN where unused."""

    time_us: int
    position_ned: tuple[float, float, float]
    velocity_ned: tuple[float, float, float]
    acceleration_ned: tuple[float, float, float]
    yaw: float
    yaw_rate: float
    count: int


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
        self._profile = profile
        self._plant = plant
        self._sensors = sensors
        self._revision = -1
        self._settings: NDArray[np.void] = np.zeros(1, CONTROL_SETTINGS)
        self._mix_key: tuple[object, ...] = ()
        self._input = np.zeros(1, CONTROL_INPUT)
        self._input["landed"] = True
        self.state = np.zeros(1, CONTROL_STATE)
        self._outputs: NDArray[np.float64] = self.state["outputs"][0]
        self._quat_sp = self._input["quat_sp"][0]
        self._quat_sp[0] = 1.0
        self._position_state = np.zeros(1, POSITION_STATE)
        self._position_ticks = position_ticks(profile)
        self._velocity_late = np.zeros(3)
        self._velocity = np.zeros(3)
        self.navigator = Navigator(parameters)
        self.land_detector = LandDetector()
        self._tilt = TiltDetector(parameters)
        self._now_us = 0
        self._tick = 0
        self._next_commander_us = 0
        self.mode = Mode.LOITER
        self._intended = Mode.LOITER
        self._before_landing = Mode.LOITER
        self.armed = False
        self.failsafe = False
        self.terminated = False
        self.ready = False
        self.home: Home | None = None
        self.rejection = ""
        self._armed_us = 0
        self._took_off = False
        self._landed_us: int | None = None
        self._texts: list[Text] = []
        self._offboard_us: int | None = None
        self._offboard_level = control_loop.OFF
        self._takeoff_amsl_m: float | None = None
        self._tilt_warned = False
        self._attitude_sp = AttitudeSetpoint()
        self._load()

    @property
    def motors(self) -> tuple[float, ...]:
        """Signals sent to the motors, 0..1."""
        return tuple(self._outputs[: self.motor_count].tolist())

    @property
    def motor_count(self) -> int:
        """Number of rotors in the parameters."""
        return int(self._settings["motor_count"][0])

    @property
    def landed_state(self) -> LandedState:
        """On the ground, in the air, taking off or landing."""
        if self.land_detector.landed:
            return LandedState.ON_GROUND
        if self.mode is Mode.TAKEOFF:
            return LandedState.TAKEOFF
        return LandedState.LANDING if self.mode is Mode.LAND else LandedState.IN_AIR

    @property
    def attitude_sp_count(self) -> int:
        """How many attitude set-points there have been: cheap to watch for a new one."""
        return self._attitude_sp.count

    @property
    def attitude_sp(self) -> AttitudeSetpoint:
        """Attitude set-point with the rate set-point that the attitude law now makes of it."""
        p, q, r = self.state["rates_sp"][0].tolist()
        sp = self._attitude_sp
        return AttitudeSetpoint(sp.time_us, sp.quat, (p, q, r), sp.thrust, sp.count)

    @property
    def position_sp(self) -> PositionSetpoint:
        """What the position controller was asked for last."""
        request, state = self.navigator.request[0], self._position_state[0]
        n, e, d = request["position_sp"].tolist()
        vn, ve, vd = state["vel_sp"].tolist()
        an, ae, ad = state["acc_sp"].tolist()
        used = self.mode in POSITION_MODES and self.armed
        yaw = float(request["yaw_sp"]) if used else math.nan
        return PositionSetpoint(self._now_us, (n, e, d), (vn, ve, vd), (an, ae, ad), yaw, math.nan, self._tick)

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
        self._took_off = False
        self._landed_us = None
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
        if not self.ready:
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
        count = self._attitude_sp.count + 1
        shown = quat if quat is not None else (1.0, 0.0, 0.0, 0.0)
        self._attitude_sp = AttitudeSetpoint(self._now_us, shown, rates, abs(thrust), count)
        self._offboard_level = control_loop.RATES if quat is None else control_loop.ATTITUDE
        self._input["rates_sp"] = rates
        self._input["yaw_rate_sp"] = rates[2]
        self._quat_sp[:] = shown
        if self.armed:
            self._input["thrust_sp"] = abs(thrust)
            self._input["level"] = self._offboard_level

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
        self._tick += 1
        if self.parameters.revision != self._revision:
            self._load()
        if now_us >= self._next_commander_us:
            self._next_commander_us += COMMANDER_US
            self._think()
        control_tick(self._settings, self._input, self.state, self._sensors.gyro, self._plant.quat)
        if self._tick % self._position_ticks == 0 and self.mode in POSITION_MODES and self.armed:
            self._hold_position()
        return self._outputs

    def _load(self) -> None:
        """Take the parameters over, as PX4's modules do on a parameter update."""
        table = self.parameters
        self._revision = table.revision
        self._mix = mix_of(table)
        self._take_control_settings(control_settings(table, self._profile, self._mix))
        self._position_settings = position_settings(table, self._profile)
        get = table.get
        self._tilt_max_air = math.radians(float(get("MPC_TILTMAX_AIR")))
        self._tilt_max_ground = math.radians(float(get("MPC_TILTMAX_LND")))
        self._land_limits = LandLimits(
            thr_min=float(get("MPC_THR_MIN")),
            hover_thrust=float(get("MPC_THR_HOVER")),
            manual_min=float(get("MPC_MANTHR_MIN")),
            z_vel_max=float(get("LNDMC_Z_VEL_MAX")),
            xy_vel_max=float(get("LNDMC_XY_VEL_MAX")),
            rot_max=math.radians(float(get("LNDMC_ROT_MAX"))),
        )

    def _take_control_settings(self, new: NDArray[np.void]) -> None:
        before, self._settings = self._settings, new
        changed = any((new[name] != before[name]).any() for name in ("low_pass", "notches", "notch_count"))
        if changed and self.state["started"][0]:
            settle_filters(new, self.state)

    def _hold_position(self) -> None:
        position = self._plant.position_ned()
        home_down = self.home.position_ned[2] if self.home else 0.0
        dt_s = float(self._position_settings["dt_s"][0])
        detector = self.land_detector
        flying = self.navigator.state is TakeoffState.FLIGHT
        self._position_settings["tilt_max"] = self._tilt_max_air if flying else self._tilt_max_ground
        self.navigator.update(
            self._now_us, dt_s, self.mode, position, detector.ground_contact, detector.landed, home_down
        )
        position_tick(
            self._position_settings,
            self.navigator.request,
            self._position_state,
            np.array(position),
            self._velocity_late,
        )
        state = self._position_state[0]
        self._quat_sp[:] = state["quat_sp"]
        thrust = float(state["thrust_sp"])
        self._input["thrust_sp"] = thrust
        self._input["yaw_rate_sp"] = math.nan
        self._input["level"] = control_loop.ATTITUDE
        w, x, y, z = self._quat_sp.tolist()
        self._attitude_sp = AttitudeSetpoint(
            self._now_us, (w, x, y, z), (0.0, 0.0, 0.0), thrust, self._attitude_sp.count + 1
        )

    def remember_velocity(self) -> None:
        """Keep the velocity of this tick: the position controller sees it one tick late."""
        self._velocity_late[:] = self._velocity
        self._velocity[:] = self._plant.velocity

    # -- 100 Hz ------------------------------------------------------------------------------------------------

    def _think(self) -> None:
        now = self._now_us
        if not self.ready and now >= READY_US:
            self.ready = True
            self._set_home()
        phi, theta, _ = self._plant.euler()
        input_ = self._input
        self.land_detector.update(now, self._motion(), self._land_limits, self.armed)
        input_["landed"] = self.land_detector.maybe_landed
        self._tilt.update(now, phi, theta, int(input_["level"][0]) != control_loop.OFF)
        if self._tilt.failed and not self.terminated:
            self._on_tilt()
        elif self._tilt_warned:
            self._tilt_warned = False
            self.failsafe = self.terminated or self.mode is not self._intended
        if not self.armed:
            return
        self._watch_offboard()
        self._watch_landing()
        flying = self.mode is Mode.TAKEOFF and self.navigator.state is TakeoffState.FLIGHT
        if flying and self.navigator.reached(self._plant.position_ned()[2]):
            target = self.navigator.target_down
            self._switch(Mode.LOITER)
            if target is not None:
                self.navigator.hold_ned[2] = target

    def _motion(self) -> Motion:
        fx, fy, fz = self._plant.force.tolist()
        p, q, r = self.state["rates"][0].tolist()
        n, e, d = self._velocity.tolist()
        held = self.mode in POSITION_MODES
        descending = held and self.navigator.descending
        thrust = float(self._input["thrust_sp"][0])
        return Motion(thrust, (n, e, d), (p, q, r), (fx, fy, fz), held, descending)

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

    def _watch_landing(self) -> None:
        now = self._now_us
        if not self.land_detector.landed:
            if not self._took_off:
                self._took_off = True
                self.say(Severity.INFO, "Takeoff detected")
            self._landed_us = None
            return
        if self._took_off:
            if self._landed_us is None:
                self._landed_us = now
                self.say(Severity.INFO, "Landing detected")
            wait_s = float(self.parameters.get("COM_DISARM_LAND"))
            if wait_s > 0.0 and now - self._landed_us >= wait_s * 1e6:
                self._disarm("Disarmed by landing")
            return
        wait_s = float(self.parameters.get("COM_DISARM_PRFLT"))
        # PX4 counts from the end of its one-second grace after arming
        if wait_s > 0.0 and now - self._armed_us >= (wait_s + 1.0) * 1e6:
            self._disarm("Disarmed by auto preflight disarming")

    # -- transitions -------------------------------------------------------------------------------------------

    def _health_problem(self) -> str:
        """Why the vehicle cannot fly at all; PX4 says it before it denies arming."""
        if not self.ready:
            return "heading estimate invalid"
        if self.terminated:
            return "flight terminated"
        if self.motor_count == 0:
            return "no usable rotor geometry (CA_ROTOR_COUNT, CA_ROTORn_*)"
        return ""

    def _mode_problem(self) -> str:
        """Why it cannot arm in this mode; PX4 keeps that to itself."""
        if self.mode in NEVER_ARM:
            return f"mode not suitable for arming: {MODE_NAMES[self.mode]}"
        if self.mode is Mode.OFFBOARD and not self._offboard_fresh():
            return "no offboard signal"
        return ""

    def _refuse(self, text: str, reason: str = "") -> Result:
        self.rejection = reason or text
        self.say(Severity.CRITICAL, text)
        return Result.TEMPORARILY_REJECTED

    def _aim_takeoff(self) -> None:
        down = self._plant.position_ned()[2]
        wish_m = self._takeoff_amsl_m
        if wish_m is None or not math.isfinite(wish_m):
            height = float(self.parameters.get("MIS_TAKEOFF_ALT"))
            target = down - height
            self.say(Severity.INFO, f"Using default takeoff altitude: {height:.1f} m")
        else:
            target = ORIGIN[2] - wish_m
        if target > down:
            target = down
            self.say(Severity.CRITICAL, "Already higher than takeoff altitude")
        self.navigator.target_down = target

    def _switch(self, mode: Mode) -> None:
        """The user's (or the mission's) choice of mode."""
        if self.mode not in NEVER_ARM and self.mode is not Mode.TAKEOFF:
            self._before_landing = self.mode
        if mode is not self.mode:
            self._offboard_level = control_loop.OFF
        self._intended = mode
        self.failsafe = self._tilt_warned
        self._enter(mode)

    def _enter(self, mode: Mode) -> None:
        before, self.mode = self.mode, mode
        if not self.armed:
            return
        stopped = int(self._input["level"][0]) == control_loop.OFF
        if mode in POSITION_MODES:
            _, _, yaw = to_euler(tuple(self._plant.quat.tolist()))
            if before is not mode and not self.land_detector.landed:
                self.navigator.airborne()
            self.navigator.enter(self._plant.position_ned(), self._plant.velocity_ned(), yaw)
            if stopped or before not in POSITION_MODES:
                self._position_state = np.zeros(1, POSITION_STATE)
            if mode is Mode.TAKEOFF:
                self._aim_takeoff()
        elif stopped and self._offboard_level != control_loop.OFF:
            # armed in Offboard: what was asked for last is flown at once
            self._input["level"] = self._offboard_level
            self._input["thrust_sp"] = self._attitude_sp.thrust
        elif stopped:
            # armed in Offboard before the first set-point: hold still, no thrust
            self._input["level"] = control_loop.RATES
            self._input["rates_sp"] = 0.0
            self._input["thrust_sp"] = 0.0

    def _disarm(self, text: str) -> None:
        self.armed = False
        self.terminated = False
        self.failsafe = False
        self._tilt_warned = False
        self._input["level"] = control_loop.OFF
        self._input["thrust_sp"] = 0.0
        self.navigator.on_disarm()
        self.say(Severity.INFO, text)
        if self.mode in NEVER_ARM or self.mode is Mode.TAKEOFF:
            self.mode = Mode.LOITER if self._before_landing is Mode.OFFBOARD else self._before_landing
        self._intended = self.mode

    def _terminate(self) -> None:
        self.terminated = True
        self.failsafe = True
        self.mode = self._intended = Mode.TERMINATION
        self._input["level"] = control_loop.OFF
        self._input["thrust_sp"] = 0.0

    def _set_home(self) -> None:
        position = self._plant.position_ned()
        w, x, y, z = self._plant.quat.tolist()
        self.home = Home(*geodetic(position), position, (w, x, y, z))
