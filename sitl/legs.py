"""What a guiding mode wants flown next, from one run of the position controller to the next."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from sitl.modes import Home

Vec3 = tuple[float, float, float]

FAR_M = 1e6
"""A place further away than this is flown towards as if it were this far."""


class LegKind(Enum):
    """Ways of getting on."""

    HOLD = 0
    TAKEOFF = 1
    GO = 2
    CIRCLE = 3
    LAND = 4
    DESCEND = 5


class Leg(NamedTuple):
    """One piece of a flight.

    Attributes:
        kind: what to do.
        ned: where to, m; centre of a circle; place of a landing. Taking off only its height counts.
        yaw: heading to take, rad; NaN faces the way (GO) or keeps what is.
        speed_m_s: largest horizontal speed; NaN for the navigator's own.
        exit_m_s: speed at which the place may be passed.
        radius_m: of a circle, positive is clockwise from above.
    """

    kind: LegKind
    ned: Vec3 = (0.0, 0.0, 0.0)
    yaw: float = math.nan
    speed_m_s: float = math.nan
    exit_m_s: float = 0.0
    radius_m: float = 0.0


class Here(NamedTuple):
    """What a mission or a return looks at.

    Attributes:
        now_us: vehicle time. position_ned: m. yaw: rad.
        landed: from the land detector. home: where heights count from, if known.
        turned_rad: how far the circle under way has gone round.
    """

    now_us: int
    position_ned: Vec3
    yaw: float
    landed: bool
    home: Home | None
    turned_rad: float = 0.0

    @property
    def home_ned(self) -> Vec3:
        """Home in the local frame, m; its origin while there is none."""
        return self.home.position_ned if self.home else (0.0, 0.0, 0.0)

    def flat_distance_m(self, ned: Vec3) -> float:
        """Horizontal distance to a place, m."""
        return math.hypot(ned[0] - self.position_ned[0], ned[1] - self.position_ned[1])


def bounded(ned: Vec3, otherwise: Vec3) -> Vec3:
    """A place the controller can reckon with: what is not finite is taken from `otherwise`, the rest held near."""
    n, e, d = (
        min(FAR_M, max(-FAR_M, wanted)) if math.isfinite(wanted) else known
        for wanted, known in zip(ned, otherwise, strict=True)
    )
    return n, e, d


def wrap(angle: float) -> float:
    """An angle within +-pi, rad."""
    return math.remainder(angle, math.tau)
