"""What the vehicle does by itself when a link that it needs falls silent.

Each cause (ground station, manual control, Offboard's set-points) asks for an action of its own; the severest is
flown. An action on a lost link waits COM_FAIL_ACT_T in Hold first, so that a pilot can take over, and stays until
the user changes the mode or the vehicle is disarmed; one on lost Offboard set-points begins at once and ends when
they are back. Source: PX4 ``commander/failsafe/failsafe.cpp`` and ``framework.cpp``.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from sitl.modes import STICK_MODES, Mode, flown_as
from sitl.parameters import ParameterTable


class Action(IntEnum):
    """What a failsafe asks for, the severer the higher."""

    NONE = 0
    WARN = 1
    FALLBACK_POSCTL = 2
    FALLBACK_ALTCTL = 3
    FALLBACK_STAB = 4
    HOLD = 5
    RTL = 6
    LAND = 7
    DESCEND = 8
    DISARM = 9
    TERMINATE = 10


ACTION_MODE = {
    Action.FALLBACK_POSCTL: Mode.POSCTL,
    Action.FALLBACK_ALTCTL: Mode.ALTCTL,
    Action.FALLBACK_STAB: Mode.STABILIZED,
    Action.HOLD: Mode.LOITER,
    Action.RTL: Mode.RTL,
    Action.LAND: Mode.LAND,
    Action.DESCEND: Mode.DESCEND,
}
"""The mode that an action flies."""

_BY_LINK_LOSS = {
    1: Action.HOLD,
    2: Action.RTL,
    3: Action.LAND,
    5: Action.TERMINATE,
    6: Action.DISARM,
}
"""Values of NAV_DLL_ACT and NAV_RCL_ACT."""

_BY_OFFBOARD_LOSS = {
    0: Action.FALLBACK_POSCTL,
    1: Action.FALLBACK_ALTCTL,
    2: Action.FALLBACK_STAB,
    3: Action.RTL,
    4: Action.LAND,
    5: Action.HOLD,
    6: Action.TERMINATE,
    7: Action.DISARM,
}
"""Values of COM_OBL_RC_ACT."""

STICKS_DISABLED = 4
"""Value of COM_RC_IN_MODE with which nobody misses the sticks."""

_NO_DELAY_S = 0.1
_DELAYED = (Action.RTL, Action.LAND, Action.DESCEND)
_EXCEPT_MISSION, _EXCEPT_HOLD, _EXCEPT_OFFBOARD = 1, 2, 4
_LONGEST_US = 3.6e9
_RECOVERY = 4
"""Delay that a failsafe used up comes back at a quarter of the speed."""


class Links(NamedTuple):
    """What is silent now.

    Attributes:
        gcs_lost: no ground station for COM_DL_LOSS_T. manual_lost: no sticks for COM_RC_LOSS_T.
        offboard_lost: no set-point for COM_OF_LOSS_T.
    """

    gcs_lost: bool
    manual_lost: bool
    offboard_lost: bool


class Choice(NamedTuple):
    """What to fly.

    Attributes:
        action: the action in force. mode: what it flies, or the mode the user chose.
        delayed_s: it waits in Hold for so long, s; 0 once it is in force.
    """

    action: Action
    mode: Mode
    delayed_s: float = 0.0


class Failsafe:
    """Chooses between the user's mode and a failsafe's, for one vehicle.

    Args:
        parameters: NAV_DLL_ACT, NAV_RCL_ACT, COM_OBL_RC_ACT, COM_RCL_EXCEPT, COM_DLL_EXCEPT, COM_FAIL_ACT_T,
            COM_RC_IN_MODE.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self._lasting: dict[str, Action] = {}
        self._was_lost: dict[str, bool] = {}
        self._manual_lost_at_arming = False
        self._used_us = 0
        self._last_us = 0

    def on_arm(self, now_us: int, links: Links) -> None:
        """The vehicle was armed: what is silent already, and not needed for its mode, is no reason to act."""
        self._lasting.clear()
        self._was_lost = {"gcs": links.gcs_lost, "manual": links.manual_lost}
        self._manual_lost_at_arming = links.manual_lost
        self._used_us = 0
        self._last_us = now_us

    def on_mode_change(self) -> None:
        """The user chose a mode: what was begun ends."""
        self._lasting.clear()

    def choose(self, now_us: int, intended: Mode, links: Links) -> Choice:
        """Look once more; call at 100 Hz while armed.

        Args:
            now_us: vehicle time. intended: the mode the user chose. links: what is silent.
        """
        if not links.manual_lost:
            self._manual_lost_at_arming = False
        unwanted = self._manual_lost_at_arming or int(self._parameters.get("COM_RC_IN_MODE")) == STICKS_DISABLED
        ignored = unwanted or self._excepted("COM_RCL_EXCEPT", intended)
        self._watch("manual", links.manual_lost and not ignored, "NAV_RCL_ACT")
        self._watch("gcs", links.gcs_lost and not self._excepted("COM_DLL_EXCEPT", intended), "NAV_DLL_ACT")
        action = max(self._lasting.values(), default=Action.NONE)
        waits_us = self._wait(now_us, action)
        fallback = self._offboard_action(links) if intended is Mode.OFFBOARD and links.offboard_lost else Action.NONE
        if fallback > action or (waits_us and fallback > Action.HOLD):
            return Choice(fallback, ACTION_MODE.get(fallback, intended))
        if waits_us:
            return Choice(Action.HOLD, Mode.LOITER, waits_us * 1e-6)
        return Choice(action, ACTION_MODE.get(action, intended))

    def calm(self, now_us: int, intended: Mode, links: Links) -> bool:
        """Is there nothing to choose, as nearly always? `choose` need not be asked then; this is quicker."""
        if (
            self._lasting
            or self._used_us
            or links.gcs_lost
            or (links.offboard_lost and intended is Mode.OFFBOARD)
            or links.manual_lost is not self._manual_lost_at_arming
            or any(self._was_lost.values())
        ):
            return False
        self._last_us = now_us
        return True

    def _watch(self, cause: str, lost: bool, parameter: str) -> None:
        """An action begins when its cause does; it lasts until the mode changes."""
        if lost and not self._was_lost.get(cause, False):
            action = _BY_LINK_LOSS.get(int(self._parameters.get(parameter)), Action.NONE)
            if action is not Action.NONE:
                self._lasting[cause] = action
        self._was_lost[cause] = lost

    def _wait(self, now_us: int, action: Action) -> int:
        """Return for how long an action still waits in Hold, us."""
        passed_us, self._last_us = now_us - self._last_us, now_us
        whole_us = float(self._parameters.get("COM_FAIL_ACT_T")) * 1e6
        if action not in _DELAYED:
            self._used_us = max(0, self._used_us - passed_us // _RECOVERY)
            return 0
        if not whole_us > _NO_DELAY_S * 1e6 or self._used_us >= whole_us:
            return 0
        self._used_us += passed_us
        return max(0, round(min(_LONGEST_US, whole_us - self._used_us)))

    def _excepted(self, parameter: str, intended: Mode) -> bool:
        bits = int(self._parameters.get(parameter))
        bit = {
            Mode.MISSION: _EXCEPT_MISSION,
            Mode.LOITER: _EXCEPT_HOLD,
            Mode.TAKEOFF: _EXCEPT_HOLD,
            Mode.OFFBOARD: _EXCEPT_OFFBOARD,
        }.get(flown_as(intended), 0)
        return bool(bits & bit)

    def _offboard_action(self, links: Links) -> Action:
        """COM_OBL_RC_ACT; without sticks the modes that need them give way to NAV_RCL_ACT's."""
        action = _BY_OFFBOARD_LOSS.get(int(self._parameters.get("COM_OBL_RC_ACT")), Action.RTL)
        if links.manual_lost and ACTION_MODE.get(action) in STICK_MODES:
            return _BY_LINK_LOSS.get(int(self._parameters.get("NAV_RCL_ACT")), Action.RTL)
        return action
