"""Starting a PX4 that the user has built, and being rid of it again: with a script that stands in for one."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from hil_autopilot import warm

from bridge.errors import PeerLost
from scenarios import hil_session, px4_process
from scenarios.cli import main
from scenarios.hil_flights import fly_with_autopilot
from scenarios.px4_process import Px4Process, free_instance
from scenarios.runner import RunOptions, run_scenario
from scenarios.scenario import load_scenario
from sitl.errors import FileError, UsageError

TESTS = Path(__file__).parents[1]
SOON_S = 20.0


@pytest.fixture(autouse=True)
def _own_journals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FROUDE_STATE_DIR", str(tmp_path / "state"))


@pytest.fixture(autouse=True)
def _ports_nobody_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulator that really runs on this computer must not be in the way."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        base = probe.getsockname()[1] - 20
    monkeypatch.setattr(px4_process, "SIMULATOR_PORT", base)
    monkeypatch.setattr(px4_process, "MAVLINK_PORT", base)


def build(folder: Path, script: str) -> Path:
    """A build directory whose bin/px4 is this shell script."""
    made = folder / "build"
    (made / "bin").mkdir(parents=True)
    (made / "etc").mkdir()
    binary = made / "bin" / "px4"
    binary.write_text(f"#!/bin/sh\n{script}\n")
    binary.chmod(0o755)
    return made


def until(reached: Callable[[], object]) -> None:
    end = time.monotonic() + SOON_S
    while not reached():
        assert time.monotonic() < end
        time.sleep(0.01)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # a child that nobody has waited for is dead, too
    return b") Z " not in Path(f"/proc/{pid}/stat").read_bytes()


class TestTheProcess:
    def test_how_it_is_started(self, tmp_path: Path) -> None:
        made = build(tmp_path, 'echo "arguments: $@"\necho "model: $PX4_SIM_MODEL"\npwd\nexec sleep 60')
        folder = tmp_path / "px4"
        with Px4Process(made, folder, 3) as process:
            until(lambda: str(folder) in process.log.read_text().splitlines())
            said = process.log.read_text()
            process.check()
        assert f"arguments: -d -i 3 -w {folder} {made / 'etc'}" in said
        assert "model: none_iris" in said
        assert process.simulator_url == f"tcpin://127.0.0.1:{px4_process.SIMULATOR_PORT + 3}"
        assert process.connect_url == f"udpin://127.0.0.1:{px4_process.MAVLINK_PORT + 3}"

    def test_it_gets_no_terminal_and_a_group_of_its_own(self, tmp_path: Path) -> None:
        """Ctrl-C is for us: we land first."""
        made = build(tmp_path, 'cat; echo "group $(ps -o pgid= -p $$) pid $$"; exec sleep 60')
        with Px4Process(made, tmp_path / "px4", 0) as process:
            until(lambda: "pid" in process.log.read_text())
            group, pid = re.findall(r"\d+", process.log.read_text())
        assert group == pid

    @pytest.mark.parametrize("script", ["trap '' INT TERM; echo on", "echo on"], ids=["stubborn", "polite"])
    def test_it_and_what_it_started_are_stopped(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str
    ) -> None:
        monkeypatch.setattr(px4_process, "_STOP_S", 0.3)
        made = build(tmp_path, f"{script}\nsleep 60 &\necho child $! me $$\nwait\nwait\nwait\nsleep 60")
        process = Px4Process(made, tmp_path / "px4", 0)
        process.start()
        until(lambda: "me" in process.log.read_text())
        child, me = map(int, re.findall(r"\d+", process.log.read_text()))
        process.stop()
        assert not alive(me)
        until(lambda: not alive(child))
        process.stop()  # may be repeated

    def test_one_that_dies_early_leaves_its_last_words(self, tmp_path: Path) -> None:
        made = build(tmp_path, "echo booting\necho 'ERROR no such airframe'\nexit 7")
        with Px4Process(made, tmp_path / "px4", 0) as process, pytest.raises(PeerLost) as lost:
            until(process.check)
        assert "status 7" in str(lost.value)
        assert "ERROR no such airframe" in str(lost.value)
        assert str(process.log) in str(lost.value)

    def test_one_that_dies_without_a_word(self, tmp_path: Path) -> None:
        made = build(tmp_path, "exit 1")
        with Px4Process(made, tmp_path / "px4", 0) as process, pytest.raises(PeerLost, match="printed nothing"):
            until(process.check)

    def test_what_is_no_build(self, tmp_path: Path) -> None:
        with pytest.raises(FileError, match="build directory"):
            Px4Process(tmp_path, tmp_path, 0)
        made = build(tmp_path, "")
        (made / "bin" / "px4").chmod(0o644)
        with pytest.raises(FileError, match="not executable"):
            Px4Process(made, tmp_path, 0)

    def test_what_cannot_be_run(self, tmp_path: Path) -> None:
        made = build(tmp_path, "")
        (made / "bin" / "px4").write_bytes(b"\x7fELF of another machine")
        with pytest.raises(FileError, match="cannot be started"):
            Px4Process(made, tmp_path / "px4", 0).start()

    def test_a_folder_that_cannot_be_made(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(FileError):
            Px4Process(build(tmp_path, ""), tmp_path / "file" / "px4", 0).start()


class TestInstances:
    def test_the_first_whose_ports_are_free(self) -> None:
        assert free_instance() == 0
        with socket.socket() as simulator, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as programs:
            simulator.bind(("127.0.0.1", px4_process.SIMULATOR_PORT))
            assert free_instance() == 1
            programs.bind(("127.0.0.1", px4_process.MAVLINK_PORT + 1))
            assert free_instance() == 2

    def test_all_taken(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(px4_process, "_free", lambda kind, port: False)
        with pytest.raises(UsageError, match="stop other simulators"):
            free_instance()


STAND_IN = f'''instance=$3
exec "{sys.executable}" "{TESTS / "px4_stand_in.py"}" --port $(({{base}} + instance)) \\
  --connect "udpout://127.0.0.1:$(({{base}} + instance))" --sysid $((instance + 1))'''


class TestFlights:
    def test_a_flight_with_a_px4_of_its_own(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        made = build(tmp_path, STAND_IN.format(base=px4_process.SIMULATOR_PORT))
        warm()  # what this process compiles the other need not
        monkeypatch.setattr(hil_session, "Lockstep", partial(hil_session.Lockstep, answer_s=30.0))
        monkeypatch.setattr(hil_session, "HilDrive", partial(hil_session.HilDrive, patience_s=120.0))
        scenario = tmp_path / "short.toml"
        scenario.write_text(
            'vehicle = "ant-x"\ngain_sets = ["table_2_2/ANT-X"]\ntakeoff_altitude_m = 2.5\n\n'
            '[[manoeuvre]]\nkind = "step"\namplitude_deg = 10.0\nhold_s = 1.0\nreturn_s = 0.4\n'
        )
        said: list[str] = []
        result = run_scenario(
            load_scenario(str(scenario)), RunOptions(out=tmp_path / "logs", px4=made, say=said.append, report=False)
        )
        assert result.stopped is None, said
        assert len(result.run.flights[0].telemetry) > 1000
        assert result.folder is not None
        (log,) = result.folder.rglob("px4.log")
        assert "problem" not in log.read_text()
        assert not left_over(made)

    def test_one_that_dies_at_once(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        made = build(tmp_path, "echo 'ERROR: no rcS'\nexit 3")
        assert main(["fly", "roll_step", "--px4", str(made), "--out", str(tmp_path / "logs")]) == 3
        said = capsys.readouterr().err
        assert "status 3" in said
        assert "ERROR: no rcS" in said

    def test_one_that_is_killed_in_the_middle(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        script = STAND_IN.format(base=px4_process.SIMULATOR_PORT)
        made = build(tmp_path, f"(sleep 4; echo 'PANIC: stack'; kill -9 $$) &\n{script}")
        status = main(["fly", "roll_step", "--px4", str(made), "--out", str(tmp_path / "logs")])
        said = capsys.readouterr().err
        assert status == 3, said
        assert "PANIC: stack" in said or "simulator's port" in said
        assert not left_over(made)

    def test_missing_binary(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["fly", "roll_step", "--px4", str(tmp_path), "--out", str(tmp_path / "logs")]) == 2
        assert "bin/px4" in capsys.readouterr().err


def left_over(made: Path) -> list[str]:
    """Processes that still run out of a build directory."""
    listed = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    return [line for line in listed.splitlines() if str(made) in line]


def test_nothing_is_started_for_no_jobs(tmp_path: Path) -> None:
    made = build(tmp_path, "exit 1")
    flown = fly_with_autopilot([], hil="", px4=made, say=print, progress=lambda _: None)
    assert flown.records == {}
    assert flown.stopped is None
