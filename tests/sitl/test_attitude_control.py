from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sitl.attitude_control import attitude_control, attitude_error, linear_attitude_control, reduced_attitude
from sitl.rotation import conjugate, from_euler, multiply, to_euler, to_world

LEVEL = (1.0, 0.0, 0.0, 0.0)
GAIN = (6.5, 5.0, 2.8)
FREE = (math.inf, math.inf, math.inf)
NO_YAW_RATE = math.nan
UP = (0.0, 0.0, 1.0)

component = st.floats(-1.0, 1.0)


@st.composite
def quaternions(draw: st.DrawFn) -> tuple[float, float, float, float]:
    raw = np.array([draw(component) for _ in range(4)])
    assume(np.linalg.norm(raw) > 0.1)
    w, x, y, z = (raw / np.linalg.norm(raw)).tolist()
    return w, x, y, z


def negated(quat: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(-c for c in quat)


def same_attitude(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return abs(float(np.dot(one, other))) > 1.0 - 1e-6


class TestOneAxis:
    @pytest.mark.parametrize("error_rad", [1e-4, 0.2, -0.7, 1.5, 3.0])
    def test_pure_roll_error_asks_for_p_times_twice_the_sine_of_its_half(self, error_rad: float) -> None:
        rates = attitude_control(LEVEL, from_euler(error_rad, 0.0, 0.0), GAIN, 0.4, FREE, NO_YAW_RATE)
        assert rates == pytest.approx((6.5 * 2.0 * math.sin(error_rad / 2.0), 0.0, 0.0), abs=1e-12)

    def test_pure_pitch_error_uses_the_pitch_gain(self) -> None:
        rates = attitude_control(LEVEL, from_euler(0.0, -0.3, 0.0), GAIN, 0.4, FREE, NO_YAW_RATE)
        assert rates == pytest.approx((0.0, -5.0 * 2.0 * math.sin(0.15), 0.0), abs=1e-12)

    @pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (0.1, 0.0, 1.0), (0.5, -0.3, -2.0)])
    def test_roll_error_is_seen_in_body_axes_at_any_attitude(self, start: tuple[float, float, float]) -> None:
        quat = from_euler(*start)
        quat_sp = multiply(quat, from_euler(0.2, 0.0, 0.0))
        rates = attitude_control(quat, quat_sp, GAIN, 0.4, FREE, NO_YAW_RATE)
        assert rates == pytest.approx((6.5 * 2.0 * math.sin(0.1), 0.0, 0.0), abs=1e-9)

    @pytest.mark.parametrize("weight", [0.1, 0.4, 1.0])
    def test_small_yaw_error_asks_for_the_same_rate_at_any_weight(self, weight: float) -> None:
        rates = attitude_control(LEVEL, from_euler(0.0, 0.0, 0.02), GAIN, weight, FREE, NO_YAW_RATE)
        assert rates[:2] == pytest.approx((0.0, 0.0), abs=1e-12)
        assert rates[2] == pytest.approx(2.8 * 0.02, rel=1e-4)
        assert rates[2] == pytest.approx(2.8 / weight * 2.0 * math.sin(weight * 0.01), rel=1e-9)

    def test_weight_zero_leaves_yaw_alone_and_the_gain_undivided(self) -> None:
        rates = attitude_control(LEVEL, from_euler(0.2, 0.0, 1.0), GAIN, 0.0, FREE, NO_YAW_RATE)
        assert rates[2] == pytest.approx(0.0, abs=0.12)
        assert all(math.isfinite(rate) for rate in rates)

    @pytest.mark.parametrize(("weight", "expected"), [(1e-4, 0.0), (1.5e-4, 2.8 * 0.5)])
    def test_a_weight_up_to_a_ten_thousandth_counts_as_none(self, weight: float, expected: float) -> None:
        rates = attitude_control(LEVEL, from_euler(0.0, 0.0, 0.5), GAIN, weight, FREE, NO_YAW_RATE)
        assert rates[2] == pytest.approx(expected, abs=1e-3)

    def test_a_hairs_breadth_of_tilt_does_not_make_yaw_count_in_full(self) -> None:
        error = attitude_error(LEVEL, from_euler(1e-6, 0.0, 1.0), 0.4)
        assert error == pytest.approx((0.0, 0.0, 2.0 * math.sin(0.2)), abs=1e-5)

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_half_a_turn_of_yaw_survives_rounding(self, sign: float) -> None:
        # the quaternion between the two is often longer than 1 by a rounding, of which there is no arc sine
        for heading in np.linspace(-3.0, 3.0, 61):
            quat = from_euler(0.1, 0.4, float(heading))
            error = attitude_error(quat, multiply(quat, (0.0, 0.0, 0.0, sign)), 0.4)
            assert error[:2] == pytest.approx((0.0, 0.0), abs=1e-6)
            assert abs(error[2]) == pytest.approx(2.0 * math.sin(0.4 * math.pi / 2.0), abs=1e-6)

    @pytest.mark.parametrize("quat_sp", [(2.0, 0.0, 0.0, 0.0), (0.5, 0.1, 0.0, 0.0)])
    def test_length_of_the_set_point_does_not_matter(self, quat_sp: tuple[float, ...]) -> None:
        length = math.hypot(*quat_sp)
        unit = tuple(c / length for c in quat_sp)
        assert attitude_error(LEVEL, quat_sp, 0.4) == pytest.approx(attitude_error(LEVEL, unit, 0.4), abs=1e-12)


class TestUpsideDown:
    @pytest.mark.parametrize("attitude", [(math.pi, 0.0, 0.0), (0.0, math.pi, 0.0), (math.pi, 0.0, 1.0)])
    def test_half_a_turn_away_asks_for_a_finite_full_turn_back(self, attitude: tuple[float, float, float]) -> None:
        rates = attitude_control(from_euler(*attitude), LEVEL, (6.5, 6.5, 2.8), 0.4, FREE, NO_YAW_RATE)
        assert all(math.isfinite(rate) for rate in rates)
        assert math.hypot(rates[0], rates[1]) == pytest.approx(13.0, rel=1e-6)

    def test_nearly_half_a_turn_away_turns_the_short_way(self) -> None:
        rates = attitude_control(from_euler(3.1, 0.0, 0.0), LEVEL, GAIN, 0.4, FREE, NO_YAW_RATE)
        assert rates[0] == pytest.approx(-6.5 * 2.0 * math.sin(1.55), rel=1e-9)

    @pytest.mark.parametrize(("gap_rad", "taken_whole"), [(8e-3, True), (10e-3, False)])
    @pytest.mark.parametrize("axis", [0, 1])
    def test_near_half_a_turn_of_roll_or_pitch_the_set_point_is_taken_whole(
        self, axis: int, gap_rad: float, taken_whole: bool
    ) -> None:
        # PX4 does so where less than 4.5e-3 is left of the cosine of half the way
        angles = [0.0, 0.0, 0.0]
        angles[axis] = math.pi - gap_rad
        tilt = from_euler(*angles)
        quat_sp = multiply(tilt, from_euler(0.0, 0.0, 0.5))
        expected = quat_sp if taken_whole else tilt
        assert same_attitude(reduced_attitude(LEVEL, quat_sp), expected)

    @pytest.mark.parametrize(("gap_rad", "taken_whole"), [(0.9e-5, True), (1.2e-5, False)])
    def test_about_a_slanting_axis_only_where_no_way_is_the_shortest(self, gap_rad: float, taken_whole: bool) -> None:
        half = (math.pi - gap_rad) / 2.0
        tilt = (math.cos(half), math.sin(half) * math.sqrt(0.5), math.sin(half) * math.sqrt(0.5), 0.0)
        quat_sp = multiply(tilt, from_euler(0.0, 0.0, 0.5))
        assert same_attitude(reduced_attitude(LEVEL, quat_sp), quat_sp if taken_whole else tilt)


class TestLimitsAndFeedForward:
    def test_each_axis_is_held_to_its_own_limit(self) -> None:
        limit = (1.0, 0.5, 0.2)
        rates = attitude_control(LEVEL, from_euler(0.8, -0.8, 0.2), GAIN, 0.4, limit, NO_YAW_RATE)
        assert rates[0] == 1.0
        assert rates[1] == -0.5
        assert abs(rates[2]) == 0.2

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_each_limit_holds_on_both_sides(self, axis: int, sign: float) -> None:
        limit, angles = (0.3, 0.2, 0.1), [0.0, 0.0, 0.0]
        angles[axis] = sign * 0.5
        rates = attitude_control(LEVEL, from_euler(*angles), GAIN, 0.4, limit, NO_YAW_RATE)
        assert rates[axis] == sign * limit[axis]

    def test_px4s_default_limit_is_met_at_57_degrees(self) -> None:
        limit = math.radians(220.0)
        gain = (4.0, 4.0, 2.8)
        below, above = (
            attitude_control(LEVEL, from_euler(math.radians(deg), 0.0, 0.0), gain, 0.4, (limit,) * 3, NO_YAW_RATE)
            for deg in (57.0, 58.0)
        )
        assert below[0] < limit
        assert above[0] == limit

    @pytest.mark.parametrize("attitude", [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.3, -0.5, 2.0)])
    def test_yaw_rate_turns_about_the_worlds_vertical(self, attitude: tuple[float, float, float]) -> None:
        quat = from_euler(*attitude)
        rates = attitude_control(quat, quat, GAIN, 0.4, FREE, 0.7)
        assert to_world(quat, rates) == pytest.approx((0.0, 0.0, 0.7), abs=1e-9)

    def test_yaw_rate_is_limited_with_the_rest(self) -> None:
        assert attitude_control(LEVEL, LEVEL, GAIN, 0.4, (1.0, 1.0, 0.3), 2.0)[2] == 0.3

    def test_gain_that_is_no_number_gives_a_rate_that_is_none(self) -> None:
        rates = attitude_control(LEVEL, from_euler(0.2, 0.1, 0.0), (math.nan, 5.0, 2.8), 0.4, (1.0,) * 3, math.nan)
        assert math.isnan(rates[0])
        assert rates[1] == pytest.approx(0.499, abs=0.01)


class TestAnyAttitude:
    @settings(deadline=None, max_examples=200)
    @given(quat=quaternions(), quat_sp=quaternions())
    def test_reduced_attitude_points_its_thrust_where_the_set_point_does(self, quat: tuple, quat_sp: tuple) -> None:
        reduced = reduced_attitude(quat, quat_sp)
        assert to_world(reduced, UP) == pytest.approx(to_world(quat_sp, UP), abs=1e-6)

    @settings(deadline=None, max_examples=200)
    @given(quat=quaternions(), quat_sp=quaternions())
    def test_reduced_attitude_is_reached_without_turning_about_the_thrust(self, quat: tuple, quat_sp: tuple) -> None:
        a, b = np.array(to_world(quat, UP)), np.array(to_world(quat_sp, UP))
        assume(a @ b > -0.999)
        turn = multiply(reduced_attitude(quat, quat_sp), conjugate(quat))
        assert np.array(turn[1:]) @ (a + b) == pytest.approx(0.0, abs=1e-9)
        # and it is the shortest: the angle between the two thrust directions
        assert 2.0 * math.acos(min(1.0, abs(turn[0]))) == pytest.approx(math.acos(max(-1.0, min(1.0, a @ b))), abs=1e-6)

    @settings(deadline=None, max_examples=200)
    @given(quat=quaternions(), quat_sp=quaternions())
    def test_a_quaternion_and_its_negative_are_the_same_attitude(self, quat: tuple, quat_sp: tuple) -> None:
        whole = multiply(conjugate(quat), quat_sp)
        assume(abs(whole[0]) > 1e-3)  # half a turn has two equally short ways
        wanted = attitude_error(quat, quat_sp, 1.0)
        assert attitude_error(negated(quat), quat_sp, 1.0) == pytest.approx(wanted, abs=1e-6)
        assert attitude_error(quat, negated(quat_sp), 1.0) == pytest.approx(wanted, abs=1e-6)

    @settings(deadline=None, max_examples=200)
    @given(quat=quaternions(), quat_sp=quaternions())
    def test_with_full_yaw_weight_the_error_is_the_whole_rotation(self, quat: tuple, quat_sp: tuple) -> None:
        whole = multiply(conjugate(quat), quat_sp)
        assume(abs(whole[0]) > 1e-3)
        sign = math.copysign(2.0, whole[0])
        assert attitude_error(quat, quat_sp, 1.0) == pytest.approx([sign * c for c in whole[1:]], abs=1e-6)

    @settings(deadline=None, max_examples=200)
    @given(quat=quaternions(), quat_sp=quaternions(), weight=st.floats(0.0, 1.0), yaw_rate=st.floats(-3.0, 3.0))
    def test_rates_are_finite_and_within_limits(
        self, quat: tuple, quat_sp: tuple, weight: float, yaw_rate: float
    ) -> None:
        rates = attitude_control(quat, quat_sp, GAIN, weight, (3.84, 3.84, 3.49), yaw_rate)
        assert all(abs(rate) <= limit for rate, limit in zip(rates, (3.84, 3.84, 3.49), strict=True))


class TestLinear:
    def test_each_euler_angle_alone(self) -> None:
        rates = linear_attitude_control((0.1, 0.2, 0.3), (0.4, 0.0, 0.1), GAIN)
        assert rates == pytest.approx((6.5 * 0.3, -5.0 * 0.2, -2.8 * 0.2), abs=1e-12)

    def test_heading_goes_the_short_way_round(self) -> None:
        rates = linear_attitude_control((0.0, 0.0, 3.0), (0.0, 0.0, -3.0), GAIN)
        assert rates[2] == pytest.approx(2.8 * (2.0 * math.pi - 6.0), abs=1e-12)

    def test_agrees_with_px4s_law_where_angles_are_small(self) -> None:
        quat = from_euler(1e-4, -2e-4, 0.0)
        exact = attitude_control(quat, LEVEL, GAIN, 1.0, FREE, NO_YAW_RATE)
        assert linear_attitude_control(to_euler(quat), (0.0, 0.0, 0.0), GAIN) == pytest.approx(exact, abs=1e-6)
