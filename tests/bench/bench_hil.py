"""What our side of a lockstep costs, and how much of a real PX4's own speed is left beside it.

Run: make bench. The second part needs a PX4 SITL that you have built: `FROUDE_PX4=PX4-Autopilot/build/px4_sitl_default
make bench`. It flies the same PX4 with our plant and with an empty simulator, which sends prepared bytes and computes
nothing, in turns, and compares.
"""

from __future__ import annotations

import os
import socket
import statistics
import struct
import time
from collections.abc import Callable
from pathlib import Path

import fastcrc
import numpy as np
import pytest

from bridge.connection import Connection
from bridge.link import open_link
from bridge.lockstep import Lockstep
from bridge.messages import BY_NAME
from bridge.simulator import Simulator, gps_fields, sensor_fields
from scenarios.px4_process import Px4Process, free_instance
from sitl.body import Body
from sitl.profile import get_profile
from sitl.vehicle_spec import resolve_vehicle

pytestmark = pytest.mark.bench

STEPS = 20_000
MOST_OVER_PLANT = 10.0
LEAST_SHARE = 0.9
ROUNDS = 3
WARM_S, MEASURED_S = 8.0, 30.0
_GPS_STEPS, _VARIANTS, _START_US, _TICK_US = 25, 500, 1_000_000, 4_000


def body() -> Body:
    return Body(resolve_vehicle("ant-x"), get_profile("sitl"))


def cpu_us(run: Callable[[int], object], steps: int = STEPS) -> float:
    for k in range(500):
        run(k)
    start = time.process_time()
    for k in range(steps):
        run(k)
    return (time.process_time() - start) / steps * 1e6


def test_cost_of_a_step() -> None:
    plant, whole = body(), body()
    simulator = Simulator(whole, truth=True)
    px4 = Connection(1, 1)
    answers = [
        px4.encode("HIL_ACTUATOR_CONTROLS", time_usec=k, controls=[0.5] * 4 + [0.0] * 12, mode=129, flags=1)
        for k in range(256)
    ]
    hover = (0.5,) * 16

    def step(k: int) -> None:
        simulator.frames()
        whole.step(simulator.receive(answers[k & 255])[0].motors)

    bare_us = min(cpu_us(lambda _: plant.step(hover)) for _ in range(3))
    step_us = min(cpu_us(step) for _ in range(3))
    print(f"\nour side of a lockstep: {step_us:.0f} us of CPU a step, {bare_us:.0f} of them plant and noise")
    assert step_us < MOST_OVER_PLANT * bare_us


# -- beside an empty simulator ---------------------------------------------------------------------------------


class EmptySimulator:
    """Sends prepared samples of a vehicle at rest, one for each answer."""

    def __init__(self, port: int) -> None:
        self.listener = socket.socket()
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.listener.bind(("127.0.0.1", port))
        self.listener.listen(1)
        rest = body()
        self.samples, self.fixes = [], []
        for _ in range(_VARIANTS):
            rest.step(())
            self.samples.append(bytearray(BY_NAME["HIL_SENSOR"].pack(sensor_fields(rest))))
            if (fix := rest.fix()) is not None:
                self.fixes.append(bytearray(BY_NAME["HIL_GPS"].pack(gps_fields(fix))))
        self.sent = self.step_no = 0
        self.locked = False

    @property
    def vehicle_s(self) -> float:
        return self.step_no * _TICK_US * 1e-6

    def accept(self) -> None:
        self.listener.settimeout(30.0)
        self.peer, _ = self.listener.accept()
        self.peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.peer.settimeout(_TICK_US * 1e-6)
        self.buffer = b""

    def step(self) -> None:
        time_us = _START_US + self.step_no * _TICK_US
        data = b""
        if self.step_no % _GPS_STEPS == 0:
            data = self._frame("HIL_GPS", self.fixes[self.step_no // _GPS_STEPS % len(self.fixes)], time_us)
        self.peer.sendall(data + self._frame("HIL_SENSOR", self.samples[self.step_no % _VARIANTS], time_us))
        self.step_no += 1
        while not self._answered():
            try:
                self.buffer += self.peer.recv(4096)
            except TimeoutError:
                if not self.locked:
                    return

    def _answered(self) -> bool:
        while len(self.buffer) >= 10 and len(self.buffer) >= (whole := self.buffer[1] + 12):
            message_id = self.buffer[7]
            self.buffer = self.buffer[whole:]
            if message_id == 93:
                self.locked = True
                self.peer.settimeout(5.0)
                return True
        return False

    def _frame(self, name: str, payload: bytearray, time_us: int) -> bytes:
        kind = BY_NAME[name]
        struct.pack_into("<Q", payload, 0, time_us)
        head = struct.pack("<6B3s", len(payload), 0, 0, self.sent & 0xFF, 254, 51, kind.id_bytes)
        self.sent += 1
        checked = head + payload
        return b"\xfd" + checked + fastcrc.crc16.mcrf4xx(checked + kind.crc_extra).to_bytes(2, "little")

    def close(self) -> None:
        self.peer.close()
        self.listener.close()


def empty_speed(build: Path, folder: Path) -> float:
    instance = free_instance()
    simulator = EmptySimulator(4560 + instance)
    with Px4Process(build, folder, instance):
        simulator.accept()
        try:
            return measured(simulator.step, lambda: simulator.vehicle_s)
        finally:
            simulator.close()


def our_speed(build: Path, folder: Path) -> float:
    process = Px4Process(build, folder, free_instance())
    plant = body()
    with open_link(process.simulator_url) as link, process:
        lockstep = Lockstep(link, Simulator(plant, truth=True))
        return measured(lockstep.step, lambda: plant.time_us * 1e-6)


def measured(step: Callable[[], object], vehicle_s: Callable[[], float]) -> float:
    """Vehicle seconds per second, once it has started."""
    began = vehicle_s()
    while vehicle_s() < began + WARM_S:
        step()
    from_s, start = vehicle_s(), time.perf_counter()
    while vehicle_s() < from_s + MEASURED_S:
        step()
    return (vehicle_s() - from_s) / (time.perf_counter() - start)


@pytest.mark.skipif("FROUDE_PX4" not in os.environ, reason="FROUDE_PX4 names no build of a PX4 SITL")
def test_share_of_a_real_px4s_own_speed(tmp_path: Path) -> None:
    build = Path(os.environ["FROUDE_PX4"])
    pairs = [
        (empty_speed(build, tmp_path / f"empty{n}"), our_speed(build, tmp_path / f"ours{n}")) for n in range(ROUNDS)
    ]
    shares = [ours / empty for empty, ours in pairs]
    share = statistics.median(shares)
    empty, ours = np.median(pairs, axis=0)
    print(
        f"\nPX4 in lockstep: {ours:.1f} x real time with our plant, {empty:.1f} x with an empty simulator: {share:.0%}"
    )
    assert share > LEAST_SHARE
