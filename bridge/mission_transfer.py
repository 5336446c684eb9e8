"""Transfer: what one link is at in the mission protocol, and what it says in it.

Source: MAVLink mission service; PX4 src/modules/mavlink/mavlink_mission.h.
"""

from __future__ import annotations

from enum import Enum
from typing import Any, Final, TypeAlias

from bridge.plan_store import EMPTY, Plan
from sitl.plan import MissionItem

Outgoing: TypeAlias = tuple[str, dict[str, Any]]
"""A message to be encoded: its name and its fields."""


NOBODY: Final = (0, 0)
"""Partner of a link that had no transfer yet."""


class State(Enum):
    """Which way items travel."""

    IDLE = "idle"
    SENDING = "sending"
    """A download."""
    GETTING = "getting"
    """An upload."""


class Transfer:
    """The transfer a link is at, or was at last: PX4 remembers its partner, its kind and its last item.

    Attributes:
        state: which way items travel.
        kind: MAV_MISSION_TYPE, of which there are more than plans.
        partner: system and component on the ground.
        integers: items travel as MISSION_ITEM_INT, not as MISSION_ITEM.
        seq: the next item, from 0.
        count: items of the plan.
        plan: what is downloaded, as it was when the download began.
        items: what was uploaded so far.
        first: item of an uploaded mission to begin with.
        crc: of the items uploaded so far.
        completed: it was an upload, and every item was taken.
        heard_us: when the partner was heard last, us.
        sent_us: when something was last sent that wants an answer, us.
    """

    __slots__ = (
        "completed",
        "count",
        "crc",
        "first",
        "heard_us",
        "integers",
        "items",
        "kind",
        "partner",
        "plan",
        "sent_us",
        "seq",
        "state",
    )

    def __init__(self) -> None:
        self.integers = True
        self.begin(State.IDLE, 0, NOBODY, 0)

    def begin(self, state: State, kind: int, partner: tuple[int, int], now_us: int) -> None:
        """Start over; only the form items travel in is remembered."""
        self.state = state
        self.kind = kind
        self.partner = partner
        self.seq = self.count = self.first = self.crc = 0
        self.plan: Plan = EMPTY
        self.items: list[MissionItem] = []
        self.completed = False
        self.heard_us = self.sent_us = now_us

    def end(self) -> None:
        """Nothing is under way any more; items that came without the rest are dropped."""
        self.state = State.IDLE
        self.plan = EMPTY
        self.items = []

    def ask(self, now_us: int) -> Outgoing:
        """Return the request of the next item of an upload."""
        self.sent_us = now_us
        name = "MISSION_REQUEST_INT" if self.integers else "MISSION_REQUEST"
        return name, {**target(self.partner), "seq": self.seq, "mission_type": self.kind}

    def announce(self, now_us: int) -> Outgoing:
        """Return the MISSION_COUNT a download begins with."""
        self.sent_us = now_us
        known = {"count": self.count, "mission_type": self.kind, "opaque_id": self.plan.opaque_id}
        return "MISSION_COUNT", {**target(self.partner), **known}


def target(partner: tuple[int, int]) -> dict[str, int]:
    """Return the fields that say for whom a message is."""
    return {"target_system": partner[0], "target_component": partner[1]}


def acknowledge(kind: int, partner: tuple[int, int], result: int, opaque_id: int = 0) -> Outgoing:
    """Return a MISSION_ACK.

    Args:
        kind: MAV_MISSION_TYPE.
        partner: for whom.
        result: MAV_MISSION_RESULT.
        opaque_id: CRC of the plan that was taken.
    """
    return "MISSION_ACK", {**target(partner), "type": result, "mission_type": kind, "opaque_id": opaque_id}
