from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bridge.connection import Connection
from bridge.messages import BY_NAME
from sitl.modes import Severity

OFFBOARD = 6 << 16
HOLD = 4 << 16 | 3 << 24

# Hz, as a real PX4 streamed in Hold; of what this vehicle streams.
GCS_HZ = {
    "ALTITUDE": 1,
    "ATTITUDE": 50,
    "ATTITUDE_QUATERNION": 50,
    "ATTITUDE_TARGET": 50,
    "BATTERY_STATUS": 0.5,
    "CURRENT_EVENT_SEQUENCE": 1 / 3,
    "CURRENT_MODE": 0.5,
    "ESC_INFO": 1,
    "ESC_STATUS": 1,
    "ESTIMATOR_STATUS": 0.5,
    "EXTENDED_SYS_STATE": 1,
    "GLOBAL_POSITION_INT": 50,
    "GPS_RAW_INT": 5,
    "HEARTBEAT": 1,
    "HOME_POSITION": 0.5,
    "LINK_NODE_STATUS": 1,
    "LOCAL_POSITION_NED": 50,
    "MISSION_CURRENT": 1,
    "OPEN_DRONE_ID_LOCATION": 1,
    "OPEN_DRONE_ID_SYSTEM": 1,
    "PING": 0.1,
    "POSITION_TARGET_GLOBAL_INT": 1,
    "POSITION_TARGET_LOCAL_NED": 50,
    "SCALED_PRESSURE": 1,
    "SERVO_OUTPUT_RAW": 50,
    "SYS_STATUS": 1,
    "TIME_ESTIMATE_TO_TARGET": 0.5,
    "VFR_HUD": 4,
    "VIBRATION": 0.1,
}
API_HZ = {
    "ALTITUDE": 10,
    "ATTITUDE": 100,
    "ATTITUDE_QUATERNION": 50,
    "ATTITUDE_TARGET": 10,
    "BATTERY_STATUS": 0.5,
    "CURRENT_EVENT_SEQUENCE": 1 / 3,
    "CURRENT_MODE": 0.5,
    "ESC_INFO": 10,
    "ESC_STATUS": 10,
    "ESTIMATOR_STATUS": 1,
    "EXTENDED_SYS_STATE": 5,
    "GLOBAL_POSITION_INT": 50,
    "GPS_RAW_INT": 10,
    "HEARTBEAT": 1,
    "HIGHRES_IMU": 50,
    "HOME_POSITION": 0.5,
    "LINK_NODE_STATUS": 1,
    "LOCAL_POSITION_NED": 30,
    "MISSION_CURRENT": 1,
    "ODOMETRY": 30,
    "OPEN_DRONE_ID_LOCATION": 1,
    "OPEN_DRONE_ID_SYSTEM": 1,
    "PING": 1,
    "POSITION_TARGET_GLOBAL_INT": 10,
    "POSITION_TARGET_LOCAL_NED": 10,
    "SCALED_PRESSURE": 1,
    "SERVO_OUTPUT_RAW": 10,
    "SYS_STATUS": 5,
    "TIMESYNC": 10,
    "TIME_ESTIMATE_TO_TARGET": 0.5,
    "VFR_HUD": 10,
    "VIBRATION": 0.5,
}


def test_default_rates_are_those_of_a_px4(flight: Any) -> None:
    both = flight("gcs", "onboard").hover()
    both.run(20.0)
    for ground, expected in zip(both.grounds, (GCS_HZ, API_HZ), strict=True):
        heard = Counter(message.name for _, message in ground.heard if message.sysid == 1)
        heard.pop("STATUSTEXT", None)
        assert set(heard) == set(expected)
        for name, hz in expected.items():
            assert heard[name] == pytest.approx(20 * hz, abs=1), name


class TestHeartbeat:
    def status(self, flight: Any) -> tuple[int, int, int]:
        flight.forget()
        flight.run(1.0)
        heartbeat = flight.ground.named("HEARTBEAT")[-1]
        assert (heartbeat.type, heartbeat.autopilot, heartbeat.mavlink_version) == (2, 12, 3)
        return heartbeat.base_mode, heartbeat.custom_mode, heartbeat.system_status

    def test_through_a_flight(self, flight: Any) -> None:
        one = flight()
        assert self.status(one) == (29, HOLD, 0)
        one.run(2.0)
        assert self.status(one) == (29, HOLD, 3)
        one.hover()
        assert self.status(one) == (157, HOLD, 4)
        one.run(1.0, one.at_20_hz(one.set_point))
        one.result(176, 1, 6)
        one.forget()
        one.run(1.0, one.at_20_hz(one.set_point))
        heartbeat = one.ground.named("HEARTBEAT")[-1]
        assert (heartbeat.base_mode, heartbeat.custom_mode, heartbeat.system_status) == (145, OFFBOARD, 4)
        one.forget()
        one.run(1.0, one.at_20_hz(lambda: one.set_point(mask=128)))
        assert one.ground.named("HEARTBEAT")[-1].base_mode == 129

    def test_prearm_bit(self, flight: Any) -> None:
        one = flight()
        one.run(1.0)
        assert one.ground.named("SYS_STATUS")[-1].onboard_control_sensors_health == 0x0300800F
        one.run(2.0)
        status = one.ground.named("SYS_STATUS")[-1]
        # as a PX4 in simulation: a radio is enabled though there is none, AHRS and attitude are only ever healthy
        assert status.onboard_control_sensors_present == 0x0300C02F
        assert status.onboard_control_sensors_enabled == 0x0301C02F
        assert status.onboard_control_sensors_health == 0x1320C82F


class TestTelemetry:
    def test_says_where_the_vehicle_is(self, flight: Any) -> None:
        hover = flight("onboard").hover(8.0)
        hover.run(3.0)
        heard = {message.name: message for _, message in hover.ground.heard}
        truth = hover.vehicle.truth
        north, east, down = truth.position_ned()
        local = heard["LOCAL_POSITION_NED"]
        assert (local.x, local.y, local.z) == pytest.approx((north, east, down), abs=0.02)
        place = heard["GLOBAL_POSITION_INT"]
        assert place.relative_alt == pytest.approx(8000, abs=300)
        assert place.alt == pytest.approx(488_000 - down * 1000, abs=30)
        assert (place.lat, place.lon) == pytest.approx((473977420, 85455940), abs=50)
        assert 0 <= place.hdg < 36000
        assert heard["EXTENDED_SYS_STATE"].landed_state == 2
        assert heard["VFR_HUD"].alt == pytest.approx(488 - down, abs=0.05)
        assert math.isnan(heard["VFR_HUD"].airspeed)
        assert heard["VFR_HUD"].throttle == pytest.approx(50, abs=5)
        assert heard["HIGHRES_IMU"].zacc == pytest.approx(-9.81, abs=0.5)
        assert heard["BATTERY_STATUS"].voltages[1:] == (65535,) * 9
        assert heard["SERVO_OUTPUT_RAW"].servo1_raw == pytest.approx(1500, abs=60)
        assert heard["SERVO_OUTPUT_RAW"].servo5_raw == 0
        assert heard["HOME_POSITION"].altitude == pytest.approx(488_000, abs=30)

    def test_is_stamped_with_the_tick_it_shows(self, on_ground: Any) -> None:
        for message_id in (30, 93):
            assert on_ground.result(511, message_id, 4000) == 0
        on_ground.forget()
        on_ground.run(0.4)
        for now_us, message in on_ground.ground.heard:
            if message.name == "ATTITUDE":
                assert message.time_boot_ms == now_us // 1000
            elif message.name == "HIL_ACTUATOR_CONTROLS":
                assert message.time_usec == now_us

    def test_disarmed_outputs(self, on_ground: Any) -> None:
        on_ground.command(511, 375, 100_000)
        on_ground.command(511, 93, 100_000)
        on_ground.forget()
        on_ground.run(0.5)
        heard = {message.name: message for _, message in on_ground.ground.heard}
        assert [getattr(heard["SERVO_OUTPUT_RAW"], f"servo{n}_raw") for n in (1, 4, 5)] == [900, 900, 0]
        assert heard["ACTUATOR_OUTPUT_STATUS"].active == 0b1111
        assert heard["ACTUATOR_OUTPUT_STATUS"].actuator[:5] == (900.0, 900.0, 900.0, 900.0, 0.0)
        assert heard["HIL_ACTUATOR_CONTROLS"].controls == (0.0,) * 16
        assert heard["HIL_ACTUATOR_CONTROLS"].mode == 1

    def test_packet_numbers_leave_no_gap(self, flight: Any) -> None:
        hover = flight("onboard").hover()
        assert hover.ground.connection.counters.lost == 0


class TestOffboard:
    @pytest.mark.parametrize("mask", [0, 7, 3, 128, 23, 132])
    def test_whole_set_points_keep_it(self, flight: Any, mask: int) -> None:
        one = flight().offboard()
        one.run(2.0, one.at_20_hz(lambda: one.set_point(mask=mask)))
        assert one.autopilot.mode == 14

    @pytest.mark.parametrize("mask", [0x87, 0xC7, 255, 128 | 6, 128 | 1])
    def test_parts_of_one_do_not(self, flight: Any, mask: int) -> None:
        one = flight().offboard()
        one.run(2.0, one.at_20_hz(lambda: one.set_point(mask=mask)))
        assert one.autopilot.mode != 14
        assert one.autopilot.failsafe

    @pytest.mark.parametrize(
        "fields",
        [
            {"q": (0.0, 0.0, 0.0, 0.0)},
            {"q": (math.nan, 0.0, 0.0, 0.0)},
            {"q": (math.inf, 0.0, 0.0, 0.0)},
            {"thrust": math.nan},
            {"thrust": math.inf},
            {"mask": 0, "body_roll_rate": math.nan},
            {"mask": 128, "body_pitch_rate": math.inf},
            {"target_system": 9},
            {"target_component": 9},
        ],
    )
    def test_nonsense_is_no_set_point(self, flight: Any, fields: dict[str, Any]) -> None:
        one = flight().offboard()
        before = one.autopilot.attitude_sp.serial
        one.run(0.5, one.at_20_hz(lambda: one.set_point(**fields)))
        assert one.autopilot.attitude_sp.serial == before
        one.run(1.0)
        assert one.autopilot.mode != 14
        assert all(math.isfinite(value) for value in one.vehicle.truth.quat())

    def test_nonsense_is_said_once_a_second(self, flight: Any) -> None:
        one = flight().offboard()
        one.run(2.9, one.at_20_hz(lambda: one.set_point(q=(0.0, 0.0, 0.0, 0.0))))
        said = [text for text in one.ground.texts() if "no rotation" in text]
        assert len(said) == 3
        assert one.server.refused > 50

    def test_target_zero_is_accepted(self, flight: Any) -> None:
        one = flight().offboard()
        one.run(2.0, one.at_20_hz(lambda: one.set_point(target_system=0, target_component=0)))
        assert one.autopilot.mode == 14

    def test_a_roll_step_rolls_and_is_echoed(self, flight: Any) -> None:
        one = flight().offboard()
        one.run(0.6, one.at_20_hz(lambda: one.set_point(0.2, thrust=-0.5)))
        target = one.ground.named("ATTITUDE_TARGET")[-1]
        assert target.q == pytest.approx((math.cos(0.1), math.sin(0.1), 0, 0), abs=1e-6)
        assert target.thrust == pytest.approx(0.5)
        assert target.type_mask == 0
        assert one.ground.named("ATTITUDE")[-1].roll == pytest.approx(0.2, abs=0.05)

    def test_body_rates(self, flight: Any) -> None:
        one = flight().offboard()
        one.run(0.5, one.at_20_hz(lambda: one.set_point(mask=128, body_roll_rate=0.3)))
        target = one.ground.named("ATTITUDE_TARGET")[-1]
        assert target.q == (1.0, 0.0, 0.0, 0.0)
        assert target.body_roll_rate == pytest.approx(0.3)
        assert one.ground.named("ATTITUDE")[-1].rollspeed == pytest.approx(0.3, abs=0.1)

    @pytest.mark.parametrize(
        ("mask", "fields", "thrust"),
        [(7 | 64, {}, 0.0), (7 | 32, {"thrust": 0.1, "thrust_body": (0.0, 0.0, -0.45)}, 0.45)],
    )
    def test_thrust_masks(self, flight: Any, mask: int, fields: dict[str, Any], thrust: float) -> None:
        one = flight().offboard()
        one.run(0.1, lambda: one.set_point(mask=mask, **fields))
        assert one.autopilot.attitude_sp.thrust == pytest.approx(thrust)


class TestTexts:
    def test_only_for_a_ground_station(self, flight: Any) -> None:
        one = flight(heartbeats=False)
        one.run(6.0)  # what it said of its start is no news any more
        one.ground.send("HEARTBEAT", type=2)  # another vehicle
        one.server.say(Severity.INFO, "Is anybody there?")
        one.run(1.0)
        assert one.ground.texts() == []
        one.ground.send("HEARTBEAT", type=6)
        one.run(0.1)
        assert one.ground.texts() == ["Is anybody there?"]

    def test_old_ones_are_not_said(self, flight: Any) -> None:
        one = flight(heartbeats=False)
        one.server.say(Severity.INFO, "old")
        one.run(4.0)
        one.server.say(Severity.INFO, "new")
        one.run(2.0)
        one.ground.send("HEARTBEAT", type=6)
        one.run(0.1)
        assert one.ground.texts() == ["new"]

    def test_why_it_would_not_arm_yet_is_said_once_on_the_way_up(self, flight: Any) -> None:
        one = flight()
        one.run(0.38)
        assert one.ground.texts() == []
        one.run(0.03)
        assert one.ground.texts() == ["Preflight Fail: heading estimate invalid"]
        assert [chunk.severity for chunk in one.ground.named("STATUSTEXT")] == [2]
        assert one.result(400, 1) == 1
        one.run(4.0)
        assert one.ground.texts().count("Preflight Fail: heading estimate invalid") == 0

    def test_what_is_no_event_keeps_no_tab(self, on_ground: Any) -> None:
        on_ground.server.say(Severity.INFO, "Not in any list\t")
        on_ground.server.say(Severity.INFO, "Takeoff detected\t")
        on_ground.run(0.1)
        assert on_ground.ground.texts() == ["Not in any list", "Takeoff detected\t"]
        assert len(on_ground.ground.named("EVENT")) == 1

    def test_a_ground_station_that_went_silent_gets_none(self, flight: Any) -> None:
        one = flight(heartbeats=False)
        one.ground.send("HEARTBEAT", type=6)
        one.run(2.4)
        assert one.server.hears_gcs()
        one.run(0.3)
        assert not one.server.hears_gcs()

    @pytest.mark.parametrize("length", [1, 49, 50, 51, 99, 100, 101, 233])
    def test_chunks_make_up_the_text_and_end_it(self, on_ground: Any, length: int) -> None:
        text = "".join(chr(ord("a") + index % 26) for index in range(length))
        on_ground.server.say(Severity.WARNING, text)
        on_ground.server.say(Severity.WARNING, "next")
        on_ground.run(0.1)
        chunks = on_ground.ground.named("STATUSTEXT")
        assert on_ground.ground.texts() == [text, "next"]
        assert [one.chunk_seq for one in chunks[:-1]] == list(range(len(chunks) - 1))
        assert len(chunks[-2].text) < 50  # a full last chunk would mean: more to come
        assert len({one["id"] for one in chunks}) == 2
        assert 0 not in {one["id"] for one in chunks}
        assert {one.severity for one in chunks} == {4}

    def test_are_bounded(self, flight: Any) -> None:
        one = flight(heartbeats=False)
        for number in range(1000):
            one.server.say(Severity.INFO, str(number))
        assert len(one.links[0].texts) <= 64


class TestServices:
    def test_timesync(self, on_ground: Any) -> None:
        on_ground.command(511, 111, -1)
        (answer,) = on_ground.ask("TIMESYNC", tc1=0, ts1=123456789012)
        assert answer.ts1 == 123456789012
        assert 3_000_000_000 < answer.tc1 <= on_ground.vehicle.time_us * 1000
        assert on_ground.ask("TIMESYNC", tc1=5, ts1=1) == []

    def test_ping(self, on_ground: Any) -> None:
        answers = on_ground.ask("PING", time_usec=111, seq=7, only=("PING",))
        mine = [one for one in answers if one.target_system]
        assert [(one.time_usec, one["seq"], one.target_system, one.target_component) for one in mine] == [
            (111, 7, 255, 190)
        ]
        for target in ((1, 0), (9, 1), (1, 1)):
            answers = on_ground.ask(
                "PING",
                time_usec=1,
                seq=1,
                target_system=target[0],
                target_component=target[1],
                only=("PING",),
            )
            assert [one for one in answers if one.target_system] == []

    def test_parameter_set_is_echoed(self, on_ground: Any) -> None:
        answers = on_ground.ask(
            "PARAM_SET",
            target_system=1,
            target_component=1,
            param_id="MC_ROLL_P",
            param_value=7.25,
            param_type=9,
        )
        assert next((one.name, one.param_id, one.param_value) for one in answers) == (
            "PARAM_VALUE",
            "MC_ROLL_P",
            7.25,
        )
        assert on_ground.vehicle.parameters.get("MC_ROLL_P") == 7.25

    def test_a_change_is_announced_on_every_link(self, flight: Any) -> None:
        both = flight("gcs", "onboard")
        both.run(1.0)
        both.ask(
            "PARAM_SET",
            target_system=1,
            target_component=1,
            param_id="MC_ROLL_P",
            param_value=7.25,
            param_type=9,
        )
        both.run(0.5)
        assert [one.param_id for one in both.grounds[1].named("PARAM_VALUE")] == ["MC_ROLL_P"]

    def test_parameter_list_is_complete_and_paced(self, on_ground: Any) -> None:
        on_ground.forget()
        on_ground.ground.send("PARAM_REQUEST_LIST", target_system=1, target_component=1)
        count = len(on_ground.vehicle.parameters)
        on_ground.run(count / 20 * 0.012 + 0.1)
        values = on_ground.ground.named("PARAM_VALUE")
        assert [one.param_id for one in values] == ["_HASH_CHECK", *on_ground.vehicle.parameters.names]
        per_tick: dict[int, int] = {}
        for now_us, message in on_ground.ground.heard:
            if message.name == "PARAM_VALUE":
                per_tick[now_us] = per_tick.get(now_us, 0) + 1
        assert max(per_tick.values()) <= 20

    @pytest.mark.parametrize(
        ("plan", "command", "radius_m", "loads"), [(0, 16, 0, True), (1, 5003, 50, False), (2, 5100, 0, False)]
    )
    def test_plans_go_up_and_come_back(
        self, on_ground: Any, plan: int, command: int, radius_m: float, loads: bool
    ) -> None:
        target = {"target_system": 1, "target_component": 1, "mission_type": plan}
        item = {**target, "seq": 0, "command": command, "x": 473977500, "y": 85456000, "z": 10.0, "autocontinue": 1}
        item |= {"frame": 3, "param1": radius_m}
        (count,) = on_ground.ask("MISSION_REQUEST_LIST", **target)
        assert (count.name, count.count, count.mission_type) == ("MISSION_COUNT", 0, plan)
        assert (count.target_system, count.target_component) == (255, 190)
        assert on_ground.ask("MISSION_ACK", **target) == []
        (request,) = on_ground.ask("MISSION_COUNT", count=1, **target)
        assert (request.name, request["seq"], request.mission_type) == ("MISSION_REQUEST_INT", 0, plan)
        assert [one.type for one in on_ground.ask("MISSION_ITEM_INT", **item)] == [0]
        assert bool(on_ground.autopilot.control.mission.items) is loads
        (count,) = on_ground.ask("MISSION_REQUEST_LIST", **target)
        assert count.count == 1
        (back,) = on_ground.ask("MISSION_REQUEST_INT", **target)
        assert (back.command, back.x, back.y, back.z, back.param1) == (command, 473977500, 85456000, 10.0, radius_m)
        on_ground.ask("MISSION_ACK", **target)
        assert [one.type for one in on_ground.ask("MISSION_CLEAR_ALL", **target)] == [0]
        assert on_ground.autopilot.control.mission.items == ()
        assert on_ground.ask("MISSION_REQUEST_LIST", target_system=4, target_component=1) == []

    @pytest.mark.parametrize(
        ("opcode", "reply", "error"),
        [(4, 129, 10), (3, 129, 10), (15, 129, 4), (14, 129, 10), (1, 129, 4), (2, 128, None), (77, 129, 7)],
    )
    def test_files_are_not_found(self, on_ground: Any, opcode: int, reply: int, error: int | None) -> None:
        request = struct.pack("<HBBBBBBI", 65535, 0, opcode, 6, 0, 0, 0, 0) + b"@PARAM"
        answers = on_ground.ask(
            "FILE_TRANSFER_PROTOCOL", target_system=1, target_component=1, payload=request, wait_s=0.01
        )
        (answer,) = answers
        seq, _, code, size, asked, _, _, _ = struct.unpack_from("<HBBBBBBI", answer.payload)
        assert (seq, code, asked) == (0, reply, opcode)
        assert answer.payload[12 : 12 + size] == (b"" if error is None else bytes([error]))

    def test_without_logs_there_is_silence(self, on_ground: Any) -> None:
        assert on_ground.ask("LOG_REQUEST_LIST", target_system=1, target_component=1, end=65535) == []
        assert on_ground.ask("LOG_REQUEST_DATA", target_system=1, target_component=1, count=90) == []

    @pytest.mark.parametrize(
        "name",
        ["REQUEST_DATA_STREAM", "COMMAND_ACK", "SYSTEM_TIME", "GPS_RTCM_DATA", "PARAM_VALUE", "ATTITUDE"],
    )
    def test_what_a_px4_ignores_is_ignored(self, on_ground: Any, name: str) -> None:
        assert on_ground.ask(name) == []


class TestRobustness:
    def test_a_peer_that_goes_takes_nobody_along(self, flight: Any) -> None:
        both = flight("gcs", "onboard")
        both.run(3.0)
        both.grounds[0].end.close()
        del both.grounds[0]
        both.forget()
        both.run(2.0)
        assert both.grounds[0].counts()["ATTITUDE"] == 200
        assert both.links[0].peers == set()

    def test_a_defect_is_counted_and_said_but_not_raised(self, flight: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        one = flight(strict=False)
        monkeypatch.setattr(one.autopilot, "offboard_attitude", lambda *_: 1 / 0)
        one.run(2.95, one.at_20_hz(one.set_point))
        assert one.server.defects > 50
        said = [text for text in one.ground.texts() if "ZeroDivisionError" in text]
        assert len(said) == 3
        assert one.ground.counts()["ATTITUDE"] > 100

    def test_tests_see_defects(self, flight: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        one = flight()
        monkeypatch.setattr(one.autopilot, "offboard_attitude", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            one.run(0.1, one.set_point)

    def test_a_vehicle_that_diverges_is_still_heard(self, on_ground: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        for state in (on_ground.vehicle.estimate, on_ground.vehicle.truth):
            monkeypatch.setattr(state, "rates", lambda: (1e40, -1e300, math.nan))
            monkeypatch.setattr(state, "velocity_ned", lambda: (1e40, -1e40, math.nan))
            monkeypatch.setattr(state, "position_ned", lambda: (1e6, math.inf, -1e39))
        on_ground.run(1.1)
        heard = {message.name: message for _, message in on_ground.ground.heard}
        assert (heard["ATTITUDE"].rollspeed, heard["ATTITUDE"].pitchspeed) == (math.inf, -math.inf)
        assert math.isnan(heard["ATTITUDE"].yawspeed)
        place = heard["GLOBAL_POSITION_INT"]
        assert (place.vx, place.vy, place.vz) == (32767, -32768, 0)
        for message_id in (331, 105, 26, 74, 141, 115):
            assert on_ground.result(512, message_id) == 0

    def test_telemetry_that_cannot_be_built_does_not_hold_up_the_rest(
        self, flight: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        one = flight(strict=False)
        monkeypatch.setattr(one.vehicle.estimate, "quat", lambda: 1 / 0)
        one.run(2.0)
        heard = one.ground.counts()
        assert heard["ATTITUDE_QUATERNION"] == 0
        assert heard["LOCAL_POSITION_NED"] == pytest.approx(100, abs=2)
        assert heard["GLOBAL_POSITION_INT"] == pytest.approx(100, abs=2)
        assert one.server.defects >= 99

    def test_a_flood_is_read_over_several_ticks(self, on_ground: Any) -> None:
        for _ in range(500):
            on_ground.ground.send("COMMAND_LONG", target_system=1, target_component=1, command=400)
        on_ground.run(0.004)
        first = on_ground.ground.counts()["COMMAND_ACK"]
        on_ground.run(0.08)
        assert 0 < first < 50
        assert on_ground.ground.counts()["COMMAND_ACK"] == 500

    def test_same_seed_same_bytes(self, flight: Any) -> None:
        def frames() -> list[bytes]:
            one = flight("gcs", "onboard").offboard()
            one.run(1.0, one.at_20_hz(lambda: one.set_point(0.1)))
            return [message.raw_frame for ground in one.grounds for _, message in ground.heard]

        assert frames() == frames()


_NUMBERS = {
    "float": st.floats(width=32),
    "double": st.floats(),
    **{
        f"{sign}int{bits}_t": st.integers(
            0 if sign else -(2 ** (bits - 1)), 2**bits - 1 if sign else 2 ** (bits - 1) - 1
        )
        for sign in ("", "u")
        for bits in (8, 16, 32, 64)
    },
}
_NUMBERS["uint8_t"] = st.integers(0, 255) | st.sampled_from([0, 1, 255, 190])


@st.composite
def _any_message(draw: Callable[..., Any], names: list[str]) -> tuple[str, dict[str, Any]]:
    kind = BY_NAME[draw(st.sampled_from(names))]
    fields: dict[str, Any] = {}
    for field in kind.fields:
        if field.name.startswith("target_"):
            fields[field.name] = draw(st.sampled_from([0, 1, 1, 1, 9]))
        elif field.type == "char" or (field.count and field.type == "uint8_t"):
            fields[field.name] = draw(st.binary(max_size=field.size))
        elif field.count:
            fields[field.name] = draw(st.lists(_NUMBERS[field.type], min_size=field.count, max_size=field.count))
        else:
            fields[field.name] = draw(_NUMBERS[field.type])
    return kind.name, fields


_HEARD = [
    "HEARTBEAT",
    "COMMAND_LONG",
    "COMMAND_INT",
    "SET_MODE",
    "SET_ATTITUDE_TARGET",
    "SET_POSITION_TARGET_LOCAL_NED",
    "TIMESYNC",
    "PING",
    "PARAM_SET",
    "PARAM_REQUEST_READ",
    "PARAM_REQUEST_LIST",
    "MISSION_REQUEST_LIST",
    "MISSION_COUNT",
    "MISSION_REQUEST_INT",
    "FILE_TRANSFER_PROTOCOL",
    "LOG_REQUEST_LIST",
]
_SOCIABLE = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@_SOCIABLE
@given(message=_any_message(_HEARD))
def test_no_message_breaks_the_vehicle(on_ground: Any, message: tuple[str, dict[str, Any]]) -> None:
    name, fields = message
    on_ground.ground.send(name, **fields)
    on_ground.run(0.02)


@_SOCIABLE
@given(data=st.data())
def test_no_bytes_break_the_vehicle(on_ground: Any, data: Any) -> None:
    frame = bytearray(
        Connection(255, 190).encode("COMMAND_LONG", target_system=1, target_component=1, command=511, param1=30.0)
    )
    for _ in range(data.draw(st.integers(1, 4))):
        frame[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
    on_ground.ground.end.send(bytes(frame))
    on_ground.ground.end.send(data.draw(st.binary(max_size=300)))
    on_ground.run(0.008)
