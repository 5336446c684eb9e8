"""The metrics of `scenarios.metrics` on a whole block of simulated flights at once, without keeping their traces.

The definitions are those of that module; here the samples are evenly spaced ticks, and many flights are measured side
by side in compiled lanes. NaN stands for UNSET. A test holds both to the same numbers on the same traces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scenarios.batch_tracking import TRACK, track_block
from scenarios.limits import LIMIT_CYCLE_RAD_S
from scenarios.manoeuvres import Window
from scenarios.metrics import LAST_S, MOST_LAG_S, MOVES_RAD, SETTLE_S
from sitl.batch import LANES
from sitl.compiled import compiled, select

FloatArray = npt.NDArray[np.float64]

STEP = ("overshoot_pct", "rise_time_s", "settling_time_5pct_s", "settling_time_2pct_s", "droop_deg")
OSCILLATION = ("oscillation_rad_s",)
EFFORT = ("peak_delta_lat", "rms_delta_lat")
MEASURED = (*STEP, *TRACK, *OSCILLATION, *EFFORT)
"""Metrics of a pair, in the order of the rows of an array of values."""

_TRACK, _SHAKE = len(STEP), len(STEP) + len(TRACK)
_EFFORT = _SHAKE + len(OSCILLATION)
STEP_ROWS, TRACK_ROWS = range(_TRACK), range(_TRACK, _SHAKE)
SHAKE_ROWS, EFFORT_ROWS = range(_SHAKE, _EFFORT), range(_EFFORT, len(MEASURED))

_HIGHEST, _LOWEST, _LARGEST, _KNOWN = range(4)
_SENSE = {"vaf_pct": _LOWEST, "vaf_lag_removed_pct": _LOWEST, "droop_deg": _LARGEST, "oscillation_rad_s": _KNOWN}
SENSES = np.array([_SENSE.get(name, _HIGHEST) for name in MEASURED])
"""Which of two windows' values is the worse."""

_BANDS, _RISE = (0.05, 0.02), (-0.9, -0.1)
_STEP_KIND, _TRACK_KIND, _HOLD_KIND = 0.0, 1.0, 2.0
_KINDS = {"step": _STEP_KIND, "track": _TRACK_KIND, "hold": _HOLD_KIND}
_STRETCH = 32
"""Ticks whose extremes are kept together."""


@compiled
def _crossing(phi: FloatArray, j: int, a: int, b: int, level: float) -> float:
    """Tick, as a fraction, at which a lane goes through a level between ticks a and b."""
    if phi[a, j] == phi[b, j]:
        return float(b)
    share: float = (level - phi[a, j]) / (phi[b, j] - phi[a, j])
    return a + (b - a) * share


@compiled
def worse(sense: int, held: float, new: float) -> float:
    """The worse of two windows' values; `held` is -inf before the first, and NaN is worse than any number.

    The oscillation alone passes over a window that is too short to tell.
    """
    first, unknown = held == -math.inf, (new != new) | (held != held)
    lowest = select(first, new, select(held < new, held, new))
    highest = select(held > new, held, new)
    largest = select(first | (abs(new) > abs(held)), new, held)
    known = select(new != new, held, highest)
    ordered = select(sense == _LOWEST, lowest, select(sense == _LARGEST, largest, highest))
    return select(sense == _KNOWN, known, select(unknown, math.nan, ordered))


@compiled
def _effort(delta: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Peak and RMS of every lane; x: (2, LANES) of zeros. out: rows in the order of EFFORT."""
    for t in range(len(delta)):
        for j in range(LANES):
            u = abs(delta[t, j])
            x[0, j] = select(u > x[0, j], u, x[0, j])
            x[1, j] += u * u
    _effort_of(delta, x, out)


@compiled
def _effort_of(delta: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """From the peaks and the sums of squares; by the trapezoid rule the ends count half."""
    last = len(delta) - 1
    for j in range(LANES):
        ends = delta[0, j] ** 2 + delta[last, j] ** 2
        out[0, j] = x[0, j]
        out[1, j] = math.sqrt(max(0.0, x[1, j] - 0.5 * ends) / last)


@compiled
def _shake(p: FloatArray, ticks: int, out: FloatArray) -> None:
    """Standard deviation of every lane over the last ticks, by the trapezoid rule; NaN where they are 0.

    Summed up from the first value on: a rate that has come to rest somewhere else loses no digits.
    """
    begin = len(p) - ticks
    if not ticks:
        for j in range(LANES):
            out[j] = math.nan
        return
    x = np.zeros((2, LANES))
    for t in range(begin, len(p)):
        for j in range(LANES):
            e = p[t, j] - p[begin, j]
            x[0, j] += e
            x[1, j] += e * e
    for j in range(LANES):
        e = p[len(p) - 1, j] - p[begin, j]
        mean = (x[0, j] - 0.5 * e) / (ticks - 1)
        out[j] = math.sqrt(max(0.0, (x[1, j] - 0.5 * e * e) / (ticks - 1) - mean * mean))


@compiled
def _step(
    phi: FloatArray,
    delta: FloatArray,
    dt_s: float,
    phi_from: float,
    phi_to: float,
    last_ticks: int,
    out: FloatArray,
    effort: FloatArray,
) -> None:
    """Overshoot, rise, settling and droop of every lane, and its effort on the way.

    The lanes are gone through once, for their extremes in every stretch of ticks. In which tick a lane goes through a
    level is then looked for in the one stretch whose extremes say so.

    Args:
        phi, delta: (T, LANES), from the tick of the step to the last before the next set-point. dt_s: tick, s.
        phi_from, phi_to: set-points, rad, not equal. last_ticks: ticks of droop, 0 if the hold is too short for it.
        out: rows in the order of STEP. effort: rows in the order of EFFORT.
    """
    ticks = len(phi)
    stretches = (ticks + _STRETCH - 1) // _STRETCH
    # one array: the compiler sees that its rows do not overlap, and the loop over lanes uses the vector unit
    x, extremes = np.zeros((5, LANES)), np.empty((stretches, 2, LANES))
    for i in range(stretches):
        begin = i * _STRETCH
        for j in range(LANES):
            x[0, j] = x[1, j] = phi[begin, j]
        for t in range(begin, min(begin + _STRETCH, ticks)):
            for j in range(LANES):
                angle, u = phi[t, j], abs(delta[t, j])
                x[0, j] = select(angle > x[0, j], angle, x[0, j])
                x[1, j] = select(angle < x[1, j], angle, x[1, j])
                x[3, j] = select(u > x[3, j], u, x[3, j])
                x[4, j] += u * u
        for j in range(LANES):
            extremes[i, 0, j] = x[0, j]
            extremes[i, 1, j] = x[1, j]
    for t in range(ticks - last_ticks, ticks):
        for j in range(LANES):
            x[2, j] += phi[t, j] - phi_to
    _effort_of(delta, x[3:], effort)
    amplitude = phi_to - phi_from
    per_rad = 1.0 / amplitude
    ends = np.empty(2)
    for j in range(LANES):
        # in all that follows an error is a share of the amplitude: -1 before the step
        largest, reached = -math.inf, 0
        for i in range(stretches):
            high, low = (extremes[i, 0, j] - phi_to) * per_rad, (extremes[i, 1, j] - phi_to) * per_rad
            top = max(high, low)
            largest = max(largest, top)
            while reached < 2 and top >= _RISE[reached]:
                k = _first_beyond(phi, j, i * _STRETCH, phi_to, per_rad, _RISE[reached])
                level = phi_from + (1.0 + _RISE[reached]) * amplitude
                ends[reached] = _crossing(phi, j, k - 1, k, level) if k else 0.0
                reached += 1
        out[0, j] = 100.0 * max(0.0, largest)
        out[1, j] = (ends[1] - ends[0]) * dt_s if reached == 2 else math.nan
        for band in range(2):
            k = -1
            for i in range(stretches - 1, -1, -1):
                high, low = abs(extremes[i, 0, j] - phi_to), abs(extremes[i, 1, j] - phi_to)
                if max(high, low) * abs(per_rad) > _BANDS[band]:
                    k = _last_outside(phi, j, i * _STRETCH, phi_to, per_rad, _BANDS[band])
                    break
            if k < 0:
                out[2 + band, j] = 0.0
            elif k == ticks - 1:
                out[2 + band, j] = math.nan
            else:
                side = math.copysign(_BANDS[band], (phi[k, j] - phi_to) * per_rad)
                out[2 + band, j] = _crossing(phi, j, k, k + 1, phi_from + (1.0 + side) * amplitude) * dt_s
        out[4, j] = math.nan
        if last_ticks > 1:
            twice = phi[ticks - last_ticks, j] + phi[ticks - 1, j] - 2.0 * phi_to
            error = (x[2, j] - 0.5 * twice) / (last_ticks - 1)
            out[4, j] = math.degrees(error if amplitude > 0.0 else -error)


@compiled
def _first_beyond(phi: FloatArray, j: int, begin: int, phi_to: float, per_rad: float, level: float) -> int:
    """First tick of a stretch at which a lane's error is at a level or above; there is one."""
    t = begin
    while (phi[t, j] - phi_to) * per_rad < level:
        t += 1
    return t


@compiled
def _last_outside(phi: FloatArray, j: int, begin: int, phi_to: float, per_rad: float, band: float) -> int:
    """Last tick of a stretch at which a lane's error is outside a band; there is one."""
    t = min(begin + _STRETCH, len(phi)) - 1
    while abs(phi[t, j] - phi_to) * abs(per_rad) <= band:
        t -= 1
    return t


@compiled
def measure_block(
    flown: FloatArray,
    windows: FloatArray,
    dt_s: float,
    values: FloatArray,
    places: npt.NDArray[np.int64],
    senses: npt.NDArray[np.int64],
    lost: npt.NDArray[np.bool_],
    ever_lost: npt.NDArray[np.bool_],
) -> None:
    """Measure all windows of a block but for their tracking, and keep the worse of each and of what is there.

    Args:
        flown: (3, T, LANES), see `Block`. windows: of `window_table`. dt_s: tick, s.
        values: (len(MEASURED), pairs) of all pairs, to be changed. places: (n,) column of each lane's pair.
        senses: SENSES. lost: (n,) of the block. ever_lost: (pairs,) to be changed.
    """
    n = len(places)
    for j in range(n):
        ever_lost[places[j]] |= lost[j]
    found = np.empty((len(senses), LANES))
    for w in range(len(windows)):
        kind, first, behind = windows[w, 0], int(windows[w, 1]), int(windows[w, 2])
        phi, p, delta = flown[0, first:behind], flown[1, first:behind], flown[2, first:behind]
        if kind == _STEP_KIND:
            _step(phi, delta, dt_s, windows[w, 3], windows[w, 4], int(windows[w, 5]), found[:_TRACK], found[_EFFORT:])
        else:
            _effort(delta, np.zeros((2, LANES)), found[_EFFORT:])
        if kind != _TRACK_KIND:
            _shake(p, int(windows[w, 6]), found[_SHAKE])
        for row in range(len(senses)):
            if row < _TRACK:
                measured = kind == _STEP_KIND
            elif row < _SHAKE:
                measured = False
            else:
                measured = row >= _EFFORT or kind != _TRACK_KIND
            if measured:
                for j in range(n):
                    values[row, places[j]] = worse(senses[row], values[row, places[j]], found[row, j])


@compiled
def merge_rows(
    found: FloatArray, first: int, values: FloatArray, places: npt.NDArray[np.int64], senses: npt.NDArray[np.int64]
) -> None:
    """Keep the worse of new values and of what is there.

    Args:
        found: (k, lanes) of rows `first` and on. values, places, senses: as `measure_block`.
    """
    for row in range(len(found)):
        for j in range(len(places)):
            at = places[j]
            values[first + row, at] = worse(senses[first + row], values[first + row, at], found[row, j])


def window_table(windows: Sequence[Window], dt_s: float) -> FloatArray:
    """Windows as compiled code reads them.

    Args:
        windows: of a manoeuvre. dt_s: tick, s.

    Returns:
        a row each: kind, first tick, tick behind the last, set-points before and after, ticks of droop and of
        oscillation at the end (0: too short to tell).
    """
    rows = []
    for one in windows:
        first, behind = round(one.start_s / dt_s), round(one.end_s / dt_s)
        hold_s, last = (behind - first) * dt_s, round(LAST_S / dt_s)
        droop = last if hold_s >= LAST_S - 1e-9 else 0
        shake = last if hold_s >= LAST_S + SETTLE_S - 1e-6 else 0
        rows.append([_KINDS[one.kind], first, behind, one.phi_from_rad, one.phi_to_rad, droop, shake])
    return np.array(rows, dtype=np.float64)


def measure_track(phi: FloatArray, phi_sp: FloatArray, dt_s: float) -> FloatArray:
    """(4, n) in the order of TRACK; arguments as `track_block`."""
    out = np.empty((len(TRACK), phi.shape[1]))
    track_block(phi, phi_sp, dt_s, min(round(MOST_LAG_S / dt_s), len(phi_sp) // 4), MOVES_RAD**2, out)
    return out


def is_limit_cycle(oscillation_rad_s: FloatArray) -> npt.NDArray[np.bool_]:
    """Which lanes shake more than an ended manoeuvre explains; NaN does not."""
    return np.asarray(np.nan_to_num(oscillation_rad_s) > LIMIT_CYCLE_RAD_S)
