"""Several vehicles in one process and one thread, in real time, slower, faster, or as fast as it goes.

    fleet = Fleet(servers, ScaledClock(1.0))
    with stop_on_signals() as stop:
        fleet.run(stop=stop, report=print)

All vehicles share the tick. Between two ticks the fleet sleeps until the next one is due or somebody speaks to a
vehicle, who is answered at once.
"""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from bridge.clock import Clock, ScaledClock, WallClock
from bridge.fleet_status import FleetStatus, FleetWatch
from bridge.readiness import Readiness
from bridge.sitl_links import close_links
from bridge.vehicle_server import VehicleServer
from sitl.errors import UsageError

_TOO_LATE_US = 100_000
"""What is later than this is not flown in a rush, in which nobody could send a set-point."""
_CATCH_UP = 20
"""A twentieth faster, until it is made up for."""
_MOST_OWED_US = 10_000_000
"""Of what a computer has slept, or was too slow for, this much is."""
_LISTEN_US = 1_000
_LONGEST_SLEEP_US = 50_000
_WATCH_TICKS = 4


class Fleet:
    """Vehicles that are served together.

    A vehicle that a ground station switches off leaves the fleet, and so does one that fails: its links are closed
    and the others fly on.

    Args:
        servers: the vehicles, all with the same tick.
        clock: their speed; None for as fast as possible.
        wall: the clock that measures the speed; tests pass their own.
        tell: gets a line for people when a vehicle leaves.
        close: called with each vehicle that leaves, before its links are closed, and at the end with the rest.

    Attributes:
        servers: the vehicles that are still served.
        failures: (system id, what happened) of the vehicles that failed.

    Raises:
        UsageError: no vehicles, or different ticks.
    """

    def __init__(
        self,
        servers: Sequence[VehicleServer],
        clock: ScaledClock | None,
        *,
        wall: Clock | None = None,
        tell: Callable[[str], object] = lambda _: None,
        close: Callable[[VehicleServer], object] = lambda _: None,
    ) -> None:
        ticks = {server.vehicle.tick_us for server in servers}
        if len(ticks) != 1:
            raise UsageError("a fleet needs vehicles, and all of them with the same tick: give them one --profile")
        self.servers = list(servers)
        self.failures: list[tuple[int, str]] = []
        self._clock = clock
        self._tick_us = ticks.pop()
        self._wall = wall or WallClock()
        self._tell = tell
        self._close = close
        self._readiness = Readiness(self.servers)
        self._behind = False

    def run(self, *, stop: Callable[[], bool], report: Callable[[FleetStatus], object] | None = None) -> FleetStatus:
        """Serve until `stop` says so or no vehicle is left; then close the vehicles, but not their links.

        A machine that cannot keep up flies slower than asked and says so in the status. After a pause of more than
        0.1 s the vehicles fly a twentieth faster than asked until they are where the clock is, for up to 10 s of pause.

        Args:
            stop: asked before every tick.
            report: gets a status once per wall second.

        Returns:
            What became of the whole: its speed is that from start to end, and those that left are in it.
        """
        everybody = self.servers.copy()
        try:
            self._each(self._tick)  # before the clock starts: the first tick loads the compiled laws
            whole = FleetWatch(everybody, None if self._clock is None else self._clock.speed, self._wall)
            self._serve(stop, report)
            whole.failed = len(self.failures)
            return whole.status()
        finally:
            self._readiness.close()
            for server in self.servers:
                self._end(server)

    def _serve(self, stop: Callable[[], bool], report: Callable[[FleetStatus], object] | None) -> None:
        pace = None if self._clock is None else _Pace(self._clock, self._tick_us)
        watch = FleetWatch(self.servers, None if self._clock is None else self._clock.speed, self._wall)
        tick = 0
        while self.servers and not stop():
            if pace is None:
                self._listen(0.0)
            elif not self._wait(pace, stop):
                break
            else:
                self._behind = pace.remaining_us() <= 0
            self._each(self._tick)
            tick += 1
            if report is not None and tick % _WATCH_TICKS == 0:
                watch.failed = len(self.failures)
                status = watch.look()
                if status is not None:
                    report(status)

    def _wait(self, pace: _Pace, stop: Callable[[], bool]) -> bool:
        """Listen until the next tick is due; whether there is one."""
        while True:
            remaining_us = pace.remaining_us()
            if self._readiness.hears_all:
                self._listen(min(remaining_us, _LONGEST_SLEEP_US) * 1e-6)
            else:
                if remaining_us > 0:
                    pace.sleep_us(min(remaining_us, _LISTEN_US))
                self._listen(0.0)
            # The last look at the clock decides, so that what came while we slept is flown in this tick.
            if remaining_us <= 0 or pace.remaining_us() <= 0:
                pace.next()
                return bool(self.servers)
            if stop() or not self.servers:
                return False

    def _listen(self, timeout_s: float) -> None:
        """Let the vehicles answer that somebody has spoken to, waiting for that if need be."""
        for server in self._readiness.wait(timeout_s):
            self._guarded(server, _listen_to)
            if server.shutdown_asked and server in self.servers:
                self._leave(server)
                self._tell(f"system {server.sysid} was switched off by a ground station")

    def _tick(self, server: VehicleServer) -> None:
        """One tick of one vehicle, what has come before it being read already (`VehicleServer.step`)."""
        server.behind = self._behind
        server.advance()

    def _each(self, run: Callable[[VehicleServer], object]) -> None:
        for server in self.servers.copy():
            self._guarded(server, run)

    def _guarded(self, server: VehicleServer, run: Callable[[VehicleServer], object]) -> None:
        """Run a part of one vehicle; if that fails, the others go on without it."""
        try:
            run(server)
        except Exception as error:
            if server.strict:
                raise
            what = f"{type(error).__name__}: {error} ({_place(error)})"
            self.failures.append((server.sysid, what))
            self._tell(f"system {server.sysid} failed and is no longer served: {what}")
            self._leave(server)

    def _leave(self, server: VehicleServer) -> None:
        self.servers.remove(server)
        self._readiness.forget(server)
        self._end(server)
        close_links(server.links)

    def _end(self, server: VehicleServer) -> None:
        """Close a vehicle; what goes wrong there must not keep the others from being closed."""
        try:
            self._close(server)
        except Exception as error:
            self.failures.append((server.sysid, str(error)))
            self._tell(f"system {server.sysid} could not be closed in order: {error}")


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C, SIGTERM and SIGHUP end a fleet after the tick it is in; yields the `stop` to give to it.

    Under nohup, a hang-up stays ignored.
    """
    stopped = False

    def stop(_number: int, _frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield lambda: stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Pace:
    """When ticks are due on a clock. Sleeps and what remains are wall time, in microseconds."""

    def __init__(self, clock: ScaledClock, tick_us: int) -> None:
        self._clock = clock
        self._tick_us = tick_us
        self._too_late_us = int(_TOO_LATE_US * clock.speed)
        self._most_owed_us = int(_MOST_OWED_US * clock.speed)
        self._owed_us = 0
        self._due_us = clock.now_us() + tick_us

    def remaining_us(self) -> int:
        """Return how long it is until the next tick, 0 or less when it is due; never 0 too early."""
        remaining_us = self._due_us - self._clock.now_us()
        return remaining_us if remaining_us <= 0 else max(1, int(remaining_us / self._clock.speed))

    def sleep_us(self, wall_us: int) -> None:
        """Sleep."""
        self._clock.sleep_until_us(self._clock.now_us() + max(1, int(wall_us * self._clock.speed)))

    def next(self) -> None:
        """Set the time of the tick after this one; what is too late is made up for little by little."""
        late_us = self._clock.now_us() - self._due_us
        if late_us > self._too_late_us:
            self._due_us += late_us
            self._owed_us = min(self._owed_us + late_us, self._most_owed_us)
        sooner_us = min(self._owed_us, self._tick_us // _CATCH_UP)
        self._owed_us -= sooner_us
        self._due_us += self._tick_us - sooner_us


def _listen_to(server: VehicleServer) -> None:
    server.listen()


def _place(error: Exception) -> str:
    """Return the file and line that raised an error, for a bug report."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "no place"
