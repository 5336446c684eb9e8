"""Links lost in flight, by the whole autopilot; times and texts are those of a real PX4."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.modes import Mode, Result
from sitl.setpoints import Sticks

IN_FORCE = "Failsafe activated\t"
OVER = "Pilot took over using sticks\t"


def said(flight: Any) -> list[str]:
    return [text for _, text in flight.texts]


def waits(seconds: int) -> str:
    return f"Failsafe activated: entering Hold for {seconds} seconds\t"


@pytest.fixture
def flown_by_sticks(hover: Any, pilot: Any) -> Any:
    """In Position at 10 m, a pilot's sticks centred until now; ``hover.pilot`` holds them."""
    hover.pilot = pilot(hover)
    hover.pilot.fly(0.2)
    assert hover.autopilot.command_mode(Mode.POSCTL) is Result.ACCEPTED
    hover.pilot.fly(0.5)
    hover.texts.clear()
    return hover


class TestSticks:
    def test_hold_after_com_rc_loss_t_and_return_com_fail_act_t_later(self, flown_by_sticks: Any) -> None:
        made, start_s = flown_by_sticks, flown_by_sticks.time_s
        made.run_until(lambda: made.autopilot.mode is Mode.LOITER, 2.0)
        # the last sticks came 20 ms before
        assert made.time_s - start_s == pytest.approx(0.48, abs=0.03)
        assert made.autopilot.failsafe
        assert made.autopilot.intended is Mode.POSCTL
        assert said(made) == [waits(5)]
        held_s = made.run_until(lambda: made.autopilot.mode is Mode.RTL, 8.0)
        assert held_s == pytest.approx(5.0, abs=0.03)
        made.run(0.1)
        assert said(made)[1] == IN_FORCE
        assert said(made)[2].startswith("RTL: start return at ")

    @pytest.mark.parametrize("wait_s", [0.2, 1.5])
    def test_com_rc_loss_t_is_obeyed(self, flown_by_sticks: Any, wait_s: float) -> None:
        made = flown_by_sticks
        made.parameters.set("COM_RC_LOSS_T", wait_s)
        took_s = made.run_until(lambda: made.autopilot.failsafe, 3.0)
        assert took_s == pytest.approx(wait_s - 0.02, abs=0.03)

    @pytest.mark.parametrize(
        ("wish", "mode", "armed"),
        [
            (1, Mode.LOITER, True),
            (2, Mode.RTL, True),
            (3, Mode.LAND, True),
            (5, Mode.TERMINATION, True),
            (6, Mode.POSCTL, False),
        ],
    )
    def test_nav_rcl_act_is_obeyed(self, flown_by_sticks: Any, wish: int, mode: Mode, armed: bool) -> None:
        made = flown_by_sticks
        made.parameters.set("NAV_RCL_ACT", wish)
        made.run(0.7)
        delayed = wish in (2, 3)
        assert made.autopilot.mode is (Mode.LOITER if delayed else mode)
        assert said(made)[0] == (waits(5) if delayed else IN_FORCE)
        assert said(made)[1:] == (["Disarmed by failsafe\t"] if wish == 6 else [])
        # a terminated flight is over as soon as it has come down
        made.run(0.5 if mode is Mode.TERMINATION else 5.5)
        assert made.autopilot.mode is mode
        assert made.autopilot.armed is armed
        assert made.autopilot.failsafe is armed
        assert (max(made.autopilot.motors) > 0.1) is (wish in (1, 2, 3))

    def test_choosing_a_mode_takes_over(self, flown_by_sticks: Any) -> None:
        made = flown_by_sticks
        made.run(2.0)
        assert made.autopilot.command_mode(Mode.LOITER) is Result.ACCEPTED
        assert not made.autopilot.failsafe
        made.run(10.0)
        assert made.autopilot.mode is made.autopilot.intended is Mode.LOITER
        assert said(made) == [waits(5)]

    def test_the_mode_that_lacks_them_cannot_be_chosen_again(self, flown_by_sticks: Any) -> None:
        made = flown_by_sticks
        made.run(2.0)
        assert made.autopilot.command_mode(Mode.POSCTL) is Result.TEMPORARILY_REJECTED
        made.run(0.1)
        assert made.autopilot.mode is Mode.LOITER
        assert made.autopilot.failsafe
        assert said(made) == [waits(5), "Switching to Position is currently not available\t"]

    @pytest.mark.parametrize(("silent_s", "mode"), [(2.0, Mode.LOITER), (7.0, Mode.RTL)])
    def test_sticks_that_come_back_centred_change_nothing_until_a_mode_is_chosen(
        self, flown_by_sticks: Any, silent_s: float, mode: Mode
    ) -> None:
        made = flown_by_sticks
        made.parameters.set("COM_FAIL_ACT_T", 5.0)
        made.run(silent_s)
        made.pilot.fly(1.5)
        assert made.autopilot.mode is mode
        assert made.autopilot.failsafe
        assert made.autopilot.command_mode(Mode.POSCTL) is Result.ACCEPTED
        made.pilot.fly(1.0)
        assert made.autopilot.mode is Mode.POSCTL
        assert not made.autopilot.failsafe

    @pytest.mark.parametrize("silent_s", [2.0, 7.0])
    def test_moving_them_takes_over(self, flown_by_sticks: Any, silent_s: float) -> None:
        made = flown_by_sticks
        made.run(silent_s)
        made.pilot.fly(0.3)
        made.pilot.fly(0.3, roll=0.6)
        assert made.autopilot.mode is made.autopilot.intended is Mode.POSCTL
        assert not made.autopilot.failsafe
        assert said(made)[-1] == OVER

    def test_missing_at_arming_they_are_not_missed_until_they_were_there(self, hover: Any, pilot: Any) -> None:
        hover.run(10.0)
        assert not hover.autopilot.failsafe
        assert said(hover) == []
        pilot(hover).fly(0.5)
        hover.run(1.0)
        assert hover.autopilot.failsafe
        assert said(hover) == [waits(5)]

    @pytest.mark.parametrize(("bits", "lost"), [(0, True), (1, True), (2, False), (4, True)])
    def test_com_rcl_except_hold(self, hover: Any, pilot: Any, bits: int, lost: bool) -> None:
        hover.parameters.set("COM_RCL_EXCEPT", bits)
        pilot(hover).fly(0.5)
        hover.run(7.0)
        assert hover.autopilot.failsafe is lost
        assert hover.autopilot.mode is (Mode.RTL if lost else Mode.LOITER)

    def test_disarming_ends_it(self, flown_by_sticks: Any) -> None:
        made = flown_by_sticks
        made.parameters.set("NAV_RCL_ACT", 3)
        made.run_until(lambda: not made.autopilot.armed, 60.0)
        assert not made.autopilot.failsafe
        assert said(made)[-2:] == ["Landing detected\t", "Disarmed by landing\t"]
        assert made.autopilot.mode is Mode.POSCTL


@pytest.fixture
def watched(hover: Any) -> Any:
    """In Hold at 10 m; a ground station has been heard once a second until now."""
    hover.heard = lambda k: hover.autopilot.gcs_heard() if k % 250 == 0 else None
    hover.run(2.0, hover.heard)
    hover.autopilot.gcs_heard()
    return hover


class TestGroundStation:
    def test_nothing_but_texts_by_default(self, watched: Any) -> None:
        watched.run(20.0)
        assert said(watched) == ["Connection to ground station lost\t"]
        assert watched.autopilot.mode is Mode.LOITER
        assert not watched.autopilot.failsafe
        watched.run(1.0, watched.heard)
        assert said(watched)[1:] == ["GCS connection regained\t"]

    def test_hold_then_return_as_recorded_and_it_stays(self, watched: Any) -> None:
        watched.parameters.set("NAV_DLL_ACT", 2)
        start_s = watched.time_s
        watched.run_until(lambda: watched.autopilot.failsafe, 15.0)
        assert watched.time_s - start_s == pytest.approx(10.0, abs=0.03)
        assert watched.autopilot.mode is Mode.LOITER
        assert watched.run_until(lambda: watched.autopilot.mode is Mode.RTL, 8.0) == pytest.approx(5.0, abs=0.03)
        watched.run(3.0, watched.heard)
        assert watched.autopilot.mode is Mode.RTL
        assert watched.autopilot.failsafe
        texts = said(watched)
        assert texts[:3] == ["Connection to ground station lost\t", waits(5), IN_FORCE]
        assert sorted(texts[3:]) == [
            "GCS connection regained\t",
            "RTL: land at destination\t",
            "RTL: start return at 498 m (10 m above destination)\t",
        ]

    @pytest.mark.parametrize("wait_s", [5, 20])
    def test_com_dl_loss_t_is_obeyed(self, watched: Any, wait_s: int) -> None:
        watched.parameters.set("NAV_DLL_ACT", 1)
        watched.parameters.set("COM_DL_LOSS_T", wait_s)
        took_s = watched.run_until(lambda: watched.autopilot.failsafe, 30.0)
        assert took_s == pytest.approx(wait_s, abs=0.03)

    @pytest.mark.parametrize(
        ("wish", "mode", "armed"),
        [
            (0, Mode.LOITER, True),
            (1, Mode.LOITER, True),
            (2, Mode.RTL, True),
            (3, Mode.LAND, True),
            (5, Mode.TERMINATION, True),
            (6, Mode.LOITER, False),
        ],
    )
    def test_nav_dll_act_is_obeyed(self, watched: Any, wish: int, mode: Mode, armed: bool) -> None:
        watched.parameters.set("NAV_DLL_ACT", wish)
        watched.parameters.set("COM_FAIL_ACT_T", 2.0)
        watched.run(11.0)
        assert (waits(2) in said(watched)) is (wish in (2, 3))
        if wish in (2, 3):
            assert watched.autopilot.mode is Mode.LOITER
        watched.run(1.2)
        assert watched.autopilot.mode is mode
        assert watched.autopilot.armed is armed
        assert watched.autopilot.failsafe is (armed and wish > 0)

    @pytest.mark.parametrize(("bits", "lost"), [(0, True), (1, True), (2, False), (4, True)])
    def test_com_dll_except_hold(self, watched: Any, bits: int, lost: bool) -> None:
        watched.parameters.set("NAV_DLL_ACT", 2)
        watched.parameters.set("COM_DLL_EXCEPT", bits)
        watched.run(16.0)
        assert watched.autopilot.failsafe is lost

    def test_choosing_a_mode_takes_over_for_as_long_as_it_is_gone(self, watched: Any) -> None:
        watched.parameters.set("NAV_DLL_ACT", 3)
        watched.run(12.0)
        assert watched.autopilot.command_takeoff(None) is Result.ACCEPTED
        watched.run(20.0)
        assert watched.autopilot.mode is Mode.LOITER
        assert not watched.autopilot.failsafe
        assert watched.vehicle.truth.position_ned()[2] == pytest.approx(-20.0, abs=0.3)


class TestStickOverride:
    """COM_RC_OVERRIDE: moved sticks give Position."""

    @pytest.mark.parametrize(("bits", "over"), [(0, False), (1, True), (2, False), (3, True)])
    @pytest.mark.parametrize("mode", [Mode.LOITER, Mode.RTL, Mode.LAND, Mode.ORBIT])
    def test_in_modes_that_fly_by_themselves(self, hover: Any, pilot: Any, bits: int, over: bool, mode: Mode) -> None:
        hover.parameters.set("COM_RC_OVERRIDE", bits)
        sticks = pilot(hover)
        hover.autopilot.command_mode(mode)
        sticks.fly(1.0, throttle=-0.2)
        assert hover.autopilot.mode is mode
        sticks.fly(0.5, throttle=-0.2, pitch=0.5)
        assert hover.autopilot.mode is (Mode.POSCTL if over else mode)
        assert said(hover).count(OVER) == int(over)

    @pytest.mark.parametrize(("bits", "over"), [(0, False), (1, False), (2, True), (3, True)])
    def test_in_offboard(self, offboard: Any, pilot: Any, bits: int, over: bool) -> None:
        offboard.parameters.set("COM_RC_OVERRIDE", bits)
        sticks = pilot(offboard)
        offboard.run(0.5, lambda k: (offboard.keep(k), sticks.send(Sticks())))
        offboard.run(0.5, lambda k: (offboard.keep(k), sticks.send(Sticks(yaw=-0.9))))
        assert offboard.autopilot.mode is (Mode.POSCTL if over else Mode.OFFBOARD)
        assert said(offboard) == ([OVER] if over else [])

    def test_small_movements_do_not(self, hover: Any, pilot: Any) -> None:
        sticks = pilot(hover)
        for roll in (0.0, 0.25, 0.0, -0.25):
            sticks.fly(1.0, roll=roll)
        assert hover.autopilot.mode is Mode.LOITER

    def test_other_stick_modes_are_left_alone(self, hover: Any, pilot: Any) -> None:
        sticks = pilot(hover)
        sticks.fly(0.2)
        hover.autopilot.command_mode(Mode.ALTCTL)
        sticks.fly(0.3, roll=0.8)
        assert hover.autopilot.mode is Mode.ALTCTL

    def test_a_terminated_flight_is_not_taken_over(self, hover: Any, pilot: Any) -> None:
        sticks = pilot(hover)
        sticks.fly(0.2)
        hover.autopilot.command_terminate(True)
        sticks.fly(0.3, roll=1.0)
        assert hover.autopilot.mode is Mode.TERMINATION
        assert hover.autopilot.motors == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_waits_that_are_no_numbers_end_nothing_badly(flown_by_sticks: Any, value: float) -> None:
    made = flown_by_sticks
    made.parameters.set("COM_FAIL_ACT_T", value)
    made.run(7.0)
    assert made.autopilot.failsafe
    assert made.autopilot.mode is (Mode.LOITER if value == math.inf else Mode.RTL)
