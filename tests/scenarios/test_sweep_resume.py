"""Sweeps that end badly and go on: killed at any moment, interrupted, on a full disk."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from scenarios.cli import main
from scenarios.sweep import dataset
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.engines import InProcess
from scenarios.sweep.plan import make_plan
from scenarios.sweep.resuming import difference
from scenarios.sweep.sweep_file import load_sweep
from tests.scenarios.sweeps import files, plan_of, sweep_text, swept

ROOT = Path(__file__).parents[2]
CHUNK_STEPS = 150_000
"""Small chunks: many of them are soon done."""
START = f"""
import sys
from scenarios.sweep import plan
plan.CHUNK_STEPS = {CHUNK_STEPS}
from scenarios.sweep import sweep_command
sweep_command._show = lambda *_: 0
from scenarios.cli import main
sys.exit(main())
"""
ENGINES = {
    "in-process": ("--engine", "in-process"),
    "processes": ("--engine", "processes", "--jobs", "2"),
    "dask": ("--dask", "local", "--jobs", "2"),
}
PATIENCE_S = 120.0


class Sweeping:
    """`froude sweep` as a user starts it, and every process that comes of it."""

    def __init__(self, *words: object) -> None:
        self.mark = uuid.uuid4().hex
        self.process = subprocess.Popen(
            [sys.executable, "-c", START, "sweep", *map(str, words)],
            cwd=ROOT,
            env={**os.environ, "FROUDE_TEST_MARK": self.mark},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # a terminal of its own, as far as signals go
        )

    def processes(self) -> list[int]:
        """Its own and its workers', by what they inherit."""
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                alive = (path / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
                if alive and self.mark.encode() in (path / "environ").read_bytes():
                    found.append(int(path.name))
        return found

    def ended(self) -> tuple[int, str]:
        """Exit status and standard error; nothing of it may be left running."""
        try:
            _, err = self.process.communicate(timeout=PATIENCE_S)
            wait_for(lambda: not self.processes(), "the end of its workers")
        finally:
            for pid in self.processes():
                os.kill(pid, signal.SIGKILL)
        assert "Traceback" not in err
        return self.process.returncode, err


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        if found := condition():
            return found
        time.sleep(0.005)
    return pytest.fail(f"never saw {what}")


def chunks(folder: Path) -> int:
    return len(list((folder / "points").glob("*.parquet")))


def folder_of(out: Path) -> Path | None:
    """The only sweep's, once it has begun."""
    return next((path.parent for path in out.glob("*/sweep.json")), None)


@pytest.fixture(scope="module")
def long_sweep(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """A sweep of 160 chunks, and what comes of it undisturbed."""
    folder = tmp_path_factory.mktemp("long")
    path = folder / "long.toml"
    path.write_text(sweep_text(400, samples=50), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenarios.sweep.plan.CHUNK_STEPS", CHUNK_STEPS)
        plan = make_plan(load_sweep(path))
    assert plan.chunks == 160
    return path, swept(plan, InProcess(plan, 1), folder / "undisturbed")[0]


def test_killed_at_any_moment(long_sweep: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    """kill -9, again and again, under every engine: nothing is lost, nothing is done twice, nobody is left."""
    path, undisturbed = long_sweep
    chance = random.Random(11)
    out = tmp_path / "out"
    ways = [path, "--out", out]
    for kill in range(4):
        engine = ENGINES[list(ENGINES)[kill % len(ENGINES)]]
        sweeping = Sweeping(*ways, *engine)
        folder = wait_for(lambda: folder_of(out), "its folder")
        before, more = chunks(folder), chance.randrange(1, 40)
        wait_for(lambda at=folder, many=before + more: chunks(at) >= many, "chunks")
        time.sleep(chance.uniform(0.0, 0.03))
        sweeping.process.kill()
        sweeping.ended()
        kept = {name: data for name, data in files(folder).items() if name.endswith(".parquet")}
        assert before < len(kept) < len(undisturbed)
        assert kept.items() <= undisturbed.items()
        ways = ["--resume", folder]
    status, err = Sweeping(*ways, *ENGINES["processes"]).ended()
    assert status == 0, err
    assert "of them done before" in err
    assert files(folder) == undisturbed
    assert len(list(out.iterdir())) == 1


@pytest.mark.parametrize(
    ("number", "engine", "all_of_it"),
    [
        (signal.SIGTERM, "processes", False),
        (signal.SIGINT, "processes", True),  # Ctrl-C reaches all that a terminal has started
        (signal.SIGHUP, "dask", True),
        (signal.SIGTERM, "in-process", False),
    ],
)
def test_interrupted(
    number: int, engine: str, all_of_it: bool, long_sweep: tuple[Path, dict[str, bytes]], tmp_path: Path
) -> None:
    """It stops soon, keeps what is done and says how to go on."""
    path, undisturbed = long_sweep
    out = tmp_path / "out"
    sweeping = Sweeping(path, "--out", out, *ENGINES[engine])
    folder = wait_for(lambda: folder_of(out), "its folder")
    wait_for(lambda: chunks(folder) >= 3, "chunks")
    if all_of_it:
        os.killpg(sweeping.process.pid, number)
    else:
        sweeping.process.send_signal(number)
    start = time.monotonic()
    sweeping.process.wait(PATIENCE_S)
    assert time.monotonic() - start < 10.0  # a second where the machine has nothing else to do
    status, err = sweeping.ended()
    assert status == 130
    assert f"stopped; what is done is kept. Go on with: froude sweep --resume {folder}" in err
    kept = files(folder)
    assert 3 <= len(kept) < len(undisturbed)
    assert kept.items() <= undisturbed.items()


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of a sweep of twelve chunks; what came of it is shown elsewhere."""
    monkeypatch.setattr("scenarios.sweep.plan.CHUNK_STEPS", 20_000)
    monkeypatch.setattr("scenarios.sweep.sweep_command._show", lambda *_: 0)
    path = tmp_path / "small.toml"
    path.write_text(sweep_text(48), encoding="utf-8")
    return path


def froude(*words: object) -> int:
    return main(["sweep", *map(str, words)])


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """All that was said, but for what is being done."""
    out, err = capsys.readouterr()
    assert out == ""
    lines = [line for line in err.splitlines() if not re.search(r" points.*; \d+ workers?, ", line)]
    assert len(lines) == 1, err
    return lines[0]


@pytest.fixture
def whole(small: Path, tmp_path: Path) -> dict[str, bytes]:
    """What comes of it undisturbed."""
    plan = make_plan(load_sweep(small))
    return swept(plan, InProcess(plan, 1), tmp_path / "undisturbed")[0]


def test_it_goes_on(small: Path, whole: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By its folder, by its file or as the newest; what is not whole is done again, and nothing else."""
    assert froude(small, "--out", tmp_path / "out") == 0
    folder = folder_of(tmp_path / "out")
    assert folder is not None
    assert files(folder) == whole
    begun = Dataset(folder)
    begun.file(2).unlink()
    begun.file(9).write_bytes(begun.file(9).read_bytes()[:-40])
    (begun.points / "chunk-00000002.parquet.part").write_bytes(b"PAR1")
    capsys.readouterr()
    assert froude("--resume", "--out", tmp_path / "out") == 0
    assert "96 points, 80 of them done before; " in capsys.readouterr().err
    assert files(folder) == whole
    begun.file(3).unlink()
    before = begun.file(4).stat().st_mtime_ns
    assert froude(small, "--resume", "--out", tmp_path / "out") == 0
    assert froude("--resume", folder) == 0
    assert files(folder) == whole
    assert begun.file(4).stat().st_mtime_ns == before


class TestFullDisk:
    @pytest.fixture
    def full(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
        """From the n-th file on, nothing reaches the disk any more."""
        synced = os.fsync

        def begin(after: int) -> None:
            count = 0

            def fsync(handle: int) -> None:
                nonlocal count
                if Path(f"/proc/self/fd/{handle}").readlink().suffix == ".part":
                    count += 1
                    if count > after:
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                synced(handle)

            monkeypatch.setattr(dataset.os, "fsync", fsync)

        yield begin
        monkeypatch.undo()

    def test_in_the_middle(
        self,
        small: Path,
        whole: dict[str, bytes],
        tmp_path: Path,
        full: Callable[[int], None],
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        full(5)
        assert froude(small, "--out", tmp_path / "out") == 2
        line = one_line(capsys)
        assert "chunk-00000004.parquet: cannot be written: No space left on device. Free some space, then go" in line
        folder = folder_of(tmp_path / "out")
        assert folder is not None
        assert len(files(folder)) == 4
        full(1000)
        assert froude("--resume", folder) == 0
        assert files(folder) == whole

    def test_before_it_has_begun(
        self, small: Path, tmp_path: Path, full: Callable[[int], None], capsys: pytest.CaptureFixture[str]
    ) -> None:
        full(0)
        assert froude(small, "--out", tmp_path / "out") == 2
        assert "sweep.json: cannot be written: No space left on device. Free some space, or choose" in one_line(capsys)
        assert list((tmp_path / "out").iterdir()) == []


def test_chunks_of_another_sweep_are_done_again(tmp_path: Path) -> None:
    plan = plan_of(tmp_path / "small.toml", sweep_text(16), block=8)
    other = plan_of(tmp_path / "other.toml", sweep_text(16, samples=5), block=8)
    swept(other, InProcess(other, 1), tmp_path / "one")
    assert Dataset(tmp_path / "one").done(other) == {0, 1, 2, 3}
    assert Dataset(tmp_path / "one").done(plan) == set()


def test_difference_is_the_first() -> None:
    assert difference({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}) == "a[1].b was 2, is 3"
    assert difference({"a": 1}, {}) == "a was 1, is null"
