"""A link that gets worse and better again in vehicle time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.clock import SimClock
from bridge.drive import NetworkDrive, SharedDrive
from bridge.faulty_link import FaultyLink, LinkFault
from bridge.link import MemoryLink

MANY = 4000


class Wire:
    """Ground and vehicle with a faulty link between them, and the time."""

    def __init__(self, seed: int = 1) -> None:
        near, self.vehicle = MemoryLink.pair()
        self.now_us = 0
        self.ground = FaultyLink(near, lambda: self.now_us, seed)

    def up(self, count: int = MANY) -> list[bytes]:
        """Send numbered datagrams to the vehicle; what it gets."""
        for n in range(count):
            self.ground.send(n.to_bytes(4, "big"))
        return list(iter(self.vehicle.recv, None))

    def down(self, count: int = MANY) -> list[bytes]:
        """... from the vehicle; what the ground gets."""
        for n in range(count):
            self.vehicle.send(n.to_bytes(4, "big"))
        return list(iter(self.ground.recv, None))


ALL = [n.to_bytes(4, "big") for n in range(MANY)]


def within(share: float, count: int, of: int) -> bool:
    """Within five standard deviations of a binomial distribution?"""
    return abs(count - share * of) < 5.0 * math.sqrt(of * share * (1.0 - share))


def test_without_a_fault_everything_passes_as_it_is() -> None:
    wire = Wire()
    assert wire.up() == ALL
    assert wire.down() == ALL


@pytest.mark.parametrize("share", [0.05, 0.3, 0.9])
def test_the_share_that_is_lost_is_the_share_asked_for_either_way(share: float) -> None:
    wire = Wire()
    wire.ground.begin(0, LinkFault(loss=share))
    up, down = wire.up(), wire.down()
    assert within(share, MANY - len(up), MANY)
    assert within(share, MANY - len(down), MANY)
    assert up != down
    assert wire.ground.datagrams(0) == (2 * MANY, 2 * MANY - len(up) - len(down))
    wire.ground.end(0)
    assert wire.up() == ALL
    assert wire.ground.datagrams(0)[0] == 2 * MANY  # what passed after it is not counted


@pytest.mark.parametrize("up", [True, False])
def test_one_direction_can_fail_alone(up: bool) -> None:
    wire = Wire()
    wire.ground.begin(0, LinkFault(loss=1.0, to_vehicle=up, from_vehicle=not up))
    assert wire.up() == ([] if up else ALL)
    assert wire.down() == (ALL if up else [])


def test_doubled_reordered_and_changed_in_their_shares() -> None:
    wire = Wire()
    wire.ground.begin(0, LinkFault(duplicate=0.3))
    assert within(0.3, len(wire.up()) - MANY, MANY)
    wire.ground.end(0)
    wire.ground.begin(1, LinkFault(corrupt=0.3))
    changed = wire.up()
    assert within(0.3, sum(a != b for a, b in zip(changed, ALL, strict=True)), MANY)
    wire.ground.end(1)
    wire.ground.begin(2, LinkFault(reorder=0.3))
    swapped = wire.up()
    late = sum(a > b for a, b in itertools.pairwise(swapped))
    # one that is held back when the one before is, too, passes: p / (1 + p) of them come late
    assert within(0.3 / 1.3, late, MANY)
    wire.ground.end(2)  # the one that is held back, if there is one, goes on
    assert sorted(swapped + list(iter(wire.vehicle.recv, None))) == ALL


def test_late_by_so_much_and_in_order() -> None:
    wire = Wire()
    wire.ground.begin(0, LinkFault(delay_us=100_000))
    wire.ground.send(b"up")
    wire.vehicle.send(b"down")
    for wire.now_us in range(0, 100_000, 4_000):
        assert wire.ground.recv() is None
        assert wire.vehicle.recv() is None
    wire.now_us = 100_000
    assert wire.ground.recv() == b"down"
    assert wire.vehicle.recv() == b"up"
    assert wire.ground.datagrams(0) == (2, 2)


def test_what_is_on_its_way_when_the_delay_ends_still_comes_and_is_overtaken() -> None:
    wire = Wire()
    wire.ground.begin(0, LinkFault(delay_us=100_000))
    wire.ground.send(b"late")
    wire.ground.end(0)
    wire.ground.send(b"prompt")
    assert wire.vehicle.recv() == b"prompt"
    wire.now_us = 100_000
    assert wire.ground.recv() is None
    assert wire.vehicle.recv() == b"late"


def test_jitter_is_even_and_overtakes() -> None:
    wire = Wire()
    wire.ground.begin(0, LinkFault(jitter_us=100_000))
    for n in range(MANY):
        wire.ground.send(n.to_bytes(4, "big"))
    came: list[tuple[int, bytes]] = []
    for wire.now_us in range(0, 104_000, 4_000):
        wire.ground.recv()
        came += [(wire.now_us, data) for data in iter(wire.vehicle.recv, None)]
    assert sorted(data for _, data in came) == ALL
    assert [data for _, data in came] != ALL
    late = np.array([time_us for time_us, _ in came])
    assert late.mean() == pytest.approx(52_000, rel=0.05)  # half of it, and half a look


def test_faults_of_one_time_work_one_after_the_other() -> None:
    wire = Wire()
    wire.ground.begin(0, LinkFault(duplicate=1.0))
    wire.ground.begin(1, LinkFault(loss=0.5))
    assert within(0.5, len(wire.up()), 2 * MANY)
    assert wire.ground.datagrams(1)[0] == 2 * MANY


def test_the_same_seed_does_the_same_whatever_else_is_going_on() -> None:
    plain, busy = Wire(seed=3), Wire(seed=3)
    plain.ground.begin(4, LinkFault(loss=0.3))
    busy.ground.begin(2, LinkFault(delay_us=1, to_vehicle=False))
    busy.ground.begin(4, LinkFault(loss=0.3))
    busy.down()
    assert plain.up() == busy.up()
    other = Wire(seed=4)
    other.ground.begin(4, LinkFault(loss=0.3))
    assert other.up() != plain.up()


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.builds(
                LinkFault,
                loss=st.sampled_from([0.0, 0.3]),
                duplicate=st.sampled_from([0.0, 0.3]),
                reorder=st.sampled_from([0.0, 0.5]),
                delay_us=st.integers(0, 20_000),
                jitter_us=st.integers(0, 20_000),
                to_vehicle=st.booleans(),
                from_vehicle=st.booleans(),
            ),
            st.integers(0, 40),
            st.integers(0, 40),
        ),
        max_size=5,
    )
)
def test_whatever_comes_and_goes_nothing_is_made_up_and_nothing_stays(
    plan: list[tuple[LinkFault, int, int]],
) -> None:
    wire = Wire()
    up, down = [], []
    for tick in range(80):
        wire.now_us = 1000 * tick
        for number, (fault, begin, length) in enumerate(plan):
            if tick == begin:
                wire.ground.begin(number, fault)
            if tick == begin + length + 1:
                wire.ground.end(number)
        wire.ground.send(b"%d" % tick)
        wire.vehicle.send(b"%d" % tick)
        down += list(iter(wire.ground.recv, None))
        up += list(iter(wire.vehicle.recv, None))
    for number in range(len(plan)):
        wire.ground.end(number)
    wire.now_us += 200_000
    down += list(iter(wire.ground.recv, None))
    up += list(iter(wire.vehicle.recv, None))
    sent = {b"%d" % tick for tick in range(80)}
    for came, way in ((up, "to_vehicle"), (down, "from_vehicle")):
        assert set(came) <= sent
        faults = [fault for fault, _, _ in plan if getattr(fault, way)]
        if not any(fault.loss for fault in faults):
            assert set(came) == sent
        if not any(fault.duplicate for fault in faults):
            assert len(came) == len(set(came))


def test_a_shared_clock_is_looked_at_after_every_tick_and_not_any_more() -> None:
    clock, seen = SimClock(4000), []
    drive = SharedDrive(clock)
    drive.watch(seen.append)
    near, _ = MemoryLink.pair()
    drive.wait(near, 20_000)
    assert seen == [4000, 8000, 12_000, 16_000, 20_000]
    drive.watch(None)
    drive.wait(near, 40_000)
    assert len(seen) == 5


def test_over_a_network_time_runs_on_while_nothing_is_heard() -> None:
    class Wall:
        now = 5_000_000

        def now_us(self) -> int:
            return self.now

        def sleep_until_us(self, time_us: int) -> int:
            return 0

    wall, seen = Wall(), []
    drive = NetworkDrive(clock=wall)
    assert drive.running_us() == 0
    drive.heard(10_000_000)
    wall.now += 300_000
    drive.watch(seen.append)
    drive.wait(MemoryLink.pair()[0], 0)
    assert (drive.now_us(), seen) == (10_000_000, [10_300_000])
    drive.heard(10_100_000)  # it was late: time does not go back
    assert (drive.now_us(), drive.running_us(), drive.wire_us()) == (10_100_000, 10_300_000, wall.now)
    wall.now += 300_000
    assert drive.running_us() == 10_400_000
