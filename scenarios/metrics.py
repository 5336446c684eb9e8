"""Measurements on time series, one definition for live flights, batches and analysis.

Pure functions of arrays: time `t_s` strictly increases but need not be uniform, angles in rad, roll
positive to the right. Means, variances and RMS are weighted by time (trapezoid rule), so that a lost
message does not tilt them. What cannot be measured is UNSET with the reason, never a number that looks
like one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios.limits import LIMIT_CYCLE_RAD_S, Metric, measured

FloatArray = npt.NDArray[np.float64]

LAST_S = 1.0
"""Droop and oscillation are measured over the last second of a window."""

SETTLE_S = 1.0
"""A window must be this much longer than `LAST_S`: its last second is then free of the step's transient."""

LARGEST_GAP_S = 0.2
"""With a longer hole in the data, a step's peak or crossing may have been missed."""

MOST_LAG_S = 1.0
QUIET_RAD_S = 0.02
"""Below this standard deviation a rate is sensor noise, and its dominant frequency means nothing."""

DIVERGED_RAD = math.radians(80.0)
MOVES_RAD = math.radians(0.5)
"""A set-point with a smaller standard deviation excites nothing."""


@dataclass(frozen=True)
class Oscillation:
    """How the vehicle shakes in the last second of a window.

    Attributes:
        std_rad_s: standard deviation of p, q, r; NaN if there is no data.
        axis: of the largest: "roll", "pitch" or "yaw".
        frequency_hz: dominant frequency of that axis; None if it is quiet.
        reason: why nothing could be measured; empty if it was.
    """

    std_rad_s: tuple[float, float, float]
    axis: str
    frequency_hz: float | None
    reason: str = ""

    @property
    def worst_rad_s(self) -> float:
        """The largest of the three; NaN if not measured."""
        return math.nan if self.reason else max(self.std_rad_s)

    @property
    def is_limit_cycle(self) -> bool:
        """Does it shake more than sensor noise and an ended manoeuvre explain?"""
        return not self.reason and self.worst_rad_s > LIMIT_CYCLE_RAD_S

    def __str__(self) -> str:
        if self.reason:
            return self.reason
        hertz = "" if self.frequency_hz is None else f"{self.frequency_hz:.1f} Hz, "
        what = "limit cycle" if self.is_limit_cycle else "rate"
        return f"{what} {hertz}{self.worst_rad_s:.2g} rad/s in {self.axis}"


def oscillation(
    t_s: FloatArray,
    p_rad_s: FloatArray,
    q_rad_s: FloatArray,
    r_rad_s: FloatArray,
    *,
    start_s: float,
    end_s: float,
) -> Oscillation:
    """Standard deviation of the body rates in the last second before `end_s`, and its dominant frequency.

    Args:
        t_s: (n,) s.
        p_rad_s: (n,) roll rate; q_rad_s and r_rad_s alike.
        q_rad_s: pitch rate.
        r_rad_s: yaw rate.
        start_s: of the window, when the set-point changed last.
        end_s: of the window.
    """
    nothing = (math.nan, math.nan, math.nan)
    if end_s - start_s < LAST_S + SETTLE_S - 1e-6:
        need = f"needs {LAST_S + SETTLE_S:g} s"
        return Oscillation(nothing, "", None, f"held for {end_s - start_s:.2g} s: oscillation {need}")
    rows = _rows(t_s, end_s - LAST_S, end_s)
    hole = _hole(t_s[rows], end_s - LAST_S, end_s)
    if hole:
        return Oscillation(nothing, "", None, hole)
    t = t_s[rows]
    rates = [np.asarray(rate[rows], dtype=np.float64) for rate in (p_rad_s, q_rad_s, r_rad_s)]
    if not all(np.isfinite(rate).all() for rate in rates):
        return Oscillation(nothing, "", None, "the vehicle did not report its body rates")
    spread = [math.sqrt(_variance(t, rate)) for rate in rates]
    worst = int(np.argmax(spread))
    hertz = dominant_frequency(t, rates[worst]) if spread[worst] > QUIET_RAD_S else None
    return Oscillation((spread[0], spread[1], spread[2]), ("roll", "pitch", "yaw")[worst], hertz)


def dominant_frequency(t_s: FloatArray, signal: FloatArray) -> float:
    """Frequency in Hz of the sine that, beside a straight line, explains most of the signal.

    The peak of a zero-padded Hann spectrum is refined by least squares on the samples' own times, so a window
    of one second is good to 0.1 Hz from 2 Hz to near half the sample rate.

    Args:
        t_s: (n,) s, n >= 8.
        signal: (n,).
    """
    t = t_s - t_s[0]
    step = float(np.median(np.diff(t)))
    even = np.arange(0.0, t[-1] + 0.5 * step, step)
    flat = np.interp(even, t, signal)
    flat = flat - np.polyval(np.polyfit(even, flat, 1), even)
    bins = 8 * len(even)
    power = np.abs(np.fft.rfft(flat * np.hanning(len(even)), bins)) ** 2
    spacing = 1.0 / (bins * step)
    guess = float(np.argmax(power)) * spacing
    low, high = max(guess - 0.75 / t[-1], 0.25 / t[-1]), guess + 0.75 / t[-1]
    line = np.column_stack([np.ones_like(t), t])

    def unexplained(hertz: float) -> float:
        angle = 2 * math.pi * hertz * t
        basis = np.column_stack([line, np.cos(angle), np.sin(angle)])
        return float(np.sum((signal - basis @ np.linalg.lstsq(basis, signal, rcond=None)[0]) ** 2))

    for _ in range(3):
        trial = np.linspace(low, high, 21)
        best = int(np.argmin([unexplained(hertz) for hertz in trial]))
        low, high = trial[max(best - 1, 0)], trial[min(best + 1, 20)]
    return float(trial[best])


def step_metrics(
    t_s: FloatArray,
    phi_rad: FloatArray,
    *,
    start_s: float,
    end_s: float,
    phi_from_rad: float,
    phi_to_rad: float,
    cycle: Oscillation | None = None,
    segment: str = "",
) -> tuple[Metric, ...]:
    """Overshoot, rise, settling and droop of a step of the roll set-point, of either sign and from any angle.

    With A = phi_to - phi_from: overshoot is the largest excess over phi_to in per cent of A; rise is from the
    first crossing of 10 % to the first of 90 %; settling is the last time outside 5 % (2 %) of A around
    phi_to, after the start; droop is the mean of phi - phi_to over the last second, in the direction of A.
    Crossings are interpolated between samples.

    Args:
        t_s: (n,) s.
        phi_rad: (n,).
        start_s: when the set-point was sent.
        end_s: when it changed again.
        phi_from_rad: set-point before.
        phi_to_rad: set-point held.
        cycle: oscillation of the flight; in a limit cycle overshoot, rise and settling are UNSET.
        segment: name for the metrics.
    """
    names = ("overshoot_pct", "rise_time_s", "settling_time_5pct_s", "settling_time_2pct_s")
    rows = _rows(t_s, start_s, end_s)
    hole = _hole(t_s[rows], start_s, end_s)
    amplitude = phi_to_rad - phi_from_rad
    if hole or amplitude == 0:
        reason = hole or "the set-point does not step"
        return tuple(measured(name, None, reason, segment) for name in (*names, "droop_deg"))
    t = t_s[rows] - start_s
    done = (np.asarray(phi_rad[rows], dtype=np.float64) - phi_from_rad) / amplitude  # 0 before, 1 at the set-point
    error_deg = math.degrees(abs(amplitude)) * (done - 1.0)
    tail = t >= end_s - start_s - LAST_S - 1e-6 if end_s - start_s >= LAST_S else None
    droop_deg = None if tail is None else _mean(t[tail], error_deg[tail])
    short = "" if tail is not None else f"held for {end_s - start_s:.2g} s: droop needs {LAST_S:g} s"
    droop = measured("droop_deg", droop_deg, short, segment)
    if cycle is not None and cycle.is_limit_cycle:
        return (*(measured(name, None, str(cycle), segment) for name in names), droop)
    rise_s, why = _rise(t, done)
    metrics = [
        measured("overshoot_pct", 100.0 * max(0.0, float(done.max()) - 1.0), "", segment),
        measured("rise_time_s", rise_s, why, segment),
    ]
    for name, band in (("settling_time_5pct_s", 0.05), ("settling_time_2pct_s", 0.02)):
        settling_s = _settling(t, done, band)
        why = "" if settling_s is not None else _unsettled(done, band, droop_deg)
        metrics.append(measured(name, settling_s, why, segment))
    return (*metrics, droop)


def track_metrics(
    t_s: FloatArray,
    phi_rad: FloatArray,
    phi_sp_rad: FloatArray,
    *,
    start_s: float,
    end_s: float,
    segment: str = "",
) -> tuple[Metric, ...]:
    """How well the roll angle follows its set-point between two times.

    VAF = 100 (1 - var(phi_sp - phi) / var(phi_sp)), which is mostly lag; the lag is where the
    cross-correlation of the two peaks, and the VAF with the lag removed compares phi at t + lag with phi_sp
    at t.

    Args:
        t_s: (n,) s.
        phi_rad: (n,).
        phi_sp_rad: (n,) set-point in force, as the vehicle reports it.
        start_s: first set-point sent.
        end_s: end of the signal.
        segment: name for the metrics.
    """
    names = ("vaf_pct", "rms_error_deg", "lag_s", "vaf_lag_removed_pct")
    rows = _rows(t_s, start_s, end_s)
    hole = _hole(t_s[rows], start_s, end_s)
    if hole:
        return tuple(measured(name, None, hole, segment) for name in names)
    t = np.asarray(t_s[rows], dtype=np.float64)
    phi, phi_sp = (np.asarray(x[rows], dtype=np.float64) for x in (phi_rad, phi_sp_rad))
    if not np.all(np.isfinite(phi_sp)):
        reason = "the vehicle reported no roll set-point"
        return tuple(measured(name, None, reason, segment) for name in names)
    rms = measured("rms_error_deg", math.degrees(math.sqrt(_mean(t, (phi_sp - phi) ** 2))), "", segment)
    moves = _variance(t, phi_sp)
    if moves < MOVES_RAD**2:
        reason = f"the set-point hardly moves ({math.degrees(math.sqrt(moves)):.2g} deg): no excitation"
        return tuple(rms if name == rms.name else measured(name, None, reason, segment) for name in names)
    vaf = measured("vaf_pct", 100.0 * (1.0 - _variance(t, phi_sp - phi) / moves), "", segment)
    lag_s, reason = _lag(t, phi, phi_sp)
    left = None if lag_s is None else _vaf_without_lag(t, phi, phi_sp, lag_s)
    return (
        vaf,
        rms,
        measured("lag_s", lag_s, reason, segment),
        measured("vaf_lag_removed_pct", left, reason, segment),
    )


def effort_metrics(
    t_s: FloatArray, delta_lat: FloatArray, *, start_s: float, end_s: float, segment: str = ""
) -> tuple[Metric, ...]:
    """Peak and RMS of the normalised roll torque between two times.

    Args:
        t_s: (n,) s.
        delta_lat: (n,) as the motors produce it; NaN where it was not reported.
        start_s: of the window.
        end_s: of the window.
        segment: name for the metrics.
    """
    names = ("peak_delta_lat", "rms_delta_lat")
    rows = _rows(t_s, start_s, end_s)
    t, delta = t_s[rows], np.asarray(delta_lat[rows], dtype=np.float64)
    known = np.isfinite(delta)
    if known.sum() < 2:
        return tuple(measured(name, None, "no motor commands reported", segment) for name in names)
    rms = math.sqrt(_mean(t[known], delta[known] ** 2))
    peak = float(np.abs(delta[known]).max())
    return measured(names[0], peak, "", segment), measured(names[1], rms, "", segment)


def divergence(t_s: FloatArray, phi_rad: FloatArray, theta_rad: FloatArray) -> str:
    """Why this is no flight any more: the first time roll or pitch passes 80 degrees; empty if never."""
    beyond = np.flatnonzero((np.abs(phi_rad) > DIVERGED_RAD) | (np.abs(theta_rad) > DIVERGED_RAD))
    if not len(beyond):
        return ""
    first = int(beyond[0])
    axis = "roll" if abs(phi_rad[first]) > DIVERGED_RAD else "pitch"
    return f"diverged: {axis} beyond {math.degrees(DIVERGED_RAD):g} deg at {t_s[first]:.2f} s"


def _rise(t: FloatArray, done: FloatArray) -> tuple[float | None, str]:
    last = _first_crossing(t, done, 0.9)
    if last is None:
        return None, f"never reaches 90 %: at most {100 * float(done.max()):.1f} %"
    first = _first_crossing(t, done, 0.1)
    assert first is not None
    return last - first, ""


def _first_crossing(t: FloatArray, done: FloatArray, level: float) -> float | None:
    above = np.flatnonzero(done >= level)
    if not len(above):
        return None
    k = int(above[0])
    return _crossing(t, done, k - 1, k, level) if k else float(t[0])


def _settling(t: FloatArray, done: FloatArray, band: float) -> float | None:
    """Last time outside the band; None if the last sample still is."""
    outside = np.flatnonzero(np.abs(done - 1.0) > band)
    if not len(outside):
        return float(t[0])
    k = int(outside[-1])
    if k == len(t) - 1:
        return None
    return _crossing(t, done, k, k + 1, 1.0 + math.copysign(band, done[k] - 1.0))


def _unsettled(done: FloatArray, band: float, droop_deg: float | None) -> str:
    was = "leaves" if np.any(np.abs(done - 1.0) <= band) else "never enters"
    droop = "" if droop_deg is None else f": droop {droop_deg:.2f} deg at the end of the hold"
    return f"{was} the {100 * band:g} % band{droop}"


def _crossing(t: FloatArray, y: FloatArray, a: int, b: int, level: float) -> float:
    if y[a] == y[b]:
        return float(t[b])
    return float(t[a] + (t[b] - t[a]) * (level - y[a]) / (y[b] - y[a]))


def _lag(t: FloatArray, phi: FloatArray, phi_sp: FloatArray) -> tuple[float | None, str]:
    """Delay of phi behind phi_sp, s, at the peak of their cross-correlation; None with the reason if none."""
    step = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1] + 0.5 * step, step)
    x = _held(t, phi_sp, even)
    y = np.interp(even, t, phi)
    x, y = x - x.mean(), y - y.mean()
    most = min(round(MOST_LAG_S / step), len(even) // 4)
    size = 2 ** math.ceil(math.log2(2 * len(even)))
    spectrum = np.conj(np.fft.rfft(x, size)) * np.fft.rfft(y, size)
    correlation = np.fft.irfft(spectrum, size)[: most + 1]
    k = int(np.argmax(correlation))
    strength = float(correlation[k] / math.sqrt(float(x @ x) * float(y @ y) + 1e-300))
    if strength < 0.5:
        return None, f"set-point and roll angle hardly correlate ({strength:.2f})"
    if k == most:
        return None, f"the lag exceeds {most * step:.2g} s"
    if k == 0:
        return 0.0, ""
    before, peak, after = (float(c) for c in correlation[k - 1 : k + 2])
    bend = before - 2 * peak + after
    return (k + (0.5 * (before - after) / bend if bend else 0.0)) * step, ""


def _vaf_without_lag(t: FloatArray, phi: FloatArray, phi_sp: FloatArray, lag_s: float) -> float:
    covered = t + lag_s <= t[-1]
    later = np.interp(t[covered] + lag_s, t, phi)
    left = _variance(t[covered], phi_sp[covered] - later)
    return 100.0 * (1.0 - left / _variance(t[covered], phi_sp[covered]))


def _held(t: FloatArray, signal: FloatArray, at: FloatArray) -> FloatArray:
    """Zero-order hold: the last value at or before each time."""
    return np.asarray(signal[np.maximum(np.searchsorted(t, at + 1e-9, side="right") - 1, 0)])


def _rows(t: FloatArray, start_s: float, end_s: float) -> slice:
    """Rows with start <= t < end; a microsecond of rounding does not matter."""
    first, last = np.searchsorted(t, [start_s - 1e-6, end_s - 1e-6])
    return slice(int(first), int(last))


def _hole(t: FloatArray, start_s: float, end_s: float) -> str:
    """Why the samples do not cover the window; empty if they do."""
    if len(t) < 8:
        return f"only {len(t)} samples"
    gap = float(np.diff(np.concatenate([[start_s], t, [end_s]])).max())
    return f"a gap of {gap:.2f} s in the telemetry" if gap > LARGEST_GAP_S else ""


def _mean(t: FloatArray, signal: FloatArray) -> float:
    return float(np.trapezoid(signal, t) / (t[-1] - t[0]))


def _variance(t: FloatArray, signal: FloatArray) -> float:
    return _mean(t, (signal - _mean(t, signal)) ** 2)
