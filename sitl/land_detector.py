"""Is it on the ground? PX4's three stages: ground contact, maybe landed, landed.

Source: PX4 ``land_detector/MulticopterLandDetector``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

STAGE_US = 333_000
"""How long each stage must last, us."""

_FREEFALL_M_S2 = 2.0
_LOW_THROTTLE = 0.6
"""Share of the way from minimum to hover thrust that still counts as low (hover thrust known)."""
_NO_THROTTLE = 0.1
"""Share of the same way that counts as none while the mode controls vertical speed."""


class Motion(NamedTuple):
    """What the detector looks at.

    Attributes:
        thrust: collective thrust set-point, 0..1.
        velocity_ned: m/s.
        rates: body rates, rad/s.
        specific_force: body, m/s^2.
        climb_controlled: the mode controls vertical speed.
        descending: the mode means to go down (or to stay down).
    """

    thrust: float
    velocity_ned: tuple[float, float, float]
    rates: tuple[float, float, float]
    specific_force: tuple[float, float, float]
    climb_controlled: bool
    descending: bool


@dataclass(frozen=True)
class LandLimits:
    """Thresholds: thr_min, hover_thrust, manual_min (0..1); z_vel_max, xy_vel_max (m/s); rot_max (rad/s)."""

    thr_min: float
    hover_thrust: float
    manual_min: float
    z_vel_max: float
    xy_vel_max: float
    rot_max: float


class LandDetector:
    """Landed flags with hysteresis; starts landed."""

    def __init__(self) -> None:
        self.ground_contact = True
        self.maybe_landed = True
        self.landed = True
        self._contact_since: int | None = None
        self._maybe_since: int | None = None
        self._landed_since: int | None = None

    def flies(self, thrust: float, limits: LandLimits) -> bool:
        """Is it in the air, with so much thrust that nothing else need be looked at?"""
        if self.landed or self._contact_since is not None:
            return False
        return thrust > limits.thr_min + _LOW_THROTTLE * (limits.hover_thrust - limits.thr_min)

    def update(self, now_us: int, motion: Motion, limits: LandLimits, armed: bool) -> None:
        """Look once more; call at 100 Hz.

        Args:
            now_us: vehicle time, us.
            motion: what the vehicle does now.
            limits: thresholds from the parameters.
            armed: disarmed is always landed.
        """
        if not armed:
            self.ground_contact = self.maybe_landed = self.landed = True
            self._contact_since = self._maybe_since = self._landed_since = now_us - STAGE_US
            return
        span = limits.hover_thrust - limits.thr_min
        low = limits.thr_min + _LOW_THROTTLE * span
        vn, ve, vd = motion.velocity_ned
        touching = (
            motion.thrust <= low
            and abs(vd) < limits.z_vel_max
            and math.hypot(vn, ve) < limits.xy_vel_max
            and (motion.descending or not motion.climb_controlled or self.maybe_landed)
        )
        floor = limits.thr_min + _NO_THROTTLE * span if motion.climb_controlled else limits.manual_min + 0.01
        factor = 2.5 if self.landed else 1.0
        still = math.hypot(motion.rates[0], motion.rates[1]) < limits.rot_max * factor
        falling = math.sqrt(sum(f * f for f in motion.specific_force)) < _FREEFALL_M_S2
        self._contact_since = (self._contact_since or now_us) if touching else None
        self.ground_contact = touching and now_us - (self._contact_since or now_us) >= STAGE_US
        maybe = self.ground_contact and motion.thrust <= floor and still and not falling
        self._maybe_since = (self._maybe_since or now_us) if maybe else None
        self.maybe_landed = maybe and now_us - (self._maybe_since or now_us) >= STAGE_US
        self._landed_since = (self._landed_since or now_us) if self.maybe_landed else None
        self.landed = self.maybe_landed and now_us - (self._landed_since or now_us) >= STAGE_US
