"""Sticks flown: Stabilized, Acro, Altitude, Position."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.modes import Mode
from sitl.rotation import from_euler, to_euler
from sitl.setpoints import Sticks

NAN = math.nan


@pytest.fixture
def up(flown: Any) -> Any:
    """In Hold, 10 m up."""
    flight = flown()
    flight.run(1.2)
    flight.take_off(10.0)
    return flight


def wanted_deg(flight: Any) -> tuple[float, ...]:
    """Attitude set-point: roll, pitch, heading."""
    return tuple(math.degrees(angle) for angle in to_euler(flight.control.attitude_sp.quat))


class TestStabilized:
    def test_a_stick_flies_as_the_same_set_point_from_outside(self, flown: Any) -> None:
        rolls = []
        for by_stick in (True, False):
            flight = flown()
            flight.run(1.2)
            flight.take_off(10.0)
            flight.control.sticks = Sticks(roll=10.0 / 35.0)
            if by_stick:
                flight.begin(Mode.STABILIZED)
            row = []
            for _ in range(50):
                if not by_stick:
                    thrust = flight.hover
                    quat = from_euler(math.radians(10.0), 0.0, math.radians(flight.euler_deg[2]))
                    flight.control.take_setpoint(flight.now_us, quat, (0.0, 0.0, NAN), thrust, fly=True)
                    if flight.mode is not Mode.OFFBOARD:
                        flight.begin(Mode.OFFBOARD)
                flight.run(0.02)
                row.append(flight.euler_deg[0])
            rolls.append(row)
        # the stick is looked at after the control law of a tick, so it is flown one tick (4 ms) later
        assert rolls[0] == pytest.approx(rolls[1], abs=0.25)
        assert max(rolls[0]) > 7.0

    def test_manual_flies_as_stabilized(self, up: Any) -> None:
        up.control.sticks = Sticks(roll=10.0 / 35.0)
        up.begin(Mode.MANUAL)
        up.run(1.0)
        assert wanted_deg(up)[0] == pytest.approx(10.0, abs=1e-3)

    def test_takes_off_and_lands_by_throttle(self, flown: Any) -> None:
        flight = flown(Mode.STABILIZED)
        flight.control.sticks = Sticks(throttle=-1.0)
        flight.run(2.0)
        assert flight.landing.landed
        flight.control.sticks = Sticks(throttle=0.3)
        flight.until(lambda: flight.ned[2] < -1.0, 6.0)
        assert not flight.landing.landed
        flight.control.sticks = Sticks(throttle=-0.2)
        flight.until(lambda: flight.ned[2] > -0.05, 20.0)
        flight.control.sticks = Sticks(throttle=-1.0)
        flight.until(lambda: flight.landing.landed, 3.0)

    def test_no_thrust_before_the_spool_up_time(self, flown: Any) -> None:
        flight = flown(Mode.STABILIZED)
        flight.control.sticks = Sticks(throttle=1.0)
        flight.run(0.95)
        assert flight.control.thrust_sp == 0.0
        flight.run(0.3)
        assert 0.0 < flight.control.thrust_sp < 0.2

    def test_set_points_are_counted(self, up: Any) -> None:
        up.begin(Mode.STABILIZED)
        before = up.control.attitude_sp_count
        up.run(0.4)
        assert up.control.attitude_sp_count == before + 100


def test_acro_turns_at_the_asked_rate(up: Any) -> None:
    up.begin(Mode.ACRO)
    up.control.sticks = Sticks(roll=0.5)
    up.run(0.3)
    assert math.degrees(up.plant.rates[0]) == pytest.approx(50.0, abs=6.0)
    assert math.degrees(up.control.attitude_sp.rates[0]) == pytest.approx(50.0)
    assert up.control.attitude_sp.quat == (1.0, 0.0, 0.0, 0.0)


class TestAltitude:
    def test_height_is_held_without_sticks(self, up: Any) -> None:
        up.begin(Mode.ALTCTL)
        up.run(6.0)
        assert up.ned[2] == pytest.approx(-10.0, abs=0.3)

    def test_throttle_is_a_climb_rate(self, up: Any) -> None:
        up.begin(Mode.ALTCTL)
        up.control.sticks = Sticks(throttle=1.0)
        up.run(4.0)
        assert up.velocity[2] == pytest.approx(-3.0, abs=0.1)
        up.control.sticks = Sticks()
        up.run(3.0)
        stopped = up.ned[2]
        up.run(4.0)
        assert up.ned[2] == pytest.approx(stopped, abs=0.2)

    def test_stick_is_tilt_and_height_stays(self, up: Any) -> None:
        up.begin(Mode.ALTCTL)
        up.control.sticks = Sticks(pitch=0.5)
        up.run(3.0)
        # the stick is an acceleration: half of what the full tilt gives
        expected = math.degrees(math.atan(0.5 * math.tan(math.radians(35.0))))
        assert wanted_deg(up)[1] == pytest.approx(-expected, abs=0.5)
        assert up.ned[2] == pytest.approx(-10.0, abs=0.5)


class TestPosition:
    def test_full_stick_is_mpc_vel_manual(self, up: Any) -> None:
        up.begin(Mode.POSCTL)
        up.control.sticks = Sticks(pitch=1.0)
        up.run(12.0)
        assert math.hypot(*up.velocity[:2]) == pytest.approx(10.0, rel=0.03)
        assert up.ned[2] == pytest.approx(-10.0, abs=0.4)
        assert up.tilt_max_deg < 45.0

    def test_release_stops_and_holds(self, up: Any) -> None:
        up.begin(Mode.POSCTL)
        up.control.sticks = Sticks(pitch=0.6, roll=-0.4)
        up.run(6.0)
        up.control.sticks = Sticks()
        up.run(8.0)
        place = up.ned
        assert math.hypot(*up.velocity[:2]) < 0.1
        up.run(10.0)
        assert math.dist(up.ned, place) < 0.5

    def test_stick_is_in_the_heading_frame(self, up: Any) -> None:
        up.begin(Mode.POSCTL)
        up.control.sticks = Sticks(yaw=0.6)
        up.run(2.0)
        up.control.sticks = Sticks()
        up.run(3.0)
        heading = math.radians(up.euler_deg[2])
        assert abs(heading) > 0.3
        up.control.sticks = Sticks(pitch=0.7)
        up.run(5.0)
        track = math.atan2(up.velocity[1], up.velocity[0])
        assert math.remainder(track - heading, math.tau) == pytest.approx(0.0, abs=0.03)

    def test_takes_off_by_throttle_and_lands_with_it_down(self, flown: Any) -> None:
        flight = flown(Mode.POSCTL)
        flight.control.sticks = Sticks()
        flight.run(2.0)
        assert flight.landing.landed
        assert flight.control.thrust_sp == 0.0
        flight.control.sticks = Sticks(throttle=0.8)
        flight.until(lambda: flight.ned[2] < -3.0, 15.0)
        flight.control.sticks = Sticks()
        flight.run(4.0)
        assert flight.distance(0.0, 0.0) < 0.5
        flight.control.sticks = Sticks(throttle=-1.0)
        flight.until(lambda: flight.landing.landed, 20.0)
        flight.run(3.0)
        assert flight.landing.landed
        assert flight.control.thrust_sp == 0.0

    def test_loss_of_sticks_holds(self, up: Any) -> None:
        up.begin(Mode.POSCTL)
        up.control.sticks = None
        place = up.ned
        up.run(8.0)
        assert math.dist(up.ned, place) < 0.5

    def test_nonsense_on_the_sticks_counts_as_centred(self, up: Any) -> None:
        place = up.ned
        for mode in (Mode.POSCTL, Mode.ALTCTL):
            up.begin(mode)
            up.control.sticks = Sticks(math.nan, math.inf, -math.inf, math.nan)
            up.run(2.0)
        assert math.dist(up.ned, place) < 1.0
