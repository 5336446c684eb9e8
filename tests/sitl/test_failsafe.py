from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.failsafe import ACTION_MODE, Action, Choice, Failsafe, Links
from sitl.modes import Mode, Result
from sitl.parameters import ParameterTable
from sitl.setpoints import Sticks

STEP_US = 10_000
LOST_LINK = [
    (1, Action.HOLD, Mode.LOITER),
    (2, Action.RTL, Mode.RTL),
    (3, Action.LAND, Mode.LAND),
    (5, Action.TERMINATE, Mode.MISSION),
    (6, Action.DISARM, Mode.MISSION),
]
DELAYED = (Action.RTL, Action.LAND)
LINKS = [("gcs", "NAV_DLL_ACT"), ("manual", "NAV_RCL_ACT")]


class Watch:
    """A failsafe looked at every 10 ms, as the commander does; armed with every link there."""

    def __init__(self, intended: Mode = Mode.MISSION, *, silent: tuple[str, ...] = (), **parameters: float) -> None:
        self.parameters = ParameterTable(parameters)
        self.failsafe = Failsafe(self.parameters)
        self.intended = intended
        self.now_us = 7_000_000
        self.failsafe.on_arm(self.now_us, self.links(*silent))

    @staticmethod
    def links(*silent: str) -> Links:
        return Links(*(name in silent for name in ("gcs", "manual", "offboard")))

    def see(self, seconds: float, *silent: str) -> list[Choice]:
        """What it chose while some links were silent."""
        choices = []
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.now_us += STEP_US
            choices.append(self.failsafe.choose(self.now_us, self.intended, self.links(*silent)))
        return choices


def actions(choices: list[Choice]) -> list[tuple[Action, Mode]]:
    """What was chosen, one after the other, without repetitions."""
    row: list[tuple[Action, Mode]] = []
    for choice in choices:
        if not row or row[-1] != choice[:2]:
            row.append((choice.action, choice.mode))
    return row


NOTHING = (Action.NONE, Mode.MISSION)


def test_actions_that_fly_have_a_mode() -> None:
    flown = set(Action) - {Action.NONE, Action.WARN, Action.DISARM, Action.TERMINATE}
    assert set(ACTION_MODE) == flown
    assert (ACTION_MODE[Action.HOLD], ACTION_MODE[Action.RTL], ACTION_MODE[Action.LAND]) == (
        Mode.LOITER,
        Mode.RTL,
        Mode.LAND,
    )


@pytest.mark.parametrize(("link", "parameter"), LINKS)
class TestLostLink:
    @pytest.mark.parametrize(("value", "action", "mode"), LOST_LINK)
    def test_is_answered_as_asked_after_com_fail_act_t_in_hold(
        self, link: str, parameter: str, value: int, action: Action, mode: Mode
    ) -> None:
        watch = Watch(**{parameter: value})
        seen = watch.see(10.0, link)
        if action not in DELAYED:
            assert actions(seen) == [(action, mode)]
            assert not any(choice.delayed_s for choice in seen)
            return
        assert actions(seen) == [(Action.HOLD, Mode.LOITER), (action, mode)]
        assert [choice.action for choice in seen].index(action) == pytest.approx(500, abs=2)
        assert seen[0].delayed_s == pytest.approx(5.0, abs=0.02)
        assert seen[400].delayed_s == pytest.approx(1.0, abs=0.02)
        assert seen[-1].delayed_s == 0.0

    @pytest.mark.parametrize(("wait_s", "waited_s"), [(0.0, 0.0), (0.05, 0.0), (1.5, 1.5), (25.0, 25.0)])
    def test_waits_as_long_as_asked(self, link: str, parameter: str, wait_s: float, waited_s: float) -> None:
        watch = Watch(**{parameter: 2, "COM_FAIL_ACT_T": wait_s})
        seen = [choice.action for choice in watch.see(30.0, link)]
        assert seen.index(Action.RTL) == pytest.approx(100.0 * waited_s, abs=2)

    @pytest.mark.parametrize("value", [4, 99, -1])
    def test_an_unknown_wish_is_none(self, link: str, parameter: str, value: int) -> None:
        assert actions(Watch(**{parameter: value}).see(7.0, link)) == [NOTHING]

    def test_stays_when_the_link_is_back(self, link: str, parameter: str) -> None:
        watch = Watch(**{parameter: 2})
        watch.see(6.0, link)
        assert actions(watch.see(30.0)) == [(Action.RTL, Mode.RTL)]

    def test_stays_when_the_link_is_back_while_it_waits(self, link: str, parameter: str) -> None:
        watch = Watch(**{parameter: 3})
        watch.see(1.0, link)
        assert actions(watch.see(6.0)) == [(Action.HOLD, Mode.LOITER), (Action.LAND, Mode.LAND)]

    @pytest.mark.parametrize("after_s", [1.0, 8.0])
    def test_ends_when_the_user_chooses_a_mode_and_begins_again_only_with_a_new_loss(
        self, link: str, parameter: str, after_s: float
    ) -> None:
        watch = Watch(**{parameter: 2})
        watch.see(after_s, link)
        watch.failsafe.on_mode_change()
        assert actions(watch.see(20.0, link)) == [NOTHING]
        assert actions(watch.see(1.0)) == [NOTHING]
        assert actions(watch.see(6.0, link))[-1] == (Action.RTL, Mode.RTL)

    def test_the_wait_used_up_comes_back_at_a_quarter_of_the_speed(self, link: str, parameter: str) -> None:
        watch = Watch(**{parameter: 2})
        watch.see(4.0, link)
        watch.failsafe.on_mode_change()
        watch.see(8.0)
        # 4 s of 5 were used, 2 of them are back
        assert watch.see(0.01, link)[0].delayed_s == pytest.approx(3.0, abs=0.05)

    def test_arming_gives_the_whole_wait_back(self, link: str, parameter: str) -> None:
        watch = Watch(**{parameter: 2})
        watch.see(8.0, link)
        watch.failsafe.on_arm(watch.now_us, watch.links())
        assert watch.see(0.01, link)[0].delayed_s == pytest.approx(5.0, abs=0.02)

    def test_silent_at_arming_is_no_reason_to_act_until_it_is_back_and_lost_again(
        self, link: str, parameter: str
    ) -> None:
        watch = Watch(silent=(link,), **{parameter: 1})
        assert actions(watch.see(20.0, link)) == [NOTHING]
        watch.intended = Mode.LOITER
        assert actions(watch.see(1.0, link)) == [(Action.NONE, Mode.LOITER)]
        watch.see(0.5)
        assert actions(watch.see(1.0, link)) == [(Action.HOLD, Mode.LOITER)]


@pytest.mark.parametrize(
    ("link", "action", "exceptions"),
    [("gcs", "NAV_DLL_ACT", "COM_DLL_EXCEPT"), ("manual", "NAV_RCL_ACT", "COM_RCL_EXCEPT")],
)
class TestExceptions:
    @pytest.mark.parametrize(
        ("bit", "excepted"),
        [
            (0, ()),
            (1, (Mode.MISSION,)),
            (2, (Mode.LOITER, Mode.ORBIT, Mode.FOLLOW_TARGET)),
            (4, (Mode.OFFBOARD,)),
            (7, (Mode.MISSION, Mode.LOITER, Mode.OFFBOARD)),
        ],
    )
    def test_a_bit_for_a_mode(
        self, link: str, action: str, exceptions: str, bit: int, excepted: tuple[Mode, ...]
    ) -> None:
        for mode in (*excepted, Mode.MISSION, Mode.LOITER, Mode.OFFBOARD, Mode.LAND):
            seen = Watch(mode, **{action: 1, exceptions: bit}).see(1.0, link)
            assert seen[-1].action is (Action.NONE if mode in excepted else Action.HOLD), mode

    def test_a_mode_without_the_exception_acts_at_once(self, link: str, action: str, exceptions: str) -> None:
        watch = Watch(Mode.LOITER, **{action: 2, exceptions: 2, "COM_FAIL_ACT_T": 0.0})
        assert actions(watch.see(5.0, link)) == [(Action.NONE, Mode.LOITER)]
        watch.intended = Mode.MISSION
        assert actions(watch.see(1.0, link)) == [(Action.RTL, Mode.RTL)]


def test_the_severest_is_flown() -> None:
    watch = Watch(NAV_DLL_ACT=3, NAV_RCL_ACT=1, COM_FAIL_ACT_T=0.0)
    assert actions(watch.see(1.0, "manual")) == [(Action.HOLD, Mode.LOITER)]
    assert actions(watch.see(1.0, "manual", "gcs")) == [(Action.LAND, Mode.LAND)]
    assert actions(watch.see(1.0, "manual")) == [(Action.LAND, Mode.LAND)]


def test_sticks_that_are_turned_off_are_not_missed() -> None:
    assert actions(Watch(NAV_RCL_ACT=1, COM_RC_IN_MODE=4).see(7.0, "manual")) == [NOTHING]


OBL = [
    (0, Action.FALLBACK_POSCTL, Mode.POSCTL),
    (1, Action.FALLBACK_ALTCTL, Mode.ALTCTL),
    (2, Action.FALLBACK_STAB, Mode.STABILIZED),
    (3, Action.RTL, Mode.RTL),
    (4, Action.LAND, Mode.LAND),
    (5, Action.HOLD, Mode.LOITER),
    (6, Action.TERMINATE, Mode.OFFBOARD),
    (7, Action.DISARM, Mode.OFFBOARD),
    (99, Action.RTL, Mode.RTL),
]


class TestLostSetPoints:
    @pytest.mark.parametrize(("wish", "action", "mode"), OBL)
    def test_with_sticks_com_obl_rc_act_is_obeyed_at_once(self, wish: int, action: Action, mode: Mode) -> None:
        assert actions(Watch(Mode.OFFBOARD, COM_OBL_RC_ACT=wish).see(7.0, "offboard")) == [(action, mode)]

    @pytest.mark.parametrize(("wish", "action", "mode"), OBL[3:])
    def test_what_needs_no_sticks_is_done_without_them(self, wish: int, action: Action, mode: Mode) -> None:
        watch = Watch(Mode.OFFBOARD, silent=("manual",), COM_OBL_RC_ACT=wish)
        assert actions(watch.see(7.0, "offboard", "manual")) == [(action, mode)]

    @pytest.mark.parametrize("wish", [0, 1, 2])
    @pytest.mark.parametrize(("without_sticks", "action", "mode"), [*LOST_LINK, (0, Action.RTL, Mode.RTL)])
    def test_without_sticks_nav_rcl_act_decides_for_the_modes_that_need_them(
        self, wish: int, without_sticks: int, action: Action, mode: Mode
    ) -> None:
        mode = Mode.OFFBOARD if mode is Mode.MISSION else mode
        watch = Watch(Mode.OFFBOARD, silent=("manual",), COM_OBL_RC_ACT=wish, NAV_RCL_ACT=without_sticks)
        assert actions(watch.see(7.0, "offboard", "manual")) == [(action, mode)]

    def test_nothing_in_other_modes(self) -> None:
        assert actions(Watch(COM_OBL_RC_ACT=6).see(2.0, "offboard")) == [NOTHING]

    def test_ends_when_they_are_back(self) -> None:
        watch = Watch(Mode.OFFBOARD, COM_OBL_RC_ACT=4)
        watch.see(8.0, "offboard")
        assert actions(watch.see(1.0)) == [(Action.NONE, Mode.OFFBOARD)]

    def test_a_lost_link_that_asks_for_more_wins(self) -> None:
        watch = Watch(Mode.OFFBOARD, COM_OBL_RC_ACT=5, NAV_DLL_ACT=3, COM_FAIL_ACT_T=0.0)
        assert actions(watch.see(1.0, "offboard")) == [(Action.HOLD, Mode.LOITER)]
        assert actions(watch.see(1.0, "offboard", "gcs")) == [(Action.LAND, Mode.LAND)]
        assert actions(watch.see(1.0)) == [(Action.LAND, Mode.LAND)]


@given(
    wait_s=st.floats(width=32, allow_nan=True, allow_infinity=True),
    acts=st.tuples(*(st.integers(-(2**31), 2**31 - 1) | st.integers(0, 8) for _ in range(5))),
    lost=st.lists(st.tuples(*(st.booleans() for _ in range(3))), max_size=8),
    intended=st.sampled_from(list(Mode)),
)
def test_whatever_the_parameters_hold_it_chooses_something_sane(
    wait_s: float, acts: tuple[int, ...], lost: list[tuple[bool, bool, bool]], intended: Mode
) -> None:
    names = ("NAV_DLL_ACT", "NAV_RCL_ACT", "COM_OBL_RC_ACT", "COM_RCL_EXCEPT", "COM_DLL_EXCEPT")
    table = ParameterTable()
    for name, value in zip(names, acts, strict=True):
        table.set(name, value)
    table.set("COM_FAIL_ACT_T", wait_s)
    failsafe = Failsafe(table)
    failsafe.on_arm(0, Links(False, False, False))
    for step, links in enumerate(lost, start=1):
        choice = failsafe.choose(step * 400_000, intended, Links(*links))
        assert 0.0 <= choice.delayed_s <= 3600.0
        assert not choice.delayed_s or choice.mode is Mode.LOITER
        assert choice.mode in (intended, ACTION_MODE.get(choice.action))


LOST = "Failsafe activated\t"
HOME_FROM_HERE = ["RTL: start return at 498 m (10 m above destination)\t", "RTL: land at destination\t"]


def said(flight: Any) -> list[str]:
    return [text for _, text in flight.texts]


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
            (0, Mode.RTL, True),
            (1, Mode.RTL, True),
            (2, Mode.RTL, True),
            (3, Mode.RTL, True),
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
        assert running is (mode in (Mode.RTL, Mode.LAND, Mode.LOITER))
        assert len(offboard.said("Failsafe activated\t")) == 1

    @pytest.mark.parametrize("wish", [0, 5])
    def test_comes_back_by_itself_with_the_set_points(self, offboard: Any, wish: int) -> None:
        offboard.parameters.set("COM_OBL_RC_ACT", wish)
        offboard.run(2.0)
        assert offboard.autopilot.mode is (Mode.RTL if wish == 0 else Mode.LOITER)
        offboard.run(0.3, offboard.keep)
        assert offboard.autopilot.mode is Mode.OFFBOARD
        assert not offboard.autopilot.failsafe
        assert said(offboard) == [LOST, *(HOME_FROM_HERE if wish == 0 else [])]

    def test_a_mode_chosen_meanwhile_stays(self, offboard: Any) -> None:
        offboard.run(2.0)
        assert offboard.autopilot.command_mode(Mode.LOITER) is Result.ACCEPTED
        offboard.run(0.5, offboard.keep)
        assert offboard.autopilot.mode is Mode.LOITER
        assert not offboard.autopilot.failsafe

    def test_lands_and_disarms_if_nobody_comes_back(self, offboard: Any) -> None:
        offboard.run_until(lambda: not offboard.autopilot.armed, 40.0)
        assert said(offboard) == [LOST, *HOME_FROM_HERE, "Landing detected\t", "Disarmed by landing\t"]
        # what the user chose last and may arm in is back
        assert offboard.autopilot.mode is Mode.OFFBOARD
        assert not offboard.autopilot.failsafe

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

    @pytest.mark.parametrize(("wish", "mode"), [(0, Mode.POSCTL), (1, Mode.ALTCTL), (2, Mode.STABILIZED)])
    def test_with_sticks_a_pilot_flies_on(self, offboard: Any, wish: int, mode: Mode) -> None:
        offboard.parameters.set("COM_OBL_RC_ACT", wish)
        manual, vehicle = offboard.autopilot.manual, offboard.vehicle

        def centred(k: int) -> None:
            manual.take(vehicle.time_us, 0, Sticks())

        offboard.run(3.0, centred)
        assert offboard.autopilot.mode is mode
        assert offboard.autopilot.intended is Mode.OFFBOARD
        assert offboard.autopilot.failsafe
        assert said(offboard) == [LOST]
        assert offboard.vehicle.truth.position_ned()[2] == pytest.approx(-10.0, abs=1.5)
        offboard.run(0.3, lambda k: (centred(k), offboard.keep(k)))
        assert offboard.autopilot.mode is Mode.OFFBOARD

    def test_offboard_cannot_be_chosen_again_without_a_signal(self, offboard: Any) -> None:
        offboard.run(2.0)
        assert offboard.autopilot.command_mode(Mode.OFFBOARD) is Result.TEMPORARILY_REJECTED
        assert offboard.autopilot.mode is Mode.RTL
        offboard.listen()
        assert said(offboard)[-1] == "Switching to Offboard is currently not available\t"
        assert said(offboard).count(LOST) == 1
