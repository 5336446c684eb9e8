from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.filters import (
    PASS_THROUGH,
    alpha_of,
    biquad,
    constrain,
    low_pass_2p,
    notch,
    settle_biquad,
    slope_step,
)


def response(coefficients: tuple[float, ...], frequency_hz: float, rate_hz: float) -> complex:
    """Transfer of a biquad at one frequency, straight from its difference equation."""
    b0, b1, b2, a1, a2 = coefficients
    lag = np.exp(-2j * math.pi * frequency_hz / rate_hz)
    return complex((b0 + b1 * lag + b2 * lag**2) / (1.0 + a1 * lag + a2 * lag**2))


def run(coefficients: tuple[float, ...], samples: np.ndarray) -> np.ndarray:
    table, delay = np.array(coefficients), np.zeros(2)
    return np.array([biquad(table, delay, float(sample)) for sample in samples])


class TestLowPass:
    @pytest.mark.parametrize(
        ("cutoff_hz", "rate_hz"), [(40.0, 250.0), (40.0, 800.0), (20.0, 1000.0), (0.5, 250.0), (124.0, 250.0)]
    )
    def test_is_the_second_order_butterworth(self, cutoff_hz: float, rate_hz: float) -> None:
        b, a = scipy.signal.butter(2, cutoff_hz, fs=rate_hz)
        assert low_pass_2p(cutoff_hz, rate_hz) == pytest.approx((*b, a[1], a[2]), rel=1e-9)

    @pytest.mark.parametrize("rate_hz", [250.0, 800.0, 1000.0])
    def test_half_power_at_the_cutoff_all_at_rest_nothing_at_half_the_rate(self, rate_hz: float) -> None:
        filter_ = low_pass_2p(40.0, rate_hz)
        assert abs(response(filter_, 40.0, rate_hz)) == pytest.approx(math.sqrt(0.5), abs=1e-12)
        assert response(filter_, 0.0, rate_hz) == pytest.approx(1.0, abs=1e-12)
        assert abs(response(filter_, rate_hz / 2.0, rate_hz)) == pytest.approx(0.0, abs=1e-12)

    def test_compiled_filter_gives_what_scipy_gives(self) -> None:
        samples = np.random.default_rng(0).standard_normal(500)
        filter_ = low_pass_2p(40.0, 250.0)
        expected = scipy.signal.lfilter(filter_[:3], (1.0, *filter_[3:]), samples)
        assert run(filter_, samples) == pytest.approx(expected, abs=1e-12)

    def test_slow_signals_come_out_5_6_ms_late_with_px4s_defaults(self) -> None:
        slow_hz = 0.1
        late_s = -np.angle(response(low_pass_2p(40.0, 250.0), slow_hz, 250.0)) / (2.0 * math.pi * slow_hz)
        # sqrt(2) / (2 pi 40 Hz) shortened by the prewarping: tan(x) > x
        assert late_s == pytest.approx(0.004 / math.sqrt(2.0) / math.tan(math.pi * 40.0 / 250.0), rel=1e-4)
        assert late_s == pytest.approx(5.6e-3, abs=0.7e-3)

    @pytest.mark.parametrize("cutoff_hz", [0.0, -1.0, 125.0, 126.0, 1e9, math.inf, math.nan])
    def test_out_of_range_cutoff_passes_everything_through(self, cutoff_hz: float) -> None:
        assert low_pass_2p(cutoff_hz, 250.0) == PASS_THROUGH
        samples = np.random.default_rng(1).standard_normal(20)
        assert run(low_pass_2p(cutoff_hz, 250.0), samples).tolist() == samples.tolist()

    @given(share=st.floats(1e-4, 0.4999), rate_hz=st.sampled_from([100.0, 250.0, 800.0, 8000.0]))
    def test_any_cutoff_is_stable_with_unit_gain_at_rest(self, share: float, rate_hz: float) -> None:
        b0, b1, b2, a1, a2 = low_pass_2p(share * rate_hz, rate_hz)
        assert np.all(np.abs(np.roots([1.0, a1, a2])) < 1.0)
        assert (b0 + b1 + b2) / (1.0 + a1 + a2) == pytest.approx(1.0, rel=1e-6)


class TestNotch:
    @pytest.mark.parametrize(("centre_hz", "width_hz"), [(60.0, 20.0), (30.0, 5.0), (110.0, 10.0)])
    def test_is_the_standard_notch(self, centre_hz: float, width_hz: float) -> None:
        b, a = scipy.signal.iirnotch(centre_hz, centre_hz / width_hz, fs=250.0)
        assert notch(centre_hz, width_hz, 250.0) == pytest.approx((*b, a[1], a[2]), abs=1e-12)

    @pytest.mark.parametrize(("centre_hz", "width_hz"), [(60.0, 100.0), (0.5, 0.25), (60.0, 0.5)])
    def test_its_centre_and_its_width_may_be_anything_below_half_the_rate(
        self, centre_hz: float, width_hz: float
    ) -> None:
        filter_ = notch(centre_hz, width_hz, 250.0)
        assert filter_ != PASS_THROUGH
        assert abs(response(filter_, centre_hz, 250.0)) < 1e-9

    @pytest.mark.parametrize("width_hz", [125.0, 126.0, math.inf])
    def test_is_off_with_a_width_of_half_the_rate_or_more(self, width_hz: float) -> None:
        assert notch(60.0, width_hz, 250.0) == PASS_THROUGH

    def test_takes_out_its_centre_and_leaves_the_ends(self) -> None:
        filter_ = notch(60.0, 20.0, 250.0)
        assert abs(response(filter_, 60.0, 250.0)) < 1e-12
        assert abs(response(filter_, 0.0, 250.0)) == pytest.approx(1.0)
        assert abs(response(filter_, 125.0, 250.0)) == pytest.approx(1.0)

    def test_its_half_power_points_are_the_bandwidth_apart(self) -> None:
        frequencies = np.linspace(40.0, 85.0, 45_001)
        gain = np.abs([response(notch(60.0, 20.0, 250.0), f, 250.0) for f in frequencies[::10]])
        inside = frequencies[::10][gain < math.sqrt(0.5)]
        assert inside[-1] - inside[0] == pytest.approx(20.0, abs=0.05)

    @pytest.mark.parametrize(
        ("centre_hz", "width_hz"), [(0.0, 20.0), (-5.0, 20.0), (125.0, 20.0), (60.0, 0.0), (math.nan, 20.0)]
    )
    def test_is_off_without_a_centre_or_a_width(self, centre_hz: float, width_hz: float) -> None:
        assert notch(centre_hz, width_hz, 250.0) == PASS_THROUGH


class TestAlphaFilter:
    def test_its_weight_is_that_of_a_backward_euler_lag(self) -> None:
        tau_s = 1.0 / (2.0 * math.pi * 20.0)
        assert alpha_of(20.0, 0.004) == pytest.approx(0.004 / (0.004 + tau_s), rel=1e-12)

    def test_a_step_comes_up_with_its_time_constant_when_samples_are_dense(self) -> None:
        tau_s, dt_s = 1.0 / (2.0 * math.pi * 20.0), 1e-6
        pole = 1.0 - alpha_of(20.0, dt_s)
        assert pole ** (tau_s / dt_s) == pytest.approx(math.exp(-1.0), rel=1e-3)

    def test_a_cutoff_below_one_hertz_is_a_filter_too(self) -> None:
        assert alpha_of(0.5, 0.004) == pytest.approx(0.004 / (0.004 + 1.0 / math.pi))

    @pytest.mark.parametrize("cutoff_hz", [0.0, -3.0, math.nan])
    def test_off_means_the_new_sample_is_taken_whole(self, cutoff_hz: float) -> None:
        assert alpha_of(cutoff_hz, 0.004) == 1.0


@pytest.mark.parametrize("filter_", [low_pass_2p(40.0, 250.0), notch(60.0, 20.0, 250.0), PASS_THROUGH])
@settings(deadline=None, max_examples=20)
@given(level=st.floats(-50.0, 50.0))
def test_a_settled_filter_goes_on_as_if_its_input_had_always_been_there(
    filter_: tuple[float, ...], level: float
) -> None:
    table, delay = np.array(filter_), np.zeros(2)
    settle_biquad(table, delay, level)
    assert [biquad(table, delay, level) for _ in range(5)] == pytest.approx([level] * 5, abs=1e-9)


def test_a_cutoff_too_low_to_compute_with_still_settles() -> None:
    table, delay = np.array(low_pass_2p(1e-30, 250.0)), np.zeros(2)
    settle_biquad(table, delay, 3.0)
    assert delay.tolist() == [0.0, 0.0]


def test_the_slope_is_a_share_of_the_way_to_the_newest_difference() -> None:
    # from 3 towards (5 - 4) / 0.25 = 4, a quarter of the way
    assert slope_step(3.0, 5.0, 4.0, 0.25, 0.25) == 3.25
    assert slope_step(3.0, 5.0, 4.0, 1.0, 0.25) == 4.0


def test_the_slope_of_a_ramp_is_found_with_the_lag_of_a_first_order_low_pass() -> None:
    slope, alpha = 0.0, alpha_of(20.0, 0.004)
    for k in range(1, 11):
        slope = slope_step(slope, 2.0 * k * 0.004, 2.0 * (k - 1) * 0.004, alpha, 0.004)
    assert slope == pytest.approx(2.0 * (1.0 - (1.0 - alpha) ** 10))


@pytest.mark.parametrize(
    ("value", "expected"), [(0.3, 0.3), (2.0, 1.0), (-2.0, -1.0), (math.inf, 1.0), (-math.inf, -1.0)]
)
def test_constrain_keeps_a_value_between_its_limits(value: float, expected: float) -> None:
    assert constrain(value, -1.0, 1.0) == expected


def test_constrain_lets_nan_through_as_px4_does() -> None:
    assert math.isnan(constrain(math.nan, -1.0, 1.0))
    assert constrain(7.0, -math.nan, math.nan) == 7.0
