"""Frequency responses from a periodic excitation, with coherence and their own uncertainty.

In closed loop noise travels round and correlates input with output, so dividing spectra of the two is biased. The
set-point is periodic and known: what repeats from period to period is its doing, what does not is noise. The mean over
periods of input and output, each referred to the set-point, gives a response without that bias (instrumental variable),
and the scatter between periods gives its variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sitl.errors import UsageError

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

MIN_PERIODS = 3


@dataclass(frozen=True)
class FrequencyResponse:
    """Output per input at the excited frequencies.

    Attributes:
        omega_rad_s: (F,).
        value: (F,) complex.
        deviation: (F,) standard deviation of `value`, both parts together, from the scatter between periods.
        coherence: (F,) share of input and output that repeats with the set-point, 0 to 1.
        periods: how many were averaged.
    """

    omega_rad_s: FloatArray
    value: ComplexArray
    deviation: FloatArray
    coherence: FloatArray
    periods: int


def period_of(frequencies_hz: FloatArray) -> float:
    """The time after which a sum of sines repeats, s.

    Args:
        frequencies_hz: (F,) all multiples of a common one, not below 0.01 Hz.

    Raises:
        UsageError: they have no common divisor of at least 0.01 Hz.
    """
    steps = np.rint(frequencies_hz * 100.0).astype(int)
    if np.abs(frequencies_hz * 100.0 - steps).max() > 1e-6 or steps.min() < 1:
        raise UsageError("the multisine's frequencies must be multiples of 0.01 Hz, or it does not repeat")
    return 100.0 / float(np.gcd.reduce(steps))


def spectra(
    t_s: FloatArray, signal: FloatArray, start_s: float, period_s: float, periods: int, omega_rad_s: FloatArray
) -> ComplexArray:
    """Amplitudes of a signal at given frequencies in each period, (periods, F), by the integral over its own times.

    Args:
        t_s: (n,) s, increasing, not necessarily even. signal: (n,).
        start_s: of the first period. period_s: s. periods: how many. omega_rad_s: (F,).
    """
    made = np.empty((periods, len(omega_rad_s)), dtype=complex)
    for m in range(periods):
        begin, end = start_s + m * period_s, start_s + (m + 1) * period_s
        inside = (t_s > begin) & (t_s < end)
        t = np.concatenate([[begin], t_s[inside], [end]])
        x = np.interp(t, t_s, signal)
        turning = np.exp(-1j * np.outer(omega_rad_s, t - begin))
        made[m] = 2.0 / period_s * np.trapezoid(turning * x, t, axis=1)
    return made


def response(inputs: ComplexArray, outputs: ComplexArray, omega_rad_s: FloatArray) -> FrequencyResponse:
    """Output per input from amplitudes in each period.

    Args:
        inputs, outputs: (periods, F) from `spectra`. omega_rad_s: (F,).

    Raises:
        UsageError: fewer than three periods.
    """
    periods = len(inputs)
    if periods < MIN_PERIODS:
        raise UsageError(f"only {periods} whole periods of the multisine: fly at least {MIN_PERIODS + 1}")
    u, y = inputs.mean(axis=0), outputs.mean(axis=0)
    value = y / u
    # what is left of each period when the repeating part is taken off, as it enters the ratio
    rest = (outputs - y) - value * (inputs - u)
    variance = (np.abs(rest) ** 2).sum(axis=0) / (periods - 1) / periods
    deviation = np.sqrt(variance) / np.abs(u)
    powers = (np.abs(inputs) ** 2).mean(axis=0) * (np.abs(outputs) ** 2).mean(axis=0)
    coherence = np.abs(u) ** 2 * np.abs(y) ** 2 / np.where(powers > 0.0, powers, 1.0)
    return FrequencyResponse(omega_rad_s, value, deviation, coherence, periods)
