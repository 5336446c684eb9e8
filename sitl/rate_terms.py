"""What P, I, D and FF of the roll rate loop gave, worked out again from what was recorded of a flight.

PX4 does not send the terms over MAVLink, and of the rate set-points only those that follow a new attitude set-point,
fifty a second. All of them follow from attitude, roll rate and gains by the laws and the filters that fly
(`attitude_control`, `rate_control`, `filters`): the rate law is asked for one term at a time, the other gains at zero.
What cannot be known from a recording that begins in the air is where the integrator stood: it is what is left of the
torque that the motors produced, over the first tenth of a second of every stretch that was sampled fast enough.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.actuators import ACHIEVED, FLT_EPSILON
from sitl.attitude_control import attitude_control, linear_attitude_control
from sitl.compiled import Record, compiled
from sitl.filters import PASS_THROUGH, biquad, settle_biquad, slope_step
from sitl.rate_control import rate_control
from sitl.rotation import from_euler

FloatArray = NDArray[np.float64]

TERMS = ("P", "I", "D", "FF")
"""Columns of what comes out."""

COLUMNS = ("t_s", "phi_rad", "theta_rad", "psi_rad", "phi_sp_rad", "theta_sp_rad", "psi_sp_rad", "p_rad_s", "delta_lat")
"""Telemetry that it takes."""

SLOWEST_S = 0.015
"""Rows further apart than this are no samples of the rate loop any more; nothing is worked out of them."""

ANCHOR_ROWS = 25
"""Rows over which the integrator's beginning is found; gyro noise averages out."""

_STATE = np.dtype(
    [
        ("low_pass", "f8", (2,)),
        ("notches", "f8", (2, 2)),
        ("rate", "f8"),
        ("accel", "f8"),
        ("integral", "f8"),
        ("rate_sp", "f8"),
        ("positive", "?"),
        ("negative", "?"),
        ("age", "i8"),
        ("begun", "?"),
    ],
    align=True,
)


@compiled
def _wanted_rate(s: Record, euler: FloatArray, euler_sp: FloatArray) -> float:
    """Roll rate set-point of the attitude law, rad/s.

    Args:
        s: of CONTROL_SETTINGS. euler, euler_sp: (3,) roll, pitch, heading and their set-points, rad.
    """
    gain = (s.att_gain[0], s.att_gain[1], s.att_gain[2])
    if s.linear:
        angles = (euler[0], euler[1], euler[2])
        wanted = (euler_sp[0], euler_sp[1], euler_sp[2])
        return linear_attitude_control(angles, wanted, gain)[0]
    quat, quat_sp = from_euler(euler[0], euler[1], euler[2]), from_euler(euler_sp[0], euler_sp[1], euler_sp[2])
    rate_max = (s.rate_max[0], s.rate_max[1], s.rate_max[2])
    return attitude_control(quat, quat_sp, gain, s.yaw_weight, rate_max, math.nan)[0]


@compiled
def _rate_terms(
    settings_array: NDArray[np.void],
    state_array: NDArray[np.void],
    dt_s: FloatArray,
    euler: FloatArray,
    euler_sp: FloatArray,
    rate: FloatArray,
    given: FloatArray,
    out: FloatArray,
) -> None:
    """One stretch: see `RateTerms`.

    Args:
        settings_array: (1,) of CONTROL_SETTINGS. state_array: (1,) of _STATE, updated in place.
        dt_s: (n,) since the row before, s. euler, euler_sp: (n, 3) roll, pitch, heading and their set-points, rad.
        rate: (n,) roll rate, rad/s. given: (n,) torque that the motors produced, NaN where unknown.
        out: (n, 4) output: the terms.
    """
    s: Record = settings_array[0]
    x: Record = state_array[0]
    k, kp, ki, kd, kff, int_lim = s.k[0], s.kp[0], s.ki[0], s.kd[0], s.kff[0], s.int_lim[0]
    for row in range(len(rate)):
        sample = rate[row]
        for i in range(s.notch_count):
            if not x.begun:
                settle_biquad(s.notches[i], x.notches[i], sample)
            sample = biquad(s.notches[i], x.notches[i], sample)
        if not x.begun:
            settle_biquad(s.low_pass, x.low_pass, sample)
        y = biquad(s.low_pass, x.low_pass, sample)
        rate_sp = _wanted_rate(s, euler[row], euler_sp[row])
        if x.begun:
            x.accel = slope_step(x.accel, y, x.rate, s.dgyro_alpha, dt_s[row])
        else:
            x.rate_sp = rate_sp
        x.begun = True
        x.rate = y
        wanted = x.rate_sp if s.rate_sp_late else rate_sp
        x.rate_sp = rate_sp
        up, down, dt = x.positive, x.negative, dt_s[row]
        out[row, 0], _ = rate_control(y, wanted, 0.0, 0.0, k, kp, 0.0, 0.0, 0.0, int_lim, up, down, True, dt)
        out[row, 1] = x.integral
        out[row, 2], _ = rate_control(y, y, x.accel, 0.0, k, 0.0, 0.0, kd, 0.0, int_lim, up, down, True, dt)
        out[row, 3], _ = rate_control(y, wanted, 0.0, 0.0, k, 0.0, 0.0, 0.0, kff, int_lim, up, down, True, dt)
        torque, x.integral = rate_control(
            y, wanted, x.accel, x.integral, k, kp, ki, kd, kff, int_lim, up, down, False, dt
        )
        x.age += 1
        if s.limits and x.age >= s.status_ticks:
            x.age = 0
            missing = torque - given[row]
            wanting = missing * missing >= ACHIEVED
            x.positive = wanting and missing > FLT_EPSILON
            x.negative = wanting and missing < -FLT_EPSILON


@dataclass(frozen=True)
class TermRows:
    """Terms of some rows, normalised roll torque; NaN where they cannot be known.

    Attributes:
        t_s: (n,) vehicle time, s.
        terms: (n, 4) in the order of `TERMS`.
    """

    t_s: FloatArray
    terms: FloatArray


class RateTerms:
    """Works the terms out while rows come.

    Args:
        settings: (1,) of CONTROL_SETTINGS, for the rate at which rows come.
    """

    def __init__(self, settings: NDArray[np.void]) -> None:
        self._settings = settings.copy()
        self._settings_filtered = settings.copy()
        self._settings_filtered["low_pass"] = PASS_THROUGH
        self._settings_filtered["notch_count"] = 0
        self._state = np.zeros(1, _STATE)
        self._filters = True
        self._last_sp: FloatArray | None = None
        self._last_s = -math.inf
        self._held = np.zeros((0, len(COLUMNS) + 1))
        self._run(self._settings, self._state, self._held, np.zeros(0))  # compiled now, not in the middle of a flight

    def push(self, columns: Mapping[str, NDArray[Any]], raw: NDArray[np.bool_]) -> TermRows:
        """Take rows; a beginning too short to find the integrator is held back.

        Args:
            columns: `COLUMNS` of (n,) each, later than everything before.
            raw: (n,) the rate is not filtered yet: a simulator's truth.
        """
        rows = np.column_stack([*(columns[name] for name in COLUMNS), raw]).astype(np.float64)
        if len(rows):
            # a set-point is reported when it arrives and flown from the next row on
            reported = rows[:, _PARTS[1]].copy()
            rows[0, _PARTS[1]] = reported[0] if self._last_sp is None else self._last_sp
            rows[1:, _PARTS[1]] = reported[:-1]
            self._last_sp = reported[-1]
        return self._work(np.concatenate([self._held, rows]), last=False)

    def finish(self) -> TermRows:
        """What was held back."""
        return self._work(self._held, last=True)

    def _work(self, rows: FloatArray, *, last: bool) -> TermRows:
        self._held = rows[:0]
        gaps = np.diff(rows[:, 0], prepend=self._last_s)
        edges = np.unique(np.concatenate([[0], np.flatnonzero(gaps > SLOWEST_S), [len(rows)]]))
        firsts, ends = edges[:-1], edges[1:]
        new = gaps[firsts] > SLOWEST_S
        if len(firsts) and new[-1] and not last and ends[-1] - firsts[-1] < ANCHOR_ROWS:
            rows, self._held = rows[: firsts[-1]], rows[firsts[-1] :]
            firsts, ends, new = firsts[:-1], ends[:-1], new[:-1]
        done = np.full((len(rows), len(TERMS)), math.nan)
        # where telemetry is slow every row stands alone, and nothing is known
        known = ~new | (ends - firsts > 1)
        for first, end, begins in zip(firsts[known], ends[known], new[known], strict=True):
            done[first:end] = self._stretch(rows[first:end], gaps[first:end], new=bool(begins))
        if len(rows):
            self._last_s = float(rows[-1, 0])
        return TermRows(rows[:, 0], done)

    def _stretch(self, rows: FloatArray, gaps: FloatArray, *, new: bool) -> FloatArray:
        if new:
            # the truth begins to be streamed a row or two later than the attitude
            self._filters = bool(np.mean(rows[:ANCHOR_ROWS, -1]) > 0.5)
        settings = self._settings if self._filters else self._settings_filtered
        if new:
            gaps = gaps.copy()
            gaps[0] = settings["dt_s"][0]
            self._state = np.zeros(1, _STATE)
            # the integrator's own motion meanwhile is in the second column already
            start = rows[:ANCHOR_ROWS]
            out = self._run(settings, self._state.copy(), start, gaps)
            left = start[:, len(COLUMNS) - 1] - out.sum(axis=1)
            known = left[np.isfinite(left)]
            self._state["integral"] = float(np.median(known)) if known.size else 0.0
        return self._run(settings, self._state, rows, gaps)

    @staticmethod
    def _run(settings: NDArray[np.void], state: NDArray[np.void], rows: FloatArray, gaps: FloatArray) -> FloatArray:
        out = np.empty((len(rows), len(TERMS)))
        euler, euler_sp, rate, given = (np.ascontiguousarray(rows[:, part]) for part in _PARTS)
        _rate_terms(settings, state, gaps, euler, euler_sp, rate, given, out)
        return out


_PARTS = (slice(1, 4), slice(4, 7), 7, 8)
"""Of `COLUMNS`: attitude, its set-point, roll rate, torque."""
