"""Reports of how far a mission is: MISSION_CURRENT once a second, MISSION_ITEM_REACHED when an item is done.

PX4 sends them from its mission service and not as streams: no message interval changes them and none can be
requested. Source: PX4 src/modules/mavlink/mavlink_mission.cpp, send and update_mission_state.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, Final, NamedTuple

from bridge.plan_store import PlanKind, PlanStore

PERIOD_US: Final = 1_000_000
"""Time between two MISSION_CURRENT on one link, us."""

REPEATS: Final = 10
"""How often MISSION_ITEM_REACHED is sent again, once a second."""

_NO_TOTAL = 65535
_MODE_ACTIVE, _MODE_SUSPENDED = 1, 2
_MODE_OF = {True: _MODE_ACTIVE, False: _MODE_SUSPENDED}


class MissionState(IntEnum):
    """MISSION_CURRENT.mission_state (MISSION_STATE)."""

    NO_MISSION = 1
    NOT_STARTED = 2
    ACTIVE = 3
    PAUSED = 4
    COMPLETE = 5


class MissionProgress(NamedTuple):
    """How far the mission is.

    Attributes:
        current: item that is flown or comes next, from 0.
        reached: last item that was reached, -1 before the first.
        finished: the last item is done.
        flying: the mode is Mission, Takeoff or Land.
    """

    current: int
    reached: int
    finished: bool
    flying: bool


class _LinkState:
    """What one link was told last."""

    __slots__ = ("current", "due_us", "reached", "repeats")

    def __init__(self, now_us: int) -> None:
        self.current = -1
        self.reached = -1
        self.repeats = 0
        self.due_us = now_us


class ProgressReports:
    """Tells each link how far the mission of a store is.

    Args:
        store: the plans; its `current` follows the progress.
        progress: how far the mission is now.
    """

    def __init__(self, store: PlanStore, progress: Callable[[], MissionProgress]) -> None:
        self._store = store
        self._progress = progress
        self._links: dict[int, _LinkState] = {}

    def poll(self, link_id: int, now_us: int) -> list[tuple[str, dict[str, Any]]]:
        """Reports due now on a link.

        Args:
            link_id: the link.
            now_us: vehicle time, us.
        """
        link = self._links.get(link_id)
        if link is None:
            link = self._links[link_id] = _LinkState(now_us)
        now = self._progress()
        self._store.current = max(now.current, 0)
        if now_us < link.due_us and now.current == link.current and now.reached == link.reached:
            return []
        total = len(self._store.mission.items)
        out: list[tuple[str, dict[str, Any]]] = []
        slow = now_us >= link.due_us
        if slow:
            link.due_us = max(link.due_us + PERIOD_US, now_us + PERIOD_US // 2)
        if slow or (now.current != link.current and total):
            out.append(("MISSION_CURRENT", self._current(now, total)))
        link.current = now.current
        if now.reached != link.reached:
            link.reached = now.reached
            link.repeats = REPEATS + 1
        elif not slow:
            return out
        if total and now.reached >= 0 and link.repeats:
            link.repeats -= 1
            out.append(("MISSION_ITEM_REACHED", {"seq": now.reached}))
        return out

    def forget(self, link_id: int) -> None:
        """Forget what a link was told."""
        self._links.pop(link_id, None)

    def _current(self, now: MissionProgress, total: int) -> dict[str, Any]:
        if not total:
            state = MissionState.NO_MISSION
        elif now.finished:
            state = MissionState.COMPLETE
        elif now.flying:
            state = MissionState.ACTIVE
        elif now.reached >= 0:
            state = MissionState.PAUSED
        else:
            state = MissionState.NOT_STARTED
        store = self._store
        return {
            "seq": max(now.current, 0),
            "total": total or _NO_TOTAL,
            "mission_state": int(state),
            "mission_mode": _MODE_OF[now.flying],
            "mission_id": store.mission.opaque_id,
            "fence_id": store.plan(PlanKind.FENCE).opaque_id,
            "rally_points_id": store.plan(PlanKind.RALLY).opaque_id,
        }
