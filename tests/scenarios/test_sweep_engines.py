"""Engines of a sweep: the same files to the bit whoever works, in whatever order, and whoever dies over it."""

from __future__ import annotations

import functools
import os
import random
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scenarios.sweep.dataset import Dataset
from scenarios.sweep.engines import Engine, InProcess, Processes
from scenarios.sweep.evaluation import Evaluator
from scenarios.sweep.plan import Plan
from scenarios.sweep.sweeping import sweep_points
from sitl.errors import UsageError
from tests.scenarios.sweeps import (
    Deadly,
    Inline,
    OnceDeadly,
    Quick,
    Shuffled,
    Slow,
    Stillborn,
    Watched,
    check_deadly,
    files,
    plan_of,
    sweep_text,
    swept,
)


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """Twelve chunks that are really flown, with margins."""
    return plan_of(tmp_path_factory.mktemp("sweep") / "small.toml", sweep_text(47, margins="samples"), block=8)


@pytest.fixture(scope="module")
def flown(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Its dataset, by one thread."""
    return swept(plan, InProcess(plan, 1), tmp_path_factory.mktemp("flown") / "one")[0]


@pytest.fixture(scope="module")
def quick_plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """Forty chunks for those who fly nothing."""
    return plan_of(tmp_path_factory.mktemp("sweep") / "quick.toml", sweep_text(160), block=8)


@pytest.fixture(scope="module")
def undisturbed(quick_plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Their dataset."""
    return swept(quick_plan, Inline(quick_plan, Quick), tmp_path_factory.mktemp("quick") / "one")[0]


MADE: dict[str, Callable[[Plan], Engine]] = {
    "two threads": lambda plan: InProcess(plan, 2),
    "one process": lambda plan: Processes(plan, 1),
    "three processes": lambda plan: Processes(plan, 3),
    "any order": lambda plan: Inline(plan, Evaluator, shuffled=True),
}


@pytest.mark.parametrize("made", MADE.values(), ids=MADE)
def test_the_same_files(made: Callable[[Plan], Engine], plan: Plan, flown: dict[str, bytes], tmp_path: Path) -> None:
    assert len(flown) == plan.chunks == 12
    assert swept(plan, made(plan), tmp_path / "other")[0] == flown


def test_chunks_that_overtake_one_another(quick_plan: Plan, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    """The same files; and few chunks are taken ahead of what is done, so memory does not grow with the points."""
    engine = Watched(Processes(quick_plan, 3, Shuffled))
    assert swept(quick_plan, engine, tmp_path / "three")[0] == undisturbed
    assert sorted(engine.order) == list(range(quick_plan.chunks))
    assert engine.order != sorted(engine.order)
    assert engine.ahead <= 2 * engine.workers + 1


def test_killed_workers(quick_plan: Plan, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    """Workers die at any moment, some before they have begun anything; the files do not show it."""
    chance = random.Random(2)
    engine = Processes(quick_plan, 2, Slow)
    dataset = Dataset(tmp_path / "disturbed")
    dataset.create(quick_plan, {})
    over = threading.Event()
    killed: list[int] = []

    def strike() -> None:
        while not over.wait(chance.uniform(0.05, 0.3)) and len(killed) < 3:
            there = [pid for pid in engine.pids() if pid not in killed]
            if there and list((tmp_path / "disturbed" / "points").iterdir()):
                killed.append(chance.choice(there))
                os.kill(killed[-1], signal.SIGKILL)

    with dataset.locked(), engine:
        killer = threading.Thread(target=strike)
        killer.start()
        try:
            progress = sweep_points(quick_plan, dataset, engine)
        finally:
            over.set()
            killer.join()
    assert killed
    assert progress.lost_workers <= len(killed)
    assert progress.done == quick_plan.points
    assert files(tmp_path / "disturbed") == undisturbed


def test_a_chunk_that_kills_one_worker(quick_plan: Plan, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    make = functools.partial(OnceDeadly, mark=tmp_path / "mark")
    found, progress = swept(quick_plan, Processes(quick_plan, 2, make), tmp_path / "disturbed")
    assert found == undisturbed
    assert progress.lost_workers == 1
    assert progress.errors == 0


def test_a_chunk_that_kills_every_worker(quick_plan: Plan, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    """Its points are rows with the reason; those that waited behind it are none the worse."""
    found, progress = swept(quick_plan, Processes(quick_plan, 2, Deadly), tmp_path / "disturbed")
    check_deadly(quick_plan, found, undisturbed)
    assert progress.lost_workers == 2
    assert progress.errors == quick_plan.block
    assert progress.done == quick_plan.points


def test_workers_that_die_as_they_start(quick_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No chunk is to blame, and nobody tries for ever."""
    monkeypatch.setattr("scenarios.sweep.engines._MOST_STILLBORN", 1)
    with pytest.raises(UsageError, match=r"2 workers, one after the other, died .* Give fewer with --jobs"):
        swept(quick_plan, Processes(quick_plan, 1, Stillborn), tmp_path / "none")
    assert not files(tmp_path / "none")


def test_stopped_in_the_middle(quick_plan: Plan, tmp_path: Path) -> None:
    """Nobody waits for what is in hand, and no worker is left; one that died with nothing to do is replaced."""
    ears = Watched(Inline(quick_plan, Quick))
    swept(quick_plan, ears, tmp_path / "ears")
    with Processes(quick_plan, 2, Slow) as engine:
        assert len(list(engine.run(ears.tasks[:4]))) == 4
        before = engine.pids()
        os.kill(before[0], signal.SIGKILL)
        wait_for(lambda: not alive(before[0]))
        next(engine.run(ears.tasks))
        now = engine.pids()
        assert len(now) == 2
        assert before[0] not in now
        start = time.monotonic()
    assert time.monotonic() - start < 5.0
    wait_for(lambda: not any(alive(pid) for pid in now))


def alive(pid: int) -> bool:
    """A process that is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition: Callable[[], Any]) -> None:
    for _ in range(500):
        if condition():
            return
        time.sleep(0.02)
    pytest.fail("never came")
