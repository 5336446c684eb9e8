"""PX4's flight modes on the wire: custom_mode numbers, HEARTBEAT flags, names.

A mode inside PX4 is a `nav_state`; on the wire it is `custom_mode = main << 16 | sub << 24`
(PX4 src/modules/commander/px4_custom_mode.h, src/lib/modes/ui.hpp, standard_modes.hpp).
"""

from __future__ import annotations

from dataclasses import dataclass

CUSTOM = 1
AUTO = 4
GUIDED = 8
STABILIZE = 16
HIL = 32
MANUAL = 64
ARMED = 128
"""MAV_MODE_FLAG bits of HEARTBEAT.base_mode."""

MAIN_AUTO = 4
MAIN_POSITION = 3
_SUB_POSITION_SLOW = 2
_SUB_AUTO_MISSION = 4

_BY_STICKS = CUSTOM | MANUAL | STABILIZE
_BY_ITSELF = CUSTOM | AUTO | GUIDED | STABILIZE
_BY_SETPOINTS = CUSTOM | STABILIZE

ADVANCED = 1
"""MAV_MODE_PROPERTY bit of AVAILABLE_MODES: shown to those who ask for more than the standard modes."""


@dataclass(frozen=True)
class Px4Mode:
    """One flight mode as ground stations know it.

    Attributes:
        nav_state: PX4's internal number; the value of `sitl.modes.Mode`.
        main, sub: the two numbers of DO_SET_MODE.
        name: how PX4's texts call it.
        base_mode: HEARTBEAT flags without ARMED.
        standard_mode: MAV_STANDARD_MODE, 0 if it is none of them; only then is its name sent.
        properties: MAV_MODE_PROPERTY bits.
    """

    nav_state: int
    main: int
    sub: int
    name: str
    base_mode: int
    standard_mode: int = 0
    properties: int = ADVANCED

    @property
    def custom_mode(self) -> int:
        """The number in HEARTBEAT, CURRENT_MODE and AVAILABLE_MODES."""
        return self.main << 16 | self.sub << 24


PX4_MODES: dict[int, Px4Mode] = {
    mode.nav_state: mode
    for mode in (
        Px4Mode(0, 1, 0, "Manual", _BY_STICKS),
        Px4Mode(1, 2, 0, "Altitude", _BY_STICKS, 4, 0),
        Px4Mode(2, MAIN_POSITION, 0, "Position", _BY_STICKS, 1, 0),
        Px4Mode(3, MAIN_AUTO, _SUB_AUTO_MISSION, "Mission", _BY_ITSELF, 6),
        Px4Mode(4, MAIN_AUTO, 3, "Hold", _BY_ITSELF),
        Px4Mode(5, MAIN_AUTO, 5, "Return", _BY_ITSELF, 5),
        Px4Mode(6, MAIN_POSITION, _SUB_POSITION_SLOW, "Position Slow", _BY_STICKS),
        Px4Mode(8, 11, 0, "Altitude Cruise", _BY_STICKS),
        Px4Mode(10, 5, 0, "Acro", CUSTOM | MANUAL),
        Px4Mode(13, 10, 0, "Termination", CUSTOM, 0, 3),
        Px4Mode(14, 6, 0, "Offboard", _BY_SETPOINTS),
        Px4Mode(15, 7, 0, "Stabilized", _BY_STICKS),
        Px4Mode(17, MAIN_AUTO, 2, "Takeoff", _BY_ITSELF, 8),
        Px4Mode(18, MAIN_AUTO, 6, "Land", _BY_ITSELF, 7),
        Px4Mode(19, MAIN_AUTO, 8, "Follow Target", _BY_SETPOINTS),
        Px4Mode(20, MAIN_AUTO, 9, "Precision Landing", _BY_ITSELF),
        Px4Mode(21, MAIN_POSITION, 1, "Orbit", _BY_SETPOINTS, 2),
        Px4Mode(22, MAIN_AUTO, 10, "VTOL Takeoff", _BY_ITSELF),
        *(Px4Mode(23 + i, MAIN_AUTO, 11 + i, f"External {i + 1}", _BY_SETPOINTS) for i in range(8)),
        # Descend has no number of its own: ground stations see Land, which therefore comes first here.
        Px4Mode(12, MAIN_AUTO, 6, "Descend", _BY_ITSELF, 7),
    )
}
"""Every mode a PX4 multicopter knows, by nav_state."""

OFFBOARD = 14

_ASKED: dict[tuple[int, int], int] = {
    (mode.main, mode.sub): mode.nav_state
    for mode in PX4_MODES.values()
    # Descend, Termination, Orbit and VTOL Takeoff cannot be asked for with DO_SET_MODE.
    if mode.nav_state not in (12, 13, 21, 22)
}
_MAINS = {main for main, _ in _ASKED}


class UnknownModeError(ValueError):
    """A mode number that PX4 does not know either; the text is PX4's."""


def asked_mode(base_mode: int, main: int, sub: int) -> Px4Mode:
    """Return the mode that DO_SET_MODE's three numbers ask PX4 for.

    Without the custom flag the old MAVLink flags choose; an unknown sub-mode of Position is Position, Auto
    without a sub-mode is Mission (PX4 src/modules/commander/Commander.cpp, VEHICLE_CMD_DO_SET_MODE).

    Raises:
        UnknownModeError: PX4 knows no such mode either.
    """
    if not base_mode & CUSTOM:
        return PX4_MODES[_plain_mode(base_mode)]
    if main not in _MAINS:
        raise UnknownModeError("Unsupported main mode")
    if main == MAIN_AUTO:
        nav_state = _ASKED.get((main, sub or _SUB_AUTO_MISSION))
        if nav_state is None:
            raise UnknownModeError("Unsupported auto mode")
        return PX4_MODES[nav_state]
    if main == MAIN_POSITION and sub == _SUB_POSITION_SLOW:
        return PX4_MODES[6]
    return PX4_MODES[_ASKED[(main, 0)]]


def split_custom_mode(custom_mode: int) -> tuple[int, int]:
    """Return (main, sub) of a custom_mode number."""
    return custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF


def _plain_mode(base_mode: int) -> int:
    """Return the nav_state for MAVLink's own mode flags."""
    if base_mode & AUTO:
        return 3
    if base_mode & MANUAL:
        if base_mode & GUIDED:
            return 2
        return 15 if base_mode & STABILIZE else 0
    raise UnknownModeError("Unsupported base mode")
