"""Rows of a sweep, worked out once more: by what `froude analyse` has, and by a loop that shares nothing with it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios import analysis
from scenarios.analysis import SHOWN_MARGINS, SetAnalysis, analyse, spread, wilson
from scenarios.gain_set import GainSet
from scenarios.limits import STANDING, Limit
from scenarios.metrics import step_metrics
from scenarios.monte_carlo import draw_samples, monte_carlo
from scenarios.roll_set import roll_set
from scenarios.sweep import evaluation
from scenarios.sweep.candidates import Candidates
from scenarios.sweep.evaluation import (
    ERROR,
    FAIL,
    GAIN_FIELDS,
    PASS,
    STATISTICS,
    Columns,
    Evaluator,
    Task,
    limits_of,
    measured_names,
)
from scenarios.sweep.plan import Chunk, Plan, make_plan
from scenarios.sweep.sweep_file import load_sweep
from sitl.batch import Batch
from sitl.control_loop import CONTROL_SETTINGS
from sitl.errors import UsageError
from tests.scenarios.roll_oracle import RollOracle

SAMPLES, SEED = 40, 5

RANDOM = f"""
samples = {SAMPLES}
seed = {SEED}
limits = "practical"
required_pass_pct = 80.0

[design]
kind = "sobol"
points = 24
seed = 2

[parameters]
MC_ROLLRATE_FF = 0.01

[axes]
vehicle = ["ant-x", "ant-r:ant-x"]
dgyro_cutoff_hz = [25.0]
MC_ROLL_P = {{ from = 2.0, to = 12.0 }}
MC_ROLLRATE_K = {{ from = 0.8, to = 1.5 }}
MC_ROLLRATE_P = {{ from = 0.02, to = 0.3, scale = "log" }}
MC_ROLLRATE_I = {{ from = 0.0, to = 1.0 }}
MC_ROLLRATE_D = {{ from = 0.0, to = 0.004 }}
MC_ROLLRATE_MAX = [60.0, 220.0]
IMU_GYRO_CUTOFF = [30.0, 60.0]
MC_AIRMODE = [0, 1]

[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = 3.0
return_s = 3.0

[[manoeuvre]]
kind = "track"
"""

LINEAR = """
samples = 12
seed = 3
required_pass_pct = 50.0
margins = "samples"
[axes]
profile = ["study"]
MC_ROLL_P = [4.0, 6.5]
MC_ROLLRATE_P = [0.03, 0.05, 0.09]
[parameters]
MC_ROLLRATE_I = 0.05
MC_ROLLRATE_D = 0.001
[[limit]]
metric = "overshoot_pct"
max = 2.1
[[limit]]
metric = "modulus_margin"
min = 0.538
[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = 2.0
return_s = 0.0
"""


def planned(tmp_path: Path, text: str) -> Plan:
    file = tmp_path / "sweep.toml"
    file.write_text(text)
    return make_plan(load_sweep(file))


def task_of(plan: Plan, case: int) -> Task:
    """All candidates in a case."""
    return Task(Chunk(case, case, 0, plan.candidates), Candidates(plan).values(0, plan.candidates))


def parameters(plan: Plan, values: np.ndarray) -> dict[str, float | int]:
    own = zip(plan.sweep.parameters, values.tolist(), strict=True)
    return {**plan.sweep.fixed, **{axis.name: int(value) if axis.integer else value for axis, value in own}}


def none(value: float) -> float | None:
    return None if math.isnan(value) else value


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Plan, int, Columns, list[SetAnalysis]]]:
    plan = planned(tmp_path_factory.mktemp("random"), RANDOM)
    assert plan.sweep.manoeuvres == analysis.manoeuvres()
    made = []
    for number, case in enumerate(plan.cases):
        task = task_of(plan, number)
        own = [parameters(plan, row) for row in task.values]
        sets = [(GainSet(str(k), one), roll_set(case.model, case.profile, one)) for k, one in enumerate(own)]
        wanted = analyse(case.model, case.profile, sets, samples=SAMPLES, seed=SEED)
        made.append((plan, number, Evaluator(plan).rows(task), list(wanted.sets)))
    return made


class TestAgainstAnalyse:
    """The same file as what `froude analyse` flies: every number of a row is one of its."""

    def test_statistics_to_the_bit(self, found: list[tuple[Plan, int, Columns, list[SetAnalysis]]]) -> None:
        unset = 0
        for plan, _, rows, wanted in found:
            for g, one in enumerate(wanted):
                assert set(measured_names(plan)) == set(one.spreads)
                for name, of in one.spreads.items():
                    got = [none(float(rows[f"{name}_{statistic}"][g])) for statistic in STATISTICS]
                    assert got == [of.nominal, of.worst, of.median, of.best], (g, name)
                    assert rows[f"{name}_unset"][g] == of.unset
                    unset += of.unset
        assert unset > 100

    def test_counts_and_interval(self, found: list[tuple[Plan, int, Columns, list[SetAnalysis]]]) -> None:
        outcomes = set()
        for _, _, rows, wanted in found:
            for g, one in enumerate(wanted):
                for name in ("passes", "unstable", "cycling", "diverged"):
                    assert rows[name][g] == getattr(one, name), (g, name)
                assert rows["samples"][g] == one.of == SAMPLES
                assert rows["nominal_passes"][g] == one.nominal_passes
                assert rows["pass_pct"][g] == 100.0 * one.passes / one.of
                assert (rows["pass_low_pct"][g], rows["pass_high_pct"][g]) == tuple(100.0 * x for x in one.interval)
                enough = one.passes / one.of >= 0.8 and one.nominal_passes
                assert rows["outcome"][g] == (PASS if enough else FAIL)
                assert (rows["reason"][g] == "") == enough
                outcomes.add(rows["outcome"][g])
        assert outcomes == {PASS, FAIL}

    def test_the_reason_is_the_limit_that_fails_most(
        self, found: list[tuple[Plan, int, Columns, list[SetAnalysis]]]
    ) -> None:
        told = set()
        for plan, number, rows, _ in found:
            case, task = plan.cases[number], task_of(plan, number)
            sets = {
                str(k): roll_set(case.model, case.profile, parameters(plan, row)) for k, row in enumerate(task.values)
            }
            flown = monte_carlo(
                case.model, sets, case.profile, plan.sweep.manoeuvres, samples=SAMPLES, seed=SEED, compiled=True
            )
            assert flown.margins is not None
            for g in range(len(sets)):
                counts = {"diverges": int(flown.diverged[g, 1:].sum())}
                for limit in limits_of(plan):
                    value = flown.metrics.get(limit.metric)
                    one = (getattr(flown.margins, limit.metric) if value is None else value)[g, 1:]
                    failing = int(sum(math.isnan(x) or not limit.holds(x) for x in one.tolist()))
                    assert rows[f"failing_{limit.metric}"][g] == failing
                    counts[limit.metric] = failing
                reason = rows["reason"][g]
                if reason:
                    most = max(counts.values())
                    assert f"on {most} of {SAMPLES} samples" in reason
                    told.add(reason.partition(" on ")[0])
        assert len(told) > 3

    def test_a_part_of_a_chunk_gives_the_same_rows(
        self, found: list[tuple[Plan, int, Columns, list[SetAnalysis]]]
    ) -> None:
        plan, number, rows, _ = found[1]
        values = task_of(plan, number).values
        for start, stop in ((0, 1), (3, 10), (23, 24)):
            part = Evaluator(plan).rows(Task(Chunk(0, number, start, stop), values[start:stop]))
            for name, column in part.items():
                assert column.tobytes() == rows[name][start:stop].tobytes() or (
                    column.dtype == object and column.tolist() == rows[name][start:stop].tolist()
                ), name


class TestAgainstTheOracle:
    """A loop written down from its difference equations, its step measured as a flight's is."""

    def test_every_number(self, tmp_path: Path) -> None:
        plan = planned(tmp_path, LINEAR)
        (case,) = plan.cases
        task = task_of(plan, 0)
        rows = Evaluator(plan).rows(task)
        drawn = draw_samples(case.model, 12, 3)
        omega = np.geomspace(0.05, 0.9999 * math.pi * case.profile.rate_hz, 800)
        some = 0
        for g, values in enumerate(task.values):
            k_phi, kp = values.tolist()
            gains = roll_set(case.model, case.profile, parameters(plan, values)).gains
            assert (gains.k_phi, gains.kp) == (k_phi, kp)
            metrics: dict[str, list[float]] = {}
            for derivatives in drawn:
                oracle = RollOracle(derivatives, gains, case.profile, 0.0)
                phi = oracle.step(math.radians(10.0), 2.0)
                t = np.arange(len(phi)) * oracle.dt
                found = step_metrics(t, phi, start_s=0.0, end_s=2.0, phi_from_rad=0.0, phi_to_rad=math.radians(10.0))
                assert np.abs(np.linalg.eigvals(oracle.A)).max() < 1.0
                for one in found:
                    metrics.setdefault(one.name, []).append(math.nan if one.value is None else one.value)
                metrics.setdefault("modulus_margin", []).append(float(np.abs(1.0 + oracle.loop(omega)).min()))
            for name, of in metrics.items():
                wanted = spread(name, np.array(of))
                for statistic in STATISTICS:
                    expected = getattr(wanted, statistic)
                    got = none(float(rows[f"{name}_{statistic}"][g]))
                    assert (got is None) == (expected is None), (g, name, statistic)
                    if expected is not None:
                        assert got == pytest.approx(expected, abs=2e-3 if name == "modulus_margin" else 1e-6), name
                assert rows[f"{name}_unset"][g] == wanted.unset
            good = [
                o <= 2.1 and m >= 0.538
                for o, m in zip(metrics["overshoot_pct"], metrics["modulus_margin"], strict=True)
            ]
            assert rows["passes"][g] == sum(good[1:])
            assert rows["nominal_passes"][g] == good[0]
            assert rows["unstable"][g] == 0
            low, high = wilson(sum(good[1:]), 12)
            assert rows["pass_low_pct"][g] == pytest.approx(100.0 * low)
            assert rows["pass_high_pct"][g] == pytest.approx(100.0 * high)
            some += 0 < sum(good[1:]) < 12
        assert some > 0


class TestMargins:
    TEXT = LINEAR.replace("min = 0.538", 'min = 0.538\n[[limit]]\nmetric = "delay_margin_s"\nmin = 0.07')

    def test_of_the_nominal_model_hold_for_all_samples_or_for_none(self, tmp_path: Path) -> None:
        each = planned(tmp_path, self.TEXT)
        alone = planned(tmp_path, self.TEXT.replace('margins = "samples"', 'margins = "nominal"'))
        task = task_of(each, 0)
        of_each, of_one = Evaluator(each).rows(task), Evaluator(alone).rows(task)
        for name in SHOWN_MARGINS:
            assert of_one[f"{name}_nominal"] == pytest.approx(of_each[f"{name}_nominal"], rel=1e-12)
            for statistic in ("worst", "median", "best"):
                assert of_one[f"{name}_{statistic}"].tobytes() == of_one[f"{name}_nominal"].tobytes()
        holds = (of_one["modulus_margin_nominal"] >= 0.538) & (of_one["delay_margin_s_nominal"] >= 0.07)
        assert 0 < holds.sum() < len(holds)
        assert (of_one["passes"][~holds] == 0).all()
        fails = of_one["modulus_margin_nominal"] < 0.538
        assert of_one["failing_modulus_margin"].tolist() == [12 if one else 0 for one in fails]
        assert set(of_each["failing_modulus_margin"].tolist()) - {0, 12}

    def test_an_unstable_loop_has_no_modulus_margin(self, tmp_path: Path) -> None:
        text = self.TEXT.replace("MC_ROLLRATE_P = [0.03, 0.05, 0.09]", "MC_ROLLRATE_P = [0.05, 5.0]")
        for margins, of in (("samples", 12), ("nominal", 12)):
            plan = planned(tmp_path, text.replace('margins = "samples"', f'margins = "{margins}"'))
            rows = Evaluator(plan).rows(task_of(plan, 0))
            assert rows["unstable"].tolist() == [0, of, 0, of]
            assert np.isnan(rows["modulus_margin_worst"]).tolist() == [False, True, False, True]

    def test_none(self, tmp_path: Path) -> None:
        text = LINEAR.replace('margins = "samples"', 'margins = "none"').replace(
            '[[limit]]\nmetric = "modulus_margin"\nmin = 0.538\n', ""
        )
        plan = planned(tmp_path, text)
        rows = Evaluator(plan).rows(task_of(plan, 0))
        assert not any("margin" in name for name in rows)
        assert (rows["unstable"] == 0).all()


class TestSummary:
    @settings(max_examples=200, deadline=None)
    @given(
        st.sampled_from(["droop_deg", "overshoot_pct", "delay_margin_s", "gain_margin_low_db"]),
        st.lists(
            st.lists(
                st.one_of(st.just(math.nan), st.floats(-9.0, 9.0), st.sampled_from([1.5, -1.5])), min_size=5, max_size=5
            ),
            min_size=1,
            max_size=4,
        ),
        st.booleans(),
    )
    def test_spread_is_that_of_analyse(self, name: str, rows: list[list[float]], alone: bool) -> None:
        values = np.array(rows)[:, :1] if alone else np.array(rows)
        drawn = slice(None) if alone else slice(1, None)
        got = evaluation._spread(name, values, drawn)
        for g, row in enumerate(values):
            wanted = spread(name, row)
            for statistic in STATISTICS:
                assert none(got[f"{name}_{statistic}"][g]) == getattr(wanted, statistic)
            assert got[f"{name}_unset"][g] == wanted.unset

    def test_droop_s_worst_is_the_largest_either_way(self) -> None:
        values = np.array([[0.0, 1.0, -3.0, 2.0, math.nan]])
        got = evaluation._spread("droop_deg", values, slice(1, None))
        assert [got[f"droop_deg_{one}"][0] for one in STATISTICS] == [0.0, -3.0, 1.0, 1.0]
        assert got["droop_deg_unset"][0] == 1

    def test_without_samples_the_nominal_model_is_the_only_one(self, tmp_path: Path) -> None:
        plan = planned(tmp_path, LINEAR.replace("samples = 12", "samples = 0"))
        rows = Evaluator(plan).rows(task_of(plan, 0))
        assert (rows["samples"] == 1).all()
        assert rows["passes"].tolist() == rows["nominal_passes"].astype(int).tolist()
        assert rows["pass_pct"].tolist() == [100.0 * one for one in rows["passes"].tolist()]
        for name in measured_names(plan):
            for statistic in STATISTICS[1:]:
                assert rows[f"{name}_{statistic}"].tobytes() == rows[f"{name}_nominal"].tobytes(), name

    def test_the_nominal_model_must_pass_too(self, tmp_path: Path) -> None:
        plan = planned(tmp_path, LINEAR)
        shape = (1, 13)
        values = {name: np.full(shape, 1.0) for name in measured_names(plan)} | {"overshoot_pct": np.zeros(shape)}
        values["oscillation_rad_s"] = np.zeros(shape)
        lost = np.zeros(shape, dtype=bool)
        assert evaluation._summary(plan, values, lost, None)["outcome"][0] == PASS
        values["overshoot_pct"][0, 0] = 2.2
        rows = evaluation._summary(plan, values, lost, None)
        assert (rows["outcome"][0], rows["passes"][0]) == (FAIL, 12)
        assert rows["reason"][0] == "only the nominal model is out of limits"

    def test_a_limit_of_the_sweep_replaces_the_standing_one(self, tmp_path: Path) -> None:
        text = LINEAR + '[[limit]]\nmetric = "oscillation_rad_s"\nmax = 5.0\n'
        limits = {one.metric: one for one in limits_of(planned(tmp_path, text))}
        assert limits["oscillation_rad_s"] == Limit("oscillation_rad_s", maximum=5.0)
        assert STANDING in limits_of(planned(tmp_path, LINEAR))


def stored(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers as PX4 stores them."""
    return st.floats(low, high, width=32)


VARIED = {
    **dict.fromkeys(GAIN_FIELDS, stored(0.0, 50.0)),
    "IMU_GYRO_CUTOFF": stored(0.0, 200.0),
    "MC_ROLLRATE_MAX": stored(0.0, 1800.0),
    "MC_RR_INT_LIM": stored(0.0, 5.0),
    "THR_MDL_FAC": stored(0.0, 1.0),
    "IMU_GYRO_NF0_FRQ": stored(0.0, 120.0),
}


class TestSettings:
    @settings(max_examples=60, deadline=None)
    @given(st.data())
    def test_the_short_way_is_the_long_way(self, data: st.DataObject) -> None:
        """Settings and gains of candidates that share what they do not differ in are those of `roll_set`."""
        names = data.draw(st.lists(st.sampled_from(sorted(VARIED)), min_size=1, max_size=6, unique=True))
        rows = data.draw(st.lists(st.tuples(*(VARIED[name] for name in names)), min_size=1, max_size=4))
        base = PLANS["margins"]
        axes = tuple(dataclasses.replace(base.sweep.parameters[0], name=name) for name in names)
        plan = dataclasses.replace(base, sweep=dataclasses.replace(base.sweep, parameters=axes))
        case = plan.cases[0]
        made, sets = evaluation._settings(plan, case, np.array(rows))
        assert made.dtype == CONTROL_SETTINGS
        for g, row in enumerate(rows):
            wanted = roll_set(case.model, case.profile, {**plan.sweep.fixed, **dict(zip(names, row, strict=True))})
            for field in CONTROL_SETTINGS.names or ():
                assert made[field][g].tobytes() == wanted.settings[field].tobytes(), field
            assert sets[g].gains == wanted.gains
            assert sets[g].profile == wanted.profile

    def test_values_are_rounded_as_px4_keeps_them(self, tmp_path: Path) -> None:
        plan = planned(tmp_path, LINEAR)
        task = task_of(plan, 0)
        assert task.values[0, 1] == float(np.float32(0.03)) != 0.03
        made, _ = evaluation._settings(plan, plan.cases[0], task.values)
        assert made["kp"][:, 0].tolist() == [float(np.float32(x)) for x in (0.03, 0.05, 0.09)] * 2


PLANS: dict[str, Plan] = {}


@pytest.fixture(autouse=True, scope="module")
def _plans(tmp_path_factory: pytest.TempPathFactory) -> None:
    PLANS["margins"] = planned(tmp_path_factory.mktemp("plans"), RANDOM)


class TestFailures:
    """A point that cannot be judged is a row with the reason, and nobody else's."""

    def check(self, plan: Plan, wanted: Columns, bad: set[int], reason: str) -> None:
        rows = Evaluator(plan).rows(task_of(plan, 0))
        assert list(rows) == list(wanted) or set(rows) == set(wanted)
        for g in range(plan.candidates):
            if g in bad:
                assert rows["outcome"][g] == ERROR
                assert reason in rows["reason"][g]
                assert rows["passes"][g] == rows["samples"][g] == 0
                assert math.isnan(rows["pass_pct"][g])
                assert all(math.isnan(rows[f"{name}_worst"][g]) for name in measured_names(plan))
                continue
            for name, column in rows.items():
                same = column[g] == wanted[name][g] or (column[g] != column[g] and wanted[name][g] != wanted[name][g])
                assert same, (g, name)

    def test_parameters_that_are_refused_together(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        plan = planned(
            tmp_path, LINEAR.replace("MC_ROLL_P = [4.0, 6.5]", "MC_ROLL_P = [4.0, 6.5]\nIMU_GYRO_CUTOFF = [30.0, 40.0]")
        )
        wanted = Evaluator(plan).rows(task_of(plan, 0))

        def refuse(model: Any, profile: Any, values: Any) -> Any:
            if values["IMU_GYRO_CUTOFF"] == 30.0:
                raise UsageError("IMU_GYRO_CUTOFF = 30: not with this")
            return roll_set(model, profile, values)

        monkeypatch.setattr(evaluation, "roll_set", refuse)
        bad = set(np.flatnonzero(task_of(plan, 0).values[:, 1] == 30.0).tolist())
        assert len(bad) == 6
        self.check(plan, wanted, bad, "IMU_GYRO_CUTOFF = 30: not with this")

    @pytest.mark.parametrize("error", [ZeroDivisionError("division by zero"), ValueError("not finite")])
    def test_a_kernel_that_raises_for_one(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
    ) -> None:
        plan = planned(tmp_path, LINEAR)
        wanted = Evaluator(plan).rows(task_of(plan, 0))
        kernel = Batch.fly

        def fly(self: Batch, number: int, room: Any = None) -> Any:
            gain_sets = self.blocks[number][1]
            if (self.job.settings["kp"][gain_sets, 0] == np.float32(0.09)).any():
                raise error
            return kernel(self, number, room)

        monkeypatch.setattr(Batch, "fly", fly)
        self.check(plan, wanted, {2, 5}, str(error))

    def test_a_program_s_own_mistake_is_no_row(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        plan = planned(tmp_path, LINEAR)

        def fly(self: Batch, number: int, room: Any = None) -> Any:
            raise AttributeError("a mistake")

        monkeypatch.setattr(Batch, "fly", fly)
        with pytest.raises(AttributeError):
            Evaluator(plan).rows(task_of(plan, 0))
