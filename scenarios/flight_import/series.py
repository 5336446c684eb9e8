"""Recorded signals, each on time stamps of its own, put on those of another one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

STALE_S = 0.5
"""A signal that is this much older than it should be is not there any more."""

STALE_PERIODS = 5.0


@dataclass(frozen=True, eq=False)
class Series:
    """A signal of one or several values.

    Attributes:
        t_s: (n,) vehicle time, strictly increasing.
        values: (n, k), in SI units.
        dropped: samples left out because their time did not increase.
    """

    t_s: FloatArray
    values: FloatArray
    dropped: int = 0

    @classmethod
    def of(cls, t_s: Any, values: Any) -> Series:
        """Keep the samples whose time is later than all before; a single value per sample may be flat.

        Args:
            t_s: (n,) s. values: (n,) or (n, k).
        """
        t = np.asarray(t_s, dtype=np.float64).reshape(-1)
        rows = np.asarray(values, dtype=np.float64).reshape(len(t), -1) if len(t) else np.zeros((0, 1))
        if not len(t):
            return cls(t, rows)
        known = np.isfinite(t)
        latest = np.maximum.accumulate(np.where(known, t, -np.inf))
        later = known & (t > np.concatenate([[-np.inf], latest[:-1]]))
        return cls(t[later], rows[later], int(len(t) - later.sum()))

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def rate_hz(self) -> float:
        """Samples per second where it was sampled at all; 0 for fewer than two."""
        if len(self) < 2:
            return 0.0
        return float(1.0 / np.median(np.diff(self.t_s)))

    def rate_between(self, start_s: float, end_s: float) -> float:
        """Samples per second between two times, as they mostly follow each other; 0 for fewer than two."""
        first, last = np.searchsorted(self.t_s, [start_s, end_s])
        return Series(self.t_s[first:last], self.values[first:last]).rate_hz

    def at(self, times_s: FloatArray, *, stale_s: float | None = STALE_S) -> FloatArray:
        """The last value at or before each time; NaN before the first and where it is too old.

        Args:
            times_s: (m,) s.
            stale_s: age, s, beyond which a value counts no more, stretched for signals that are rare by nature; None
                for states that hold until they change.

        Returns:
            (m, k).
        """
        out = np.full((len(times_s), self.values.shape[1]), np.nan)
        if not len(self):
            return out
        # a microsecond: the same instant, told by two topics
        at = np.searchsorted(self.t_s, times_s + 1e-6, side="right") - 1
        known = at >= 0
        if stale_s is not None:
            period = 1.0 / self.rate_hz if self.rate_hz else 0.0
            age = times_s - self.t_s[np.maximum(at, 0)]
            known &= age <= max(stale_s, STALE_PERIODS * period)
        out[known] = self.values[at[known]]
        return out


def interpolated(series: Series, times_s: FloatArray) -> FloatArray:
    """(m, k) on straight lines between the samples; NaN where the signal is not there, as in `Series.at`."""
    held = series.at(times_s)
    lines = np.column_stack([np.interp(times_s, series.t_s, column) for column in series.values.T])
    return np.where(np.isfinite(held), lines, np.nan)


def euler(quat: FloatArray) -> FloatArray:
    """(n, 3) of phi, theta, psi in rad from (n, 4) quaternions, w first; NaN stays NaN."""
    w, x, y, z = quat.T
    phi = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    theta = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    psi = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([phi, theta, psi])
