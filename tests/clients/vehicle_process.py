"""`froude sitl` in a process of its own, as a user runs it."""

from __future__ import annotations

import itertools
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]


_BELOW_EPHEMERAL = range(12_000, 32_000)
_tried = itertools.count(os.getpid() * 37)


def free_port(count: int = 1) -> int:
    """Return the first of so many UDP ports of the loopback that nobody uses, one behind the other.

    The system gives ports of its own choice from 32768 up: one from there may be another program's a moment later.
    """
    for number in itertools.islice(_tried, 200):
        port = _BELOW_EPHEMERAL[number * 11 % (len(_BELOW_EPHEMERAL) - count)]
        if all(map(_is_free, range(port, port + count))):
            return port
    raise AssertionError(f"no {count} free ports behind one another")


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


class VehicleProcess:
    """A running `froude sitl`.

    Attributes:
        port: where its first vehicle expects its first ground station; the next vehicle is one higher.
        folder: what it printed is in sitl.log there.
    """

    def __init__(self, folder: Path, port: int, words: list[str]) -> None:
        self.port = port
        self.folder = folder
        self._log = folder / "sitl.log"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "scenarios.cli", "sitl", *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
            )
        # Compiling the control laws comes first where nobody has flown yet.
        end = time.monotonic() + 220
        while "Ctrl-C stops" not in self.printed():
            if self._process.poll() is not None or time.monotonic() > end:
                self._process.kill()
                raise AssertionError(f"froude sitl did not come up:\n{self.printed()}")
            time.sleep(0.02)

    def printed(self) -> str:
        """Return everything it has printed so far."""
        return self._log.read_text(errors="replace")

    def stop(self) -> str:
        """End it as Ctrl-C does and return its last words; may be repeated.

        Raises:
            AssertionError: it did not end in order, or a client's messages hit a defect.
        """
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            status = self._process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(timeout=10)
            raise AssertionError(f"froude sitl went on after SIGINT:\n{self.printed()}") from None
        printed = self.printed()
        assert status == 0, printed
        assert not re.search(r"defects|failed vehicles|Traceback", printed), printed
        return printed.splitlines()[-1]
