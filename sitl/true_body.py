"""A vehicle without autopilot and without sensors, at any rate: for autopilots that make their own sensors' errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sitl.actuators import MAX_MOTORS
from sitl.control_settings import mix_of
from sitl.errors import UsageError
from sitl.parameters import ParameterTable
from sitl.plant import Plant
from sitl.profile import Profile
from sitl.vehicle import Truth, airframe_parameters
from sitl.vehicle_spec import VehicleModel


class TrueBody:
    """What an autopilot flies that asks for the true state.

    Args:
        model: derivatives, body, assumptions.
        profile: of which the motor lag is used; rates, delays, filters and noise are the autopilot's own business.
        rate_hz: ticks per second, whole or not.

    Attributes:
        truth: what the plant does.
        time_s: vehicle time since it was put on the ground, s.

    Raises:
        UsageError: the profile's form is the study's linear one, which knows no attitude.
    """

    def __init__(self, model: VehicleModel, profile: Profile, *, rate_hz: float) -> None:
        if profile.linear:
            raise UsageError(
                f'profile "{profile.name}" is the study\'s linear model of the roll axis alone; a real autopilot needs '
                'attitude, gravity and all axes: use profile "sitl"'
            )
        self.model = model
        self.profile = profile
        self.rate_hz = rate_hz
        self._mix = mix_of(ParameterTable(airframe_parameters(model, profile)))
        self._commands = np.zeros(MAX_MOTORS)
        self._ticks = 0
        self._since_s = 0.0
        self.reset()

    def step(self, motors: Sequence[float]) -> None:
        """One tick.

        Args:
            motors: commands 0..1 in PX4's motor order, held over the tick; what is missing stands still.
        """
        count = min(len(motors), MAX_MOTORS)
        self._commands[:count] = motors[:count]
        self._commands[count:] = 0.0
        self.plant.step(self._commands)
        self._ticks += 1
        # from whole ticks: a sum of them would drift away from the plant
        self.time_s = self._since_s + self._ticks / self.rate_hz

    def set_rate(self, rate_hz: float) -> None:
        """Go on from here at another rate; nothing jumps.

        Args:
            rate_hz: ticks per second.
        """
        if rate_hz != self.rate_hz:
            self.rate_hz = rate_hz
            self._since_s, self._ticks = self.time_s, 0
            self.plant.set_tick(1e6 / rate_hz)

    def reset(self) -> None:
        """Back on the ground at the origin, motors standing, time zero."""
        self.plant = Plant(
            self.model.derivatives,
            self.model.assumptions,
            self._mix,
            tick_us=1e6 / self.rate_hz,
            motor_lag_s=self.profile.motor_lag(self.model.assumptions.motor_lag_s),
        )
        self.truth = Truth(self.plant)
        self.time_s = 0.0
        self._since_s, self._ticks = 0.0, 0
