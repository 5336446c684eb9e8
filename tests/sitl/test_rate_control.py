from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.rate_control import rate_control

DT_S = 0.004
USUAL: dict[str, Any] = {
    "rate": 0.2,
    "rate_sp": 1.2,
    "accel": 10.0,
    "integral": 0.05,
    "k": 1.0,
    "kp": 0.15,
    "ki": 0.2,
    "kd": 0.003,
    "kff": 0.0,
    "int_lim": 0.3,
    "positive_saturated": False,
    "negative_saturated": False,
    "frozen": False,
    "dt_s": DT_S,
}
FADE = 1.0 - (1.0 / math.radians(400.0)) ** 2
"""Share of the integration left at an error of 1 rad/s."""


def law(**changes: Any) -> tuple[float, float]:
    return rate_control(*(USUAL | changes).values())


class TestTorque:
    def test_is_p_on_the_error_plus_the_integral_minus_d_on_the_acceleration(self) -> None:
        torque, _ = law()
        assert torque == pytest.approx(0.15 * 1.0 + 0.05 - 0.003 * 10.0, abs=1e-15)

    def test_is_formed_before_the_integrator_moves(self) -> None:
        without, _ = law(ki=0.0)
        assert law(ki=5.0)[0] == without

    def test_derivative_acts_on_the_measurement_only(self) -> None:
        # no kick: a step of the set-point changes P alone
        assert law(rate_sp=5.2)[0] - law()[0] == pytest.approx(0.15 * 4.0, abs=1e-15)

    def test_k_scales_p_and_d_but_not_feed_forward_nor_the_integral_itself(self) -> None:
        torque, _ = law(k=2.0, kff=0.01)
        assert torque == pytest.approx(2.0 * 0.15 * 1.0 + 0.05 - 2.0 * 0.003 * 10.0 + 0.01 * 1.2, abs=1e-15)

    def test_is_not_clamped(self) -> None:
        assert law(kp=100.0)[0] == pytest.approx(100.0 + 0.05 - 0.03)

    @pytest.mark.parametrize("rate_sp", [math.nan, math.inf, -math.inf])
    def test_set_point_that_is_no_number_counts_as_the_present_rate(self, rate_sp: float) -> None:
        torque, integral = law(rate_sp=rate_sp, kff=0.1)
        assert torque == pytest.approx(0.05 - 0.03 + 0.1 * 0.2, abs=1e-15)
        assert integral == 0.05

    @pytest.mark.parametrize("bad", [{"rate": math.nan}, {"kp": math.nan}, {"accel": math.inf}, {"kd": math.nan}])
    def test_torque_that_is_no_number_becomes_zero(self, bad: dict[str, float]) -> None:
        assert law(**bad)[0] == 0.0


class TestIntegrator:
    def test_moves_by_the_faded_error(self) -> None:
        assert law()[1] == pytest.approx(0.05 + FADE * 0.2 * 1.0 * DT_S, abs=1e-15)

    def test_k_scales_its_gain(self) -> None:
        assert law(k=2.0)[1] == pytest.approx(0.05 + FADE * 2.0 * 0.2 * 1.0 * DT_S, abs=1e-15)

    @pytest.mark.parametrize("error_deg_s", [400.0, 401.0, -400.0, 3000.0])
    def test_stops_at_an_error_of_400_deg_s(self, error_deg_s: float) -> None:
        integral = law(rate=0.0, rate_sp=math.radians(error_deg_s))[1]
        assert integral == pytest.approx(0.05, abs=1e-12)

    def test_is_at_three_quarters_at_200_deg_s(self) -> None:
        error = math.radians(200.0)
        moved = law(rate=0.0, rate_sp=error)[1] - 0.05
        assert moved == pytest.approx(0.75 * 0.2 * error * DT_S, abs=1e-12)

    def test_its_limit_is_in_torque_and_not_scaled_by_k(self) -> None:
        assert law(integral=0.2999, k=3.0, ki=50.0)[1] == 0.3
        assert law(integral=-0.2999, k=3.0, ki=50.0, rate_sp=-1.0)[1] == -0.3

    def test_no_limit_means_no_fading_either(self) -> None:
        # the study's PID: what infinity stands for
        moved = law(rate=0.0, rate_sp=math.radians(500.0), int_lim=math.inf)[1] - 0.05
        assert moved == pytest.approx(0.2 * math.radians(500.0) * DT_S, abs=1e-12)

    def test_frozen_on_the_ground_while_the_rest_goes_on(self) -> None:
        torque, integral = law(frozen=True)
        assert integral == 0.05
        assert torque == law()[0]

    @pytest.mark.parametrize(("rate_sp", "moves"), [(1.2, False), (-1.0, True)])
    def test_positive_saturation_lets_it_go_down_only(self, rate_sp: float, moves: bool) -> None:
        integral = law(rate_sp=rate_sp, positive_saturated=True)[1]
        assert (integral < 0.05) if moves else (integral == 0.05)

    @pytest.mark.parametrize(("rate_sp", "moves"), [(-1.0, False), (1.2, True)])
    def test_negative_saturation_lets_it_go_up_only(self, rate_sp: float, moves: bool) -> None:
        integral = law(rate_sp=rate_sp, negative_saturated=True)[1]
        assert (integral > 0.05) if moves else (integral == 0.05)

    @pytest.mark.parametrize("rate_sp", [1.2, -1.0])
    def test_saturated_both_ways_it_stands_still(self, rate_sp: float) -> None:
        assert law(rate_sp=rate_sp, positive_saturated=True, negative_saturated=True)[1] == 0.05

    def test_saturation_does_not_touch_the_torque(self) -> None:
        assert law(positive_saturated=True)[0] == law()[0]

    @pytest.mark.parametrize("bad", [{"rate": math.nan}, {"ki": math.nan}, {"ki": math.inf}])
    def test_a_step_that_is_no_number_is_thrown_away(self, bad: dict[str, float]) -> None:
        assert law(**bad)[1] == 0.05

    def test_limit_that_is_no_number_does_not_limit(self) -> None:
        assert law(integral=0.5, int_lim=math.nan)[1] == pytest.approx(0.5 + FADE * 0.2 * DT_S, abs=1e-12)


number = st.floats(-50.0, 50.0)


@settings(deadline=None, max_examples=200)
@given(
    rate=number,
    rate_sp=st.one_of(number, st.just(math.nan)),
    integral=st.floats(-0.3, 0.3),
    ki=st.floats(0.0, 100.0),
    positive=st.booleans(),
    negative=st.booleans(),
)
def test_integral_stays_in_its_limit_and_never_winds_into_a_saturated_side(
    rate: float, rate_sp: float, integral: float, ki: float, positive: bool, negative: bool
) -> None:
    torque, after = law(
        rate=rate,
        rate_sp=rate_sp,
        integral=integral,
        ki=ki,
        positive_saturated=positive,
        negative_saturated=negative,
    )
    assert math.isfinite(torque)
    assert -0.3 <= after <= 0.3
    assert not (positive and after > integral)
    assert not (negative and after < integral)
