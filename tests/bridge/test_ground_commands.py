"""Commands for a vehicle on the ground, as a PX4 in simulation answers them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from bridge.services import VehicleFiles

NAN = math.nan
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
CALIBRATE, STORAGE, REBOOT, ACTUATOR, FAILURE, AUTOTUNE, STOP_LOG, ARM = 241, 245, 246, 310, 420, 212, 2511, 400
MOTOR_1, MOTOR_12, SERVO_1, SERVO_8 = 1, 12, 33, 40


def actuate(one: Any, number: float, value: float, seconds: float) -> int | None:
    """Send an ACTUATOR_TEST; return its result."""
    result: int | None = one.result(ACTUATOR, value, seconds, 0, 0, number, wait_s=0.02)
    return result


class TestCalibration:
    @pytest.mark.parametrize(
        ("params", "name"),
        [
            ((1,), "gyro"),
            ((0, 1), "mag"),
            ((0, 0, 1), "baro"),
            ((0, 0, 0, 0, 1), "accel"),
            ((0, 0, 0, 0, 2), "level"),
            ((0, 0, 0, 0, 4), "accel"),
            ((1, 1, 1), "gyro"),
        ],
    )
    def test_texts_that_ground_stations_follow(self, on_ground: Any, params: tuple[float, ...], name: str) -> None:
        assert on_ground.result(CALIBRATE, *params) == ACCEPTED
        assert on_ground.ground.texts() == [
            f"[cal] calibration started: 2 {name}",
            "[cal] progress <100>",
            f"[cal] calibration done: {name}",
        ]
        assert on_ground.ground.named("EVENT") == []

    @pytest.mark.parametrize(
        ("radio", "result"), [(0, ACCEPTED), (1, ACCEPTED), (2, ACCEPTED), (3, UNSUPPORTED), (-1, UNSUPPORTED)]
    )
    def test_of_the_radio(self, on_ground: Any, radio: int, result: int) -> None:
        assert on_ground.result(CALIBRATE, 0, 0, 0, radio) == result
        assert on_ground.ground.texts() == []

    def test_not_while_armed(self, on_ground: Any) -> None:
        on_ground.result(ARM, 1)
        assert on_ground.result(CALIBRATE, 1) == REJECTED
        assert on_ground.ground.texts() == []


class TestStorage:
    @pytest.fixture
    def kept(self, flight: Any, tmp_path: Path) -> tuple[Any, Path]:
        path = tmp_path / "vehicle.params"
        one = flight(files=VehicleFiles(parameters=path))
        one.run(2.2)
        return one, path

    def test_saving_is_at_once(self, kept: tuple[Any, Path]) -> None:
        one, path = kept
        one.vehicle.parameters.set("MC_ROLL_P", 7.25)
        assert not path.exists()
        assert one.result(STORAGE, 1, wait_s=0.012) == ACCEPTED
        assert "\tMC_ROLL_P\t7.25\t9\n" in path.read_text()

    def test_loading_returns_to_the_file(self, kept: tuple[Any, Path]) -> None:
        one, path = kept
        path.write_text("1\t1\tMC_ROLL_P\t5.5\t9\n")
        one.vehicle.parameters.set("MC_PITCH_P", 9.0)
        assert one.result(STORAGE, 0) == ACCEPTED
        assert one.vehicle.parameters.get("MC_ROLL_P") == 5.5
        assert list(one.vehicle.parameters.changed()) == ["MC_ROLL_P"]

    def test_a_damaged_file_is_accepted_and_told(self, kept: tuple[Any, Path]) -> None:
        one, path = kept
        path.write_text("nonsense\n")
        one.vehicle.parameters.set("MC_PITCH_P", 9.0)
        assert one.result(STORAGE, 0) == ACCEPTED
        (text,) = one.ground.texts()
        assert "line 1" in text
        assert one.vehicle.parameters.get("MC_PITCH_P") == 9.0

    def test_a_disk_that_cannot_be_written_is_told_at_each_try(self, flight: Any, tmp_path: Path) -> None:
        folder = tmp_path / "gone"
        folder.mkdir()
        one = flight(files=VehicleFiles(parameters=folder / "vehicle.params"))
        one.run(2.2)
        folder.rmdir()
        one.vehicle.parameters.set("MC_ROLL_P", 7.25)
        for _ in range(5):
            assert one.result(STORAGE, 1, wait_s=0.02) == ACCEPTED
        one.run(0.1)
        assert one.server.vehicle.parameters.get("MC_ROLL_P") == 7.25
        one.forget()
        one.run(10.5)
        assert sum("cannot be written" in text for text in one.ground.texts()) == 2  # one try in 5 s

    @pytest.mark.parametrize("wish", [2, 4])
    def test_resetting_empties_the_file(self, kept: tuple[Any, Path], wish: int) -> None:
        one, path = kept
        one.vehicle.parameters.set("MC_ROLL_P", 7.25)
        one.run(1.0)
        assert "MC_ROLL_P" in path.read_text()
        assert one.result(STORAGE, wish) == ACCEPTED
        one.run(1.0)
        assert "MC_ROLL_P" not in path.read_text()

    def test_calibration_alone(self, kept: tuple[Any, Path]) -> None:
        one, _ = kept
        one.vehicle.parameters.set("MC_ROLL_P", 7.25)
        assert one.result(STORAGE, 3) == ACCEPTED
        assert one.vehicle.parameters.get("MC_ROLL_P") == 7.25

    @pytest.mark.parametrize("wish", [-1, 5, 1e9, NAN])
    def test_anything_else_is_silence(self, kept: tuple[Any, Path], wish: float) -> None:
        assert kept[0].result(STORAGE, wish) is None


class TestReboot:
    @pytest.mark.parametrize(
        ("wish", "result", "asked"), [(0, ACCEPTED, False), (1, DENIED, False), (2, ACCEPTED, True)]
    )
    def test_switching_off_is_a_wish(self, on_ground: Any, wish: int, result: int, asked: bool) -> None:
        assert on_ground.result(REBOOT, wish) == result
        assert on_ground.server.shutdown_asked is asked

    def test_not_while_armed(self, on_ground: Any) -> None:
        on_ground.result(ARM, 1)
        assert on_ground.result(REBOOT, 2) == DENIED
        assert not on_ground.server.shutdown_asked


class TestActuators:
    @pytest.mark.parametrize("motor", [0, 1, 2, 3])
    def test_one_motor_turns_for_as_long_as_asked(self, on_ground: Any, motor: int) -> None:
        assert actuate(on_ground, MOTOR_1 + motor, 0.4, 0.5) == ACCEPTED
        on_ground.run(0.2)
        assert on_ground.autopilot.motors == tuple(pytest.approx(0.4) if k == motor else 0.0 for k in range(4))
        assert on_ground.vehicle.battery().current_a > 0.0
        on_ground.run(0.5)
        assert on_ground.autopilot.motors == (0.0,) * 4

    @pytest.mark.parametrize("seconds", [0.0, -1.0, 60.0, NAN, math.inf])
    def test_three_seconds_at_most(self, on_ground: Any, seconds: float) -> None:
        assert actuate(on_ground, MOTOR_1, 0.4, seconds) == ACCEPTED
        on_ground.run(2.9)
        assert on_ground.autopilot.motors[0] > 0.3
        on_ground.run(0.2)
        assert on_ground.autopilot.motors[0] == 0.0

    @pytest.mark.parametrize("value", [0.0, -1.0, NAN])
    def test_off(self, on_ground: Any, value: float) -> None:
        actuate(on_ground, MOTOR_1, 0.4, 3.0)
        assert actuate(on_ground, MOTOR_1, value, 3.0) == ACCEPTED
        on_ground.run(0.1)
        assert on_ground.autopilot.motors[0] == 0.0

    def test_no_more_than_all(self, on_ground: Any) -> None:
        actuate(on_ground, MOTOR_1, 50.0, 1.0)
        on_ground.run(0.1)
        assert on_ground.autopilot.motors[0] == 1.0

    @pytest.mark.parametrize("number", [MOTOR_12, SERVO_1, SERVO_8])
    def test_what_is_not_there_is_accepted_and_does_nothing(self, on_ground: Any, number: int) -> None:
        assert actuate(on_ground, number, 0.4, 1.0) == ACCEPTED
        on_ground.run(0.1)
        assert on_ground.autopilot.motors[:4] == (0.0,) * 4

    @pytest.mark.parametrize("number", [0, -1, 13, 32, 41, NAN, math.inf])
    def test_what_no_px4_has_is_silence(self, on_ground: Any, number: float) -> None:
        assert actuate(on_ground, number, 0.4, 1.0) is None

    def test_not_while_armed(self, on_ground: Any) -> None:
        on_ground.result(ARM, 1)
        assert actuate(on_ground, MOTOR_1, 1.0, 1.0) == DENIED

    def test_arming_ends_it(self, on_ground: Any) -> None:
        actuate(on_ground, MOTOR_1, 1.0, 3.0)
        on_ground.result(ARM, 1)
        on_ground.result(ARM, 0)
        on_ground.run(0.1)
        assert on_ground.autopilot.motors[0] == 0.0


class TestFailures:
    @pytest.mark.parametrize("unit", range(5))
    @pytest.mark.parametrize(("kind", "result"), [(0, ACCEPTED), (1, UNSUPPORTED), (4, UNSUPPORTED)])
    def test_are_acknowledged_to_nobody_in_particular(self, on_ground: Any, unit: int, kind: int, result: int) -> None:
        (ack,) = on_ground.command(FAILURE, unit, kind, 0)
        assert (ack.name, ack.command, ack.result) == ("COMMAND_ACK", FAILURE, result)
        assert (ack.target_system, ack.target_component) == (0, 0)

    @pytest.mark.parametrize("unit", [5, 100, 101, 104, -1])
    def test_of_what_a_simulator_has_not_are_silence(self, on_ground: Any, unit: int) -> None:
        assert on_ground.command(FAILURE, unit, 0, 0) == []


class TestLogging:
    def test_stopping_is_answered_a_second_later(self, on_ground: Any) -> None:
        assert on_ground.command(STOP_LOG, wait_s=0.99) == []
        on_ground.run(0.02)
        (ack,) = on_ground.ground.named("COMMAND_ACK")
        assert (ack.command, ack.result, ack.target_system, ack.target_component) == (STOP_LOG, ACCEPTED, 255, 190)

    def test_each_sender_is_answered_on_its_link(self, flight: Any) -> None:
        both = flight("gcs", "onboard")
        both.run(2.2)
        for link in (0, 1):
            both.grounds[link].send("COMMAND_LONG", target_system=1, target_component=1, command=STOP_LOG)
        both.run(1.1)
        assert [len(ground.named("COMMAND_ACK")) for ground in both.grounds] == [1, 1]

    def test_a_flood_does_not_pile_up(self, on_ground: Any) -> None:
        for _ in range(50):
            on_ground.ground.send("COMMAND_LONG", target_system=1, target_component=1, command=STOP_LOG)
        on_ground.run(1.2)
        assert 1 <= len(on_ground.ground.named("COMMAND_ACK")) <= 8

    def test_starting_a_stream_is_not_offered(self, on_ground: Any) -> None:
        assert on_ground.result(2510) == UNSUPPORTED


def test_high_latency_fails_in_words(on_ground: Any) -> None:
    assert on_ground.result(2600, 1) == FAILED
    assert on_ground.ground.texts() == ["Control high latency failed! Telemetry unavailable\t"]
    assert len(on_ground.ground.named("EVENT")) == 1


@pytest.mark.parametrize(
    ("number", "params", "result"),
    [
        (AUTOTUNE, (1, 0), UNSUPPORTED),
        (AUTOTUNE, (1, 4), DENIED),
        (187, (0.5,), ACCEPTED),
        (401, (), ACCEPTED),
        (5300, (1,), ACCEPTED),
    ],
)
def test_what_changes_nothing(on_ground: Any, number: int, params: tuple[float, ...], result: int) -> None:
    assert on_ground.result(number, *params) == result
    assert on_ground.ground.texts() == []
    assert not on_ground.autopilot.armed
