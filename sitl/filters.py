"""The gyro's filters as PX4 has them: 2nd-order low pass, notch, first-order low pass.

Coefficients are computed once in plain Python; the sample functions are compiled and shared by every loop of the
vehicle. Source: PX4 ``lib/mathlib/math/filter`` and ``sensors/vehicle_angular_velocity``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.compiled import compiled, select

PASS_THROUGH = (1.0, 0.0, 0.0, 0.0, 0.0)
"""Biquad coefficients (b0, b1, b2, a1, a2) that change nothing."""


def low_pass_2p(cutoff_hz: float, rate_hz: float) -> tuple[float, float, float, float, float]:
    """Coefficients of PX4's 2nd-order Butterworth low pass (bilinear transform, prewarped).

    Args:
        cutoff_hz: -3 dB frequency, Hz.
        rate_hz: sample rate, Hz.

    Returns:
        (b0, b1, b2, a1, a2); the pass-through ones if the cutoff is not in (0, rate/2), as PX4 does.
    """
    if not 0.0 < cutoff_hz < rate_hz / 2.0:
        return PASS_THROUGH
    ohm = math.tan(math.pi * cutoff_hz / rate_hz)
    c = 1.0 + 2.0 * math.cos(math.pi / 4.0) * ohm + ohm * ohm
    b0 = ohm * ohm / c
    a1 = 2.0 * (ohm * ohm - 1.0) / c
    a2 = (1.0 - 2.0 * math.cos(math.pi / 4.0) * ohm + ohm * ohm) / c
    return b0, 2.0 * b0, b0, a1, a2


def notch(frequency_hz: float, bandwidth_hz: float, rate_hz: float) -> tuple[float, float, float, float, float]:
    """Coefficients of PX4's notch filter.

    Args:
        frequency_hz: centre, Hz; 0 is off.
        bandwidth_hz: width between the -3 dB points, Hz.
        rate_hz: sample rate, Hz.

    Returns:
        (b0, b1, b2, a1, a2); the pass-through ones if the notch is off or at rate/2 and above.
    """
    if not (0.0 < frequency_hz < rate_hz / 2.0 and 0.0 < bandwidth_hz < rate_hz / 2.0):
        return PASS_THROUGH
    alpha = math.tan(math.pi * bandwidth_hz / rate_hz)
    beta = -math.cos(2.0 * math.pi * frequency_hz / rate_hz)
    b0 = 1.0 / (alpha + 1.0)
    b1 = 2.0 * beta * b0
    return b0, b1, b0, b1, (1.0 - alpha) * b0


def alpha_of(cutoff_hz: float, dt_s: float) -> float:
    """Weight of a new sample in PX4's first-order low pass: dt / (dt + 1/(2 pi fc)); 1 (off) if fc <= 0."""
    if not cutoff_hz > 0.0:
        return 1.0
    return dt_s / (dt_s + 1.0 / (2.0 * math.pi * cutoff_hz))


@compiled
def constrain(value: float, low: float, high: float) -> float:
    """PX4's ``constrain``: a value held between two limits. A NaN value stays NaN, a NaN limit does not limit."""
    return select(value < low, low, select(value > high, high, value))


@compiled
def biquad_step(
    b0: float, b1: float, b2: float, a1: float, a2: float, delay0: float, delay1: float, sample: float
) -> tuple[float, float]:
    """Next output of a biquad in direct form II, and what becomes its first memory (the second becomes ``delay0``).

    Args:
        b0, b1, b2, a1, a2: coefficients.
        delay0, delay1: the filter's memory.
        sample: next input.
    """
    w = sample - delay0 * a1 - delay1 * a2
    return w * b0 + delay0 * b1 + delay1 * b2, w


@compiled
def slope_step(slope: float, value: float, last: float, alpha: float, dt_s: float) -> float:
    """Next output of PX4's D filter: the first-order low pass of a backward difference.

    Args:
        slope: its last output, 1/s of the value's unit.
        value, last: this sample and the one before.
        alpha: weight of the new difference (``alpha_of``). dt_s: between the two, s.
    """
    return slope + alpha * ((value - last) / dt_s - slope)


@compiled
def biquad(coefficients: NDArray[np.float64], delay: NDArray[np.float64], sample: float) -> float:
    """Next output of a biquad in direct form II.

    Args:
        coefficients: (5,) b0, b1, b2, a1, a2.
        delay: (2,) the filter's memory, updated in place.
        sample: next input.
    """
    b0, b1, b2, a1, a2 = coefficients[0], coefficients[1], coefficients[2], coefficients[3], coefficients[4]
    output, w = biquad_step(b0, b1, b2, a1, a2, delay[0], delay[1], sample)
    delay[1] = delay[0]
    delay[0] = w
    return output


@compiled
def settle_biquad(coefficients: NDArray[np.float64], delay: NDArray[np.float64], sample: float) -> None:
    """Set a biquad's memory to where a constant input would have brought it (PX4's ``reset``).

    Args:
        coefficients: (5,) b0, b1, b2, a1, a2.
        delay: (2,) the filter's memory, overwritten.
        sample: the constant input.
    """
    total = 1.0 + coefficients[3] + coefficients[4]
    w = sample / total if total > 0.0 else 0.0  # zero by rounding for cutoffs far below any use
    delay[0] = w
    delay[1] = w
