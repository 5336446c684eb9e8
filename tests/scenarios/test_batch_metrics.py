"""Metrics in lanes where they have an exact answer: at the seams of ticks, stretches and windows, and over several."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from scenarios.batch_metrics import (
    EFFORT,
    MEASURED,
    OSCILLATION,
    SENSES,
    TRACK_ROWS,
    is_limit_cycle,
    measure_block,
    measure_track,
    merge_rows,
    window_table,
    worse,
)
from scenarios.batch_tracking import TRACK
from scenarios.limits import LIMIT_CYCLE_RAD_S, Metric, measured
from scenarios.manoeuvres import Window
from scenarios.metrics import effort_metrics, oscillation, step_metrics, track_metrics
from scenarios.score import WORST
from sitl.batch import LANES

NAN, INF = math.nan, math.inf
DT_S = 0.02
A = math.radians(10.0)
SENSE = dict(zip(MEASURED, SENSES.tolist(), strict=True))


def measured_block(
    windows: Sequence[Window], phi: np.ndarray, p: np.ndarray | None = None, delta: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Metrics of as many lanes as `phi` has columns; -inf where none of the windows has the metric."""
    count = phi.shape[1]
    flown = np.zeros((3, len(phi), LANES))
    for row, signal in enumerate((phi, p, delta)):
        if signal is not None:
            flown[row, :, :count] = signal
    values = np.full((len(MEASURED), count), -INF)
    lost = np.zeros(count, dtype=bool)
    measure_block(flown, window_table(windows, DT_S), DT_S, values, np.arange(count), SENSES, lost, lost.copy())
    return dict(zip(MEASURED, values, strict=True))


def one_step(phi: np.ndarray, before: float = 0.0, after: float = A) -> dict[str, np.ndarray]:
    return measured_block([Window("step", 0.0, len(phi) * DT_S, before, after)], phi)


def number(metric: Metric) -> float:
    return NAN if metric.value is None else metric.value


class TestWorse:
    """Of two windows' values the one that a scenario's score takes for the whole flight."""

    @pytest.mark.parametrize("name", ["overshoot_pct", "vaf_pct", "vaf_lag_removed_pct", "droop_deg", "peak_delta_lat"])
    @pytest.mark.parametrize("pair", [(1.0, 2.0), (2.0, 1.0), (-1.0, 2.0), (1.0, -2.0), (-2.0, 1.0), (2.0, -2.0)])
    def test_of_two_numbers(self, name: str, pair: tuple[float, float]) -> None:
        key = WORST.get(name, number)
        wanted = max((measured(name, value) for value in pair), key=key)
        assert worse(SENSE[name], *pair) == wanted.value

    @pytest.mark.parametrize("name", MEASURED)
    def test_the_first_is_taken_as_it_is(self, name: str) -> None:
        assert [worse(SENSE[name], -INF, value) for value in (-3.0, 0.0, 4.0)] == [-3.0, 0.0, 4.0]

    @pytest.mark.parametrize("name", [name for name in MEASURED if name not in OSCILLATION])
    def test_what_cannot_be_told_in_one_window_cannot_of_the_flight(self, name: str) -> None:
        assert all(math.isnan(worse(SENSE[name], *pair)) for pair in ((NAN, 1.0), (1.0, NAN), (-INF, NAN), (NAN, NAN)))

    def test_a_window_too_short_for_the_oscillation_is_passed_over(self) -> None:
        sense = SENSE["oscillation_rad_s"]
        assert worse(sense, 0.3, NAN) == 0.3
        assert worse(sense, -INF, NAN) == -INF
        assert [worse(sense, 0.3, 0.2), worse(sense, 0.3, 0.4)] == [0.3, 0.4]

    def test_rows_are_merged_where_they_belong(self) -> None:
        values = np.full((len(MEASURED), 4), 5.0)
        values[TRACK_ROWS] = 7.0
        found = np.array([[1.0, 9.0], [1.0, 9.0], [1.0, 9.0], [NAN, 9.0]])
        wanted = values.copy()
        merge_rows(found, TRACK_ROWS.start, values, np.array([2, 1]), SENSES)
        for row, name in zip(TRACK_ROWS, TRACK, strict=True):
            lowest = name.startswith("vaf")
            wanted[row, 2], wanted[row, 1] = (1.0, 7.0) if lowest else (7.0, 9.0)
        wanted[TRACK_ROWS.stop - 1, 2] = NAN
        assert values == pytest.approx(wanted, nan_ok=True)


class TestFlight:
    WINDOWS = (
        Window("step", 0.1, 2.6, 0.0, A),
        Window("hold", 2.6, 4.6, A, -A),
        Window("track", 4.6, 5.5, -A, A),
        Window("step", 5.5, 6.7, A, -0.5 * A),
        Window("hold", 6.7, 8.6, -0.5 * A, 0.0),
    )

    def signals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Angles that follow the set-points in ten different ways, and rates and torques that shake differently."""
        ticks = round(8.6 / DT_S)
        t = np.arange(ticks) * DT_S
        targets = np.zeros(ticks)
        for window in self.WINDOWS:
            targets[round(window.start_s / DT_S) :] = window.phi_to_rad
        zeta, wn = np.array([0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0, 1.5, 2.0, 4.0]), np.linspace(4.0, 13.0, 10)
        angle, rate, phi = np.zeros(10), np.zeros(10), np.empty((ticks, 10))
        for k in range(ticks):
            phi[k] = angle
            rate += DT_S * (wn**2 * (targets[k] * (1.0 + 0.02 * zeta) - angle) - 2.0 * zeta * wn * rate)
            angle += DT_S * rate
        rng = np.random.default_rng(7)
        shaken = rng.normal(0.0, 1.0, (2, ticks, 10)) * rng.uniform(0.1, 1.0, (2, 1, 10))
        growing = (t / t[-1])[:, None] ** np.array([0.0, 1.0, 0.3, 2.0, 0.5, 1.0, 0.0, 0.2, 3.0, 0.0])
        return phi, shaken[0] * growing, shaken[1] * growing[::-1] - 0.3

    def reference(self, phi: np.ndarray, p: np.ndarray, delta: np.ndarray) -> dict[str, float]:
        """What `scenarios.metrics` and the score's rule make of one lane."""
        t, level = np.arange(len(phi)) * DT_S, np.zeros(len(phi))
        found: dict[str, list[Metric]] = {}
        for one in self.WINDOWS:
            span = {"start_s": one.start_s, "end_s": one.end_s}
            metrics = list(effort_metrics(t, delta, **span))
            if one.kind == "step":
                metrics += step_metrics(t, phi, phi_from_rad=one.phi_from_rad, phi_to_rad=one.phi_to_rad, **span)
            if one.kind != "track":
                shake = oscillation(t, p, level, level, **span)
                metrics += [] if shake.reason else [measured("oscillation_rad_s", shake.worst_rad_s)]
            for metric in metrics:
                found.setdefault(metric.name, []).append(metric)
        return {
            name: NAN if any(one.value is None for one in all_) else number(max(all_, key=WORST.get(name, number)))
            for name, all_ in found.items()
        }

    def test_its_value_is_that_of_the_worst_window(self) -> None:
        phi, p, delta = self.signals()
        got = measured_block(self.WINDOWS, phi, p, delta)
        for j in range(phi.shape[1]):
            for name, value in self.reference(phi[:, j], p[:, j], delta[:, j]).items():
                assert got[name][j] == pytest.approx(value, rel=1e-9, abs=1e-9, nan_ok=True), (name, j)
        assert np.isfinite(got["settling_time_5pct_s"]).any()
        assert np.isnan(got["settling_time_5pct_s"]).any()
        assert all((got[name] == -INF).all() for name in TRACK)

    def test_a_window_changes_only_what_it_measures(self) -> None:
        phi, p, delta = self.signals()
        of = {
            kind: measured_block([w for w in self.WINDOWS if w.kind == kind], phi, p, delta)
            for kind in ("track", "hold")
        }
        assert {name for name, value in of["track"].items() if (value > -INF).all()} == set(EFFORT)
        assert {name for name, value in of["hold"].items() if (value > -INF).all()} == {*EFFORT, *OSCILLATION}

    def test_what_was_lost_once_stays_lost(self) -> None:
        flown, table = np.zeros((3, 50, LANES)), window_table([Window("track", 0.0, 1.0, 0.0, A)], DT_S)
        ever = np.array([False, True, False, True])
        lost = np.array([True, False])
        measure_block(flown, table, DT_S, np.zeros((len(MEASURED), 4)), np.array([2, 3]), SENSES, lost, ever)
        assert ever.tolist() == [False, True, True, True]

    @pytest.mark.parametrize(("hold_s", "last"), [(0.99, (0, 0)), (1.0, (100, 0)), (1.98, (100, 0)), (2.0, (100, 100))])
    @pytest.mark.parametrize("start_s", [0.0, 0.3, 4.1, 33.3])
    def test_a_second_is_enough_for_the_droop_and_two_for_the_oscillation(
        self, hold_s: float, last: tuple[int, int], start_s: float
    ) -> None:
        (row,) = window_table([Window("hold", start_s, start_s + hold_s, 0.1, 0.2)], 0.01).tolist()
        first = round(100 * start_s)
        assert row == [2.0, first, first + round(100 * hold_s), 0.1, 0.2, *last]


class TestStepAtTheSeams:
    @pytest.mark.parametrize("ticks", [62, 63, 64, 65, 66, 97])
    @pytest.mark.parametrize(
        ("before", "after"), [(0.0, A), (A, 0.0), (-3 * A, -2 * A), (2 * A, 3 * A), (3 * A, 2 * A)]
    )
    def test_a_jump_at_any_tick(self, ticks: int, before: float, after: float) -> None:
        forth = np.array([0, 1, 2, 30, 31, 32, 33, ticks - 2, ticks - 1, ticks])
        for jumps in (forth, forth[::-1]):  # nothing is left of what a lane measured before
            done = (np.arange(ticks)[:, None] >= jumps).astype(float)
            got = one_step(before + done * (after - before), before, after)
            there = np.where(jumps < ticks, 0.0, NAN)
            moved = np.where(jumps == 0, 0.0, 1.0)
            assert got["overshoot_pct"] == pytest.approx(0.0, abs=1e-9)
            assert got["rise_time_s"] == pytest.approx(0.8 * DT_S * moved + there, nan_ok=True)
            for name, band in (("settling_time_5pct_s", 0.05), ("settling_time_2pct_s", 0.02)):
                assert got[name] == pytest.approx((jumps - band) * DT_S * moved + there, nan_ok=True)

    @pytest.mark.parametrize("ticks", [64, 65, 97])
    @pytest.mark.parametrize(("before", "after"), [(0.0, A), (3 * A, 2 * A)])
    @pytest.mark.parametrize("height", [0.04, 0.3, -0.04, -0.3])
    def test_a_single_tick_off_the_set_point(self, ticks: int, before: float, after: float, height: float) -> None:
        at = np.array([0, 1, 31, 32, 63, ticks - 2, ticks - 1])
        off = np.where(np.arange(ticks)[:, None] == at, height, 0.0)
        got = one_step(after + off * (after - before), before, after)
        assert got["overshoot_pct"] == pytest.approx(100.0 * max(0.0, height))
        for name, band in (("settling_time_5pct_s", 0.05), ("settling_time_2pct_s", 0.02)):
            back = (at + 1.0 - band / abs(height)) * DT_S if abs(height) > band else 0.0 * at
            wanted = np.where((at == ticks - 1) & (abs(height) > band), NAN, back)
            assert got[name] == pytest.approx(wanted, nan_ok=True), name

    def test_a_rise_over_several_stretches(self) -> None:
        ends = np.array([20.0, 40.0, 64.0, 90.0, 120.0])
        got = one_step(A * np.minimum(1.0, np.arange(150)[:, None] / ends))
        assert got["rise_time_s"] == pytest.approx(0.8 * ends * DT_S)
        assert got["settling_time_5pct_s"] == pytest.approx(0.95 * ends * DT_S)

    def test_a_level_is_reached_and_a_band_kept_at_its_edge(self) -> None:
        # from -1 to 0 the edges are numbers without rounding
        at = np.array([3, 31, 32, 63])
        tick = np.arange(70)[:, None]
        got = one_step(np.where(tick < at, -1.0, -0.1), -1.0, 0.0)
        assert got["rise_time_s"] == pytest.approx((1.0 - 0.1 / 0.9) * DT_S)
        for name, band in (("settling_time_5pct_s", 0.05), ("settling_time_2pct_s", 0.02)):
            for side in (band, -band):
                assert one_step(np.full((70, 1), side), -1.0, 0.0)[name] == 0.0
                got = one_step(np.where(tick <= at, 1.2 * side, side), -1.0, 0.0)
                assert got[name] == pytest.approx((at + 1.0) * DT_S)

    @pytest.mark.parametrize("ticks", [49, 50, 51, 80])
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_droop_is_the_mean_of_the_last_second(self, ticks: int, sign: float) -> None:
        # 2 deg short at the beginning of the last second, 1 deg over at its end, and nothing of what was before
        tick = np.arange(ticks)[:, None]
        short_deg = np.where(tick < ticks - 50, 90.0, np.interp(tick, [ticks - 50, ticks - 1], [-2.0, 1.0]))
        droop = one_step(sign * (A + np.radians(short_deg)), 0.0, sign * A)["droop_deg"]
        assert droop == pytest.approx([-0.5 if ticks >= 50 else NAN], nan_ok=True)


class TestSums:
    def test_effort_of_a_ramp_and_of_a_constant(self) -> None:
        # by the trapezoid rule the mean square of n steps from 0 to 1 is 1/3 + 1 / (6 n^2)
        ramp = np.arange(51) / 50.0
        delta = np.column_stack([ramp, -ramp[::-1], np.full(51, -0.25), 0.0 * ramp])
        for kind in ("step", "track"):
            got = measured_block([Window(kind, 0.0, 51 * DT_S, 0.0, A)], 0.0 * delta, None, delta)
            assert got["peak_delta_lat"] == pytest.approx([1.0, 1.0, 0.25, 0.0])
            slope = math.sqrt(1.0 / 3.0 + 1.0 / (6.0 * 50.0**2))
            assert got["rms_delta_lat"] == pytest.approx([slope, slope, 0.25, 0.0])

    def test_oscillation_of_a_ramp_and_of_one_tick(self) -> None:
        # the last second has 49 steps
        ramp, n = np.concatenate([np.full(50, 9.0), np.arange(50) / 49.0]), 49
        tick, last = np.zeros(100), np.zeros(100)
        tick[70], last[99] = 1.0, 1.0
        p = np.column_stack([ramp, 3.0 - ramp, tick, last])
        got = measured_block([Window("hold", 0.0, 2.0, 0.0, A)], 0.0 * p, p)["oscillation_rad_s"]
        slope = math.sqrt(1.0 / 12.0 + 1.0 / (6.0 * n**2))
        share = np.array([1.0, 0.5]) / n
        assert got == pytest.approx([slope, slope, *np.sqrt(share - share**2)])

    def test_a_limit_cycle_is_beyond_the_limit(self) -> None:
        rates = np.array([NAN, 0.0, LIMIT_CYCLE_RAD_S, np.nextafter(LIMIT_CYCLE_RAD_S, 1.0)])
        assert is_limit_cycle(rates).tolist() == [False, False, False, True]


class TestTrack:
    @pytest.mark.parametrize("seconds", [2.0, 12.0])
    @pytest.mark.parametrize("lag_s", [0.04, 0.48, 0.6, 0.9, 1.1])
    def test_a_lag_is_looked_for_as_far_as_elsewhere(self, seconds: float, lag_s: float) -> None:
        t = np.arange(round(seconds / DT_S)) * DT_S
        phi_sp, phi = A * np.sin(math.pi * t), A * np.sin(math.pi * (t - lag_s))
        got = measure_track(phi[:, None], phi_sp, DT_S)[:, 0]
        wanted = [number(one) for one in track_metrics(t, phi, phi_sp, start_s=0.0, end_s=seconds)]
        assert got == pytest.approx(wanted, rel=1e-6, abs=1e-6, nan_ok=True)

    @pytest.mark.parametrize(("std_deg", "moves"), [(0.49, False), (0.51, True)])
    def test_a_set_point_that_moves_by_half_a_degree_excites(self, std_deg: float, moves: bool) -> None:
        phi_sp = math.radians(std_deg) * math.sqrt(2.0) * np.sin(2.0 * math.pi * np.arange(500) * DT_S)
        got = dict(zip(TRACK, measure_track(phi_sp[:, None], phi_sp, DT_S)[:, 0], strict=True))
        assert got["rms_error_deg"] == 0.0
        assert math.isfinite(got["vaf_pct"]) is moves
