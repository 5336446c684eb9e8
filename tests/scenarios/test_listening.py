"""Who listens where: every command that opens a port, looked at from outside; what is said when it opens wider."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from sockets import Opened, opened

from bridge.exposure import exposed, warnings

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="sockets are looked up in /proc")
PATIENCE_S = 150.0  # the control laws may have to be compiled first
LOOPBACK, ANY = "127.0.0.1", "0.0.0.0"


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def free_instance() -> int:
    """A PX4 instance whose ports nobody has."""
    for instance in range(60 + os.getpid() % 100, 250):
        wanted = [(socket.SOCK_DGRAM, 18570), (socket.SOCK_DGRAM, 14580), (socket.SOCK_STREAM, 4560)]
        try:
            for kind, first in wanted:
                with socket.socket(socket.AF_INET, kind) as probe:
                    probe.bind((LOOPBACK, first + instance))
        except OSError:
            continue
        return instance
    raise AssertionError("no free instance")


class Command:
    """A froude in a process of its own.

    Attributes:
        seen: every socket that it had open at some time.
    """

    def __init__(self, folder: Path, *words: str) -> None:
        self.seen: set[Opened] = set()
        self._log = folder / "printed"
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "scenarios.cli", *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env={
                    **os.environ,
                    "PYTHONPATH": str(ROOT),
                    "PYTHONUNBUFFERED": "1",
                    "DISPLAY": "",
                    "WAYLAND_DISPLAY": "",
                },
                start_new_session=True,
            )

    def printed(self) -> str:
        return self._log.read_text(errors="replace")

    def look(self) -> set[Opened]:
        self.seen |= (now := opened(self.process.pid))
        return now

    def wait_for(self, text: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while text not in self.printed():
            assert self.process.poll() is None, self.printed()
            assert time.monotonic() < end, self.printed()
            self.look()
            time.sleep(0.05)
        self.look()

    def run_out(self) -> None:
        """Look on until it ends."""
        end = time.monotonic() + PATIENCE_S
        while self.process.poll() is None:
            assert time.monotonic() < end, self.printed()
            self.look()
            time.sleep(0.02)


@contextmanager
def froude(folder: Path, *words: str) -> Iterator[Command]:
    command = Command(folder, *words)
    try:
        yield command
    finally:
        if command.process.poll() is None:
            command.process.send_signal(signal.SIGINT)
            try:
                command.process.wait(20)
            except subprocess.TimeoutExpired:
                os.killpg(command.process.pid, signal.SIGKILL)
                command.process.wait(10)


def test_sitl_is_on_the_loopback(tmp_path: Path) -> None:
    instance = free_instance()
    with froude(tmp_path, "sitl", "ant-x", "--instance", str(instance), "--no-log") as command:
        command.wait_for("Ctrl-C stops")
        ports = {("udp", 18570 + instance), ("udp", 14580 + instance)}
        assert {(one.kind, one.port) for one in command.look()} == ports
        assert all(one.host == LOOPBACK for one in command.seen), command.seen
        assert "open to" not in command.printed()


def test_sitl_opened_wider_says_what_is_open(tmp_path: Path) -> None:
    instance = free_instance()
    with froude(tmp_path, "sitl", "ant-x", "--instance", str(instance), "--no-log", "--bind", ANY) as command:
        command.wait_for("Ctrl-C stops")
        assert {one.host for one in command.look()} == {ANY}
        (line,) = [line for line in command.printed().splitlines() if "open to other computers" in line]
        assert all(str(port + instance) in line for port in (18570, 14580))
        assert "can arm, fly and change every parameter" in line
        assert "--signing-key" in line


def test_sitl_on_links_of_the_users_own(tmp_path: Path) -> None:
    links = [f"{kind}://127.0.0.1:{free_port()}" for kind in ("tcpin", "udpin", "udpout")]
    with froude(
        tmp_path, "sitl", "ant-x", "--no-log", *(word for link in links for word in ("--link", link))
    ) as command:
        command.wait_for("Ctrl-C stops")
        time.sleep(0.2)  # something was sent
        assert len(command.look()) == 3
        assert all(one.loopback for one in command.seen), command.seen


@pytest.mark.parametrize("host", [LOOPBACK, ANY])
@pytest.mark.parametrize("kind", ["tcpin", "json"])
def test_hil(tmp_path: Path, host: str, kind: str) -> None:
    port = free_port()
    with froude(tmp_path, "hil", "ant-x", "--link", f"{kind}://{host}:{port}") as command:
        command.wait_for("waits for a")
        assert command.look() == {Opened("tcp" if kind == "tcpin" else "udp", host, port)}
        told = [line for line in command.printed().splitlines() if "open to other computers" in line]
        assert [str(port) in line for line in told] == [True] * (host == ANY)


def test_hil_by_itself_is_on_the_loopback(tmp_path: Path) -> None:
    instance = free_instance()
    with froude(tmp_path, "hil", "ant-x", "--instance", str(instance)) as command:
        command.wait_for("waits for a PX4")
        assert command.look() == {Opened("tcp", LOOPBACK, 4560 + instance)}


def test_a_flight_with_a_live_view_is_on_the_loopback(tmp_path: Path) -> None:
    with froude(
        tmp_path, "fly", "roll_step", "--gains", "table_2_2/ANT-X", "--live", "--out", str(tmp_path)
    ) as command:
        command.run_out()
        assert command.process.returncode == 0, command.printed()
        assert any(one.kind == "tcp" for one in command.seen)
        assert all(one.loopback for one in command.seen), command.seen


def test_a_flight_in_memory_opens_nothing(tmp_path: Path) -> None:
    with froude(tmp_path, "fly", "roll_step", "--gains", "table_2_2/ANT-X", "--out", str(tmp_path)) as command:
        command.run_out()
        assert command.process.returncode == 0, command.printed()
        assert not command.seen


@pytest.mark.parametrize("host", [LOOPBACK, ANY])
def test_a_flight_over_a_link_says_if_others_can_reach_it(tmp_path: Path, host: str) -> None:
    port = free_port(socket.SOCK_DGRAM)
    words = (
        "fly",
        "roll_step",
        "--gains",
        "table_2_2/ANT-X",
        "--out",
        str(tmp_path),
        "--connect",
        f"udpin://{host}:{port}",
    )
    with froude(tmp_path, *words) as command:
        command.run_out()
        assert command.process.returncode == 3
        assert command.seen == {Opened("udp", host, port)}
        assert (f"open to other computers: {host} port {port}; whoever" in command.printed()) is (host == ANY)


@pytest.mark.parametrize(
    ("url", "where"),
    [
        ("udpin://127.0.0.1:14550", ""),
        ("udpin://:14550", ""),
        ("udpin://localhost:14550", ""),
        ("udpin://[::1]:14550", ""),
        ("udpin://127.8.9.1:14550", ""),
        ("udpin://0.0.0.0:14550", "0.0.0.0 port 14550"),
        ("tcpin://[::]:4560", ":: port 4560"),
        ("tcpin://192.0.2.7:4560", "192.0.2.7 port 4560"),
        ("tcpin://a.name:4560", "a.name port 4560"),
        ("json://0.0.0.0:9002", "0.0.0.0 port 9002"),
        ("udpout://192.0.2.7:14550", ""),
        ("tcpout://192.0.2.7:14550", ""),
        ("udpout://127.0.0.1:14550?local=18570#gcs", ""),
        ("udpout://127.0.0.1:14550?local=18570&bind=0.0.0.0#gcs", "0.0.0.0 port 18570"),
        ("udpout://192.0.2.7:14550?local=18570", "0.0.0.0 port 18570"),
        ("serial:///dev/ttyACM0:921600", ""),
        ("memory://", ""),
        ("udpin://[::1:1", ""),
    ],
)
def test_an_address_tells_whom_it_lets_in(url: str, where: str) -> None:
    assert exposed(url) == where
    assert warnings([url, url], "beware") == [f"warning: open to other computers: {where}; beware"] * bool(where)
