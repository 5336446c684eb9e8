"""MissionServer: the vehicle's side of MAVLink's mission protocol, as PX4 speaks it.

It takes and gives back the plans of a PlanStore:

- Upload: each item is asked for, again every 250 ms, for 5 s; a plan changes only when its last item is in.
- Download: MISSION_COUNT is repeated every 250 ms until the first item is asked for; until the ground closes the
  list with a MISSION_ACK, or for 5 s, the link is busy and refuses everything else.
- Whether items travel as integers or floats is what the ground used last.
- One transfer per link and one upload at a time on all of them.

Messages in, messages out: no socket, no clock. Sources: PX4 src/modules/mavlink/mavlink_mission.cpp, MAVLink's
mission microservice, answers recorded from a PX4 SITL of May 2026. Where PX4 may keep part of a plan, lock up or
confirm what it did not take, this does not: `_repeated_count`, `_uninvited` and `_list` say how.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from bridge.messages import Message
from bridge.mission_items import ItemRefused, fields_of, item_crc, item_from
from bridge.mission_progress import MissionProgress, ProgressReports
from bridge.mission_transfer import NOBODY, Outgoing, State, Transfer, acknowledge, target
from bridge.plan_store import MOST_ITEMS, PlanKind, PlanStore, plan_kind
from sitl.modes import Severity

RETRY_US: Final = 250_000
"""An unanswered MISSION_COUNT or request of an item is sent again after this time, us."""

TIMEOUT_US: Final = 5_000_000
"""A transfer ends when its partner was silent for so long, us."""

ACCEPTED, ERROR, UNSUPPORTED, NO_SPACE, CANCELLED = 0, 1, 3, 4, 15
"""MAV_MISSION_RESULT."""

_MISSION_PLANNER = 190  # MAV_COMP_ID_MISSIONPLANNER: PX4's mission service answers to it too
_TIMED_OUT = "Mission sync timeout\t"
_BUSY = "WPM: REJ. CMD: Busy\t"
_UNEXPECTED = "WPM: REJ. CMD: Req. WP was unexpected\t"
_FENCE_ONLY_KEPT = "Geofence stored, not enforced by this vehicle"


class MissionServer:
    """Serves one PlanStore to any number of links.

    Args:
        store: the vehicle's plans.
        system_id: own system.
        component_id: own component; messages to it, to component 0 or to 190 are answered.
        say: tells everybody a text.
        progress: how far the mission is. With it MISSION_CURRENT and MISSION_ITEM_REACHED are sent.

    Attributes:
        refused: messages for us that made no sense or came at the wrong time.
    """

    HANDLES: Final = (
        "MISSION_REQUEST_LIST",
        "MISSION_REQUEST",
        "MISSION_REQUEST_INT",
        "MISSION_COUNT",
        "MISSION_ITEM",
        "MISSION_ITEM_INT",
        "MISSION_ACK",
        "MISSION_CLEAR_ALL",
        "MISSION_SET_CURRENT",
        "MISSION_REQUEST_PARTIAL_LIST",
        "MISSION_WRITE_PARTIAL_LIST",
    )

    def __init__(
        self,
        store: PlanStore,
        *,
        say: Callable[[Severity, str], None],
        system_id: int = 1,
        component_id: int = 1,
        progress: Callable[[], MissionProgress] | None = None,
    ) -> None:
        self.store = store
        self.system_id = system_id
        self.refused = 0
        self._components = (0, component_id, _MISSION_PLANNER)
        self._say = say
        self._transfers: dict[int, Transfer] = {}
        self._uploading: int | None = None  # the one link that may
        self._reports = ProgressReports(store, progress) if progress else None
        self._handlers: dict[str, Callable[[Message, Transfer, int, int], list[Outgoing]]] = {
            "MISSION_REQUEST_LIST": self._list,
            "MISSION_REQUEST": self._request,
            "MISSION_REQUEST_INT": self._request,
            "MISSION_COUNT": self._count,
            "MISSION_ITEM": self._item,
            "MISSION_ITEM_INT": self._item,
            "MISSION_ACK": self._acknowledged,
            "MISSION_CLEAR_ALL": self._clear,
            "MISSION_SET_CURRENT": self._set_current,
        }

    def handle(self, msg: Message, link_id: int, now_us: int) -> list[Outgoing]:
        """Answer one message; what is not for us, and what PX4 does not know, gets no answer.

        Args:
            msg: the message.
            link_id: link it came from; the answers belong there.
            now_us: vehicle time, us.
        """
        if msg.name not in self.HANDLES or msg.target_system != self.system_id:
            return []
        if msg.target_component not in self._components:
            return []
        handler = self._handlers.get(msg.name)
        if handler is None:  # partial lists: no part of PX4
            self.refused += 1
            return []
        return handler(msg, self._transfer(link_id), link_id, now_us)

    def poll(self, link_id: int, now_us: int) -> list[Outgoing]:
        """Messages due now on a link: what has to be asked or said again, and how far the mission is.

        Args:
            link_id: the link.
            now_us: vehicle time, us.
        """
        transfer = self._transfer(link_id)
        out = self._reports.poll(link_id, now_us) if self._reports else []
        if transfer.state is State.IDLE:
            return out
        if now_us - transfer.heard_us >= TIMEOUT_US:
            self._end(transfer, link_id)
            self._say(Severity.CRITICAL, _TIMED_OUT)
        elif now_us - transfer.sent_us >= RETRY_US:
            if transfer.state is State.GETTING:
                out.append(transfer.ask(now_us))
            elif not transfer.seq:
                out.append(transfer.announce(now_us))
        return out

    def forget(self, link_id: int) -> None:
        """Forget a link whose peer is gone; an upload that was under way is dropped."""
        transfer = self._transfers.pop(link_id, None)
        if transfer:
            self._end(transfer, link_id)
        if self._reports:
            self._reports.forget(link_id)

    def _transfer(self, link_id: int) -> Transfer:
        transfer = self._transfers.get(link_id)
        if transfer is None:
            transfer = self._transfers[link_id] = Transfer()
        return transfer

    def _end(self, transfer: Transfer, link_id: int) -> None:
        """Nothing is under way on a link; items that came without the rest are dropped."""
        transfer.end()
        if self._uploading == link_id:
            self._uploading = None

    def _list(self, msg: Message, transfer: Transfer, link_id: int, now_us: int) -> list[Outgoing]:
        """MISSION_REQUEST_LIST: a download begins.

        One whose every item was sent counts as closed. The PX4 recorded compares these two numbers during an
        upload as well and so gives it up; here only the ground station whose upload it is can do that.
        """
        partner = (msg.sysid, msg.compid)
        plan = self.store.plan(transfer.kind)
        sending, getting = transfer.state is State.SENDING, transfer.state is State.GETTING
        again = partner == transfer.partner and (getting or transfer.kind == msg.mission_type)
        sent = transfer.seq == len(plan.items)
        if (sending and not (sent or again)) or (getting and not (sent and again)):
            return self._refuse("Mission download request ignored, already active\t", Severity.INFO)
        self._end(transfer, link_id)
        transfer.begin(State.SENDING, msg.mission_type, partner, now_us)
        transfer.plan = self.store.plan(transfer.kind)
        transfer.count = len(transfer.plan.items)
        return [transfer.announce(now_us)]

    def _request(self, msg: Message, transfer: Transfer, link_id: int, now_us: int) -> list[Outgoing]:
        """MISSION_REQUEST, MISSION_REQUEST_INT: the next item of a download, or the last one once more."""
        if (msg.sysid, msg.compid) != transfer.partner and transfer.partner != NOBODY:
            return self._refuse("WPM: REJ. CMD: partner id mismatch\t")
        transfer.integers = msg.name == "MISSION_REQUEST_INT"
        if transfer.state is State.GETTING:
            return self._refuse(_BUSY)
        if transfer.state is State.IDLE or msg.mission_type != transfer.kind:
            return self._refuse()
        transfer.heard_us = now_us
        seq: int = msg["seq"]
        expected = seq in (transfer.seq, transfer.seq - 1) and seq < transfer.count
        if not expected or self.store.plan(transfer.kind) is not transfer.plan:
            self._end(transfer, link_id)
            return [*self._refuse(_UNEXPECTED), acknowledge(transfer.kind, transfer.partner, ERROR)]
        transfer.seq = seq + 1
        transfer.sent_us = now_us
        name = "MISSION_ITEM_INT" if transfer.integers else "MISSION_ITEM"
        item = fields_of(transfer.plan.items[seq], integers=transfer.integers)
        place = {"seq": seq, "current": int(seq == self.store.current), "mission_type": transfer.kind}
        return [(name, {**target(transfer.partner), **place, **item})]

    def _count(self, msg: Message, transfer: Transfer, link_id: int, now_us: int) -> list[Outgoing]:
        """MISSION_COUNT: an upload begins."""
        partner = (msg.sysid, msg.compid)
        if transfer.state is State.SENDING:
            return [*self._refuse("WPM: IGN MISSION_COUNT: Busy\t"), acknowledge(transfer.kind, partner, ERROR)]
        if transfer.state is State.GETTING:
            if partner != transfer.partner:
                return [*self._refuse(), acknowledge(transfer.kind, partner, ERROR)]
            return self._repeated_count(msg, transfer, link_id, now_us)
        if self._uploading is not None:  # on another link
            return [*self._refuse(), acknowledge(transfer.kind, partner, ERROR)]
        transfer.begin(State.IDLE, msg.mission_type, partner, now_us)
        kind = plan_kind(msg.mission_type)
        if msg.count > (0 if kind is None else MOST_ITEMS[kind]):
            return [*self._refuse(), acknowledge(transfer.kind, partner, NO_SPACE)]
        if not msg.count:
            if kind is not None:
                self.store.clear(kind)
            return [acknowledge(transfer.kind, partner, ACCEPTED)]
        self._uploading = link_id
        transfer.state = State.GETTING
        transfer.count = msg.count
        return [transfer.ask(now_us)]

    def _repeated_count(self, msg: Message, transfer: Transfer, link_id: int, now_us: int) -> list[Outgoing]:
        """A MISSION_COUNT during an upload: our request was lost, or the ground begins anew.

        With another count or type it is another plan. PX4 goes on with the first numbers then, and could take
        the beginning of a plan for the whole.
        """
        transfer.heard_us = now_us
        if transfer.seq:
            return [*self._refuse(_BUSY), acknowledge(transfer.kind, transfer.partner, ERROR)]
        if (msg.count, msg.mission_type) == (transfer.count, transfer.kind):
            return [transfer.ask(now_us)]
        self._end(transfer, link_id)
        return self._count(msg, transfer, link_id, now_us)

    def _item(self, msg: Message, transfer: Transfer, link_id: int, now_us: int) -> list[Outgoing]:
        """MISSION_ITEM, MISSION_ITEM_INT: the next item of an upload."""
        if (msg.sysid, msg.compid) != transfer.partner:
            return self._refuse("REJ. MIS ITEM: partner id mismatch\t")
        transfer.integers = msg.name == "MISSION_ITEM_INT"
        if msg.mission_type != transfer.kind:
            return [*self._refuse(), acknowledge(transfer.kind, transfer.partner, ERROR)]
        if transfer.state is not State.GETTING:
            return self._uninvited(msg, transfer)
        transfer.heard_us = now_us
        if msg["seq"] != transfer.seq:
            return []  # a repeat: the one that was asked for will come
        kind = PlanKind(transfer.kind)
        try:
            item = item_from(msg, kind)
        except ItemRefused as error:
            self._end(transfer, link_id)
            self._refuse(None if error.silent else "IGN MISSION_ITEM: Invalid item\t")
            return [acknowledge(transfer.kind, transfer.partner, error.result)]
        if msg.current:
            transfer.first = transfer.seq
        transfer.items.append(item)
        transfer.crc = item_crc(msg, transfer.crc)
        transfer.seq += 1
        if transfer.seq < transfer.count:
            return [transfer.ask(now_us)]
        self.store.put(kind, transfer.items, transfer.crc, transfer.first)
        self._end(transfer, link_id)
        transfer.completed = True
        if kind is PlanKind.FENCE:
            self._say(Severity.WARNING, _FENCE_ONLY_KEPT)
        return [acknowledge(transfer.kind, transfer.partner, ACCEPTED, transfer.crc)]

    def _uninvited(self, msg: Message, transfer: Transfer) -> list[Outgoing]:
        """An item without an upload: the last one of a complete upload shows that our MISSION_ACK was lost.

        PX4 confirms the last item of an upload that it gave up as well.
        """
        if transfer.completed and msg["seq"] == transfer.seq - 1:
            return [acknowledge(transfer.kind, transfer.partner, ACCEPTED, transfer.crc)]
        idle = transfer.state is State.IDLE
        said = self._refuse(f"IGN MISSION_ITEM: {'No transfer' if idle else 'Busy'}\t")
        return [*said, acknowledge(transfer.kind, transfer.partner, ERROR)]

    def _acknowledged(self, msg: Message, transfer: Transfer, link_id: int, now_us: int) -> list[Outgoing]:
        """MISSION_ACK: the ground closes a download, cancels an upload or wants items in the other form."""
        if (msg.sysid, msg.compid) != transfer.partner:
            return self._refuse("REJ. WP CMD: partner id mismatch\t")
        closes = transfer.state is State.SENDING and msg.mission_type == transfer.kind
        cancels = transfer.state is State.GETTING and msg.type == CANCELLED
        if closes or cancels:
            self._end(transfer, link_id)
        elif transfer.state is State.GETTING and msg.type == UNSUPPORTED:
            transfer.integers = not transfer.integers
            return [transfer.ask(now_us)]
        return []

    def _clear(self, msg: Message, transfer: Transfer, link_id: int, now_us: int) -> list[Outgoing]:
        """MISSION_CLEAR_ALL: empty one plan, or all."""
        if transfer.state is not State.IDLE:
            return self._refuse("WPM: IGN CLEAR CMD: Busy\t")
        transfer.kind = msg.mission_type
        transfer.completed = False
        self.store.clear(msg.mission_type)
        return [acknowledge(transfer.kind, (msg.sysid, msg.compid), ACCEPTED)]

    def _set_current(self, msg: Message, transfer: Transfer, link_id: int, now_us: int) -> list[Outgoing]:
        """MISSION_SET_CURRENT: go on with another item; MISSION_CURRENT is the only answer."""
        if transfer.state is not State.IDLE:
            return self._refuse("WPM: IGN WP CURR CMD: Busy\t")
        if msg["seq"] >= len(self.store.mission.items):
            return self._refuse("WPM: WP CURR CMD: Not in list\t")
        if not self.store.set_current(msg["seq"]):
            return self._refuse("WPM: WP CURR CMD: Error setting ID\t")
        return []

    def _refuse(self, text: str | None = None, severity: Severity = Severity.CRITICAL) -> list[Outgoing]:
        self.refused += 1
        if text is not None:
            self._say(severity, text)
        return []
