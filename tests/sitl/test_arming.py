from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.modes import MODE_NAMES, NEVER_ARM, STICK_MODES, Mode, Result
from sitl.parameters import ParameterTable
from sitl.setpoints import Sticks

STILL = (0.0, 0.0, 0.0)
DENIED = "Arming denied: Resolve system health failures first\t"


class TestArming:
    def test_is_refused_until_the_estimator_is_ready(self, flight: Any) -> None:
        early = flight()
        early.run(1.0)
        assert early.autopilot.command_arm(True) is Result.TEMPORARILY_REJECTED
        early.listen()
        assert [text for _, text in early.texts] == ["Preflight Fail: heading estimate invalid", DENIED]
        assert early.autopilot.rejection == "heading estimate invalid"
        early.get_ready()
        assert early.time_s == pytest.approx(2.0, abs=0.03)
        assert early.autopilot.command_arm(True) is Result.ACCEPTED

    def test_says_so_and_sets_home(self, ground: Any) -> None:
        before = ground.autopilot.home
        ground.run(1.0)
        ground.arm()
        assert ground.said("Armed by external command\t")
        home = ground.autopilot.home
        assert home is not before
        assert (home.lat_deg, home.lon_deg, home.alt_m) == pytest.approx((47.397742, 8.545594, 488.0), abs=1e-6)
        assert home.position_ned == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)

    def test_again_is_accepted_without_a_word(self, ground: Any) -> None:
        ground.arm()
        ground.texts.clear()
        assert ground.autopilot.command_arm(True, force=True) is Result.ACCEPTED
        ground.listen()
        assert ground.texts == []

    def test_disarming_on_the_ground(self, ground: Any) -> None:
        ground.arm()
        ground.run(0.5)
        assert ground.autopilot.command_arm(False) is Result.ACCEPTED
        ground.run(0.1)
        assert ground.said("Disarmed by external command\t")
        assert ground.autopilot.motors == (0.0, 0.0, 0.0, 0.0)

    def test_disarming_the_disarmed_is_accepted_without_a_word(self, ground: Any) -> None:
        assert ground.autopilot.command_arm(False) is Result.ACCEPTED
        ground.listen()
        assert ground.texts == []

    def test_force_does_not_skip_the_checks(self, flight: Any) -> None:
        assert flight().autopilot.command_arm(True, force=True) is Result.TEMPORARILY_REJECTED

    def test_is_refused_in_land_mode_with_the_bare_text(self, ground: Any) -> None:
        ground.autopilot.command_mode(Mode.LAND)
        assert ground.autopilot.command_arm(True) is Result.TEMPORARILY_REJECTED
        ground.listen()
        assert [text for _, text in ground.texts] == [DENIED]
        assert "Land" in ground.autopilot.rejection

    def test_is_refused_in_offboard_without_a_signal_and_not_with_one(self, ground: Any) -> None:
        assert ground.autopilot.command_mode(Mode.OFFBOARD) is Result.ACCEPTED
        assert ground.autopilot.command_arm(True) is Result.TEMPORARILY_REJECTED
        assert ground.autopilot.rejection == "no offboard signal"
        ground.autopilot.offboard_attitude(None, STILL, 0.0)
        assert ground.autopilot.command_arm(True) is Result.ACCEPTED

    @pytest.mark.parametrize(
        ("name", "value"), [("CA_ROTOR_COUNT", 0), ("CA_ROTOR2_PX", math.nan), ("CA_ROTOR0_KM", math.inf)]
    )
    def test_is_refused_without_a_usable_geometry(self, ground: Any, name: str, value: float) -> None:
        ground.parameters.set(name, value)
        ground.run(0.1)
        assert ground.autopilot.command_arm(True) is Result.TEMPORARILY_REJECTED
        assert "CA_ROTOR" in ground.autopilot.rejection

    def test_a_table_without_an_airframe_cannot_arm(self, flight: Any) -> None:
        bare = flight(parameters=ParameterTable())
        bare.get_ready()
        assert bare.autopilot.command_arm(True) is Result.TEMPORARILY_REJECTED


class TestAutoDisarm:
    @pytest.mark.parametrize(("wait_s", "after_s"), [(10.0, 11.0), (3.0, 4.0)])
    def test_comes_a_second_after_com_disarm_prflt(self, ground: Any, wait_s: float, after_s: float) -> None:
        ground.parameters.set("COM_DISARM_PRFLT", wait_s)
        armed_s = ground.arm()
        ground.run(after_s + 0.5)
        (said_s,) = ground.said("Disarmed by auto preflight disarming\t")
        assert said_s - armed_s == pytest.approx(after_s, abs=0.02)
        assert not ground.autopilot.armed
        assert ground.autopilot.mode is Mode.LOITER

    def test_can_be_turned_off(self, ground: Any) -> None:
        ground.parameters.set("COM_DISARM_PRFLT", -1.0)
        ground.arm()
        ground.run(15.0)
        assert ground.autopilot.armed

    def test_take_off_to_where_it_already_is_never_leaves_the_ground(self, ground: Any) -> None:
        # what happens to scripts that send a height above ground where PX4 wants one above the sea
        ground.arm()
        assert ground.autopilot.command_takeoff(10.0) is Result.ACCEPTED
        ground.run(11.5)
        assert ground.said("Already higher than takeoff altitude\t")
        assert ground.said("Disarmed by auto preflight disarming\t")
        assert not ground.said("Takeoff detected\t")


class TestSticksForbidArming:
    """What a real PX4 says of the throttle."""

    def attempt(self, ground: Any, mode: Mode, throttle: float) -> Result:
        assert ground.autopilot.command_mode(mode) is Result.ACCEPTED
        ground.autopilot.manual.take(ground.vehicle.time_us, 0, Sticks(throttle=throttle))
        result: Result = ground.autopilot.command_arm(True)
        ground.listen()
        return result

    @pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.STABILIZED, Mode.ACRO])
    @pytest.mark.parametrize(
        ("throttle", "denied"), [(-1.0, False), (-0.85, False), (-0.7, True), (0.0, True), (0.8, True)]
    )
    def test_throttle_that_is_thrust_must_be_low(self, ground: Any, mode: Mode, throttle: float, denied: bool) -> None:
        assert self.attempt(ground, mode, throttle) is (Result.TEMPORARILY_REJECTED if denied else Result.ACCEPTED)
        said = "Arming denied: throttle not in safe position\t" if denied else "Armed by external command\t"
        assert [text for _, text in ground.texts] == [said]
        assert ground.autopilot.armed is not denied

    @pytest.mark.parametrize("mode", [Mode.ALTCTL, Mode.POSCTL, Mode.POSITION_SLOW, Mode.ALTITUDE_CRUISE])
    @pytest.mark.parametrize(
        ("throttle", "denied"), [(-1.0, False), (0.0, False), (0.15, False), (0.25, True), (1.0, True)]
    )
    def test_throttle_that_is_a_climb_must_not_be_up(
        self, ground: Any, mode: Mode, throttle: float, denied: bool
    ) -> None:
        assert self.attempt(ground, mode, throttle) is (Result.TEMPORARILY_REJECTED if denied else Result.ACCEPTED)
        said = "Arming denied: throttle above center\t" if denied else "Armed by external command\t"
        assert [text for _, text in ground.texts] == [said]

    @pytest.mark.parametrize("mode", [Mode.LOITER, Mode.TAKEOFF])
    def test_in_other_modes_the_throttle_does_not_matter(self, ground: Any, mode: Mode) -> None:
        assert self.attempt(ground, mode, 1.0) is Result.ACCEPTED


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.TERMINATION])
def test_in_which_modes_it_arms_alone(ground: Any, mode: Mode) -> None:
    """Without sticks, set-points and a mission."""
    assert ground.autopilot.command_mode(mode) is Result.ACCEPTED
    arms = mode in (Mode.LOITER, Mode.TAKEOFF, Mode.VTOL_TAKEOFF)
    assert ground.autopilot.command_arm(True) is (Result.ACCEPTED if arms else Result.TEMPORARILY_REJECTED)
    ground.listen()
    said = [text for _, text in ground.texts]
    if arms:
        assert said[0] == "Armed by external command\t"
        return
    assert said == [DENIED]
    reason = ground.autopilot.rejection
    if mode in NEVER_ARM:
        assert reason == f"mode not suitable for arming: {MODE_NAMES[mode]}"
    elif mode in STICK_MODES:
        assert reason == "no manual control"
    else:
        assert reason
    assert not ground.autopilot.armed
    assert not ground.autopilot.ready


class TestGroundStation:
    def test_arming_needs_one_if_its_loss_would_matter(self, ground: Any) -> None:
        ground.parameters.set("NAV_DLL_ACT", 2)
        assert ground.autopilot.command_arm(True) is Result.TEMPORARILY_REJECTED
        ground.listen()
        assert [text for _, text in ground.texts] == [
            "Preflight Fail: No connection to the ground control station",
            DENIED,
        ]
        ground.autopilot.gcs_heard()
        ground.run(0.1)
        assert ground.autopilot.ready
        assert ground.autopilot.command_arm(True) is Result.ACCEPTED


class TestAfterDisarming:
    """The mode that the user chose last and that does not prevent arming is back (recorded: Offboard)."""

    @pytest.mark.parametrize("mode", [Mode.LAND, Mode.RTL, Mode.DESCEND, Mode.ORBIT])
    def test_a_mode_that_prevents_arming_gives_way(self, hover: Any, mode: Mode) -> None:
        hover.autopilot.command_mode(mode)
        hover.run(0.1)
        assert hover.autopilot.command_arm(False, force=True) is Result.ACCEPTED
        assert hover.autopilot.mode is hover.autopilot.intended is Mode.LOITER

    def test_offboard_stays(self, hover: Any) -> None:
        hover.go_offboard()
        hover.autopilot.command_land()
        hover.run(0.1)
        hover.autopilot.command_arm(False, force=True)
        assert hover.autopilot.mode is Mode.OFFBOARD
