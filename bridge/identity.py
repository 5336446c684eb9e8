"""Who the vehicle says it is: the messages that are only sent when asked for.

Message contents follow PX4's src/modules/mavlink/mavlink_main.cpp (send_autopilot_capabilities) and
streams/AVAILABLE_MODES.hpp.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag

from bridge.px4_modes import PX4_MODES
from bridge.telemetry import Fields, Source
from sitl.modes import AVAILABLE


class Capability(IntFlag):
    """MAV_PROTOCOL_CAPABILITY bits; those this vehicle really has are in CAPABILITIES."""

    MISSION_FLOAT = 1
    PARAM_FLOAT = 2
    MISSION_INT = 4
    COMMAND_INT = 8
    PARAM_ENCODE_BYTEWISE = 16
    FTP = 32
    SET_ATTITUDE_TARGET = 64
    SET_POSITION_TARGET_LOCAL_NED = 128
    FLIGHT_TERMINATION = 2048
    MAVLINK2 = 8192
    MISSION_FENCE = 16384
    MISSION_RALLY = 32768


CAPABILITIES = (
    Capability.PARAM_FLOAT
    | Capability.COMMAND_INT
    | Capability.PARAM_ENCODE_BYTEWISE
    | Capability.SET_ATTITUDE_TARGET
    | Capability.FLIGHT_TERMINATION
    | Capability.MAVLINK2
)

# The autopilot whose behaviour is copied, not this package's version: ground stations choose their parameter
# descriptions by it. major << 24 | minor << 16 | patch << 8 | 255 for a release.
PX4_VERSION = 1 << 24 | 17 << 16 | 0 << 8 | 255

_UID = 0x46524F554445_0000  # "FROUDE": no hardware behind it
_PROTOCOL = 200


def autopilot_version(source: Source, _: int) -> list[Fields]:
    """AUTOPILOT_VERSION (148): capabilities, versions, an identity of its own for each system id."""
    return [
        {
            "capabilities": int(CAPABILITIES),
            "flight_sw_version": PX4_VERSION,
            "middleware_sw_version": PX4_VERSION,
            "board_version": 1,
            "uid": _UID + source.sysid - 1,
            "uid2": [source.sysid - 1, *b"froude", *[0] * 11],
        }
    ]


def protocol_version(_source: Source, _: int) -> list[Fields]:
    """PROTOCOL_VERSION (300): MAVLink 2."""
    return [{"version": _PROTOCOL, "min_version": 100, "max_version": 203}]


def flight_information(source: Source, _: int) -> list[Fields]:
    """FLIGHT_INFORMATION (264): UTC times of arming and take-off are not kept."""
    return [{"time_boot_ms": source.time_ms}]


def available_modes(_: Source, index: int) -> list[Fields]:
    """AVAILABLE_MODES (435): the modes this vehicle flies; index 0 = all of them, from 1 one of them."""
    modes = [PX4_MODES[mode.value] for mode in AVAILABLE]
    return [
        {
            "number_modes": len(modes),
            "mode_index": number,
            "standard_mode": mode.standard_mode,
            "custom_mode": mode.custom_mode,
            "properties": mode.properties,
            # Standard modes are named by the ground station, in its user's language.
            "mode_name": "" if mode.standard_mode else mode.name,
        }
        for number, mode in enumerate(modes, start=1)
        if index in (0, number)
    ]


REQUESTED: dict[int, tuple[str, Callable[[Source, int], list[Fields]]]] = {
    148: ("AUTOPILOT_VERSION", autopilot_version),
    264: ("FLIGHT_INFORMATION", flight_information),
    300: ("PROTOCOL_VERSION", protocol_version),
    435: ("AVAILABLE_MODES", available_modes),
}
"""Name and maker of each message that is only sent on request; the maker takes REQUEST_MESSAGE's param2."""
