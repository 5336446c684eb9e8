"""The Monte Carlo: the metrics of flights, the same whichever way it is run, and what a real flight gives."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy.linalg

from scenarios.batch_metrics import MEASURED, SENSES, STEP, measure_block, measure_track, window_table
from scenarios.batch_tracking import TRACK
from scenarios.manoeuvres import Window, make_manoeuvre
from scenarios.metrics import effort_metrics, oscillation, step_metrics, track_metrics
from scenarios.monte_carlo import MonteCarlo, draw_samples, monte_carlo
from scenarios.runner import RunOptions, run_scenario
from scenarios.scenario import load_scenario
from sitl.airframe import Derivatives
from sitl.batch import LANES
from sitl.errors import UsageError
from sitl.profile import get_profile
from sitl.sampled_loop import RollGains
from sitl.vehicle_spec import resolve_vehicle

MODEL = resolve_vehicle("ant-x")
STEP_AND_TRACK = (make_manoeuvre("step", amplitude_deg=10.0, hold_s=3.0, return_s=3.0), make_manoeuvre("track"))
GAINS = {
    "flown": RollGains(6.5, 1.0, 0.05, 0.05, 0.001),
    "cycles": RollGains(12.04, 1.0, 0.6, 35.8, 3.57e-6),
    "lazy": RollGains(0.3, 1.0, 0.02, 0.0, 0.0),
}


def found(compiled: bool | None = None, threads: int | None = None, **changes: object) -> MonteCarlo:
    wanted: dict = {"samples": 40, "seed": 3, "trace_every": 1} | changes
    return monte_carlo(MODEL, GAINS, get_profile("sitl"), STEP_AND_TRACK, threads=threads, compiled=compiled, **wanted)


@pytest.fixture(scope="module")
def flown() -> MonteCarlo:
    return found(compiled=True)


class TestLaneMetrics:
    """Every lane's number is that of `scenarios.metrics` on the same trace."""

    RATE_HZ = 250

    def lanes(self) -> np.ndarray:
        """Roll angles, rad: quiet, overshooting, slow, shaking, growing, standing still, leading, noisy; (T, 8)."""
        t = np.arange(8 * self.RATE_HZ) / self.RATE_HZ
        rng = np.random.default_rng(4)
        first = 1.0 - np.exp(-9.0 * t)
        swing = 1.0 - np.exp(-3.0 * t) * np.cos(14.0 * t)
        return math.radians(10.0) * np.column_stack(
            [
                first, swing, 1.0 - np.exp(-0.4 * t), first + 0.2 * np.sin(50.0 * t), first * (1.0 + 0.3 * t),
                np.zeros_like(t), 1.0 - 0.2 * np.exp(-t), first + rng.normal(0.0, 0.01, len(t)),
            ]
        )  # fmt: skip

    def measured(self, kind: str, phi: np.ndarray, before: float = 0.0, after: float = 0.0) -> dict[str, np.ndarray]:
        """Of one window, the angles being the rates and the torques, too; the other lanes are nobody's."""
        count = phi.shape[1]
        flown = np.repeat(np.pad(phi, ((0, 0), (0, LANES - count)), "edge")[None], 3, axis=0)
        windows = window_table([Window(kind, 0.0, len(phi) / self.RATE_HZ, before, after)], 1.0 / self.RATE_HZ)
        values = np.full((len(MEASURED), count + 2), -math.inf)
        places = np.arange(count)[::-1] + 1
        lost, ever = np.arange(count) == 1, np.zeros(count + 2, dtype=bool)
        measure_block(flown, windows, 1.0 / self.RATE_HZ, values, places, SENSES, lost, ever)
        assert np.flatnonzero(ever).tolist() == places[lost].tolist()
        assert (values[:, [0, -1]] == -math.inf).all()
        return {name: row[places] for name, row in zip(MEASURED, values, strict=True) if row[1] != -math.inf}

    def test_step(self) -> None:
        phi, dt = self.lanes()[: 3 * self.RATE_HZ], 1.0 / self.RATE_HZ
        target = math.radians(10.0)
        got = self.measured("step", phi, 0.0, target)
        t = np.arange(len(phi)) * dt
        for j in range(phi.shape[1]):
            wanted = step_metrics(t, phi[:, j], start_s=0.0, end_s=3.0, phi_from_rad=0.0, phi_to_rad=target)
            for one in wanted:
                value = math.nan if one.value is None else one.value
                assert got[one.name][j] == pytest.approx(value, rel=1e-9, abs=1e-9, nan_ok=True), (one.name, j)

    def test_step_down_from_an_angle(self) -> None:
        phi = self.lanes()[: 3 * self.RATE_HZ]
        got = self.measured("step", math.radians(10.0) - phi, math.radians(10.0), 0.0)
        again = self.measured("step", phi, 0.0, math.radians(10.0))
        for name in STEP:
            assert got[name] == pytest.approx(again[name], nan_ok=True, abs=1e-9), name

    @pytest.mark.parametrize("held", [1, 5, 2000], ids=["every tick", "50 Hz", "hardly ever"])
    def test_track(self, held: int) -> None:
        dt = 1.0 / self.RATE_HZ
        t = np.arange(8 * self.RATE_HZ) * dt
        sent = np.radians(8.0) * (np.sin(2.0 * t) + 0.5 * np.sin(5.1 * t + 1.0))
        phi_sp = np.repeat(sent[::held], held)[: len(t)]
        rng = np.random.default_rng(1)
        phi = np.column_stack(
            [np.interp(t - lag, t, sent) * gain for lag, gain in ((0.0, 1.0), (0.103, 0.9), (0.31, 0.7), (0.9, 1.0))]
            + [rng.normal(0.0, 0.1, len(t)), -sent, np.zeros_like(t), np.interp(t - 1.4, t, sent)]
        )
        got = dict(zip(TRACK, measure_track(phi, phi_sp, dt), strict=True))
        for j in range(phi.shape[1]):
            for one in track_metrics(t, phi[:, j], phi_sp, start_s=0.0, end_s=8.0):
                value = math.nan if one.value is None else one.value
                assert got[one.name][j] == pytest.approx(value, rel=1e-6, abs=1e-6, nan_ok=True), (one.name, j)

    def test_effort_and_oscillation(self) -> None:
        delta, dt = 3.0 * self.lanes(), 1.0 / self.RATE_HZ
        t, level = np.arange(len(delta)) * dt, np.zeros(len(delta))
        end = float(len(delta) * dt)
        for kind in ("step", "hold", "track"):
            got = self.measured(kind, delta, 0.0, 1.0)
            assert ("oscillation_rad_s" in got) == (kind != "track")
            for j in range(delta.shape[1]):
                for one in effort_metrics(t, delta[:, j], start_s=0.0, end_s=end):
                    assert got[one.name][j] == pytest.approx(one.value, rel=1e-9), (kind, one.name)
                wanted = oscillation(t, delta[:, j], level, level, start_s=0.0, end_s=end)
                if kind != "track":
                    assert got["oscillation_rad_s"][j] == pytest.approx(wanted.worst_rad_s, rel=1e-6, abs=1e-9)

    def test_a_rate_that_rests_far_from_nothing_loses_no_digits(self) -> None:
        t = np.arange(3 * self.RATE_HZ) / self.RATE_HZ
        rate = 500.0 + np.column_stack([1e-6 * np.sin(40.0 * t), np.zeros_like(t)])
        got = self.measured("hold", rate)["oscillation_rad_s"]
        assert got == pytest.approx([1e-6 / math.sqrt(2.0), 0.0], rel=0.05, abs=1e-12)

    def test_windows_too_short_to_tell(self) -> None:
        got = self.measured("step", self.lanes()[: self.RATE_HZ // 2], 0.0, math.radians(10.0))
        assert np.isnan(got["droop_deg"]).all()
        # passed over: another window may be long enough
        assert "oscillation_rad_s" not in self.measured("hold", self.lanes()[: self.RATE_HZ])


class TestWaysOfRunning:
    def test_threads_do_not_matter(self, flown: MonteCarlo) -> None:
        for threads in (1, 2, 5):
            other = found(compiled=True, threads=threads)
            for name, values in flown.metrics.items():
                assert np.array_equal(values, other.metrics[name], equal_nan=True), name
            assert flown.traces is not None
            assert other.traces is not None
            assert flown.traces.phi_rad.tobytes() == other.traces.phi_rad.tobytes()

    def test_numpy_gives_the_same_numbers(self, flown: MonteCarlo) -> None:
        arrays = found(compiled=False, samples=5)
        for name, values in arrays.metrics.items():
            # in a limit cycle what rounding leaves grows with every swing
            steady = values[[0, 2]], flown.metrics[name][[0, 2], :6]
            assert steady[0] == pytest.approx(steady[1], rel=1e-6, abs=1e-9, nan_ok=True), name

    def test_same_seed_same_samples(self, flown: MonteCarlo) -> None:
        assert np.array_equal(found(trace_every=0).derivatives, flown.derivatives)
        other = found(seed=4, trace_every=0)
        assert not np.array_equal(other.derivatives[1:], flown.derivatives[1:])
        assert np.array_equal(other.derivatives[0], MODEL.derivatives.as_array())

    def test_metrics_without_traces_are_those_of_the_traces(self, flown: MonteCarlo) -> None:
        """Recomputed from the kept traces by the functions that score flights."""
        traces = flown.traces
        assert traces is not None
        hold = slice(0, 750)
        for g, j in ((0, 0), (0, 17), (2, 3)):
            phi, t = traces.phi_rad[g, j, hold], np.arange(750) / 250.0
            steps = step_metrics(t, phi, start_s=0.0, end_s=3.0, phi_from_rad=0.0, phi_to_rad=math.radians(10.0))
            for one in steps:
                value = math.nan if one.value is None else one.value
                assert flown.metrics[one.name][g, j] == pytest.approx(value, abs=1e-9, nan_ok=True), one.name
        assert flown.metrics["peak_delta_lat"] == pytest.approx(np.abs(traces.delta_lat).max(axis=2), rel=1e-12)

    def test_thinned_traces_are_every_nth_tick(self, flown: MonteCarlo) -> None:
        thin = found(trace_every=7).traces
        assert thin is not None
        assert flown.traces is not None
        assert np.array_equal(thin.phi_rad[:, :, : -(-1500 // 7)], flown.traces.phi_rad[:, :, :1500:7])

    def test_a_limit_cycle_has_no_overshoot(self, flown: MonteCarlo) -> None:
        assert (flown.metrics["oscillation_rad_s"][1] > 1.0).all()
        assert np.isnan(flown.metrics["overshoot_pct"][1]).all()
        assert np.isnan(flown.metrics["rise_time_s"][2]).all()
        assert (flown.metrics["oscillation_rad_s"][[0, 2]] < 0.05).all()


class TestSamples:
    def test_statistics(self) -> None:
        drawn = draw_samples(MODEL, 20_000, 7)[1:]
        centre = MODEL.derivatives.as_array()
        sigma = np.abs(centre) * MODEL.sigma_pct.as_array() / 100.0
        z = (drawn - centre) / sigma
        assert np.abs(z).max() <= 3.0
        assert z.mean(axis=0) == pytest.approx(np.zeros(6), abs=0.03)
        # a normal distribution cut at 3 sigma: variance 1 - 6 pdf(3) / (2 cdf(3) - 1)
        cut = 1.0 - 6.0 * math.exp(-4.5) / math.sqrt(2.0 * math.pi) / math.erf(3.0 / math.sqrt(2.0))
        assert z.var(axis=0) == pytest.approx(np.full(6, cut), abs=0.03)
        assert np.corrcoef(z.T) == pytest.approx(np.eye(6), abs=0.03)
        flat = (draw_samples(MODEL, 20_000, 7, "uniform", 2.0)[1:] - centre) / sigma
        assert np.abs(flat).max() <= 2.0
        assert flat.var(axis=0) == pytest.approx(np.full(6, 16.0 / 12.0), abs=0.03)

    @pytest.mark.parametrize(("samples", "spread"), [(-1, 3.0), (10**9, 3.0), (5, 0.0), (5, -1.0), (5, math.nan)])
    def test_numbers_that_cannot_be_used(self, samples: int, spread: float) -> None:
        with pytest.raises(UsageError):
            draw_samples(MODEL, samples, 1, "gaussian", spread)

    def test_a_million_samples_are_drawn_and_more_are_refused(self) -> None:
        assert draw_samples(MODEL, 1_000_000, 1).shape == (1_000_001, 6)
        with pytest.raises(UsageError, match="give 0 to 1000000"):
            draw_samples(MODEL, 1_000_001, 1)

    def test_margins_agree_with_what_is_flown(self) -> None:
        """On samples far apart: where the linear loop is stable the flight is quiet, where not it shakes or is lost."""
        rng = np.random.default_rng(2)
        spread = MODEL.derivatives.as_array() * np.exp(rng.uniform(-0.7, 0.7, (60, 6)))
        result = monte_carlo(
            MODEL, {"one": RollGains(8.0, 1.0, 0.28, 0.3, 0.003)}, get_profile("sitl"), STEP_AND_TRACK[:1],
            derivatives=spread,
        )  # fmt: skip
        assert result.margins is not None
        stable = result.margins.closed_loop_stable[0]
        quiet = (np.nan_to_num(result.metrics["oscillation_rad_s"][0], nan=9.0) < 0.3) & ~result.diverged[0]
        clear = np.abs(result.margins.delay_margin_s[0]) > 1e-3
        assert 5 < stable.sum() < 55
        assert np.array_equal(stable[clear], quiet[clear])

    def test_derivatives_nobody_would_expect(self) -> None:
        """An airframe that rolls the wrong way, one that does nothing, one a thousand times as strong."""
        odd = np.tile(MODEL.derivatives.as_array(), (4, 1))
        odd[1, 5] *= -1.0
        odd[2] = 0.0
        odd[3] *= 1000.0
        result = monte_carlo(MODEL, {"flown": GAINS["flown"]}, get_profile("sitl"), STEP_AND_TRACK, derivatives=odd)
        assert result.margins is not None
        assert result.margins.closed_loop_stable[0].tolist() == [True, False, False, False]
        assert not np.isfinite(result.metrics["settling_time_5pct_s"][0, 1:]).any()
        assert result.diverged[0, 1]
        odd[1, 2] = math.inf
        with pytest.raises(UsageError, match="sample 1 of the derivatives is not finite"):
            monte_carlo(MODEL, GAINS, get_profile("sitl"), STEP_AND_TRACK, derivatives=odd)

    def test_gains_of_zero(self) -> None:
        nothing = RollGains(0.0, 0.0, 0.0, 0.0, 0.0)
        result = monte_carlo(MODEL, {"nothing": nothing}, get_profile("sitl"), STEP_AND_TRACK, samples=3)
        assert (result.metrics["peak_delta_lat"] == 0.0).all()
        assert np.isnan(result.metrics["rise_time_s"]).all()
        assert result.margins is not None
        assert not result.margins.closed_loop_stable.any()

    def test_nothing_to_fly(self) -> None:
        for gains, flights in (({}, STEP_AND_TRACK), (GAINS, ())):
            with pytest.raises(UsageError, match="at least one gain set and one manoeuvre"):
                monte_carlo(MODEL, gains, get_profile("sitl"), flights)

    def test_traces_that_do_not_fit(self) -> None:
        with pytest.raises(UsageError, match=r"would fill \d+ GB"):
            found(samples=100_000)


class TestAgainstOthers:
    def test_the_linear_step_is_that_of_a_matrix_power(self) -> None:
        """Profile study is linear: the step of its sampled closed loop, tick matrix by tick matrix."""
        profile, g = get_profile("study"), GAINS["flown"]
        dt = profile.dt_s
        result = monte_carlo(MODEL, {"flown": g}, profile, STEP_AND_TRACK[:1], samples=2, trace_every=1)
        assert result.traces is not None
        for j in range(3):
            Yv, Yp, Yd, Lv, Lp, Ld = result.derivatives[j]
            whole = np.zeros((4, 4))
            whole[:3] = [[Yv, Yp, 9.81, Yd], [Lv, Lp, 0.0, Ld], [0.0, 1.0, 0.0, 0.0]]
            step = scipy.linalg.expm(whole * dt)[:3]
            x, integral, before, phis = np.zeros(3), 0.0, 0.0, []
            for _ in range(round(3.0 / dt)):
                phis.append(x[2])
                error = g.k_phi * (math.radians(10.0) - x[2]) - x[1]
                u = g.kp * error + integral - g.kd * (x[1] - before) / dt
                integral += g.ki * error * dt
                before = x[1]
                x = step @ np.append(x, u)
            assert result.traces.phi_rad[0, j, : len(phis)] == pytest.approx(np.array(phis), abs=1e-9)

    @pytest.mark.parametrize("profile", ["study", "sitl"])
    def test_the_nominal_lane_is_the_flight_over_mavlink(self, profile: str) -> None:
        scenario = dataclasses.replace(
            load_scenario("demo"), gain_sets=("table_2_2/ANT-X",), profile=profile, overrides={}
        )
        (flight,) = run_scenario(scenario, RunOptions(out=None)).run.flights
        result = monte_carlo(MODEL, {"2.2": GAINS["flown"]}, get_profile(profile), scenario.manoeuvres, samples=1)
        for name, tolerance in (
            ("overshoot_pct", 0.1), ("rise_time_s", 0.006), ("droop_deg", 0.03), ("vaf_pct", 2.0), ("lag_s", 0.008),
            ("peak_delta_lat", 0.01),
        ):  # fmt: skip
            metric = flight.metric(name)
            assert metric is not None
            if name == "peak_delta_lat" and profile == "study":
                continue  # a kick of one tick of 1 ms, and telemetry has every fourth
            assert result.metrics[name][0, 0] == pytest.approx(metric.value, abs=tolerance), name

    def test_a_scaled_vehicle_flies_its_scaled_derivatives(self) -> None:
        model = resolve_vehicle("ant-r:ant-x", ("derivatives", "uncertainty"))
        drawn = draw_samples(model, 400, 2)
        assert drawn[0] == pytest.approx(model.derivatives.as_array())
        sigma = np.abs(drawn[0]) * model.sigma_pct.as_array() / 100.0
        assert drawn[1:].std(axis=0) == pytest.approx(0.986 * sigma, rel=0.15)

    def test_an_airframe_without_sigma_has_nothing_to_vary(self) -> None:
        sure = dataclasses.replace(MODEL, sigma_pct=Derivatives(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        assert (draw_samples(sure, 5, 1) == MODEL.derivatives.as_array()).all()
