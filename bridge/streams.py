"""Which telemetry goes out on a link, and when.

A `Schedule` keeps one due time per streamed message and a heap over them, so a tick on which nothing is due
costs one comparison. Due times advance by whole intervals in microseconds of vehicle time: the achieved rate
is the rate asked for, without drift, up to the vehicle's tick rate. Rates are PX4's: mavlink_main.cpp's
configure_streams_to_default, and for what its simulator adds init.d-posix/px4-rc.mavlink.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping

from bridge.stream_table import DEFAULT_HZ, HEARTBEAT_ID, START_HZ, STREAMS, LinkMode, Stream
from bridge.telemetry import Fields, Source

__all__ = ["HEARTBEAT_ID", "OFF", "STREAMS", "LinkMode", "Schedule", "Stream"]

OFF = -1
"""Interval of a message that is not streamed."""

_NEVER = 1 << 62


class _Slot:
    """One stream on one link: its interval and what was last sent."""

    __slots__ = ("build", "fallback_us", "interval_us", "name", "order", "sent_us", "sent_version", "version")

    def __init__(self, stream: Stream, order: int, interval_us: int, now_us: int) -> None:
        self.name = stream.name
        self.build = stream.build
        self.version = stream.version
        self.fallback_us = stream.fallback_us
        self.order = order
        self.interval_us = interval_us
        self.sent_version = -1
        self.sent_us = now_us

    def has_news(self, source: Source, now_us: int) -> bool:
        """Return whether there is something to send that has not been sent."""
        version = self.version(source)  # type: ignore[misc]
        if version != self.sent_version:
            self.sent_version = version
            self.sent_us = now_us
            return True
        return 0 < self.fallback_us <= now_us - self.sent_us


class Schedule:
    """When each message is due on one link.

    Args:
        mode: whose default rates; a memory link starts like an onboard one.
        now_us: vehicle time; HEARTBEAT is due at once, everything else one interval later.
    """

    def __init__(self, mode: LinkMode, now_us: int = 0) -> None:
        self.mode = mode
        self._slots: dict[int, _Slot] = {}
        self._waiting: list[tuple[int, _Slot]] = []
        self._heap: list[tuple[int, int, _Slot | None]] = []
        for order, stream in enumerate(STREAMS.values()):
            hz = START_HZ[mode].get(stream.name, 0.0)
            if hz:
                self._slots[stream.message_id] = _Slot(stream, order, _interval_us(hz), now_us)
        self._rebuild(
            [
                (now_us if message_id == HEARTBEAT_ID else now_us + slot.interval_us, slot.order, slot)
                for message_id, slot in self._slots.items()
            ]
        )

    def interval_us(self, message_id: int) -> int:
        """Return a message's interval in microseconds, OFF if it is not streamed."""
        slot = self._slots.get(message_id)
        return OFF if slot is None else slot.interval_us

    def set_interval(self, message_id: int, interval_us: int, now_us: int) -> None:
        """Change how often a message is streamed; the first one goes out with the next tick.

        Args:
            message_id: which.
            interval_us: in microseconds; 0 is the default of the link's mode, below 0 is off.
            now_us: vehicle time.

        Raises:
            KeyError: not a message that can be streamed.
        """
        stream = STREAMS[message_id]
        if interval_us == 0:
            hz = DEFAULT_HZ[self.mode].get(stream.name, 0.0)
            interval_us = _interval_us(hz) if hz else OFF
        previous = self._slots.pop(message_id, None)
        entries: list[tuple[int, int, _Slot]] = [
            (due, slot.order, slot)
            for due, slot in self._waiting + [(due, slot) for due, _, slot in self._heap if slot is not None]
            if slot is not previous
        ]
        if interval_us > 0:
            slot = _Slot(stream, list(STREAMS).index(message_id), interval_us, now_us)
            if previous is not None:
                slot.sent_version, slot.sent_us = previous.sent_version, previous.sent_us
            self._slots[message_id] = slot
            entries.append((now_us, slot.order, slot))
        self._rebuild(entries)

    def intervals(self) -> Mapping[str, int]:
        """Return the interval in microseconds of each streamed message, by name."""
        return {slot.name: slot.interval_us for slot in self._slots.values()}

    def run(self, now_us: int, source: Source, send: Callable[[str, Fields], None]) -> None:
        """Send what is due at vehicle time `now_us`."""
        if self._waiting:
            self._send_news(now_us, source, send)
        heap = self._heap
        due_us, _, slot = heap[0]
        while due_us <= now_us:
            assert slot is not None  # the sentinel is never due
            if slot.version is not None and not slot.has_news(source, now_us):
                heapq.heappop(heap)
                self._waiting.append((due_us, slot))
            else:
                # Its next turn first: one that cannot be built or sent must not block the others.
                heapq.heapreplace(heap, (_next_us(due_us, slot, now_us), slot.order, slot))
                fields = slot.build(source)
                if fields is not None:
                    send(slot.name, fields)
            due_us, _, slot = heap[0]

    def _send_news(self, now_us: int, source: Source, send: Callable[[str, Fields], None]) -> None:
        """Send what was due earlier, had nothing new then, and has now."""
        ready = [entry for entry in self._waiting if entry[1].has_news(source, now_us)]
        if not ready:
            return
        self._waiting = [entry for entry in self._waiting if entry not in ready]
        for due_us, slot in ready:
            heapq.heappush(self._heap, (_next_us(due_us, slot, now_us), slot.order, slot))
        for _, slot in ready:
            fields = slot.build(source)
            if fields is not None:
                send(slot.name, fields)

    def _rebuild(self, entries: list[tuple[int, int, _Slot]]) -> None:
        self._waiting = []
        # The sentinel spares the loop in `run` a test for an empty heap.
        self._heap = [*entries, (_NEVER, len(STREAMS), None)]
        heapq.heapify(self._heap)


def _next_us(due_us: int, slot: _Slot, now_us: int) -> int:
    """Return when a message that was due and is sent now is due again; what was missed is not made up for."""
    next_us = due_us + slot.interval_us
    if next_us > now_us:
        return next_us
    return now_us + (slot.interval_us if slot.version is not None else 1)


def _interval_us(hz: float) -> int:
    return int(1e6 / hz)
