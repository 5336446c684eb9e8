"""The autopilot: the commander that decides and the control that flies, tick by tick.

At 100 Hz it thinks as PX4's commander does; every tick it lets `sitl.flight_control` fly.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.commander import Commander
from sitl.failsafe import Action
from sitl.flight_control import FlightControl
from sitl.guide import ATTITUDE_BY_STICK
from sitl.land_detector import LandDetector
from sitl.landing_watch import land_limits
from sitl.modes import LandedState, Mode
from sitl.navigator import Navigator
from sitl.parameters import ParameterTable
from sitl.plant import Plant
from sitl.profile import Profile
from sitl.sensors import Sensors
from sitl.setpoints import AttitudeSetpoint, PositionRequest, PositionSetpoint

COMMANDER_US = 10_000
LONGEST_TEST_S = 3.0
"""Longest time that a motor is tested for, s."""


class Autopilot(Commander):
    """Modes, arming and control of one vehicle.

    Args:
        parameters: the table it obeys, re-read whenever it changes.
        profile: rates and lateness of the loops.
        plant: what it flies; read only through what an estimator gives.
        sensors: the gyro.

    Attributes:
        offboard_levels: the last Offboard set-point asks for an attitude (or more), not for bare rates.
    """

    def __init__(self, parameters: ParameterTable, profile: Profile, plant: Plant, sensors: Sensors) -> None:
        super().__init__(parameters, plant, FlightControl(parameters, profile, plant, sensors))
        self._revision = parameters.revision
        self._next_commander_us = 0
        self.offboard_levels = False
        self._tested: tuple[int, float, int] | None = None

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
    def armed_us(self) -> int | None:
        """Vehicle time of arming, None while disarmed."""
        return self._armed_us if self.armed else None

    @property
    def took_off_us(self) -> int | None:
        """Vehicle time of taking off, None while disarmed or before."""
        return self._landing.took_off_us if self.armed else None

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
        return self.control.position_sp(self._now_us, used=self.armed and self.by_position)

    @property
    def by_position(self) -> bool:
        """Does the position controller fly this mode?"""
        if self.mode is Mode.OFFBOARD:
            return self.control.by_position
        return self.mode not in ATTITUDE_BY_STICK and self.mode is not Mode.TERMINATION

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
        self.offboard_levels = quat is not None
        if self.mode is Mode.OFFBOARD:
            self.control.take_setpoint(self._now_us, quat, rates, abs(thrust), fly=self.armed)

    def offboard_position(self, request: PositionRequest) -> None:
        """A set-point for the position controller: keeps Offboard alive and, in Offboard, is flown."""
        self._offboard_us = self._now_us
        self.offboard_levels = True
        if self.mode is Mode.OFFBOARD:
            self.control.take_position(self._now_us, request, fly=self.armed)

    def test_motor(self, motor: int, value: float, seconds: float) -> None:
        """Turn one motor while disarmed: PX4's actuator test. Nothing happens while armed or with a motor it has not.

        Args:
            motor: from 0. value: 0..1; below 0 or not finite is off. seconds: for how long, at most LONGEST_TEST_S.
        """
        if self.armed or not 0 <= motor < self.motor_count:
            return
        value = max(0.0, min(1.0, value)) if math.isfinite(value) else 0.0
        seconds = max(0.0, min(LONGEST_TEST_S, seconds)) if math.isfinite(seconds) else 0.0
        self._tested = (motor, value, self._now_us + round(seconds * 1e6))

    def restart(self) -> None:
        """Boot anew, wherever the vehicle is: disarmed, motors off, nothing known but the parameters."""
        self._booted_us = self._now_us
        self.armed = self.terminated = self.failsafe = self.healthy = False
        self._tilt_warned = self._told_why = False
        self._home_here = True
        self.home = self._offboard_us = self._takeoff_amsl_m = self._tested = None
        self._action = Action.NONE
        self.mode = self.intended = self._after_disarming = Mode.LOITER
        self.land_detector = LandDetector()
        self.control.restart()

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
            self._land_limits = land_limits(self.parameters)
            self.control.load()
        if now_us >= self._next_commander_us:
            self._next_commander_us += COMMANDER_US
            self.think(now_us)
        outputs = self.control.run()
        if self.armed:
            if self.mode is not Mode.OFFBOARD or self.control.by_position:
                self.control.guide(now_us, self.mode, self.land_detector, self.home)
            self._tested = None
        elif self._tested is not None:
            motor, value, until_us = self._tested
            outputs[motor] = value
            if now_us >= until_us:
                outputs[motor] = 0.0
                self._tested = None
        return outputs
