"""Ranking: candidates over all their cases. Which of them pass everywhere?

The dataset is read file by file and only the columns that are needed; what is kept is a few numbers a candidate, so a
sweep of millions is ranked in the memory of a few hundred megabytes.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from scenarios.analysis import wilson
from scenarios.sweep.dataset import LARGEST_CHUNK, Dataset
from scenarios.sweep.evaluation import ERROR, PASS
from scenarios.sweep.objectives import Objective
from scenarios.sweep.plan import MOST_CHUNK
from scenarios.sweep.stored_sweep import StoredSweep
from scenarios.sweep.sweep_words import DIVERGED
from sitl.errors import FileError
from sitl.plain_file import check_plain

if TYPE_CHECKING:
    import pyarrow as pa

FloatArray = npt.NDArray[np.float64]

NOT_JUDGED = -1
"""Samples that pass where the point is an ERROR: fewer than none."""

MOST_REASONS = 500
"""Texts that are told apart; errors may name values, so each could have its own."""
OTHERS = "other reasons"

_COUNTED = re.compile(r" on \d+ of \d+ samples$")


@dataclass
class CaseSummary:
    """A case over its candidates.

    Attributes:
        name: of the case. points, passing, errors: of those that are done. samples: of the points that fail.
        failing: limit's metric, or DIVERGED -> of those samples, how many break it.
    """

    name: str
    points: int = 0
    passing: int = 0
    errors: int = 0
    samples: int = 0
    failing: Counter[str] = field(default_factory=Counter)


@dataclass
class Reason:
    """Why points do not pass.

    Attributes:
        text: without numbers. points: how many. candidate, case: of the first of them, by file.
    """

    text: str
    points: int
    candidate: int
    case: int


@dataclass(frozen=True)
class Ranking:
    """All candidates.

    Attributes:
        sweep: what was swept.
        done, passed, errors: (N,) cases that are worked out, passed, and could not be judged.
        worst_passes: (N,) samples that pass in the worst case; NOT_JUDGED if it could not be judged.
        worst_case: (N,) its number; among cases alike the one with the worst first objective.
        costs: (N, K) each objective in its worst case, small is good (`cost`, `value`); NaN where it was not measured
            in some case.
        values: parameter axis -> (N,).
        cases: one by one. reasons, failures: why points fail, and why points could not be judged, the most common
            first. problems: files that could not be read.
    """

    sweep: StoredSweep
    done: npt.NDArray[np.uint16]
    passed: npt.NDArray[np.uint16]
    errors: npt.NDArray[np.uint16]
    worst_passes: npt.NDArray[np.int32]
    worst_case: npt.NDArray[np.uint16]
    costs: FloatArray
    values: Mapping[str, npt.NDArray[Any]]
    cases: tuple[CaseSummary, ...]
    reasons: tuple[Reason, ...]
    failures: tuple[Reason, ...]
    problems: tuple[str, ...]

    @cached_property
    def complete(self) -> npt.NDArray[np.bool_]:
        """(N,) every case is worked out."""
        return np.asarray(self.done == len(self.sweep.cases))

    @cached_property
    def everywhere(self) -> npt.NDArray[np.bool_]:
        """(N,) passes in every case."""
        return np.asarray(self.passed == len(self.sweep.cases))

    @cached_property
    def order(self) -> npt.NDArray[np.intp]:
        """Candidates that are complete, the best first.

        What passes everywhere comes first; then the share of samples that passes in the worst case counts, the cases
        passed, and the first objective.
        """
        found = np.flatnonzero(self.complete)
        everywhere, passed = self.everywhere[found], self.passed[found].astype(np.int32)
        keys = (self.costs[found, 0], -passed, -self.worst_passes[found], ~everywhere)
        return np.asarray(found[np.lexsort(keys)])

    @property
    def points_done(self) -> int:
        """Of all points."""
        return int(self.done.sum(dtype=np.int64))

    @property
    def incomplete(self) -> int:
        """Candidates of which some cases are worked out and some are not."""
        return int(np.count_nonzero((self.done > 0) & ~self.complete))

    @property
    def passing(self) -> int:
        """Candidates that pass everywhere."""
        return int(np.count_nonzero(self.everywhere))

    @property
    def best(self) -> int | None:
        """The first of the order; whether it passes everywhere, `everywhere` says. None: none is complete."""
        return int(self.order[0]) if len(self.order) else None

    def worst_pct(self, candidate: int) -> float | None:
        """Share of the samples that pass in its worst case; None if that could not be judged."""
        passes = int(self.worst_passes[candidate])
        return None if passes == NOT_JUDGED else 100.0 * passes / self.sweep.of

    def interval_pct(self, candidate: int) -> tuple[float, float] | None:
        """Wilson's 95 % interval of that share."""
        passes = int(self.worst_passes[candidate])
        if passes == NOT_JUDGED:
            return None
        low, high = wilson(passes, self.sweep.of)
        return 100.0 * low, 100.0 * high

    def objective(self, candidate: int, number: int) -> float:
        """An objective in its worst case, in the metric's unit; NaN if not measured in some case."""
        return float(value_of(self.sweep.objectives[number], self.costs[candidate, number]))

    def values_of(self, candidate: int) -> dict[str, float]:
        """Values of its axes."""
        return {name: column[candidate].item() for name, column in self.values.items()}


def cost(objective: Objective, value: FloatArray) -> FloatArray:
    """An objective such that small is good. Of the droop the magnitude counts.

    Args:
        objective: whose. value: in the metric's unit.
    """
    if objective.metric == "droop_deg":
        return np.asarray(np.abs(value))
    return np.asarray(-value if objective.maximise else value)


def value_of(objective: Objective, cost: Any) -> Any:
    """The value of a `cost`.

    Args:
        objective: whose. cost: a number or an array.
    """
    return -cost if objective.maximise else cost


def rank(sweep: StoredSweep) -> Ranking:
    """Read the dataset and rank what is there.

    Args:
        sweep: of the folder. A file of another sweep, or a damaged one, counts as not done yet.
    """
    number, objectives = sweep.candidates, sweep.objectives
    done, passed, errors = (np.zeros(number, np.uint16) for _ in range(3))
    worst_passes = np.full(number, np.iinfo(np.int32).max, np.int32)
    worst_case = np.zeros(number, np.uint16)
    worst_first = np.full(number, -np.inf)
    costs = np.full((number, len(objectives)), -np.inf)
    values = {axis.name: np.full(number, 0, np.int32 if axis.integer else np.float32) for axis in sweep.axes}
    cases = tuple(CaseSummary(name) for name in sweep.cases)
    reasons: dict[str, Reason] = {}
    failures: dict[str, Reason] = {}
    problems: list[str] = []
    for table in _tables(sweep, problems):
        at, case = _numbers(table, "candidate"), int(table["case"][0].as_py())
        outcome = table["outcome"].to_numpy(zero_copy_only=False)
        good, bad = outcome == PASS, outcome == ERROR
        done[at] += 1
        passed[at] += good
        errors[at] += bad
        passes = np.where(bad, NOT_JUDGED, _numbers(table, "passes")).astype(np.int32)
        now = np.column_stack([cost(one, _numbers(table, one.column)) for one in objectives])
        first = np.nan_to_num(now[:, 0], nan=np.inf)
        worse = (passes < worst_passes[at]) | ((passes == worst_passes[at]) & (first > worst_first[at]))
        worst_case[at[worse]], worst_first[at[worse]] = case, first[worse]
        worst_passes[at] = np.minimum(worst_passes[at], passes)
        costs[at] = np.maximum(costs[at], now)  # NaN stays
        for name, column in values.items():
            column[at] = _numbers(table, name)
        _sum_up(cases[case], table, good, bad, sweep)
        _collect(reasons, table, at, ~good & ~bad)
        _collect(failures, table, at, bad)
    costs[done == 0] = np.nan
    worst_passes[done == 0] = NOT_JUDGED
    return Ranking(
        *(sweep, done, passed, errors, worst_passes, worst_case, costs, values, cases),
        reasons=_common(reasons),
        failures=_common(failures),
        problems=tuple(problems),
    )


def _tables(sweep: StoredSweep, problems: list[str]) -> Iterator[pa.Table]:
    """The files of the dataset, one at a time, each of one case."""
    import pyarrow.parquet as pq

    columns = ["candidate", "case", *(axis.name for axis in sweep.axes), "outcome", "reason", "passes", "samples"]
    columns += ["diverged", *(f"failing_{limit.metric}" for limit in sweep.limits)]
    columns += [one.column for one in sweep.objectives if one.column not in columns]
    for path in sorted(Dataset(sweep.path).points.glob("chunk-*.parquet")):
        try:
            check_plain(path, LARGEST_CHUNK)
            with pq.ParquetFile(path) as file:
                if file.metadata.num_rows > MOST_CHUNK:
                    problems.append(f"{path.name} says that it has {file.metadata.num_rows} rows: not counted")
                    continue
                named = (file.metadata.metadata or {}).get(b"froude_plan", b"").decode()
                if named != sweep.facts["fingerprint"]:
                    problems.append(f"{path.name} is of another sweep: not counted")
                    continue
                table = file.read(columns=columns)
        except (OSError, ValueError, FileError) as error:
            problems.append(f"{path.name} cannot be read ({error}): not counted; --resume works it out again")
            continue
        if table.num_rows:
            yield table


def _numbers(table: pa.Table, name: str) -> npt.NDArray[Any]:
    return np.asarray(table[name].to_numpy(zero_copy_only=False))


def _sum_up(
    case: CaseSummary, table: pa.Table, good: npt.NDArray[np.bool_], bad: npt.NDArray[np.bool_], sweep: StoredSweep
) -> None:
    failed = ~good & ~bad
    case.points += len(good)
    case.passing += int(np.count_nonzero(good))
    case.errors += int(np.count_nonzero(bad))
    case.samples += int(_numbers(table, "samples")[failed].sum())
    case.failing[DIVERGED] += int(_numbers(table, "diverged")[failed].sum())
    for limit in sweep.limits:
        case.failing[limit.metric] += int(_numbers(table, f"failing_{limit.metric}")[failed].sum())


def _collect(
    found: dict[str, Reason], table: pa.Table, candidates: npt.NDArray[Any], which: npt.NDArray[np.bool_]
) -> None:
    rows = np.flatnonzero(which)
    if not len(rows):
        return
    texts = table["reason"].to_numpy(zero_copy_only=False)[rows]
    case = int(table["case"][0].as_py())
    unique, first, counts = np.unique(texts.astype(str), return_index=True, return_counts=True)
    for text, at, count in zip(unique.tolist(), first.tolist(), counts.tolist(), strict=True):
        text = _COUNTED.sub("", text)
        if text not in found and len(found) >= MOST_REASONS:
            text = OTHERS
        reason = found.setdefault(text, Reason(text, 0, int(candidates[rows[at]]), case))
        reason.points += count


def _common(found: Mapping[str, Reason]) -> tuple[Reason, ...]:
    return tuple(sorted(found.values(), key=lambda one: (-one.points, one.text)))
