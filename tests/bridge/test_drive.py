"""How a client lets time pass, and when it gives a vehicle up: on a clock of the test's own."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bridge.clock import SimClock
from bridge.drive import NetworkDrive, SharedDrive
from bridge.errors import PeerLost, PeerSilent
from bridge.link import Link, MemoryLink


class WallClock:
    """Wall time that passes only when it is told to."""

    def __init__(self) -> None:
        self.us = 1_000_000_000

    def now_us(self) -> int:
        return self.us

    def sleep_until_us(self, time_us: int) -> int:
        self.us = max(self.us, time_us)
        return 0


class SlowLink(Link):
    """A link whose `recv` takes as long as it is asked to wait, unless something is there."""

    def __init__(self, wall: WallClock) -> None:
        super().__init__("udpin://127.0.0.1:14540")
        self.wall = wall
        self.inbox: list[bytes] = []
        self.on_recv: Callable[[], object] = lambda: None

    def send(self, data: bytes) -> None: ...

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        self.on_recv()
        if self.inbox:
            self.wall.us += 100
            return self.inbox.pop(0)
        self.wall.us += round(timeout_s * 1e6)
        return None

    def close(self) -> None: ...


@pytest.fixture
def wall() -> WallClock:
    return WallClock()


@pytest.fixture
def link(wall: WallClock) -> SlowLink:
    return SlowLink(wall)


def wait_long(drive: NetworkDrive, link: SlowLink, wall: WallClock, seconds: float = 60.0) -> float:
    """Wait until the drive gives up; s it took."""
    start = wall.us
    while wall.us - start < seconds * 1e6:
        drive.wait(link, 0)
    pytest.fail("never gave up")


class TestShared:
    def test_a_wait_is_a_tick_and_ends_when_something_comes(self) -> None:
        clock = SimClock(4000)
        near, far = MemoryLink.pair()
        clock.every_tick(lambda: far.send(b"x") if clock.tick % 5 == 0 else None)
        drive = SharedDrive(clock)
        assert drive.knows_time
        assert drive.wait(near, 1_000_000) == b"x"
        assert (drive.now_us(), clock.tick) == (20_000, 5)

    def test_it_never_waits_beyond_what_the_caller_has_to_do_and_always_one_tick(self) -> None:
        clock = SimClock(4000)
        near, _far = MemoryLink.pair()
        drive = SharedDrive(clock)
        assert drive.wait(near, 12_000) is None
        assert drive.now_us() == 12_000
        assert drive.wait(near, 0) is None
        assert drive.now_us() == 16_000


class TestNetwork:
    def test_time_is_the_latest_that_was_heard(self, wall: WallClock) -> None:
        drive = NetworkDrive(clock=wall)
        assert (drive.now_us(), drive.knows_time) == (0, False)
        drive.heard(7_000_000)
        drive.heard(6_996_000)  # an older datagram that took longer
        assert (drive.now_us(), drive.knows_time) == (7_000_000, True)

    def test_a_vehicle_may_tell_that_its_time_is_zero(self, wall: WallClock) -> None:
        drive = NetworkDrive(clock=wall)
        drive.heard(0)
        assert drive.knows_time

    def test_nobody_there(self, wall: WallClock, link: SlowLink) -> None:
        drive = NetworkDrive(2.0, clock=wall)
        start = wall.us
        with pytest.raises(PeerSilent, match=r"udpin://127\.0\.0\.1:14540: no sign of .* within 2 s.*vehicle running"):
            wait_long(drive, link, wall)
        assert 2.0 <= (wall.us - start) * 1e-6 < 2.1

    def test_somebody_who_is_no_vehicle(self, wall: WallClock, link: SlowLink) -> None:
        drive = NetworkDrive(2.0, clock=wall)
        link.inbox = [b"garbage"] * 100_000
        with pytest.raises(PeerSilent, match=r"something does send here.*component 1"):
            wait_long(drive, link, wall)

    def test_a_vehicle_that_falls_silent(self, wall: WallClock, link: SlowLink) -> None:
        drive = NetworkDrive(2.0, clock=wall)
        for k in range(500):
            drive.heard(4000 * k)
            drive.wait(link, 0)
        with pytest.raises(PeerLost, match=r"udpin://127\.0\.0\.1:14540 went away: nothing new .* for 2 s"):
            wait_long(drive, link, wall)

    def test_a_vehicle_whose_clock_stands_still_is_as_good_as_gone(self, wall: WallClock, link: SlowLink) -> None:
        drive = NetworkDrive(2.0, clock=wall)
        drive.heard(5_000_000)
        link.inbox = [b"x"] * 100_000
        link.on_recv = lambda: drive.heard(5_000_000)
        with pytest.raises(PeerLost):
            wait_long(drive, link, wall)

    def test_a_restart_is_noticed(self, wall: WallClock) -> None:
        drive = NetworkDrive(clock=wall)
        drive.heard(27_000_000)
        with pytest.raises(PeerLost, match=r"from 27\.0 s to 0\.1 s, so it has restarted"):
            drive.heard(100_000)

    def test_a_pause_of_this_computer_is_no_silence_of_the_vehicle(self, wall: WallClock, link: SlowLink) -> None:
        drive = NetworkDrive(2.0, clock=wall)
        drive.heard(1_000_000)
        drive.wait(link, 0)
        wall.us += 3_600_000_000
        for _ in range(50):
            drive.wait(link, 0)
