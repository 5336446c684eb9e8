"""A search: the same candidates whoever works and however often it is stopped, and better ones than by chance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenarios.sweep.dataset import Dataset
from scenarios.sweep.engines import InProcess, Processes
from scenarios.sweep.evaluation import PASS, Evaluator
from scenarios.sweep.plan import Plan
from scenarios.sweep.search import Search
from scenarios.sweep.sweeping import Progress, sweep_points
from sitl.errors import FileError
from tests.scenarios.sweeps import Inline, Quick, files, plan_of, sweep_text, swept

SEARCH = "generation = 16\nseed = 5"
OBJECTIVES = 'objectives = ["rise_time_s", "overshoot_pct"]'


def search_text(objectives: str = '["rise_time_s", "delay_margin_s"]', kind: str = "search", points: int = 64) -> str:
    design = SEARCH if kind == "search" else "seed = 5"
    text = sweep_text(points, kind=kind, margins="nominal", design=design, axes="")
    return text.replace(OBJECTIVES, f"objectives = {objectives}").replace(
        "[[manoeuvre]]", '[[limit]]\nmetric = "delay_margin_s"\nmin = 0.015\n[[manoeuvre]]'
    )


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """Four generations of sixteen candidates, two a chunk."""
    made = plan_of(tmp_path_factory.mktemp("search") / "search.toml", search_text())
    assert (made.candidates, made.block, made.chunks) == (64, 2, 32)
    return made


@pytest.fixture(scope="module")
def searched(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its folder, by one thread."""
    folder = tmp_path_factory.mktemp("searched") / "one"
    swept(plan, InProcess(plan, 1), folder)
    return folder


def test_the_same_candidates(plan: Plan, searched: Path, tmp_path: Path) -> None:
    assert swept(plan, Processes(plan, 2), tmp_path / "processes")[0] == files(searched)
    assert swept(plan, Inline(plan, Evaluator, shuffled=True), tmp_path / "shuffled")[0] == files(searched)


class Stop(Exception):
    """Somebody pulls the plug."""


@pytest.mark.parametrize("after", [1, 17, 40])
def test_stopped_and_gone_on_with(after: int, plan: Plan, searched: Path, tmp_path: Path) -> None:
    """In the middle of a generation, with chunks done in another order: all of it is asked again, none worked again."""
    dataset = Dataset(tmp_path / "stopped")
    dataset.create(plan, {})

    def stop(now: Progress) -> None:
        if now.done >= after:
            raise Stop

    with pytest.raises(Stop), dataset.locked():
        sweep_points(plan, dataset, Inline(plan, Evaluator, shuffled=True), stop)
    kept = files(dataset.path)
    assert 0 < len(kept) < plan.chunks
    with dataset.locked(), InProcess(plan, 1) as engine:
        progress = sweep_points(plan, dataset, engine)
    assert progress.begun_with == 2 * len(kept)
    assert files(dataset.path) == files(searched)


def front(folder: Path) -> np.ndarray:
    """(n, 2) rise time and -delay margin of what passes, both small where good."""
    rows = Dataset(folder).read(["outcome", "rise_time_s_worst", "delay_margin_s_worst"]).to_pydict()
    passing = np.array([one == PASS for one in rows["outcome"]])
    assert passing.any()
    return np.column_stack(
        [np.array(rows["rise_time_s_worst"])[passing], -np.array(rows["delay_margin_s_worst"])[passing]]
    ).astype(float)


def volume(points: np.ndarray, corner: tuple[float, float]) -> float:
    """Area that points dominate below a corner: the hypervolume of two objectives."""
    total, best = 0.0, corner[1]
    for x, y in sorted(map(tuple, points)):
        if x < corner[0] and y < best:
            total += (corner[0] - x) * (best - y)
            best = y
    return float(total)


TIGHT = """
[[limit]]
metric = "rise_time_s"
max = 0.35
[[limit]]
metric = "settling_time_5pct_s"
max = 1.2
"""
FOUR = """
MC_ROLLRATE_I = { from = 0.01, to = 0.3 }
MC_ROLLRATE_D = { from = 0.0, to = 0.003 }
"""


def test_better_than_by_chance(tmp_path: Path) -> None:
    """Four axes, limits that one candidate in a dozen keeps: a search finds more of them, and a better front.

    The other design is a Latin hypercube of as many candidates. Mean of four seeds.
    """
    passing, dominated = np.zeros((4, 2)), np.zeros((4, 2))
    for seed in range(4):
        for k, kind in enumerate(("search", "latin-hypercube")):
            text = search_text(kind=kind, points=256).replace("seed = 5", f"seed = {seed}")
            text = text.replace("samples = 4", "samples = 2").replace("min = 0.015", "min = 0.012")
            text = text.replace("max = 20.0", "max = 15.0").replace("[[manoeuvre]]", TIGHT + "[[manoeuvre]]")
            path = tmp_path / f"{kind}{seed}.toml"
            plan = plan_of(path, text.replace("to = 0.12 }", "to = 0.12 }" + FOUR))
            swept(plan, InProcess(plan, 1), path.with_suffix(""))
            found = front(path.with_suffix(""))
            passing[seed, k], dominated[seed, k] = len(found), volume(found, (0.35, -0.012))
    assert (passing[:, 0] > 2.5 * passing[:, 1]).all(), passing
    assert dominated[:, 0].mean() > 1.1 * dominated[:, 1].mean(), dominated


def test_one_objective(tmp_path: Path) -> None:
    """By TPE: again the same candidates, and later generations are better than the first."""
    plan = plan_of(tmp_path / "one.toml", search_text('["rise_time_s"]'))
    found, _ = swept(plan, InProcess(plan, 1), tmp_path / "one")
    assert swept(plan, Inline(plan, Evaluator, shuffled=True), tmp_path / "again")[0] == found
    rows = Dataset(tmp_path / "one").read(["candidate", "outcome", "rise_time_s_worst"]).to_pydict()
    passing = [
        (number, rise)
        for number, outcome, rise in zip(rows["candidate"], rows["outcome"], rows["rise_time_s_worst"], strict=True)
        if outcome == PASS and rise is not None
    ]
    assert min(rise for number, rise in passing if number >= 16) < min(rise for number, rise in passing if number < 16)


def test_rows_of_another_optimiser(tmp_path: Path, plan: Plan, searched: Path) -> None:
    """Its candidates would not be those that the rows are of: refused, not mixed."""
    search = Search(plan)
    values, start = next(search.generations())
    with pytest.raises(FileError, match=r"holds other candidates than this search asks for.*Start the sweep anew"):
        search.tell(values + 1.0, start, Dataset(searched))


def test_points_that_fail(tmp_path: Path) -> None:
    """They are told as the worst there is; the search goes on."""

    class Broken(Quick):
        def rows(self, task):  # type: ignore[no-untyped-def]
            columns = super().rows(task)
            if task.chunk.number % 2:
                columns["outcome"][:] = "ERROR"
                columns["pass_pct"] = np.full(len(task.values), np.nan)
            return columns

    plan = plan_of(tmp_path / "broken.toml", search_text())
    _, progress = swept(plan, Inline(plan, Broken), tmp_path / "broken")
    assert progress.done == 64
    assert progress.errors == 32
