"""The weights of the synthesis, derived from the requirements: W1 on S, W2 on Q, W3 on F.

The closed loop from roll set-point to roll angle is to be no worse than a second-order system of the natural frequency
and damping required; the weights are the inverses of what that allows:

    |S| <= 1/|W1|,  W1 = (s / Ms + w1) / (s + w1 eps)    slow errors below eps, fast ones below the peak Ms
    |Q| <= 1/|W2|,  W2 = 1 / Qmax                        torque per roll set-point
    |F| <= 1/|W3|,  W3 = (s / w3 + 1) / (Mt (s / (100 w3) + 1))    no resonance above Mt, roll-off beyond w3

S + F = 1, Q the torque per set-point. All are sampled by Tustin's rule at the loop's own rate, so that the norms that
are minimised and those that are certified are of the same transfer functions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scenarios.tuning.requirements import Requirements
from sitl.crossings import ComplexArray, FloatArray

LOW_ERROR = 0.03
"""Share of a set-point that may be missing at rest; the airframe rolls back as it gains speed, so 0 is not asked."""

STRICTEST_PEAK = 1.0
_DEFAULT_LIMIT = 1e3
"""Torque per rad that stands for "no limit on control effort"."""


@dataclass(frozen=True)
class Weight:
    """(a s + b) / (c s + d).

    Attributes:
        name: W1, W2 or W3. channel: what it shapes.
        a, b, c, d: coefficients; s in rad/s.
    """

    name: str
    channel: str
    a: float
    b: float
    c: float
    d: float

    def sampled(self, dt_s: float) -> tuple[float, float, float]:
        """(b0, b1, a1) of (b0 + b1 / z) / (1 + a1 / z), by Tustin's rule."""
        if self.a == 0.0 and self.c == 0.0:
            return self.b / self.d, 0.0, 0.0
        k = 2.0 / dt_s
        lead = self.c * k + self.d
        return (self.a * k + self.b) / lead, (self.b - self.a * k) / lead, (self.d - self.c * k) / lead

    def at(self, omega: FloatArray, dt_s: float) -> ComplexArray:
        """Its value at frequencies in rad/s, sampled."""
        b0, b1, a1 = self.sampled(dt_s)
        lag = np.exp(-1j * omega * dt_s)
        value: ComplexArray = (b0 + b1 * lag) / (1.0 + a1 * lag)
        return value

    def __str__(self) -> str:
        def line(slope: float, offset: float) -> str:
            return f"{slope:.5g} s + {offset:.5g}" if slope else f"{offset:.5g}"

        return f"{self.name} = ({line(self.a, self.b)}) / ({line(self.c, self.d)})"


def weights_for(requirements: Requirements) -> tuple[Weight, Weight, Weight]:
    """(W1, W2, W3).

    Args:
        requirements: what they stand for.
    """
    # 5 % of a step are left after settling: exp(-w t) = 0.05, unless the natural frequency asks for more
    speed = max(3.0 / requirements.settling_time_s, 0.5 * requirements.natural_frequency_rad_s)
    peak = requirements.peak_sensitivity
    resonance = max(_peak_of(requirements.damping), 1.0 + requirements.overshoot_pct / 100.0)
    roll_off = 6.0 * requirements.natural_frequency_rad_s
    most = requirements.peak_delta_lat / math.radians(requirements.amplitude_deg)
    limit = _DEFAULT_LIMIT if math.isinf(most) else most
    return (
        Weight("W1", "S = 1 - F", 1.0 / peak, speed, 1.0, speed * LOW_ERROR),
        Weight("W2", "Q", 0.0, 1.0 / limit, 0.0, 1.0),
        Weight("W3", "F", 1.0 / roll_off, 1.0, resonance / (100.0 * roll_off), resonance),
    )


def _peak_of(damping: float) -> float:
    """Largest magnitude of a second-order system of that damping."""
    if damping >= math.sqrt(0.5):
        return STRICTEST_PEAK
    return 1.0 / (2.0 * damping * math.sqrt(1.0 - damping**2))
