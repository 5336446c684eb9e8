"""A vehicle without an autopilot: plant, sensors and time, for a real one to fly."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sitl.actuators import MAX_MOTORS
from sitl.control_settings import mix_of
from sitl.errors import UsageError
from sitl.faults import Faults
from sitl.geomagnetism import earth_field_gauss
from sitl.parameters import ParameterTable
from sitl.plant import Plant
from sitl.profile import Profile
from sitl.sensors import EARTH_FIELD_GAUSS, GPS_PERIOD_US, ORIGIN, Gps, Sensors
from sitl.vehicle import Truth, airframe_parameters
from sitl.vehicle_spec import VehicleModel

RATE_HZ = 250
"""What PX4 takes from a simulator: at 400 Hz and above it answers every second sample only."""

START_US = 1_000_000
"""An autopilot's clock is the simulator's: it must not begin at 0."""

LEAST_NOISE = {
    "gyro_noise_rad_s": 0.0015,
    "accel_noise_m_s2": 0.005,
    "mag_noise_gauss": 0.0005,
    "baro_noise_hpa": 0.005,
    "gps_noise_m": 0.01,
    "gps_noise_m_s": 0.005,
}
"""A sensor that repeats itself exactly is taken for dead: "MAG STALE". The gyro's is above the autopilot's resolution,
about 1 mrad/s cut towards zero, or it would read nothing but zeros at rest."""


class Body:
    """What an autopilot flies.

    Args:
        model: derivatives, body, assumptions.
        profile: of which motor lag, transport delay and noise are used; the autopilot's items are its own business.
        seed: of the noise.
        home: where it stands: latitude and longitude in deg, height above mean sea level in m.
        gps_delay_ticks: a fix is handed over so much later, as a receiver does.
        gps_period_us: between two fixes.

    Raises:
        UsageError: the profile's form is the study's linear one, which knows no attitude.
    """

    tick_us = 1_000_000 // RATE_HZ

    def __init__(
        self,
        model: VehicleModel,
        profile: Profile,
        *,
        seed: int = 0,
        home: tuple[float, float, float] = ORIGIN,
        gps_delay_ticks: int = 2,
        gps_period_us: int = GPS_PERIOD_US,
    ) -> None:
        if profile.linear:
            raise UsageError(
                f'profile "{profile.name}" is the study\'s linear model of the roll axis alone; a real autopilot needs '
                'attitude, gravity and all axes: use profile "sitl"'
            )
        self.model = model
        self.profile = sensed(profile)
        self.seed = seed
        self.tick = 0
        self.home = home
        self._field_gauss = EARTH_FIELD_GAUSS if home == ORIGIN else earth_field_gauss(*home)
        self._gps_delay_ticks = gps_delay_ticks
        self._gps_period_us = gps_period_us
        self._commands = np.zeros(MAX_MOTORS)
        self._last_fix_us = 0
        self._place()

    @property
    def time_us(self) -> int:
        """Vehicle time, us; it never goes back, not even by `reset`."""
        return START_US + self.tick * self.tick_us

    def step(self, motors: Sequence[float]) -> None:
        """One tick.

        Args:
            motors: commands 0..1 in PX4's motor order, held over the tick; what is missing stands still.
        """
        if len(motors) >= MAX_MOTORS:
            self._commands[:] = motors[:MAX_MOTORS]
        else:
            self._commands[: len(motors)] = motors
            self._commands[len(motors) :] = 0.0
        self.plant.step(self._commands)
        self.tick += 1
        self.sensors.sample(self.time_us)
        fix = self.sensors.gps()
        if fix.time_us != self._last_fix_us:
            self._last_fix_us = fix.time_us
            self._fixes.append((self.tick + self._gps_delay_ticks, fix))

    def fix(self) -> Gps | None:
        """The position fix that is handed over in this tick, if one is."""
        if self._fixes and self._fixes[0][0] <= self.tick:
            return self._fixes.popleft()[1]
        return None

    def reset(self) -> None:
        """Back on the ground at the origin, motors standing; the noise goes on."""
        self.seed += 1
        self._place()

    def _place(self) -> None:
        table = ParameterTable(airframe_parameters(self.model, self.profile))
        self.plant = Plant(
            self.model.derivatives,
            self.model.assumptions,
            mix_of(table),
            tick_us=self.tick_us,
            motor_lag_s=self.profile.motor_lag(self.model.assumptions.motor_lag_s),
            delay_ticks=self.profile.transport_delay_ticks,
        )
        self.sensors = Sensors(
            self.plant,
            self.profile,
            self.seed,
            origin=self.home,
            field_gauss=self._field_gauss,
            gps_period_us=self._gps_period_us,
        )
        self.faults = Faults(self.plant, self.sensors, self.seed)
        self.truth = Truth(self.plant)
        self._fixes: deque[tuple[int, Gps]] = deque()
        self._last_fix_us = self.sensors.gps().time_us
        self.sensors.sample(self.time_us)


def sensed(profile: Profile) -> Profile:
    """The profile as a real autopilot's simulator needs it: at its rate, with some noise, quantised by the autopilot.

    Args:
        profile: as chosen.
    """
    noise = {name: max(getattr(profile, name), least) for name, least in LEAST_NOISE.items()}
    # a delay in ticks of another rate belongs to the autopilot of that rate
    ticks = profile.transport_delay_ticks if profile.rate_hz == RATE_HZ else 0
    return replace(profile, rate_hz=RATE_HZ, transport_delay_ticks=ticks, gyro_quantum_rad_s=0.0, **noise)
