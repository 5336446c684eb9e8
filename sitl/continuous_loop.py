"""The study's own loop: continuous, with an ideal derivative, cut at delta_lat.

    r = K_phi (phi_sp - phi),   delta_lat = K_P (r - p) + K_I int (r - p) - K_D p' + K_FF r

around the model of equation 2.2, optionally behind motors with a first-order lag. There is no sampling, so no tick
rate bounds the gain: an upper gain margin that the sampled loop has, this one may not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sitl.crossings import ComplexArray, FloatArray, IndexArray
from sitl.lateral import G_M_S2
from sitl.margin_batch import OMEGA_MIN_RAD_S, MarginArrays, check_models, margins_of_loop, stacked
from sitl.sampled_loop import RollGains

OMEGA_MAX_RAD_S = 1e5
"""Far above anything that moves."""

MARGINAL_1_S = 1e-7
"""A mode that decays slower than this counts as one that never does, see `sitl.margin_batch.MARGINAL`."""


class ContinuousLoop:
    """The continuous loop of one gain set on S samples; a `sitl.crossings.Loop`.

    Args:
        derivatives: (S, 6) in the order of DERIVATIVE_NAMES. gains: of the roll axis.
        motor_lag_s: time constant of the motors, 0 for none.
    """

    def __init__(self, derivatives: FloatArray, gains: RollGains, motor_lag_s: float = 0.0) -> None:
        self.derivatives = np.asarray(derivatives, dtype=float)
        self.gains = gains
        self.motor_lag_s = motor_lag_s
        self.delay_s = motor_lag_s
        Yv, Yp, Yd, Lv, Lp, Ld = self.derivatives.T
        one, zero = np.ones_like(Yv), np.zeros_like(Yv)
        self._den = np.stack([one, -(Lp + Yv), Lp * Yv - Lv * Yp, -G_M_S2 * Lv], axis=-1)
        self._phi = np.stack([zero, Ld, Lv * Yd - Ld * Yv], axis=-1)

    def grid(self) -> FloatArray:
        """See `sitl.crossings.Loop`."""
        return np.geomspace(OMEGA_MIN_RAD_S, OMEGA_MAX_RAD_S, 500)

    def values(self, omega: FloatArray, rows: IndexArray) -> ComplexArray:
        """See `sitl.crossings.Loop`."""
        return self._loop(omega, self._den[rows], self._phi[rows])

    def table(self, omega: FloatArray, rows: slice) -> ComplexArray:
        """See `sitl.crossings.Loop`."""
        return self._loop(omega, self._den[rows][:, None, :], self._phi[rows][:, None, :])

    def _loop(self, omega: FloatArray, den: FloatArray, num: FloatArray) -> ComplexArray:
        s = 1j * omega
        g = self.gains
        phi = (num[..., 1] * s + num[..., 2]) / (((s + den[..., 1]) * s + den[..., 2]) * s + den[..., 3])
        error = g.k * g.kp + (g.k * g.ki / s if g.k * g.ki else 0.0)
        value: ComplexArray = (
            ((error + g.k * g.kd * s) * s + (error + g.kff) * g.k_phi) * phi / (1.0 + s * self.motor_lag_s)
        )
        return value

    def real_at(self) -> tuple[float, ...]:
        """See `sitl.crossings.Loop`: frequency 0 without an integrator and where the airframe has no pole there."""
        at_rest = bool((self._den[:, 3] == 0.0).any())
        return () if self.gains.k * self.gains.ki or at_rest else (0.0,)

    def closed_loop_matrix(self, loop_gain: FloatArray, rows: IndexArray) -> FloatArray:
        """M of x' = M x, the closed loop without set-point.

        The state is v, p, phi, with lag the motors, and with K_I the integral.

        Args:
            loop_gain: (K,) factor on delta_lat where the loop is cut. rows: (K,) samples.

        Returns:
            (K, N, N).
        """
        g = self.gains
        d = self.derivatives[rows]
        lag, integrates = self.motor_lag_s > 0.0, g.k * g.ki != 0.0
        size = 3 + lag + integrates
        made = np.zeros((len(rows), size, size))
        made[:, 0, 0], made[:, 0, 1], made[:, 0, 2] = d[:, 0], d[:, 1], G_M_S2
        made[:, 1, 0], made[:, 1, 1], made[:, 2, 1] = d[:, 3], d[:, 4], 1.0
        if lag:
            made[:, 0, 3], made[:, 1, 3] = d[:, 2], d[:, 5]
        slope = made[:, 1].copy()  # p', but for what the command adds to it at once
        command = -g.k * g.kd * slope
        command[:, 1] -= g.k * g.kp
        command[:, 2] -= (g.k * g.kp + g.kff) * g.k_phi
        if integrates:
            command[:, -1] += g.k * g.ki
            made[:, -1, 1], made[:, -1, 2] = -1.0, -g.k_phi
        command *= loop_gain[:, None]
        if lag:
            made[:, 3] = command / self.motor_lag_s
            made[:, 3, 3] -= 1.0 / self.motor_lag_s
        else:
            # the command moves p' that it is made of: delta (1 + gain K_D Ld) = the rest
            command /= (1.0 + loop_gain * g.k * g.kd * d[:, 5])[:, None]
            made[:, 0] += d[:, 2, None] * command
            made[:, 1] += d[:, 5, None] * command
        return made

    def unstable(self, rows: IndexArray, gains: FloatArray) -> IndexArray:
        """See `sitl.crossings.Loop`."""
        values = np.linalg.eigvals(self.closed_loop_matrix(gains, rows))
        return np.asarray(np.count_nonzero(values.real >= -MARGINAL_1_S, axis=-1))


def continuous_margins(derivatives: FloatArray, gains: Sequence[RollGains], motor_lag_s: float = 0.0) -> MarginArrays:
    """Margins of the study's continuous loop of every gain set on every sample.

    Args:
        derivatives: (S, 6) in the order of DERIVATIVE_NAMES. gains: G sets. motor_lag_s: of the motors, 0 for none.

    Returns:
        arrays (G, S); the upper gain margin is inf where no gain is too high.

    Raises:
        UsageError: no sample or gain set, or a number that is not finite.
    """
    check_models(derivatives, gains)
    if not (math.isfinite(motor_lag_s) and motor_lag_s >= 0.0):
        raise ValueError(f"motor lag {motor_lag_s} s: must be 0 or more")
    return stacked([margins_of_loop(ContinuousLoop(derivatives, one, motor_lag_s), len(derivatives)) for one in gains])
