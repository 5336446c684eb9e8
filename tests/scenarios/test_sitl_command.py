"""`froude sitl`: what it prints where, how it ends, and what it says when something is wrong."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bridge.connection import Connection
from bridge.udp_link import UdpLink
from scenarios import cli
from scenarios.cli import main
from sitl.vehicle import Vehicle

SOON_S = 60.0

Sitl = Callable[..., tuple[int, str, str]]


@pytest.fixture
def sitl(capsys: pytest.CaptureFixture[str]) -> Sitl:
    """Runs `froude sitl` in this process; (exit status, standard output, standard error)."""

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            logs = () if "--log-dir" in words else ("--no-log",)
            status = main(["sitl", *map(str, words), *logs])
        except SystemExit as end:
            status = int(end.code or 0)
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def ends_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first vehicle asks for the end of the process in its 50th tick."""
    step = Vehicle.step

    def interrupted_step(vehicle: Vehicle) -> None:
        if vehicle.tick == 50:
            os.kill(os.getpid(), signal.SIGTERM)
        step(vehicle)

    monkeypatch.setattr(Vehicle, "step", interrupted_step)
    monkeypatch.setattr("sitl.vehicle.warm_up", lambda *_: None)  # the first vehicle would be its own


class Ear:
    """A ground station's socket."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.systems: set[int] = set()

    def wait_for(self, systems: set[int]) -> None:
        while not systems <= self.systems:
            assert select.select([self.socket], [], [], SOON_S)[0], f"only heard {self.systems}"
            self.systems.add(self.socket.recv(65_535)[5])


@pytest.fixture
def ear() -> Iterator[Ear]:
    one = Ear()
    yield one
    one.socket.close()


@pytest.mark.usefixtures("ends_soon")
class TestServes:
    def test_one_vehicle(self, sitl: Sitl, ear: Ear) -> None:
        status, out, err = sitl("ant-x", "--instance", 6, "--speed", "max", "--link", f"udpout://127.0.0.1:{ear.port}")
        assert status == 0
        assert out.splitlines()[0] == f"ANT-X is system 7, serving ground station at udpout://127.0.0.1:{ear.port}"
        assert out.splitlines()[1:] == ["Ctrl-C stops it."]
        (last,) = [line for line in err.splitlines() if "compiling" not in line]
        assert last.startswith("froude: served 0.2 s")
        ear.wait_for({7})

    def test_a_fleet(self, sitl: Sitl, ear: Ear) -> None:
        url = f"udpout://127.0.0.1:{ear.port}#onboard"
        status, out, err = sitl("ant-x*2", "ant-r:adam-0", "--instance", 3, "--speed", "max", "--link", url)
        assert status == 0
        assert [line.split(",")[0] for line in out.splitlines()[:3]] == [
            "ANT-X is system 4",
            "ANT-X is system 5",
            "ANT-R:ADAM-0 is system 6",
        ]
        assert out.splitlines()[3] == "3 vehicles; Ctrl-C stops them."
        assert "3 vehicles: 3 Hold, 0 armed" in err
        ear.wait_for({4, 5, 6})

    def test_a_link_that_others_reach_is_warned_of(self, sitl: Sitl) -> None:
        status, _, err = sitl("ant-x", "--speed", "max", "--link", "udpin://0.0.0.0:0")
        assert status == 0
        assert "froude: warning: open to other computers: every address of this computer, port" in err

    def test_so_is_bind(self, sitl: Sitl) -> None:
        words = ("ant-x*2", "--instance", 240, "--speed", "max")
        status, _, err = sitl(*words, "--bind", "0.0.0.0")
        assert status == 0
        assert "port 14820-14821, 18810-18811. Whoever reaches it can arm, fly and change every parameter" in err
        assert "warning" not in sitl(*words)[2]

    def test_a_vehicle_that_fails_shows_in_the_exit_status(
        self, sitl: Sitl, ear: Ear, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        step = Vehicle.step

        def fail(vehicle: Vehicle) -> None:
            if vehicle.tick == 10 and vehicle.model.name == "ANT-R":
                raise ZeroDivisionError("no mass")
            step(vehicle)

        monkeypatch.setattr(Vehicle, "step", fail)
        words = ("ant-x", "ant-r", "--speed", "max", "--link", f"udpout://127.0.0.1:{ear.port}")
        status, _, err = sitl(*words)
        assert status == 3
        assert "froude: system 2 failed and is no longer served: ZeroDivisionError: no mass" in err
        assert "served 0.2 s" in err


class TestMistakes:
    """One line that names the thing and the remedy, nothing on standard output, exit status 2 or 3."""

    @pytest.mark.parametrize(
        ("words", "says"),
        [
            (["ant-z"], "ant-z"),
            (["ant-x", "ant-z*3"], "ant-z"),
            (["ant-x*0"], "ant-x*0: 0 vehicles; give a number from 1 to 255"),
            (["ant-x*255", "ant-r"], "256 vehicles"),
            (["ant-x", "--instance", "-1"], "--instance -1: choose one from 0 to 254"),
            (["ant-x", "--instance", "255"], "--instance 255: choose one from 0 to 254"),
            (["ant-x*2", "--instance", "254"], "Start at most 1 of them"),
            (["ant-x", "--speed", "0"], "--speed 0"),
            (["ant-x", "--speed", "fast"], "--speed fast: give a number above 0, or 'max'"),
            (["ant-x", "--seed", "-1"], "--seed -1: give 0 or more"),
            (["ant-x", "--bind", "::"], "--bind ::: give an IPv4 address"),
            (["ant-x", "--bind", "192.0.2.1"], "cannot listen on 192.0.2.1:18570"),
            (["ant-x", "--bind", "0.0.0.0", "--link", "udpin://127.0.0.1:1"], "--link replaces those"),
            (["ant-x", "ant-r", "--link", "udpin://127.0.0.1:14550"], "2 vehicles cannot share it. Write +i"),
            (["ant-x", "--link", "udp://x"], "unknown kind 'udp'"),
            (["ant-x", "--link", "udpin://127.0.0.1:65535+i", "--instance", "1"], "not a number from 0 to 65535"),
            (["ant-x", "--state", "{tmp}"], "is a folder. Give --state a file"),
            (["ant-x", "--log-dir", "{tmp}/no/logs"], "its parent folder does not exist"),
            (["ant-x", "--signing-key", "{tmp}/no"], "no such key file"),
        ],
    )
    def test_options(self, sitl: Sitl, tmp_path: Path, words: list[str], says: str) -> None:
        status, out, err = sitl(*[word.format(tmp=tmp_path) for word in words])
        assert (status, out) == (2, "")
        err = "".join(line for line in err.splitlines(keepends=True) if "compiling" not in line)
        assert err.count("\n") == 1
        assert err.startswith("froude: ")
        assert says in err

    def test_a_busy_port(self, sitl: Sitl) -> None:
        with UdpLink.listen("127.0.0.1", 0) as busy:
            status, out, err = sitl("ant-x", "--instance", 2, "--link", f"udpin://127.0.0.1:{busy.port}")
            assert (status, out) == (3, "")
            assert f"froude: instance 2: 127.0.0.1:{busy.port} is in use by another program" in err

    def test_no_vehicle(self, sitl: Sitl) -> None:
        status, out, err = sitl()
        assert (status, out) == (2, "")
        assert "--help" in err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_fleet_of_its_own_ends_in_order(ear: Ear, number: signal.Signals) -> None:
    url = f"udpout://127.0.0.1:{ear.port}"
    command = [sys.executable, "-m", "scenarios.cli", "sitl", "ant-x*2", "--no-log", "--link", url, "--status"]
    with subprocess.Popen(
        command, cwd=Path(cli.__file__).parents[1], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as fleet:
        ear.wait_for({1, 2})
        ear.socket.sendto(b"\xfd not a message", ear.socket.recvfrom(65_535)[1])
        ear.socket.sendto(Connection(255, 190).encode("HEARTBEAT", type=6), ear.socket.recvfrom(65_535)[1])
        assert fleet.stderr is not None
        line = fleet.stderr.readline()
        while "vehicles" not in line:
            line = fleet.stderr.readline()
        fleet.send_signal(number)
        _, err = fleet.communicate(timeout=20)
    assert fleet.returncode == 0
    assert "2 vehicles: 2 Hold, 0 armed" in line
    assert "received 1  bad bytes 15" in err.splitlines()[-1]
