"""Whether twenty vehicles on one core keep real time and their stream rates, and what of the core they use.

Run: make bench. The fleet runs in a process of its own, kept on one core; this one listens on the other side of
loopback sockets. Achieved rates are compared with what PX4's defaults ask for, side by side in one flight.
"""

from __future__ import annotations

import os
import resource
import select
import signal
import socket
import subprocess
import sys
import time
from collections import Counter

import pytest

from bridge.messages import BY_NAME
from bridge.streams import LinkMode, Schedule

pytestmark = pytest.mark.bench

VEHICLES = 20
WARM_S, FLIGHT_S = 3.0, 12.0
MOST_OFF = 0.02
SLOWEST_HZ = 10.0
MODES: tuple[LinkMode, ...] = ("gcs", "onboard")
# Sent when there is something new or somewhere to go, not at a fixed rate.
ON_NEWS = {
    "ATTITUDE_TARGET",
    "POSITION_TARGET_LOCAL_NED",
    "POSITION_TARGET_GLOBAL_INT",
    "GPS_RAW_INT",
    "RC_CHANNELS",
    "MANUAL_CONTROL",
}


def asked_hz(mode: LinkMode) -> dict[str, float]:
    """Return the rates that can be counted to 2 per cent in one flight."""
    rates = {name: 1e6 / interval_us for name, interval_us in Schedule(mode).intervals().items()}
    return {name: hz for name, hz in rates.items() if hz >= SLOWEST_HZ and name not in ON_NEWS}


def ear() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8_000_000)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


def count(ears: dict[LinkMode, socket.socket], seconds: float) -> tuple[Counter[tuple[str, int, int]], float]:
    """Return how often each (mode, system, message id) was heard, and in how many seconds."""
    heard: Counter[tuple[str, int, int]] = Counter()
    start = time.perf_counter()
    while (passed := time.perf_counter() - start) < seconds:
        select.select(list(ears.values()), [], [], 0.1)
        for mode, sock in ears.items():
            try:
                while True:
                    data = sock.recv(65_535)
                    heard[mode, data[5], data[7] | data[8] << 8 | data[9] << 16] += 1
            except BlockingIOError:
                pass
    return heard, passed


@pytest.mark.parametrize("vehicles", [1, VEHICLES])
def test_a_fleet_keeps_its_rates(capsys, vehicles):
    ears = {mode: ear() for mode in MODES}
    links = [f"--link=udpout://127.0.0.1:{sock.getsockname()[1]}#{mode}" for mode, sock in ears.items()]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "scenarios.cli", "sitl", f"ant-x*{vehicles}", "--no-log", *links]
    fleet = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(fleet.pid, {max(os.sched_getaffinity(0))})
        for sock in ears.values():
            assert select.select([sock], [], [], 60.0)[0], "the fleet never spoke"
        count(ears, WARM_S)
        heard, seconds = count(ears, FLIGHT_S)
    finally:
        fleet.send_signal(signal.SIGTERM)
        said = fleet.communicate(timeout=20)[1]
        for sock in ears.values():
            sock.close()
    assert fleet.returncode == 0, said
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    ratios = {
        (mode, system, name): heard[mode, system, BY_NAME[name].id] / seconds / hz
        for mode in MODES
        for system in range(1, vehicles + 1)
        for name, hz in asked_hz(mode).items()
    }
    worst = max(ratios, key=lambda key: abs(ratios[key] - 1.0))
    with capsys.disabled():
        print(
            f"\n{vehicles} vehicles, two links each, in real time: {sum(heard.values()) / seconds:.0f} messages/s, "
            f"{cpu_s:.1f} s of CPU for {WARM_S + FLIGHT_S:.0f} s and the start; "
            f"worst of {len(ratios)} stream rates {100 * (ratios[worst] - 1.0):+.2f} % {worst}"
        )
        print(said.strip())
    assert abs(ratios[worst] - 1.0) <= MOST_OFF
