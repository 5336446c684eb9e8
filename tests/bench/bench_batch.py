"""How fast the Monte Carlo is, beside what else could be used for it: python-control, and a loop in C.

Run: make bench. The job: 500 samples of ANT-X, a step of 5 s and tracking for 20 s, at 400 Hz: 5 million vehicle-steps,
with margins and metrics. Only ratios measured side by side in one process are asserted.
"""

from __future__ import annotations

import ctypes
import math
import os
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scenarios.manoeuvres import Manoeuvre, make_manoeuvre
from scenarios.monte_carlo import draw_samples, monte_carlo
from scenarios.roll_set import roll_sets
from sitl.batch import Batch, RollJob
from sitl.profile import get_profile
from sitl.roll_loop import roll_torque, step_matrices
from sitl.sampled_loop import RollGains
from sitl.vehicle_spec import resolve_vehicle

pytestmark = pytest.mark.bench

SAMPLES, RATE_HZ = 500, 400
REPEATS = 9
PLAIN_SAMPLES = 6
"""Flown the plain way and counted up to 500: each takes as long as the next."""
LEAST_OVER_PLAIN = 500.0
LEAST_SHARE_OF_C = 0.5
LEAST_OF_TWO_CORES = 1.25
MOST_OF_COLD_NUMPY = 1.3

GAINS = RollGains(6.5, 1.0, 0.05, 0.05, 0.001)
MODEL = resolve_vehicle("ant-x")
PROFILE = get_profile("study", rate_hz=RATE_HZ, limits=True)


def manoeuvres() -> list[Manoeuvre]:
    return [
        make_manoeuvre("step", amplitude_deg=5.0, hold_s=5.0, return_s=0.0),
        make_manoeuvre("track", return_s=0.0),
    ]


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def side_by_side(repeats: int, *works: Callable[[], object]) -> list[list[float]]:
    """Times of each, taken in turns: what else the machine does hits all alike."""
    for work in works:
        work()
    rounds = [[seconds(work) for work in works] for _ in range(repeats)]
    return [list(times) for times in zip(*rounds, strict=True)]


def plain_sample(derivatives: np.ndarray, signals: list[np.ndarray]) -> tuple[float, ...]:
    """One sample as a user of python-control would do it: models, interconnection, responses, margins, metrics."""
    import control

    Yv, Yp, Yd, Lv, Lp, Ld = derivatives
    dt = 1.0 / RATE_HZ
    plant = control.c2d(
        control.ss([[Yv, Yp, 9.81], [Lv, Lp, 0.0], [0.0, 1.0, 0.0]], [[Yd], [Ld], [0.0]], np.eye(3)[1:], [[0], [0]]),
        dt,
    )
    plant.input_labels, plant.output_labels = ["delta"], ["p", "phi"]
    z = control.tf("z")
    z.dt = dt
    names = {"dt": dt}
    angle = control.tf([GAINS.k_phi], [1.0], **names, inputs="e_phi", outputs="p_sp")
    pid = control.tf([GAINS.kp, GAINS.ki * dt - GAINS.kp], [1.0, -1.0], **names, inputs="e_p", outputs="pi")
    slope = control.tf([GAINS.kd, -GAINS.kd], [dt, 0.0], **names, inputs="p", outputs="d")
    e_phi = control.summing_junction(["phi_sp", "-phi"], "e_phi", **names)
    e_p = control.summing_junction(["p_sp", "-p"], "e_p", **names)
    delta = control.summing_junction(["pi", "-d"], "delta", **names)
    closed = control.interconnect(
        [plant, angle, pid, slope, e_phi, e_p, delta], inputs=["phi_sp"], outputs=["phi", "delta"]
    )
    opened = control.interconnect(
        [plant, angle, pid, slope, control.summing_junction(["-phi"], "e_phi", **names), e_p,
         control.summing_junction(["pi", "-d"], "torque", **names)], inputs=["delta"], outputs=["torque"])  # fmt: skip
    margins = control.margin(-opened)
    step, track = (control.forced_response(closed, inputs=signal).outputs[0] for signal in signals)
    info = control.step_info(step, T=dt * np.arange(len(step)), final_output=math.radians(5.0))
    vaf = 100.0 * (1.0 - np.var(signals[1] - track) / np.var(signals[1]))
    return (*margins, info["Overshoot"], info["SettlingTime"], vaf, step[-1])


def test_against_plain_python_control(capsys):
    flown = manoeuvres()
    signals = [np.repeat(one.samples(50.0), RATE_HZ // 50)[: round(one.duration_s * RATE_HZ)] for one in flown]
    derivatives = draw_samples(MODEL, SAMPLES, 1)[1:]

    def batch() -> object:
        return monte_carlo(MODEL, {"2.2": GAINS}, PROFILE, flown, derivatives=derivatives)

    def plain() -> object:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return [plain_sample(one, signals) for one in derivatives[:PLAIN_SAMPLES]]

    monte_carlo(MODEL, {"2.2": GAINS}, PROFILE, flown, samples=40, compiled=True)  # warm, as after the first run
    result, theirs = batch(), plain()
    for j, (*_, overshoot, settling, vaf, _last) in enumerate(theirs):
        assert result.metrics["vaf_pct"][0, j] == pytest.approx(vaf, abs=0.05)
        assert result.metrics["settling_time_2pct_s"][0, j] == pytest.approx(settling, abs=0.01, nan_ok=True)
        assert result.metrics["overshoot_pct"][0, j] == pytest.approx(overshoot, abs=0.05)
    ours, whole = side_by_side(7, batch, plain)
    ratio = float(np.median(np.array(whole) / np.array(ours))) * SAMPLES / PLAIN_SAMPLES
    with capsys.disabled():
        print(
            f"\n500 samples, step and tracking, margins and metrics: {1e3 * min(ours):.0f} ms; plain python-control ",
            end="",
        )
        print(f"{min(whole) * SAMPLES / PLAIN_SAMPLES:.0f} s ({ratio:.0f} x as long)")
    assert ratio > LEAST_OVER_PLAIN


def c_loop(folder) -> Callable[..., None]:
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    library = folder / "roll_loop.so"
    source = Path(__file__).with_name("roll_loop.c")
    subprocess.run(
        [compiler, "-O3", "-march=native", "-ffast-math", "-shared", "-fPIC", str(source), "-o", str(library)],
        check=True,
    )
    fly = ctypes.CDLL(str(library)).fly
    array = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
    fly.argtypes = [ctypes.c_long, ctypes.c_long, array, array, array, ctypes.c_double, ctypes.c_double,
                    ctypes.c_long, array, array]  # fmt: skip
    fly.restype = None
    return fly


def test_against_a_loop_in_c(tmp_path, capsys):
    (one,) = roll_sets(MODEL, PROFILE, [GAINS])
    settings = np.array([one.settings]).reshape(1)
    derivatives = draw_samples(MODEL, SAMPLES, 1)[1:]
    phi_sp = np.full(25 * RATE_HZ, math.radians(5.0))
    job = RollJob(settings, derivatives, 0.0, 0, 0.5, phi_sp)
    limit, status = roll_torque(settings, 0.5).limit, int(settings["status_ticks"][0])
    fly = c_loop(tmp_path)
    shape = (len(phi_sp), SAMPLES)
    phi, u = np.empty(shape), np.empty(shape)

    def native() -> None:
        step = step_matrices(derivatives, 0.0, 1.0 / RATE_HZ)[:, :3][:, :, [0, 1, 2, 4]]
        matrices = np.ascontiguousarray(np.moveaxis(step, 0, 2))
        gains = np.array([GAINS.k_phi, GAINS.k, GAINS.kp, GAINS.ki, GAINS.kd, settings["int_lim"][0, 0]])
        fly(SAMPLES, len(phi_sp), matrices, gains, phi_sp, 1.0 / RATE_HZ, limit, status, phi, u)

    # both write into memory that is there: ours keeps every block's traces, p besides phi and delta_lat
    first = Batch(job, True)
    rooms = [np.zeros(first.room) for _ in first.blocks]

    def batch() -> list:
        made = Batch(job, True)
        return [made.fly(number, room) for number, room in enumerate(rooms)]

    native()
    flown = batch()
    assert np.abs(np.concatenate([block.phi_rad for block in flown], axis=1) - phi).max() < 1e-9
    assert np.abs(np.concatenate([block.delta_lat for block in flown], axis=1) - u).max() < 1e-9
    ours, theirs = side_by_side(REPEATS, batch, native)
    share = float(np.median(np.array(theirs) / np.array(ours)))
    with capsys.disabled():
        print(f"\nfive million steps, traces stored, one thread: {1e3 * min(ours):.1f} ms; ", end="")
        print(f"C -O3 -march=native {1e3 * min(theirs):.1f} ms (we reach {100 * share:.0f} % of it)")
    assert share > LEAST_SHARE_OF_C


def test_both_cores(capsys):
    if (os.cpu_count() or 1) < 2:
        pytest.skip("one core")
    profile = get_profile("sitl")

    def with_threads(threads: int) -> Callable[[], object]:
        return lambda: monte_carlo(
            MODEL, {"2.2": GAINS}, profile, manoeuvres(), samples=4000, threads=threads, margins=False
        )

    one, two = side_by_side(5, with_threads(1), with_threads(2))
    ratio = float(np.median(np.array(one) / np.array(two)))
    with capsys.disabled():
        print(f"\n4000 samples: {1e3 * min(one):.0f} ms on one thread, {1e3 * min(two):.0f} ms on two ({ratio:.2f} x)")
    assert ratio > LEAST_OF_TWO_CORES


COLD = """
import sys, time
from scenarios.manoeuvres import make_manoeuvre
from scenarios.monte_carlo import monte_carlo
from sitl.profile import get_profile
from sitl.sampled_loop import RollGains
from sitl.vehicle_spec import resolve_vehicle
flown = [make_manoeuvre("step", amplitude_deg=5.0, hold_s=5.0, return_s=0.0), make_manoeuvre("track", return_s=0.0)]
how = {"numpy": False, "auto": None}[sys.argv[1]]
start = time.perf_counter()
monte_carlo(resolve_vehicle("ant-x"), {"2.2": RollGains(6.5, 1.0, 0.05, 0.05, 0.001)}, get_profile("sitl"), flown,
            compiled=how, margins=False)
print(time.perf_counter() - start)
"""


def test_a_cold_first_run(tmp_path, capsys):
    """Machine code is kept beside the sources; a copy of the packages elsewhere has none."""
    root = Path(__file__).parents[2]

    def cold(how: str, number: int) -> float:
        folder = tmp_path / f"{how}{number}"
        for package in ("sitl", "bridge", "scenarios"):
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(root / package, folder / package, ignore=ignored)
        done = subprocess.run(
            [sys.executable, "-c", COLD, how], cwd=folder, capture_output=True, text=True, check=True,
            env={**os.environ, "PYTHONPATH": str(folder)},
        )  # fmt: skip
        return float(done.stdout)

    rounds = [(cold("auto", n), cold("numpy", n)) for n in range(3)]
    ratio = float(np.median([auto / array for auto, array in rounds]))
    with capsys.disabled():
        print(f"\ncold, nothing compiled: {min(a for a, _ in rounds):.2f} s; numpy {min(n for _, n in rounds):.2f} s")
    assert ratio < MOST_OF_COLD_NUMPY
