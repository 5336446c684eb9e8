"""Dask: chunks worked out by the workers of a cluster, or of one on this machine that lasts as long as the sweep.

The plan is sent once and kept by the workers. A worker that dies costs what it had in hand, which the scheduler gives
out again. It blames everything that a dead worker had for its death; so what it has given up is tried once more by
itself, with nothing else under way, before its points become rows with the reason.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import logging
import os
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from queue import Empty, SimpleQueue
from typing import Any
from uuid import uuid4

from bridge.clock import WallClock
from scenarios.sweep.cluster_check import CONNECT_S, check_workers, differs, scheduler_answers
from scenarios.sweep.engines import DIED_TWICE, Result, Rows, apart
from scenarios.sweep.evaluation import Columns, Evaluator, Task, failed
from scenarios.sweep.plan import Plan
from scenarios.sweep.program import program_facts
from sitl.errors import LinkError, UsageError

LOCAL = "local"
_IN_HAND = 2
"""Chunks of a worker's thread: one it works on, one that waits, so that it never does."""
_LOOK_EVERY_S = 1.0
"""How often the workers are counted."""
_PATIENCE_S = 60.0
"""For a cluster that has lost its last worker."""
_SILENT = logging.CRITICAL + 1


class Dask:
    """A Dask scheduler and its workers, who must have the same program and the same versions as this process.

    Args:
        plan: of the sweep. address: of the scheduler, `tcp://host:8786`; LOCAL for a cluster on this machine.
        workers: of that one; 0 takes one a core. make: makes what works chunks out, in every worker.

    Raises:
        UsageError: the address is none, or Dask is not installed.
    """

    def __init__(self, plan: Plan, address: str, workers: int = 0, make: Callable[[Plan], Rows] = Evaluator) -> None:
        if address != LOCAL and not re.fullmatch(r"(tcp|tls|ws|wss|ucx)://[^/\s]+:\d+/?", address):
            raise UsageError(f'--dask "{address}" is no scheduler: write tcp://HOST:8786, or local')
        if importlib.util.find_spec("distributed") is None:
            raise UsageError("--dask needs Dask, which is not installed: pip install 'froude[cluster]'")
        self.name = f"Dask at {address}" if address != LOCAL else "Dask on this machine"
        self.workers = workers or os.cpu_count() or 1
        self._plan, self._address, self._make = plan, address, make
        self._clock = WallClock()
        self._token = uuid4().hex[:12]
        self._next_look_us, self._lost = 0, 0

    def __enter__(self) -> Dask:
        """Connect, and look at every worker.

        Raises:
            LinkError: no scheduler, no workers, or some that are not of our versions.
        """
        with ExitStack() as stack:
            stack.enter_context(_quiet())
            self._client = stack.enter_context(self._connected())
            check_workers(self._client, self._address)
            self._threads: dict[str, int] = dict(self._client.nthreads())
            self.workers = len(self._threads)
            self._alone_since_us = self._clock.now_us()
            if self._address != LOCAL or importlib.util.find_spec("bokeh"):  # without bokeh it has nothing to show
                self.name += f", dashboard {self._client.dashboard_link}"
            self._kept = stack.pop_all()
        self._send_plan()
        return self

    def __exit__(self, *_: object) -> None:
        del self._sent  # a future that outlives its client complains
        self._kept.close()

    @contextlib.contextmanager
    def _connected(self) -> Iterator[Any]:
        from distributed import Client

        with ExitStack() as stack:
            if self._address == LOCAL:
                where: Any = stack.enter_context(_local_cluster(self.workers))
                self._local = where
            else:
                where = self._address
                asyncio.run(scheduler_answers(where))
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of versions: they are looked at more closely
                    client = Client(where, timeout=CONNECT_S, set_as_default=False, name="froude-sweep")
            except (OSError, TimeoutError) as error:
                raise LinkError(
                    f"{self._address}: the scheduler does not answer: {error}. Is it one of Dask?"
                ) from None
            stack.callback(client.close)
            yield client

    def _send_plan(self) -> None:
        # made by a task, so that it is made again where the last worker that had it has died
        key = f"froude-plan-{self._token}-{uuid4().hex[:6]}"
        self._sent = self._client.submit(_same, self._plan, key=key, pure=False)
        self._spread_plan()

    def _spread_plan(self) -> None:
        # the scheduler gives work first to those who have what it needs
        with contextlib.suppress(Exception):
            self._client.replicate([self._sent])

    def pids(self) -> list[int]:
        """Of the workers of a cluster on this machine that have started."""
        return [nanny.pid for nanny in list(self._local.workers.values()) if nanny.pid]

    def run(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Results as they come; what was given up is tried again at the end, one by one."""
        source = iter(tasks)
        given_up: list[Task] = []
        for result in self._rush(source):
            if isinstance(result, Task):
                given_up.append(result)
            else:
                yield result
        for task in given_up:
            self._send_plan()
            for result in self._rush(iter([task])):
                if isinstance(result, Task):
                    result = Result(task, failed(self._plan, len(task.values), DIED_TWICE), 1)
                yield result

    def _rush(self, source: Iterator[Task]) -> Iterator[Result | Task]:
        """Results, and the tasks that the scheduler has given up because their workers died."""
        from distributed.scheduler import KilledWorker

        running: dict[Any, Task] = {}
        done: SimpleQueue[Any] = SimpleQueue()
        try:
            self._fill(running, source, done)
            while running:
                self._look()
                try:
                    future = done.get(timeout=_LOOK_EVERY_S)
                except Empty:
                    continue
                columns: Columns | None
                try:
                    columns = self._result(future)
                except TimeoutError:
                    # it went with its worker after it was done, and is being worked out again
                    done.put(future)
                    continue
                except KilledWorker:
                    columns = None
                task = running.pop(future)
                future.release()
                if columns is None:
                    yield task
                else:
                    lost, self._lost = self._lost, 0
                    yield Result(task, columns, lost)
                self._fill(running, source, done)
        finally:
            if running:
                with contextlib.suppress(Exception):  # the cluster may be what has failed
                    self._client.cancel(list(running), force=True)

    def _fill(self, running: dict[Any, Task], source: Iterator[Task], done: SimpleQueue[Any]) -> None:
        here = program_facts()
        while len(running) < _IN_HAND * max(1, sum(self._threads.values())):
            task = next(source, None)
            if task is None:
                return
            key = f"froude-chunk-{self._token}-{task.chunk.number}-{uuid4().hex[:6]}"
            future = self._client.submit(_work, self._sent, task, self._make, here, key=key, pure=False)
            running[future] = task
            future.add_done_callback(done.put)

    def _result(self, future: Any) -> Columns:
        from distributed.client import FutureCancelledError

        try:
            columns: Columns = future.result(timeout=_LOOK_EVERY_S)
        except TimeoutError:
            raise
        except (FutureCancelledError, OSError):
            raise LinkError(
                f"{self._address}: the scheduler has gone. What is done is kept: go on with --resume"
            ) from None
        except ImportError as error:
            raise LinkError(
                f"{self._address}: a worker that has joined cannot work: {error}. Install froude there, or end it; "
                "then go on with --resume"
            ) from None
        return columns

    def _look(self) -> None:
        """Count the workers, once a second."""
        now_us = self._clock.now_us()
        if now_us < self._next_look_us:
            return
        self._next_look_us = now_us + round(_LOOK_EVERY_S * 1e6)
        try:
            found = dict(self._client.nthreads())
        except (OSError, TimeoutError, RuntimeError, ValueError):
            return  # a scheduler that has gone is told of by what it had
        if found:
            self._alone_since_us = now_us
        elif now_us - self._alone_since_us > _PATIENCE_S * 1e6:
            raise LinkError(
                f"{self._address}: has had no workers for {_PATIENCE_S:.0f} s. Start some, and go on with --resume"
            )
        if found.keys() - self._threads.keys():
            self._spread_plan()
        self._lost += len(self._threads.keys() - found.keys())
        self._threads = found


def _same(plan: Plan) -> Plan:
    return plan


_kept = threading.local()
"""Of a worker's thread: its evaluator, and the fingerprint of the plan that it is for."""


def _work(plan: Plan, task: Task, make: Callable[[Plan], Rows], theirs: dict[str, Any]) -> Columns:
    """In a worker.

    Args:
        plan: of the sweep. task: the chunk. make: of the evaluator. theirs: versions where the results are kept.

    Raises:
        LinkError: a worker that came late and is not of those versions.
    """
    if getattr(_kept, "plan", None) != plan.fingerprint:
        if wrong := differs(program_facts(), theirs, "a worker that has joined"):
            raise LinkError(f"{wrong}. End it, and go on with --resume")
        _kept.plan, _kept.evaluator = plan.fingerprint, make(plan)
    rows: Columns = _kept.evaluator.rows(task)
    return rows


@contextlib.contextmanager
def _local_cluster(workers: int) -> Iterator[Any]:
    """Worker processes below this one, for as long as this lasts."""
    import dask
    from distributed import LocalCluster

    # Nobody looks at the profile that every worker would take of itself a hundred times a second. The threads that will
    # start others later are started in this block, too.
    with dask.config.set({"distributed.worker.profile.enabled": False}), apart():
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # of this computer alone; without one Dask takes a port of all addresses
            silence_logs=_SILENT,
            memory_limit=0,  # a chunk is small; what Dask would do about memory is to spill, which has no use here
            scheduler_kwargs={"allowed_failures": 1},
        )
    try:
        yield cluster
    finally:
        # nobody waits for a chunk that nobody will read
        for nanny in cluster.workers.values():
            nanny.close_gracefully()
            if nanny.pid:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(nanny.pid, signal.SIGKILL)
        cluster.close()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Dask reports every worker that dies, with tracebacks; who sweeps is told of it in our own words."""
    import distributed  # noqa: F401  -- makes its loggers

    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in _LOGGERS]
    before = {name: logging.getLogger(name).level for name in [*_LOGGERS, *names]}
    for name in before:
        logging.getLogger(name).setLevel(_SILENT)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


_LOGGERS = ("distributed", "tornado", "asyncio")
