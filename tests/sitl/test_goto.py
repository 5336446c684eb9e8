from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.goto import Way, WayLimits, braking_speed, corner_speed

DT_S = 0.008
LIMITS = WayLimits(5.0, 3.0, 3.0, 1.5, 4.0, 3.0, 4.0, 0.5)
places = st.tuples(*[st.floats(-200.0, 200.0)] * 2, st.floats(-60.0, 60.0))
speeds = st.tuples(*[st.floats(-4.0, 4.0)] * 2, st.floats(-1.5, 1.5))


def flown(way: Way, goal: tuple[float, float, float], seconds: float) -> list[tuple[float, ...]]:
    rows = []
    for _ in range(round(seconds / DT_S)):
        way.step(DT_S, goal, LIMITS)
        rows.append((*way.position, *way.velocity, *way.acceleration))
    return rows


def test_speed_rises_to_cruise_and_the_place_is_reached() -> None:
    way = Way()
    rows = flown(way, (100.0, 0.0, -10.0), 45.0)
    assert max(row[3] for row in rows) == pytest.approx(5.0, abs=0.05)
    assert way.position == pytest.approx([100.0, 0.0, -10.0], abs=0.02)
    assert way.velocity == pytest.approx([0.0, 0.0, 0.0], abs=0.02)


@settings(max_examples=40, deadline=None)
@given(places, speeds)
def test_limits_hold_from_anywhere(goal: tuple[float, float, float], velocity: tuple[float, float, float]) -> None:
    way = Way()
    way.start((0.0, 0.0, 0.0), velocity)
    last = [0.0, 0.0, 0.0]
    fastest = max(5.0, math.hypot(velocity[0], velocity[1]))
    for row in flown(way, goal, 12.0):
        assert math.hypot(row[3], row[4]) <= fastest + 0.05
        assert math.hypot(row[6], row[7]) <= 3.0 + 1e-9
        assert -4.0 - 1e-9 <= row[8] <= 3.0 + 1e-9
        arrived = row[6:] == (0.0, 0.0, 0.0)
        assert arrived or math.hypot(row[6] - last[0], row[7] - last[1]) <= 4.0 * DT_S + 1e-3
        last = list(row[6:])


@settings(max_examples=40, deadline=None)
@given(places, speeds)
def test_every_place_is_reached(goal: tuple[float, float, float], velocity: tuple[float, float, float]) -> None:
    way = Way()
    way.start((0.0, 0.0, 0.0), velocity)
    flown(way, goal, 130.0)
    assert way.position == pytest.approx(list(goal), abs=0.05)


def test_from_rest_it_does_not_overshoot() -> None:
    for distance in (0.5, 3.0, 20.0, 80.0):
        way = Way()
        assert max(row[0] for row in flown(way, (distance, 0.0, 0.0), 40.0)) < distance + 0.05


@pytest.mark.parametrize("distance", [0.1, 1.0, 10.0, 1000.0])
def test_braking_speed_can_be_shed_within_the_distance(distance: float) -> None:
    jerk, acceleration = 4.0, 3.0
    speed = braking_speed(jerk, acceleration, distance)
    # v^2 / (2 a) for the braking and 2 v a / j for building it up: the relation PX4 solves
    assert speed**2 / (2.0 * acceleration) + 2.0 * acceleration * speed / jerk == pytest.approx(distance, rel=1e-9)


def test_corner_speed_grows_with_straightness() -> None:
    ahead = corner_speed((-10.0, 0.0), (10.0, 0.0), 3.0, 2.0)
    right_angle = corner_speed((-10.0, 0.0), (0.0, 10.0), 3.0, 2.0)
    back = corner_speed((-10.0, 0.0), (-10.0, 0.0), 3.0, 2.0)
    assert ahead > 50.0
    assert right_angle == pytest.approx(math.sqrt(6.0), rel=1e-6)
    assert back == pytest.approx(0.0, abs=1e-9)
    assert corner_speed((0.0, 0.0), (1.0, 0.0), 3.0, 2.0) == 0.0
