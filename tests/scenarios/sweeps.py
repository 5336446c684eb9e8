"""Small sweeps, and stand-ins for what works their chunks out: quick ones, and ones that kill their worker."""

from __future__ import annotations

import dataclasses
import io
import os
import random
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from scenarios.sweep.dataset import Dataset
from scenarios.sweep.engines import DIED_TWICE, Engine, Result, Rows
from scenarios.sweep.evaluation import ERROR, PASS, Columns, Task, failed
from scenarios.sweep.plan import Plan, make_plan
from scenarios.sweep.sweep_file import load_sweep
from scenarios.sweep.sweeping import Progress, sweep_points

SWEEP = """
title = "small"
margins = "{margins}"
samples = {samples}
seed = 3
objectives = ["rise_time_s", "overshoot_pct"]
[design]
kind = "{kind}"
points = {points}
{design}
[axes]
MC_ROLL_P = {{ from = 2.0, to = 12.0 }}
MC_ROLLRATE_P = {{ from = 0.02, to = 0.12 }}
{axes}
[[limit]]
metric = "overshoot_pct"
max = 20.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 5.0
hold_s = {hold_s}
return_s = 0.0
"""


def sweep_text(
    points: int = 48,
    *,
    kind: str = "sobol",
    samples: int = 4,
    margins: str = "none",
    hold_s: float = 2.0,
    design: str = "",
    axes: str = 'vehicle = ["ant-x", "ant-r"]',
) -> str:
    """A sweep file; `design` and `axes` are lines more."""
    return SWEEP.format(
        points=points, kind=kind, samples=samples, margins=margins, hold_s=hold_s, design=design, axes=axes
    )


def plan_of(path: Path, text: str, block: int = 0) -> Plan:
    """The plan of a sweep file, written there; `block` candidates a chunk instead of as many as half a second takes."""
    path.write_text(text, encoding="utf-8")
    plan = make_plan(load_sweep(path))
    return dataclasses.replace(plan, block=block) if block else plan


def swept(
    plan: Plan, engine: Engine, folder: Path, facts: dict[str, Any] | None = None
) -> tuple[dict[str, bytes], Progress]:
    """Every file of the dataset that an engine makes, and what was told of it; `facts` are kept beside it."""
    dataset = Dataset(folder)
    dataset.create(plan, facts or {})
    with dataset.locked(), engine as entered:
        progress = sweep_points(plan, dataset, entered)
    return files(folder), progress


def files(folder: Path) -> dict[str, bytes]:
    """Name -> bytes of every file of the points of a dataset."""
    return {path.name: path.read_bytes() for path in (folder / "points").iterdir()}


class Inline:
    """An engine that starts nothing, with a stand-in for what works; in the order given, or in one of its own."""

    name, workers = "inline", 1

    def __init__(self, plan: Plan, make: Callable[[Plan], Rows], *, shuffled: bool = False) -> None:
        self.at_work, self.shuffled = make(plan), shuffled

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, tasks: Iterable[Task]) -> Iterator[Result]:
        given = list(tasks)
        if self.shuffled:
            random.Random(5).shuffle(given)
        for task in given:
            yield Result(task, self.at_work.rows(task))


class Watched:
    """Another engine, and the order in which chunks were taken from its hands.

    Attributes:
        order: numbers of the chunks. tasks: as they were given. ahead: the most that were taken ahead of what was done.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.name, self.workers = engine.name, engine.workers
        self.order: list[int] = []
        self.tasks: list[Task] = []
        self.ahead = 0

    def __enter__(self) -> Engine:
        self.engine.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.engine.__exit__()

    def run(self, tasks: Iterable[Task]) -> Iterator[Result]:
        for result in self.engine.run(self._watched(tasks)):
            self.order.append(result.task.chunk.number)
            yield result

    def _watched(self, tasks: Iterable[Task]) -> Iterator[Task]:
        for task in tasks:
            self.tasks.append(task)
            self.ahead = max(self.ahead, len(self.tasks) - len(self.order))
            yield task


def check_deadly(plan: Plan, found: dict[str, bytes], undisturbed: dict[str, bytes]) -> None:
    """The chunk of `Deadly` is rows with the reason, and all else is as ever."""
    name = f"chunk-{Deadly.CHUNK:08d}.parquet"
    assert found.keys() == undisturbed.keys()
    assert [path for path, data in found.items() if data != undisturbed[path]] == [name]
    rows = pq.read_table(io.BytesIO(found[name])).to_pydict()
    assert rows["outcome"] == [ERROR] * plan.block
    assert rows["reason"] == [DIED_TWICE] * plan.block
    assert rows["pass_pct"] == [None] * plan.block


class Quick:
    """Rows that cost nothing and tell what they were made of."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan

    def rows(self, task: Task) -> Columns:
        columns = failed(self.plan, len(task.values), "")
        columns["outcome"][:] = PASS
        columns["pass_pct"] = np.arange(task.chunk.start, task.chunk.stop) % 101.0
        columns["rise_time_s_worst"] = task.values[:, 0] / (1 + task.chunk.case)
        return columns


class Slow(Quick):
    """Rows that take a moment: somebody can be killed over them."""

    def rows(self, task: Task) -> Columns:
        time.sleep(0.03)
        return super().rows(task)


class Shuffled(Quick):
    """Chunks that take one to five moments, in an order of their own."""

    def rows(self, task: Task) -> Columns:
        time.sleep(0.01 * (1 + task.chunk.number * 7 % 5))
        return super().rows(task)


class Deadly(Slow):
    """A chunk that kills its worker whenever it is tried, as one that takes too much memory does."""

    CHUNK = 5

    def rows(self, task: Task) -> Columns:
        if task.chunk.number == self.CHUNK:
            time.sleep(0.05)
            os.kill(os.getpid(), signal.SIGKILL)
        return super().rows(task)


class OnceDeadly(Quick):
    """A chunk that kills the first worker that tries it: the second one finds the mark that it has left."""

    def __init__(self, plan: Plan, mark: Path) -> None:
        super().__init__(plan)
        self.mark = mark

    def rows(self, task: Task) -> Columns:
        if task.chunk.number == Deadly.CHUNK and not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().rows(task)


class Stillborn(Quick):
    """A worker that dies before it has begun anything."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        os.kill(os.getpid(), signal.SIGKILL)
