"""Where a vehicle is, from its sensors: inertial navigation that GPS and compass keep from drifting.

The accelerometer of these airframes reads what the air does to them, too (Yv v + Yp p + Yd delta), so it does not tell
which way is down. Tilt comes from velocity: what is tilted wrongly gains speed that GPS does not see.
"""

from __future__ import annotations

import math

import numpy as np

from sitl.rotation import from_euler, multiply, normalise, to_world
from sitl.sensors import EARTH_FIELD_GAUSS, local_position

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

G_M_S2 = 9.81
ALIGN = 100
"""Samples at rest from which the first attitude is made."""

_VELOCITY, _POSITION = 0.25, 0.08
"""Shares of a fix's error that are taken over, ten times a second."""
_TILT = 0.004
"""rad of tilt per m/s of velocity error of one fix."""
_HEADING = 0.02
"""Share of a compass error that is taken over, fifty times a second."""
_TRUTH = 0.3
"""Share of the truth's velocity and position that is taken over every tick: they come in cm."""


class Estimator:
    """Attitude, velocity and position of one vehicle.

    Args:
        field_gauss: magnetic field, NED, gauss: which way is north.

    Attributes:
        quat: body to world. velocity, position: NED, m/s and m. ready: aligned, and a fix has come.
    """

    def __init__(self, field_gauss: Vec3 = EARTH_FIELD_GAUSS) -> None:
        self.quat: Quat = (1.0, 0.0, 0.0, 0.0)
        self.velocity = np.zeros(3)
        self.position = np.zeros(3)
        self.aligned = False
        self.fixes = 0
        self._declination = math.atan2(field_gauss[1], field_gauss[0])
        self._level: list[Vec3] = []
        self._north: list[Vec3] = []

    @property
    def ready(self) -> bool:
        return self.aligned and self.fixes > 0

    def inertial(self, gyro: Vec3, accel: Vec3, dt_s: float) -> None:
        """One IMU sample, dt_s after the last: rad/s, m/s^2."""
        if not self.aligned:
            self._level.append(accel)
            if len(self._level) >= ALIGN and self._north:
                self._align()
            return
        self._turn((gyro[0] * dt_s, gyro[1] * dt_s, gyro[2] * dt_s), in_body=True)
        force = np.array(to_world(self.quat, accel))
        force[2] += G_M_S2
        self.position += (self.velocity + 0.5 * dt_s * force) * dt_s
        self.velocity += force * dt_s

    def compass(self, mag: Vec3) -> None:
        """One reading of the magnetometer, gauss, body axes."""
        if not self.aligned:
            self._north.append(mag)
            return
        north, east, _ = to_world(self.quat, mag)
        error = math.remainder(self._declination - math.atan2(east, north), math.tau)
        self._turn((0.0, 0.0, _HEADING * error), in_body=False)

    def fix(self, lat_deg: float, lon_deg: float, alt_m: float, velocity_ned: Vec3) -> None:
        """A position fix: deg, m AMSL, m/s."""
        self.fixes += 1
        position = np.array(local_position(lat_deg, lon_deg, alt_m))
        if self.fixes == 1:
            self.position[:] = position
        if not self.aligned:
            return
        wrong = np.array(velocity_ned) - self.velocity
        self.velocity += _VELOCITY * wrong
        self.position += _POSITION * (position - self.position)
        # too little speed north: the nose is lower than thought, which is a turn about minus east
        self._turn((_TILT * wrong[1], -_TILT * wrong[0], 0.0), in_body=False)

    def truth(self, quat: Quat, lat_deg: float, lon_deg: float, alt_m: float, velocity_ned: Vec3) -> None:
        """The simulator's own word, for who may have it."""
        self.quat = normalise(quat)
        self.aligned = True
        share = _TRUTH if self.fixes else 1.0
        self.fixes += 1
        self.velocity += share * (np.array(velocity_ned) - self.velocity)
        self.position += share * (np.array(local_position(lat_deg, lon_deg, alt_m)) - self.position)

    def _align(self) -> None:
        x, y, z = np.mean(self._level, axis=0).tolist()
        phi, theta = math.atan2(-y, -z), math.atan2(x, math.hypot(y, z))
        level = from_euler(phi, theta, 0.0)
        north, east, _ = to_world(level, tuple(np.mean(self._north, axis=0).tolist()))
        self.quat = from_euler(phi, theta, math.remainder(self._declination - math.atan2(east, north), math.tau))
        self.aligned = True

    def _turn(self, angle: Vec3, *, in_body: bool) -> None:
        """Turn by a small angle, rad, about body or world axes."""
        size = math.sqrt(angle[0] ** 2 + angle[1] ** 2 + angle[2] ** 2)
        part = 0.5 if size < 1e-9 else math.sin(0.5 * size) / size
        turn = (math.cos(0.5 * size), part * angle[0], part * angle[1], part * angle[2])
        self.quat = normalise(multiply(self.quat, turn) if in_body else multiply(turn, self.quat))
