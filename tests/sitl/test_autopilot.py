from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sitl.modes import EXTERNAL_MODES, MODE_NAMES, STICK_MODES, LandedState, Mode, Result
from sitl.rotation import from_euler

LEVEL = (1.0, 0.0, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0)


class TestNothingTurnsWhileDisarmed:
    @pytest.mark.parametrize("quat", [LEVEL, None])
    def test_offboard_set_points_wait_for_arming(self, ground: Any, quat: Any) -> None:
        autopilot = ground.autopilot
        autopilot.command_mode(Mode.OFFBOARD)
        ground.run(1.0, lambda _: autopilot.offboard_attitude(quat, STILL, 0.9))
        assert autopilot.motors == (0.0, 0.0, 0.0, 0.0)
        assert ground.vehicle.truth.position_ned() == (0.0, 0.0, 0.0)
        assert autopilot.attitude_sp.thrust == 0.9  # what was asked for is still shown
        ground.arm()
        ground.run(0.1)
        assert autopilot.motors == pytest.approx((0.9,) * 4, abs=0.02)

    @pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.TERMINATION])
    def test_in_any_mode(self, ground: Any, mode: Mode) -> None:
        assert ground.autopilot.command_mode(mode) is Result.ACCEPTED
        ground.run(3.0)
        assert ground.autopilot.motors == (0.0, 0.0, 0.0, 0.0)

    def test_offboard_before_its_first_set_point_stands_still(self, ground: Any) -> None:
        ground.autopilot.offboard_alive("position")
        ground.autopilot.command_mode(Mode.OFFBOARD)
        ground.arm()
        ground.run(0.5)
        assert ground.autopilot.motors == pytest.approx((0.0,) * 4, abs=1e-6)


class TestTakeOff:
    def test_default_height_in_the_time_a_real_px4_takes(self, flight: Any) -> None:
        up = flight(flight_gains=False)
        armed_s = up.arm()
        up.run(0.5)
        up.autopilot.command_takeoff(None)
        start_s = up.time_s
        up.run_until(lambda: up.autopilot.mode is Mode.LOITER, 20.0)
        assert up.said("Using default takeoff altitude: 2.5 m\t")
        assert up.said("Takeoff detected\t")[0] - armed_s == pytest.approx(1.8, abs=0.1)
        assert up.time_s - start_s == pytest.approx(6.1, abs=0.3)
        up.run(6.0)
        assert up.vehicle.truth.position_ned() == pytest.approx((0.0, 0.0, -2.5), abs=0.1)

    def test_height_above_the_sea(self, ground: Any) -> None:
        ground.arm()
        ground.autopilot.command_takeoff(488.0 + 6.0)
        ground.run_until(lambda: ground.autopilot.mode is Mode.LOITER, 20.0)
        ground.run(5.0)
        assert ground.vehicle.truth.altitude_m() == pytest.approx(494.0, abs=0.1)

    def test_mode_before_arming_goes_up_once_armed(self, ground: Any) -> None:
        assert ground.autopilot.command_mode(Mode.TAKEOFF) is Result.ACCEPTED
        ground.run(1.0)
        assert ground.texts == []
        ground.arm()
        ground.run(12.0)
        assert ground.autopilot.mode is Mode.LOITER
        assert ground.vehicle.truth.position_ned()[2] == pytest.approx(-2.5, abs=0.1)

    def test_spools_up_first(self, ground: Any) -> None:
        ground.arm()
        ground.autopilot.command_takeoff(None)
        ground.run(0.95)
        assert ground.autopilot.motors == pytest.approx((0.0,) * 4, abs=1e-6)
        ground.run(0.3)
        assert min(ground.autopilot.motors) > 0.1

    def test_states_on_the_way(self, ground: Any) -> None:
        assert ground.autopilot.landed_state is LandedState.ON_GROUND
        ground.arm()
        ground.autopilot.command_takeoff(None)
        ground.run(4.0)
        assert ground.autopilot.landed_state is LandedState.TAKEOFF
        ground.run(6.0)
        assert ground.autopilot.landed_state is LandedState.IN_AIR

    def test_in_the_air_it_goes_up_from_here_and_never_down(self, hover: Any) -> None:
        hover.autopilot.command_takeoff(None)
        hover.run(12.0)
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(-20.0, abs=0.2)
        hover.autopilot.command_takeoff(490.0)
        hover.run(5.0)
        assert hover.said("Already higher than takeoff altitude\t")
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(-20.0, abs=0.2)


class TestHoldAndLand:
    @pytest.mark.parametrize("airframe", ["ant-x", "ant-r", "carrier-1", "adam-0"])
    def test_every_airframe_holds_its_place_and_height(self, flight: Any, airframe: str) -> None:
        made = flight(airframe)
        made.take_off(5.0, settle_s=4.0)
        places = []
        made.run(10.0, lambda _: places.append(made.vehicle.truth.position_ned()))
        assert np.abs(np.array(places) - (0.0, 0.0, -5.0)).max() < 0.3

    def test_stops_where_it_can_after_a_dash(self, hover: Any) -> None:
        hover.go_offboard()
        quat = from_euler(0.2, 0.0, 0.0)
        hover.run(3.0, lambda _: hover.autopilot.offboard_attitude(quat, (0.0, 0.0, math.nan), 0.51))
        speed = hover.vehicle.truth.velocity_ned()[1]
        assert speed > 2.5
        hover.autopilot.command_mode(Mode.LOITER)
        hover.run(10.0)
        assert hover.vehicle.truth.velocity_ned() == pytest.approx((0.0, 0.0, 0.0), abs=0.05)

    def test_keeps_the_heading_it_entered_with(self, hover: Any) -> None:
        hover.go_offboard()
        hover.run(4.0, lambda _: hover.autopilot.offboard_attitude(from_euler(0, 0, 1.0), (0.0, 0.0, math.nan), 0.5))
        hover.autopilot.command_mode(Mode.LOITER)
        hover.run(5.0)
        assert hover.vehicle.truth.euler()[2] == pytest.approx(1.0, abs=0.02)

    def test_wrong_hover_thrust_is_learnt_and_not_forgotten_with_the_mode(self, flight: Any) -> None:
        made = flight()
        made.parameters.set("MPC_THR_HOVER", 0.4)
        made.take_off(10.0, settle_s=20.0)
        heights = []
        for mode in (Mode.LOITER, Mode.TAKEOFF, Mode.LOITER):
            before = made.vehicle.truth.position_ned()[2]
            made.autopilot.command_mode(mode)
            made.run(0.6)
            heights.append(made.vehicle.truth.position_ned()[2] - before)
        # an integrator that started again would drop it by a quarter of a metre
        assert max(heights) < 0.05

    def test_lands_says_so_and_disarms_two_seconds_later(self, hover: Any) -> None:
        assert hover.autopilot.command_land() is Result.ACCEPTED
        hover.run(0.1)
        assert hover.autopilot.landed_state is LandedState.LANDING
        hover.run_until(lambda: not hover.autopilot.armed, 40.0)
        landed, disarmed = hover.said("Landing detected\t"), hover.said("Disarmed by landing\t")
        assert hover.said("Landing at current position\t")
        assert disarmed[0] - landed[0] == pytest.approx(2.0, abs=0.03)
        assert hover.autopilot.mode is Mode.LOITER
        assert hover.autopilot.landed_state is LandedState.ON_GROUND
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(0.0, abs=0.01)

    def test_touches_down_gently(self, hover: Any) -> None:
        hover.autopilot.command_land()
        speeds = []

        def watch(_: int) -> None:
            if hover.vehicle.truth.position_ned()[2] > -0.05:
                speeds.append(hover.vehicle.truth.velocity_ned()[2])

        hover.run(20.0, watch)
        assert 0.5 < max(speeds) < 0.8

    def test_com_disarm_land_is_obeyed(self, hover: Any) -> None:
        hover.parameters.set("COM_DISARM_LAND", 0.5)
        hover.autopilot.command_land()
        hover.run_until(lambda: not hover.autopilot.armed, 40.0)
        assert hover.said("Disarmed by landing\t")[0] - hover.said("Landing detected\t")[0] == pytest.approx(
            0.5, abs=0.03
        )

    def test_hold_after_landing_stays_down(self, hover: Any) -> None:
        hover.autopilot.command_land()
        hover.run_until(lambda: bool(hover.said("Landing detected\t")), 40.0)
        hover.autopilot.command_mode(Mode.LOITER)
        hover.run(3.0)
        assert hover.said("Disarmed by landing\t")
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(0.0, abs=0.01)

    def test_take_off_again_after_landing(self, hover: Any) -> None:
        hover.autopilot.command_land()
        hover.run_until(lambda: bool(hover.said("Landing detected\t")), 40.0)
        hover.autopilot.command_takeoff(None)
        hover.run(15.0)
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(-10.0, abs=0.3)


class TestInTheAir:
    def test_disarming_is_denied_unless_forced(self, hover: Any) -> None:
        assert hover.autopilot.command_arm(False) is Result.TEMPORARILY_REJECTED
        hover.listen()
        assert hover.said("Disarming denied: not landed\t")
        assert hover.autopilot.command_arm(False, force=True) is Result.ACCEPTED
        hover.run(0.5)
        assert hover.said("Disarmed by external command\t")
        assert hover.autopilot.motors == (0.0, 0.0, 0.0, 0.0)
        assert hover.vehicle.truth.velocity_ned()[2] > 3.0

    def test_offboard_is_refused_without_a_signal(self, hover: Any) -> None:
        hover.autopilot.offboard_attitude(LEVEL, STILL, 0.5)
        hover.run(1.1)
        assert hover.autopilot.command_mode(Mode.OFFBOARD) is Result.TEMPORARILY_REJECTED
        assert hover.autopilot.mode is Mode.LOITER
        assert hover.autopilot.rejection == "no offboard signal"

    def test_one_fresh_set_point_is_enough(self, hover: Any) -> None:
        hover.autopilot.offboard_attitude(LEVEL, STILL, 0.5)
        hover.run(0.9)
        assert hover.autopilot.command_mode(Mode.OFFBOARD) is Result.ACCEPTED

    @pytest.mark.parametrize("mode", sorted(STICK_MODES | set(EXTERNAL_MODES)))
    def test_modes_that_cannot_run_are_refused_by_name(self, hover: Any, mode: Mode) -> None:
        assert hover.autopilot.command_mode(mode) is Result.TEMPORARILY_REJECTED
        hover.listen()
        assert [text for _, text in hover.texts] == [f"Switching to {MODE_NAMES[mode]} is currently not available\t"]
        assert hover.autopilot.mode is hover.autopilot.intended is Mode.LOITER

    def test_every_other_mode_is_flown_from_the_next_tick_on(self, hover: Any) -> None:
        waiting = {Mode.OFFBOARD, Mode.MISSION, Mode.TERMINATION}
        for mode in sorted(set(Mode) - STICK_MODES - set(EXTERNAL_MODES) - waiting):
            assert hover.autopilot.command_mode(mode) is Result.ACCEPTED
            hover.run(0.1)
            assert hover.autopilot.mode is mode
            assert hover.autopilot.command_mode(Mode.LOITER) is Result.ACCEPTED
            hover.run(0.4)
        assert hover.vehicle.truth.position_ned() == pytest.approx((0.0, 0.0, -10.0), abs=0.5)

    def test_gain_change_acts_at_the_next_tick(self, flight: Any) -> None:
        runs = []
        for gain in (None, 0.2):
            made = flight(seed=5)
            made.take_off(5.0, settle_s=1.0)
            if gain is not None:
                made.parameters.set("MC_ROLLRATE_P", gain)
            motors = []
            for _ in range(2):
                made.vehicle.step()
                motors.append(made.autopilot.motors)
            runs.append(motors)
        assert runs[0][0] != runs[1][0]

    def test_gyro_cutoff_change_is_smooth(self, hover: Any) -> None:
        hover.go_offboard()
        hover.run(1.0, lambda _: hover.autopilot.offboard_attitude(None, (0.0, 0.0, 1.0), 0.5))
        before = hover.vehicle.estimate.rates()[2]
        hover.parameters.set("IMU_GYRO_CUTOFF", 80.0)
        rates = []
        hover.run(0.05, lambda _: rates.append(hover.vehicle.estimate.rates()[2]))
        assert before == pytest.approx(0.95, abs=0.1)
        assert rates == pytest.approx([before] * len(rates), abs=0.03)

    def test_termination_stops_the_motors_for_good(self, hover: Any) -> None:
        assert hover.autopilot.command_terminate(False) is Result.DENIED
        assert hover.autopilot.command_terminate(True) is Result.ACCEPTED
        hover.run(0.1)
        assert hover.autopilot.motors == (0.0, 0.0, 0.0, 0.0)
        assert hover.autopilot.mode is Mode.TERMINATION
        assert hover.autopilot.failsafe
        for refused in (hover.autopilot.command_mode(Mode.LOITER), hover.autopilot.command_takeoff(None)):
            assert refused is Result.TEMPORARILY_REJECTED
        hover.run(8.0)
        assert hover.vehicle.truth.position_ned()[2] == pytest.approx(0.0, abs=0.05)
        assert hover.autopilot.motors == (0.0, 0.0, 0.0, 0.0)

    def test_termination_on_the_ground_is_denied(self, ground: Any) -> None:
        assert ground.autopilot.command_terminate(True) is Result.DENIED


def test_geometry_changed_on_the_ground_is_flown(ground: Any) -> None:
    ground.parameters.set("CA_ROTOR_COUNT", 6)
    ground.run(0.1)
    assert ground.autopilot.motor_count == 6
    assert len(ground.autopilot.motors) == 6


def test_home_can_be_set_here(hover: Any) -> None:
    assert hover.autopilot.command_set_home_here() is Result.ACCEPTED
    assert hover.autopilot.home.alt_m == pytest.approx(498.0, abs=0.2)


def test_set_points_are_counted_and_stamped(hover: Any) -> None:
    hover.go_offboard()
    hover.vehicle.step()
    before = hover.autopilot.attitude_sp
    hover.autopilot.offboard_attitude((0.0, 0.0, 0.0, 0.0), STILL, -0.5)
    hover.vehicle.step()
    after = hover.autopilot.attitude_sp
    assert after.serial == before.serial + 1 == hover.autopilot.attitude_sp_count
    assert after.time_us == hover.vehicle.time_us - hover.vehicle.tick_us
    assert after.quat == (0.0, 0.0, 0.0, 0.0)
    assert after.thrust == 0.5
    assert all(math.isnan(rate) for rate in after.rates)
