"""A sweep on Dask: the files of any other engine, workers that die or come late, and clusters unfit for it."""

from __future__ import annotations

import functools
import os
import random
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import distributed
import pytest

from scenarios.sweep import cluster, cluster_check
from scenarios.sweep.cluster import Dask
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.engines import InProcess
from scenarios.sweep.plan import Plan
from scenarios.sweep.sweeping import sweep_points
from sitl.errors import LinkError, UsageError
from tests.scenarios.sweeps import (
    Deadly,
    Inline,
    OnceDeadly,
    Quick,
    Slow,
    Watched,
    check_deadly,
    files,
    plan_of,
    sweep_text,
    swept,
)


@pytest.fixture(scope="module")
def quick_plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """Forty chunks for those who fly nothing."""
    return plan_of(tmp_path_factory.mktemp("sweep") / "quick.toml", sweep_text(160), block=8)


@pytest.fixture(scope="module")
def undisturbed(quick_plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Their dataset."""
    return swept(quick_plan, Inline(quick_plan, Quick), tmp_path_factory.mktemp("quick") / "one")[0]


@pytest.fixture
def scheduler() -> Iterator[distributed.LocalCluster]:
    """Somebody else's, with no workers yet; theirs would be threads of this process."""
    with cluster._quiet(), distributed.LocalCluster(
        n_workers=0, processes=False, protocol="tcp", host="127.0.0.1", dashboard_address="127.0.0.1:0",
        silence_logs=False, memory_limit=0,
    ) as theirs:  # fmt: skip
        yield theirs


def test_the_same_files(tmp_path: Path) -> None:
    plan = plan_of(tmp_path / "small.toml", sweep_text(47, margins="samples"), block=8)
    one = swept(plan, InProcess(plan, 1), tmp_path / "one")[0]
    assert len(one) == 12
    engine = Watched(Dask(plan, "local", 2))
    assert swept(plan, engine, tmp_path / "other")[0] == one
    assert engine.ahead <= 2 * engine.workers + 1  # memory does not grow with the points


def test_killed_workers(
    quick_plan: Plan, undisturbed: dict[str, bytes], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    chance = random.Random(3)
    engine = Dask(quick_plan, "local", 2, Slow)
    dataset = Dataset(tmp_path / "disturbed")
    dataset.create(quick_plan, {})
    over = threading.Event()
    killed: list[int] = []

    def strike() -> None:
        while not over.wait(chance.uniform(0.1, 0.4)) and len(killed) < 2:
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
    assert progress.done == quick_plan.points
    assert files(tmp_path / "disturbed") == undisturbed
    assert capfd.readouterr().err == ""


def test_a_chunk_that_kills_one_worker(quick_plan: Plan, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    make = functools.partial(OnceDeadly, mark=tmp_path / "mark")
    found, progress = swept(quick_plan, Dask(quick_plan, "local", 2, make), tmp_path / "disturbed")
    assert found == undisturbed
    assert progress.errors == 0


def test_a_chunk_that_kills_every_worker(
    quick_plan: Plan, undisturbed: dict[str, bytes], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its points are rows with the reason; whatever else the scheduler blamed is none the worse."""
    found, progress = swept(quick_plan, Dask(quick_plan, "local", 2, Deadly), tmp_path / "disturbed")
    check_deadly(quick_plan, found, undisturbed)
    assert progress.errors == quick_plan.block
    assert progress.done == quick_plan.points
    assert capfd.readouterr().err == ""


class TestSomebodyElsesCluster:
    def test_workers_that_come_late(
        self, scheduler: Any, quick_plan: Plan, undisturbed: dict[str, bytes], tmp_path: Path
    ) -> None:
        scheduler.scale(1)
        engine = Dask(quick_plan, scheduler.scheduler_address, 0, Slow)
        dataset = Dataset(tmp_path / "late")
        dataset.create(quick_plan, {})
        seen: set[int] = set()
        with dataset.locked(), engine:
            assert engine.workers == 1
            assert "http://127.0.0.1:" in engine.name
            scheduler.scale(2)
            sweep_points(quick_plan, dataset, engine, lambda _: seen.add(len(engine._threads)))
        assert seen == {1, 2}
        assert files(tmp_path / "late") == undisturbed

    def test_no_workers(self, scheduler: Any, quick_plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(cluster_check, "WORKERS_S", 0.2)
        with pytest.raises(LinkError, match=r"has had no workers for 0 s\. Start some: dask worker tcp://"):
            Dask(quick_plan, scheduler.scheduler_address).__enter__()

    @pytest.mark.parametrize(
        ("theirs", "text"),
        [
            ({"numpy": "1.26.4"}, r"worker tcp://\S+ has numpy 1\.26\.4, here is [\d.]+\. Results would not"),
            ({"froude": "0.0.9"}, r"worker tcp://\S+ has froude 0\.0\.9, here is"),
            ({"numba": "0.60.0"}, r"worker tcp://\S+ has numba 0\.60\.0, here is"),
        ],
    )
    def test_other_versions(
        self, scheduler: Any, quick_plan: Plan, monkeypatch: pytest.MonkeyPatch, theirs: dict[str, str], text: str
    ) -> None:
        here = cluster_check.program_facts()
        scheduler.scale(1)
        monkeypatch.setattr(
            distributed.Client,
            "run",
            lambda *_, **__: {"tcp://10.0.0.7:4000": here | {"versions": here["versions"] | theirs}},
        )
        with pytest.raises(LinkError, match=text):
            Dask(quick_plan, scheduler.scheduler_address).__enter__()

    def test_a_worker_without_froude(self, scheduler: Any, quick_plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
        scheduler.scale(1)
        missing = Exception("ModuleNotFoundError(\"No module named 'scenarios'\")")
        monkeypatch.setattr(distributed.Client, "run", lambda *_, **__: {"tcp://10.0.0.7:4000": missing})
        with pytest.raises(LinkError, match=r"worker tcp://10\.0\.0\.7:4000 cannot load froude \(.*No module named"):
            Dask(quick_plan, scheduler.scheduler_address).__enter__()

    @pytest.mark.parametrize(("package", "version"), [("distributed", "2024.1.0"), ("python", "3.10.4.final.0")])
    def test_a_scheduler_of_another_version(
        self, scheduler: Any, quick_plan: Plan, monkeypatch: pytest.MonkeyPatch, package: str, version: str
    ) -> None:
        """Nothing of ours is sent there: another Python could not even read it."""
        scheduler.scale(1)
        asked = distributed.Client.get_versions

        def answer(client: Any, **kwargs: Any) -> Any:
            found = asked(client, **kwargs)
            found["scheduler"]["packages"] = found["scheduler"]["packages"] | {package: version}
            return found

        monkeypatch.setattr(distributed.Client, "get_versions", answer)
        monkeypatch.delattr(distributed.Client, "run")
        monkeypatch.delattr(distributed.Client, "run_on_scheduler")
        with pytest.raises(LinkError, match=f"the scheduler has {package} {version}, here is"):
            Dask(quick_plan, scheduler.scheduler_address).__enter__()

    def test_it_goes(self, scheduler: Any, quick_plan: Plan, tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
        """In the middle of a sweep: what is done is kept."""
        scheduler.scale(1)
        dataset = Dataset(tmp_path / "gone")
        dataset.create(quick_plan, {})

        def end(now: Any) -> None:
            if now.done > 40:
                scheduler.close()

        with (
            dataset.locked(),
            Dask(quick_plan, scheduler.scheduler_address, 0, Slow) as engine,
            pytest.raises(LinkError, match=r"the scheduler has gone\. What is done is kept: go on with --resume"),
        ):
            sweep_points(quick_plan, dataset, engine, end)
        kept = files(tmp_path / "gone")
        assert kept.items() < undisturbed.items()


class TestAddress:
    @pytest.mark.parametrize("address", ["foo", "localhost:8786", "http://here:8786", "tcp://here", "tcp://:8786"])
    def test_is_none(self, address: str, quick_plan: Plan) -> None:
        with pytest.raises(UsageError, match=r"is no scheduler: write tcp://HOST:8786, or local"):
            Dask(quick_plan, address)

    def test_nobody_is_there(self, quick_plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(cluster_check, "CONNECT_S", 0.3)
        with pytest.raises(LinkError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers there"):
            Dask(quick_plan, "tcp://127.0.0.1:9").__enter__()

    def test_somebody_who_says_nothing(self, quick_plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(cluster_check, "CONNECT_S", 0.3)
        with socket.create_server(("127.0.0.1", 0)) as server:
            address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
            with pytest.raises(LinkError, match=r"no Dask scheduler answers there"):
                Dask(quick_plan, address).__enter__()

    def test_dask_is_not_installed(self, quick_plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda _: None)
        with pytest.raises(UsageError, match=r"--dask needs Dask.*: pip install 'froude\[cluster\]'"):
            Dask(quick_plan, "local")
