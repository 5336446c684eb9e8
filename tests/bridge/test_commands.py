from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from sitl.modes import Mode

NAN = math.nan
INT32_MAX = 2**31 - 1
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
ARM, MODE, TAKEOFF, LAND, HOME = 400, 176, 22, 21, 179
REQUEST, SET_INTERVAL, GET_INTERVAL = 512, 511, 510


class TestAcknowledgement:
    def test_is_one_and_names_the_sender(self, on_ground: Any) -> None:
        (ack,) = on_ground.command(ARM, 0)
        assert (ack.name, ack.command, ack.result) == ("COMMAND_ACK", ARM, ACCEPTED)
        assert (ack.target_system, ack.target_component) == (255, 190)
        assert (ack.sysid, ack.compid) == (1, 1)

    def test_set_mode_is_acknowledged_once(self, on_ground: Any) -> None:
        assert [one.name for one in on_ground.command(MODE, 1, 4, 3)] == ["COMMAND_ACK"]

    def test_goes_to_the_links_where_the_sender_was_heard(self, flight: Any) -> None:
        two = flight("gcs", "onboard")
        two.run(3.0)
        assert two.result(ARM, 0, link=1) == ACCEPTED
        assert two.grounds[0].named("COMMAND_ACK") == []

    def test_commander_answers_after_everything_that_came_with_the_command(self, on_ground: Any) -> None:
        target = {"target_system": 1, "target_component": 1}
        on_ground.ground.send("COMMAND_LONG", command=ARM, param1=0, **target)
        on_ground.ground.send("COMMAND_LONG", command=REQUEST, param1=300, **target)
        on_ground.ground.send("PING", time_usec=5, seq=1)
        on_ground.ground.send("COMMAND_LONG", command=MODE, param1=1, param2=4, param3=3, **target)
        on_ground.run(0.004)
        heard = on_ground.ground.named("COMMAND_ACK", "PROTOCOL_VERSION", "PING")
        assert [one.command if one.name == "COMMAND_ACK" else one.name for one in heard] == [
            "PROTOCOL_VERSION",
            REQUEST,
            "PING",
            ARM,
            MODE,
        ]

    def test_every_one_of_a_burst_is_answered(self, on_ground: Any) -> None:
        for _ in range(40):
            on_ground.ground.send("COMMAND_LONG", target_system=1, target_component=1, command=12345)
        on_ground.run(0.1)
        assert [one.result for one in on_ground.ground.named("COMMAND_ACK")] == [UNSUPPORTED] * 40


class TestTarget:
    @pytest.mark.parametrize(("system", "component"), [(0, 1), (1, 0), (0, 0)])
    def test_zero_means_everybody(self, on_ground: Any, system: int, component: int) -> None:
        assert on_ground.result(ARM, 0, target_system=system, target_component=component) == ACCEPTED

    @pytest.mark.parametrize(("system", "component"), [(9, 1), (1, 99), (9, 99)])
    def test_others_are_silence(self, on_ground: Any, system: int, component: int) -> None:
        assert on_ground.command(ARM, 1, target_system=system, target_component=component) == []
        assert not on_ground.autopilot.armed

    def test_capabilities_are_told_to_whoever_asks_any_component(self, on_ground: Any) -> None:
        names = [one.name for one in on_ground.command(520, 1, target_component=99)]
        assert names == ["AUTOPILOT_VERSION", "COMMAND_ACK"]

    def test_our_own_echo_is_ignored(self, flight: Any) -> None:
        echo = flight()
        echo.ground.connection.sysid = echo.ground.connection.compid = 1
        echo.run(3.0)
        assert echo.command(ARM, 1) == []


# What a real PX4 answered to the same command in the same state, where this vehicle does the same.
ON_GROUND = [
    (ARM, (0,), ACCEPTED),
    (ARM, (NAN,), ACCEPTED),  # not a number disarms
    (MODE, (1, 4, 3), ACCEPTED),
    (MODE, (1, 4, 2), ACCEPTED),
    (MODE, (1, 4, 6), ACCEPTED),
    (MODE, (1, 6), ACCEPTED),  # Offboard without set-points, disarmed
    (MODE, (1, 4, 1), REJECTED),
    (MODE, (1, 4, 7), REJECTED),
    (MODE, (1, 8), REJECTED),
    (MODE, (1, 10), REJECTED),
    (MODE, (1, 0), REJECTED),
    (MODE, (1, 255), REJECTED),
    (TAKEOFF, (0, 0, 0, NAN, NAN, NAN, NAN), ACCEPTED),
    (TAKEOFF, (0, 0, 0, 0, INT32_MAX, INT32_MAX, 0), DENIED),
    (LAND, (0, 0, 0, NAN, NAN, NAN, NAN), ACCEPTED),
    (HOME, (1,), ACCEPTED),
    (HOME, (0, 0, 0, NAN, NAN, NAN, NAN), DENIED),
    (300, (0,), DENIED),
    (193, (0,), UNSUPPORTED),
    (115, (90, 10, 1), UNSUPPORTED),
    (183, (1, 1500), UNSUPPORTED),
    (246, (0,), ACCEPTED),
    (246, (1,), DENIED),
    (246, (7,), DENIED),
    (241, (), ACCEPTED),
    (185, (1,), DENIED),
    (192, (-1, 0), UNSUPPORTED),
    (401, (), ACCEPTED),
    (2500, (), UNSUPPORTED),
    (224, (5,), UNSUPPORTED),
    (31010, (), UNSUPPORTED),
    (12345, (), UNSUPPORTED),
]


# What a PX4 without cameras, gimbals, a gripper and the like leaves unanswered.
SILENT = {
    *(0, 1, 2, 35, 93, 203, 204, 205, 206, 211, 214, 220, 242, 243, 260, 311, 500, 521, 530, 531, 532),
    *(1000, 1001, 2003, 2511, 3000, 30001, 30002, 42600),
}
SOMETIMES_SILENT = {245, 310, 400, 420}


@pytest.mark.parametrize("number", sorted(SILENT))
def test_what_a_px4_leaves_to_others_is_silence(on_ground: Any, number: int) -> None:
    assert on_ground.result(number, 1, 1, 1, 1, 1, 1, 1) is None
    assert on_ground.server.refused == 0


@pytest.mark.parametrize(("number", "params", "result"), ON_GROUND)
def test_on_the_ground_as_a_px4(on_ground: Any, number: int, params: tuple[float, ...], result: int) -> None:
    assert on_ground.result(number, *params) == result
    assert not on_ground.autopilot.armed


class TestArming:
    def test_before_ready(self, flight: Any) -> None:
        early = flight()
        early.run(0.5)
        assert early.result(ARM, 1) == REJECTED
        assert "Arming denied: Resolve system health failures first\t" in early.ground.texts()

    @pytest.mark.parametrize("params", [(1,), (0.5,), (1, 5)])
    def test_arms(self, on_ground: Any, params: tuple[float, ...]) -> None:
        assert on_ground.result(ARM, *params) == ACCEPTED
        assert on_ground.autopilot.armed
        assert on_ground.ground.texts()[0] == "Armed by external command\t"
        assert on_ground.result(ARM, 1) == ACCEPTED
        assert on_ground.result(ARM, 0) == ACCEPTED
        assert not on_ground.autopilot.armed

    def test_force_does_not_skip_the_checks(self, flight: Any) -> None:
        early = flight()
        early.run(0.5)
        assert early.result(ARM, 1, 21196) == REJECTED

    def test_any_other_wish_changes_nothing(self, on_ground: Any) -> None:
        assert on_ground.result(ARM, 2) is None
        assert on_ground.ground.texts() == ["Unsupported ARM_DISARM param: 2.000\t"]
        assert not on_ground.autopilot.armed

    def test_in_the_air_only_by_force(self, flight: Any) -> None:
        hover = flight().hover()
        assert hover.result(ARM, 0) == REJECTED
        assert "Disarming denied: not landed\t" in hover.ground.texts()
        assert hover.result(ARM, 0, 21196) == ACCEPTED
        assert not hover.autopilot.armed


class TestModes:
    @pytest.mark.parametrize(
        ("params", "mode", "custom_mode"),
        [
            ((1, 1), Mode.MANUAL, 0x00010000),
            ((1, 2), Mode.ALTCTL, 0x00020000),
            ((1, 3), Mode.POSCTL, 0x00030000),
            ((1, 3, 1), Mode.POSCTL, 0x00030000),  # Orbit is no mode to be chosen
            ((1, 3, 2), Mode.POSITION_SLOW, 0x02030000),
            ((1, 4), Mode.MISSION, 0x04040000),
            ((1, 4, 2), Mode.TAKEOFF, 0x02040000),
            ((1, 4, 3), Mode.LOITER, 0x03040000),
            ((1, 4, 5), Mode.RTL, 0x05040000),
            ((1, 4, 6), Mode.LAND, 0x06040000),
            ((1, 4, 8), Mode.FOLLOW_TARGET, 0x08040000),
            ((1, 4, 9), Mode.PRECLAND, 0x09040000),
            ((1, 5), Mode.ACRO, 0x00050000),
            ((1, 6), Mode.OFFBOARD, 0x00060000),
            ((1, 7), Mode.STABILIZED, 0x00070000),
            ((1, 11), Mode.ALTITUDE_CRUISE, 0x000B0000),
            ((1, 4, 11), Mode.EXTERNAL1, 0x0B040000),
            ((64,), Mode.MANUAL, 0x00010000),
            ((80,), Mode.STABILIZED, 0x00070000),
            ((72,), Mode.POSCTL, 0x00030000),
            ((4,), Mode.MISSION, 0x04040000),
        ],
    )
    def test_every_mode_can_be_chosen_while_disarmed(
        self, on_ground: Any, params: tuple[float, ...], mode: Mode, custom_mode: int
    ) -> None:
        assert on_ground.result(MODE, *params) == ACCEPTED
        assert on_ground.ground.texts() == []
        assert on_ground.autopilot.mode is mode
        on_ground.run(1.0)
        assert on_ground.ground.named("HEARTBEAT")[-1].custom_mode == custom_mode

    @pytest.mark.parametrize(
        ("params", "name"),
        [
            ((1, 1), "Manual"),
            ((1, 3), "Position"),
            ((1, 7), "Stabilized"),
            ((1, 4), "Mission"),
            ((1, 6), "Offboard"),
            ((1, 4, 11), "External 1"),
        ],
    )
    def test_what_cannot_run_in_the_air_is_refused_by_name(
        self, flight: Any, params: tuple[float, ...], name: str
    ) -> None:
        hover = flight().hover()
        assert hover.result(MODE, *params) == REJECTED
        assert hover.ground.texts() == [f"Switching to {name} is currently not available\t"]
        assert hover.autopilot.mode is Mode.LOITER

    def test_only_a_ground_station_is_told_why_not(self, flight: Any) -> None:
        hover = flight("gcs", "onboard").hover()
        assert hover.result(MODE, 1, 1, link=1) == REJECTED
        assert hover.ground.texts() == []

    @pytest.mark.parametrize(
        ("params", "text"),
        [
            ((1, 8), "Unsupported main mode"),
            ((1, 4, 99), "Unsupported auto mode"),
            ((0,), "Unsupported base mode"),
        ],
    )
    def test_what_px4_does_not_know_either(self, on_ground: Any, params: tuple[float, ...], text: str) -> None:
        assert on_ground.result(MODE, *params) == REJECTED
        assert on_ground.ground.texts() == [f"{text}\t"]

    def test_set_mode_message(self, on_ground: Any) -> None:
        (ack,) = on_ground.ask("SET_MODE", target_system=1, base_mode=1, custom_mode=4 << 16 | 6 << 24)
        assert (ack.name, ack.command, ack.result) == ("COMMAND_ACK", MODE, ACCEPTED)
        assert on_ground.autopilot.mode == 18
        assert on_ground.ask("SET_MODE", target_system=7, base_mode=1, custom_mode=4 << 16 | 3 << 24) == []
        assert on_ground.autopilot.mode == 18

    def test_standard_mode(self, on_ground: Any) -> None:
        assert on_ground.result(262, 7) == ACCEPTED
        assert on_ground.autopilot.mode == 18
        assert on_ground.result(262, 99) == FAILED
        assert on_ground.result(262, 0) == FAILED
        assert on_ground.autopilot.mode == 18

    def test_offboard_in_the_air_needs_a_signal(self, flight: Any) -> None:
        hover = flight().hover()
        assert hover.result(MODE, 1, 6) == REJECTED
        assert hover.autopilot.mode == 4

    def test_pause_by_reposition(self, flight: Any) -> None:
        offboard = flight().offboard()
        assert offboard.result(192, -1, 1, 0, NAN, NAN, NAN, NAN) == ACCEPTED
        assert offboard.autopilot.mode == 4


class TestTakeoff:
    def test_relative_height_of_a_command_int(self, on_ground: Any) -> None:
        assert on_ground.result(ARM, 1) == ACCEPTED
        (ack,) = on_ground.ask(
            "COMMAND_INT",
            target_system=1,
            target_component=1,
            frame=3,
            command=TAKEOFF,
            x=INT32_MAX,
            y=INT32_MAX,
            z=4.0,
        )
        assert ack.result == ACCEPTED
        on_ground.run(10.0)
        assert on_ground.vehicle.truth.position_ned()[2] == pytest.approx(-4.0, abs=0.3)

    def test_broken_place_of_a_command_int(self, on_ground: Any) -> None:
        bits = 0x7FF80000
        (ack,) = on_ground.ask("COMMAND_INT", target_system=1, target_component=1, command=TAKEOFF, x=bits, y=bits)
        assert ack.result == DENIED


class TestRequests:
    @pytest.mark.parametrize(
        ("message_id", "name"),
        [
            (148, "AUTOPILOT_VERSION"),
            (300, "PROTOCOL_VERSION"),
            (261, "STORAGE_INFORMATION"),
            (395, "COMPONENT_INFORMATION"),
            (397, "COMPONENT_METADATA"),
            (8, "LINK_NODE_STATUS"),
            (290, "ESC_INFO"),
            (291, "ESC_STATUS"),
            (380, "TIME_ESTIMATE_TO_TARGET"),
            (12901, "OPEN_DRONE_ID_LOCATION"),
            (12904, "OPEN_DRONE_ID_SYSTEM"),
            (264, "FLIGHT_INFORMATION"),
            (105, "HIGHRES_IMU"),
            (242, "HOME_POSITION"),
            (375, "ACTUATOR_OUTPUT_STATUS"),
            (115, "HIL_STATE_QUATERNION"),
            (93, "HIL_ACTUATOR_CONTROLS"),
            (331, "ODOMETRY"),
            (26, "SCALED_IMU"),
            (148.4, "AUTOPILOT_VERSION"),
            (NAN, "HEARTBEAT"),
        ],
    )
    def test_message_first_then_acknowledgement(self, on_ground: Any, message_id: float, name: str) -> None:
        on_ground.ground.send("COMMAND_LONG", target_system=1, target_component=1, command=REQUEST, param1=message_id)
        on_ground.run(0.02)
        heard = [one for _, one in on_ground.ground.heard]
        ack = next(index for index, one in enumerate(heard) if one.name == "COMMAND_ACK")
        assert heard[ack - 1].name == name
        assert heard[ack].result == ACCEPTED

    @pytest.mark.parametrize("message_id", [77, 42, 65, 87, 253, 12345, 16000000, -1, math.inf])
    def test_what_cannot_be_sent_is_denied(self, on_ground: Any, message_id: float) -> None:
        assert [one.result for one in on_ground.command(REQUEST, message_id)] == [DENIED]

    def test_system_time_is_not_invented(self, on_ground: Any) -> None:
        assert on_ground.result(REQUEST, 2) == DENIED

    @pytest.mark.parametrize(
        ("number", "name"),
        [
            (520, "AUTOPILOT_VERSION"),
            (519, "PROTOCOL_VERSION"),
            (528, "FLIGHT_INFORMATION"),
            (410, "HOME_POSITION"),
            (525, "STORAGE_INFORMATION"),
        ],
    )
    def test_old_requests(self, on_ground: Any, number: int, name: str) -> None:
        answers = on_ground.command(number, 1, only=(name, "COMMAND_ACK"))
        assert name in [one.name for one in answers]
        assert [one.result for one in answers if one.name == "COMMAND_ACK"] == [ACCEPTED]

    def test_home_is_known_from_the_start(self, flight: Any) -> None:
        early = flight()
        early.run(0.1)
        home, ack = early.command(REQUEST, 242, only=("HOME_POSITION", "COMMAND_ACK"))[:2]
        assert ack.result == ACCEPTED
        assert (home.latitude, home.longitude) == pytest.approx((473977420, 85455940), abs=50)
        assert home.altitude == pytest.approx(488_000, abs=30)

    def test_available_modes(self, on_ground: Any) -> None:
        *modes, ack = on_ground.command(REQUEST, 435)
        assert ack.result == ACCEPTED
        assert [one.mode_index for one in modes] == list(range(1, len(modes) + 1))
        assert {one.number_modes for one in modes} == {len(modes)} == {26}
        by_number = {one.custom_mode: one for one in modes}
        assert by_number[0x03040000].mode_name == "Hold"
        assert by_number[0x00060000].mode_name == "Offboard"
        assert (by_number[0x06040000].mode_name, by_number[0x06040000].standard_mode) == ("", 7)
        assert by_number[0x000A0000].properties == 3  # Termination: nobody may choose it
        external = by_number[0x0B040000]
        assert (external.mode_name, external.properties) == ("(Mode not available)", 2)
        one, ack = on_ground.command(REQUEST, 435, 2)
        assert (one.mode_index, ack.result) == (2, ACCEPTED)
        assert on_ground.result(REQUEST, 435, 99) == DENIED

    def test_identity(self, on_ground: Any) -> None:
        version = on_ground.command(REQUEST, 148)[0]
        assert version.capabilities == 0xE8FF
        assert version.flight_sw_version == 0x011100FF
        assert version.uid


class TestIntervals:
    def test_set_and_get(self, on_ground: Any) -> None:
        assert on_ground.result(SET_INTERVAL, 30, 50_000) == ACCEPTED
        answers = {one.name: one for one in on_ground.command(GET_INTERVAL, 30)}
        assert answers["MESSAGE_INTERVAL"].interval_us == 50_000
        assert answers["MESSAGE_INTERVAL"].message_id == 30
        assert answers["COMMAND_ACK"].result == ACCEPTED

    @pytest.mark.parametrize(
        ("asked_us", "interval_us"), [(0, 66_666), (NAN, 66_666), (-1, -1), (1, 1), (1e30, INT32_MAX)]
    )
    def test_what_becomes_of_it(self, on_ground: Any, asked_us: float, interval_us: int) -> None:
        assert on_ground.result(SET_INTERVAL, 30, asked_us) == ACCEPTED
        assert on_ground.command(REQUEST, 244, 30)[0].interval_us == interval_us

    @pytest.mark.parametrize(
        "params",
        [(0, 500_000), (0, -1), (77, 1e6), (12345, 1e6), (30, 2e4, 1), (30, 2e4, 0, 0, 0, 0, 1)],
    )
    def test_refused(self, on_ground: Any, params: tuple[float, ...]) -> None:
        assert on_ground.result(SET_INTERVAL, *params) == FAILED
        assert on_ground.links[0].schedule.interval_us(0) == 1_000_000
        assert on_ground.links[0].schedule.interval_us(30) == 20_000

    def test_unused_parameters_may_be_nan(self, on_ground: Any) -> None:
        assert on_ground.result(SET_INTERVAL, 30, 20_000, NAN, NAN, NAN, NAN, NAN) == ACCEPTED

    def test_of_an_unknown_message_is_off(self, on_ground: Any) -> None:
        assert on_ground.command(GET_INTERVAL, 12345)[0].interval_us == -1

    def test_is_the_link_s_own(self, flight: Any) -> None:
        two = flight("gcs", "onboard")
        assert two.result(SET_INTERVAL, 30, 1e6, link=1) == ACCEPTED
        assert two.command(GET_INTERVAL, 30, link=0)[0].interval_us == 20_000

    def test_the_measured_rate_is_the_asked_one(self, on_ground: Any) -> None:
        for hz in (250, 100, 62.5, 33, 7):
            on_ground.result(SET_INTERVAL, 30, int(1e6 / hz))
            on_ground.forget()
            on_ground.run(8.0)
            stamps = [one.time_boot_ms for one in on_ground.ground.named("ATTITUDE")]
            assert (stamps[-1] - stamps[0]) / (len(stamps) - 1) == pytest.approx(1000 / hz, rel=2e-3)


class TestTermination:
    def test_needs_an_armed_vehicle_and_the_word(self, flight: Any) -> None:
        hover = flight().hover()
        assert hover.result(185, 0) == DENIED
        assert hover.result(185, 1) == ACCEPTED
        hover.run(1.0)
        heartbeat = hover.ground.named("HEARTBEAT")[-1]
        assert heartbeat.custom_mode == 10 << 16
        assert heartbeat.system_status == 8
        assert heartbeat.base_mode == 129


class TestStorage:
    def test_reset_brings_the_defaults_back(self, on_ground: Any) -> None:
        parameters = on_ground.vehicle.parameters
        default = parameters.get("MC_ROLL_P")
        parameters.set("MC_ROLL_P", 1.25)
        assert on_ground.result(245, 2) == ACCEPTED
        assert parameters.get("MC_ROLL_P") == default

    @pytest.mark.parametrize("action", [0, 1, 2, 3, 4])
    def test_without_a_file_it_is_accepted_as_by_a_px4(self, on_ground: Any, action: int) -> None:
        assert on_ground.result(245, action) == ACCEPTED

    @pytest.mark.parametrize("action", [5, -1, NAN])
    def test_what_a_px4_does_not_know_is_silence(self, on_ground: Any, action: float) -> None:
        assert on_ground.result(245, action) is None

    def test_not_while_armed(self, on_ground: Any) -> None:
        on_ground.result(ARM, 1)
        assert on_ground.result(245, 2) == REJECTED
        assert on_ground.result(241, 1) == REJECTED
        assert on_ground.result(246, 2) == DENIED
        assert not on_ground.server.shutdown_asked

    def test_switching_off(self, on_ground: Any) -> None:
        assert on_ground.result(246, 2) == ACCEPTED
        assert on_ground.server.shutdown_asked


_WILD = st.floats(width=32) | st.sampled_from([0.0, 1.0, 2.0, NAN, math.inf, -math.inf, 3e38, float(INT32_MAX)])


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(number=0, params=[0.0, 0.0, 0.0, 0.0, float(INT32_MAX), float(INT32_MAX), 0.0])
@given(
    number=st.sampled_from([20, 21, 22, 176, 179, 185, 192, 241, 245, 246, 262, 400, 510, 511, 512, 520])
    | st.integers(0, 65535),
    params=st.lists(_WILD, min_size=7, max_size=7),
)
def test_no_numbers_break_a_command(on_ground: Any, number: int, params: list[float]) -> None:
    acks = on_ground.command(number, *params, wait_s=0.012, only=("COMMAND_ACK",))
    if params[4] == params[5] == pytest.approx(INT32_MAX, rel=1e-6):  # no place in floats: denied, whatever it is
        assert [(ack.command, ack.result) for ack in acks] == [(number, DENIED)]
    elif number in SOMETIMES_SILENT:
        assert [ack.command for ack in acks] in ([], [number])
    else:
        assert [ack.command for ack in acks] == ([] if number in SILENT else [number])
