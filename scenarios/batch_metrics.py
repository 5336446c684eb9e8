"""The metrics of `scenarios.metrics` on a whole block of simulated flights at once, without keeping their traces.

The definitions are those of that module; here the samples are evenly spaced ticks, and many flights are measured side
by side in compiled lanes. NaN stands for UNSET. A test holds both to the same numbers on the same traces.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from scenarios.batch_tracking import TRACK, track_block
from scenarios.limits import LIMIT_CYCLE_RAD_S
from scenarios.metrics import LAST_S, MOST_LAG_S, MOVES_RAD, SETTLE_S
from sitl.compiled import compiled, select

FloatArray = npt.NDArray[np.float64]

STEP = ("overshoot_pct", "rise_time_s", "settling_time_5pct_s", "settling_time_2pct_s", "droop_deg")
EFFORT = ("peak_delta_lat", "rms_delta_lat")
OSCILLATION = ("oscillation_rad_s",)

BANDS = (0.05, 0.02)


@compiled
def _crossing(phi: FloatArray, j: int, a: int, b: int, level: float) -> float:
    """Tick, as a fraction, at which a lane goes through a level between ticks a and b."""
    if phi[a, j] == phi[b, j]:
        return float(b)
    share: float = (level - phi[a, j]) / (phi[b, j] - phi[a, j])
    return a + (b - a) * share


@compiled
def step_block(phi: FloatArray, dt_s: float, phi_from: float, phi_to: float, last_ticks: int, out: FloatArray) -> None:
    """Overshoot, rise, settling and droop of every lane.

    Args:
        phi: (T, n) rad, from the tick of the step to the last before the next set-point. dt_s: tick, s.
        phi_from, phi_to: set-points, rad, not equal. last_ticks: ticks of droop, 0 if the hold is too short for it.
        out: (5, n) output, in the order of STEP.
    """
    ticks, n = phi.shape
    amplitude = phi_to - phi_from
    # one array: the compiler sees that its rows do not overlap, and the loop over lanes uses the vector unit
    x = np.zeros((6, n))
    for j in range(n):
        x[0, j] = -math.inf
        for row in range(1, 5):
            x[row, j] = -1.0
    late = ticks - last_ticks
    for t in range(ticks):
        time = float(t)
        # trapezoid rule over the last second
        weight = 0.0 if t < late else (0.5 if t in (late, ticks - 1) else 1.0)
        for j in range(n):
            done = (phi[t, j] - phi_from) / amplitude
            off = abs(done - 1.0)
            x[0, j] = max(x[0, j], done)
            x[1, j] = select(x[1, j] < 0.0, select(done >= 0.1, time, -1.0), x[1, j])
            x[2, j] = select(x[2, j] < 0.0, select(done >= 0.9, time, -1.0), x[2, j])
            x[3, j] = select(off > 0.05, time, x[3, j])
            x[4, j] = select(off > 0.02, time, x[4, j])
            x[5, j] += weight * (done - 1.0)
    for j in range(n):
        out[0, j] = 100.0 * max(0.0, x[0, j] - 1.0)
        out[1, j] = math.nan
        if x[2, j] >= 0.0:
            ends = np.empty(2)
            for i in range(2):
                k = int(x[1 + i, j])
                level = phi_from + (0.1 if i == 0 else 0.9) * amplitude
                ends[i] = _crossing(phi, j, k - 1, k, level) if k else 0.0
            out[1, j] = (ends[1] - ends[0]) * dt_s
        for i in range(2):
            k = int(x[3 + i, j])
            band = BANDS[i]
            if k < 0:
                out[2 + i, j] = 0.0
            elif k == ticks - 1:
                out[2 + i, j] = math.nan
            else:
                side = math.copysign(band, (phi[k, j] - phi_from) / amplitude - 1.0)
                out[2 + i, j] = _crossing(phi, j, k, k + 1, phi_from + (1.0 + side) * amplitude) * dt_s
        out[4, j] = x[5, j] / (last_ticks - 1) * math.degrees(abs(amplitude)) if last_ticks > 1 else math.nan


@compiled
def _moments(signal: FloatArray, mean: FloatArray, variance: FloatArray) -> None:
    """Mean and variance of every column by the trapezoid rule."""
    ticks, n = signal.shape
    for j in range(n):
        mean[j] = 0.0
        variance[j] = 0.0
    for t in range(ticks):
        weight = 0.5 if t in (0, ticks - 1) else 1.0
        for j in range(n):
            mean[j] += weight * signal[t, j]
    for j in range(n):
        mean[j] /= ticks - 1
    for t in range(ticks):
        weight = 0.5 if t in (0, ticks - 1) else 1.0
        for j in range(n):
            variance[j] += weight * (signal[t, j] - mean[j]) ** 2
    for j in range(n):
        variance[j] /= ticks - 1


@compiled
def deviation_block(signal: FloatArray, out: FloatArray) -> None:
    """Standard deviation of every lane.

    Args:
        signal: (T, n). out: (n,) output.
    """
    mean = np.empty(signal.shape[1])
    _moments(signal, mean, out)
    for j in range(len(out)):
        out[j] = math.sqrt(out[j])


@compiled
def effort_block(delta: FloatArray, out: FloatArray) -> None:
    """Peak and RMS of every lane.

    Args:
        delta: (T, n). out: (2, n) output, in the order of EFFORT.
    """
    ticks, n = delta.shape
    x = np.zeros((2, n))
    for t in range(ticks):
        weight = 0.5 if t in (0, ticks - 1) else 1.0
        for j in range(n):
            x[0, j] = max(x[0, j], abs(delta[t, j]))
            x[1, j] += weight * delta[t, j] ** 2
    for j in range(n):
        out[0, j] = x[0, j]
        out[1, j] = math.sqrt(x[1, j] / (ticks - 1))


def measure_step(phi: FloatArray, dt_s: float, phi_from_rad: float, phi_to_rad: float) -> FloatArray:
    """(5, n) in the order of STEP; arguments as `step_block`."""
    out = np.empty((len(STEP), phi.shape[1]))
    hold_s = len(phi) * dt_s
    last = round(LAST_S / dt_s) if hold_s >= LAST_S - 1e-9 else 0
    step_block(phi, dt_s, phi_from_rad, phi_to_rad, last, out)
    return out


def measure_track(phi: FloatArray, phi_sp: FloatArray, dt_s: float) -> FloatArray:
    """(4, n) in the order of TRACK; arguments as `track_block`."""
    out = np.empty((len(TRACK), phi.shape[1]))
    track_block(phi, phi_sp, dt_s, min(round(MOST_LAG_S / dt_s), len(phi_sp) // 4), MOVES_RAD**2, out)
    return out


def measure_effort(delta: FloatArray) -> FloatArray:
    """(2, n) in the order of EFFORT; delta: (T, n)."""
    out = np.empty((len(EFFORT), delta.shape[1]))
    effort_block(delta, out)
    return out


def measure_oscillation(p: FloatArray, dt_s: float) -> FloatArray:
    """(n,) standard deviation of the roll rate in the last second, rad/s; NaN if the window is too short.

    Args:
        p: (T, n) rad/s over the window. dt_s: tick, s.
    """
    out = np.full(p.shape[1], math.nan)
    if len(p) * dt_s >= LAST_S + SETTLE_S - 1e-6:
        deviation_block(p[len(p) - round(LAST_S / dt_s) :], out)
    return out


def is_limit_cycle(oscillation_rad_s: FloatArray) -> npt.NDArray[np.bool_]:
    """Which lanes shake more than an ended manoeuvre explains; NaN does not."""
    return np.asarray(np.nan_to_num(oscillation_rad_s) > LIMIT_CYCLE_RAD_S)
