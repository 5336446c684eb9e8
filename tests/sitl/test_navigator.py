"""Hold that is sent somewhere, and what the navigator shows of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sitl.modes import Mode
from sitl.sensors import geodetic
from sitl.setpoints import Reposition
from sitl.takeoff import TakeoffState

NAN = math.nan


@pytest.fixture
def up(flown: Any) -> Any:
    """In Hold, 10 m up."""
    flight = flown()
    flight.run(1.2)
    flight.take_off(10.0)
    return flight


def send(flight: Any, n: float, e: float, height_m: float, yaw: float = NAN, speed_m_s: float = NAN) -> None:
    lat, lon, amsl = geodetic((n, e, -height_m))
    flight.control.navigator.reposition(Reposition(lat, lon, amsl, yaw, speed_m_s))


def test_goes_there_at_cruise_speed_and_faces_the_way(up: Any) -> None:
    send(up, 0.0, 50.0, 15.0)
    up.run(7.0)
    assert math.hypot(*up.velocity[:2]) == pytest.approx(5.0, abs=0.2)
    assert up.euler_deg[2] == pytest.approx(90.0, abs=8.0)
    assert up.control.navigator.target_ned == pytest.approx((0.0, 50.0, -15.0), abs=1e-3)
    up.run(15.0)
    assert up.ned == pytest.approx((0.0, 50.0, -15.0), abs=0.3)
    assert up.tilt_max_deg < 30.0
    assert up.mode is Mode.LOITER


def test_speed_of_the_wish_and_of_the_pilot(up: Any) -> None:
    send(up, 80.0, 0.0, 10.0, speed_m_s=8.0)
    up.run(8.0)
    assert up.velocity[0] == pytest.approx(8.0, abs=0.3)
    up.control.navigator.cruise_m_s = 2.0
    up.run(8.0)
    assert up.velocity[0] == pytest.approx(2.0, abs=0.3)


def test_what_is_not_given_stays(up: Any) -> None:
    up.control.navigator.reposition(Reposition(NAN, NAN, 488.0 + 14.0, NAN, NAN))
    up.run(8.0)
    assert up.ned == pytest.approx((0.0, 0.0, -14.0), abs=0.3)
    lat, lon, _ = geodetic((10.0, 0.0, 0.0))
    up.control.navigator.reposition(Reposition(lat, lon, NAN, NAN, -1.0))
    up.run(10.0)
    assert up.ned == pytest.approx((10.0, 0.0, -14.0), abs=0.3)


def test_a_heading_is_turned_to_at_a_limited_rate(up: Any) -> None:
    up.control.navigator.reposition(Reposition(NAN, NAN, NAN, math.radians(170.0), NAN))
    fastest = 0.0
    for _ in range(100):
        up.run(0.1)
        fastest = max(fastest, abs(math.degrees(up.plant.rates[2])))
    assert abs(up.euler_deg[2]) == pytest.approx(170.0, abs=3.0)
    assert fastest < 75.0
    assert up.distance(0.0, 0.0) < 0.3


def test_on_the_ground_nothing_happens(flown: Any) -> None:
    flight = flown()
    flight.run(2.0)
    send(flight, 20.0, 0.0, 10.0)
    flight.run(3.0)
    assert flight.landing.landed
    assert flight.control.navigator.state is TakeoffState.READY
    flight.take_off(4.0)
    assert flight.distance(0.0, 0.0) < 0.5


def test_leaving_hold_forgets_the_place(up: Any) -> None:
    send(up, 100.0, 0.0, 10.0)
    up.run(3.0)
    up.begin(Mode.POSCTL)
    up.run(4.0)
    up.begin(Mode.LOITER)
    place = up.ned
    up.run(6.0)
    assert math.dist(up.ned, place) < 0.5


@pytest.mark.parametrize("value", [NAN, math.inf, -math.inf, 1e30, -1e30, 1e9])
def test_nonsense_never_breaks_the_state(up: Any, value: float) -> None:
    up.control.navigator.cruise_m_s = value
    up.control.navigator.reposition(Reposition(value, value, value, value, value))
    up.run(3.0)
    assert np.isfinite(up.plant.x).all()
    assert math.hypot(*up.velocity[:2]) < 12.5
    up.begin(Mode.LOITER)
    up.run(8.0)
    assert math.hypot(*up.velocity) < 0.5


@pytest.mark.parametrize("value", [NAN, 0.0, -5.0, math.inf])
def test_senseless_limits_never_break_the_state(up: Any, value: float) -> None:
    for name in ("MPC_XY_CRUISE", "MPC_JERK_AUTO", "MPC_XY_TRAJ_P", "MPC_YAWRAUTO_MAX", "NAV_ACC_RAD"):
        up.parameters.set(name, value)
    send(up, 30.0, 30.0, 12.0)
    up.run(4.0)
    assert np.isfinite(up.plant.x).all()


@pytest.mark.parametrize(("radius_m", "sense"), [(10.0, 1.0), (-10.0, -1.0)])
def test_orbits(up: Any, radius_m: float, sense: float) -> None:
    up.begin(Mode.ORBIT)
    lat, lon, _ = geodetic((15.0, 0.0, 0.0))
    up.control.navigator.orbit(Reposition(lat, lon, NAN, NAN, 3.0), radius_m)
    up.until(lambda: up.control.navigator.track.turned_rad > 1.0, 40.0)
    turned = 0.0
    for _ in range(100):
        before = math.atan2(up.ned[1], up.ned[0] - 15.0)
        up.run(0.1)
        turned += math.remainder(math.atan2(up.ned[1], up.ned[0] - 15.0) - before, math.tau)
        assert up.distance(15.0, 0.0) == pytest.approx(10.0, abs=0.6)
    assert turned == pytest.approx(sense * 3.0, abs=0.2)
    assert math.hypot(*up.velocity[:2]) == pytest.approx(3.0, abs=0.2)
    to_centre = math.degrees(math.atan2(-up.ned[1], 15.0 - up.ned[0]))
    assert abs(math.remainder(up.euler_deg[2] - to_centre, 360.0)) < 20.0


def test_no_target_while_the_motors_are_off(up: Any) -> None:
    assert up.control.navigator.target_ned == pytest.approx((0.0, 0.0, -10.0), abs=0.2)
    up.control.navigator.on_disarm()
    assert up.control.navigator.target_ned is None
