"""Margins of many loops, sampled and continuous, against eigenvalues, bisection and loops known by heart."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.airframe import Derivatives, load_airframe
from sitl.continuous_loop import ContinuousLoop, continuous_margins
from sitl.errors import UsageError
from sitl.lateral import LateralModel
from sitl.margin_batch import MarginArrays, batch_margins
from sitl.profile import Profile, get_profile
from sitl.sampled_loop import RollGains, SampledLoop
from sitl.stability import loop_margins
from sitl.uncertainty import sample_derivatives

FLOWN = RollGains(6.5, 1.0, 0.05, 0.05, 0.001)
HINF = RollGains(12.04, 1.0, 0.6, 35.8, 3.57e-6)
PROFILES = [get_profile("study"), get_profile("study", rate_hz=400), get_profile("sitl"), get_profile("board")]


def samples(name: str, count: int, factor: float = 1.0) -> np.ndarray:
    frame = load_airframe(name)
    sigma = Derivatives.from_values(frame.sigma_pct.as_array() * factor)
    return sample_derivatives(frame.derivatives, sigma, count, np.random.default_rng(3))


def radius(d: np.ndarray, g: RollGains, profile: Profile, lag: float, gain: float = 1.0, delay: float = 0.0) -> float:
    """Spectral radius of one closed loop, by eigenvalues alone."""
    loop = SampledLoop(Derivatives.from_values(d), g, profile, lag, delay)
    return float(np.abs(loop.eigenvalues(gain)).max())


@pytest.mark.parametrize("profile", PROFILES, ids=lambda p: f"{p.name}-{p.rate_hz}")
@pytest.mark.parametrize("name", ["ant-r", "ant-x", "carrier-1", "adam-0"])
def test_margins_are_where_eigenvalues_cross_the_unit_circle(profile: Profile, name: str) -> None:
    """Samples of three times the study's uncertainty: stable ones lose their stability exactly where we say."""
    d = samples(name, 12, 3.0)
    own = load_airframe(name).flight_gains
    assert own is not None
    lag = profile.motor_lag(0.025)
    gains = [RollGains.from_flight_gains(own), HINF]
    found = batch_margins(d, gains, profile, lag)
    assert found.closed_loop_stable.shape == (2, 12)
    for g, one in enumerate(gains):
        for s, row in enumerate(d):
            stable = radius(row, one, profile, lag) < 1.0
            assert bool(found.closed_loop_stable[g, s]) is stable
            for margin in (found.gain_margin_low_db[g, s], found.gain_margin_high_db[g, s]):
                if math.isfinite(margin):
                    at = 10.0 ** (margin / 20.0)
                    assert radius(row, one, profile, lag, at) == pytest.approx(1.0, abs=1e-7)
                    inner = at * (1.0 + 1e-4 * (1 if margin == found.gain_margin_low_db[g, s] else -1))
                    assert radius(row, one, profile, lag, inner) < 1.0
            if stable:
                assert found.gain_margin_high_db[g, s] > 0.0
                assert not found.gain_margin_low_db[g, s] > 0.0


@pytest.mark.parametrize("profile", [get_profile("sitl"), get_profile("board")], ids=["sitl", "board"])
def test_delay_margin_is_where_more_delay_makes_it_unstable(profile: Profile) -> None:
    """Bisection on the delay, with eigenvalues as judge. With a motor lag part of a tick is as good as exact."""
    d = samples("adam-0", 6)
    own = load_airframe("adam-0").flight_gains
    assert own is not None
    g = RollGains.from_flight_gains(own)
    found = batch_margins(d, [g], profile, 0.02).delay_margin_s[0]
    for row, margin in zip(d, found, strict=True):
        assert radius(row, g, profile, 0.02) < 1.0
        low, high = 0.0, 0.2
        while high - low > 1e-6:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if radius(row, g, profile, 0.02, 1.0, middle) < 1.0 else (low, middle)
        assert margin == pytest.approx(low, abs=2e-5)


def test_a_batch_of_many_is_many_batches_of_one() -> None:
    d = samples("ant-x", 300, 3.0)
    for profile in PROFILES[1:3]:
        lag = profile.motor_lag(0.025)
        found = batch_margins(d, [FLOWN, HINF], profile, lag)
        for s in (0, 1, 127, 128, 299):
            for g, one in enumerate((FLOWN, HINF)):
                alone = loop_margins(Derivatives.from_values(d[s]), one, profile, lag)
                for field in fields(alone):
                    if hasattr(found, field.name):
                        value, single = getattr(found, field.name)[g, s], getattr(alone, field.name)
                        assert value == pytest.approx(math.nan if single is None else single, nan_ok=True, rel=1e-9)


def test_the_upper_limit_of_the_bare_sampled_loop_lies_at_half_the_rate() -> None:
    """At z = -1: python-control's `margin` does not look there, eigenvalues do."""
    profile = get_profile("study", rate_hz=400)
    d = samples("ant-x", 20)
    found = batch_margins(d, [FLOWN], profile, 0.0)
    assert found.phase_crossover_rad_s[0] == pytest.approx(math.pi * 400.0)
    for row, high in zip(d, found.gain_margin_high_db[0], strict=True):
        at = 10.0 ** (high / 20.0)
        values = SampledLoop(Derivatives.from_values(row), FLOWN, profile, 0.0).eigenvalues(at)
        assert np.abs(values + 1.0).min() < 1e-6


@given(
    st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6),
    st.floats(0.0, 20.0),
    st.floats(0.0, 2.0),
    st.floats(0.0, 50.0),
    st.floats(0.0, 0.01),
    st.sampled_from(PROFILES),
    st.sampled_from([0.0, 0.03]),
)
@settings(deadline=None, max_examples=60)
def test_any_model_and_gains_give_numbers_that_hold_together(
    spread: list[float], k_phi: float, kp: float, ki: float, kd: float, profile: Profile, lag: float
) -> None:
    """Even signs may be wrong: no warning, no NaN where a number exists, stability as eigenvalues have it."""
    nominal = load_airframe("ant-x").derivatives.as_array()
    d = np.stack([nominal, nominal * np.array(spread)])
    one = RollGains(k_phi, 1.0, kp, ki, kd)
    found = batch_margins(d, [one], profile, lag)
    for s in (0, 1):
        size = radius(d[s], one, profile, lag)
        if abs(size - 1.0) > 1e-9:
            assert bool(found.closed_loop_stable[0, s]) is (size < 1.0)
        if found.closed_loop_stable[0, s]:
            assert found.phase_margin_deg[0, s] > 0.0
            assert found.delay_margin_s[0, s] > 0.0
            assert found.sensitivity_peak[0, s] == pytest.approx(1.0 / found.modulus_margin[0, s])
        assert not np.isnan(found.modulus_margin[0, s])


class TestPeaks:
    def test_are_the_largest_on_a_dense_grid(self) -> None:
        d = samples("ant-r", 8)
        profile = get_profile("sitl")
        found = batch_margins(d, [FLOWN], profile, 0.01)
        omega = np.geomspace(1e-3, math.pi * 250.0, 40_000)
        for s, row in enumerate(d):
            L = SampledLoop(Derivatives.from_values(row), FLOWN, profile, 0.01).transfer(omega)
            assert found.sensitivity_peak[0, s] == pytest.approx(np.abs(1 / (1 + L)).max(), rel=1e-5)
            assert found.complementary_peak[0, s] == pytest.approx(np.abs(L / (1 + L)).max(), rel=1e-5)
            assert found.sensitivity_peak[0, s] >= np.abs(1 / (1 + L)).max() * (1 - 1e-12)


class TestContinuous:
    def test_a_rate_loop_known_by_heart(self) -> None:
        """Lv = 0 and K_phi = -Lp: L = G / s / (1 + T s), all margins on paper."""
        a, gain, lag = 2.0, 40.0, 0.05
        d = np.array([[-0.1, 0.0, 0.0, 0.0, -a, gain]])
        found = continuous_margins(d, [RollGains(a, 1.0, 1.0, 0.0, 0.0)], lag)
        w = math.sqrt((math.sqrt(1.0 + 4.0 * lag**2 * gain**2) - 1.0) / 2.0) / lag
        phase = math.pi / 2.0 - math.atan(w * lag)
        assert found.crossover_rad_s[0, 0] == pytest.approx(w, rel=1e-9)
        assert found.phase_margin_deg[0, 0] == pytest.approx(math.degrees(phase), rel=1e-9)
        assert found.delay_margin_s[0, 0] == pytest.approx(phase / w, rel=1e-9)
        assert found.gain_margin_high_db[0, 0] == math.inf

    def test_the_matrix_is_the_transfer_function(self) -> None:
        """det(s - closed(g)) / det(s - closed(0)) = 1 + g L, up to the share that the ideal derivative has at once."""
        d = samples("carrier-1", 3)
        rows = np.arange(3)
        for gains, lag in ((HINF, 0.0), (RollGains(6.5, 1.2, 0.15, 0.2, 0.002, 0.05), 0.02), (FLOWN, 0.0)):
            loop = ContinuousLoop(d, gains, lag)
            for w in (0.3, 4.0, 60.0):
                s = 1j * w
                closed = loop.closed_loop_matrix(np.full(3, 1.7), rows)
                opened = loop.closed_loop_matrix(np.zeros(3), rows)
                unit = np.eye(closed.shape[-1])
                ratio = np.linalg.det(s * unit - closed) / np.linalg.det(s * unit - opened)
                L = loop.values(np.full(3, w), rows)
                at_once = 1.0 + 1.7 * gains.k * gains.kd * d[:, 5] if lag == 0.0 else 1.0
                assert ratio * at_once == pytest.approx(1.0 + 1.7 * L, rel=1e-8)

    def test_the_gains_of_the_study_have_no_upper_limit_on_its_own_loop(self) -> None:
        """As chapter 7 says; with motors that lag by 25 ms they are not even stable."""
        d = samples("ant-x", 200)
        assert np.isinf(continuous_margins(d, [HINF]).gain_margin_high_db).all()
        assert continuous_margins(d, [HINF]).closed_loop_stable.all()
        assert not continuous_margins(d, [HINF], 0.025).closed_loop_stable.any()

    def test_a_fast_sampled_loop_is_the_continuous_one(self) -> None:
        d = samples("adam-0", 10)
        one = RollGains(6.5, 1.0, 0.15, 0.05, 0.0)
        fast = batch_margins(d, [one], get_profile("study", rate_hz=8000), 0.02)
        slow = continuous_margins(d, [one], 0.02)
        for name in ("phase_margin_deg", "delay_margin_s", "gain_margin_low_db", "sensitivity_peak"):
            assert getattr(fast, name) == pytest.approx(getattr(slow, name), rel=6e-3)

    def test_model_and_loop_share_the_same_poles(self) -> None:
        model = load_airframe("ant-r").derivatives
        opened = ContinuousLoop(model.as_array()[None], FLOWN).closed_loop_matrix(np.zeros(1), np.zeros(1, dtype=int))
        values = np.linalg.eigvals(opened[0])
        for pole in np.linalg.eigvals(LateralModel.from_derivatives(model).A):
            assert np.abs(values - pole).min() < 1e-9


class TestMarginal:
    """Without K_phi the integral of p stands for phi: one mode lies on the boundary, whatever the model."""

    @pytest.mark.parametrize("profile", ["study", "sitl", "board"])
    def test_no_attitude_gain_is_no_stability_whatever_the_rounding(self, profile: str) -> None:
        still = RollGains(0.0, 1.0, 0.05, 0.05, 0.001)
        d = samples("ant-x", 200)
        found = batch_margins(d, [still], get_profile(profile), 0.0 if profile == "study" else 0.025)
        assert not found.closed_loop_stable.any()

    def test_the_continuous_loop_alike(self) -> None:
        still = RollGains(0.0, 1.0, 0.05, 0.05, 0.001)
        assert not continuous_margins(samples("ant-x", 200), [still]).closed_loop_stable.any()

    def test_a_slow_mode_that_dies_is_stable(self) -> None:
        """v' = -1e-4 v decays in hours, and feels nothing of the loop's."""
        d = np.array([[-1e-4, 0.0, 0.0, 0.0, -2.0, 400.0]])
        assert batch_margins(d, [FLOWN], get_profile("study"), 0.0).closed_loop_stable.all()


class TestBadInput:
    @pytest.mark.parametrize("bad", [np.zeros((0, 6)), np.zeros((2, 5)), np.full((2, 6), math.inf)])
    def test_samples(self, bad: np.ndarray) -> None:
        for margins in (
            lambda: batch_margins(bad, [FLOWN], PROFILES[0], 0.0),
            lambda: continuous_margins(bad, [FLOWN]),
        ):
            with pytest.raises(UsageError, match="sample"):
                margins()

    def test_gains(self) -> None:
        d = samples("ant-x", 2)
        with pytest.raises(UsageError, match="no gain set"):
            batch_margins(d, [], PROFILES[0], 0.0)
        with pytest.raises(UsageError, match="finite"):
            batch_margins(d, [replace(FLOWN, kp=math.nan)], PROFILES[0], 0.0)
        none = batch_margins(d, [RollGains(0.0, 1.0, 0.0, 0.0, 0.0)], PROFILES[2], 0.025)
        assert not none.closed_loop_stable.any()
        assert isinstance(none, MarginArrays)


def test_gain_sets_together_are_gain_sets_alone() -> None:
    """Stable and unstable, with and without integrator, more rows than are worked on at once."""
    rng = np.random.default_rng(5)
    model = load_airframe("ant-x").derivatives.as_array()
    d = model * rng.uniform(0.8, 1.2, (90, 6))
    gains = [
        RollGains(k_phi, k, kp, float(rng.choice([0.0, 0.4])), kd, float(rng.choice([0.0, 0.02])))
        for k_phi, k, kp, kd in rng.uniform([1.0, 0.5, 0.01, 0.0], [14.0, 1.5, 0.5, 0.006], (30, 4)).tolist()
    ]
    assert len(d) * len(gains) > 2048
    together = batch_margins(d, gains, PROFILES[2], 0.02)
    assert 0.1 < together.closed_loop_stable.mean() < 0.9
    for g, one in enumerate(gains):
        alone = batch_margins(d[:7], [one], PROFILES[2], 0.02)
        for field in fields(MarginArrays):
            got, wanted = getattr(together, field.name)[g, :7], getattr(alone, field.name)[0]
            assert got == pytest.approx(wanted, rel=1e-9, abs=1e-12, nan_ok=True), (g, field.name)
