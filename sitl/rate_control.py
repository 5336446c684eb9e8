"""PX4's rate PID, one axis. Source: PX4 ``lib/rate_control`` and ``mc_rate_control``."""

from __future__ import annotations

import math

from sitl.compiled import compiled, select
from sitl.filters import constrain

_I_FACTOR_RATE = math.radians(400.0)
"""Rate error at which the integrator stops altogether, rad/s."""


@compiled
def rate_control(
    rate: float,
    rate_sp: float,
    accel: float,
    integral: float,
    k: float,
    kp: float,
    ki: float,
    kd: float,
    kff: float,
    int_lim: float,
    positive_saturated: bool,
    negative_saturated: bool,
    frozen: bool,
    dt_s: float,
) -> tuple[float, float]:
    """Torque set-point and next integrator state of one axis.

    The integrator moves after the output is formed, one-sided while the allocator reports this axis saturated,
    less and less as the error nears 400 deg/s, and not at all on the ground. K scales P, I and D, not FF.

    Args:
        rate: filtered body rate, rad/s.
        rate_sp: its set-point, rad/s; not finite means no error.
        accel: filtered derivative of the rate, rad/s^2.
        integral: integrator state, normalised torque.
        k: MC_xRATE_K. kp: MC_xRATE_P. ki: MC_xRATE_I. kd: MC_xRATE_D. kff: MC_xRATE_FF.
        int_lim: MC_xR_INT_LIM, normalised torque; infinity for none, and then for no 400 deg/s fade-out either.
        positive_saturated: no more positive torque to be had. negative_saturated: nor negative.
        frozen: landed or maybe landed.
        dt_s: time since the last sample, s.

    Returns:
        (torque, integral): normalised torque set-point (not clamped), next integrator state.
    """
    # no branches: the same lines run for many vehicles at once, in compiled lanes or on arrays
    rate_sp = select(math.isfinite(rate_sp), rate_sp, rate)
    error = rate_sp - rate
    torque = k * kp * error + integral - k * kd * accel + kff * rate_sp
    error = select(positive_saturated, min(error, 0.0), error)
    error = select(negative_saturated, max(error, 0.0), error)
    ratio = error / _I_FACTOR_RATE
    factor = select(int_lim != math.inf, max(0.0, 1.0 - ratio * ratio), 1.0)
    moved = integral + factor * k * ki * error * dt_s
    moved = select(math.isfinite(moved), constrain(moved, -int_lim, int_lim), integral)
    return select(math.isfinite(torque), torque, 0.0), select(frozen, integral, moved)
