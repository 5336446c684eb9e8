"""A client's time where every wait is ticks of a plant that an autopilot flies."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from px4_stand_in import StandIn

from bridge.errors import PeerLost, PeerSilent
from bridge.hil_drive import BEHIND_REST_US, BEHIND_US, HilDrive
from bridge.link import MemoryLink
from bridge.lockstep import Lockstep
from bridge.simulator import Simulator
from bridge.tcp_link import TcpLink
from sitl.body import START_US, Body
from sitl.profile import get_profile
from sitl.vehicle_spec import resolve_vehicle

LEVEL, TILTED = (1.0, 0.0, 0.0, 0.0), (0.99, 0.1, 0.0, 0.0)


@pytest.fixture
def port() -> Iterator[TcpLink]:
    with TcpLink.listen("127.0.0.1", 0) as link:
        yield link


def drive(port: TcpLink, patience_s: float = 30.0) -> HilDrive:
    body = Body(resolve_vehicle("ant-x"), get_profile("sitl"))
    return HilDrive(Lockstep(port, Simulator(body, truth=True), answer_s=30.0), patience_s)


def test_a_wait_is_ticks_and_each_is_seen(port: TcpLink) -> None:
    near, _ = MemoryLink.pair()
    one = drive(port)
    ticks: list[int] = []
    one.each_tick = lambda: ticks.append(one.now_us())
    with StandIn(port.port):
        assert one.wait(near, START_US + 2_000_000) is None
    assert one.now_us() == START_US + 2_000_000
    assert ticks == [START_US + 4000 * k for k in range(1, 501)]


def test_it_ends_when_something_comes_one_tick_at_least(port: TcpLink) -> None:
    near, far = MemoryLink.pair()
    one = drive(port)
    with StandIn(port.port):
        one.wait(near, START_US + 400_000)
        before_us = one.now_us()
        far.send(b"news")
        assert one.wait(near, before_us + 400_000) == b"news"
        assert one.now_us() == before_us + 4000
        one.wait(near, before_us)  # the past: one tick, so that nobody waits for ever
        assert one.now_us() == before_us + 8000


def test_nobody_comes(port: TcpLink) -> None:
    near, _ = MemoryLink.pair()
    with pytest.raises(PeerSilent, match="PX4_SIM_MODEL"):
        drive(port, 0.1).wait(near, START_US + 4000)


def test_its_process_has_ended_before_it_came(port: TcpLink) -> None:
    near, _ = MemoryLink.pair()
    one = drive(port)

    def ended() -> None:
        raise PeerLost("PX4", "it ended with status 7")

    one.alive = ended
    with pytest.raises(PeerLost, match="status 7"):
        one.wait(near, START_US + 4000)


def test_it_leaves_and_nobody_waits_for_it_again(port: TcpLink) -> None:
    near, _ = MemoryLink.pair()
    one = drive(port)
    with StandIn(port.port) as px4:
        one.wait(near, START_US + 1_000_000)
        px4.drop()
        with pytest.raises(PeerLost, match="simulator's port"):
            one.wait(near, START_US + 100_000_000)
    with pytest.raises(PeerLost, match="not back"):
        one.wait(near, START_US + 100_000_000)


def test_its_last_words_are_told(port: TcpLink) -> None:
    near, _ = MemoryLink.pair()
    one = drive(port)
    gone: list[bool] = []

    def alive() -> None:
        if gone:
            raise PeerLost("PX4", "it ended with status 9: PANIC")

    one.alive = alive
    with StandIn(port.port) as px4:
        one.wait(near, START_US + 1_000_000)
        gone.append(True)
        px4.drop()
        with pytest.raises(PeerLost, match="PANIC"):
            one.wait(near, START_US + 100_000_000)


def test_a_changed_set_point_is_there_before_the_next_tick(port: TcpLink) -> None:
    """It is given a moment of wall clock, and an unchanged one none."""
    near, _ = MemoryLink.pair()
    one = drive(port)
    slept: list[int] = []
    wall = one._clock

    class Watched:
        def now_us(self) -> int:
            return wall.now_us()

        def sleep_until_us(self, time_us: int) -> int:
            slept.append(one.now_us())
            return wall.sleep_until_us(time_us)

    one._clock = Watched()
    with StandIn(port.port):
        one.wait(near, START_US + 800_000)
        for quat in (LEVEL, LEVEL, TILTED, TILTED, LEVEL):
            one.sent_setpoint(quat)
            one.wait(near, 0)
    assert [(at - START_US) // 4000 - 200 for at in slept] == [0, 2, 4]


class SlowLink(MemoryLink):
    """Telemetry that comes only to who waits for it, as from a thread that has not run yet."""

    def __init__(self, pieces: int) -> None:
        super().__init__("memory://slow", 10)
        self.pieces = pieces
        self.waited: list[float] = []

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        if timeout_s == 0.0:
            return None
        self.waited.append(timeout_s)
        self.pieces -= 1
        return b"news" if self.pieces >= 0 else None


def test_telemetry_that_is_behind_the_plant_is_waited_for(port: TcpLink) -> None:
    slow, one = SlowLink(pieces=2), drive(port)
    with StandIn(port.port):
        one.wait(slow, START_US + 400_000)  # nothing was heard yet: nothing is late
        assert slow.waited == []
        one.heard(one.now_us())
        assert one.wait(slow, START_US + 10_000_000) == b"news"
        assert one.now_us() == START_US + 400_000 + BEHIND_US
        one.heard(one.now_us() - 20_000)
        assert one.wait(slow, START_US + 10_000_000) == b"news"
        assert one.now_us() == START_US + 400_000 + 2 * BEHIND_US - 20_000


def test_a_stream_that_has_ended_does_not_hold_the_plant_up(port: TcpLink) -> None:
    slow, one = SlowLink(pieces=0), drive(port)
    with StandIn(port.port):
        one.wait(slow, START_US + 400_000)
        one.heard(one.now_us())
        assert one.wait(slow, one.now_us() + 4 * BEHIND_REST_US) is None
    assert len(slow.waited) == 4
