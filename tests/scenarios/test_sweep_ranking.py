"""The ranking and the front of a sweep, worked out once more from all rows, and by the definition."""

from __future__ import annotations

import dataclasses
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

sys.path.insert(0, str(Path(__file__).parent))

from sweeps import Inline, Quick, plan_of, sweep_text, swept

from scenarios.analysis import wilson
from scenarios.gain_set import load_gain_sets
from scenarios.sweep.dataset import SWEEP_JSON, Dataset
from scenarios.sweep.evaluation import ERROR, FAIL, PASS, Columns, Task
from scenarios.sweep.objectives import Objective
from scenarios.sweep.pareto import front_of, non_dominated
from scenarios.sweep.plan import Plan
from scenarios.sweep.ranking import NOT_JUDGED, OTHERS, Ranking, cost, rank
from scenarios.sweep.stored_sweep import stored_sweep
from scenarios.sweep.winner import winner_set, write_winner
from sitl.errors import FileError


class Made(Quick):
    """Rows by chance, of every kind: seeded by the chunk, so that anybody works out the same."""

    PASSING = 0.8

    def rows(self, task: Task) -> Columns:
        columns = super().rows(task)
        count, of = len(task.values), self.plan.samples - 1
        chance = np.random.default_rng(task.chunk.number)
        kinds = chance.random(count)
        passes = np.where(kinds < self.PASSING, of, chance.integers(0, of + 1, count)).astype(np.int32)
        outcome = np.where(kinds < self.PASSING, PASS, FAIL).astype(object)
        failed = np.flatnonzero(outcome == FAIL)
        outcome[failed[::5]] = ERROR
        bad = outcome == ERROR
        columns["outcome"], columns["nominal_passes"] = outcome, outcome == PASS
        columns["passes"], columns["samples"] = np.where(bad, 0, passes), np.where(bad, 0, of).astype(np.int32)
        columns["pass_pct"] = np.where(bad, math.nan, 100.0 * passes / of)
        limits = chance.integers(0, 2, count)
        texts = np.array(["overshoot out of its limit", "oscillation out of its limit"])[limits]
        reasons = [f"{text} on {of - n} of {of} samples" for text, n in zip(texts, passes, strict=True)]
        columns["reason"] = np.where(bad, "no such mixer", np.where(outcome == PASS, "", reasons)).astype(object)
        columns["failing_overshoot_pct"] = np.where(bad, 0, of - passes).astype(np.int32)
        for name in ("rise_time_s_worst", "overshoot_pct_worst"):
            # a few digits: some are alike
            values = np.round(chance.gamma(2.0, 0.1, count), 2)
            columns[name] = np.where(bad | (chance.random(count) < 0.05), math.nan, values)
        return columns


class NonePasses(Made):
    PASSING = 0.0


def made(
    folder: Path, rows: type[Quick] = Made, points: int = 90, block: int = 16, **options: Any
) -> tuple[Plan, Path]:
    """A sweep of rows that nobody flew."""
    text = sweep_text(points, axes='vehicle = ["ant-x", "ant-r"]\nmotor_lag_s = [0.01, 0.02]', **options)
    plan = plan_of(folder / "made.toml", text, block)
    swept(plan, Inline(plan, rows), folder / "made")
    return plan, folder / "made"


@pytest.fixture(scope="module")
def ranked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Ranking, dict[int, list[dict[str, Any]]]]:
    """A ranking, and all rows by candidate."""
    _, folder = made(tmp_path_factory.mktemp("ranked"))
    rows: dict[int, list[dict[str, Any]]] = {}
    for row in Dataset(folder).read().to_pylist():
        rows.setdefault(row["candidate"], []).append(row)
    return rank(stored_sweep(folder)), rows


Ranked = tuple[Ranking, dict[int, list[dict[str, Any]]]]


def test_every_candidate_is_summed_up_over_its_cases(ranked: Ranked) -> None:
    ranking, rows = ranked
    assert 0 < ranking.passing < len(rows)
    for candidate, cases in rows.items():
        assert ranking.done[candidate] == len(cases) == 4
        assert ranking.passed[candidate] == sum(row["outcome"] == PASS for row in cases)
        assert ranking.errors[candidate] == sum(row["outcome"] == ERROR for row in cases)
        assert ranking.everywhere[candidate] == all(row["outcome"] == PASS for row in cases)
        shares = [row["pass_pct"] for row in cases]
        if None in shares:
            assert ranking.worst_pct(candidate) is None
            assert ranking.interval_pct(candidate) is None
            assert ranking.worst_passes[candidate] == NOT_JUDGED
        else:
            assert ranking.worst_pct(candidate) == pytest.approx(min(shares))
            low, high = wilson(min(row["passes"] for row in cases), 4)
            assert ranking.interval_pct(candidate) == (100.0 * low, 100.0 * high)
        worst = cases[int(ranking.worst_case[candidate])]
        assert worst["pass_pct"] == (None if None in shares else min(shares))
        for k, column in enumerate(("rise_time_s_worst", "overshoot_pct_worst")):
            values = [row[column] for row in cases]
            if None in values:
                assert math.isnan(ranking.objective(candidate, k))
            else:
                assert ranking.objective(candidate, k) == max(values)
        for name, value in ranking.values_of(candidate).items():
            assert value == cases[0][name]


def test_the_order_is_by_what_passes_then_by_the_worst_case_then_by_the_first_objective(ranked: Ranked) -> None:
    ranking, rows = ranked

    def key(candidate: int) -> tuple[float, ...]:
        cases = rows[candidate]
        share = min(-1.0 if row["pass_pct"] is None else row["pass_pct"] for row in cases)
        passed = sum(row["outcome"] == PASS for row in cases)
        rises = [row["rise_time_s_worst"] for row in cases]
        return (-(passed == 4), -share, -passed, math.inf if None in rises else max(rises))

    assert ranking.order.tolist() == sorted(rows, key=lambda candidate: (*key(candidate), candidate))


def test_cases_and_reasons_are_counted(ranked: Ranked) -> None:
    ranking, rows = ranked
    every = [row for cases in rows.values() for row in cases]
    for number, case in enumerate(ranking.cases):
        mine = [row for row in every if row["case"] == number]
        assert case.name == ranking.sweep.cases[number]
        assert (case.points, case.passing) == (len(mine), sum(row["outcome"] == PASS for row in mine))
        failing = [row for row in mine if row["outcome"] == FAIL]
        assert case.errors == sum(row["outcome"] == ERROR for row in mine)
        assert case.samples == sum(row["samples"] for row in failing)
        assert case.failing["overshoot_pct"] == sum(row["failing_overshoot_pct"] for row in failing)
    assert {one.text for one in ranking.reasons} == {"overshoot out of its limit", "oscillation out of its limit"}
    assert sum(one.points for one in ranking.reasons) == sum(row["outcome"] == FAIL for row in every)
    (failure,) = ranking.failures
    assert (failure.text, failure.points) == ("no such mixer", sum(row["outcome"] == ERROR for row in every))
    assert rows[failure.candidate][failure.case]["outcome"] == ERROR


def test_reasons_without_end_share_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scenarios.sweep.ranking.MOST_REASONS", 1)
    _, folder = made(tmp_path)
    ranking = rank(stored_sweep(folder))
    assert len(ranking.reasons) == 2
    assert OTHERS in {one.text for one in ranking.reasons}


def test_a_stopped_sweep_ranks_what_is_complete(tmp_path: Path) -> None:
    plan, folder = made(tmp_path)
    dataset = Dataset(folder)
    dataset.file(5).unlink()  # candidates 16 to 31 in case 1
    dataset.file(2).write_bytes(dataset.file(2).read_bytes()[:100])  # candidates 0 to 15 in case 2
    ranking = rank(stored_sweep(folder))
    assert ranking.points_done == plan.points - 32
    assert ranking.incomplete == 32
    assert sorted(ranking.order.tolist()) == list(range(32, 90))
    assert not ranking.everywhere[:32].any()
    (problem,) = ranking.problems
    assert problem.startswith("chunk-00000002.parquet cannot be read")


def test_a_chunk_of_another_sweep_is_not_counted(tmp_path: Path) -> None:
    plan, folder = made(tmp_path)
    (tmp_path / "other").mkdir()
    _, other = made(tmp_path / "other", samples=6)
    Dataset(folder).file(0).write_bytes(Dataset(other).file(0).read_bytes())
    ranking = rank(stored_sweep(folder))
    assert ranking.points_done == plan.points - 16
    assert ranking.problems == ("chunk-00000000.parquet is of another sweep: not counted",)


def test_files_made_to_do_harm_are_not_read(tmp_path: Path) -> None:
    """A pipe where a chunk or a description should be would be waited for; a hole of a terabyte would be read."""
    _, folder = made(tmp_path)
    dataset = Dataset(folder)
    dataset.file(0).unlink()
    os.mkfifo(dataset.file(0))
    with dataset.file(1).open("ab") as file:
        file.truncate(1 << 40)
    problems = rank(stored_sweep(folder)).problems
    assert any("is a device, a pipe or a socket" in one for one in problems), problems
    assert any("bytes, and at most" in one for one in problems), problems
    (folder / SWEEP_JSON).write_text("[" * 100_000)
    with pytest.raises(FileError, match="is damaged"):
        dataset.facts()


def test_a_sweep_that_has_just_begun_has_no_best(tmp_path: Path) -> None:
    plan = plan_of(tmp_path / "new.toml", sweep_text())
    Dataset(tmp_path / "new").create(plan, {})
    ranking = rank(stored_sweep(tmp_path / "new"))
    assert ranking.best is None
    assert winner_set(ranking) is None
    assert write_winner(ranking, tmp_path / "new") == ()
    assert len(front_of(ranking).candidates) == 0


def test_a_folder_whose_description_lacks_something_is_damaged(tmp_path: Path) -> None:
    _, folder = made(tmp_path)
    path = folder / SWEEP_JSON
    path.write_text(path.read_text().replace('"objectives"', '"subjectives"'))
    with pytest.raises(FileError, match=r"sweep\.json: is damaged: KeyError 'objectives'"):
        stored_sweep(folder)


def test_of_the_droop_the_magnitude_is_bad_and_of_margins_little() -> None:
    droop, margin = Objective("droop_deg", "worst", False), Objective("delay_margin_s", "worst", True)
    assert cost(droop, np.array([-3.0, 1.0])).tolist() == [3.0, 1.0]
    assert cost(margin, np.array([0.02, math.inf])).tolist() == [-0.02, -math.inf]


# -- the front -------------------------------------------------------------------------------------------------------


def dominates(one: np.ndarray, other: np.ndarray) -> bool:
    return bool((one <= other).all() and (one < other).any())


@settings(max_examples=200, deadline=None)
@given(
    st.integers(1, 4).flatmap(
        lambda columns: st.integers(0, 30).flatmap(
            lambda rows: arrays(
                np.float64,
                (rows, columns),
                elements=st.sampled_from([-math.inf, -1.0, -0.0, 0.0, 0.5, 1.0, 7.0, math.inf]),
            )
        )
    )
)
def test_the_front_is_what_the_definition_says(costs: np.ndarray) -> None:
    wanted = [not any(dominates(other, one) for other in costs) for one in costs]
    assert non_dominated(costs).tolist() == wanted


def test_the_front_is_among_those_that_pass_everywhere(ranked: Ranked) -> None:
    ranking, _ = ranked
    front = front_of(ranking)
    among = [c for c in np.flatnonzero(ranking.everywhere) if not np.isnan(ranking.costs[c]).any()]
    wanted = {c for c in among if not any(dominates(ranking.costs[d], ranking.costs[c]) for d in among)}
    assert front.passing
    assert front.among == len(among)
    assert set(front.candidates.tolist()) == wanted
    first = ranking.costs[front.candidates, 0]
    assert (np.diff(first) >= 0.0).all()


def test_where_none_passes_everywhere_the_front_is_among_all(tmp_path: Path) -> None:
    _, folder = made(tmp_path, NonePasses)
    ranking = rank(stored_sweep(folder))
    front = front_of(ranking)
    assert ranking.passing == 0
    assert not front.passing
    assert front.among == np.count_nonzero(~np.isnan(ranking.costs).any(axis=1))


# -- the winner ------------------------------------------------------------------------------------------------------


def float32(values: Any) -> dict[str, Any]:
    return {name: value if isinstance(value, int) else np.float32(value) for name, value in values.items()}


@pytest.mark.parametrize(("rows", "name", "other"), [(Made, "winner", "best"), (NonePasses, "best", "winner")])
def test_the_first_is_exported_as_what_it_is(tmp_path: Path, rows: type[Quick], name: str, other: str) -> None:
    text = sweep_text(40, axes="MC_ROLLRATE_D = [0.0, 0.0013]\nIMU_GYRO_RATEMAX = [400, 800]")
    text += "[parameters]\nMC_ROLLRATE_I = 0.1\nMC_ROLLRATE_FF = 1e-05\nMC_AIRMODE = 1\n"
    plan = plan_of(tmp_path / "made.toml", text)
    folder = tmp_path / "made"
    swept(plan, Inline(plan, rows), folder)
    ranking = rank(stored_sweep(folder))
    for suffix in (".toml", ".params"):
        (folder / f"{other}{suffix}").write_text("of an earlier look")
    toml, params = write_winner(ranking, folder)
    assert [toml.name, params.name] == [f"{name}.toml", f"{name}.params"]
    assert not list(folder.glob(f"{other}.*"))
    assert not list(folder.glob(".*.part"))
    assert ranking.best is not None
    row = Dataset(folder).read().to_pylist()[0]
    wanted = {axis.name: ranking.values_of(ranking.best)[axis.name] for axis in plan.sweep.parameters}
    assert wanted.keys() <= row.keys()
    wanted |= {"MC_ROLLRATE_I": 0.1, "MC_ROLLRATE_FF": 1e-5, "MC_AIRMODE": 1}
    for path in (toml, params):
        (found,) = load_gain_sets(path)
        assert float32(found.parameters) == float32(wanted)
        assert isinstance(found.parameters["IMU_GYRO_RATEMAX"], int)
    (found,) = load_gain_sets(toml)
    assert found.name == f"made {name}"
    assert found.source.startswith(f"froude sweep made: candidate {ranking.best} of 40")
    assert found.note.startswith("passes in 1 of 1" if name == "winner" else "DOES NOT PASS everywhere; ")


def test_the_ranking_keeps_no_more_than_a_few_numbers_a_candidate(ranked: Ranked) -> None:
    ranking, rows = ranked
    arrays_ = [value for field in dataclasses.fields(ranking) for value in [getattr(ranking, field.name)]]
    kept = sum(one.nbytes for one in (*arrays_, *ranking.values.values()) if isinstance(one, np.ndarray))
    assert kept <= 40 * len(rows)
