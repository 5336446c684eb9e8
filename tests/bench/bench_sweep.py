"""How much of a sweep is the kernel, what a second worker brings, what Dask costs, and that memory does not grow.

Run: make bench. The sweep: 2000 gain sets on ANT-X and ANT-R, 100 samples of a step of 5 s each, without margins.
Works take turns in one process, and the median of the ratios counts: what else the machine does hits all alike. Where
more than one process works, that needs a machine with nothing else to do.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scenarios.batch_flight import WorstOf, setpoint_ticks
from scenarios.monte_carlo import draw_samples
from scenarios.sweep.candidates import Candidates
from scenarios.sweep.cluster import Dask
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.engines import Engine, InProcess, Processes
from scenarios.sweep.evaluation import _settings
from scenarios.sweep.plan import Plan, make_plan
from scenarios.sweep.sweep_file import load_sweep
from scenarios.sweep.sweeping import _missing, sweep_points
from sitl.batch import Batch, RollJob
from sitl.roll_loop import step_matrices

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1800)]

LEAST_OF_KERNEL = 0.80
LEAST_OF_TWO_WORKERS = 1.8
MOST_OVER_PROCESSES = 1.15
MOST_GROWTH_MB = 15.0
REPEATS = 3
CORES = len(os.sched_getaffinity(0))

SWEEP = """
title = "bench"
margins = "none"
samples = 99
objectives = ["rise_time_s", "overshoot_pct"]
[design]
kind = "sobol"
points = {points}
[axes]
MC_ROLL_P = {{ from = 2.0, to = 12.0 }}
MC_ROLLRATE_P = {{ from = 0.02, to = 0.12 }}
MC_ROLLRATE_I = {{ from = 0.01, to = 0.3 }}
vehicle = ["ant-x", "ant-r"]
[[limit]]
metric = "overshoot_pct"
max = 20.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 5.0
hold_s = 5.0
return_s = 0.0
"""


def plan_of(folder: Path, points: int) -> Plan:
    path = folder / "bench.toml"
    path.write_text(SWEEP.format(points=points), encoding="utf-8")
    return make_plan(load_sweep(path))


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    return plan_of(tmp_path, 2000)


@pytest.fixture
def longer(tmp_path: Path) -> Plan:
    """Chunks enough that the last one, for which a worker may wait, is a small part of the whole."""
    return plan_of(tmp_path, 5000)


folders: Iterator[int] = iter(range(1_000_000))


def sweep(plan: Plan, engine: Engine, folder: Path, clock=time.perf_counter) -> float:
    """Seconds of a sweep whose workers have started and compiled."""
    dataset = Dataset(folder / f"sweep{next(folders)}")
    dataset.create(plan, {})
    start = clock()
    with dataset.locked():
        sweep_points(plan, dataset, engine)
    return clock() - start


def kernel(plan: Plan) -> float:
    """Seconds of processor time that flying and measuring the same points takes, without anything around it."""
    values = Candidates(plan).values(0, plan.candidates)
    (manoeuvre,) = plan.sweep.manoeuvres
    ready = []
    for case in plan.cases:
        drawn = draw_samples(case.model, plan.sweep.samples, plan.sweep.seed)
        lag_s = case.profile.motor_lag(case.model.assumptions.motor_lag_s)
        signal = setpoint_ticks(manoeuvre, case.profile, plan.sweep.setpoint_rate_hz)
        matrices = step_matrices(drawn, lag_s, case.profile.dt_s)
        for start in range(0, plan.candidates, plan.block):
            settings, _ = _settings(plan, case, values[start : start + plan.block])
            delay = case.profile.transport_delay_ticks
            job = RollJob(settings, drawn, lag_s, delay, case.model.assumptions.hover_thrust, signal)
            worst = WorstOf(len(settings), len(drawn))
            ready.append((worst, Batch(job, True, matrices), case.profile.dt_s))
    begun = time.process_time()
    for worst, batch, dt_s in ready:
        worst.fly(batch, manoeuvre, dt_s)
    return time.process_time() - begun


def test_share_of_the_kernel(plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rounds = []
    with InProcess(plan, 1) as engine:
        sweep(plan, engine, tmp_path)
        for _ in range(REPEATS):
            rounds.append((kernel(plan), sweep(plan, engine, tmp_path, time.process_time)))
    share = float(np.median([alone / whole for alone, whole in rounds]))
    best = min(whole for _, whole in rounds)
    steps = plan.points * plan.steps_per_point
    with capsys.disabled():
        print(
            f"\n{plan.points:,} points of {plan.samples} samples, {steps / 1e6:,.0f} million steps: {best:.1f} s of a "
            f"core, {1e6 * best / plan.points:.0f} us a point, {steps / best / 1e6:.0f} million steps/s; "
            f"{100 * share:.0f} % of the kernel's own rate"
        )
    assert share > LEAST_OF_KERNEL


def side_by_side(plan: Plan, folder: Path, *engines: Engine) -> np.ndarray:
    """(REPEATS, n) seconds, in turns, of engines whose workers are warm."""
    times = []
    for _ in range(REPEATS):
        row = []
        for engine in engines:
            with engine:
                # workers start and load what is compiled
                for _ in engine.run(itertools.islice(_missing(plan, set()), 4 * engine.workers)):
                    pass
                row.append(sweep(plan, engine, folder))
        times.append(row)
    return np.array(times)


@pytest.mark.skipif(CORES < 2, reason="one core")
def test_two_workers(longer: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = side_by_side(longer, tmp_path, Processes(longer, 1), Processes(longer, 2))
    ratio = float(np.median(times[:, 0] / times[:, 1]))
    with capsys.disabled():
        print(f"\n1 worker {times[:, 0].min():.1f} s, 2 workers {times[:, 1].min():.1f} s ({ratio:.2f} x)")
    assert ratio > LEAST_OF_TWO_WORKERS


@pytest.mark.skipif(CORES < 2, reason="one core")
def test_dask_beside_processes(longer: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = side_by_side(longer, tmp_path, Processes(longer, 2), Dask(longer, "local", 2))
    ratio = float(np.median(times[:, 1] / times[:, 0]))
    with capsys.disabled():
        print(f"\n2 processes {times[:, 0].min():.1f} s, Dask with 2 workers {times[:, 1].min():.1f} s ({ratio:.2f} x)")
    assert ratio < MOST_OVER_PROCESSES


MEMORY = """
import resource, sys
from pathlib import Path
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.plan import make_plan
from scenarios.sweep.sweep_file import load_sweep
from scenarios.sweep.sweeping import sweep_points
from tests.scenarios.sweeps import Quick
from scenarios.sweep.engines import Processes
import dataclasses
path = Path(sys.argv[1])
plan = dataclasses.replace(make_plan(load_sweep(path)), block=20)
dataset = Dataset(path.with_suffix(""))
dataset.create(plan, {})
with dataset.locked(), Processes(plan, 1, Quick) as engine:
    sweep_points(plan, dataset, engine)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
"""


def test_memory_does_not_grow(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of the process that gives out and keeps; nothing is flown, so that it is soon done."""
    used = {}
    for points in (2_000, 40_000):
        path = tmp_path / f"memory{points}.toml"
        path.write_text(SWEEP.format(points=points // 2), encoding="utf-8")
        done = subprocess.run(
            [sys.executable, "-c", MEMORY, str(path)],
            cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True,
        )  # fmt: skip
        used[points] = float(done.stdout)
    with capsys.disabled():
        print(f"\nmemory: {', '.join(f'{points:,} points {mb:.0f} MB' for points, mb in used.items())}")
    assert used[40_000] - used[2_000] < MOST_GROWTH_MB
