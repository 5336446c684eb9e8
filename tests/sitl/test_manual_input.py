from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.manual_input import RADIO, ManualInput
from sitl.parameters import ParameterTable
from sitl.setpoints import Sticks

STEP_US = 10_000
LEFT, RIGHT = Sticks(roll=-0.5), Sticks(roll=0.5)


class Pilot:
    """Sticks looked at every 10 ms."""

    def __init__(self, **parameters: float) -> None:
        self.parameters = ParameterTable(parameters)
        self.manual = ManualInput(self.parameters)
        self.now_us = 3_000_000

    def take(self, source: int, sticks: Sticks = LEFT) -> bool:
        return self.manual.take(self.now_us, source, sticks)

    def run(self, seconds: float, sticks: Sticks | None = None, source: int = 0) -> list[bool]:
        """Time passes, with sticks every 50 ms if there are any; when they counted as moving."""
        moving = []
        for k in range(round(seconds * 1e6 / STEP_US)):
            if sticks is not None and k % 5 == 0:
                assert self.take(source, sticks)
            self.now_us += STEP_US
            self.manual.update(self.now_us)
            moving.append(self.manual.moving)
        return moving


def test_without_a_pilot_there_are_no_sticks() -> None:
    pilot = Pilot()
    assert not any(pilot.run(1.0))
    assert pilot.manual.sticks is None


@pytest.mark.parametrize(
    ("mode", "radio", "joystick"),
    [
        (0, True, False),
        (1, False, True),
        (2, True, True),
        (3, True, True),
        (4, False, False),
        (5, True, True),
        (6, True, True),
        (7, True, True),
        (8, True, True),
        (9, False, False),
        (-1, False, False),
    ],
)
def test_com_rc_in_mode_says_who_may_fly(mode: int, radio: bool, joystick: bool) -> None:
    for source, allowed in ((RADIO, radio), (0, joystick), (1, joystick)):
        pilot = Pilot(COM_RC_IN_MODE=mode)
        assert pilot.take(source) is allowed
        assert (pilot.manual.sticks == LEFT) is allowed


@pytest.mark.parametrize("wait_s", [0.5, 0.1, 3.0])
def test_sticks_are_lost_after_com_rc_loss_t(wait_s: float) -> None:
    pilot = Pilot(COM_RC_LOSS_T=wait_s)
    pilot.take(0)
    pilot.run(wait_s - 0.02)
    assert pilot.manual.sticks == LEFT
    pilot.run(0.05)
    assert pilot.manual.sticks is None


class TestTwoSources:
    @pytest.mark.parametrize("mode", [2, 3])
    @pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 0), (0, RADIO), (RADIO, 0)])
    def test_the_first_that_speaks_keeps_the_vehicle(self, mode: int, first: int, second: int) -> None:
        pilot = Pilot(COM_RC_IN_MODE=mode)
        for _ in range(20):
            assert pilot.take(first, LEFT)
            pilot.run(0.1)
            assert not pilot.take(second, RIGHT)
            assert pilot.manual.sticks == LEFT

    @pytest.mark.parametrize(("mode", "taken"), [(2, True), (3, False)])
    def test_when_it_falls_silent_another_takes_over_unless_only_the_first_counts(self, mode: int, taken: bool) -> None:
        pilot = Pilot(COM_RC_IN_MODE=mode)
        pilot.take(RADIO, LEFT)
        pilot.run(0.6)
        assert pilot.take(0, RIGHT) is taken
        assert pilot.manual.sticks == (RIGHT if taken else None)

    @pytest.mark.parametrize(
        ("mode", "ranking"), [(5, (RADIO, 0, 1)), (6, (0, 1, RADIO)), (7, (RADIO, 1, 0)), (8, (1, 0, RADIO))]
    )
    def test_a_source_that_ranks_higher_takes_over_at_once(self, mode: int, ranking: tuple[int, ...]) -> None:
        pilot = Pilot(COM_RC_IN_MODE=mode)
        for place in (2, 1, 0):
            assert pilot.take(ranking[place])
            pilot.run(0.05)
        for lower in ranking[1:]:
            assert not pilot.take(lower, RIGHT)
        assert pilot.manual.sticks == LEFT
        pilot.run(0.6)
        assert pilot.take(ranking[2], RIGHT)

    def test_another_pilots_sticks_are_no_movement(self) -> None:
        pilot = Pilot(COM_RC_IN_MODE=6)
        pilot.run(2.0, Sticks(throttle=-1.0), source=1)
        assert not any(pilot.run(2.0, Sticks(throttle=1.0), source=0))

    def test_a_source_that_is_no_longer_allowed_is_replaced_at_once(self) -> None:
        pilot = Pilot(COM_RC_IN_MODE=2)
        pilot.take(0)
        pilot.parameters.set("COM_RC_IN_MODE", 0)
        assert not pilot.take(0)
        assert pilot.take(RADIO, RIGHT)
        assert pilot.manual.sticks == RIGHT


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", range(4))
def test_sticks_that_are_no_numbers_are_refused(value: float, axis: int) -> None:
    pilot = Pilot()
    assert pilot.take(0, LEFT)
    assert not pilot.take(0, Sticks(*(value if axis == i else 0.0 for i in range(4))))
    assert pilot.manual.sticks == LEFT


def test_sticks_beyond_their_travel_are_held_at_it() -> None:
    pilot = Pilot()
    assert pilot.take(0, Sticks(2.0, -3.0, 1.0, 1e30))
    assert pilot.manual.sticks == Sticks(1.0, -1.0, 1.0, 1.0)


class TestMoving:
    @pytest.mark.parametrize("axis", ["roll", "pitch", "yaw", "throttle"])
    @pytest.mark.parametrize(("to", "moves"), [(0.25, False), (-0.25, False), (0.35, True), (-0.35, True)])
    def test_begins_beyond_com_rc_stick_ov_on_any_axis(self, axis: str, to: float, moves: bool) -> None:
        pilot = Pilot()
        assert not any(pilot.run(2.0, Sticks()))
        assert any(pilot.run(1.0, Sticks()._replace(**{axis: to}))) is moves

    def test_the_limit_is_a_parameter(self) -> None:
        pilot = Pilot(COM_RC_STICK_OV=80.0)
        pilot.run(1.0, Sticks())
        assert not any(pilot.run(1.0, Sticks(roll=0.75)))
        assert any(pilot.run(1.0, Sticks(roll=-0.75)))

    def test_passes_once_they_stay_where_they_are(self) -> None:
        pilot = Pilot()
        pilot.run(1.0, Sticks())
        moved = pilot.run(3.0, Sticks(roll=1.0))
        assert moved[2]
        assert not any(moved[150:])

    def test_a_slow_drift_is_none(self) -> None:
        pilot = Pilot()
        for k in range(100):
            assert not any(pilot.run(0.1, Sticks(roll=-1.0 + 0.02 * k)))

    def test_sticks_that_appear_or_come_back_are_none(self) -> None:
        pilot = Pilot()
        assert not any(pilot.run(1.0, Sticks(throttle=-1.0)))
        pilot.run(2.0)
        assert not any(pilot.run(1.0, Sticks(1.0, 1.0, 1.0, 1.0)))


NUMBER = st.floats(width=32) | st.floats(-1.0, 1.0)


@given(
    steps=st.lists(
        st.tuples(st.integers(-1, 3), st.tuples(NUMBER, NUMBER, NUMBER, NUMBER), st.integers(0, 2_000_000)), max_size=12
    ),
    loss_s=NUMBER,
    stick_ov=NUMBER,
    mode=st.integers(-2, 10),
)
def test_whatever_comes_sticks_stay_within_their_travel(
    steps: list[tuple[int, tuple[float, ...], int]], loss_s: float, stick_ov: float, mode: int
) -> None:
    pilot = Pilot()
    for name, value in (("COM_RC_LOSS_T", loss_s), ("COM_RC_STICK_OV", stick_ov), ("COM_RC_IN_MODE", mode)):
        pilot.parameters.set(name, value)
    for source, sticks, wait_us in steps:
        pilot.take(source, Sticks(*sticks))
        assert pilot.manual.sticks is None or all(-1.0 <= stick <= 1.0 for stick in pilot.manual.sticks)
        pilot.now_us += wait_us
        pilot.manual.update(pilot.now_us)
