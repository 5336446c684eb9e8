"""The six lateral derivatives that explain measured frequency responses, with 95 % intervals.

Roll rate and lateral speed per delta_lat are fitted together by the model of equation 2.2 behind motors with a
first-order lag and a delay, weighted by what is known of each point. Least squares by `scipy`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenarios.identification.frequency_response import ComplexArray, FloatArray, FrequencyResponse
from sitl.airframe import DERIVATIVE_NAMES, Derivatives
from sitl.errors import UsageError
from sitl.lateral import G_M_S2

MIN_COHERENCE = 0.6
"""Points below are not used: noise there, not response."""

MIN_POINTS = 8
FLOORS = 0.003, 0.003
"""Share of a response, roll rate and speed, to which a point is trusted at best: sampling and interpolation cost it."""

NAMES = (*DERIVATIVE_NAMES, "motor_lag_s", "delay_s", "speed_delay_s")
_Z = 1.959963984540054
_WIDE = 0.5
"""An interval wider than this share of the value is said to be unknown."""


@dataclass(frozen=True)
class Fit:
    """What the responses say.

    Attributes:
        derivatives: fitted. interval_95: half width of each derivative's 95 % interval, in its unit.
        motor_lag_s, delay_s: of the actuators, with half widths of their intervals.
        points: of the responses that were used. misfit: root mean square of the weighted residual, 1 when the model
            explains everything but noise.
        unknown: derivatives that the data hardly tell.
    """

    derivatives: Derivatives
    interval_95: Derivatives
    motor_lag_s: tuple[float, float]
    delay_s: tuple[float, float]
    points: int
    misfit: float
    unknown: tuple[str, ...]

    @property
    def sigma_pct(self) -> Derivatives:
        """One standard deviation of each derivative in per cent of its magnitude."""
        value, half = self.derivatives.as_array(), self.interval_95.as_array()
        return Derivatives.from_values(100.0 * half / _Z / np.maximum(np.abs(value), 1e-12))


def model(parameters: FloatArray, omega: FloatArray, gravity_m_s2: float = G_M_S2) -> tuple[ComplexArray, ComplexArray]:
    """Roll rate and lateral speed per delta_lat (equation 2.2 with motors), complex (F,).

    Args:
        parameters: (9,) in the order of NAMES. omega: (F,) rad/s. gravity_m_s2: sideways, per radian of roll.
    """
    Yv, Yp, Yd, Lv, Lp, Ld, lag, delay, speed_delay = parameters
    s = 1j * omega
    den = ((s - Lp - Yv) * s + Lp * Yv - Lv * Yp) * s - gravity_m_s2 * Lv
    motors = np.exp(-s * delay) / (1.0 + s * lag)
    p = s * (Ld * s - Ld * Yv + Lv * Yd) / den * motors
    v = (Yd * s * s + (Yp * Ld - Lp * Yd) * s + gravity_m_s2 * Ld) / den * motors * np.exp(-s * speed_delay)
    return p, v


def fit(
    roll: FrequencyResponse,
    speed: FrequencyResponse,
    *,
    gravity_m_s2: float = G_M_S2,
    start: Derivatives | None = None,
) -> Fit:
    """Fit the model to both responses.

    Args:
        roll: p per delta_lat, rad/s. speed: v per delta_lat, m/s. gravity_m_s2: sideways, per radian of roll.
        start: where to begin; found by regression if None.

    Raises:
        UsageError: too few points with coherence: the excitation was not enough, or too much noise.
    """
    import scipy.optimize  # slow to import, and only a fit needs it

    used = [one.coherence >= MIN_COHERENCE for one in (roll, speed)]
    if used[0].sum() < MIN_POINTS or used[1].sum() < MIN_POINTS // 2:
        raise UsageError(
            f"not enough excitation: {int(used[0].sum())} of {len(roll.value)} frequencies of the roll rate and "
            f"{int(used[1].sum())} of the speed have a coherence of {MIN_COHERENCE:g} or more; fly a larger peak_deg, "
            "or for longer"
        )
    first = _regression(roll, speed, used) if start is None else start.as_array()
    guess = np.concatenate([first, [0.02, 0.005, 0.0]])
    scale = np.maximum(np.abs(guess), [0.1, 0.1, 1.0, 1.0, 0.5, 10.0, 0.01, 0.005, 0.01])
    data = [
        (one.value[u], np.maximum(one.deviation[u], floor * np.abs(one.value[u])), one.omega_rad_s[u])
        for one, u, floor in zip((roll, speed), used, FLOORS, strict=True)
    ]

    def residual(x: FloatArray) -> FloatArray:
        left = []
        for signal, (value, deviation, omega) in enumerate(data):
            gap = (model(x * scale, omega, gravity_m_s2)[signal] - value) / (deviation / np.sqrt(2.0))
            left += [gap.real, gap.imag]
        return np.concatenate(left)

    low = np.concatenate([np.full(6, -np.inf), [0.0, -0.02, -0.05]]) / scale
    high = np.concatenate([np.full(6, np.inf), [0.3, 0.2, 0.1]]) / scale
    found = scipy.optimize.least_squares(residual, guess / scale, bounds=(low, high), x_scale="jac", max_nfev=400)
    freedom = max(1, len(found.fun) - len(found.x))
    misfit = float(np.sqrt((found.fun**2).sum() / freedom))
    # where the model explains less than the noise allows, the interval is widened by as much
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * max(1.0, misfit**2)
    half = _Z * np.sqrt(np.diag(covariance)) * scale
    value = found.x * scale
    unknown = [name for k, name in enumerate(DERIVATIVE_NAMES) if half[k] > _WIDE * abs(value[k])]
    return Fit(
        derivatives=Derivatives.from_values(value[:6]),
        interval_95=Derivatives.from_values(half[:6]),
        motor_lag_s=(float(value[6]), float(half[6])),
        delay_s=(float(value[7]), float(half[7])),
        points=int(used[0].sum() + used[1].sum()),
        misfit=misfit,
        unknown=tuple(unknown),
    )


def _regression(roll: FrequencyResponse, speed: FrequencyResponse, used: list[np.ndarray]) -> FloatArray:
    """Start values: both equations of motion are linear in the derivatives once the motors' lag is guessed."""
    both = used[0] & used[1]
    s = 1j * roll.omega_rad_s[both]
    p, v = roll.value[both], speed.value[both]
    best, least = np.zeros(6), np.inf
    for lag in (0.0, 0.01, 0.02, 0.03, 0.05):
        delta = 1.0 / (1.0 + s * lag) * np.exp(-s * 0.004)
        columns = np.column_stack([v, p, delta])
        side, side_rest = _solve(columns, s * v - G_M_S2 * p / s)
        turn, turn_rest = _solve(columns, s * p)
        if side_rest + turn_rest < least:
            best, least = np.concatenate([side, turn]), side_rest + turn_rest
    return best


def _solve(columns: ComplexArray, wanted: ComplexArray) -> tuple[FloatArray, float]:
    weight = 1.0 / np.maximum(np.abs(wanted), 1e-9)
    a = np.concatenate([(columns.T * weight).T.real, (columns.T * weight).T.imag])
    b = np.concatenate([(wanted * weight).real, (wanted * weight).imag])
    x, *_ = np.linalg.lstsq(a, b, rcond=None)
    return x, float(((a @ x - b) ** 2).sum())
