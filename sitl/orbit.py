"""Going round a place: to the nearest point of the circle first, then round.

Source: PX4 ``FlightTaskOrbit`` (approach, then circle); also flown for NAV_LOITER_TURNS.
"""

from __future__ import annotations

import math

from sitl.legs import Leg, LegKind, Vec3

_ON_CIRCLE_M, _AT_HEIGHT_M = 0.5, 0.8
_SMALLEST_M, _LARGEST_M = 1.0, 10_000.0


def sane_radius(radius_m: float, otherwise_m: float) -> float:
    """A radius that can be flown, m, sign kept; what is zero or not finite is the other one."""
    radius_m = radius_m if math.isfinite(radius_m) and radius_m else otherwise_m
    radius_m = radius_m if math.isfinite(radius_m) and radius_m else _SMALLEST_M
    return math.copysign(min(_LARGEST_M, max(_SMALLEST_M, abs(radius_m))), radius_m)


class Orbit:
    """A circle to be flown.

    Args:
        leg: a GO leg to its centre, with speed and heading. radius_m: positive is clockwise from above.
        position: where it is approached from, NED, m.
    """

    def __init__(self, leg: Leg, radius_m: float, position: Vec3) -> None:
        self._round = leg._replace(kind=LegKind.CIRCLE, radius_m=radius_m, exit_m_s=0.0)
        n, e, d = leg.ned
        out_n, out_e = position[0] - n, position[1] - e
        size = math.hypot(out_n, out_e)
        out = (out_n / size, out_e / size) if size > 0.1 else (1.0, 0.0)
        self._entry = leg._replace(ned=(n + out[0] * abs(radius_m), e + out[1] * abs(radius_m), d), exit_m_s=0.0)
        self.entered = False

    def leg(self, position: Vec3) -> Leg:
        """What to fly now. position: NED, m."""
        n, e, d = self._entry.ned
        off_m = math.hypot(position[0] - n, position[1] - e)
        self.entered = self.entered or (off_m <= _ON_CIRCLE_M and abs(position[2] - d) <= _AT_HEIGHT_M)
        return self._round if self.entered else self._entry
