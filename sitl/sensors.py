"""What the vehicle measures: IMU, magnetometer, barometer, GPS, from the plant's state plus seeded noise.

The noise is drawn in blocks from one generator per vehicle and indexed by tick, so a reading depends on the seed and
the tick alone, not on who looks at it or when. The gyro is quantised towards zero, as the 16-bit sensor of PX4's
simulator is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sitl.compiled import compiled
from sitl.plant import Plant
from sitl.profile import Profile
from sitl.rotation import to_body

_BLOCK = 1024
EARTH_FIELD_GAUSS = (0.215231, 0.013340, 0.432900)
"""Magnetic field at ORIGIN, NED, gauss: `sitl.geomagnetism.earth_field_gauss` there."""
_METRES_PER_DEG = 111_319.49
GPS_PERIOD_US = 100_000

ORIGIN = (47.397742, 8.545594, 488.0)
"""PX4's customary home: latitude and longitude in deg, height above mean sea level in m."""


@dataclass(frozen=True)
class Gps:
    """A position fix: degrees, metres above mean sea level, m/s NED, one-sigma accuracies in m."""

    time_us: int
    lat_deg: float
    lon_deg: float
    alt_m: float
    vel_ned: tuple[float, float, float]
    eph_m: float = 0.3
    epv_m: float = 0.4
    satellites: int = 12
    fix_type: int = 3


class GyroError(Protocol):
    """What faults make of a sample of the gyro; asked for once per sample."""

    def added(self) -> NDArray[np.float64]:
        """(3,) added to the true rates, rad/s."""

    def lost(self) -> NDArray[np.bool_]:
        """(3,) True where the sample does not come and the one before stands."""


def geodetic(
    position_ned: tuple[float, float, float], origin: tuple[float, float, float] = ORIGIN
) -> tuple[float, float, float]:
    """Latitude (deg), longitude (deg), height (m AMSL) of a NED position (m) on a locally flat earth."""
    lat = origin[0] + position_ned[0] / _METRES_PER_DEG
    lon = origin[1] + position_ned[1] / _metres_per_deg_east(origin[0])
    return lat, lon, origin[2] - position_ned[2]


def local_position(
    lat_deg: float, lon_deg: float, alt_m: float, origin: tuple[float, float, float] = ORIGIN
) -> tuple[float, float, float]:
    """NED position (m) of a latitude (deg), longitude (deg) and height (m AMSL); the inverse of `geodetic`."""
    north = (lat_deg - origin[0]) * _METRES_PER_DEG
    east = (lon_deg - origin[1]) * _metres_per_deg_east(origin[0])
    return north, east, origin[2] - alt_m


@cache
def _metres_per_deg_east(lat_deg: float) -> float:
    return _METRES_PER_DEG * math.cos(math.radians(lat_deg))


def pressure_hpa(alt_m: float) -> float:
    """Pressure of the standard atmosphere, hPa, at a height in m AMSL; nothing above the 44 km where it ends."""
    return float(1013.25 * max(0.0, 1.0 - 2.25577e-5 * alt_m) ** 5.25588)


@compiled
def measure_gyro(
    rates: NDArray[np.float64],
    noise: NDArray[np.float64],
    row: int,
    quantum: float,
    gyro: NDArray[np.float64],
) -> None:
    """Body rates plus noise, cut towards zero to whole quanta.

    Args:
        rates: (3,) true, rad/s. noise: (n, >=3), rad/s. row: of the noise. quantum: rad/s, 0 for exact.
        gyro: (3,) output, rad/s.
    """
    for axis in range(3):
        value = rates[axis] + noise[row, axis]
        gyro[axis] = math.trunc(value / quantum) * quantum if quantum > 0.0 else value


class Sensors:
    """The sensors of one vehicle.

    Args:
        plant: what moves. profile: noise levels. seed: of the noise.
        origin: where its position 0 is: latitude and longitude in deg, height above mean sea level in m.
        field_gauss: magnetic field at the origin, NED, gauss. gps_period_us: between two fixes.
    """

    def __init__(
        self,
        plant: Plant,
        profile: Profile,
        seed: int,
        *,
        origin: tuple[float, float, float] = ORIGIN,
        field_gauss: tuple[float, float, float] = EARTH_FIELD_GAUSS,
        gps_period_us: int = GPS_PERIOD_US,
    ) -> None:
        self._plant = plant
        self._profile = profile
        self._rng = np.random.default_rng([seed, 1])
        self._gps_rng = np.random.default_rng([seed, 2])
        self._noise = np.zeros((_BLOCK, 10))
        self._row = _BLOCK
        self._scale = np.array(
            [profile.gyro_noise_rad_s] * 3
            + [profile.accel_noise_m_s2] * 3
            + [profile.mag_noise_gauss] * 3
            + [profile.baro_noise_hpa]
        )
        self._origin = origin
        self._field_gauss = field_gauss
        self._gps_period_us = gps_period_us
        self._next_gps_us = 0
        self.gyro = np.zeros(3)
        self.gyro_fault: GyroError | None = None
        """What is wrong with the gyro; None while nothing is."""
        self._gps = Gps(0, *origin, (0.0, 0.0, 0.0))

    def sample(self, now_us: int) -> None:
        """Read all sensors once; ``gyro`` (3,) rad/s is ready afterwards.

        Args:
            now_us: vehicle time, us.
        """
        self._row += 1
        if self._row >= _BLOCK:
            self._noise = self._rng.standard_normal((_BLOCK, 10)) * self._scale
            self._row = 0
        quantum = self._profile.gyro_quantum_rad_s
        if self.gyro_fault is None:
            measure_gyro(self._plant.rates, self._noise, self._row, quantum, self.gyro)
        else:
            before, lost = self.gyro.copy(), self.gyro_fault.lost()
            rates = self._plant.rates + self.gyro_fault.added()
            measure_gyro(rates, self._noise, self._row, quantum, self.gyro)
            self.gyro[lost] = before[lost]
        if now_us >= self._next_gps_us:
            # from now, not from zero: sensors may begin late, and must not make up for fixes nobody saw
            self._next_gps_us = now_us - now_us % self._gps_period_us + self._gps_period_us
            self._fix(now_us)

    def _fix(self, now_us: int) -> None:
        spread = self._gps_rng.standard_normal(6)
        position = np.array(self._plant.position_ned()) + spread[:3] * self._profile.gps_noise_m
        velocity = np.array(self._plant.velocity_ned()) + spread[3:] * self._profile.gps_noise_m_s
        north, east, down = velocity.tolist()
        self._gps = Gps(now_us, *geodetic(tuple(position.tolist()), self._origin), (north, east, down))

    def gps(self) -> Gps:
        """The last fix (10 Hz)."""
        return self._gps

    def accel(self) -> tuple[float, float, float]:
        """Specific force over the last tick, body axes, m/s^2; a_y is the study's output."""
        x, y, z = (self._plant.force + self._noise[self._row % _BLOCK, 3:6]).tolist()
        return x, y, z

    def mag(self) -> tuple[float, float, float]:
        """Magnetic field, body axes, gauss."""
        field = to_body(tuple(self._plant.quat.tolist()), self._field_gauss)
        x, y, z = (np.array(field) + self._noise[self._row % _BLOCK, 6:9]).tolist()
        return x, y, z

    def pressure(self) -> float:
        """Static pressure, hPa."""
        return pressure_hpa(self._origin[2] - float(self._plant.x[2])) + float(self._noise[self._row % _BLOCK, 9])
