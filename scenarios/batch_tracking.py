"""Tracking metrics of a whole block of simulated flights: VAF, error, lag, and VAF with the lag taken off.

The definitions are those of `scenarios.metrics.track_metrics`. The set-point is held between the messages that bring
it, which makes its correlation with a roll angle a sum over its jumps: that is what makes this fast.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sitl.compiled import compiled

FloatArray = npt.NDArray[np.float64]

TRACK = ("vaf_pct", "rms_error_deg", "lag_s", "vaf_lag_removed_pct")

_COARSE = 8
"""Ticks between two lags that are tried first; a roll angle does not change its mind faster."""


@compiled
def _jumps(x: FloatArray) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Where a held signal changes and by how much, its beginning and end included: (ticks, downward jumps)."""
    places, sizes = np.empty(len(x) + 1, dtype=np.int64), np.empty(len(x) + 1)
    count, before = 0, 0.0
    for t in range(len(x) + 1):
        value = x[t] if t < len(x) else 0.0
        if value != before or t in (0, len(x)):
            places[count] = t
            sizes[count] = before - value
            before = value
            count += 1
    return places[:count], sizes[:count]


@compiled
def _correlate(places: npt.NDArray[np.int64], sizes: FloatArray, sums: FloatArray, lag: int, value: FloatArray) -> None:
    """Cross-correlation of a held signal with every lane at one lag.

    The set-point is held between the messages that bring it, so the sum over ticks is one over its jumps, with the
    lanes summed up beforehand.

    Args:
        places, sizes: of `_jumps`. sums: (T + 1, n) sums of the lanes. lag: ticks. value: (n,) output.
    """
    last = len(sums) - 1
    for j in range(len(value)):
        value[j] = 0.0
    for k in range(len(places)):
        row, size = min(places[k] + lag, last), sizes[k]
        for j in range(len(value)):
            value[j] += size * sums[row, j]


@compiled
def _lags(phi_sp: FloatArray, phi: FloatArray, most: int, lags: FloatArray, shares: FloatArray) -> None:
    """Lag of every lane behind the set-point, and what is left unexplained when it is taken off.

    Args:
        phi_sp: (T,). phi: (T, n). most: ticks.
        lags: (n,) output: where the cross-correlation peaks, in ticks; NaN if it does not.
        shares: (n,) output: variance of phi_sp - phi(t + lag) over that of phi_sp; NaN without a lag.
    """
    ticks, n = phi.shape
    x = phi_sp - np.mean(phi_sp)
    places, sizes = _jumps(x)
    mean, peaks = np.zeros(n), np.full(n, -math.inf)
    for t in range(ticks):
        for j in range(n):
            mean[j] += phi[t, j]
    for j in range(n):
        mean[j] /= ticks
    sums = np.zeros((ticks + 1, n))
    # sums of y^2 and of y times the y before
    power, neighbours = np.zeros(n), np.zeros(n)
    for t in range(ticks):
        back = max(t - 1, 0)
        share = 1.0 if t else 0.0
        for j in range(n):
            y = phi[t, j] - mean[j]
            sums[t + 1, j] = sums[t, j] + y
            power[j] += y * y
            neighbours[j] += share * y * (phi[back, j] - mean[j])
    value = np.empty((most + 2, n))
    low, high = most, 0
    for lag in range(0, most + 1, _COARSE):
        _correlate(places, sizes, sums, lag, value[lag])
        for j in range(n):
            if value[lag, j] > peaks[j]:
                peaks[j] = value[lag, j]
                lags[j] = lag
    for j in range(n):
        low, high = min(low, int(lags[j])), max(high, int(lags[j]))
    low, high = max(0, low - _COARSE), min(most, high + _COARSE)
    for lag in range(low, high + 1):
        if lag % _COARSE:
            _correlate(places, sizes, sums, lag, value[lag])
    totals = np.zeros((2, ticks + 1))
    for t in range(ticks):
        totals[0, t + 1] = totals[0, t] + x[t]
        totals[1, t + 1] = totals[1, t] + x[t] * x[t]
    wanted = totals[1, ticks]
    for j in range(n):
        coarse = int(lags[j])
        best = coarse
        for lag in range(max(low, coarse - _COARSE + 1), min(high, coarse + _COARSE - 1) + 1):
            if value[lag, j] > value[best, j]:
                best = lag
        peak = value[best, j]
        lags[j] = shares[j] = math.nan
        if not peak / math.sqrt(wanted * power[j] + 1e-300) >= 0.5 or best == most:
            continue
        lags[j] = float(best)
        if best > 0:
            before, after = value[best - 1, j], value[best + 1, j]
            bend = before - 2.0 * peak + after
            lags[j] += 0.5 * (before - after) / bend if bend != 0.0 else 0.0
        whole = int(lags[j])
        shares[j] = _unexplained(
            x, totals, phi, j, mean[j], lags[j], value[whole, j], value[whole + 1, j], power[j], neighbours[j]
        )


@compiled
def _unexplained(
    x: FloatArray,
    totals: FloatArray,
    phi: FloatArray,
    j: int,
    mean: float,
    lag: float,
    near: float,
    far: float,
    power: float,
    neighbours: float,
) -> float:
    """Variance of x(t) - y(t + lag) over that of x, where y = phi - mean is known; trapezoid rule, y linear in between.

    All its sums over time are known from the correlation but for a few terms at the ends, so no time is gone through
    again: with e = x - (1 - f) y0 - f y1, y0 and y1 being y some whole ticks and one more later, the square of e falls
    into those sums.

    Args:
        x: (T,) set-point without its mean. totals: (2, T + 1) sums of x and x^2 up to each tick.
        phi: (T, n), lane j of it. mean: of the lane. lag: ticks.
        near, far: correlation of x and y at the whole ticks of the lag and at one more.
        power, neighbours: sums of y^2 and of y times the y before.
    """
    whole = int(lag)
    f = lag - whole
    if f < 1e-9:
        f = 0.0
    count = len(x) - whole - (1 if f > 0.0 else 0)
    # sums over t < count of: x, x^2, y0, y0^2, y1, y1^2, y0 y1, x y0, x y1
    sx, sxx, sy0, sy00, sy1, sy11 = totals[0, count], totals[1, count], 0.0, power, 0.0, 0.0
    sy01, sx0, sx1 = neighbours, near, far
    total = 0.0
    for t in range(whole):
        y, after = phi[t, j] - mean, phi[t + 1, j] - mean
        total += y
        sy00 -= y * y
        sy01 -= y * after
    first, last = phi[whole, j] - mean, phi[len(x) - 1, j] - mean
    # the whole of y adds up to nothing
    sy0 = -total
    if f > 0.0:
        sy0 -= last
        sy00 -= last * last
        sx0 -= x[count] * last
        sy1 = sy0 - first + last
        sy11 = sy00 - first * first + last * last
    e1 = sx - (1.0 - f) * sy0 - f * sy1
    e2 = (
        sxx
        + (1.0 - f) ** 2 * sy00
        + f * f * sy11
        + 2.0 * (f * (1.0 - f) * sy01 - (1.0 - f) * sx0 - (f * sx1 if f > 0.0 else 0.0))
    )
    # the ends count half
    for t in (0, count - 1):
        y0 = phi[t + whole, j] - mean
        y1 = phi[t + whole + 1, j] - mean if f > 0.0 else 0.0
        e = x[t] - (1.0 - f) * y0 - f * y1
        e1 -= 0.5 * e
        e2 -= 0.5 * e * e
        sx -= 0.5 * x[t]
        sxx -= 0.5 * x[t] * x[t]
    span = count - 1
    share: float = (e2 / span - (e1 / span) ** 2) / (sxx / span - (sx / span) ** 2)
    return share


@compiled
def track_block(phi: FloatArray, phi_sp: FloatArray, dt_s: float, most_lag: int, moves: float, out: FloatArray) -> None:
    """VAF, RMS error, lag and VAF without lag of every lane.

    Args:
        phi: (T, n) rad. phi_sp: (T,) rad. dt_s: tick, s. most_lag: ticks. moves: least variance of phi_sp, rad^2.
        out: (4, n) output, in the order of TRACK.
    """
    ticks, n = phi.shape
    level, spread = 0.0, 0.0
    for t in range(ticks):
        level += (0.5 if t in (0, ticks - 1) else 1.0) * phi_sp[t] / (ticks - 1)
    for t in range(ticks):
        spread += (0.5 if t in (0, ticks - 1) else 1.0) * (phi_sp[t] - level) ** 2 / (ticks - 1)
    x = np.zeros((2, n))
    for t in range(ticks):
        weight = 0.5 if t in (0, ticks - 1) else 1.0
        for j in range(n):
            e = phi_sp[t] - phi[t, j]
            x[0, j] += weight * e
            x[1, j] += weight * e * e
    lags, shares = np.full(n, math.nan), np.full(n, math.nan)
    moving = spread >= moves
    if moving:
        _lags(phi_sp, phi, most_lag, lags, shares)
    for j in range(n):
        square = x[1, j] / (ticks - 1)
        out[1, j] = math.degrees(math.sqrt(square))
        out[0, j] = 100.0 * (1.0 - (square - (x[0, j] / (ticks - 1)) ** 2) / spread) if moving else math.nan
        out[2, j] = lags[j] * dt_s
        out[3, j] = 100.0 * (1.0 - shares[j])
