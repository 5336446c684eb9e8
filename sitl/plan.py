"""A mission as it was uploaded: its items, kept so exactly that they can be downloaded again.

Source: MAVLink mission service (MISSION_ITEM_INT), PX4 ``navigation/navigation.h``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

GLOBAL_FRAMES = (0, 3, 5, 6)
"""MAV_FRAME_GLOBAL, ..._RELATIVE_ALT and their integer twins: x and y are degrees."""

RELATIVE_FRAMES = (3, 6)
"""Heights count from home."""

NAV_WAYPOINT, NAV_LOITER_UNLIM, NAV_LOITER_TURNS, NAV_LOITER_TIME = 16, 17, 18, 19
NAV_RETURN_TO_LAUNCH, NAV_LAND, NAV_TAKEOFF, NAV_DELAY = 20, 21, 22, 93
DO_JUMP, DO_CHANGE_SPEED, DO_SET_HOME, CONDITION_YAW = 177, 178, 179, 115
"""MAV_CMD numbers that a mission may hold and this vehicle flies."""


@dataclass(frozen=True)
class MissionItem:
    """One item of a plan.

    Attributes:
        frame: MAV_FRAME. command: MAV_CMD. autocontinue: go on by itself.
        params: param1..param4 as they came; their meaning is the command's.
        lat_deg, lon_deg: place, deg; in frames without a place x and y as they came.
        alt_m: height, m, above what the frame says.
    """

    frame: int
    command: int
    autocontinue: bool
    params: tuple[float, float, float, float]
    lat_deg: float
    lon_deg: float
    alt_m: float

    @property
    def relative(self) -> bool:
        """Does its height count from home?"""
        return self.frame in RELATIVE_FRAMES

    @property
    def placed(self) -> bool:
        """Does it name a place on the globe?"""
        return self.frame in GLOBAL_FRAMES and math.isfinite(self.lat_deg) and math.isfinite(self.lon_deg)
