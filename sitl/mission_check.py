"""Can a mission be flown? PX4's reasons why not, in PX4's words.

Source: PX4 ``navigator/MissionFeasibility``.
"""

from __future__ import annotations

from sitl.modes import Home
from sitl.plan import (
    CONDITION_YAW,
    DO_CHANGE_SPEED,
    DO_JUMP,
    DO_SET_HOME,
    NAV_DELAY,
    NAV_LAND,
    NAV_LOITER_TIME,
    NAV_LOITER_TURNS,
    NAV_LOITER_UNLIM,
    NAV_RETURN_TO_LAUNCH,
    NAV_TAKEOFF,
    NAV_WAYPOINT,
    MissionItem,
)

PLACES = frozenset({NAV_WAYPOINT, NAV_LOITER_UNLIM, NAV_LOITER_TURNS, NAV_LOITER_TIME, NAV_LAND, NAV_TAKEOFF})
"""Items that name a place."""
FLOWN = PLACES | {NAV_RETURN_TO_LAUNCH, NAV_DELAY, DO_JUMP, DO_CHANGE_SPEED, DO_SET_HOME, CONDITION_YAW}
"""Items that are flown."""
PASSED_OVER = frozenset(
    {0, 112, 187, 189, 195, 196, 197, 200, 201, 203, 204, 205, 206, 211, 212, 214, 530, 531, 532, 1000, 1001, 2000}
    | {2001, 2003, 2500, 2501}
)
"""Items for a camera, a gimbal or a gripper that this vehicle does not have: reached as soon as they are met."""

NO_MISSION = "No valid mission"


def mission_problem(items: tuple[MissionItem, ...], home: Home | None, landed: bool) -> str:
    """Why a mission can not be flown; empty if it can.

    Args:
        items: the mission. home: where heights count from, if known. landed: is it on the ground?
    """
    if not items:
        return NO_MISSION
    placed = False
    for number, item in enumerate(items, start=1):
        if item.command not in FLOWN | PASSED_OVER:
            return f"Mission rejected: item {number}: unsupported cmd: {item.command}"
        if number == 1 and item.command == NAV_LAND and landed:
            return "Mission rejected: starts with landing"
        if item.command == NAV_TAKEOFF:
            above = item.alt_m if item.relative or home is None else item.alt_m - home.alt_m
            if above <= 0.0:
                return "Mission rejected: Takeoff altitude below home altitude!"
            if placed:
                return "Mission rejected: takeoff not first waypoint item"
        if item.command in PLACES and item.relative and home is None:
            return f"Mission rejected: No home pos, WP {number} uses rel alt"
        placed = placed or item.command in PLACES or item.command == NAV_RETURN_TO_LAUNCH
    return ""
