"""Stability of the roll loop as it is flown: gain, phase, delay and modulus margins, cut at delta_lat.

What is found and how stands in `margin_batch`, which does the same for many models and gain sets at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy.typing as npt

from sitl.airframe import Derivatives
from sitl.margin_batch import Sampled, margins_of_loop
from sitl.profile import Profile
from sitl.sampled_loop import ComplexArray, RollGains, SampledLoop

__all__ = ["Margins", "RollGains", "loop_margins", "loop_transfer", "margins_of"]


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
    """Margins of the loop of one model: a batch of one."""
    one = loop.as_samples()
    found = margins_of_loop(Sampled(one), 1)

    def number(name: str) -> float | None:
        value = float(getattr(found, name)[0])
        return None if math.isnan(value) else value

    return Margins(
        closed_loop_stable=bool(found.closed_loop_stable[0]),
        gain_margin_low_db=number("gain_margin_low_db"),
        gain_margin_high_db=number("gain_margin_high_db"),
        phase_margin_deg=number("phase_margin_deg"),
        delay_margin_s=number("delay_margin_s"),
        modulus_margin=float(found.modulus_margin[0]),
        crossover_rad_s=number("crossover_rad_s"),
        phase_crossover_rad_s=number("phase_crossover_rad_s"),
        loop_delay_s=loop.delay_s,
    )
