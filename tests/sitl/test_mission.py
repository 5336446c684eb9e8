"""Missions, flown and by their rules."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from sitl.legs import Here, LegKind
from sitl.mission import MissionRun
from sitl.modes import Home, Mode
from sitl.parameters import ParameterTable
from sitl.plan import (
    CONDITION_YAW,
    DO_CHANGE_SPEED,
    DO_JUMP,
    NAV_DELAY,
    NAV_LAND,
    NAV_LOITER_TIME,
    NAV_LOITER_TURNS,
    NAV_LOITER_UNLIM,
    NAV_RETURN_TO_LAUNCH,
    NAV_TAKEOFF,
    NAV_WAYPOINT,
)

NAN = math.nan
HOME = Home(47.397742, 8.545594, 488.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def at(n: float, e: float, height_m: float, now_us: int = 0, *, landed: bool = False, yaw: float = 0.0) -> Here:
    return Here(now_us, (n, e, -height_m), yaw, landed, HOME)


@pytest.fixture
def run() -> MissionRun:
    made = MissionRun(ParameterTable())
    made.home, made.landed = HOME, False
    return made


def said(run: MissionRun) -> list[str]:
    return [text.text for text in run.texts]


class TestFlights:
    def test_takeoff_three_waypoints_and_land(self, flown: Any) -> None:
        flight = flown()
        flight.run(1.2)
        places = [(30.0, 0.0), (30.0, 30.0), (0.0, 30.0)]
        flight.fly_mission(
            flown.rise(8.0),
            *[flown.waypoint(n, e, 10.0) for n, e in places],
            flown.item(NAV_LAND, (-5.0, 20.0, 0.0)),
        )
        mission = flight.control.mission
        reached, missed = [], [math.inf] * 3
        while not flight.landing.landed or flight.ned[2] > 5.0 or mission.reached_serial == 0:
            serial = mission.reached_serial
            flight.run(0.02)
            if mission.reached_serial != serial:
                reached.append(mission.reached_seq)
            missed = [min(m, flight.distance(*place)) for m, place in zip(missed, places, strict=True)]
            assert flight.now_us < 150e6, (flight.ned, mission.current)
        flight.run(0.1)
        reached += [mission.reached_seq] if mission.reached_seq not in reached else []
        assert reached == [0, 1, 2, 3, 4]
        assert max(missed) < 2.0
        assert flight.distance(-5.0, 20.0) < 1.0
        assert mission.finished
        assert flight.mode is Mode.MISSION
        assert flight.tilt_max_deg < 46.0
        assert flight.texts == ["Executing Mission", "Takeoff to 8.0 meters above home", "Mission finished, landed"]
        flight.run(3.0)
        assert flight.control.thrust_sp == 0.0

    def test_without_a_landing_it_holds_at_the_last_place(self, flown: Any) -> None:
        flight = flown()
        flight.run(1.2)
        flight.fly_mission(flown.rise(6.0), flown.waypoint(20.0, 0.0, 9.0))
        flight.until(lambda: flight.mode is Mode.LOITER, 60.0)
        assert flight.texts[-1] == "Mission finished, loitering"
        flight.run(8.0)
        assert flight.ned == pytest.approx((20.0, 0.0, -9.0), abs=0.3)

    def test_waypoints_are_passed_without_stopping(self, flown: Any) -> None:
        flight = flown()
        flight.run(1.2)
        flight.take_off(10.0)
        flight.fly_mission(*[flown.waypoint(n, 0.0, 10.0) for n in (30.0, 60.0, 90.0)])
        flight.until(lambda: flight.ned[0] > 20.0, 20.0)
        slowest = math.inf
        while flight.ned[0] < 70.0:
            flight.run(0.1)
            slowest = min(slowest, flight.velocity[0])
        assert slowest > 4.0

    def test_hold_time_heading_and_speed(self, flown: Any) -> None:
        flight = flown()
        flight.run(1.2)
        flight.take_off(10.0)
        flight.fly_mission(
            flown.item(DO_CHANGE_SPEED, params=(1.0, 2.0, -1.0, 0.0), frame=2),
            flown.waypoint(20.0, 0.0, 10.0, hold_s=4.0, yaw_deg=90.0),
            flown.waypoint(20.0, 20.0, 10.0),
        )
        fastest = 0.0
        while flight.control.mission.current < 2:
            flight.run(0.1)
            fastest = max(fastest, math.hypot(*flight.velocity[:2]))
            assert flight.now_us < 80e6
        assert fastest == pytest.approx(2.0, abs=0.3)
        assert flight.euler_deg[2] == pytest.approx(90.0, abs=13.0)
        assert flight.distance(20.0, 0.0) < 1.0

    def test_another_mode_between_and_on_again(self, flown: Any) -> None:
        flight = flown()
        flight.run(1.2)
        flight.fly_mission(flown.rise(6.0), flown.waypoint(30.0, 0.0, 6.0), flown.waypoint(30.0, 30.0, 6.0))
        flight.until(lambda: flight.control.mission.current == 1 and flight.ned[0] > 10.0, 40.0)
        flight.begin(Mode.LOITER)
        flight.run(6.0)
        assert math.hypot(*flight.velocity) < 0.3
        flight.begin(Mode.MISSION)
        assert flight.control.mission.current == 1
        flight.until(lambda: flight.mode is Mode.LOITER, 60.0)
        assert flight.control.mission.reached_seq == 2

    def test_circles(self, flown: Any) -> None:
        flight = flown()
        flight.run(1.2)
        flight.take_off(10.0)
        flight.fly_mission(flown.item(NAV_LOITER_TURNS, (20.0, 0.0, -10.0), (1.0, 0.0, 8.0, NAN)))
        flight.until(lambda: flight.control.navigator.track.turned_rad > 0.3, 40.0)
        radii, angles = [], []
        while flight.mode is Mode.MISSION:
            flight.run(0.2)
            radii.append(flight.distance(20.0, 0.0))
            angles.append(math.atan2(flight.ned[1], flight.ned[0] - 20.0))
        assert min(radii[5:-2]) > 7.0
        assert max(radii[5:-2]) < 9.0
        steps = [math.remainder(b - a, math.tau) for a, b in itertools.pairwise(angles)]
        assert sum(steps[:-2]) > 4.5

    def test_return_item_asks_for_return(self, flown: Any) -> None:
        flight = flown()
        flight.run(1.2)
        flight.fly_mission(flown.rise(6.0), flown.waypoint(15.0, 0.0, 6.0), flown.item(NAV_RETURN_TO_LAUNCH, frame=2))
        flight.until(lambda: flight.mode is Mode.RTL, 60.0)
        flight.until(lambda: flight.landing.landed, 90.0)
        assert flight.distance(0.0, 0.0) < 1.0

    def test_a_first_waypoint_on_the_ground_begins_with_a_take_off(self, flown: Any) -> None:
        flight = flown(MIS_TAKEOFF_ALT=4.0)
        flight.run(1.2)
        flight.fly_mission(flown.waypoint(10.0, 0.0, 2.0))
        flight.until(lambda: -flight.ned[2] > 3.0, 20.0)
        assert flight.distance(0.0, 0.0) < 0.5
        assert "Takeoff to 4.0 meters above home" in flight.texts

    def test_nothing_to_fly(self, flown: Any) -> None:
        flight = flown()
        flight.run(1.2)
        flight.fly_mission()
        flight.run(3.0)
        assert flight.texts == ["No valid mission available, refusing takeoff"]
        assert flight.landing.landed
        flight.begin(Mode.LOITER)
        flight.take_off(5.0)
        flight.begin(Mode.MISSION)
        flight.run(0.1)
        assert flight.mode is Mode.LOITER
        assert flight.texts[-1] == "No valid mission available, loitering"


class TestItems:
    def test_jumps_are_counted(self, run: MissionRun, flown: Any) -> None:
        jump = flown.item(DO_JUMP, params=(0.0, 2.0, 0.0, 0.0), frame=2)
        run.load((flown.waypoint(0.0, 0.0, 10.0), flown.waypoint(10.0, 0.0, 10.0), jump))
        run.start()
        reached = []
        for _ in range(40):
            leg = run.leg(at(10.0 * (run.current == 1), 0.0, 10.0))
            assert leg.kind is LegKind.GO
            if run.finished:
                break
            reached.append(run.reached_seq)
        assert [*reached, run.reached_seq] == [0, 1] * 3
        assert run.wish is Mode.LOITER

    def test_jumps_that_lead_nowhere_end_the_mission(self, run: MissionRun, flown: Any) -> None:
        run.load(tuple(flown.item(DO_JUMP, params=(0.0, -1.0, 0.0, 0.0), frame=2) for _ in range(3)))
        run.start()
        run.leg(at(0.0, 0.0, 10.0))
        assert run.finished
        assert "Mission item could not be set.\t" in said(run)

    @pytest.mark.parametrize("target", [-1.0, 7.0, NAN, math.inf])
    def test_a_jump_to_no_item_is_passed(self, run: MissionRun, flown: Any, target: float) -> None:
        run.load((flown.item(DO_JUMP, params=(target, 5.0, 0.0, 0.0), frame=2), flown.waypoint(5.0, 0.0, 10.0)))
        run.start()
        assert run.leg(at(0.0, 0.0, 10.0)).ned[0] == pytest.approx(5.0, abs=1e-3)
        assert run.current == 1

    def test_loiter_time_and_delay_wait(self, run: MissionRun, flown: Any) -> None:
        loiter = flown.item(NAV_LOITER_TIME, (0.0, 0.0, -10.0), (3.0, 0.0, 0.0, NAN))
        run.load((loiter, flown.item(NAV_DELAY, params=(2.0, -1.0, -1.0, -1.0), frame=2), loiter))
        run.start()
        for now_s, current in ((0.0, 0), (2.9, 0), (3.0, 1), (3.1, 1), (5.0, 1), (5.2, 2)):
            run.leg(at(0.0, 0.0, 10.0, round(now_s * 1e6)))
            assert run.current == current

    def test_loiter_unlimited_never_ends(self, run: MissionRun, flown: Any) -> None:
        run.load((flown.item(NAV_LOITER_UNLIM, (0.0, 0.0, -10.0)), flown.waypoint(5.0, 0.0, 10.0)))
        run.start()
        for now_s in range(0, 10_000, 1000):
            run.leg(at(0.0, 0.0, 10.0, now_s * 1_000_000))
        assert run.current == 0

    def test_without_autocontinue_it_stays(self, run: MissionRun, flown: Any) -> None:
        stop = flown.item(NAV_WAYPOINT, (5.0, 0.0, -10.0), autocontinue=False)
        run.load((stop, flown.waypoint(9.0, 0.0, 10.0)))
        run.start()
        run.leg(at(5.0, 0.0, 10.0))
        assert (run.current, run.reached_seq) == (0, 0)
        assert run.leg(at(5.0, 0.0, 10.0)).ned[0] == pytest.approx(5.0, abs=1e-3)

    def test_acceptance_radius_of_the_item(self, run: MissionRun, flown: Any) -> None:
        run.load((flown.item(NAV_WAYPOINT, (10.0, 0.0, -10.0), (0.0, 6.0, 0.0, NAN)), flown.waypoint(50.0, 0.0, 10.0)))
        run.start()
        run.leg(at(3.9, 0.0, 10.0))
        assert run.current == 0
        run.leg(at(4.1, 0.0, 12.0))
        assert run.current == 0, "the height must fit as well"
        run.leg(at(4.1, 0.0, 10.0))
        assert run.current == 1

    def test_heights_above_sea_and_above_home(self, run: MissionRun, flown: Any) -> None:
        run.home = HOME
        run.load((flown.item(NAV_WAYPOINT, (1.0, 0.0, -12.0), frame=5),))
        run.start()
        assert run.leg(at(50.0, 0.0, 10.0)).ned[2] == pytest.approx(-12.0)
        run.load((flown.item(NAV_WAYPOINT, (1.0, 0.0, -12.0), frame=6),))
        high = HOME.__class__(HOME.lat_deg, HOME.lon_deg, 493.0, (0.0, 0.0, -5.0), HOME.quat)
        run.start()
        assert run.leg(at(50.0, 0.0, 10.0)._replace(home=high)).ned[2] == pytest.approx(-17.0)

    def test_condition_yaw_turns(self, run: MissionRun, flown: Any) -> None:
        run.load((flown.item(CONDITION_YAW, params=(270.0, 0.0, 0.0, 0.0), frame=2), flown.waypoint(50.0, 0.0, 10.0)))
        run.start()
        run.leg(at(0.0, 0.0, 10.0))
        assert run.leg(at(0.0, 0.0, 10.0)).yaw == pytest.approx(-math.pi / 2.0)

    def test_set_current(self, run: MissionRun, flown: Any) -> None:
        run.load((flown.waypoint(5.0, 0.0, 10.0), flown.waypoint(9.0, 0.0, 10.0)))
        assert run.set_current(1)
        assert not run.set_current(2)
        assert not run.set_current(-1)
        assert run.leg(at(0.0, 0.0, 10.0)).ned[0] == pytest.approx(9.0, abs=1e-3)

    def test_after_another_arming_a_finished_mission_begins_anew(self, run: MissionRun, flown: Any) -> None:
        run.load((flown.waypoint(0.0, 0.0, 10.0), flown.waypoint(0.0, 5.0, 10.0)))
        run.start(1)
        run.leg(at(0.0, 0.0, 10.0))
        run.leg(at(0.0, 5.0, 10.0))
        assert run.finished
        run.start(1)
        assert run.current == 1
        run.leg(at(0.0, 5.0, 10.0))
        run.start(2)
        assert run.current == 0

    @pytest.mark.parametrize("value", [NAN, math.inf, -math.inf, 1e30, -1e30])
    @pytest.mark.parametrize("command", [16, 17, 18, 19, 20, 21, 22, 93, 115, 177, 178])
    def test_nonsense_makes_finite_legs(self, run: MissionRun, flown: Any, command: int, value: float) -> None:
        nonsense = flown.item(command, params=(value, value, value, value))
        nonsense = type(nonsense)(6, command, True, nonsense.params, value, value, value)
        run.load((nonsense, flown.waypoint(5.0, 0.0, 10.0)))
        run.start()
        for now_s in range(20):
            leg = run.leg(at(0.0, 0.0, 10.0, now_s * 1_000_000))
            assert all(math.isfinite(x) and abs(x) <= 1e6 for x in leg.ned)
            assert not math.isinf(leg.yaw)
            assert leg.exit_m_s >= 0.0


class TestProblems:
    def test_why_not(self, run: MissionRun, flown: Any) -> None:
        assert run.problem == "No valid mission"
        run.load((flown.waypoint(1.0, 0.0, 10.0),))
        assert run.valid
        run.load((flown.item(4242),))
        assert run.problem == "Mission rejected: item 1: unsupported cmd: 4242"
        run.load((flown.waypoint(1.0, 0.0, 10.0), flown.rise()))
        assert run.problem == "Mission rejected: takeoff not first waypoint item"
        run.load((flown.item(NAV_TAKEOFF, (0.0, 0.0, 3.0)),))
        assert run.problem == "Mission rejected: Takeoff altitude below home altitude!"
        run.load((flown.item(NAV_LAND),))
        assert run.valid
        run.landed = True
        assert run.problem == "Mission rejected: starts with landing"

    def test_relative_heights_need_a_home(self, run: MissionRun, flown: Any) -> None:
        run.home = None
        run.load((flown.waypoint(1.0, 0.0, 10.0),))
        assert run.problem == "Mission rejected: No home pos, WP 1 uses rel alt"
