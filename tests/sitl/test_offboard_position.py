"""Offboard by position, velocity and acceleration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.modes import Mode
from sitl.offboard_motion import offboard_motion, wants_up
from sitl.parameters import ParameterTable
from sitl.setpoints import PositionRequest

NAN, INF = math.nan, math.inf
anything = st.floats(allow_nan=True, allow_infinity=True)
vectors = st.tuples(anything, anything, anything)


@pytest.fixture
def up(flown: Any) -> Any:
    flight = flown()
    flight.run(1.2)
    flight.take_off(10.0)
    return flight


def test_ten_metres_away_without_much_overshoot(up: Any) -> None:
    furthest = 0.0
    up.offboard(position=(10.0, 0.0, -10.0), yaw=0.0)
    for _ in range(300):
        up.run(0.04)
        furthest = max(furthest, up.ned[0])
    assert up.ned == pytest.approx((10.0, 0.0, -10.0), abs=0.2)
    assert furthest < 11.0
    assert up.tilt_max_deg < 46.0


def test_velocity_is_reached_and_the_position_left_free(up: Any) -> None:
    up.offboard(velocity=(3.0, -2.0, -1.0), yaw=0.0)
    up.run(6.0)
    assert up.velocity == pytest.approx((3.0, -2.0, -1.0), abs=0.25)


def test_vertical_speed_is_limited(up: Any) -> None:
    up.offboard(velocity=(0.0, 0.0, -50.0))
    up.run(4.0)
    assert up.velocity[2] == pytest.approx(-3.0, abs=0.1)


def test_velocity_with_a_position_is_fed_forward(up: Any) -> None:
    up.offboard(position=(0.0, 0.0, -10.0), velocity=(1.0, 0.0, 0.0))
    up.run(8.0)
    # at rest where gain times distance cancels it
    assert up.ned[0] == pytest.approx(1.0 / 0.95, abs=0.15)


def test_horizontal_acceleration_is_tilt(up: Any) -> None:
    up.offboard(acceleration=(1.5, 0.0, NAN), velocity=(NAN, NAN, 0.0), yaw=0.0)
    up.run(1.0)
    w, _, y, _ = up.control.attitude_sp.quat
    assert 2.0 * math.degrees(math.atan2(y, w)) == pytest.approx(-math.degrees(math.atan(1.5 / 9.80665)), abs=1e-6)
    assert up.velocity[0] > 0.5


def test_vertical_acceleration_by_itself(up: Any) -> None:
    up.offboard(acceleration=(NAN, NAN, -2.0), velocity=(0.0, 0.0, NAN))
    up.run(0.5)
    assert up.control.attitude_sp.thrust == pytest.approx(up.hover * (1.0 + 2.0 / 9.80665), rel=0.02)


def test_yaw_and_yaw_rate(up: Any) -> None:
    up.offboard(velocity=(0.0, 0.0, 0.0), yaw=1.0)
    up.run(5.0)
    assert math.radians(up.euler_deg[2]) == pytest.approx(1.0, abs=0.05)
    up.offboard(velocity=(0.0, 0.0, 0.0), yaw_rate=0.4)
    up.run(2.0)
    before = up.euler_deg[2]
    up.run(2.0)
    assert math.radians(up.euler_deg[2] - before) == pytest.approx(0.8, abs=0.25)


def test_a_place_beyond_the_world_is_flown_towards_at_the_limit(up: Any) -> None:
    up.offboard(position=(1e9, 0.0, -10.0))
    up.run(15.0)
    assert up.velocity[0] == pytest.approx(12.0, rel=0.05)
    assert abs(up.velocity[1]) < 0.1
    assert up.ned[2] == pytest.approx(-10.0, abs=0.5)


def test_takes_off_from_the_ground_on_a_ramp_and_lands_by_velocity(flown: Any) -> None:
    flight = flown()
    flight.run(2.0)
    flight.offboard(position=(0.0, 0.0, -4.0))
    flight.run(0.2)
    assert flight.control.thrust_sp < 0.3
    flight.run(12.0)
    assert flight.ned == pytest.approx((0.0, 0.0, -4.0), abs=0.3)
    flight.offboard(velocity=(0.0, 0.0, 0.7))
    flight.until(lambda: flight.landing.landed, 20.0)


def test_stays_on_the_ground_unless_asked_up(flown: Any) -> None:
    flight = flown()
    flight.run(2.0)
    flight.offboard(position=(5.0, 0.0, 1.0))
    flight.run(3.0)
    assert flight.landing.landed
    assert flight.control.thrust_sp == 0.0


def test_an_attitude_takes_over_and_back(up: Any) -> None:
    up.offboard(velocity=(2.0, 0.0, 0.0))
    up.run(2.0)
    up.control.take_setpoint(up.now_us, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, NAN), up.hover, fly=True)
    assert not up.control.by_position
    up.run(1.0)
    assert up.control.attitude_sp.quat == (1.0, 0.0, 0.0, 0.0)
    up.offboard(velocity=(0.0, 0.0, 0.0))
    up.run(5.0)
    assert math.hypot(*up.velocity) < 0.2
    assert up.control.attitude_sp.quat != (1.0, 0.0, 0.0, 0.0)


def test_after_stabilized_it_is_in_the_air(flown: Any) -> None:
    from sitl.setpoints import Sticks

    flight = flown(Mode.STABILIZED)
    flight.run(1.2)
    flight.control.sticks = Sticks(throttle=0.3)
    flight.until(lambda: flight.ned[2] < -2.0, 10.0)
    flight.offboard(velocity=(0.0, 0.0, 0.0))
    flight.run(4.0)
    assert flight.control.thrust_sp == pytest.approx(flight.hover, abs=0.05)


def test_attitude_target_is_counted(up: Any) -> None:
    up.offboard(velocity=(0.0, 0.0, 0.0))
    before = up.control.attitude_sp_count
    up.run(0.8)
    assert up.control.attitude_sp_count == before + 100


@pytest.mark.parametrize(
    "wanted",
    [
        {"position": (1e30, -1e30, 1e30)},
        {"velocity": (1e30, INF, -1e30)},
        {"acceleration": (1e30, -1e30, 1e30)},
        {"acceleration": (1e30, -1e30, -1e30)},
        {"position": (NAN, 3.0, -5.0)},
        {"position": (INF, INF, INF)},
        {"velocity": (NAN, NAN, -1.0)},
        {"position": (1.0, 1.0, NAN)},
        {"velocity": (0.0, 0.0, 0.0), "yaw": 1e30, "yaw_rate": -1e30},
        {"velocity": (0.0, 0.0, 0.0), "yaw": INF},
    ],
)
def test_nonsense_never_breaks_the_state(up: Any, wanted: dict[str, Any]) -> None:
    up.offboard(**wanted)
    up.run(1.5)
    assert np.isfinite(up.plant.x).all()
    assert np.isfinite(up.control.state["outputs"]).all()
    assert np.isfinite(up.control._position_state["vel_int"]).all()
    up.begin(Mode.LOITER)
    up.run(8.0)
    assert math.hypot(*up.velocity) < 0.5


@given(vectors, vectors, vectors, anything, anything)
def test_requests_are_made_fit(p: Any, v: Any, a: Any, yaw: float, rate: float) -> None:
    table = ParameterTable()
    request = PositionRequest(p, v, a, yaw, rate)
    wish = offboard_motion(request, lambda name: float(table.get(name)))
    three = (wish.position, wish.velocity, wish.acceleration)
    for axis in range(3):
        assert any(math.isfinite(vector[axis]) for vector in three)
    for vector in three:
        assert math.isfinite(vector[0]) == math.isfinite(vector[1])
        assert not any(math.isinf(x) or abs(x) > 1e6 for x in vector)
    assert not math.isinf(wish.yaw)
    assert not math.isinf(wish.yaw_rate)
    assert isinstance(wants_up(request, 0.0), bool)
