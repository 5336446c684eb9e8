"""Commands that fly: what the vehicle does after the acknowledgement."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.modes import Mode
from sitl.sensors import geodetic, local_position

NAN = math.nan
INT32_MAX = 2**31 - 1
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS, CANCELLED = range(7)
REPOSITION, SPEED, HOME, ORBIT, ALTITUDE, RETURN, LAND, TAKEOFF, ARM = 192, 178, 179, 34, 186, 20, 21, 22, 400
CHANGE_MODE = 1


def command_int(one: Any, command: int, frame: int, x: float, y: float, z: float, *params: float) -> int | None:
    """Send a COMMAND_INT; x and y in degrees, or in metres for a local frame. Return the result."""
    scale = 1e7 if frame in (0, 3, 5, 6) else 1e4
    place = {"x": round(x * scale) if x == x else INT32_MAX, "y": round(y * scale) if y == y else INT32_MAX, "z": z}
    numbers = {f"param{k}": value for k, value in enumerate(params, start=1)}
    target = {"target_system": 1, "target_component": 1, "frame": frame, "command": command}
    acks = one.ask("COMMAND_INT", only=("COMMAND_ACK",), **target, **place, **numbers)
    assert [ack.command for ack in acks] in ([], [command])
    return acks[0].result if acks else None


@pytest.fixture
def hover(flight: Any) -> Any:
    return flight().hover()


@pytest.fixture
def asked(hover: Any, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the navigator of a hovering vehicle is asked for."""
    seen: list[Any] = []
    monkeypatch.setattr(hover.autopilot.navigator, "reposition", seen.append)
    monkeypatch.setattr(hover.autopilot.navigator, "orbit", lambda *what: seen.append(what))
    return seen


class TestReposition:
    @pytest.mark.parametrize(("frame", "z"), [(0, 500.0), (5, 500.0), (3, 12.0), (6, 12.0)])
    def test_global_frames(self, hover: Any, asked: list[Any], frame: int, z: float) -> None:
        assert command_int(hover, REPOSITION, frame, 47.39801, 8.54605, z, 2.5, CHANGE_MODE, 0, 0.5) == ACCEPTED
        (where,) = asked
        assert (where.lat_deg, where.lon_deg) == pytest.approx((47.39801, 8.54605), abs=1e-7)
        assert where.alt_m == pytest.approx(500.0, abs=0.05)
        assert (where.yaw, where.speed_m_s) == (0.5, 2.5)

    def test_local_frame(self, hover: Any, asked: list[Any]) -> None:
        assert command_int(hover, REPOSITION, 1, 30.0, -20.0, -7.0, -1.0, CHANGE_MODE, 0, NAN) == ACCEPTED
        (where,) = asked
        assert local_position(where.lat_deg, where.lon_deg, where.alt_m) == pytest.approx((30.0, -20.0, -7.0), abs=0.01)
        assert math.isnan(where.yaw)
        assert math.isnan(where.speed_m_s)

    def test_relative_to_a_home_that_was_moved(self, hover: Any, asked: list[Any]) -> None:
        assert command_int(hover, HOME, 0, 47.4, 8.5, 588.0) == ACCEPTED
        assert command_int(hover, REPOSITION, 6, 47.4, 8.5, -80.0, -1, CHANGE_MODE) == ACCEPTED
        assert asked[0].alt_m == pytest.approx(508.0, abs=0.01)

    def test_a_command_long_is_above_sea_level(self, hover: Any, asked: list[Any]) -> None:
        assert hover.result(REPOSITION, -1, CHANGE_MODE, 0, NAN, 47.398, 8.546, 499.0) == ACCEPTED
        (where,) = asked
        assert (where.lat_deg, where.lon_deg, where.alt_m) == pytest.approx((47.398, 8.546, 499.0), abs=1e-5)

    def test_no_place_keeps_what_is(self, hover: Any, asked: list[Any]) -> None:
        assert command_int(hover, REPOSITION, 6, NAN, NAN, NAN, -1, CHANGE_MODE, 0, NAN) == ACCEPTED
        assert all(map(math.isnan, asked[0]))

    @pytest.mark.parametrize("flags", [0, 2, 3, NAN])
    def test_only_with_the_flag(self, hover: Any, asked: list[Any], flags: float) -> None:
        assert hover.result(REPOSITION, -1, flags, 0, NAN, 47.398, 8.546, 499.0) == UNSUPPORTED
        assert asked == []

    def test_is_flown_at_the_speed_asked_for(self, hover: Any) -> None:
        assert command_int(hover, REPOSITION, 1, 25.0, 0.0, -8.0, 2.0, CHANGE_MODE, 0, NAN) == ACCEPTED
        hover.run(6.0)
        assert math.hypot(*hover.vehicle.truth.velocity_ned()[:2]) == pytest.approx(2.0, abs=0.2)
        hover.run(15.0)
        assert hover.vehicle.truth.position_ned() == pytest.approx((25.0, 0.0, -8.0), abs=0.4)
        assert hover.autopilot.mode is Mode.LOITER


class TestSpeed:
    @pytest.mark.parametrize("kind", [0, 1])
    def test_is_flown_and_lasts(self, hover: Any, kind: int) -> None:
        assert hover.result(SPEED, kind, 1.5) == ACCEPTED
        assert command_int(hover, REPOSITION, 1, 20.0, 0.0, -5.0, -1, CHANGE_MODE, 0, NAN) == ACCEPTED
        hover.run(6.0)
        assert math.hypot(*hover.vehicle.truth.velocity_ned()[:2]) == pytest.approx(1.5, abs=0.2)

    @pytest.mark.parametrize("speed", [-1.0, -2.0, NAN])
    def test_below_zero_is_the_default(self, hover: Any, speed: float) -> None:
        assert hover.result(SPEED, 1, 1.5) == ACCEPTED
        assert hover.autopilot.navigator.cruise_m_s == 1.5
        assert hover.result(SPEED, 1, speed) == ACCEPTED
        assert math.isnan(hover.autopilot.navigator.cruise_m_s)

    @pytest.mark.parametrize("kind", [2, 3, 9])
    def test_other_kinds_are_accepted_and_do_nothing(self, hover: Any, kind: int) -> None:
        assert hover.result(SPEED, kind, 1.5) == ACCEPTED
        assert math.isnan(hover.autopilot.navigator.cruise_m_s)

    @pytest.mark.parametrize("speed", [0.0, math.inf, 3e38])
    def test_absurd_ones_do_not_stop_or_break_it(self, hover: Any, speed: float) -> None:
        assert hover.result(SPEED, 1, speed) == ACCEPTED
        assert command_int(hover, REPOSITION, 1, 10.0, 0.0, -5.0, -1, CHANGE_MODE, 0, NAN) == ACCEPTED
        hover.run(10.0)
        assert hover.vehicle.truth.position_ned()[0] == pytest.approx(10.0, abs=0.5)


class TestHome:
    def test_here(self, hover: Any) -> None:
        assert hover.result(HOME, 1) == ACCEPTED
        assert hover.autopilot.home.alt_m == pytest.approx(hover.vehicle.truth.altitude_m(), abs=0.05)

    @pytest.mark.parametrize(("frame", "z"), [(0, 500.0), (3, 12.0)])
    def test_there(self, on_ground: Any, frame: int, z: float) -> None:
        assert command_int(on_ground, HOME, frame, 47.41, 8.55, z) == ACCEPTED
        home = on_ground.command(410, only=("HOME_POSITION",), wait_s=0.004)[0]
        assert (home.latitude, home.longitude) == pytest.approx((474100000, 85500000), abs=2)
        assert home.altitude == pytest.approx(500_000, abs=50)
        assert (home.x, home.y, home.z) == pytest.approx(local_position(47.41, 8.55, 500.0), rel=1e-3)

    def test_there_in_metres(self, on_ground: Any) -> None:
        assert command_int(on_ground, HOME, 1, 40.0, 30.0, -2.0) == ACCEPTED
        assert on_ground.autopilot.home.position_ned == pytest.approx((40.0, 30.0, -2.0), abs=0.01)

    @pytest.mark.parametrize(
        ("lat", "lon", "alt"), [(NAN, NAN, 500.0), (91.0, 8.0, 0.0), (47.0, 181.0, 0.0), (47.0, 8.0, NAN)]
    )
    def test_nowhere(self, on_ground: Any, lat: float, lon: float, alt: float) -> None:
        before = on_ground.autopilot.home
        assert on_ground.result(HOME, 0, 0, 0, 0, lat, lon, alt) == DENIED
        assert on_ground.autopilot.home is before

    def test_not_where_it_is_switched_off(self, on_ground: Any) -> None:
        on_ground.vehicle.parameters.set("COM_HOME_EN", 0)
        assert on_ground.result(HOME, 1) == DENIED

    def test_before_there_is_a_position(self, flight: Any) -> None:
        early = flight()
        early.run(0.5)
        assert early.result(HOME, 1) == REJECTED


class TestOrbit:
    def test_what_is_asked(self, hover: Any, asked: list[Any]) -> None:
        assert command_int(hover, ORBIT, 5, 47.398, 8.546, 500.0, -20.0, 3.0) == ACCEPTED
        ((where, radius),) = asked
        assert (where.lat_deg, where.lon_deg, where.alt_m) == pytest.approx((47.398, 8.546, 500.0), abs=1e-6)
        assert (radius, where.speed_m_s) == (-20.0, 3.0)
        assert hover.autopilot.mode is Mode.ORBIT

    def test_goes_round(self, hover: Any) -> None:
        assert command_int(hover, ORBIT, 1, 0.0, 0.0, -5.0, 8.0, 3.0) == ACCEPTED
        hover.run(15.0)
        north, east, down = hover.vehicle.truth.position_ned()
        assert math.hypot(north, east) == pytest.approx(8.0, abs=1.0)
        assert math.hypot(*hover.vehicle.truth.velocity_ned()[:2]) == pytest.approx(3.0, abs=0.5)
        assert down == pytest.approx(-5.0, abs=0.5)
        heartbeat = hover.ground.named("HEARTBEAT")[-1]
        assert heartbeat.custom_mode == 3 << 16 | 1 << 24

    @pytest.mark.parametrize("params", [(NAN,) * 7, (0.0,) * 7, (math.inf, -math.inf, 0, 0, 1e30, -1e30, math.inf)])
    def test_absurd_ones_do_not_break_it(self, hover: Any, params: tuple[float, ...]) -> None:
        assert hover.result(ORBIT, *params) == ACCEPTED
        hover.run(2.0)
        assert all(map(math.isfinite, hover.vehicle.truth.position_ned()))

    def test_refused_in_words(self, flight: Any) -> None:
        one = flight().hover()
        assert one.result(185, 1) == ACCEPTED
        assert one.result(ORBIT, 8, 3) == REJECTED
        assert "Orbit command rejected" in one.ground.texts()

    def test_figures_of_eight_are_refused_in_words_only(self, hover: Any) -> None:
        assert hover.result(35, 8, 4) is None
        assert hover.ground.texts() == ["Figure 8 command not supported."]


class TestAltitude:
    @pytest.mark.parametrize(
        ("frame", "altitude", "amsl"), [(0, 510.0, 510.0), (5, 510.0, 510.0), (3, 9.0, 497.0), (6, 9.0, 497.0)]
    )
    def test_frames(self, hover: Any, asked: list[Any], frame: int, altitude: float, amsl: float) -> None:
        assert hover.result(ALTITUDE, altitude, frame) == ACCEPTED
        (where,) = asked
        assert where.alt_m == pytest.approx(amsl, abs=0.05)
        assert all(math.isnan(value) for value in (where.lat_deg, where.lon_deg, where.yaw, where.speed_m_s))

    def test_is_flown(self, hover: Any) -> None:
        assert hover.result(ALTITUDE, 8.0, 3) == ACCEPTED
        hover.run(8.0)
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(-8.0, abs=0.3)


class TestModesOfTheirOwn:
    def test_return(self, hover: Any) -> None:
        assert hover.result(RETURN) == ACCEPTED
        assert hover.autopilot.mode is Mode.RTL
        assert "Returning to launch\t" in hover.ground.texts()

    def test_land(self, hover: Any) -> None:
        assert hover.result(LAND) == ACCEPTED
        assert hover.ground.texts() == ["Landing at current position\t"]
        hover.run(15.0)
        assert not hover.autopilot.armed

    def test_precision_landing(self, hover: Any) -> None:
        assert hover.result(23) == ACCEPTED
        assert hover.autopilot.mode is Mode.PRECLAND
        assert hover.ground.texts() == ["Precision landing\t"]

    def test_vtol_takeoff(self, on_ground: Any) -> None:
        assert on_ground.result(84) == ACCEPTED
        assert on_ground.autopilot.mode is Mode.VTOL_TAKEOFF

    @pytest.mark.parametrize(
        ("standard", "mode"), [(1, Mode.POSCTL), (4, Mode.ALTCTL), (5, Mode.RTL), (6, Mode.MISSION)]
    )
    def test_standard_modes(self, on_ground: Any, standard: int, mode: Mode) -> None:
        assert on_ground.result(262, standard) == ACCEPTED
        assert on_ground.autopilot.mode is mode

    @pytest.mark.parametrize(("number", "result"), [(189, CANCELLED), (191, ACCEPTED)])
    def test_landing_patterns(self, hover: Any, number: int, result: int) -> None:
        assert hover.result(number) == result
        assert hover.autopilot.mode is Mode.LOITER

    @pytest.mark.parametrize("number", [80, 195, 196, 197, 201])
    def test_regions_of_interest_are_accepted(self, hover: Any, number: int) -> None:
        assert hover.result(number) == ACCEPTED
        assert hover.autopilot.mode is Mode.LOITER


class TestTakeoff:
    @pytest.mark.parametrize(("frame", "z"), [(0, 492.0), (3, 4.0), (6, 4.0)])
    def test_height(self, on_ground: Any, frame: int, z: float) -> None:
        assert on_ground.result(ARM, 1) == ACCEPTED
        assert command_int(on_ground, TAKEOFF, frame, NAN, NAN, z) == ACCEPTED
        on_ground.run(8.0)
        assert on_ground.vehicle.truth.position_ned()[2] == pytest.approx(-4.0, abs=0.3)

    def test_default_height_is_said(self, on_ground: Any) -> None:
        on_ground.vehicle.parameters.set("MIS_TAKEOFF_ALT", 3.25)
        assert on_ground.result(ARM, 1) == ACCEPTED
        assert on_ground.result(TAKEOFF, 0, 0, 0, NAN, NAN, NAN, NAN) == ACCEPTED
        assert "Using default takeoff altitude: 3.2 m\t" in on_ground.ground.texts()
        events = on_ground.ground.named("EVENT")
        assert len(events) == 1


class TestMission:
    ITEM = {"target_system": 1, "target_component": 1, "frame": 6, "autocontinue": 1}  # noqa: RUF012 - constant

    def load(self, one: Any) -> None:
        target = {"target_system": 1, "target_component": 1}
        lat, lon, _ = geodetic((10.0, 0.0, 0.0))
        assert one.ask("MISSION_COUNT", count=2, **target)[0].name == "MISSION_REQUEST_INT"
        items = [{"command": TAKEOFF, "param4": NAN}, {"command": 16}]
        for seq, item in enumerate(items):
            place = {"seq": seq, "x": round(lat * 1e7), "y": round(lon * 1e7), "z": 5.0}
            one.ask("MISSION_ITEM_INT", **self.ITEM, **place, **item)
        assert len(one.autopilot.control.mission.items) == 2

    @pytest.mark.parametrize("first", [NAN, -2.0, math.inf])
    def test_first_item_must_be_one(self, on_ground: Any, first: float) -> None:
        self.load(on_ground)
        assert on_ground.result(300, first) == DENIED
        assert not on_ground.autopilot.armed

    def test_without_one_it_is_denied_in_words(self, on_ground: Any) -> None:
        assert on_ground.result(300, 0) == DENIED
        assert "Mission start denied! No valid mission\t" in on_ground.ground.texts()

    def test_arms_and_flies(self, on_ground: Any) -> None:
        self.load(on_ground)
        assert on_ground.result(300, 0) == ACCEPTED
        assert on_ground.autopilot.armed
        assert on_ground.autopilot.mode is Mode.MISSION
        on_ground.run(15.0)
        assert on_ground.vehicle.truth.position_ned() == pytest.approx((10.0, 0.0, -5.0), abs=2.5)
        reached = [one["seq"] for one in on_ground.ground.named("MISSION_ITEM_REACHED")]
        assert reached[0] == 0
        progress = on_ground.ground.named("MISSION_CURRENT")[-1]
        assert (progress.total, progress.mission_state) == (2, 5)


def test_a_reposition_while_disarmed_only_changes_the_mode(on_ground: Any) -> None:
    assert on_ground.result(176, 1, 4, 6) == ACCEPTED
    assert on_ground.result(REPOSITION, -1, CHANGE_MODE, 0, NAN, NAN, NAN, NAN) == ACCEPTED
    assert on_ground.autopilot.mode is Mode.LOITER
    assert on_ground.autopilot.navigator.target_ned is None
