"""Engines: who works the chunks out. In this process, or in processes of its own; a cluster's is `cluster.py`.

An engine is given tasks one by one, as it has room for them, and gives results in whatever order they are done. A
result is the same whoever worked it out.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from multiprocessing import get_context, resource_tracker
from typing import Any, Protocol

from scenarios import interrupts
from scenarios.sweep.evaluation import Columns, Evaluator, Task, failed
from scenarios.sweep.plan import Plan
from sitl.errors import UsageError

_IN_HAND = 2
"""Chunks of a worker: one it works on, one that waits, so that it never does."""

_MOST_STILLBORN = 10
"""Workers that may die one after the other before one has finished a chunk."""

DIED_TWICE = "its worker died twice while working it out: out of memory?"


@dataclass(frozen=True)
class Result:
    """A chunk that is done.

    Attributes:
        task: it. columns: its rows. lost: workers that have died since the result before.
    """

    task: Task
    columns: Columns
    lost: int = 0


class Rows(Protocol):
    """What works chunks out: an `Evaluator`, for all but tests."""

    def rows(self, task: Task) -> Columns:
        """The rows of a chunk."""
        ...


class Engine(Protocol):
    """Works chunks out; a context manager, so that its workers end with it."""

    name: str
    workers: int

    def __enter__(self) -> Engine: ...

    def __exit__(self, *_: object) -> None: ...

    def run(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Results of tasks, in any order; only a few tasks are taken ahead of what is done."""
        ...


class InProcess:
    """In this process, by threads: nothing to start, for small sweeps.

    Args:
        plan: of the sweep. workers: threads; 0 takes every core.
    """

    name = "in-process"

    def __init__(self, plan: Plan, workers: int = 0) -> None:
        self.workers = workers or os.cpu_count() or 1
        self._plan = plan

    def __enter__(self) -> InProcess:
        self._pool = ThreadPoolExecutor(self.workers) if self.workers > 1 else None
        self._evaluator = Evaluator(self._plan, self._pool, self.workers)
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def run(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Results in the order of the tasks."""
        for task in tasks:
            yield Result(task, self._evaluator.rows(task))


@contextmanager
def apart() -> Iterator[None]:
    """Workers started in this block hear neither Ctrl-C nor that the terminal has gone: we do, and end them."""
    others = (signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()
    with interrupts.kept_from_children(*others):
        # Python's own helper is one of them. Starting it opens our ears again, so it is started first.
        resource_tracker.ensure_running()
    with interrupts.kept_from_children(*others):
        yield


_evaluator: Rows | None = None
_begun: Any = None


def _begin(plan: Plan, make: Callable[[Plan], Rows], begun: Any) -> None:
    """A worker keeps its evaluator: samples and matrices of a case are made once."""
    global _evaluator, _begun
    interrupts.end_with_parent()
    _evaluator, _begun = make(plan), begun


def _work(task: Task) -> Columns:
    assert _evaluator is not None
    _begun.value = task.chunk.number
    return _evaluator.rows(task)


class _Worker:
    """A process, and the number of the chunk that it has begun last, in memory that outlives it."""

    def __init__(self, plan: Plan, make: Callable[[Plan], Rows]) -> None:
        # spawn: a forked child of a process that has started Arrow's threads may hang
        context = get_context("spawn")
        self.begun = context.RawValue("q", -1)
        self.executor = ProcessPoolExecutor(1, context, initializer=_begin, initargs=(plan, make, self.begun))


@dataclass(frozen=True)
class _Given:
    """A chunk that a worker has: order in which it was given out, place of the worker, and how many it has killed."""

    order: int
    place: int
    worker: _Worker
    task: Task
    killed: int


class Processes:
    """Processes on this machine, each with an executor of its own: when one dies, its chunk alone is lost.

    That chunk is given out once more; the points of one that kills its worker again are rows with the reason.

    Args:
        plan: of the sweep. workers: processes; 0 takes one a core. make: makes what works chunks out, in a worker.
    """

    name = "processes"

    def __init__(self, plan: Plan, workers: int = 0, make: Callable[[Plan], Rows] = Evaluator) -> None:
        self.workers = workers or os.cpu_count() or 1
        self._plan, self._make = plan, make
        self._places: list[_Worker] = []
        self._running: dict[Future[Columns], _Given] = {}
        self._again: list[tuple[Task, int]] = []
        self._lost = self._stillborn = 0

    def __enter__(self) -> Processes:
        with apart():
            self._places = [_Worker(self._plan, self._make) for _ in range(self.workers)]
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._places:
            # nobody waits for a chunk that nobody will read
            for process in list((worker.executor._processes or {}).values()):
                process.kill()
            worker.executor.shutdown(wait=True, cancel_futures=True)
        self._places = []

    def pids(self) -> list[int]:
        """Of the workers that have started."""
        return [pid for worker in self._places for pid in list(worker.executor._processes or {})]

    def run(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Results as they come: each worker has one chunk in hand and one waiting.

        Raises:
            UsageError: no worker lives long enough to begin a chunk.
        """
        source, orders = iter(tasks), count()
        self._running.clear()
        self._again.clear()
        for place in range(self.workers):
            self._fill(place, source, orders)
        while self._running:
            done, _ = wait(self._running, return_when=FIRST_COMPLETED)
            for future in sorted(done & self._running.keys(), key=lambda one: self._running[one].order):
                given = self._running.pop(future, None)
                if given is None:
                    continue  # went with its worker, a moment ago
                try:
                    columns = future.result()
                except BrokenProcessPool:
                    yield from self._replace(given)
                else:
                    self._stillborn = 0
                    yield self._result(given.task, columns)
                self._fill(given.place, source, orders)

    def _result(self, task: Task, columns: Columns) -> Result:
        lost, self._lost = self._lost, 0
        return Result(task, columns, lost)

    def _fill(self, place: int, source: Iterator[Task], orders: Iterator[int]) -> None:
        while sum(1 for given in self._running.values() if given.place == place) < _IN_HAND:
            task, killed = self._again.pop() if self._again else (next(source, None), 0)
            if task is None:
                return
            worker = self._places[place]
            try:
                with apart():
                    future = worker.executor.submit(_work, task)
            except BrokenProcessPool:
                # it died with nothing to do, or what it had is told of in a moment
                self._renew(place)
                self._again.append((task, killed))
                continue
            self._running[future] = _Given(next(orders), place, worker, task, killed)

    def _renew(self, place: int) -> None:
        self._lost += 1
        self._stillborn += 1
        if self._stillborn > _MOST_STILLBORN:
            raise UsageError(
                f"{self._stillborn} workers, one after the other, died without finishing a chunk: out of memory? Give "
                "fewer with --jobs, and go on with --resume"
            )
        self._places[place].executor.shutdown(wait=True, cancel_futures=True)
        self._places[place] = _Worker(self._plan, self._make)

    def _replace(self, first: _Given) -> Iterator[Result]:
        """A worker has died: a new one takes its place, and what the old one had is given out again.

        Its executor breaks everything that it had been given. What it had begun is to blame; what waited has done no
        harm.
        """
        others = [one for one, given in self._running.items() if given.worker is first.worker]
        given_up = []
        for given in (first, *(self._running.pop(future) for future in others)):
            killed = given.killed + (given.task.chunk.number == first.worker.begun.value)
            if killed < 2:
                self._again.append((given.task, killed))
            else:
                given_up.append(given.task)
        if self._places[first.place] is first.worker:
            self._renew(first.place)
        for task in given_up:
            self._stillborn = 0
            yield self._result(task, failed(self._plan, len(task.values), DIED_TWICE))
