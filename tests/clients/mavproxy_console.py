"""MAVProxy without a terminal: commands through its standard input, answers from its output."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import pytest

MODULES = "param,mode,arm,misc,link,output,cmdlong,wp,log,signing"


class Console:
    """A running MAVProxy; files it writes or reads without a path are in `folder`."""

    def __init__(self, port: int, folder: Path, *, modules: str = MODULES) -> None:
        program = Path(sys.executable).with_name("mavproxy.py")
        if not program.exists():
            pytest.skip("MAVProxy is not installed")
        self.folder = folder
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-W",
                "ignore",
                str(program),
                f"--master=udpin:127.0.0.1:{port}",
                "--mav20",
                "--streamrate=-1",
                f"--state-basedir={folder}",
                f"--default-modules={modules}",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=folder,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "TERM": "dumb", "HOME": str(folder)},
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        self._text = ""
        self._read_to = 0
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, args=(self._stdout,), daemon=True)
        self._reader.start()

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
        """Wait until something is printed that matches; what was printed up to its end no longer counts."""
        end = time.monotonic() + limit_s
        with self._changed:
            while True:
                found = re.compile(pattern).search(self._text, self._read_to)
                if found:
                    self._read_to = found.end()
                    return found
                if not self._changed.wait(max(0.0, end - time.monotonic())):
                    raise AssertionError(f"no {pattern!r} within {limit_s} s in:\n{self._text[self._read_to :]}")

    def parameters(self, limit_s: float = 60.0) -> int:
        """Wait for the parameters that it fetches by itself; returns how many."""
        return int(self.until(r"Received (\d+) parameters", limit_s)[1])

    def fetched(self, name: str, value: str) -> bool:
        """Ask the vehicle for a parameter until it has the value: MAVProxy sets it in its own time."""
        for _ in range(20):
            self.say(f"param fetch {name}")
            if self.until(rf"{name} = (\S+)")[1].startswith(value):
                return True
            time.sleep(0.2)
        return False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # On a pipe it does not listen to SIGTERM.
        self._process.kill()
        self._process.wait(timeout=10)
        self._reader.join(timeout=5)
        self._stdin.close()
        self._stdout.close()
