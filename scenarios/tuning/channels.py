"""What the weights shape: S, Q and F of many gain sets on many models at once, over a grid of frequencies.

The plant's share of the loop, filters included, is worked out once; for a gain set only products are left. The same
pass over L gives the delay margin, so that it can bound the search.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scenarios.tuning.weights import Weight
from sitl.crossings import ComplexArray, FloatArray
from sitl.profile import Profile
from sitl.sampled_loop import RollGains, SampledLoop

POINTS = 240
OMEGA_LOW_RAD_S = 0.02
"""Below, S of every candidate is small and F is near 1: the weights say nothing there."""

_NO_GAINS = RollGains(1.0, 1.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Norms:
    """Largest weighted magnitudes over models and frequencies; each (candidates,).

    Attributes:
        s, q, f: of |W1 S|, |W2 Q|, |W3 F|. delay_margin_s: least over the models, to the grid's accuracy.
    """

    s: FloatArray
    q: FloatArray
    f: FloatArray
    delay_margin_s: FloatArray

    @property
    def worst(self) -> FloatArray:
        """The objective: the largest of the three."""
        return np.maximum(np.maximum(self.s, self.q), self.f)


class Channels:
    """The channels of some models under one profile and motor lag.

    Args:
        derivatives: (M, 6). profile: of the loop. motor_lag_s: of the motors.
    """

    def __init__(self, derivatives: FloatArray, profile: Profile, motor_lag_s: float) -> None:
        self.loop = SampledLoop(derivatives, _NO_GAINS, profile, motor_lag_s)
        self.dt_s = profile.dt_s
        self.omega = np.geomspace(OMEGA_LOW_RAD_S, 0.999 * math.pi / profile.dt_s, POINTS)
        self._p, self._phi = self.loop.plant(self.omega)
        # the shares of the four gains in what multiplies p and phi
        unit = RollGains(1.0, 1.0, 1.0, 0.0, 0.0)
        self._gyro, self._attitude = self.loop.with_gains(unit).controller(self.omega)
        integral, _ = self.loop.with_gains(RollGains(1.0, 1.0, 0.0, 1.0, 0.0)).controller(self.omega)
        slope, _ = self.loop.with_gains(RollGains(1.0, 1.0, 0.0, 0.0, 1.0)).controller(self.omega)
        self._per_ki = integral / self._gyro
        self._slope = slope
        # the set-point is as late as the rate set-point made of it
        self._late = np.exp(-1j * self.omega * profile.dt_s * profile.rate_sp_late_ticks)

    def norms(self, gains: Sequence[RollGains], weights: Sequence[Weight]) -> Norms:
        """The norms of every gain set over all models.

        Args:
            gains: K sets with k = 1 and no feed-forward. weights: W1, W2, W3.
        """
        shapes = [np.abs(weight.at(self.omega, self.dt_s)) for weight in weights]
        found = np.empty((4, len(gains)))
        for i, g in enumerate(gains):
            loop, q = self._closed(g)
            f = q * self._phi
            found[0, i] = (np.abs(1.0 - f) * shapes[0]).max()
            found[1, i] = (np.abs(q) * shapes[1]).max()
            found[2, i] = (np.abs(f) * shapes[2]).max()
            found[3, i] = self._delay_margin(loop)
        return Norms(*found)

    def each(self, gains: RollGains, weights: Sequence[Weight]) -> FloatArray:
        """The norms of one gain set on every model: (3, M) of |W1 S|, |W2 Q|, |W3 F|.

        Args:
            gains: with k = 1 and no feed-forward. weights: W1, W2, W3.
        """
        _, q = self._closed(gains)
        f = q * self._phi
        shapes = [np.abs(weight.at(self.omega, self.dt_s)) for weight in weights]
        return np.stack(
            [(np.abs(value) * shape).max(axis=1) for value, shape in zip((1.0 - f, q, f), shapes, strict=True)]
        )

    def _closed(self, g: RollGains) -> tuple[ComplexArray, ComplexArray]:
        """L and Q of every model."""
        error = g.kp + g.ki * self._per_ki
        loop = (error * self._gyro + g.kd * self._slope) * self._p + (g.k_phi * error * self._attitude) * self._phi
        return loop, (g.k_phi * error * self._late) / (1.0 + loop)

    def stable(self, gains: Sequence[RollGains]) -> FloatArray:
        """Largest spectral radius over the models; (K,). Below 1 every model is stable."""
        return np.array([float(np.abs(self.loop.with_gains(g).eigenvalues()).max()) for g in gains])

    def _delay_margin(self, loop: np.ndarray) -> float:
        """Least delay that takes L to -1 at a crossover, interpolated; inf without one. Meant for stable loops."""
        size = np.log(np.abs(loop))
        row, at = np.nonzero(np.signbit(size[:, :-1]) != np.signbit(size[:, 1:]))
        if not len(row):
            return math.inf
        before, after = size[row, at], size[row, at + 1]
        share = before / (before - after)
        ratio = loop[row, at + 1] / loop[row, at]
        phase = (np.angle(loop[row, at]) + share * np.angle(ratio)) % (2.0 * math.pi)
        omega = self.omega[at] * (self.omega[at + 1] / self.omega[at]) ** share
        lag = (phase + math.pi) % (2.0 * math.pi)
        return float((lag / omega).min())
