"""Froude scaling: what one multirotor's identified model predicts for another of a different size.

N = L_reference / L_target, with L the diagonal from motor to motor (study, chapters 4 to 6). Lengths scale
with 1/N, times with 1/sqrt(N), so every eigenvalue of the lateral model is multiplied by sqrt(N): the scaled
model is the same motion played faster (N > 1, a smaller target) or slower.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

from sitl.airframe import Airframe, Derivatives

EXPONENTS = Derivatives(Yv=0.5, Yp=-0.5, Yd=0.0, Lv=1.5, Lp=0.5, Ld=1.0)
"""Table 4.1: a derivative of the target is that of the reference times N**exponent."""

SigmaMode = Literal["table", "grow"]


def froude_number(reference: Airframe, target: Airframe) -> float:
    """N = diagonal of the reference / diagonal of the target (tables 5.1, 5.3, 5.5, 5.7)."""
    return reference.diagonal_m / target.diagonal_m


def derivative_factors(N: float) -> Derivatives:
    """N**exponent of each derivative (table 4.1).

    Raises:
        ValueError: N is not a positive finite number.
    """
    if not (math.isfinite(N) and N > 0.0):
        raise ValueError(f"Froude number {N!r} is not positive and finite")
    return Derivatives(**{name: N**exponent for name, exponent in EXPONENTS.as_dict().items()})


def gain_factor(N: float) -> float:
    """sqrt(N): what section 6.6 multiplies the model's gain by."""
    return math.sqrt(N)


def scale_derivatives(derivatives: Derivatives, N: float) -> Derivatives:
    """The reference's derivatives scaled to the target (tables 5.2, 5.4, 5.6, 5.8)."""
    return Derivatives.from_values(derivatives.as_array() * derivative_factors(N).as_array())


def scale_sigma(sigma_pct: Derivatives, N: float, mode: SigmaMode = "table") -> Derivatives:
    """The reference's standard deviations, in per cent, scaled to the target (sections 6.4 and 6.5).

    The study does not print how. "table" multiplies each by the derivative's own factor of table 4.1; "grow"
    by that factor or its inverse, whichever is above 1, so that a prediction is never surer than its source.
    """
    factors = derivative_factors(N).as_array()
    if mode == "grow":
        factors = factors.clip(min=1.0 / factors)
    return Derivatives.from_values(sigma_pct.as_array() * factors)


def scale_gain(derivatives: Derivatives, N: float) -> Derivatives:
    """Yd and Ld times sqrt(N): both transfer functions times sqrt(N), eigenvalues kept (section 6.6)."""
    factor = gain_factor(N)
    return replace(derivatives, Yd=derivatives.Yd * factor, Ld=derivatives.Ld * factor)
