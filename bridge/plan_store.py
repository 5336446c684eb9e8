"""PlanStore: the mission, the geofence and the rally points that ground stations left with the vehicle.

A plan changes as a whole or not at all: it is put here when its last item has come and passed every check.
Source: MAVLink mission service; limits of PX4 SITL (boards/px4/sitl, src/modules/dataman/dataman.h).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from sitl.plan import MissionItem


class PlanKind(IntEnum):
    """The plans that are kept; the value is MAVLink's MAV_MISSION_TYPE."""

    MISSION = 0
    FENCE = 1
    RALLY = 2


ALL_PLANS: Final = 255
"""MAV_MISSION_TYPE_ALL."""

MOST_ITEMS: Final = {PlanKind.MISSION: 10_000, PlanKind.FENCE: 64, PlanKind.RALLY: 32}
"""Items that fit into each plan."""


@dataclass(frozen=True)
class Plan:
    """A complete plan.

    Attributes:
        items: what was uploaded, as it is given back.
        opaque_id: CRC of the upload, 0 for an empty plan; ground stations compare it with the one they know.
    """

    items: tuple[MissionItem, ...] = ()
    opaque_id: int = 0


EMPTY: Final = Plan()


class PlanStore:
    """Three plans and which item of the mission is next.

    Args:
        on_mission: told the items and the opaque id of each new mission; an empty one has neither.
        on_current: told which item the mission is to go on with; its answer is whether it does.

    Attributes:
        current: the item of the mission that is flown or comes next, from 0.
    """

    def __init__(
        self,
        on_mission: Callable[[tuple[MissionItem, ...], int], None] | None = None,
        on_current: Callable[[int], bool] | None = None,
    ) -> None:
        self.current = 0
        self._on_mission = on_mission
        self._on_current = on_current
        self._plans: dict[PlanKind, Plan] = dict.fromkeys(PlanKind, EMPTY)

    @property
    def mission(self) -> Plan:
        """The mission."""
        return self._plans[PlanKind.MISSION]

    def plan(self, mission_type: int) -> Plan:
        """Return the plan of a MAV_MISSION_TYPE; of one that is not kept, an empty one."""
        kind = plan_kind(mission_type)
        return EMPTY if kind is None else self._plans[kind]

    def put(self, kind: PlanKind, items: Sequence[MissionItem], opaque_id: int, first: int = 0) -> None:
        """Keep a complete plan in place of the old one.

        The same mission once more changes nothing: it goes on where it is, as on a PX4.

        Args:
            kind: which plan.
            items: all of them, at most as many as fit; the caller has checked that.
            opaque_id: CRC of the upload.
            first: item of a mission to begin with.
        """
        plan = Plan(tuple(items), opaque_id)
        old = self._plans[kind]
        # repr, because two NaN are not equal and most items have one
        if plan.opaque_id == old.opaque_id and repr(plan.items) == repr(old.items):
            return
        self._plans[kind] = plan
        if kind is PlanKind.MISSION:
            self._new_mission(plan, first)

    def clear(self, mission_type: int) -> None:
        """Empty the plan of a MAV_MISSION_TYPE, or all of them; a type that is not kept changes nothing."""
        kind = plan_kind(mission_type)
        kinds = tuple(PlanKind) if mission_type == ALL_PLANS else () if kind is None else (kind,)
        for one in kinds:
            self._plans[one] = EMPTY
            if one is PlanKind.MISSION:
                self._new_mission(EMPTY, 0)

    def set_current(self, seq: int) -> bool:
        """Go on with an item of the mission; False where there is no such item or the vehicle does not follow."""
        if not 0 <= seq < len(self.mission.items):
            return False
        if self._on_current is not None and not self._on_current(seq):
            return False
        self.current = seq
        return True

    def _new_mission(self, plan: Plan, first: int) -> None:
        self.current = 0
        if self._on_mission is not None:
            self._on_mission(plan.items, plan.opaque_id)
        if first:
            self.set_current(first)


def plan_kind(mission_type: int) -> PlanKind | None:
    """Return which plan a MAV_MISSION_TYPE means, None for one that is not kept."""
    return PlanKind(mission_type) if 0 <= mission_type < len(PlanKind) else None
