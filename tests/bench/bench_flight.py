"""How fast a whole flight is, how quickly the command line answers, and what the demo needs of memory.

Run: make bench. Wall-clock figures are printed for the README; only ratios measured side by side and memory are
asserted. The bare vehicle is the yardstick of the flight: what the wire, the client and the recording add to it.
"""

from __future__ import annotations

import dataclasses
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest

from scenarios.gain_set import load_gain_sets
from scenarios.one_flight import fly
from scenarios.runner import plan
from scenarios.scenario import load_scenario
from sitl.modes import Mode
from sitl.vehicle import Vehicle

pytestmark = pytest.mark.bench

REPEATS = 5
MOST_OVER_BARE = 12.0
MOST_OVER_PYTHON = 8.0
MOST_MEMORY_MB = 500.0


def job(folder):
    scenario = load_scenario("demo")
    (gain_set,) = load_gain_sets("table_2_2/ANT-X")
    planned = plan(gain_set, scenario, scenario.resolve_vehicle(), scenario.resolve_profile())
    return dataclasses.replace(planned, folder=folder)


def bare_speed(planned) -> float:
    """Vehicle seconds per second of the vehicle alone, hovering in Hold."""
    vehicle = Vehicle(planned.model, planned.profile)
    while not vehicle.autopilot.ready:
        vehicle.step()
    vehicle.autopilot.command_arm(True)
    vehicle.autopilot.command_takeoff(None)
    while vehicle.autopilot.mode is not Mode.LOITER:
        vehicle.step()
    start, ticks = time.perf_counter(), 5000
    for _ in range(ticks):
        vehicle.step()
    return ticks * vehicle.tick_us * 1e-6 / (time.perf_counter() - start)


def flight_speed(planned) -> float:
    start = time.perf_counter()
    record = fly(planned)
    return float(record.telemetry["t_s"][-1]) / (time.perf_counter() - start)


def test_a_flight_with_recording(tmp_path, capsys):
    planned = job(tmp_path)
    flight_speed(planned)  # loads and compiles
    speeds, bare = [], []
    for _ in range(REPEATS):
        speeds.append(flight_speed(planned))
        bare.append(bare_speed(planned))
    with capsys.disabled():
        middle = sorted(speeds)[REPEATS // 2]
        print(f"\nflight over memory:// with recording: {max(speeds):.0f} x real time (median {middle:.0f} x)")
        print(f"vehicle alone: {max(bare):.0f} x real time")
    assert max(bare) / max(speeds) < MOST_OVER_BARE


def test_help_answers_at_once(capsys):
    def seconds(*command: str) -> float:
        best = 9.0
        for _ in range(REPEATS):
            start = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            best = min(best, time.perf_counter() - start)
        return best

    ours = seconds(str(Path(sys.executable).with_name("froude")), "--help")
    python = seconds(sys.executable, "-c", "pass")
    with capsys.disabled():
        print(f"\nfroude --help: {ours:.3f} s (python itself: {python:.3f} s)")
    assert ours / python < MOST_OVER_PYTHON


def test_memory_of_the_demo(tmp_path, capsys):
    froude = str(Path(sys.executable).with_name("froude"))
    subprocess.run([froude, "fly", "--out", str(tmp_path)], check=True, stdout=subprocess.DEVNULL)
    peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    with capsys.disabled():
        print(f"\nfroude fly, the demo: {peak_mb:.0f} MB at its peak")
    assert peak_mb < MOST_MEMORY_MB
