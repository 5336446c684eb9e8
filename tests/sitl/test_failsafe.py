from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.failsafe import ACTION_MODE, Action, TiltDetector, offboard_loss_action
from sitl.modes import Mode, Result
from sitl.parameters import ParameterTable
from sitl.rotation import from_euler

TILTED, UPRIGHT = math.radians(61.0), math.radians(59.0)


@pytest.mark.parametrize(
    ("wish", "action"),
    [
        (3, Action.LAND),
        (4, Action.LAND),
        (5, Action.HOLD),
        (6, Action.TERMINATE),
        (7, Action.DISARM),
        (99, Action.LAND),
    ],
)
def test_lost_offboard_signal_does_what_com_obl_rc_act_says(wish: int, action: Action) -> None:
    assert offboard_loss_action(ParameterTable({"COM_OBL_RC_ACT": wish})) is action


@pytest.mark.parametrize("wish", [0, 1, 2])
@pytest.mark.parametrize(
    ("without_manual_control", "action"),
    [(0, Action.LAND), (1, Action.HOLD), (2, Action.LAND), (3, Action.LAND), (5, Action.TERMINATE), (6, Action.DISARM)],
)
def test_manual_modes_are_not_to_be_had_so_nav_rcl_act_decides(
    wish: int, without_manual_control: int, action: Action
) -> None:
    table = ParameterTable({"COM_OBL_RC_ACT": wish, "NAV_RCL_ACT": without_manual_control})
    assert offboard_loss_action(table) is action


def test_actions_that_fly_have_a_mode() -> None:
    assert ACTION_MODE == {Action.HOLD: Mode.LOITER, Action.LAND: Mode.LAND}


class TestTilt:
    def watch(self, detector: TiltDetector, phi: float, theta: float, start_us: int, seconds: float) -> int:
        for now_us in range(start_us, start_us + round(seconds * 1e6), 10_000):
            detector.update(now_us, phi, theta, True)
        return start_us + round(seconds * 1e6)

    @pytest.mark.parametrize(("phi", "theta"), [(TILTED, 0.0), (-TILTED, 0.0), (0.0, TILTED), (0.0, -TILTED)])
    def test_fails_after_300_ms_beyond_60_degrees(self, phi: float, theta: float) -> None:
        detector = TiltDetector(ParameterTable())
        now_us = self.watch(detector, phi, theta, 0, 0.3)
        assert not detector.failed
        self.watch(detector, phi, theta, now_us, 0.02)
        assert detector.failed

    def test_shorter_excursions_do_not_add_up(self) -> None:
        detector, now_us = TiltDetector(ParameterTable()), 0
        for _ in range(5):
            now_us = self.watch(detector, TILTED, 0.0, now_us, 0.25)
            now_us = self.watch(detector, UPRIGHT, 0.0, now_us, 0.02)
        assert not detector.failed

    def test_recovers_when_upright_again(self) -> None:
        detector = TiltDetector(ParameterTable())
        now_us = self.watch(detector, TILTED, 0.0, 0, 0.5)
        assert detector.failed
        self.watch(detector, UPRIGHT, 0.0, now_us, 0.02)
        assert not detector.failed

    def test_obeys_its_parameters_as_they_change(self) -> None:
        table = ParameterTable({"FD_FAIL_R": 30, "FD_FAIL_R_TTRI": 0.1})
        detector = TiltDetector(table)
        now_us = self.watch(detector, 0.6, 0.0, 0, 0.15)
        assert detector.failed
        table.set("FD_FAIL_R", 0)
        self.watch(detector, 3.0, 0.0, now_us, 1.0)
        assert not detector.failed

    def test_not_watched_not_failed(self) -> None:
        detector = TiltDetector(ParameterTable())
        for now_us in range(0, 1_000_000, 10_000):
            detector.update(now_us, 3.0, 3.0, False)
        assert not detector.failed

    @pytest.mark.parametrize(
        ("breaker", "armed_s", "action"),
        [
            (121212, 3.9, Action.DISARM),
            (0, 3.9, Action.DISARM),
            (121212, 4.1, None),
            (0, 4.1, Action.TERMINATE),
        ],
    )
    def test_disarms_just_after_arming_and_later_only_if_the_breaker_allows(
        self, breaker: int, armed_s: float, action: Action | None
    ) -> None:
        detector = TiltDetector(ParameterTable({"CBRK_FLIGHTTERM": breaker}))
        assert detector.action(round(armed_s * 1e6)) is action


@pytest.fixture
def offboard(flight: Any) -> Any:
    """A vehicle in Offboard at 10 m, with level set-points at 50 Hz while it runs with ``keep``."""
    made = flight()
    made.take_off(10.0, settle_s=2.0)
    made.go_offboard()
    made.keep = lambda k: made.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.nan), 0.5)
    made.run(1.0, made.keep)
    made.texts.clear()
    return made


class TestLostOffboardSignal:
    @pytest.mark.parametrize("patience_s", [1.0, 3.0, 0.2])
    def test_is_noticed_after_com_of_loss_t(self, offboard: Any, patience_s: float) -> None:
        offboard.parameters.set("COM_OF_LOSS_T", patience_s)
        start_s = offboard.time_s
        offboard.run(patience_s + 0.3)
        (said_s,) = offboard.said("Failsafe activated\t")
        assert said_s - start_s == pytest.approx(patience_s, abs=0.05)

    @pytest.mark.parametrize(
        ("wish", "mode", "armed"),
        [
            (0, Mode.LAND, True),
            (1, Mode.LAND, True),
            (2, Mode.LAND, True),
            (3, Mode.LAND, True),
            (4, Mode.LAND, True),
            (5, Mode.LOITER, True),
            (6, Mode.TERMINATION, True),
            (7, Mode.OFFBOARD, False),
        ],
    )
    def test_is_answered_as_asked(self, offboard: Any, wish: int, mode: Mode, armed: bool) -> None:
        offboard.parameters.set("COM_OBL_RC_ACT", wish)
        offboard.run(1.2)
        assert offboard.autopilot.mode is mode
        assert offboard.autopilot.armed is armed
        assert offboard.autopilot.failsafe is armed
        running = any(motor > 0.1 for motor in offboard.autopilot.motors)
        assert running is (mode in (Mode.LAND, Mode.LOITER))
        assert len(offboard.said("Failsafe activated\t")) == 1

    @pytest.mark.parametrize("wish", [0, 5])
    def test_comes_back_by_itself_with_the_set_points(self, offboard: Any, wish: int) -> None:
        offboard.parameters.set("COM_OBL_RC_ACT", wish)
        offboard.run(2.0)
        assert offboard.autopilot.mode is not Mode.OFFBOARD
        offboard.run(0.3, offboard.keep)
        assert offboard.autopilot.mode is Mode.OFFBOARD
        assert not offboard.autopilot.failsafe
        assert len(offboard.texts) == 1

    def test_a_mode_chosen_meanwhile_stays(self, offboard: Any) -> None:
        offboard.run(2.0)
        assert offboard.autopilot.command_mode(Mode.LOITER) is Result.ACCEPTED
        offboard.run(0.5, offboard.keep)
        assert offboard.autopilot.mode is Mode.LOITER
        assert not offboard.autopilot.failsafe

    def test_lands_and_disarms_if_nobody_comes_back(self, offboard: Any) -> None:
        offboard.run_until(lambda: not offboard.autopilot.armed, 40.0)
        assert [text for _, text in offboard.texts] == ["Failsafe activated", "Landing detected", "Disarmed by landing"]
        assert offboard.autopilot.mode is Mode.LOITER

    @pytest.mark.parametrize(("rate_hz", "kept"), [(3.0, True), (0.7, False)])
    def test_3_hz_keep_it_and_0_7_do_not(self, offboard: Any, rate_hz: float, kept: bool) -> None:
        every = round(250.0 / rate_hz)
        offboard.run(6.0, lambda k: offboard.keep(k) if k % every == 0 else None)
        assert (not offboard.said("Failsafe activated\t")) is kept

    def test_a_short_gap_goes_unnoticed(self, offboard: Any) -> None:
        offboard.run(0.4)
        offboard.run(2.0, offboard.keep)
        assert offboard.texts == []
        assert offboard.autopilot.mode is Mode.OFFBOARD

    def test_a_heartbeat_without_set_points_keeps_it_too(self, offboard: Any) -> None:
        offboard.run(3.0, lambda k: offboard.autopilot.offboard_alive("position"))
        assert offboard.autopilot.mode is Mode.OFFBOARD

    def test_on_the_ground_nothing_takes_off(self, flight: Any) -> None:
        made = flight()
        made.get_ready()
        made.autopilot.command_mode(Mode.OFFBOARD)
        made.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.nan), 0.0)
        made.arm()
        made.run(13.0)
        assert made.said("Failsafe activated\t")
        assert made.said("Disarmed by auto preflight disarming\t")
        assert made.vehicle.truth.position_ned()[2] == pytest.approx(0.0, abs=0.01)


class TestAttitudeFailure:
    def tip(self, made: Any, seconds: float) -> None:
        """Fly on the side: 75 degrees of roll, with thrust to spare."""
        quat = from_euler(math.radians(75.0), 0.0, 0.0)
        made.run(seconds, lambda k: made.autopilot.offboard_attitude(quat, (0.0, 0.0, math.nan), 0.9))

    def test_is_a_warning_by_default_and_passes(self, offboard: Any) -> None:
        self.tip(offboard, 1.2)
        assert offboard.said("Attitude failure detected\t")
        assert offboard.autopilot.failsafe
        assert offboard.autopilot.armed
        assert offboard.autopilot.mode is Mode.OFFBOARD
        offboard.run(2.0, offboard.keep)
        assert not offboard.autopilot.failsafe
        assert len(offboard.texts) == 1

    def test_terminates_if_the_circuit_breaker_is_open(self, offboard: Any) -> None:
        offboard.parameters.set("CBRK_FLIGHTTERM", 0)
        self.tip(offboard, 1.2)
        assert offboard.autopilot.terminated
        assert offboard.autopilot.motors == (0.0, 0.0, 0.0, 0.0)

    def test_just_after_arming_it_disarms(self, flight: Any) -> None:
        made = flight()
        made.get_ready()
        made.autopilot.command_mode(Mode.OFFBOARD)
        made.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.nan), 0.9)
        made.arm()
        made.run(1.5, lambda k: made.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.nan), 0.9))
        self.tip(made, 1.2)
        assert made.said("Attitude failure detected\t")
        assert made.said("Disarmed by failsafe\t")
        assert not made.autopilot.armed
