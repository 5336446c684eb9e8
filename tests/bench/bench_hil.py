"""What our side of a lockstep costs, and how much of a real PX4's own speed is left beside it.

Run: make bench. The second part needs a PX4 SITL that you have built: `FROUDE_PX4=PX4-Autopilot/build/px4_sitl_default
make bench`. One PX4 is served by our plant and by an empty simulator, which sends prepared bytes and computes nothing,
in turns of half a second, on the same connection.
"""

from __future__ import annotations

import os
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
from sitl.body import RATE_HZ, START_US, Body
from sitl.profile import get_profile
from sitl.vehicle_spec import resolve_vehicle

pytestmark = pytest.mark.bench

STEPS = 20_000
MOST_OVER_PLANT = 10.0
LEAST_SHARE = 0.9
ROUNDS = 40
WARM_S, SLICE_S = 8.0, 0.5
_GPS_TICKS, _VARIANTS, _ACTUATORS = 25, 500, 93


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


class EmptySteps:
    """An empty simulator in the place of a lockstep's plant, on the same connection to the same PX4.

    It sends prepared samples of a vehicle at rest and takes any answer for the right one.
    """

    def __init__(self, lockstep: Lockstep) -> None:
        self.body, self.link = lockstep.body, lockstep.link
        rest = body()
        self.samples, self.fixes = [], []
        for _ in range(_VARIANTS):
            rest.step(())
            self.samples.append(bytearray(BY_NAME["HIL_SENSOR"].pack(sensor_fields(rest))))
            if (fix := rest.fix()) is not None:
                self.fixes.append(bytearray(BY_NAME["HIL_GPS"].pack(gps_fields(fix))))
        self.sent = 0

    def step(self) -> None:
        tick, data = self.body.tick, b""
        if tick % _GPS_TICKS == 0:
            data = self._frame("HIL_GPS", self.fixes[tick // _GPS_TICKS % len(self.fixes)])
        self.link.send(data + self._frame("HIL_SENSOR", self.samples[tick % _VARIANTS]))
        while True:
            answer = self.link.recv(5.0)
            assert answer is not None, "the PX4 does not answer"
            if len(answer) > 9 and answer[7] == _ACTUATORS:
                break
        self.body.tick += 1

    def _frame(self, name: str, payload: bytearray) -> bytes:
        kind = BY_NAME[name]
        struct.pack_into("<Q", payload, 0, self.body.time_us)
        head = struct.pack("<6B3s", len(payload), 0, 0, self.sent & 0xFF, 254, 51, kind.id_bytes)
        self.sent += 1
        checked = head + payload
        return b"\xfd" + checked + fastcrc.crc16.mcrf4xx(checked + kind.crc_extra).to_bytes(2, "little")


@pytest.mark.skipif("FROUDE_PX4" not in os.environ, reason="FROUDE_PX4 names no build of a PX4 SITL")
def test_share_of_a_real_px4s_own_speed(tmp_path: Path) -> None:
    process = Px4Process(Path(os.environ["FROUDE_PX4"]), tmp_path, free_instance())
    with open_link(process.simulator_url) as link, process:
        lockstep = Lockstep(link, Simulator(body(), truth=True))
        while lockstep.body.time_us < START_US + WARM_S * 1e6 or not lockstep.locked:
            lockstep.step()
        empty = EmptySteps(lockstep)
        shares, speeds = [], []
        for _ in range(ROUNDS):
            # ours, empty, empty, ours: what changes slowly meanwhile falls out
            times = [seconds(step) for step in (lockstep.step, empty.step, empty.step, lockstep.step)]
            shares.append((times[1] + times[2]) / (times[0] + times[3]))
            speeds.append(2.0 * SLICE_S / (times[0] + times[3]))
        assert lockstep.report.late == 0
    share = statistics.median(shares)
    print(
        f"\nPX4 in lockstep with our plant: {statistics.median(speeds):.1f} x real time, {share:.0%} of what it "
        f"reaches with an empty simulator (quartiles {np.quantile(shares, 0.25):.0%}, {np.quantile(shares, 0.75):.0%})"
    )
    assert share > LEAST_SHARE


def seconds(step: Callable[[], object]) -> float:
    """Wall-clock time of SLICE_S of vehicle time."""
    start = time.perf_counter()
    for _ in range(round(SLICE_S * RATE_HZ)):
        step()
    return time.perf_counter() - start
