"""A link that can be made worse for a while, in vehicle time: what a flight's planned faults do to the wire.

While no fault is in force every datagram passes as it is. Each fault draws from generators of its own, one for each
direction, so that neither traffic the other way nor another fault changes its fate.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bridge.link import Damage, Link

TO_VEHICLE, FROM_VEHICLE = 0, 1


@dataclass(frozen=True)
class LinkFault:
    """What happens to datagrams.

    Attributes:
        loss, duplicate, reorder, corrupt: shares of them, 0 to 1: vanish, arrive twice, are held back until the next
            has passed, arrive with one byte changed.
        delay_us: every one comes so much later. jitter_us: ... and up to so much more, each by chance.
        to_vehicle, from_vehicle: the directions it acts in, seen from the end that has this link.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    delay_us: int = 0
    jitter_us: int = 0
    to_vehicle: bool = True
    from_vehicle: bool = True


class FaultyLink(Link):
    """The ground's end of a link that faults come to and go from.

    Args:
        link: the link underneath; it should keep datagrams whole.
        now_us: time in which datagrams are late; it never goes back and goes on while nothing comes.
        seed: of what is left to chance.
    """

    def __init__(self, link: Link, now_us: Callable[[], int], seed: int) -> None:
        super().__init__(link.name)
        self._link = link
        self._now_us = now_us
        self._seed = seed
        self._out, self._in = _Way(), _Way()
        self._stages: dict[int, list[_Stage]] = {}

    def fileno(self) -> int:
        """As the link underneath."""
        return self._link.fileno()

    def begin(self, number: int, fault: LinkFault) -> None:
        """Put a fault in force.

        Args:
            number: of the fault. fault: what it does.
        """
        stages = []
        for place, (way, wanted) in enumerate(((self._out, fault.to_vehicle), (self._in, fault.from_vehicle))):
            if wanted:
                stage = _Stage(fault, np.random.default_rng([self._seed, 4, number, place]))
                way.stages[number] = stage
                stages.append(stage)
        self._stages[number] = stages

    def end(self, number: int) -> None:
        """Take a fault away; what it holds back goes on, what is on its way comes when it is due."""
        for way in (self._out, self._in):
            stage = way.stages.pop(number, None)
            held = stage.damage.release() if stage is not None else None
            if held is not None:
                way.put(self._now_us(), held)
        self._send_due()

    def datagrams(self, number: int) -> tuple[int, int]:
        """How many datagrams a fault has seen so far, both directions together, and to how many it did something."""
        stages = self._stages.get(number, [])
        return sum(stage.seen for stage in stages), sum(stage.hit for stage in stages)

    def send(self, data: bytes) -> None:
        """Send what the faults leave of it, when they let it."""
        if self._out.idle:
            self._link.send(data)
            return
        self._out.take(self._now_us(), data)
        self._send_due()

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        """Return the next datagram that is due, None if there is none within `timeout_s` seconds."""
        if not self._out.idle:
            self._send_due()
        if self._in.idle:
            return self._link.recv(timeout_s)
        while True:
            due = self._in.due(self._now_us())
            if due is not None:
                return due
            data = self._link.recv(timeout_s)
            if data is None:
                return self._in.due(self._now_us())
            self._in.take(self._now_us(), data)
            timeout_s = 0.0

    def close(self) -> None:
        """Close the link underneath; what is on its way is lost."""
        self._link.close()

    def _send_due(self) -> None:
        now_us = self._now_us()
        data = self._out.due(now_us)
        while data is not None:
            self._link.send(data)
            data = self._out.due(now_us)


class _Stage:
    """One fault in one direction."""

    def __init__(self, fault: LinkFault, rng: np.random.Generator) -> None:
        self.damage = Damage(
            rng, loss=fault.loss, duplicate=fault.duplicate, reorder=fault.reorder, corrupt=fault.corrupt
        )
        self._rng = rng
        self._delay_us, self._jitter_us = fault.delay_us, fault.jitter_us
        self.seen = 0
        self._delayed = 0

    @property
    def hit(self) -> int:
        """Datagrams that something happened to."""
        return self._delayed or self.damage.count

    def passing(self, due_us: int, data: bytes) -> list[tuple[int, bytes]]:
        """What comes of a datagram, and when."""
        self.seen += 1
        if not (self._delay_us or self._jitter_us):
            return [(due_us, one) for one in self.damage.passing(data)]
        self._delayed += 1
        late_us = self._delay_us + (int(self._rng.integers(self._jitter_us + 1)) if self._jitter_us else 0)
        return [(due_us + late_us, data)]


class _Way:
    """One direction: the faults in force, in the order they began, and what is on its way."""

    def __init__(self) -> None:
        self.stages: dict[int, _Stage] = {}
        self._waiting: list[tuple[int, int, bytes]] = []
        self._serial = 0

    @property
    def idle(self) -> bool:
        """Nothing is in force and nothing on its way."""
        return not (self.stages or self._waiting)

    def take(self, now_us: int, data: bytes) -> None:
        """Let a datagram through the faults."""
        passing = [(now_us, data)]
        for stage in self.stages.values():
            passing = [left for due_us, one in passing for left in stage.passing(due_us, one)]
        for due_us, one in passing:
            self.put(due_us, one)

    def put(self, due_us: int, data: bytes) -> None:
        """Let a datagram arrive at a time, us; those of one time in the order they were put."""
        self._serial += 1
        heapq.heappush(self._waiting, (due_us, self._serial, data))

    def due(self, now_us: int) -> bytes | None:
        """The next datagram that has arrived by now."""
        if self._waiting and self._waiting[0][0] <= now_us:
            return heapq.heappop(self._waiting)[2]
        return None
