"""Stability of the roll loop as it is flown: gain, phase, delay and modulus margins, cut at delta_lat.

The airframe is unstable by itself, so the loop is conditionally stable: too little gain loses it as well as
too much, and both limits are reported. Without filters the upper one lies at z = -1, half the tick rate.
Whether the loop is stable at all is decided by the eigenvalues of one tick, never by the shape of L.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from sitl.airframe import Derivatives
from sitl.profile import Profile
from sitl.sampled_loop import ComplexArray, FloatArray, RollGains, SampledLoop

__all__ = ["Margins", "RollGains", "loop_margins", "loop_transfer", "margins_of"]

# Lowest frequency looked at: below the slowest integrator crossover of any gain worth flying.
OMEGA_MIN_RAD_S = 1e-4
# A critical gain further than this from the present one (200 dB) is none.
GAIN_RANGE = 1e10


@dataclass(frozen=True)
class Margins:
    """How far the loop is from losing, or from finding, its stability."""

    closed_loop_stable: bool
    gain_margin_low_db: float | None
    """Lower end of the nearest range of loop gains with a stable closed loop, relative to the present gain;
    negative when stable. None if that range reaches down to no gain at all, or there is no such range."""
    gain_margin_high_db: float | None
    """Upper end of that range: positive when stable, `inf` if no gain is too high; negative when the gain
    must come down by that much. None if no gain makes the loop stable."""
    phase_margin_deg: float | None
    """Stable: the least phase, lag or lead, that takes L through -1; `inf` if L never has magnitude 1.
    Unstable: minus the phase lead that would make it stable, None if none within 180 degrees does."""
    delay_margin_s: float | None
    """Stable: the delay that would just destroy it, least (lag to -180 degrees / frequency) over the
    crossovers; `inf` if none does. Unstable: minus the delay that would have to be removed, None if removing
    `loop_delay_s` were not enough. Exact for a delay of whole ticks. Part of a tick shifts the torque's hold,
    which with motor lag is the same to microseconds; without lag the loop bears a little more (up to 0.6 ms
    more at 250 Hz on the study's airframes)."""
    modulus_margin: float
    """Least |1 + L|: 1 / peak sensitivity. Means nothing when unstable."""
    crossover_rad_s: float | None
    """Highest frequency at which |L| falls through 1."""
    phase_crossover_rad_s: float | None
    """Where L is real at the upper gain margin: the frequency at which too much gain oscillates. A saturating
    loop that is unstable settles into a limit cycle near it."""
    loop_delay_s: float
    """Transport delay, half a tick of hold, motor lag and gyro filter at low frequency."""


def loop_transfer(
    omega_rad_s: npt.ArrayLike,
    derivatives: Derivatives,
    gains: RollGains,
    profile: Profile,
    motor_lag_s: float,
    transport_delay_s: float = 0.0,
) -> ComplexArray:
    """L(e^(j omega dt)) of the sampled loop; see `SampledLoop.transfer`."""
    return SampledLoop(derivatives, gains, profile, motor_lag_s, transport_delay_s).transfer(omega_rad_s)


def loop_margins(
    derivatives: Derivatives,
    gains: RollGains,
    profile: Profile,
    motor_lag_s: float,
    transport_delay_s: float = 0.0,
) -> Margins:
    """Margins of the roll loop of one model, gain set and profile; arguments as `SampledLoop`."""
    return margins_of(SampledLoop(derivatives, gains, profile, motor_lag_s, transport_delay_s))


def margins_of(loop: SampledLoop) -> Margins:
    """Margins of a loop.

    Crossings are bracketed on a grid and then refined as roots, so they are exact to rounding.
    """
    omega = _grid(loop)
    value = loop.transfer(omega)
    unstable = int(np.count_nonzero(np.abs(loop.eigenvalues()) >= 1.0))
    low, high, phase_crossover = _gain_range(loop, _critical_gains(loop, omega, value))
    crossovers = _crossovers(loop, omega, value)
    falling = [c.omega for c in crossovers if c.falling]
    return Margins(
        closed_loop_stable=unstable == 0,
        gain_margin_low_db=_db(low) if low else None,
        gain_margin_high_db=_db(high) if high else None,
        phase_margin_deg=_phase_margin(crossovers, unstable),
        delay_margin_s=_delay_margin(crossovers, unstable, loop.delay_s),
        modulus_margin=_modulus_margin(loop, omega, value),
        crossover_rad_s=max(falling) if falling else None,
        phase_crossover_rad_s=phase_crossover,
        loop_delay_s=loop.delay_s,
    )


def _db(gain: float) -> float:
    return math.inf if math.isinf(gain) else 20.0 * math.log10(gain)


def _grid(loop: SampledLoop) -> FloatArray:
    """Frequencies up to just below pi/dt, so close that L turns by about 10 degrees at most between two."""
    top = math.pi / loop.dt_s * (1.0 - 1e-6)
    slow = np.geomspace(OMEGA_MIN_RAD_S, 0.5, 100, endpoint=False)
    fast = np.geomspace(0.5, top, 500)
    turning_s = loop.delay_s - loop.motor_lag_s + 2.0 * loop.dt_s  # a lag turns L by 90 degrees in all
    even = np.linspace(0.5, top, math.ceil(top * turning_s / 0.15))
    return np.unique(np.concatenate([slow, fast, even]))


def _zoom(function: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray) -> FloatArray:
    """Roots of `function`, one in each bracket (low, high) where it changes sign; all brackets at once."""
    for _ in range(7):
        points = low + (high - low) * np.linspace(0.0, 1.0, 9)[:, None]
        sign = np.sign(function(points))
        first = np.argmax(sign[:-1] != sign[1:], axis=0)
        column = np.arange(len(low))
        low, high = points[first, column], points[first + 1, column]
    return 0.5 * (low + high)


@dataclass(frozen=True)
class _CriticalGain:
    """A factor on the loop gain that puts a closed-loop eigenvalue on the unit circle, and its frequency."""

    gain: float
    omega: float


def _critical_gains(loop: SampledLoop, omega: FloatArray, value: ComplexArray) -> list[_CriticalGain]:
    """Every gain g with 1 + g L = 0 somewhere on the unit circle, ascending, with z = 1 and z = -1."""
    at = np.flatnonzero(np.signbit(value.imag[:-1]) != np.signbit(value.imag[1:]))
    roots = _zoom(lambda w: loop.transfer(w).imag, omega[at], omega[at + 1])
    ends = [math.pi / loop.dt_s]
    if loop.finite_at_zero:
        ends.append(0.0)
    where = np.concatenate([roots, ends])
    real = loop.transfer(where).real
    found = [
        _CriticalGain(-1.0 / r, float(w))
        for w, r in zip(where, real.tolist(), strict=True)
        if -GAIN_RANGE < r < -1.0 / GAIN_RANGE
    ]
    return sorted(found, key=lambda critical: critical.gain)


def _gain_range(loop: SampledLoop, critical: list[_CriticalGain]) -> tuple[float | None, float | None, float | None]:
    """(low, high, frequency at high) of the nearest range of gain factors with a stable closed loop.

    Between two neighbouring critical gains no eigenvalue can cross the unit circle, so one look inside each
    range decides it. low is None for a range that begins at zero; all are None if there is no stable range.
    """
    gains = [0.0, *(c.gain for c in critical), math.inf]
    at_high = [*(c.omega for c in critical), None]
    ranges = [(low, high, omega) for (low, high), omega in zip(pairwise(gains), at_high, strict=True)]
    for low, high, omega in sorted(ranges, key=lambda r: _distance(r[0], r[1])):
        if low < high and np.all(np.abs(loop.eigenvalues(_inside(low, high))) < 1.0):
            return low or None, high, omega
    return None, None, None


def _distance(low: float, high: float) -> float:
    """How far a range of gain factors is from 1, as a ratio's logarithm; 0 if 1 lies in it."""
    if high <= 1.0:
        return -math.log(high)
    return math.log(low) if low > 1.0 else 0.0


def _inside(low: float, high: float) -> float:
    """A gain factor well inside a range: the present gain if that is."""
    if low < 1.0 < high:
        return 1.0
    if math.isinf(high):
        return 2.0 * low
    return math.sqrt(low * high) if low else 0.5 * high


@dataclass(frozen=True)
class _Crossover:
    """A frequency at which |L| is 1."""

    omega: float
    phase_deg: float
    """Phase of L above -180 degrees, in [0, 360): the lag that takes it there."""
    falling: bool
    """|L| falls with frequency: more lag here makes an eigenvalue pair unstable; where it rises, stable."""


def _crossovers(loop: SampledLoop, omega: FloatArray, value: ComplexArray) -> list[_Crossover]:
    above = np.abs(value) > 1.0
    at = np.flatnonzero(above[:-1] != above[1:])
    roots = _zoom(lambda w: np.log(np.abs(loop.transfer(w))), omega[at], omega[at + 1])
    phase = (np.degrees(np.angle(loop.transfer(roots))) + 180.0) % 360.0
    return [_Crossover(float(w), float(p), bool(f)) for w, p, f in zip(roots, phase, above[:-1][at], strict=True)]


def _lead_to_stability(events: list[tuple[float, bool]], unstable: int, most: float) -> float | None:
    """Least lead after which no eigenvalue is left outside the unit circle.

    Args:
        events: (lead at which an eigenvalue pair meets the unit circle, whether lead brings it inside).
        unstable: eigenvalues outside now.
        most: lead beyond which not to look.
    """
    for lead, inwards in sorted(events):
        if lead > most:
            break
        unstable += -2 if inwards else 2
        if unstable == 0:
            return lead
    return None


def _phase_margin(crossovers: list[_Crossover], unstable: int) -> float | None:
    if unstable == 0:
        return min((min(c.phase_deg, 360.0 - c.phase_deg) for c in crossovers), default=math.inf)
    lead = _lead_to_stability([(360.0 - c.phase_deg, c.falling) for c in crossovers], unstable, 180.0)
    return None if lead is None else -lead


def _delay_margin(crossovers: list[_Crossover], unstable: int, loop_delay_s: float) -> float | None:
    if unstable == 0:
        return min((math.radians(c.phase_deg) / c.omega for c in crossovers), default=math.inf)
    events = [
        (math.radians(360.0 - c.phase_deg + 360.0 * turn) / c.omega, c.falling)
        for c in crossovers
        for turn in range(1 + math.ceil(loop_delay_s * c.omega / (2.0 * math.pi)))
    ]
    lead_s = _lead_to_stability(events, unstable, loop_delay_s)
    return None if lead_s is None else -lead_s


def _modulus_margin(loop: SampledLoop, omega: FloatArray, value: ComplexArray) -> float:
    """Least |1 + L|, refined around the grid's own minimum and compared with z = -1."""
    i = int(np.argmin(np.abs(1.0 + value)))
    low, high = omega[max(i - 1, 0)], omega[min(i + 1, len(omega) - 1)]
    least = math.inf
    for _ in range(6):
        points = np.linspace(low, high, 9)
        distance = np.abs(1.0 + loop.transfer(points))
        j = int(np.argmin(distance))
        least = float(distance[j])
        low, high = points[max(j - 1, 0)], points[min(j + 1, 8)]
    return min(least, float(np.abs(1.0 + loop.transfer(math.pi / loop.dt_s))))
