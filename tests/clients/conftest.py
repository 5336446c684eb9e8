from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
Serve = Callable[..., int]


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., int]]:
    """Start a vehicle in a process of its own; returns the free port it speaks to."""
    running: list[subprocess.Popen[bytes]] = []
    log = (tmp_path / "vehicle.log").open("wb")

    def start(*, speed: float = 1.0, mode: str = "gcs") -> int:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port: int = probe.getsockname()[1]
        running.append(
            subprocess.Popen(
                [
                    sys.executable,
                    str(Path(__file__).with_name("vehicle_process.py")),
                    str(speed),
                    f"udpout://127.0.0.1:{port}#{mode}",
                ],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            )
        )
        return port

    yield start
    for process in running:
        process.send_signal(signal.SIGTERM)
    ends = [process.wait(timeout=10) for process in running]
    log.close()
    # 1 is a defect that a client's messages hit; the log names it.
    assert ends == [0] * len(running), (tmp_path / "vehicle.log").read_text()
