"""Who the vehicle says it is: the messages that are only sent when asked for.

Message contents follow PX4's src/modules/mavlink/mavlink_main.cpp (send_autopilot_capabilities) and
streams/AVAILABLE_MODES.hpp.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag

from bridge.px4_modes import PX4_MODES, Px4Mode
from bridge.telemetry import Fields, Source
from sitl.modes import EXTERNAL_MODES, Mode


class Capability(IntFlag):
    """MAV_PROTOCOL_CAPABILITY bits; this vehicle has all of these."""

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


CAPABILITIES = Capability(sum(Capability))

# The autopilot whose behaviour is copied, not this package's version: ground stations choose their parameter
# descriptions by it. major << 24 | minor << 16 | patch << 8 | 255 for a release.
PX4_VERSION = 1 << 24 | 17 << 16 | 0 << 8 | 255

_UID = 0x46524F554445_0000  # "FROUDE": no hardware behind it
_PROTOCOL = 200
_UNLISTED = (Mode.DESCEND,)  # ground stations see Land
_NOT_SELECTABLE = 2


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
    """FLIGHT_INFORMATION (264): when it was armed and took off, in microseconds UTC; 0 disarmed, or UTC unknown."""
    autopilot, boot_us = source.vehicle.autopilot, source.utc_boot_us
    armed_us, took_off_us = autopilot.armed_us, autopilot.took_off_us
    return [
        {
            "time_boot_ms": source.time_ms,
            "arming_time_utc": boot_us + armed_us if boot_us and armed_us is not None else 0,
            "takeoff_time_utc": boot_us + took_off_us if boot_us and took_off_us is not None else 0,
        }
    ]


def available_modes(_: Source, index: int) -> list[Fields]:
    """AVAILABLE_MODES (435): index 0 = all of them, from 1 one of them; external modes are places nobody has taken."""
    modes = [PX4_MODES[number] for number in sorted(PX4_MODES) if number not in _UNLISTED]
    return [
        {
            "number_modes": len(modes),
            "mode_index": number,
            "standard_mode": mode.standard_mode,
            "custom_mode": mode.custom_mode,
            "properties": _NOT_SELECTABLE if mode.nav_state in EXTERNAL_MODES else mode.properties,
            "mode_name": _mode_name(mode),
        }
        for number, mode in enumerate(modes, start=1)
        if index in (0, number)
    ]


def _mode_name(mode: Px4Mode) -> str:
    """Standard modes are named by the ground station, in its user's language."""
    if mode.standard_mode:
        return ""
    return "(Mode not available)" if mode.nav_state in EXTERNAL_MODES else mode.name


def component_metadata(source: Source, _: int) -> list[Fields]:
    """COMPONENT_METADATA (397): where the list of metadata files is."""
    if source.metadata is None:
        return []
    crc, uri = source.metadata.general_crc, source.metadata.general_uri
    return [{"time_boot_ms": source.time_ms, "file_crc": crc, "uri": uri}]


def component_information(source: Source, _: int) -> list[Fields]:
    """COMPONENT_INFORMATION (395): the same, as older ground stations ask for it."""
    if source.metadata is None:
        return []
    crc, uri = source.metadata.general_crc, source.metadata.general_uri
    return [{"time_boot_ms": source.time_ms, "general_metadata_file_crc": crc, "general_metadata_uri": uri}]


def storage_information(source: Source, _: int) -> list[Fields]:
    """STORAGE_INFORMATION (261): one place for logs; its size is that of the computer and not told."""
    return [{"time_boot_ms": source.time_ms, "storage_id": 1, "storage_count": 1, "status": 2}]


REQUESTED: dict[int, tuple[str, Callable[[Source, int], list[Fields]]]] = {
    148: ("AUTOPILOT_VERSION", autopilot_version),
    261: ("STORAGE_INFORMATION", storage_information),
    264: ("FLIGHT_INFORMATION", flight_information),
    300: ("PROTOCOL_VERSION", protocol_version),
    395: ("COMPONENT_INFORMATION", component_information),
    397: ("COMPONENT_METADATA", component_metadata),
    435: ("AVAILABLE_MODES", available_modes),
}
"""Name and maker of each message that is only sent on request; the maker takes REQUEST_MESSAGE's param2."""
