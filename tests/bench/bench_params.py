"""How quickly `froude sitl` answers: PARAM_SET, the whole parameter list, and the streams of one link.

Run: make bench. The vehicle runs in real time in a process of its own; this one speaks to it over loopback UDP with a
bare socket. For comparison: a PX4 1.17 simulation sends its 859 parameters in 0.77 s on the machine that the figures
of the README come from.
"""

from __future__ import annotations

import itertools
import select
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from bridge.connection import Connection, Message

pytestmark = pytest.mark.bench

PX4_S_PER_PARAMETER = 0.77 / 859
MOST_ECHO_S = 1e-3
SETS = 500
MOST_OFF = 0.02
RATE_S = 8.0


class Station:
    """A ground station that only has a socket."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8_000_000)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.connection = Connection(255, 190, datagram=True)
        self.vehicle = ("127.0.0.1", 0)

    def send(self, name: str, **fields: object) -> None:
        self.socket.sendto(self.connection.encode(name, target_system=1, target_component=1, **fields), self.vehicle)

    def wait(self, wanted: Callable[[Message], bool], limit_s: float = 5.0) -> Message:
        """Return the first message that is wanted."""
        end = time.perf_counter() + limit_s
        while time.perf_counter() < end:
            if select.select([self.socket], [], [], 0.1)[0]:
                data, self.vehicle = self.socket.recvfrom(65_535)
                for message in self.connection.receive(data):
                    if wanted(message):
                        return message
        raise AssertionError(f"nothing of the kind within {limit_s} s")


@pytest.fixture(scope="module")
def station() -> Iterator[Station]:
    one = Station()
    command = [
        sys.executable,
        "-m",
        "scenarios.cli",
        "sitl",
        "ant-x",
        "--no-log",
        f"--link=udpout://127.0.0.1:{one.port}",
    ]
    vehicle = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    one.wait(lambda message: message.name == "HEARTBEAT", 60.0)
    yield one
    vehicle.send_signal(signal.SIGTERM)
    assert vehicle.wait(20) == 0
    one.socket.close()


def test_param_set_is_echoed(station, capsys):
    took = []
    for number in range(SETS):
        value = 5.0 + number / 1000
        start = time.perf_counter()
        station.send("PARAM_SET", param_id="MC_ROLL_P", param_value=value, param_type=9)
        station.wait(lambda m, value=value: m.name == "PARAM_VALUE" and abs(m.param_value - value) < 1e-5)
        took.append(time.perf_counter() - start)
        time.sleep(0.0013)  # at another moment of the tick each time
    took.sort()
    with capsys.disabled():
        print(
            f"\nPARAM_SET to PARAM_VALUE: median {statistics.median(took) * 1e3:.2f} ms, "
            f"95 of 100 within {took[SETS * 95 // 100] * 1e3:.2f} ms, all within {took[-1] * 1e3:.2f} ms"
        )
    assert statistics.median(took) < MOST_ECHO_S


def test_all_parameters(station, capsys):
    best = 9.0
    for _ in range(5):
        time.sleep(0.1)
        start = time.perf_counter()
        station.send("PARAM_REQUEST_LIST")
        missing: set[int] | None = None

        def news(message: Message) -> bool:
            nonlocal missing
            if message.name == "PARAM_VALUE" and message.param_index != 65535:
                missing = set(range(message.param_count)) if missing is None else missing
                missing.discard(message.param_index)
            return missing is not None and not missing

        number = station.wait(news, 20.0).param_count
        best = min(best, (time.perf_counter() - start) / number)
    with capsys.disabled():
        print(
            f"\n{number} parameters: {best * number:.3f} s, {best * 1e3:.3f} ms each "
            f"({PX4_S_PER_PARAMETER / best:.1f} times as fast as a PX4's {PX4_S_PER_PARAMETER * 1e3:.2f} ms)"
        )
    assert best < PX4_S_PER_PARAMETER


@pytest.mark.parametrize("hz", [5.0, 30.0, 50.0, 100.0, 250.0])
def test_achieved_rates(station, capsys, hz):
    station.send("COMMAND_LONG", command=511, param1=30.0, param2=1e6 / hz)
    station.wait(lambda message: message.name == "COMMAND_ACK" and message.command == 511 and message.result == 0)
    times = []
    end = time.perf_counter() + RATE_S
    while time.perf_counter() < end:
        station.wait(lambda message: message.name == "ATTITUDE")
        times.append(time.perf_counter())
    achieved = (len(times) - 1) / (times[-1] - times[0])
    gaps = sorted(after - before for before, after in itertools.pairwise(times))
    with capsys.disabled():
        print(
            f"\nATTITUDE at {hz:g} Hz: {achieved:.2f} Hz, "
            f"99 of 100 gaps within {gaps[len(gaps) * 99 // 100] * 1e3:.1f} ms"
        )
    assert abs(achieved / hz - 1.0) <= MOST_OFF
