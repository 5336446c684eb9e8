"""Vehicle time passes only when it is told to; wall time is only ever asked for here, never asserted on."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.clock import Clock, ScaledClock, SimClock, WallClock, utc_stamp, utc_us
from sitl.errors import UsageError

ROOT = Path(__file__).parents[2]


class FakeWall:
    """A wall clock that jumps; it wakes a little late, as real ones do."""

    def __init__(self, late_us: int = 0) -> None:
        self.time_us = 5_000_000
        self.late_us = late_us

    def now_us(self) -> int:
        return self.time_us

    def sleep_until_us(self, time_us: int) -> int:
        self.time_us = max(self.time_us, time_us + self.late_us)
        return self.time_us - time_us


def test_a_tick_moves_time_first_and_then_runs_everybody_in_order() -> None:
    clock = SimClock(4000)
    seen: list[tuple[str, int]] = []
    clock.every_tick(lambda: seen.append(("vehicle", clock.now_us())))
    clock.every_tick(lambda: seen.append(("recorder", clock.now_us())))
    clock.advance(2)
    assert seen == [("vehicle", 4000), ("recorder", 4000), ("vehicle", 8000), ("recorder", 8000)]
    assert clock.tick == 2


@given(tick_us=st.integers(1, 20_000), start_us=st.integers(0, 10**12), ticks=st.integers(0, 300))
def test_time_is_exact(tick_us: int, start_us: int, ticks: int) -> None:
    clock = SimClock(tick_us, start_us=start_us)
    for _ in range(ticks):
        clock.advance()
    assert clock.now_us() == start_us + ticks * tick_us


@given(tick_us=st.integers(1, 5000), until_us=st.integers(-1000, 100_000))
def test_sleeping_on_simulated_time_runs_the_ticks_and_says_how_far_it_overshot(tick_us: int, until_us: int) -> None:
    clock = SimClock(tick_us)
    ran: list[int] = []
    clock.every_tick(lambda: ran.append(clock.now_us()))
    late_us = clock.sleep_until_us(until_us)
    assert clock.now_us() == until_us + late_us
    assert ran == list(range(tick_us, clock.now_us() + 1, tick_us))
    assert until_us <= 0 or late_us < tick_us


def test_callables_come_and_go() -> None:
    clock = SimClock(1000)
    ran: list[str] = []

    def once() -> None:
        ran.append("once")
        clock.forget(once)
        clock.every_tick(lambda: ran.append("later"))

    clock.every_tick(once)
    clock.advance()
    assert ran == ["once"]
    clock.advance(2)
    assert ran == ["once", "later", "later"]
    clock.forget(once)


def test_a_tick_may_not_advance_its_own_clock() -> None:
    clock = SimClock(1000)
    clock.every_tick(clock.advance)
    with pytest.raises(RuntimeError, match="inside one of its own ticks"):
        clock.advance()


def test_an_error_in_a_tick_reaches_whoever_advanced_and_leaves_the_clock_usable() -> None:
    clock = SimClock(1000)

    def fail() -> None:
        raise ValueError("the vehicle broke")

    clock.every_tick(fail)
    with pytest.raises(ValueError, match="the vehicle broke"):
        clock.advance()
    clock.forget(fail)
    clock.advance()
    assert clock.now_us() == 2000


@pytest.mark.parametrize("tick_us", [0, -4000])
def test_a_tick_takes_time(tick_us: int) -> None:
    with pytest.raises(UsageError, match="does not move time"):
        SimClock(tick_us)


@given(speed=st.floats(0.01, 100.0), until_us=st.integers(0, 10**9), late_us=st.integers(0, 5000))
def test_a_scaled_clock_keeps_to_its_speed(speed: float, until_us: int, late_us: int) -> None:
    wall = FakeWall(late_us)
    clock = ScaledClock(speed, wall)
    assert clock.now_us() == 0
    late = clock.sleep_until_us(until_us)
    assert clock.now_us() >= until_us - 1  # a microsecond of rounding
    assert (wall.now_us() - 5_000_000) * speed == pytest.approx(clock.now_us(), abs=1.0)
    assert late == max(0, clock.now_us() - until_us)
    assert late <= (late_us + 1) * speed + 1


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan, math.inf])
def test_a_speed_is_positive(speed: float) -> None:
    with pytest.raises(UsageError, match="speed"):
        ScaledClock(speed)


def test_wall_time_goes_forward_and_a_past_moment_is_not_waited_for() -> None:
    clock: Clock = WallClock()
    before = clock.now_us()
    assert clock.sleep_until_us(before + 200) >= 0
    assert clock.now_us() >= before + 200
    assert clock.sleep_until_us(before) >= 200


def test_stamps_sort_and_are_file_names() -> None:
    assert utc_stamp(0) == "19700101T000000Z"
    assert utc_stamp(1_795_377_895_123_456) == "20261122T200455Z"
    assert utc_stamp(utc_us()) <= utc_stamp()
    assert utc_stamp().isalnum()


def test_nobody_else_asks_the_computer_for_the_time() -> None:
    found = []
    for path in (path for package in ("sitl", "bridge", "scenarios") for path in ROOT.glob(f"{package}/**/*.py")):
        if path.name == "froude_messages.py":  # generated; nothing in it runs but its tables
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found += [path.relative_to(ROOT).as_posix() for name in names if name.split(".")[0] == "time"]
    assert found == ["bridge/clock.py"]
