"""Where a loop meets the boundary of stability: L on a grid for many samples, what is bracketed there, refined."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IndexArray = npt.NDArray[np.intp]
BoolArray = npt.NDArray[np.bool_]

# A critical gain further than this from the present one (200 dB) is none.
GAIN_RANGE = 1e10
# Samples worked on together: what they need at once stays near the cache.
_CHUNK = 64
_ROOT_STEPS = 60
_LEAST_ROUNDS = 3


class Loop(Protocol):
    """What margins are worked out of: S loops that share their grid of frequencies."""

    delay_s: float

    def grid(self) -> FloatArray:
        """(F,) rad/s, ascending, so close that L turns by about 10 degrees at most between two."""

    def values(self, omega: FloatArray, rows: IndexArray) -> ComplexArray:
        """L of sample rows[k] at omega[k]; (K,)."""

    def table(self, omega: FloatArray, rows: slice) -> ComplexArray:
        """L of some samples at all frequencies; (n, F)."""

    def real_at(self) -> tuple[float, ...]:
        """Frequencies at which L is real by its nature: the ends of the band."""

    def unstable(self, rows: IndexArray, gains: FloatArray) -> IndexArray:
        """How many closed-loop eigenvalues are unstable with the loop gain of sample rows[k] times gains[k]; (K,)."""


@dataclass(frozen=True)
class CriticalGains:
    """Gain factors that put a closed-loop eigenvalue on the boundary; by sample, then ascending. Each (K,)."""

    row: IndexArray
    gain: FloatArray
    omega: FloatArray


@dataclass(frozen=True)
class Unity:
    """Frequencies at which |L| is 1. Each (K,)."""

    row: IndexArray
    omega: FloatArray
    phase_deg: FloatArray
    """Phase of L above -180 degrees, in [0, 360): the lag that takes it there."""
    falling: BoolArray
    """|L| falls with frequency: more lag here makes an eigenvalue pair unstable; where it rises, stable."""


class Crossings:
    """One look at L over the grid, and everything bracketed there, refined."""

    def __init__(self, loop: Loop, samples: int) -> None:
        omega = loop.grid()
        real: list[tuple[IndexArray, IndexArray]] = []
        unity: list[tuple[IndexArray, IndexArray, BoolArray]] = []
        nearest, largest = np.empty((2, 2, samples), dtype=np.intp)
        for first in range(0, samples, _CHUNK):
            rows = slice(first, min(first + _CHUNK, samples))
            value = loop.table(omega, rows)
            below = np.signbit(value.imag)
            row, at = np.nonzero(below[:, :-1] != below[:, 1:])
            real.append((row + first, at))
            size = value.real**2 + value.imag**2
            above = size > 1.0
            row, at = np.nonzero(above[:, :-1] != above[:, 1:])
            unity.append((row + first, at, above[row, at]))
            distance = size + 2.0 * value.real + 1.0  # |1 + L|^2
            with np.errstate(all="ignore"):
                inverse = distance / size  # |1 + 1 / L|^2; L = 0 is as far from anything as can be
            inverse[~np.isfinite(size)] = 1.0
            for place, measure in ((nearest, distance), (largest, inverse)):
                best = measure.argmin(axis=1)
                place[0, rows], place[1, rows] = np.maximum(best - 1, 0), np.minimum(best + 1, len(omega) - 1)
        self.samples = samples
        self.nearest = omega[nearest[0]], omega[nearest[1]]
        self.largest = omega[largest[0]], omega[largest[1]]
        self.critical = self._real(loop, omega, *(np.concatenate(part) for part in zip(*real, strict=True)))
        self.unity = self._unity(loop, omega, *(np.concatenate(part) for part in zip(*unity, strict=True)))

    def _real(self, loop: Loop, omega: FloatArray, row: IndexArray, at: IndexArray) -> CriticalGains:
        roots = _roots(lambda w, k: loop.values(w, row[k]).imag, omega[at], omega[at + 1])
        for end in loop.real_at():
            row = np.concatenate([row, np.arange(self.samples)])
            roots = np.concatenate([roots, np.full(self.samples, end)])
        real = loop.values(roots, row).real
        counts = (real < -1.0 / GAIN_RANGE) & (real > -GAIN_RANGE)
        row, roots, gain = row[counts], roots[counts], -1.0 / real[counts]
        order = np.lexsort((gain, row))
        return CriticalGains(row[order], gain[order], roots[order])

    @staticmethod
    def _unity(loop: Loop, omega: FloatArray, row: IndexArray, at: IndexArray, falling: BoolArray) -> Unity:
        roots = _roots(lambda w, k: np.log(np.abs(loop.values(w, row[k]))), omega[at], omega[at + 1])
        phase = (np.degrees(np.angle(loop.values(roots, row))) + 180.0) % 360.0
        return Unity(row, roots, phase, falling)


def _roots(function: Callable[[FloatArray, IndexArray], FloatArray], low: FloatArray, high: FloatArray) -> FloatArray:
    """Roots in brackets (low, high) where the function changes sign, all at once (Illinois' regula falsi).

    Args:
        function: of the points and of the numbers of their brackets.
    """
    root = 0.5 * (low + high)
    todo = np.arange(len(low))
    a, b = low.copy(), high.copy()
    fa, fb = function(a, todo), function(b, todo)
    kept = np.zeros(len(low))  # which end stayed last time, and so has its value halved when it stays again
    for _ in range(_ROOT_STEPS):
        if not len(todo):
            break
        with np.errstate(all="ignore"):
            x = b - fb * (b - a) / (fb - fa)
        # outside, or no number (both ends zero by rounding): halve
        x = np.where((x > a) & (x < b), x, 0.5 * (a + b))
        fx = function(x, todo)
        left = np.signbit(fx) == np.signbit(fa)
        fb = np.where(left & (kept == 1.0), 0.5 * fb, fb)
        fa = np.where(~left & (kept == -1.0), 0.5 * fa, fa)
        a, fa = np.where(left, x, a), np.where(left, fx, fa)
        b, fb = np.where(left, b, x), np.where(left, fb, fx)
        kept = np.where(left, 1.0, -1.0)
        root[todo] = x
        going = (b - a > 1e-14 * b) & (fx != 0.0) & (np.abs(fx) > 1e-15)
        todo, a, b, fa, fb, kept = todo[going], a[going], b[going], fa[going], fb[going], kept[going]
    return root


def least_of(
    loop: Loop, bracket: tuple[FloatArray, FloatArray], measure: Callable[[ComplexArray], FloatArray]
) -> FloatArray:
    """Least value of a measure of L near the grid's own least, and at the ends of the band; (S,).

    Args:
        loop: all of them. bracket: (S,) each, rad/s. measure: of L, smooth at its least (a square of a distance).
    """
    low, high = bracket
    samples = len(low)
    least = np.full(samples, math.inf)
    points = 9
    rows = np.repeat(np.arange(samples), points)
    for _ in range(_LEAST_ROUNDS):
        omega = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, points)
        value = measure(loop.values(omega.ravel(), rows)).reshape(samples, points)
        best = value.argmin(axis=1)
        column = np.arange(samples)
        least = np.minimum(least, value[column, best])
        inner = np.clip(best, 1, points - 2)
        low, high = omega[column, inner - 1], omega[column, inner + 1]
    # the parabola through the last three
    before, middle, after = (value[column, inner + side] for side in (-1, 0, 1))
    with np.errstate(all="ignore"):
        share = 0.5 * (before - after) / (before - 2.0 * middle + after)
    share = np.where(np.abs(share) <= 1.0, share, 0.0)
    last = omega[column, inner] + share * 0.5 * (high - low)
    least = np.minimum(least, measure(loop.values(last, column)))
    for end in loop.real_at():
        least = np.minimum(least, measure(loop.values(np.full(samples, end), np.arange(samples))))
    return np.asarray(least)
