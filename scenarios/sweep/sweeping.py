"""A sweep under way: chunks that are missing are worked out and kept, in whatever order they come."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios import interrupts
from scenarios.sweep.candidates import Candidates
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.engines import Engine, Result
from scenarios.sweep.evaluation import ERROR, PASS, Task, chunk_steps
from scenarios.sweep.plan import Plan
from scenarios.sweep.sweep_file import SEARCH


@dataclass
class Progress:
    """How far a sweep is.

    Attributes:
        points: of the whole sweep. done: kept so far, those of earlier runs included. begun_with: of earlier runs.
        passing, errors: of those of this run. lost_workers: that died, of this run.
        steps: vehicle-steps flown in this run.
        best_pct, best_point: the largest share of samples that passes, of this run, and where.
    """

    points: int
    done: int = 0
    begun_with: int = 0
    passing: int = 0
    errors: int = 0
    lost_workers: int = 0
    steps: int = 0
    best_pct: float = -1.0
    best_point: int = -1

    def take(self, plan: Plan, result: Result) -> None:
        """Count a chunk.

        Args:
            plan: of the sweep. result: the chunk.
        """
        columns, chunk = result.columns, result.task.chunk
        outcome = columns["outcome"]
        self.done += len(outcome)
        self.passing += int(np.count_nonzero(outcome == PASS))
        self.errors += int(np.count_nonzero(outcome == ERROR))
        self.lost_workers += result.lost
        self.steps += chunk_steps(plan, chunk)
        share = np.where(np.isnan(columns["pass_pct"]), -1.0, columns["pass_pct"])
        best = int(np.argmax(share))
        if share[best] > self.best_pct:
            self.best_pct = float(share[best])
            self.best_point = (chunk.start + best) * len(plan.cases) + chunk.case


def sweep_points(
    plan: Plan, dataset: Dataset, engine: Engine, show: Callable[[Progress], object] = lambda _: None
) -> Progress:
    """Work out every chunk that the dataset does not hold.

    Args:
        plan: of the sweep. dataset: made for it, and locked. engine: entered. show: called after every chunk.

    Returns:
        what was done.

    Raises:
        FileError: a chunk cannot be kept; those before it are.
    """
    there = dataset.done(plan)
    progress = Progress(plan.points)
    for number in there:
        chunk = plan.chunk(number)
        progress.done += chunk.stop - chunk.start
    progress.begun_with = progress.done
    show(progress)

    def keep(result: Result) -> None:
        with interrupts.held():
            dataset.write(plan, result.task, result.columns)
        progress.take(plan, result)
        show(progress)

    if plan.sweep.design.kind == SEARCH:
        from scenarios.sweep.search import Search

        search = Search(plan)
        for values, start in search.generations():
            missing = [task for task in _tasks(plan, values, start) if task.chunk.number not in there]
            for result in engine.run(missing):
                keep(result)
            search.tell(values, start, dataset)
        return progress
    for result in engine.run(_missing(plan, there)):
        keep(result)
    return progress


def _missing(plan: Plan, there: set[int]) -> Iterator[Task]:
    candidates = Candidates(plan)
    for block in range(plan.blocks):
        numbers = [n for n in range(block * len(plan.cases), (block + 1) * len(plan.cases)) if n not in there]
        if numbers:
            first = plan.chunk(numbers[0])
            values = candidates.values(first.start, first.stop)
            yield from (Task(plan.chunk(number), values) for number in numbers)


def _tasks(plan: Plan, values: npt.NDArray[np.float64], start: int) -> Iterator[Task]:
    """The chunks of a generation: candidates from `start` on in every case."""
    for number in range(start // plan.block * len(plan.cases), plan.chunks):
        chunk = plan.chunk(number)
        if chunk.start >= start + len(values):
            return
        yield Task(chunk, values[chunk.start - start : chunk.stop - start])
