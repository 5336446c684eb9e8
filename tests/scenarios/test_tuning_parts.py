"""Requirements, the weights made of them, the channels they shape and the step that is flown."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios.tuning.channels import Channels
from scenarios.tuning.requirements import PRACTICAL, STUDY, Requirements, requirements_for
from scenarios.tuning.step_trial import StepTrial
from scenarios.tuning.weights import Weight, weights_for
from sitl.errors import UsageError
from sitl.profile import Profile, get_profile
from sitl.sampled_loop import RollGains
from sitl.uncertainty import sample_derivatives
from sitl.vehicle_spec import resolve_vehicle

sys.path.insert(0, str(Path(__file__).parent))  # a module beside the tests that is no test

from roll_oracle import RollOracle, weight_at

PROFILES = [get_profile("study"), get_profile("sitl"), get_profile("board")]
OMEGA = np.geomspace(1e-3, 1e5, 20_001)


def continuous(weight: Weight, omega: np.ndarray) -> np.ndarray:
    return np.abs((1j * omega * weight.a + weight.b) / (1j * omega * weight.c + weight.d))


def models(name: str, count: int) -> np.ndarray:
    model = resolve_vehicle(name)
    drawn = sample_derivatives(model.derivatives, model.sigma_pct, count, np.random.default_rng(8))
    return np.concatenate([model.derivatives.as_array()[None], drawn])


class TestRequirements:
    def test_are_the_studys_for_its_own_profile_and_practical_elsewhere(self) -> None:
        """Section 7.1: 0.5 s, 0.15 %, 10 rad/s, 0.9, 1.3, no limit on control effort."""
        study = requirements_for("study")
        assert (study.settling_time_s, study.overshoot_pct, study.natural_frequency_rad_s) == (0.5, 0.15, 10.0)
        assert (study.damping, study.peak_sensitivity, study.peak_delta_lat) == (0.9, 1.3, math.inf)
        for profile in ("sitl", "board"):
            asked = requirements_for(profile)
            assert (asked.settling_time_s, asked.overshoot_pct, asked.delay_margin_s) == (0.6, 5.0, 0.020)

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("settling_time_s", 0.0),
            ("settling_time_s", -1.0),
            ("settling_time_s", math.nan),
            ("settling_time_s", math.inf),
            ("settling_time_s", 0.049),
            ("overshoot_pct", -0.1),
            ("overshoot_pct", math.inf),
            ("delay_margin_s", -1e-3),
            ("delay_margin_s", math.inf),
            ("delay_margin_s", math.nan),
            ("damping", 0.0),
            ("peak_sensitivity", math.inf),
            ("peak_delta_lat", 0.0),
            ("amplitude_deg", 46.0),
        ],
    )
    def test_that_nothing_can_meet_are_refused_by_name(self, name: str, value: float) -> None:
        with pytest.raises(UsageError, match=name):
            replace(PRACTICAL, **{name: value})

    def test_of_no_overshoot_and_no_delay_margin_are_fine(self) -> None:
        assert Requirements(0.5, 0.0, 0.0).overshoot_pct == 0.0


class TestWeights:
    @pytest.mark.parametrize("required", [STUDY, PRACTICAL, replace(STUDY, settling_time_s=0.1)])
    def test_ends_are_what_is_allowed_at_rest_and_far_out(self, required: Requirements) -> None:
        first, second, third = weights_for(required)
        low, high = np.array([1e-6]), np.array([1e9])
        assert continuous(first, low) == pytest.approx(1.0 / 0.03)  # 3 % of a set-point may be missing
        assert continuous(first, high) == pytest.approx(1.0 / required.peak_sensitivity)
        assert continuous(third, high) == pytest.approx(100.0 * continuous(third, low))
        assert 1.0 / continuous(third, low) == pytest.approx(1.0 + required.overshoot_pct / 100.0)
        assert np.all(np.diff(continuous(first, OMEGA)) <= 0.0)
        assert np.all(np.diff(continuous(third, OMEGA)) >= 0.0)
        assert continuous(second, low) == continuous(second, high)

    def test_torque_per_set_point_is_the_peak_torque_over_the_step(self) -> None:
        """0.5 in a step of 10 degrees; the study's "no limit" leaves 1000 per rad."""
        assert 1.0 / weights_for(PRACTICAL)[1].b == pytest.approx(0.5 / math.radians(10.0))
        assert 1.0 / weights_for(STUDY)[1].b == pytest.approx(1e3)

    @given(st.floats(0.06, 3.0), st.floats(1.05, 3.0))
    @settings(deadline=None, max_examples=40)
    def test_a_first_order_loop_that_just_settles_keeps_w1_and_half_as_fast_breaks_it(
        self, settling: float, peak: float
    ) -> None:
        """exp(-w t) = 5 % at the settling time, where that asks for more than the natural frequency."""
        required = replace(STUDY, settling_time_s=settling, peak_sensitivity=peak, natural_frequency_rad_s=0.1)
        first, _, _ = weights_for(required)
        speed = -math.log(0.05) / settling
        for factor, kept in ((1.0, True), (2.0, True), (0.5, False)):
            s = 1j * OMEGA
            largest = float((continuous(first, OMEGA) * np.abs(s / (s + factor * speed))).max())
            assert (largest <= 1.002) is kept  # ln 20 is 2.996, the weight takes 3

    def test_natural_frequency_asks_for_speed_where_settling_does_not(self) -> None:
        slow, fast = (
            weights_for(replace(STUDY, settling_time_s=3.0, natural_frequency_rad_s=w))[0] for w in (8.0, 16.0)
        )
        assert fast.b == pytest.approx(2.0 * slow.b)

    @given(st.floats(0.05, 0.7), st.floats(0.0, 60.0))
    @settings(deadline=None, max_examples=40)
    def test_w3_allows_the_peak_of_the_damping_or_the_overshoot_and_no_more(self, zeta: float, over: float) -> None:
        required = replace(PRACTICAL, damping=zeta, overshoot_pct=over)
        third = weights_for(required)[2]
        w = required.natural_frequency_rad_s

        def second_order(damping: float) -> np.ndarray:
            s = 1j * OMEGA / w
            return np.abs(1.0 / (s**2 + 2.0 * damping * s + 1.0))

        peak = float(second_order(zeta).max())
        assert 1.0 / continuous(third, np.array([1e-9])) == pytest.approx(max(peak, 1.0 + over / 100.0), rel=1e-4)
        # a loop that rings more than both allow is told, wherever it rings
        lower = 0.5 / (1.02 * max(peak, 1.0 + over / 100.0))
        assert (continuous(third, OMEGA) * second_order(lower)).max() > 1.0

    @pytest.mark.parametrize("dt_s", [1e-3, 4e-3])
    def test_sampled_they_are_tustins(self, dt_s: float) -> None:
        omega = np.linspace(0.0, 0.999 * math.pi / dt_s, 500)
        for weight in (*weights_for(STUDY), *weights_for(PRACTICAL)):
            assert weight.at(omega, dt_s) == pytest.approx(weight_at(weight, omega, dt_s), rel=1e-9)

    def test_are_written_as_people_write_them(self) -> None:
        assert str(weights_for(STUDY)[0]) == "W1 = (0.76923 s + 6) / (1 s + 0.18)"


GAINS = [RollGains(8.0, 1.0, 0.05, 0.2, 0.001), RollGains(12.0, 1.0, 0.03, 0.6, 0.0005), RollGains(4, 1, 0.02, 0.01, 0)]


@pytest.mark.parametrize("profile", PROFILES, ids=lambda p: p.name)
@pytest.mark.parametrize("name", ["ant-x", "adam-0"])
class TestChannels:
    def test_norms_are_those_of_the_loop_written_down_again(self, profile: Profile, name: str) -> None:
        rows = models(name, 3)
        lag = profile.motor_lag(0.025)
        channels = Channels(rows, profile, lag)
        weights = weights_for(requirements_for(profile.name))
        found = channels.norms(GAINS, weights)
        shapes = [np.abs(weight_at(weight, channels.omega, profile.dt_s)) for weight in weights]
        for k, gains in enumerate(GAINS):
            each = np.array([np.abs(RollOracle(row, gains, profile, lag).channels(channels.omega)) for row in rows])
            largest = [(each[:, i] * shapes[i]).max() for i in range(3)]
            assert [found.s[k], found.q[k], found.f[k]] == pytest.approx(largest, rel=1e-6)
            assert found.worst[k] == max(found.s[k], found.q[k], found.f[k])

    def test_delay_margin_is_near_that_of_a_dense_grid(self, profile: Profile, name: str) -> None:
        rows = models(name, 2)
        lag = profile.motor_lag(0.025)
        found = Channels(rows, profile, lag).norms(GAINS, weights_for(STUDY)).delay_margin_s
        omega = np.geomspace(0.02, 0.999 * math.pi / profile.dt_s, 6000)
        for k, gains in enumerate(GAINS):
            least = math.inf
            for row in rows:
                loop = RollOracle(row, gains, profile, lag).loop(omega)
                size = np.abs(loop)
                for n in np.flatnonzero((size[:-1] > 1.0) != (size[1:] > 1.0)):
                    least = min(least, (np.angle(loop[n]) + math.pi) % (2.0 * math.pi) / omega[n])
            assert found[k] == pytest.approx(least, rel=0.02)

    def test_spectral_radius_is_that_of_the_loop_written_down_again(self, profile: Profile, name: str) -> None:
        rows = models(name, 3)
        lag = profile.motor_lag(0.025)
        sets = [*GAINS, RollGains(20.0, 1.0, 2.0, 100.0, 0.01)]
        for gains, radius in zip(sets, Channels(rows, profile, lag).stable(sets), strict=True):
            own = max(float(np.abs(np.linalg.eigvals(RollOracle(row, gains, profile, lag).A)).max()) for row in rows)
            assert radius == pytest.approx(own, rel=1e-8)


class TestStepTrial:
    @pytest.mark.parametrize("profile", PROFILES, ids=lambda p: p.name)
    def test_settling_and_overshoot_are_those_of_the_difference_equations(self, profile: Profile) -> None:
        """A step so small that no limit acts."""
        model = resolve_vehicle("ant-x")
        rows = models("ant-x", 2)
        required = replace(PRACTICAL, amplitude_deg=1.0)
        # one without, one with overshoot, both within 5 % at the end
        sets = [RollGains(8.0, 1.0, 0.06, 0.3, 0.001), RollGains(11.0, 1.0, 0.08, 0.9, 0.001)]
        trial = StepTrial(model, profile, required).fly(sets, rows)
        lag = profile.motor_lag(model.assumptions.motor_lag_s)
        seen = []
        for k, gains in enumerate(sets):
            for m, row in enumerate(rows):
                flown = RollOracle(row, gains, profile, lag).step(1.0, 3.0)
                outside = np.flatnonzero(np.abs(flown - 1.0) > 0.05)
                assert outside[-1] < len(flown) - 10
                assert trial.settling_s[k, m] == pytest.approx(outside[-1] * profile.dt_s, abs=2.1 * profile.dt_s)
                over = max(0.0, 100.0 * (flown.max() - 1.0))
                assert trial.overshoot_pct[k, m] == pytest.approx(over, abs=0.02)
                seen.append(over)
        assert max(seen) > 1.0

    def test_what_never_settles_or_diverges_is_endless(self) -> None:
        model = resolve_vehicle("ant-x")
        sets = [RollGains(1.0, 1.0, 0.001, 0.0, 0.0), RollGains(20.0, 1.0, 2.0, 100.0, 0.01)]
        trial = StepTrial(model, get_profile("sitl"), PRACTICAL).fly(sets, models("ant-x", 1))
        assert np.isinf(trial.settling_s).all()
        assert np.isinf(trial.overshoot_pct[1]).all()
