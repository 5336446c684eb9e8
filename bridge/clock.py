"""Clocks: the only module that imports `time`.

Everything that waits is handed a clock, so the same client flies a vehicle in this thread at any speed
(SimClock), a vehicle in another process (WallClock) or one that runs slowed down or sped up (ScaledClock).
Times are integer microseconds; only their differences mean something, except for `utc_us`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Protocol

from sitl.errors import UsageError


class Clock(Protocol):
    """What a waiting caller needs of a clock."""

    def now_us(self) -> int:
        """Return the time in microseconds; it never goes back."""
        ...

    def sleep_until_us(self, time_us: int) -> int:
        """Let time pass until `time_us` and return how late we are, in microseconds (0 or more)."""
        ...


class SimClock:
    """Vehicle time in one thread: time passes only when somebody advances it.

    Each tick first moves the time on, then runs every registered callable once, in the order they were
    registered: that is how a vehicle, its links and a runner share one thread and give the same bytes each
        time.

    Args:
        tick_us: length of one tick in microseconds (an integer: time never accumulates a rounding error).
        start_us: the time before the first tick.
    """

    def __init__(self, tick_us: int, *, start_us: int = 0) -> None:
        if tick_us < 1:
            raise UsageError(f"a clock tick of {tick_us} us does not move time; give 1 us or more")
        self.tick_us = tick_us
        self.tick = 0
        self._now_us = start_us
        self._each_tick: list[Callable[[], object]] = []
        self._advancing = False

    def now_us(self) -> int:
        """Return the time in microseconds."""
        return self._now_us

    def every_tick(self, run: Callable[[], object]) -> None:
        """Run this callable once in every later tick; what it raises reaches the caller of `advance`."""
        # A new list: a callable registered from inside a tick starts with the next one.
        self._each_tick = [*self._each_tick, run]

    def forget(self, run: Callable[[], object]) -> None:
        """Stop running this callable; unknown ones are ignored, so that teardown may repeat itself."""
        self._each_tick = [other for other in self._each_tick if other != run]

    def advance(self, ticks: int = 1) -> None:
        """Let `ticks` ticks pass.

        Raises:
            RuntimeError: a registered callable advanced the clock that is running it.
        """
        if self._advancing:
            raise RuntimeError("the clock was advanced from inside one of its own ticks")
        self._advancing = True
        try:
            for _ in range(ticks):
                self._now_us += self.tick_us
                self.tick += 1
                for run in self._each_tick:
                    run()
        finally:
            self._advancing = False

    def sleep_until_us(self, time_us: int) -> int:
        """Advance tick by tick until `time_us` is reached; return the overshoot in microseconds."""
        if time_us > self._now_us:
            self.advance(-(-(time_us - self._now_us) // self.tick_us))
        return self._now_us - time_us


class WallClock:
    """The computer's monotonic clock."""

    def now_us(self) -> int:
        """Return the monotonic time in microseconds."""
        return time.monotonic_ns() // 1000

    def sleep_until_us(self, time_us: int) -> int:
        """Sleep until `time_us`, at once if it has passed; return how late we woke, in microseconds."""
        remaining_us = time_us - self.now_us()
        if remaining_us > 0:
            time.sleep(remaining_us * 1e-6)
        return max(0, self.now_us() - time_us)


class ScaledClock:
    """Wall time multiplied by a speed, from zero at its making.

    Args:
        speed: vehicle seconds per wall second, for example 0.5 or 20.
        wall: the clock that is scaled; tests pass their own.

    Raises:
        UsageError: the speed is not a positive finite number.
    """

    def __init__(self, speed: float, wall: Clock | None = None) -> None:
        if not (math.isfinite(speed) and speed > 0):
            raise UsageError(f"--speed {speed}: give a number above 0, or 'max' for as fast as the machine can")
        self.speed = speed
        self._wall: Clock = wall or WallClock()
        self._start_us = self._wall.now_us()

    def now_us(self) -> int:
        """Return the scaled time in microseconds since this clock was made."""
        return int((self._wall.now_us() - self._start_us) * self.speed)

    def sleep_until_us(self, time_us: int) -> int:
        """Sleep until the scaled time `time_us`; return how late we woke, in scaled microseconds."""
        self._wall.sleep_until_us(self._start_us + math.ceil(time_us / self.speed))
        return max(0, self.now_us() - time_us)


def utc_us() -> int:
    """Return microseconds since 1 January 1970 UTC, for SYSTEM_TIME, TIMESYNC and log stamps."""
    return time.time_ns() // 1000


def utc_stamp(at_us: int | None = None) -> str:
    """Return a UTC time as `20261122T200455Z`: sorts by time and is a file name on every system.

    Args:
        at_us: microseconds since 1970 UTC; now if None.
    """
    seconds = (utc_us() if at_us is None else at_us) // 1_000_000
    return time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(seconds))
