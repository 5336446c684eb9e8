"""Engines: who works the chunks out. In this process, or in processes of its own; a cluster's is `cluster.py`.

An engine is given tasks one by one, as it has room for them, and gives results in whatever order they are done. A
result is the same whoever worked it out.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import count
from multiprocessing import get_context, parent_process
from typing import Protocol

from scenarios import interrupts
from scenarios.sweep.evaluation import Columns, Evaluator, Task, failed
from scenarios.sweep.plan import Plan

_IN_HAND = 2
"""Chunks of a worker: one it works on, one that waits, so that it never does."""

DIED_TWICE = "its worker died twice while working it out: out of memory?"


@dataclass(frozen=True)
class Result:
    """A chunk that is done.

    Attributes:
        task: it. columns: its rows. lost: workers that died over it.
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


_evaluator: Rows | None = None


def _begin(plan: Plan, make: Callable[[Plan], Rows]) -> None:
    """A worker keeps its evaluator: samples and matrices of a case are made once."""
    global _evaluator
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _evaluator = make(plan)


def _end_with_parent() -> None:
    """A killed parent tells nobody; a worker would wait for its next chunk for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(task: Task) -> Columns:
    assert _evaluator is not None
    return _evaluator.rows(task)


@dataclass(frozen=True)
class _Given:
    """A chunk that a worker has: order in which it was given out, to whom, workers that died over it before."""

    order: int
    worker: int
    executor: ProcessPoolExecutor
    task: Task
    lost: int


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
        self._executors: list[ProcessPoolExecutor] = []
        self._running: dict[Future[Columns], _Given] = {}
        self._again: list[tuple[Task, int]] = []

    def __enter__(self) -> Processes:
        self._executors = [self._executor() for _ in range(self.workers)]
        return self

    def __exit__(self, *_: object) -> None:
        for executor in self._executors:
            # nobody waits for a chunk that nobody will read
            for process in list((executor._processes or {}).values()):
                process.kill()
            executor.shutdown(wait=True, cancel_futures=True)
        self._executors = []

    def _executor(self) -> ProcessPoolExecutor:
        # spawn: a forked child of a process that has started Arrow's threads may hang
        return ProcessPoolExecutor(1, get_context("spawn"), initializer=_begin, initargs=(self._plan, self._make))

    def run(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Results as they come: each worker has one chunk in hand and one waiting."""
        source, orders = iter(tasks), count()
        self._running.clear()
        self._again.clear()
        for worker in range(self.workers):
            self._fill(worker, source, orders)
        while self._running:
            done, _ = wait(self._running, return_when=FIRST_COMPLETED)
            for future in sorted(done & self._running.keys(), key=lambda one: self._running[one].order):
                given = self._running.pop(future, None)
                if given is None:
                    continue  # went with its worker, a moment ago
                try:
                    yield Result(given.task, future.result(), given.lost)
                except BrokenProcessPool:
                    yield from self._replace(given)
                self._fill(given.worker, source, orders)

    def _fill(self, worker: int, source: Iterator[Task], orders: Iterator[int]) -> None:
        while sum(1 for given in self._running.values() if given.worker == worker) < _IN_HAND:
            task, lost = self._again.pop() if self._again else (next(source, None), 0)
            if task is None:
                return
            try:
                with interrupts.kept_from_children():
                    future = self._executors[worker].submit(_work, task)
            except BrokenProcessPool:
                # it died with nothing to do, or what it had is told of in a moment
                self._executors[worker] = self._executor()
                self._again.append((task, lost))
                continue
            self._running[future] = _Given(next(orders), worker, self._executors[worker], task, lost)

    def _replace(self, first: _Given) -> Iterator[Result]:
        """A worker has died: a new one takes its place, and what the old one had is given out again.

        Its executor breaks everything that it had been given. The first was in hand; what waited has done no harm.
        """
        for future in [one for one, given in self._running.items() if given.executor is first.executor]:
            given = self._running.pop(future)
            self._again.append((given.task, given.lost))
        if self._executors[first.worker] is first.executor:
            self._executors[first.worker] = self._executor()
        first.executor.shutdown(wait=True, cancel_futures=True)
        if first.lost:
            yield Result(first.task, failed(self._plan, len(first.task.values), DIED_TWICE), first.lost + 1)
        else:
            self._again.append((first.task, 1))
