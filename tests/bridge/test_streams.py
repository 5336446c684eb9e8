from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.streams import HEARTBEAT_ID, OFF, STREAMS, Schedule

TICK_US = 4000
ATTITUDE, ATTITUDE_TARGET, SYS_STATUS, HIGHRES_IMU, ORIGIN, ESC_INFO = 30, 83, 1, 105, 49, 290


class Stub:
    """A source that counts set-points; every message is built from it without a vehicle."""

    def __init__(self) -> None:
        self.autopilot = SimpleNamespace(attitude_sp_count=0)
        self.vehicle: Any = SimpleNamespace(autopilot=self.autopilot)


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> Any:
    for stream in tuple(STREAMS.values()):
        builds(monkeypatch, stream.message_id, lambda _: {})
    return Stub()


def builds(monkeypatch: pytest.MonkeyPatch, message_id: int, build: Callable[[Any], Any]) -> None:
    """Let a message be built by `build`."""
    monkeypatch.setitem(STREAMS, message_id, replace(STREAMS[message_id], build=build))


def only(message_id: int, interval_us: int, now_us: int = 0) -> Schedule:
    """A schedule that streams one message and HEARTBEAT."""
    schedule = Schedule("gcs", now_us)
    for other in STREAMS:
        if other not in (HEARTBEAT_ID, message_id):
            schedule.set_interval(other, OFF, now_us)
    schedule.set_interval(message_id, interval_us, now_us)
    return schedule


def fly(schedule: Schedule, source: Any, ticks: int, tick_us: int = TICK_US, start: int = 0) -> Counter[str]:
    sent: Counter[str] = Counter()
    for tick in range(start, start + ticks):
        schedule.run(tick * tick_us, source, lambda name, _: sent.update([name]))
    return sent


@settings(max_examples=60, deadline=None)
@given(tick_us=st.sampled_from([1000, 1250, 4000]), factor=st.floats(1.0, 40.0), ticks=st.integers(200, 2000))
def test_any_rate_up_to_the_tick_rate_is_achieved_exactly(tick_us: int, factor: float, ticks: int) -> None:
    interval_us = int(tick_us * factor)
    with pytest.MonkeyPatch.context() as patch:
        for message_id in (HEARTBEAT_ID, ATTITUDE):
            builds(patch, message_id, lambda _: {})
        sent = fly(only(ATTITUDE, interval_us), Stub(), ticks, tick_us)
    # One at time zero, then one per whole interval that has passed by the last tick.
    assert sent["ATTITUDE"] == (ticks - 1) * tick_us // interval_us + 1


def test_faster_than_the_tick_gives_one_per_tick_and_no_backlog(source: Any) -> None:
    schedule = only(ATTITUDE, 1)
    assert fly(schedule, source, 500)["ATTITUDE"] == 500
    # A gap in which nobody ran the schedule is not made up for.
    assert fly(schedule, source, 10, start=5000)["ATTITUDE"] == 10


def test_nothing_is_built_when_nothing_is_due(source: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[Any] = []
    builds(monkeypatch, SYS_STATUS, built.append)
    schedule = only(SYS_STATUS, 1_000_000)
    fly(schedule, source, 250)
    assert len(built) == 1


def test_heartbeat_is_the_first_thing_said(source: Any) -> None:
    order: list[str] = []
    Schedule("gcs").run(0, source, lambda name, _: order.append(name))
    assert order[0] == "HEARTBEAT"


def test_a_message_with_nothing_to_send_keeps_its_place(source: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    builds(monkeypatch, SYS_STATUS, lambda _: None)
    schedule = only(SYS_STATUS, 100_000)
    assert fly(schedule, source, 250)["SYS_STATUS"] == 0
    assert schedule.interval_us(SYS_STATUS) == 100_000


class TestIntervals:
    def test_default_is_the_mode_s_rate_and_not_the_simulator_s(self) -> None:
        schedule = Schedule("gcs")
        assert schedule.interval_us(ATTITUDE) == 20_000
        schedule.set_interval(ATTITUDE, 0, 0)
        assert schedule.interval_us(ATTITUDE) == 66_666  # as a PX4 answered

    def test_default_of_an_onboard_link(self) -> None:
        schedule = Schedule("onboard")
        schedule.set_interval(ATTITUDE, 123_456, 0)
        schedule.set_interval(ATTITUDE, 0, 0)
        assert schedule.interval_us(ATTITUDE) == 10_000

    def test_default_of_what_a_mode_does_not_stream_is_off(self) -> None:
        schedule = Schedule("gcs")
        schedule.set_interval(HIGHRES_IMU, 100_000, 0)
        assert schedule.interval_us(HIGHRES_IMU) == 100_000
        schedule.set_interval(HIGHRES_IMU, 0, 0)
        assert schedule.interval_us(HIGHRES_IMU) == OFF

    def test_memory_starts_like_onboard_without_what_nobody_looks_at(self) -> None:
        memory, onboard = Schedule("memory").intervals(), Schedule("onboard").intervals()
        unwatched = {
            "ESC_INFO",
            "ESC_STATUS",
            "OPEN_DRONE_ID_LOCATION",
            "OPEN_DRONE_ID_SYSTEM",
            "POSITION_TARGET_GLOBAL_INT",
        }
        assert set(onboard) - set(memory) == unwatched
        assert memory == {name: interval_us for name, interval_us in onboard.items() if name not in unwatched}

    def test_default_of_a_memory_link(self) -> None:
        schedule = Schedule("memory")
        for message_id, interval_us in ((ATTITUDE, 10_000), (ESC_INFO, OFF)):
            schedule.set_interval(message_id, 123_456, 0)
            schedule.set_interval(message_id, 0, 0)
            assert schedule.interval_us(message_id) == interval_us

    def test_off_stops_and_on_starts_with_the_next_tick(self, source: Any) -> None:
        schedule = only(ATTITUDE, TICK_US)
        fly(schedule, source, 10)
        schedule.set_interval(ATTITUDE, OFF, 10 * TICK_US)
        assert fly(schedule, source, 100, start=10)["ATTITUDE"] == 0
        schedule.set_interval(ATTITUDE, 50_000, 110 * TICK_US)
        assert fly(schedule, source, 1, start=110)["ATTITUDE"] == 1

    def test_other_messages_keep_their_phase(self, source: Any) -> None:
        schedule = only(ATTITUDE, 20_000)
        schedule.set_interval(SYS_STATUS, 100_000, 0)
        fly(schedule, source, 3)
        schedule.set_interval(HIGHRES_IMU, 40_000, 3 * TICK_US)
        sent = fly(schedule, source, 48, start=3)  # up to 0.2 s
        assert sent["ATTITUDE"] == 10
        assert sent["SYS_STATUS"] == 2

    def test_unknown_message(self) -> None:
        with pytest.raises(KeyError):
            Schedule("gcs").set_interval(77, 1000, 0)


class TestAttitudeTarget:
    def test_is_sent_once_per_new_set_point(self, source: Any) -> None:
        schedule = only(ATTITUDE_TARGET, TICK_US)
        fly(schedule, source, 1)
        sent: list[int] = []
        for tick in range(1, 101):
            if tick % 5 == 0:
                source.autopilot.attitude_sp_count += 1
            schedule.run(tick * TICK_US, source, lambda name, _, t=tick: sent.append(t) if name != "HEARTBEAT" else 0)
        assert sent == list(range(5, 101, 5))

    def test_is_limited_by_its_interval(self, source: Any) -> None:
        schedule = only(ATTITUDE_TARGET, 20_000)
        sent = 0

        def count(name: str, _: Any) -> None:
            nonlocal sent
            sent += name == "ATTITUDE_TARGET"

        for tick in range(500):
            source.autopilot.attitude_sp_count += 1
            schedule.run(tick * TICK_US, source, count)
        assert sent == 100

    def test_follows_the_rate_set_points_after_half_a_second_without(self, source: Any) -> None:
        schedule = only(ATTITUDE_TARGET, 20_000)
        early = fly(schedule, source, 125)["ATTITUDE_TARGET"]
        assert early == 1
        late = fly(schedule, source, 250, start=125)["ATTITUDE_TARGET"]
        assert late == 50


def test_the_origin_is_said_once(source: Any) -> None:
    assert fly(only(ORIGIN, 0), source, 2500)["GPS_GLOBAL_ORIGIN"] == 1
