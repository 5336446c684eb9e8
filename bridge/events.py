"""MAVLink's events service: what the vehicle reports reaches every ground station, in order, though links lose frames.

Each event has a sequence number; a receiver that misses one asks for it again. Source: MAVLink events service,
PX4 src/modules/mavlink/mavlink_events.cpp.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

from bridge.event_list import find_event
from sitl.modes import Severity

Reply = tuple[str, dict[str, Any]]

KEPT = 64
"""Events kept for receivers that missed them."""

_SEQUENCE_US = 3_000_000
_RESET = 1  # MAV_EVENT_CURRENT_SEQUENCE_FLAGS_RESET: a new count begins
_UNAVAILABLE = 0
_MOST_ANSWERS = 32
_START = 0xFFF6
"""PX4 starts close to the wrap-around, so that receivers meet it at once."""


class _Kept(NamedTuple):
    sequence: int
    fields: dict[str, Any]


class EventServer:
    """The events of one vehicle.

    Args:
        system_id, component_id: the vehicle's own.

    Attributes:
        refused: requests that made no sense.
    """

    HANDLES = ("REQUEST_EVENT",)

    def __init__(self, *, system_id: int, component_id: int) -> None:
        self._system_id = system_id
        self._component_id = component_id
        self._kept: deque[_Kept] = deque(maxlen=KEPT)
        self._next = _START
        self._seen: dict[int, int] = {}
        self._due_us: dict[int, int] = {}
        self._links: set[int] = set()
        self.refused = 0

    def report(self, severity: Severity, text: str, now_us: int) -> bool:
        """Report what a text says as an event; False if no event says it. now_us: vehicle time."""
        found = find_event(text)
        if found is None:
            return False
        event, arguments = found
        fields = {
            "id": event.number,
            "event_time_boot_ms": now_us // 1000,
            "sequence": self._next,
            "log_levels": int(severity) << 4 | int(severity),
            "arguments": arguments,
        }
        self._kept.append(_Kept(self._next, fields))
        self._next = (self._next + 1) & 0xFFFF
        return True

    def handle(self, msg: Any, link_id: int, now_us: int) -> list[Reply]:
        """Answer a REQUEST_EVENT with the events asked for, or with what is still there."""
        if msg.target_system != self._system_id or msg.target_component not in (0, self._component_id):
            return []
        count = (msg.last_sequence - msg.first_sequence & 0xFFFF) + 1
        if count > 0x8000:
            self.refused += 1
            return []
        kept = {event.sequence: event.fields for event in self._kept}
        replies: list[Reply] = []
        for step in range(min(count, _MOST_ANSWERS)):
            sequence = msg.first_sequence + step & 0xFFFF
            if sequence in kept:
                replies.append(("EVENT", kept[sequence]))
                continue
            oldest = self._kept[0].sequence if self._kept else self._next
            fields = {
                "target_system": msg.sysid,
                "target_component": msg.compid,
                "sequence": sequence,
                "sequence_oldest_available": oldest,
                "reason": _UNAVAILABLE,
            }
            replies.append(("RESPONSE_EVENT_ERROR", fields))
        return replies

    def poll(self, link_id: int, now_us: int) -> list[Reply]:
        """Return events that this link has not had, and every three seconds the number of the last."""
        replies: list[Reply] = []
        if link_id not in self._links:
            self._links.add(link_id)
            self._seen.setdefault(link_id, _START)
            self._due_us[link_id] = now_us + _SEQUENCE_US
            # the number before the first that follows: a receiver takes what it already counts as had for a repeat
            return [("CURRENT_EVENT_SEQUENCE", {"sequence": self._seen[link_id] - 1 & 0xFFFF, "flags": _RESET})]
        seen = self._seen[link_id]
        if seen != self._next:
            unseen = self._next - seen & 0xFFFF
            replies += [("EVENT", event.fields) for event in list(self._kept)[-unseen:]]
            self._seen[link_id] = self._next
        if now_us >= self._due_us[link_id]:
            self._due_us[link_id] = now_us + _SEQUENCE_US
            replies.append(("CURRENT_EVENT_SEQUENCE", {"sequence": self._next - 1 & 0xFFFF}))
        return replies

    def forget(self, link_id: int) -> None:
        """The link's peer is gone; the next one is told where the count is."""
        self._links.discard(link_id)
