"""Commands in flight and on the ground: modes, mission, home, orbit, motor test, termination."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sitl.modes import EXTERNAL_MODES, LandedState, Mode, Result, Severity
from sitl.sensors import geodetic
from sitl.setpoints import Reposition

HERE = Reposition(math.nan, math.nan, math.nan, math.nan, math.nan)


def said(flight: Any) -> list[str]:
    return [text for _, text in flight.texts]


def place(n: float, e: float, height_m: float, **more: float) -> Reposition:
    """A place of the local frame on the globe."""
    lat, lon, alt = geodetic((n, e, -height_m))
    return HERE._replace(lat_deg=lat, lon_deg=lon, alt_m=alt, **more)


class TestModes:
    @pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.TERMINATION])
    def test_disarmed_every_mode_is_accepted_without_a_word(self, ground: Any, mode: Mode) -> None:
        assert ground.autopilot.command_mode(mode) is Result.ACCEPTED
        ground.run(0.2)
        assert ground.autopilot.mode is ground.autopilot.intended is mode
        assert said(ground) == []

    def test_nobody_switches_to_termination(self, ground: Any, hover: Any) -> None:
        for made in (ground, hover):
            assert made.autopilot.command_mode(Mode.TERMINATION) is Result.TEMPORARILY_REJECTED
            assert made.autopilot.mode is Mode.LOITER
            assert not made.autopilot.terminated
            made.listen()
            assert said(made) == ["Switching to Termination is currently not available\t"]
        hover.run(2.0)
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(-10.0, abs=0.1)

    def test_armed_on_the_ground_sticks_are_needed_as_well(self, ground: Any, pilot: Any) -> None:
        ground.arm()
        ground.texts.clear()
        assert ground.autopilot.command_mode(Mode.STABILIZED) is Result.TEMPORARILY_REJECTED
        ground.listen()
        assert said(ground) == ["Switching to Stabilized is currently not available\t"]
        pilot(ground).fly(0.2, throttle=-1.0)
        assert ground.autopilot.command_mode(Mode.STABILIZED) is Result.ACCEPTED

    @pytest.mark.parametrize("mode", EXTERNAL_MODES[:1] + EXTERNAL_MODES[-1:])
    def test_an_external_mode_is_of_no_use(self, hover: Any, mode: Mode) -> None:
        assert hover.autopilot.command_mode(mode) is Result.TEMPORARILY_REJECTED
        assert "external" in hover.autopilot.rejection

    def test_a_refusal_can_go_without_words(self, hover: Any) -> None:
        assert hover.autopilot.command_mode(Mode.OFFBOARD, explain=False) is Result.TEMPORARILY_REJECTED
        hover.listen()
        assert said(hover) == []
        assert hover.autopilot.rejection == "no offboard signal"

    def test_refusals_are_critical(self, hover: Any) -> None:
        hover.autopilot.command_mode(Mode.MISSION)
        (text,) = hover.autopilot.take_texts()
        assert text.severity is Severity.CRITICAL

    def test_precision_landing_without_a_target_lands(self, hover: Any) -> None:
        assert hover.autopilot.command_mode(Mode.PRECLAND) is Result.ACCEPTED
        hover.run_until(lambda: not hover.autopilot.armed, 40.0)
        assert said(hover) == ["Landing detected\t", "Disarmed by landing\t"]
        assert hover.autopilot.mode is Mode.LOITER

    def test_takeoff_goes_over_to_hold_at_the_height(self, ground: Any) -> None:
        ground.arm()
        ground.autopilot.command_takeoff(488.0 + 7.0)
        ground.run_until(lambda: ground.autopilot.mode is Mode.LOITER, 20.0)
        assert ground.autopilot.intended is Mode.LOITER
        assert ground.vehicle.truth.position_ned()[2] == pytest.approx(-7.0, abs=0.3)
        ground.run(5.0)
        assert ground.vehicle.truth.position_ned() == pytest.approx((0.0, 0.0, -7.0), abs=0.1)
        assert ground.autopilot.landed_state is LandedState.IN_AIR


class TestMission:
    def test_knows_home_as_soon_as_the_commander_does(self, flight: Any, flown: Any) -> None:
        autopilot = flight().autopilot
        autopilot.control.mission.load((flown.rise(5.0), flown.waypoint(12.0, 0.0, 5.0)))
        assert autopilot.control.mission.home is autopilot.home
        assert autopilot.control.mission.valid
        autopilot.command_set_home(*geodetic((15.0, 5.0, 0.0)))
        assert autopilot.control.mission.home is autopilot.home

    def test_without_one_it_does_not_start(self, ground: Any) -> None:
        assert ground.autopilot.command_mission_start() is Result.DENIED
        ground.listen()
        assert said(ground) == ["Mission start denied! No valid mission\t"]
        assert not ground.autopilot.armed
        assert ground.autopilot.mode is Mode.LOITER

    def test_nor_is_its_mode_to_be_had_in_flight(self, hover: Any) -> None:
        assert hover.autopilot.command_mode(Mode.MISSION) is Result.TEMPORARILY_REJECTED
        hover.listen()
        assert said(hover) == ["Switching to Mission is currently not available\t"]

    def test_it_arms_flies_and_holds_at_the_end(self, ground: Any, flown: Any) -> None:
        mission = ground.autopilot.control.mission
        mission.load((flown.rise(5.0), flown.waypoint(12.0, 0.0, 5.0), flown.waypoint(12.0, 6.0, 5.0)))
        assert ground.autopilot.command_mission_start() is Result.ACCEPTED
        assert ground.autopilot.armed
        assert ground.autopilot.mode is Mode.MISSION
        ground.run_until(lambda: ground.autopilot.mode is Mode.LOITER, 60.0)
        assert ground.autopilot.intended is Mode.LOITER
        ground.run(4.0)
        assert ground.vehicle.truth.position_ned() == pytest.approx((12.0, 6.0, -5.0), abs=0.3)
        assert not ground.autopilot.failsafe

    def test_what_forbids_arming_forbids_it(self, flight: Any, flown: Any) -> None:
        early = flight()
        early.autopilot.control.mission.load((flown.rise(5.0), flown.waypoint(12.0, 0.0, 5.0)))
        early.run(0.1)
        assert early.autopilot.command_mission_start() is Result.DENIED
        early.listen()
        assert said(early)[-1] == "Mission start denied\t"
        assert not early.autopilot.armed


class TestHome:
    def test_is_known_from_the_first_tick(self, flight: Any) -> None:
        home = flight().autopilot.home
        assert (home.lat_deg, home.lon_deg, home.alt_m) == pytest.approx((47.397742, 8.545594, 488.0), abs=1e-6)

    def test_moves_with_the_vehicle_when_told_here(self, hover: Any) -> None:
        hover.autopilot.command_reposition(place(8.0, -3.0, 10.0))
        hover.run(12.0)
        assert hover.autopilot.command_set_home_here() is Result.ACCEPTED
        assert hover.autopilot.home.position_ned == pytest.approx((8.0, -3.0, -10.0), abs=0.3)

    def test_is_refused_before_there_is_a_position(self, flight: Any) -> None:
        assert flight().autopilot.command_set_home_here() is Result.TEMPORARILY_REJECTED

    @pytest.mark.parametrize(
        "where",
        [(91.0, 0.0, 0.0), (0.0, 181.0, 0.0), (math.nan, 0.0, 0.0), (0.0, math.nan, 0.0), (0.0, 0.0, math.inf)],
    )
    def test_a_place_that_is_none_is_denied(self, ground: Any, where: tuple[float, float, float]) -> None:
        before = ground.autopilot.home
        assert ground.autopilot.command_set_home(*where) is Result.DENIED
        assert ground.autopilot.home is before

    def test_a_place_outlives_arming_and_is_forgotten_after_the_flight(self, ground: Any) -> None:
        there = geodetic((15.0, 5.0, 0.0))
        assert ground.autopilot.command_set_home(*there) is Result.ACCEPTED
        ground.arm()
        home = ground.autopilot.home
        assert (home.lat_deg, home.lon_deg, home.alt_m) == there
        assert home.position_ned == pytest.approx((15.0, 5.0, 0.0), abs=1e-3)
        ground.autopilot.command_arm(False)
        ground.arm()
        assert ground.autopilot.home.position_ned == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)

    def test_return_goes_where_it_is_now(self, hover: Any) -> None:
        hover.parameters.set("RTL_RETURN_ALT", 12.0)
        hover.autopilot.command_set_home(*geodetic((18.0, -7.0, 0.0)))
        assert hover.autopilot.command_return() is Result.ACCEPTED
        heights = []
        hover.run(8.0, lambda _: heights.append(-hover.vehicle.truth.position_ned()[2]))
        hover.run_until(lambda: not hover.autopilot.armed, 90.0)
        assert hover.vehicle.truth.position_ned() == pytest.approx((18.0, -7.0, 0.0), abs=0.3)
        assert max(heights) == pytest.approx(12.0, abs=0.9)
        assert said(hover) == [
            "Returning to launch\t",
            "RTL: start return at 500 m (12 m above destination)\t",
            "RTL: land at destination\t",
            "Landing detected\t",
            "Disarmed by landing\t",
        ]
        assert hover.autopilot.mode is Mode.LOITER


class TestPlaces:
    def test_reposition_goes_there_and_holds(self, hover: Any) -> None:
        assert hover.autopilot.command_reposition(place(10.0, 4.0, 13.0, yaw=1.0)) is Result.ACCEPTED
        hover.run(15.0)
        assert hover.autopilot.mode is Mode.LOITER
        assert hover.vehicle.truth.position_ned() == pytest.approx((10.0, 4.0, -13.0), abs=0.3)
        assert hover.vehicle.truth.euler()[2] == pytest.approx(1.0, abs=0.05)

    def test_reposition_leaves_another_mode_for_hold(self, hover: Any) -> None:
        hover.autopilot.command_land()
        hover.run(2.0)
        hover.autopilot.command_reposition(place(0.0, 0.0, 12.0))
        hover.run(10.0)
        assert hover.autopilot.mode is Mode.LOITER
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(-12.0, abs=0.2)

    @pytest.mark.parametrize(("radius_m", "turn"), [(6.0, 1.0), (-6.0, -1.0)])
    def test_orbit_keeps_its_radius_height_and_sense(self, hover: Any, radius_m: float, turn: float) -> None:
        wish = place(15.0, 0.0, 11.0)
        assert hover.autopilot.command_orbit(wish, radius_m=radius_m, speed_m_s=3.0) is Result.ACCEPTED
        assert hover.autopilot.mode is Mode.ORBIT
        hover.run(15.0)
        track = []
        hover.run(20.0, lambda _: track.append(hover.vehicle.truth.position_ned()))
        north, east, down = np.array(track).T
        assert np.hypot(north - 15.0, east) == pytest.approx(6.0, abs=0.6)
        assert down == pytest.approx(-11.0, abs=0.3)
        angle = np.unwrap(np.arctan2(east, north - 15.0))
        # 3 m/s on 6 m for 20 s are ten radians
        assert angle[-1] - angle[0] == pytest.approx(turn * 10.0, rel=0.1)
        assert (np.diff(angle) * turn > 0.0).all()

    def test_orbit_ends_with_another_mode(self, hover: Any) -> None:
        hover.autopilot.command_orbit(HERE, radius_m=5.0, speed_m_s=3.0)
        hover.run(10.0)
        hover.autopilot.command_mode(Mode.LOITER)
        hover.run(8.0)
        before = hover.vehicle.truth.position_ned()
        hover.run(5.0)
        assert hover.vehicle.truth.position_ned() == pytest.approx(before, abs=0.1)

    def test_on_the_ground_they_only_choose_the_mode(self, ground: Any) -> None:
        assert ground.autopilot.command_orbit(HERE, radius_m=5.0, speed_m_s=3.0) is Result.ACCEPTED
        assert ground.autopilot.mode is Mode.ORBIT
        assert ground.autopilot.command_reposition(place(5.0, 5.0, 5.0)) is Result.ACCEPTED
        assert ground.autopilot.mode is Mode.LOITER
        ground.arm()
        ground.run(3.0)
        assert ground.vehicle.truth.position_ned() == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


class TestMotorTest:
    def turning(self, ground: Any, seconds: float) -> np.ndarray:
        rows: list[tuple[float, ...]] = []
        for _ in range(round(seconds * 250)):
            ground.vehicle.step()
            rows.append(ground.autopilot.motors)
        return np.array(rows)

    @pytest.mark.parametrize("motor", range(4))
    @pytest.mark.parametrize(("asked_s", "turned_s"), [(0.5, 0.5), (3.0, 3.0), (60.0, 3.0), (math.inf, 0.0)])
    def test_turns_that_motor_alone_and_ends_by_itself(
        self, ground: Any, motor: int, asked_s: float, turned_s: float
    ) -> None:
        ground.autopilot.test_motor(motor, 0.15, asked_s)
        seen = self.turning(ground, 4.0)
        others = [i for i in range(4) if i != motor]
        assert set(seen[:, motor]) <= {0.0, 0.15}
        assert np.count_nonzero(seen[:, motor]) / 250.0 == pytest.approx(turned_s, abs=0.01)
        assert not seen[:, others].any()
        assert not ground.autopilot.armed

    @pytest.mark.parametrize(("value", "turns_at"), [(2.0, 1.0), (-1.0, 0.0), (math.nan, 0.0), (math.inf, 0.0)])
    def test_value_is_held_within_what_a_motor_takes(self, ground: Any, value: float, turns_at: float) -> None:
        ground.autopilot.test_motor(1, value, 0.1)
        assert self.turning(ground, 0.05)[-1].tolist() == [0.0, turns_at, 0.0, 0.0]

    def test_a_new_value_replaces_the_old_one_and_off_ends_it(self, ground: Any) -> None:
        ground.autopilot.test_motor(0, 0.1, 3.0)
        assert self.turning(ground, 0.1)[-1][0] == 0.1
        ground.autopilot.test_motor(0, -1.0, 3.0)
        assert not self.turning(ground, 0.1).any()

    @pytest.mark.parametrize("motor", [-1, 4, 11, 12, 1000])
    def test_a_motor_it_has_not_is_nothing(self, ground: Any, motor: int) -> None:
        ground.autopilot.test_motor(motor, 0.5, 1.0)
        assert not self.turning(ground, 0.1).any()

    def test_arming_stops_it(self, ground: Any) -> None:
        ground.autopilot.test_motor(2, 0.2, 3.0)
        self.turning(ground, 0.1)
        ground.arm()
        assert np.abs(self.turning(ground, 0.9)[1:]).max() < 1e-9
        ground.autopilot.command_arm(False)
        assert self.turning(ground, 1.0).max() < 1e-9

    def test_is_not_begun_in_flight(self, hover: Any) -> None:
        hover.autopilot.test_motor(0, 1.0, 3.0)
        hover.run(1.0)
        assert max(hover.autopilot.motors) < 0.6
        hover.autopilot.command_arm(False, force=True)
        hover.run(0.1)
        assert hover.autopilot.motors == (0.0, 0.0, 0.0, 0.0)


class TestTermination:
    def test_stays_until_disarmed_and_then_all_is_as_before(self, hover: Any) -> None:
        assert hover.autopilot.command_terminate(True) is Result.ACCEPTED
        hover.run(2.0)
        assert hover.autopilot.mode is hover.autopilot.intended is Mode.TERMINATION
        assert hover.autopilot.failsafe
        assert not any(hover.autopilot.motors)
        assert hover.autopilot.command_return() is Result.TEMPORARILY_REJECTED
        assert hover.autopilot.command_reposition(HERE) is Result.TEMPORARILY_REJECTED
        assert hover.autopilot.command_orbit(HERE, radius_m=5.0, speed_m_s=1.0) is Result.TEMPORARILY_REJECTED
        assert hover.autopilot.command_land() is Result.TEMPORARILY_REJECTED
        hover.run(1.0)
        assert hover.autopilot.mode is Mode.TERMINATION
        assert not any(hover.autopilot.motors)
        assert hover.autopilot.command_arm(False, force=True) is Result.ACCEPTED
        assert not hover.autopilot.terminated
        assert hover.autopilot.mode is Mode.LOITER
        hover.run(1.0)
        assert hover.autopilot.command_arm(True) is Result.ACCEPTED

    def test_ends_by_landing(self, hover: Any) -> None:
        hover.autopilot.command_terminate(True)
        hover.run_until(lambda: not hover.autopilot.armed, 8.0)
        assert said(hover) == ["Landing detected\t", "Disarmed by landing\t"]
        assert not hover.autopilot.terminated
        assert not hover.autopilot.failsafe
        assert hover.autopilot.mode is Mode.LOITER

    def test_a_height_reached_meanwhile_does_not_end_it(self, ground: Any) -> None:
        ground.arm()
        ground.autopilot.command_takeoff(None)
        ground.run_until(lambda: ground.vehicle.truth.position_ned()[2] < -2.1, 10.0)
        assert ground.autopilot.command_terminate(True) is Result.ACCEPTED
        for _ in range(100):
            ground.run(0.02)
            assert ground.autopilot.mode is Mode.TERMINATION
            assert not any(ground.autopilot.motors)

    def test_is_denied_on_the_ground_and_when_off_is_asked(self, ground: Any, hover: Any) -> None:
        assert ground.autopilot.command_terminate(True) is Result.DENIED
        assert hover.autopilot.command_terminate(False) is Result.DENIED
        assert hover.autopilot.mode is Mode.LOITER


def test_ready_is_what_arming_would_say(ground: Any) -> None:
    assert ground.autopilot.ready
    for mode in (Mode.LAND, Mode.POSCTL, Mode.OFFBOARD, Mode.MISSION):
        ground.autopilot.command_mode(mode)
        assert not ground.autopilot.ready
    ground.autopilot.command_mode(Mode.TAKEOFF)
    assert ground.autopilot.ready
