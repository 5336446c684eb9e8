"""Vehicles for real ground stations: one process for the tests of a file, or one of a test's own."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

# The tests of this folder share modules that are no tests.
sys.path.insert(0, str(Path(__file__).parent))

from lossy_relay import LossyRelay
from vehicle_process import VehicleProcess, free_port

Sitl = Callable[..., VehicleProcess]


@pytest.fixture(scope="module")
def sitl(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sitl]:
    """Return the function that starts vehicles; all are stopped when the tests of the file are done."""
    running: list[VehicleProcess] = []

    def start(*words: str, speed: float = 1.0, mode: str = "onboard", count: int = 1) -> VehicleProcess:
        port = free_port(count)
        link = f"udpout://127.0.0.1:{port}{'+i' if count > 1 else ''}#{mode}"
        folder = tmp_path_factory.mktemp("sitl")
        specs = ["ant-x"] if not words or words[0].startswith("-") else []
        process = VehicleProcess(folder, port, [*specs, *words, "--speed", str(speed), "--link", link])
        running.append(process)
        return process

    with ExitStack() as stack:
        yield start
        # One that does not stop in order must not keep the others running.
        for process in running:
            stack.callback(process.stop)


@pytest.fixture
def relay() -> Iterator[Callable[..., LossyRelay]]:
    """Return the function that puts a network that loses datagrams in front of a client's port."""
    with ExitStack() as stack:

        def start(client_port: int, *, loss: float = 0.1, seed: int = 1) -> LossyRelay:
            return stack.enter_context(LossyRelay(client_port, loss, seed))

        yield start
