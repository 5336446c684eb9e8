"""What ground stations show at the edge of the screen: links, motors, radio, plans, remote identification."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from bridge import status_telemetry as status
from bridge.telemetry import Source
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

UTC_US = 1_795_387_540_000_000
"""2026-11-22 22:45:40 UTC."""


def request(one: Any, name: str, message_id: int, link: int = 0) -> Any:
    """Ask for one message; None if it is denied."""
    answers = one.command(512, message_id, only=(name, "COMMAND_ACK"), wait_s=0.004, link=link)
    accepted = next(answer.result for answer in answers if answer.name == "COMMAND_ACK") == 0
    found = [answer for answer in answers if answer.name == name]
    assert bool(found) == accepted
    return found[-1] if found else None


@pytest.fixture(scope="module")
def octo() -> Source:
    """A vehicle with eight motors, spinning on the ground."""
    model = resolve_vehicle("ant-x")
    rotors = tuple(
        replace(
            model.airframe.rotors[0],
            px_m=math.cos(k * math.pi / 4),
            py_m=math.sin(k * math.pi / 4),
            km=0.05 * (-1) ** k,
        )
        for k in range(8)
    )
    vehicle = Vehicle(replace(model, airframe=replace(model.airframe, rotors=rotors)), get_profile("sitl"))
    while vehicle.time_us < 2_500_000:
        vehicle.step()
    assert vehicle.autopilot.command_arm(True) == 0
    while vehicle.time_us < 4_000_000:
        vehicle.step()
    return Source(vehicle)


class TestLink:
    def test_counts_what_this_link_has_carried(self, flight: Any) -> None:
        both = flight("gcs", "onboard")
        both.run(1.1)
        for link in (0, 1):
            ground, connection = both.grounds[link], both.links[link].connection
            seen = request(both, "LINK_NODE_STATUS", 8, link)
            assert seen.messages_received == ground.connection.sent
            assert seen.messages_sent <= connection.sent <= seen.messages_sent + 60
            assert (seen.messages_lost, seen.rx_parse_err, seen.tx_overflows) == (0, 0, 0)

    def test_counts_what_was_lost_and_broken(self, on_ground: Any) -> None:
        ground = on_ground.ground
        for _ in range(5):
            ground.connection.encode("HEARTBEAT")  # never sent
        broken = bytearray(ground.connection.encode("HEARTBEAT", type=6))
        broken[-1] ^= 0xFF
        ground.end.send(bytes(broken))
        seen = request(on_ground, "LINK_NODE_STATUS", 8)
        assert seen.messages_lost == 6
        assert seen.rx_parse_err == 1

    def test_without_a_link_there_is_none(self) -> None:
        assert status.link_node_status(Source(Vehicle(resolve_vehicle("ant-x"), get_profile("sitl")))) is None


class TestMotors:
    def test_four_are_one_group(self, on_ground: Any) -> None:
        on_ground.run(3.0)
        info, esc = on_ground.ground.named("ESC_INFO"), on_ground.ground.named("ESC_STATUS")
        assert len(info) == len(esc) == 3
        assert {(one["index"], one.count, one.info, one.connection_type) for one in info} == {(0, 4, 0b1111, 0)}
        assert [one.counter for one in info] == sorted({one.counter for one in info})
        assert {one["index"] for one in esc} == {0}
        assert esc[-1].voltage == pytest.approx([16.2] * 4)
        assert esc[-1].current == (0.0,) * 4
        assert esc[-1].rpm == (0,) * 4

    def test_current_is_shared_by_thrust(self, flight: Any) -> None:
        hover = flight().hover()
        esc = request(hover, "ESC_STATUS", 291)
        battery = hover.vehicle.battery()
        assert sum(esc.current) == pytest.approx(battery.current_a, rel=0.05)
        assert min(esc.current) > 1.0
        assert esc.voltage[0] == pytest.approx(battery.voltage_v, rel=0.02)

    def test_eight_are_two_groups_in_turn(self, octo: Source) -> None:
        vehicle, groups, currents = octo.vehicle, [], 0.0
        for _ in range(4):
            info, esc = status.esc_info(octo), status.esc_status(octo)
            assert info["index"] == esc["index"]
            assert (info["count"], info["info"]) == (8, 0b1111)
            assert all(voltage > 10.0 for voltage in esc["voltage"])
            groups.append(info["index"])
            currents += sum(esc["current"]) / 2
            for _ in range(1_000_000 // vehicle.tick_us):
                vehicle.step()
        assert groups in ([0, 4, 0, 4], [4, 0, 4, 0])
        assert currents == pytest.approx(vehicle.battery().current_a, rel=0.05)

    @pytest.mark.parametrize(("motors", "online"), [(1, [1]), (5, [15, 1]), (6, [15, 3]), (12, [15, 15, 15])])
    def test_any_number_of_motors(self, monkeypatch: pytest.MonkeyPatch, motors: int, online: list[int]) -> None:
        vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"))
        monkeypatch.setattr(type(vehicle.autopilot), "motors", property(lambda _: (0.5,) * motors))
        source, seen = Source(vehicle), {}
        for _ in online:
            info, esc = status.esc_info(source), status.esc_status(source)
            seen[info["index"]] = info["info"]
            assert sum(1 for value in esc["voltage"] if value) == bin(info["info"]).count("1")
            assert sum(1 for value in esc["current"] if value) == bin(info["info"]).count("1")
            vehicle.tick += 1_000_000 // vehicle.tick_us
        assert [seen[4 * group] for group in range(len(online))] == online


class TestTarget:
    def test_nothing_on_the_ground(self, on_ground: Any) -> None:
        on_ground.run(2.0)
        assert on_ground.ground.named("POSITION_TARGET_GLOBAL_INT") == []
        assert request(on_ground, "POSITION_TARGET_GLOBAL_INT", 87) is None

    def test_where_hold_holds(self, flight: Any) -> None:
        hover = flight().hover(6.0)
        target = request(hover, "POSITION_TARGET_GLOBAL_INT", 87)
        assert (target.coordinate_frame, target.type_mask) == (5, 0)
        assert (target.lat_int, target.lon_int) == pytest.approx((473977420, 85455940), abs=60)
        assert target.alt == pytest.approx(494.0, abs=0.5)

    def test_nothing_where_no_place_is_held(self, flight: Any) -> None:
        assert request(flight().offboard(), "POSITION_TARGET_GLOBAL_INT", 87) is None

    def test_time_to_fly_home(self, flight: Any) -> None:
        one = flight().hover(10.0)
        lat, lon, alt = one.vehicle.origin
        assert one.result(192, -1, 1, 0, math.nan, lat + 30.0 / 111_195, lon, alt + 10.0) == 0
        one.run(20.0)
        times = request(one, "TIME_ESTIMATE_TO_TARGET", 380)
        cruise, sink = (one.vehicle.parameters.get(name) for name in ("MPC_XY_CRUISE", "MPC_LAND_SPEED"))
        assert times.safe_return == pytest.approx(30.0 / cruise + 10.0 / sink, abs=2.0)
        assert (times.land, times.mission_next_item, times.mission_end, times.commanded_action) == (-1, -1, -1, -1)

    def test_on_the_ground_it_is_home(self, on_ground: Any) -> None:
        assert request(on_ground, "TIME_ESTIMATE_TO_TARGET", 380).safe_return == 0

    def test_parameters_of_nothing_divide_by_nothing(self, flight: Any) -> None:
        hover = flight().hover()
        for name in ("MPC_XY_CRUISE", "MPC_LAND_SPEED"):
            for value in (0.0, math.nan, math.inf, -1.0):
                hover.vehicle.parameters.set(name, value)
                assert request(hover, "TIME_ESTIMATE_TO_TARGET", 380).safe_return >= -(2**31)


class TestRemoteIdentification:
    def test_on_the_ground(self, on_ground: Any) -> None:
        where = request(on_ground, "OPEN_DRONE_ID_LOCATION", 12901)
        assert where.status == 1
        assert (where.latitude, where.longitude) == pytest.approx((473977420, 85455940), abs=50)
        assert where.altitude_geodetic == pytest.approx(488.0, abs=0.1)
        assert where.height == pytest.approx(0.0, abs=0.1)
        assert (where.speed_horizontal, where.speed_vertical) == (0, 0)
        assert 0 <= where.direction < 36000
        assert where.timestamp == 65535.0  # nobody told it the time of day

    def test_in_flight(self, flight: Any) -> None:
        one = flight(utc_boot_us=UTC_US).hover()
        assert one.result(192, -1, 1, 0, math.nan, one.vehicle.origin[0], one.vehicle.origin[1] + 1e-3, 493.0) == 0
        one.run(6.0)
        where = request(one, "OPEN_DRONE_ID_LOCATION", 12901)
        assert where.status == 2
        assert where.direction == pytest.approx(9000, abs=300)
        assert where.speed_horizontal == pytest.approx(500, abs=60)
        assert where.height == pytest.approx(5.0, abs=0.5)
        hour_s = (UTC_US // 1_000_000 % 3600) + one.vehicle.time_us * 1e-6
        assert where.timestamp == pytest.approx(hour_s % 3600.0, abs=0.2)

    def test_the_operator_is_at_home(self, flight: Any) -> None:
        one = flight(utc_boot_us=UTC_US)
        one.run(3.0)
        assert one.result(179, 0, 0, 0, math.nan, 47.5, 8.25, 512.0) == 0
        who = request(one, "OPEN_DRONE_ID_SYSTEM", 12904)
        assert (who.operator_latitude, who.operator_longitude) == pytest.approx((475000000, 82500000), abs=20)
        assert who.operator_altitude_geo == 512.0
        assert (who.operator_location_type, who.area_count, who.area_ceiling, who.area_floor) == (
            0,
            1,
            -1000.0,
            -1000.0,
        )
        assert who.timestamp == pytest.approx(UTC_US // 1_000_000 - 1_546_300_800 + 3, abs=1)

    def test_without_the_time_of_day(self, on_ground: Any) -> None:
        assert request(on_ground, "OPEN_DRONE_ID_SYSTEM", 12904).timestamp == 0


def test_no_radio_no_channels(on_ground: Any) -> None:
    assert request(on_ground, "RC_CHANNELS", 65) is None


@pytest.mark.parametrize("value", [1e40, -1e300, math.inf, -math.inf, math.nan])
def test_a_vehicle_that_diverges_is_still_told(on_ground: Any, monkeypatch: pytest.MonkeyPatch, value: float) -> None:
    state = on_ground.vehicle.estimate
    monkeypatch.setattr(state, "velocity_ned", lambda: (value, value, value))
    monkeypatch.setattr(state, "position_ned", lambda: (value, value, value))
    monkeypatch.setattr(on_ground.autopilot.land_detector, "landed", False)
    for name, message_id in (("OPEN_DRONE_ID_LOCATION", 12901), ("TIME_ESTIMATE_TO_TARGET", 380)):
        assert request(on_ground, name, message_id) is not None
