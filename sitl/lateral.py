"""LateralModel: the study's linear model of lateral motion (equations 2.2 and 2.3).

| state | meaning            | unit  |   | input     | PX4's normalised roll torque set-point  |
|-------|--------------------|-------|   | output p  | roll rate, rad/s                        |
| v     | lateral speed      | m/s   |   | output ay | lateral accelerometer, specific force,  |
| p     | roll rate          | rad/s |   |           | m/s^2: Yv v + Yp p + Yd delta_lat       |
| phi   | roll angle         | rad   |

Body frame FRD: v to the right, p and phi right side down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sitl.airframe import Derivatives

G_M_S2 = 9.81
"""Reproduces table 3.1 to its printed digits."""

# An eigenvalue counts as real when its imaginary part is rounding: below this share of its magnitude.
_REAL = 1e-9

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Mode:
    """One natural mode of the airframe without control."""

    name: str
    """The fastest real decay is "roll", an oscillation "phugoid", any other real mode "aperiodic"."""
    wn_rad_s: float
    """Magnitude of the eigenvalue."""
    zeta: float
    """Damping ratio, -Re/|eigenvalue|; negative is unstable."""
    eigenvalue: complex
    """1/s; of an oscillation the one with positive imaginary part."""


@dataclass(frozen=True, eq=False)
class LateralModel:
    """x' = A x + B delta_lat, y = C x + D delta_lat with x = [v, p, phi], y = [p, a_y]."""

    derivatives: Derivatives
    A: FloatArray  # (3, 3)
    B: FloatArray  # (3, 1)
    C: FloatArray  # (2, 3)
    D: FloatArray  # (2, 1)

    @classmethod
    def from_derivatives(cls, d: Derivatives) -> LateralModel:
        """The model of one set of derivatives (equations 2.2 and 2.3)."""
        return cls(
            derivatives=d,
            A=np.array([[d.Yv, d.Yp, G_M_S2], [d.Lv, d.Lp, 0.0], [0.0, 1.0, 0.0]]),
            B=np.array([[d.Yd], [d.Ld], [0.0]]),
            C=np.array([[0.0, 1.0, 0.0], [d.Yv, d.Yp, 0.0]]),
            D=np.array([[0.0], [d.Yd]]),
        )

    def denominator(self) -> tuple[float, float, float, float]:
        """Coefficients of the characteristic polynomial, highest power first."""
        d = self.derivatives
        return 1.0, -(d.Lp + d.Yv), d.Lp * d.Yv - d.Lv * d.Yp, -G_M_S2 * d.Lv

    def roll_rate_tf(self) -> Any:
        """Transfer function p / delta_lat as a `control.TransferFunction`, rad/s per unit."""
        import control  # slow to import, and only these two need it

        d = self.derivatives
        return control.tf([d.Ld, -d.Ld * d.Yv + d.Lv * d.Yd, 0.0], list(self.denominator()))

    def lateral_accel_tf(self) -> Any:
        """Transfer function a_y / delta_lat as a `control.TransferFunction`, m/s^2 per unit."""
        import control

        d = self.derivatives
        numerator = [d.Yd, d.Ld * d.Yp - d.Lp * d.Yd, 0.0, (d.Ld * d.Yv - d.Lv * d.Yd) * G_M_S2]
        return control.tf(numerator, list(self.denominator()))

    def modes(self) -> tuple[Mode, ...]:
        """Natural modes, fastest real decay first (table 3.1: roll and phugoid)."""
        eigenvalues = np.linalg.eigvals(self.A)
        real = sorted(float(e.real) for e in eigenvalues if abs(e.imag) <= _REAL * abs(e))
        oscillations = [complex(e) for e in eigenvalues if e.imag > _REAL * abs(e)]
        modes = [_mode("roll" if i == 0 and e < 0.0 else "aperiodic", e) for i, e in enumerate(real)]
        return (*modes, *(_mode("phugoid", e) for e in oscillations))


def _mode(name: str, eigenvalue: complex) -> Mode:
    magnitude = abs(eigenvalue)
    zeta = -complex(eigenvalue).real / magnitude if magnitude > 0.0 else 0.0
    return Mode(name, magnitude, zeta, complex(eigenvalue))
