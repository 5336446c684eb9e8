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
    POSITION_SLOW = 6
    ALTITUDE_CRUISE = 8
    ACRO = 10
    DESCEND = 12
    TERMINATION = 13
    OFFBOARD = 14
    STABILIZED = 15
    TAKEOFF = 17
    LAND = 18
    FOLLOW_TARGET = 19
    PRECLAND = 20
    ORBIT = 21
    VTOL_TAKEOFF = 22
    EXTERNAL1 = 23
    EXTERNAL2 = 24
    EXTERNAL3 = 25
    EXTERNAL4 = 26
    EXTERNAL5 = 27
    EXTERNAL6 = 28
    EXTERNAL7 = 29
    EXTERNAL8 = 30


EXTERNAL_MODES = tuple(Mode(number) for number in range(Mode.EXTERNAL1, Mode.EXTERNAL8 + 1))
"""Modes that a companion computer would bring; this vehicle has none."""

MODE_NAMES = {
    Mode.MANUAL: "Manual",
    Mode.ALTCTL: "Altitude",
    Mode.POSCTL: "Position",
    Mode.MISSION: "Mission",
    Mode.LOITER: "Hold",
    Mode.RTL: "Return",
    Mode.POSITION_SLOW: "Position Slow",
    Mode.ALTITUDE_CRUISE: "Altitude Cruise",
    Mode.ACRO: "Acro",
    Mode.DESCEND: "Descend",
    Mode.TERMINATION: "Termination",
    Mode.OFFBOARD: "Offboard",
    Mode.STABILIZED: "Stabilized",
    Mode.TAKEOFF: "Takeoff",
    Mode.LAND: "Land",
    Mode.FOLLOW_TARGET: "Follow Target",
    Mode.PRECLAND: "Precision Landing",
    Mode.ORBIT: "Orbit",
    Mode.VTOL_TAKEOFF: "VTOL Takeoff",
    **{mode: f"External {number}" for number, mode in enumerate(EXTERNAL_MODES, start=1)},
}

FLOWN_AS = {
    Mode.POSITION_SLOW: Mode.POSCTL,
    Mode.ALTITUDE_CRUISE: Mode.ALTCTL,
    Mode.FOLLOW_TARGET: Mode.LOITER,
    Mode.PRECLAND: Mode.LAND,
    Mode.VTOL_TAKEOFF: Mode.TAKEOFF,
    Mode.ORBIT: Mode.LOITER,
}
"""Modes that fly another's law: without a target to follow or to land on PX4 holds or lands here as well, and an orbit
is a place that Hold goes round."""

STICK_MODES = frozenset(
    {
        Mode.MANUAL,
        Mode.STABILIZED,
        Mode.ACRO,
        Mode.ALTCTL,
        Mode.ALTITUDE_CRUISE,
        Mode.POSCTL,
        Mode.POSITION_SLOW,
    }
)
"""Modes that a pilot's sticks fly."""

CLIMB_MODES = STICK_MODES - {Mode.MANUAL, Mode.STABILIZED, Mode.ACRO}
"""Those of them in which the throttle stick asks for a climb rate."""

NEVER_ARM = frozenset(
    {
        Mode.RTL,
        Mode.LAND,
        Mode.DESCEND,
        Mode.TERMINATION,
        Mode.FOLLOW_TARGET,
        Mode.PRECLAND,
        Mode.ORBIT,
    }
)
"""Modes in which PX4 refuses to arm."""


def flown_as(mode: Mode) -> Mode:
    """The mode whose law flies a mode."""
    return FLOWN_AS.get(mode, mode)


class Result(IntEnum):
    """Answer to a command; the value is MAVLink's MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5
    CANCELLED = 6


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
