"""Items of a plan on the wire and in the store: what PX4 takes, what it keeps of it and how it gives it back.

PX4 does not keep an upload's bytes. It keeps what its navigator needs, so a download shows parameters that a
command does not have as zero, a heading between 0 and 360 deg, and the frame's integer twin to those who ask for
integers. Facts from PX4 src/modules/mavlink/mavlink_mission.cpp and from answers recorded from a PX4 SITL.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any, Final

from bridge.messages import Message
from bridge.plan_store import PlanKind
from sitl.errors import FroudeError
from sitl.plan import GLOBAL_FRAMES, RELATIVE_FRAMES, MissionItem

FRAME_MISSION: Final = 2
"""MAV_FRAME_MISSION: an item without a place."""

_FRAME_GLOBAL, _FRAME_GLOBAL_INT = 0, 5
_FRAME_RELATIVE, _FRAME_RELATIVE_INT = 3, 6
_FLOAT_FRAMES = (_FRAME_GLOBAL, _FRAME_RELATIVE)

ERROR, UNSUPPORTED_FRAME, UNSUPPORTED, INVALID_PARAM1 = 1, 2, 3, 6
"""MAV_MISSION_RESULT of refused items."""

_WAYPOINT, _LOITER_UNLIM, _LOITER_TIME, _LAND, _TAKEOFF, _LOITER_TO_ALT = 16, 17, 19, 21, 22, 31
_NAV_ROI, _DO_SET_ROI, _DO_JUMP = 80, 201, 177
_VTOL_TAKEOFF, _VTOL_LAND = 84, 85
_FENCE_POLYGONS, _FENCE_CIRCLES, _RALLY_POINT = (5001, 5002), (5003, 5004), 5100

PLACED_COMMANDS: Final = frozenset(
    {
        _WAYPOINT,
        _LOITER_UNLIM,
        _LOITER_TIME,
        _LAND,
        _TAKEOFF,
        _LOITER_TO_ALT,
        _NAV_ROI,
        _DO_SET_ROI,
        195,  # DO_SET_ROI_LOCATION
        _VTOL_TAKEOFF,
        _VTOL_LAND,
        212,  # DO_AUTOTUNE_ENABLE
        400,  # COMPONENT_ARM_DISARM
        4501,  # CONDITION_GATE
        5000,  # NAV_FENCE_RETURN_POINT
        *_FENCE_POLYGONS,
        *_FENCE_CIRCLES,
        _RALLY_POINT,
    }
)
"""MAV_CMD that PX4 takes in a global frame."""

UNPLACED_COMMANDS: Final = frozenset(
    {
        20,  # NAV_RETURN_TO_LAUNCH
        _NAV_ROI,
        93,  # NAV_DELAY
        112,  # CONDITION_DELAY
        114,  # CONDITION_DISTANCE
        _DO_JUMP,
        178,  # DO_CHANGE_SPEED
        179,  # DO_SET_HOME
        187,  # DO_SET_ACTUATOR
        189,  # DO_LAND_START
        196,  # DO_SET_ROI_WPNEXT_OFFSET
        197,  # DO_SET_ROI_NONE
        200,  # DO_CONTROL_VIDEO
        _DO_SET_ROI,
        203,  # DO_DIGICAM_CONTROL
        204,  # DO_MOUNT_CONFIGURE
        205,  # DO_MOUNT_CONTROL
        206,  # DO_SET_CAM_TRIGG_DIST
        211,  # DO_GRIPPER
        212,  # DO_AUTOTUNE_ENABLE
        214,  # DO_SET_CAM_TRIGG_INTERVAL
        260,  # OBLIQUE_SURVEY
        400,  # COMPONENT_ARM_DISARM
        530,  # SET_CAMERA_MODE
        532,  # SET_CAMERA_FOCUS
        534,  # SET_CAMERA_SOURCE
        1000,  # DO_GIMBAL_MANAGER_PITCHYAW
        1001,  # DO_GIMBAL_MANAGER_CONFIGURE
        2000,  # IMAGE_START_CAPTURE
        2001,  # IMAGE_STOP_CAPTURE
        2003,  # DO_TRIGGER_CONTROL
        2500,  # VIDEO_START_CAPTURE
        2501,  # VIDEO_STOP_CAPTURE
        3000,  # DO_VTOL_TRANSITION
        42600,  # DO_WINCH
    }
)
"""MAV_CMD that PX4 takes in MAV_FRAME_MISSION."""

_NOT_IN_A_MISSION = frozenset((*_FENCE_POLYGONS, *_FENCE_CIRCLES, _RALLY_POINT))
_ROI_PLACED, _ROI_UNPLACED = (0, 3), (0, 1, 2)  # none and location; none, next waypoint and a waypoint's number
_LEAST_VERTICES = 3
_VALUES_BYTES = 28  # param1..4, x, y, z: the first bytes of MISSION_ITEM and MISSION_ITEM_INT
_INT32_LEAST, _INT32_MOST = -(1 << 31), (1 << 31) - 1


class ItemRefused(FroudeError):
    """An item that PX4 does not take.

    Args:
        result: MAV_MISSION_RESULT that says so.
        problem: what is wrong with it.
        silent: PX4 says nothing about it to people.
    """

    def __init__(self, result: int, problem: str, *, silent: bool = False) -> None:
        self.result = result
        self.silent = silent
        super().__init__(f"mission item refused: {problem}")


def item_crc(msg: Message, crc: int) -> int:
    """Carry the CRC32 of an upload on over one more item, as it came; begin with 0."""
    head = struct.pack("<BHB", msg.frame, msg.command, msg.autocontinue)
    values = msg.raw_payload[:_VALUES_BYTES].ljust(_VALUES_BYTES, b"\0")
    return zlib.crc32(head + values, crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF


def item_from(msg: Message, kind: PlanKind) -> MissionItem:
    """Return what is kept of a MISSION_ITEM or MISSION_ITEM_INT.

    Args:
        msg: the item.
        kind: the plan it is for.

    Raises:
        ItemRefused: PX4 takes no such item; it carries the MAV_MISSION_RESULT.
    """
    integers = msg.name == "MISSION_ITEM_INT"
    if msg.frame == FRAME_MISSION:
        item = _unplaced(msg)
    elif msg.frame in (GLOBAL_FRAMES if integers else _FLOAT_FRAMES):
        item = _placed(msg, integers)
    else:
        raise ItemRefused(UNSUPPORTED_FRAME, f"frame {msg.frame} is none for {msg.name}")
    if kind is PlanKind.FENCE:
        return _fence_item(item, msg.param1)
    if kind is PlanKind.MISSION and item.command in _NOT_IN_A_MISSION:
        raise ItemRefused(ERROR, f"command {item.command} belongs into a geofence or rally plan", silent=True)
    return item


def fields_of(item: MissionItem, *, integers: bool) -> dict[str, Any]:
    """Return the fields of the MISSION_ITEM_INT (`integers`) or MISSION_ITEM that gives an item back."""
    if item.frame == FRAME_MISSION:
        frame, scale = FRAME_MISSION, 1.0
    elif item.frame in RELATIVE_FRAMES:
        frame, scale = (_FRAME_RELATIVE_INT if integers else _FRAME_RELATIVE), 1e7
    else:
        frame, scale = (_FRAME_GLOBAL_INT if integers else _FRAME_GLOBAL), 1e7
    x, y = item.lat_deg, item.lon_deg
    param1, param2, param3, param4 = item.params
    return {
        "frame": frame,
        "command": item.command,
        "autocontinue": int(item.autocontinue),
        "param1": param1,
        "param2": param2,
        "param3": param3,
        "param4": param4,
        "x": _int32(x * scale) if integers else x,
        "y": _int32(y * scale) if integers else y,
        "z": item.alt_m,
    }


def _placed(msg: Message, integers: bool) -> MissionItem:
    """An item at a place on the globe."""
    command: int = msg.command
    if command not in PLACED_COMMANDS:
        raise ItemRefused(UNSUPPORTED, f"command {command} is none for a mission")
    if command in (_NAV_ROI, _DO_SET_ROI):
        _check_roi(msg.param1, _ROI_PLACED)
        command = _DO_SET_ROI
    lat, lon = (msg.x * 1e-7, msg.y * 1e-7) if integers else (msg.x, msg.y)
    return MissionItem(msg.frame, command, bool(msg.autocontinue & 1), _kept(msg), lat, lon, msg.z)


def _kept(msg: Message) -> tuple[float, float, float, float]:
    """param1..param4 as PX4 keeps them for a command at a place."""
    command, p1, p2, p3, p4 = msg.command, msg.param1, msg.param2, msg.param3, msg.param4
    if command == _WAYPOINT:
        return p1, p2, 0.0, _heading(p4)
    if command == _LOITER_UNLIM:
        return 0.0, 0.0, p3, _heading(p4)
    if command == _LOITER_TIME:
        return p1, float(p2 > 0), p3, float(p4 > 0)
    if command == _LOITER_TO_ALT:
        return float(p1 > 0), p2, 0.0, float(p4 > 0)
    if command == _LAND:
        return 0.0, float(_uint16(p2)), 0.0, _heading(p4)
    if command in (_TAKEOFF, _VTOL_TAKEOFF, _VTOL_LAND):
        return 0.0, 0.0, 0.0, _heading(p4)
    if command in _FENCE_POLYGONS:
        return float(_uint16(p1 + 0.5)), 0.0, 0.0, 0.0
    if command in _FENCE_CIRCLES:
        return p1, 0.0, 0.0, 0.0
    return 0.0, 0.0, 0.0, 0.0


def _unplaced(msg: Message) -> MissionItem:
    """An item without a place: its seven parameters as they came, all as floats."""
    command: int = msg.command
    if command not in UNPLACED_COMMANDS:
        raise ItemRefused(UNSUPPORTED, f"command {command} is none for a mission without a place")
    p1, p2 = msg.param1, msg.param2
    if command in (_NAV_ROI, _DO_SET_ROI):
        _check_roi(p1, _ROI_UNPLACED)
        command = _DO_SET_ROI
    elif command == _DO_JUMP:
        p1, p2 = float(_int16(p1)), float(_uint16(p2))
    params = (p1, p2, msg.param3, msg.param4)
    return MissionItem(
        FRAME_MISSION, command, bool(msg.autocontinue & 1), params, _float32(msg.x), _float32(msg.y), msg.z
    )


def _fence_item(item: MissionItem, param1: float) -> MissionItem:
    """What a geofence keeps of an item: place, height and one parameter; not whether the height is relative."""
    if item.frame == FRAME_MISSION:
        first = 0.0 if item.command == _DO_JUMP else param1
        return MissionItem(FRAME_MISSION, item.command, False, (first, 0.0, 0.0, 0.0), 0.0, 0.0, item.alt_m)
    first = item.params[0] if item.command in (_WAYPOINT, _LOITER_TIME, *_FENCE_POLYGONS, *_FENCE_CIRCLES) else 0.0
    if item.command in _FENCE_POLYGONS and first < _LEAST_VERTICES:
        raise ItemRefused(ERROR, f"a fence polygon of {first:g} vertices", silent=True)
    params = (first, 0.0, 0.0, 0.0)
    return MissionItem(_FRAME_GLOBAL, item.command, False, params, item.lat_deg, item.lon_deg, item.alt_m)


def _check_roi(param1: float, allowed: tuple[int, ...]) -> None:
    """Which kinds of region of interest there are depends on the frame."""
    if not math.isfinite(param1) or int(param1) not in allowed:
        raise ItemRefused(INVALID_PARAM1, f"a region of interest of kind {param1:g}")


def _heading(degrees: float) -> float:
    """The same heading from 0 up to 360 deg; NaN, "as it is", stays and so becomes what is infinite."""
    if 0.0 <= degrees < 360.0 or not math.isfinite(degrees):
        return degrees if math.isfinite(degrees) else math.nan
    turned = _float32(math.fmod(degrees, 360.0))
    turned = turned if turned >= 0.0 else _float32(turned + 360.0)
    return turned if turned < 360.0 else 0.0


def _float32(value: float) -> float:
    single: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return single


def _int32(value: float) -> int:
    """Round half away from zero; what does not fit becomes the least number, as a processor converts it."""
    if not _INT32_LEAST <= value <= _INT32_MOST:
        return _INT32_LEAST
    return int(math.copysign(math.floor(abs(value) + 0.5), value))


def _uint16(value: float) -> int:
    return int(value) & 0xFFFF if math.isfinite(value) else 0


def _int16(value: float) -> int:
    return (_uint16(value) ^ 0x8000) - 0x8000
