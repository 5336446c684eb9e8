"""Standard streams that are closed, full, or that nobody reads any more: every command does its work all the same."""

from __future__ import annotations

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.scenarios.sweeps import sweep_text
from tests.sockets import opened

ROOT = Path(__file__).parents[2]
PATIENCE_S = 60.0
CLOSED = "<&- >&- 2>&-"


def line(words: str, streams: str) -> list[str]:
    return ["bash", "-c", f"exec {shlex.quote(sys.executable)} -m scenarios.cli {words} {streams}"]


def froude(words: str, streams: str = CLOSED) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        line(words, streams), cwd=ROOT, text=True, capture_output=True, timeout=PATIENCE_S, check=False
    )


@pytest.fixture
def sweep(tmp_path: Path) -> str:
    (tmp_path / "small.toml").write_text(sweep_text(8), encoding="utf-8")
    return f"sweep {tmp_path}/small.toml --out {tmp_path}/out --engine in-process"


@pytest.mark.parametrize(
    "words", ["airframes", "model ant-x", "restore", "analyse --vehicle ant-x --gains table_2_2/ANT-X --json"]
)
def test_all_closed(words: str) -> None:
    done = froude(words)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_search_for_gains(tmp_path: Path) -> None:
    """Its files are written, and the exit status is that of the search."""
    gains = tmp_path / "gains.toml"
    done = froude(f"tune ant-x --samples 0 --profile study --gate --out {gains}")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert "[[gain_set]]" in gains.read_text(encoding="utf-8")


def test_a_sweep(sweep: str, tmp_path: Path) -> None:
    """Closed, and its result full: what there is to look at is made, and the exit status tells."""
    assert froude(sweep).returncode == 0
    (folder,) = (tmp_path / "out").iterdir()
    assert {"winner.toml", "report.html", "sweep.rrd"} <= {path.name for path in folder.iterdir()}
    full = froude(f"sweep --show {folder}", "> /dev/full")
    assert full.returncode == 2
    assert full.stderr.splitlines()[-1].startswith("froude: standard output: cannot be written: No space left on")


def test_a_sweep_whose_reader_went_away_still_gates(tmp_path: Path) -> None:
    text = sweep_text(8).replace("max = 20.0", "max = -1.0")
    (tmp_path / "small.toml").write_text(text, encoding="utf-8")
    words = f"sweep {tmp_path}/small.toml --out {tmp_path}/out --engine in-process --gate"
    done = subprocess.run(
        ["bash", "-c", f"{shlex.quote(sys.executable)} -m scenarios.cli {words} | true; exit ${{PIPESTATUS[0]}}"],
        cwd=ROOT,
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 1
    assert b"Traceback" not in done.stderr


def test_no_file_takes_the_place_of_a_stream(tmp_path: Path) -> None:
    """What a library says on standard error must not end up in a recording that got its number."""
    look = (
        "import json, os; print(json.dumps([os.readlink(f'/proc/self/fd/{n}') for n in range(3)]), file=open(OUT, 'w'))"
    )
    program = (
        f"OUT = {str(tmp_path / 'seen')!r}; from scenarios import standard_streams; standard_streams.reopen(); {look}"
    )
    command = ["bash", "-c", f"exec {shlex.quote(sys.executable)} -c {shlex.quote(program)} {CLOSED}"]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 0
    assert json.loads((tmp_path / "seen").read_text()) == [os.devnull] * 3


@pytest.mark.parametrize(
    "command", ["sitl ant-x --no-log --link tcpin://127.0.0.1:{}", "hil ant-x --link tcpin://127.0.0.1:{}"]
)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_what_serves_ends_in_order_and_its_port_is_free(command: str, number: signal.Signals) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with subprocess.Popen(line(command.format(port) + " --status", CLOSED), cwd=ROOT) as process:
        try:
            until = time.monotonic() + PATIENCE_S
            while not any(one.port == port for one in opened(process.pid)):
                assert process.poll() is None
                assert time.monotonic() < until
                time.sleep(0.02)
            with socket.create_connection(("127.0.0.1", port), PATIENCE_S):
                time.sleep(0.5)
                assert process.poll() is None
                process.send_signal(number)
                assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
    with socket.create_server(("127.0.0.1", port)):
        pass
