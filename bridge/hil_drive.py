"""A client's time where a real autopilot flies our plant in lockstep: every wait is ticks of the plant.

Client and plant live in one thread. So a set-point is sent between two known ticks, and what the client sees of the
plant is of the tick that it is in.
"""

from __future__ import annotations

from collections.abc import Callable

from bridge.clock import Clock, WallClock
from bridge.drive import Drive
from bridge.errors import PeerLost, PeerSilent
from bridge.link import Link
from bridge.lockstep import Lockstep

LAST_WORDS_S = 0.1
"""Wall-clock time that a process is given to end after its connection has."""

ARRIVAL_S = 0.003
"""Wall-clock time that a set-point is given to get through the autopilot's own threads before the next tick."""

BEHIND_US = 40_000
"""Vehicle time by which the autopilot's telemetry may be behind the plant: it comes from a thread that nobody in the
lockstep waits for, and on a busy computer it would leave gaps."""

BEHIND_WAIT_S = 0.05
"""Wall-clock time that late telemetry is waited for."""

BEHIND_REST_US = 1_000_000
"""Vehicle time without such waits after one was in vain: nothing is being streamed."""


class HilDrive(Drive):
    """Waits by stepping the plant.

    Args:
        lockstep: plant and autopilot.
        patience_s: wall-clock time without an autopilot on the simulator's port after which it counts as lost, s.
        clock: measures that time.

    Attributes:
        each_tick: called after every tick: the flight's recorder of the truth.
        alive: called while nobody is there, and when the autopilot went: raises if its process has ended.
    """

    def __init__(self, lockstep: Lockstep, patience_s: float = 20.0, clock: Clock | None = None) -> None:
        self.lockstep = lockstep
        self.patience_s = patience_s
        self.each_tick: Callable[[], object] | None = None
        self.alive: Callable[[], object] = lambda: None
        self._clock: Clock = clock or WallClock()
        self._alone_since_us: int | None = None
        self._left = False
        self._quat: tuple[float, float, float, float] | None = None
        self._hold = False
        self._heard_us: int | None = None
        self._follow_from_us = 0

    def now_us(self) -> int:
        """Vehicle time: the plant's, which is the autopilot's, too; us."""
        return self.lockstep.body.time_us

    def heard(self, time_us: int) -> None:
        """A message of the autopilot carried this vehicle time."""
        self._heard_us = time_us

    def sent_setpoint(self, quat: tuple[float, float, float, float]) -> None:
        """A changed set-point must be there before time goes on, or it counts a tick or two later."""
        self._hold = self._hold or quat != self._quat
        self._quat = quat

    def wait(self, link: Link, until_us: int) -> bytes | None:
        """Let ticks pass, one at least, until something comes or `until_us` is reached.

        Raises:
            PeerLost: the autopilot left the simulator's port. PeerSilent: none ever came.
        """
        if self._hold:
            self._hold = False
            self._clock.sleep_until_us(self._clock.now_us() + round(ARRIVAL_S * 1e6))
        while True:
            self._tick()
            data = link.recv() or self._late(link)
            if data is not None or self.now_us() >= until_us:
                return data

    def _late(self, link: Link) -> bytes | None:
        """Telemetry that is behind the plant, waited for."""
        now_us = self.now_us()
        if self._heard_us is None or now_us - self._heard_us < BEHIND_US or now_us < self._follow_from_us:
            return None
        data = link.recv(BEHIND_WAIT_S)
        if data is None:
            self._follow_from_us = now_us + BEHIND_REST_US
        return data

    def _tick(self) -> None:
        lockstep = self.lockstep
        before, restarts = self.now_us(), lockstep.report.restarts
        lockstep.step()
        if lockstep.report.restarts != restarts:
            # a process that ends closes its connection first: its last words say more
            self._clock.sleep_until_us(self._clock.now_us() + round(LAST_WORDS_S * 1e6))
            self.alive()
            self._left = True
            raise PeerLost("the autopilot", "it left the simulator's port")
        if self.now_us() == before:
            if self._left:
                raise PeerLost("the autopilot", "it left the simulator's port and is not back")
            self._alone()
            return
        self._alone_since_us, self._left = None, False
        if self.each_tick is not None:
            self.each_tick()
        if self._look is not None:
            self._look(self.now_us())

    def _alone(self) -> None:
        now = self._clock.now_us()
        if self._alone_since_us is None:
            self._alone_since_us = now
        self.alive()
        if now - self._alone_since_us > self.patience_s * 1e6:
            remedy = "Start it: PX4 connects to that port by itself (PX4_SIM_MODEL=none_iris)"
            name = self.lockstep.link.name
            raise PeerSilent(name, self.patience_s, "an autopilot on the simulator's port", remedy)
