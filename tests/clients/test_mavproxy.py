"""MAVProxy without a terminal: commands through its standard input, answers from its output."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import pytest

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

MODULES = "param,mode,arm,misc,link,output,cmdlong,ftp"


class Console:
    """A running MAVProxy."""

    def __init__(self, port: int, directory: Path) -> None:
        program = Path(sys.executable).with_name("mavproxy.py")
        if not program.exists():
            pytest.skip("MAVProxy is not installed")
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-W",
                "ignore",
                str(program),
                f"--master=udpin:127.0.0.1:{port}",
                "--mav20",
                "--streamrate=-1",
                f"--state-basedir={directory}",
                f"--default-modules={MODULES}",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=directory,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "TERM": "dumb", "HOME": str(directory)},
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        self._text = ""
        self._read_to = 0
        self._changed = threading.Condition()
        threading.Thread(target=self._read, args=(self._stdout,), daemon=True).start()

    def _read(self, stream: IO[bytes]) -> None:
        # The prompt ends without a newline, so lines cannot be waited for.
        while data := os.read(stream.fileno(), 4096):
            with self._changed:
                self._text += data.decode(errors="replace")
                self._changed.notify_all()

    def say(self, line: str) -> None:
        """Type a line; what was printed before it no longer counts."""
        with self._changed:
            self._read_to = len(self._text)
        self._stdin.write(line.encode() + b"\n")
        self._stdin.flush()

    def until(self, pattern: str, limit_s: float = 20.0) -> re.Match[str]:
        """Wait until something is printed that matches."""
        end = time.monotonic() + limit_s
        with self._changed:
            while True:
                found = re.compile(pattern).search(self._text, self._read_to)
                if found:
                    self._read_to = found.end()
                    return found
                if not self._changed.wait(max(0.0, end - time.monotonic())):
                    raise AssertionError(f"no {pattern!r} within {limit_s} s in:\n{self._text[self._read_to :]}")

    def close(self) -> None:
        """End it; a MAVProxy on a pipe does not listen to SIGTERM."""
        self._process.kill()
        self._process.wait(timeout=10)
        self._stdin.close()
        self._stdout.close()


@pytest.fixture
def console(serve: Callable[..., int], tmp_path: Path) -> Iterator[Callable[..., Console]]:
    opened: list[Console] = []

    def start(speed: float = 1.0) -> Console:
        directory = tmp_path / "mavproxy"
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir()
        opened.append(Console(serve(speed=speed), directory))
        return opened[-1]

    yield start
    for one in opened:
        one.close()


def test_parameters(console: Callable[..., Console]) -> None:
    mavproxy = console()
    received = mavproxy.until(r"Received (\d+) parameters", limit_s=60.0)
    assert int(received[1]) == len(parameter_specs())
    mavproxy.say("param show MC_ROLL_P")
    mavproxy.until(rf"MC_ROLL_P\s+{parameter_specs()['MC_ROLL_P'].default}")
    mavproxy.say("param set MC_ROLL_P 7.25")
    assert fetched(mavproxy, "MC_ROLL_P", "7.25")
    mavproxy.say("param set COM_OBL_RC_ACT 5")
    assert fetched(mavproxy, "COM_OBL_RC_ACT", "5")


def fetched(mavproxy: Console, name: str, value: str) -> bool:
    """Ask the vehicle for a parameter until it has the value: MAVProxy sets it in its own time."""
    for _ in range(20):
        mavproxy.say(f"param fetch {name}")
        if mavproxy.until(rf"{name} = (\S+)")[1].startswith(value):
            return True
        time.sleep(0.2)
    return False


def test_a_flight(console: Callable[..., Console]) -> None:
    mavproxy = console(speed=2.0)
    mavproxy.until(r"Received \d+ parameters", limit_s=60.0)
    mavproxy.say("long DO_SET_MODE 209 4 3 0 0 0 0")
    mavproxy.until(r"Got COMMAND_ACK: DO_SET_MODE: ACCEPTED")
    mavproxy.say("long DO_SET_MODE 209 1 0 0 0 0 0")
    mavproxy.until(r"Got COMMAND_ACK: DO_SET_MODE: TEMPORARILY_REJECTED")
    mavproxy.say("arm throttle")
    mavproxy.until(r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: ACCEPTED")
    mavproxy.until(r"ARMED")
    mavproxy.say("long NAV_TAKEOFF 0 0 0 nan nan nan 492")
    mavproxy.until(r"Got COMMAND_ACK: NAV_TAKEOFF: ACCEPTED")
    mavproxy.until(r"LOITER", limit_s=30.0)
    mavproxy.say("disarm")
    mavproxy.until(r"Disarming denied: not landed")
    mavproxy.say("long NAV_LAND 0 0 0 nan nan nan nan")
    mavproxy.until(r"Got COMMAND_ACK: NAV_LAND: ACCEPTED")
    mavproxy.until(r"DISARMED", limit_s=40.0)
