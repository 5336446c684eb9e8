"""Words the vehicle and its callers share: modes, results, landed states, texts."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Mode(IntEnum):
    """Flight modes; the value is PX4's nav_state."""

    MANUAL = 0
    ALTCTL = 1
    POSCTL = 2
    MISSION = 3
    LOITER = 4
    RTL = 5
    ACRO = 10
    DESCEND = 12
    TERMINATION = 13
    OFFBOARD = 14
    STABILIZED = 15
    TAKEOFF = 17
    LAND = 18


MODE_NAMES = {
    Mode.MANUAL: "Manual",
    Mode.ALTCTL: "Altitude",
    Mode.POSCTL: "Position",
    Mode.MISSION: "Mission",
    Mode.LOITER: "Hold",
    Mode.RTL: "Return",
    Mode.ACRO: "Acro",
    Mode.DESCEND: "Descend",
    Mode.TERMINATION: "Termination",
    Mode.OFFBOARD: "Offboard",
    Mode.STABILIZED: "Stabilized",
    Mode.TAKEOFF: "Takeoff",
    Mode.LAND: "Land",
}

AVAILABLE = (Mode.LOITER, Mode.TAKEOFF, Mode.LAND, Mode.OFFBOARD)
"""Modes a caller may choose on this vehicle."""

POSITION_MODES = frozenset({Mode.LOITER, Mode.TAKEOFF, Mode.LAND, Mode.DESCEND})
"""Modes that the position controller flies."""

NEVER_ARM = frozenset({Mode.RTL, Mode.LAND, Mode.DESCEND, Mode.TERMINATION})
"""Modes in which PX4 refuses to arm."""


class Result(IntEnum):
    """Answer to a command; the value is MAVLink's MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class LandedState(IntEnum):
    """Where the vehicle is; the value is MAVLink's MAV_LANDED_STATE."""

    UNDEFINED = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class Severity(IntEnum):
    """How serious a text is; the value is MAVLink's MAV_SEVERITY."""

    EMERGENCY = 0
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


@dataclass(frozen=True)
class Text:
    """A line for people on the ground."""

    severity: Severity
    text: str


@dataclass(frozen=True)
class Home:
    """Where Return goes and heights are counted from.

    Attributes:
        lat_deg: latitude, deg. lon_deg: longitude, deg. alt_m: height above mean sea level, m.
        position_ned: (3,) from the origin of the local frame, m.
        quat: attitude when it was set.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float
    position_ned: tuple[float, float, float]
    quat: tuple[float, float, float, float]
