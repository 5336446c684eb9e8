"""The events this vehicle can report: what each says, its number, and the JSON that tells ground stations.

PX4 says important things twice: as a text that ends with a TAB, and as an event (MAVLink events service), which a
ground station translates with the vehicle's own list. Here the text comes first: a template finds the event that
says the same and the numbers in it.
"""

from __future__ import annotations

import json
import math
import re
import struct
from dataclasses import dataclass
from functools import cache

from sitl.modes import MODE_NAMES

_COMPONENT = 1
_FNV_START, _FNV_PRIME = 0x811C9DC5, 0x01000193
_ARGUMENT_BYTES = 40
_LARGEST_FLOAT32 = 3.4028234663852886e38
_HOLE = re.compile(r"\{(\d)\}")
_NUMBER = r"([-+]?\d+(?:\.\d*)?|[-+]?nan|[-+]?inf)"

_SAID: dict[str, str] = {
    "armed": "Armed by external command",
    "disarmed": "Disarmed by external command",
    "disarmed_landing": "Disarmed by landing",
    "disarmed_preflight": "Disarmed by auto preflight disarming",
    "disarmed_failsafe": "Disarmed by failsafe",
    "takeoff_detected": "Takeoff detected",
    "landing_detected": "Landing detected",
    "landing_here": "Landing at current position",
    "landing_precisely": "Precision landing",
    "returning": "Returning to launch",
    "takeoff_default": "Using default takeoff altitude: {1} m",
    "arming_denied_health": "Arming denied: Resolve system health failures first",
    "arming_denied_throttle": "Arming denied: throttle not in safe position",
    "arming_denied_center": "Arming denied: throttle above center",
    "disarming_denied": "Disarming denied: not landed",
    "arm_param": "Unsupported ARM_DISARM param: {1}",
    "main_mode": "Unsupported main mode",
    "auto_mode": "Unsupported auto mode",
    "base_mode": "Unsupported base mode",
    "failsafe": "Failsafe activated",
    "failsafe_hold": "Failsafe activated: entering Hold for {1} seconds",
    "gcs_lost": "Connection to ground station lost",
    "gcs_regained": "GCS connection regained",
    "sticks": "Pilot took over using sticks",
    "tilt": "Attitude failure detected",
    "rtl_height": "RTL: start return at {1} m ({2} m above destination)",
    "rtl_land": "RTL: land at destination",
    "mission_none": "Mission start denied! No valid mission",
    "mission_denied": "Mission start denied",
    "takeoff_lower": "Already higher than takeoff altitude",
    "rtl_loiter": "RTL: completed, loitering",
    "mission_begun": "Executing Mission",
    "mission_landed": "Mission finished, landed",
    "mission_loitering": "Mission finished, loitering",
    "mission_no_valid_landed": "No valid mission available, refusing takeoff",
    "mission_no_valid_flying": "No valid mission available, loitering",
    "mission_takeoff": "Takeoff to {1} meters above home",
    "mission_item_unset": "Mission item could not be set.",
    "mission_timeout": "Mission sync timeout",
    "mission_busy": "WPM: REJ. CMD: Busy",
    "mission_unexpected": "WPM: REJ. CMD: Req. WP was unexpected",
    "mission_partner": "WPM: REJ. CMD: partner id mismatch",
    "mission_item_partner": "REJ. MIS ITEM: partner id mismatch",
    "mission_command_partner": "REJ. WP CMD: partner id mismatch",
    "mission_active": "Mission download request ignored, already active",
    "mission_count_busy": "WPM: IGN MISSION_COUNT: Busy",
    "mission_item_invalid": "IGN MISSION_ITEM: Invalid item",
    "mission_item_none": "IGN MISSION_ITEM: No transfer",
    "mission_item_busy": "IGN MISSION_ITEM: Busy",
    "mission_clear_busy": "WPM: IGN CLEAR CMD: Busy",
    "mission_current_busy": "WPM: IGN WP CURR CMD: Busy",
    "mission_current_none": "WPM: WP CURR CMD: Not in list",
    "mission_current_failed": "WPM: WP CURR CMD: Error setting ID",
    "local_invalid": "SET_POSITION_TARGET_LOCAL_NED invalid",
    "local_frame": "SET_POSITION_TARGET_LOCAL_NED coordinate frame {1} unsupported",
    "global_invalid": "SET_POSITION_TARGET_GLOBAL_INT invalid",
    "global_frame": "SET_POSITION_TARGET_GLOBAL_INT coordinate frame {1} unsupported",
    "limit_land_tilt": "Land tilt has been constrained by max tilt",
    "limit_cruise": "Cruise speed has been constrained by max speed",
    "limit_manual": "Manual speed has been constrained by max speed",
    "limit_back": "Manual backward speed has been constrained by forward speed",
    "limit_side": "Manual sideways speed has been constrained by forward speed",
    "limit_up": "Ascent speed has been constrained by max speed",
    "limit_down": "Descent speed has been constrained by max speed",
    "limit_tilt": "Tilt constrained to safe value",
    "limit_hover": "Hover thrust has been constrained by min/max",
    "starting": "Sensors and estimator are starting",
    "high_latency": "Control high latency failed! Telemetry unavailable",
    **{
        f"mode_{mode.name.lower()}": f"Switching to {name} is currently not available"
        for mode, name in MODE_NAMES.items()
    },
}


@dataclass(frozen=True)
class Event:
    """One thing the vehicle can say.

    Attributes:
        name: PX4's way of naming events. message: with {1}, {2} where its numbers go. number: its EVENT.id.
    """

    name: str
    message: str
    number: int

    @property
    def holes(self) -> int:
        """How many numbers it carries."""
        return len(_HOLE.findall(self.message))


def find_event(text: str) -> tuple[Event, bytes] | None:
    """Return the event that says the same as a text, and its arguments (float32, little-endian), or None."""
    for event, pattern in _events():
        found = pattern.fullmatch(text)
        if found:
            return event, b"".join(_float32(part) for part in found.groups())[:_ARGUMENT_BYTES]
    return None


def events_json() -> bytes:
    """Return the list as ground stations fetch it (component metadata type 4)."""
    events = {
        str(event.number & 0xFFFFFF): {
            "name": event.name,
            "message": event.message,
            "arguments": [{"type": "float", "name": f"value{k + 1}"} for k in range(event.holes)],
        }
        for event, _ in _events()
    }
    tree = {
        "version": 1,
        "components": {str(_COMPONENT): {"namespace": "px4", "event_groups": {"default": {"events": events}}}},
    }
    return json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()


def _float32(text: str) -> bytes:
    value = float(text)
    return struct.pack("<f", math.copysign(math.inf, value) if abs(value) > _LARGEST_FLOAT32 else value)


@cache
def _events() -> tuple[tuple[Event, re.Pattern[str]], ...]:
    found = []
    for key, message in _SAID.items():
        name = f"froude_{key}"
        pattern = _NUMBER.join(re.escape(part) for part in _HOLE.split(message)[::2])
        found.append((Event(name, message, _COMPONENT << 24 | _hash(name) & 0xFFFFFF), re.compile(pattern)))
    return tuple(found)


def _hash(name: str) -> int:
    """FNV-1a, as PX4 numbers its events."""
    value = _FNV_START
    for byte in name.encode():
        value = (value ^ byte) * _FNV_PRIME & 0xFFFFFFFF
    return value
