"""One compiled tick of the three-axis control chain: gyro sample in, motor commands out.

Order within a tick, as a PX4 in lockstep has it: gyro filter, rate PID with the rate set-point of the tick before,
allocation (the motors act from this sample on, held to the next), then the attitude law, whose rate set-point is used
one tick later. The attitude it sees is a fraction of a tick late, as the estimator's is.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.actuators import MAX_MOTORS, allocate, motor_output, saturation
from sitl.attitude_control import attitude_control, linear_attitude_control
from sitl.compiled import Record, compiled
from sitl.filters import biquad, constrain, settle_biquad, slope_step
from sitl.rate_control import rate_control
from sitl.rotation import normalise, to_euler

HISTORY = 8
"""Attitudes remembered, hence the greatest lateness of the estimate in ticks is HISTORY - 2."""

_ABSURD = 1e6
"""Bound of rate set-points (rad/s) and motors where there are no limits: what diverges must still be told."""

OFF, RATES, ATTITUDE = 0, 1, 2
"""What the loop controls: nothing (motors stopped), body rates, attitude."""

CONTROL_SETTINGS = np.dtype(
    [
        ("dt_s", "f8"),
        ("low_pass", "f8", (5,)),
        ("notches", "f8", (2, 5)),
        ("notch_count", "i8"),
        ("dgyro_alpha", "f8"),
        ("att_gain", "f8", (3,)),
        ("yaw_weight", "f8"),
        ("rate_max", "f8", (3,)),
        ("k", "f8", (3,)),
        ("kp", "f8", (3,)),
        ("ki", "f8", (3,)),
        ("kd", "f8", (3,)),
        ("kff", "f8", (3,)),
        ("int_lim", "f8", (3,)),
        ("yaw_torque_alpha", "f8"),
        ("mix", "f8", (MAX_MOTORS, 4)),
        ("inverse", "f8", (4, MAX_MOTORS)),
        ("motor_count", "i8"),
        ("method", "i8"),
        ("airmode", "i8"),
        ("slew_per_tick", "f8", (MAX_MOTORS,)),
        ("thr_mdl_fac", "f8"),
        ("status_ticks", "i8"),
        ("attitude_late_ticks", "f8"),
        ("rate_sp_late", "?"),
        ("limits", "?"),
        ("linear", "?"),
    ],
    align=True,
)
"""What a tick needs to know and never changes: gains, filter coefficients, mix (SI, rad, normalised torque)."""

CONTROL_INPUT = np.dtype(
    [
        ("level", "i8"),
        ("quat_sp", "f8", (4,)),
        ("yaw_rate_sp", "f8"),
        ("rates_sp", "f8", (3,)),
        ("thrust_sp", "f8"),
        ("landed", "?"),
    ],
    align=True,
)
"""What the modes ask of the loop; rates_sp counts at level RATES only."""

CONTROL_STATE = np.dtype(
    [
        ("started", "?"),
        ("low_pass", "f8", (3, 2)),
        ("notches", "f8", (2, 3, 2)),
        ("rates", "f8", (3,)),
        ("accel", "f8", (3,)),
        ("integral", "f8", (3,)),
        ("positive", "u1", (3,)),
        ("negative", "u1", (3,)),
        ("status_age", "i8"),
        ("attitudes", "f8", (HISTORY, 4)),
        ("attitude", "f8", (4,)),
        ("rates_sp", "f8", (3,)),
        ("yaw_torque", "f8"),
        ("torque_sp", "f8", (3,)),
        ("motors", "f8", (MAX_MOTORS,)),
        ("outputs", "f8", (MAX_MOTORS,)),
    ],
    align=True,
)
"""What a tick remembers; motors are commands in thrust space, outputs the signals sent to the motors."""


@compiled
def _filter_gyro(settings: Record, state: Record, gyro: NDArray[np.float64]) -> None:
    for axis in range(3):
        sample = gyro[axis]
        for i in range(settings.notch_count):
            if not state.started:
                settle_biquad(settings.notches[i], state.notches[i, axis], sample)
            sample = biquad(settings.notches[i], state.notches[i, axis], sample)
        if not state.started:
            settle_biquad(settings.low_pass, state.low_pass[axis], sample)
        rate = biquad(settings.low_pass, state.low_pass[axis], sample)
        if state.started:
            alpha, dt_s = settings.dgyro_alpha, settings.dt_s
            state.accel[axis] = slope_step(state.accel[axis], rate, state.rates[axis], alpha, dt_s)
        state.rates[axis] = rate


@compiled
def settle_filters(settings_array: NDArray[np.void], state_array: NDArray[np.void]) -> None:
    """Let changed gyro filters start from the rates they put out last, as PX4 does when a cutoff is set in flight.

    Args:
        settings_array: (1,) of CONTROL_SETTINGS, the new ones. state_array: (1,) of CONTROL_STATE, updated in place.
    """
    settings: Record = settings_array[0]
    state: Record = state_array[0]
    for axis in range(3):
        rate = state.rates[axis]
        for i in range(settings.notch_count):
            settle_biquad(settings.notches[i], state.notches[i, axis], rate)
        settle_biquad(settings.low_pass, state.low_pass[axis], rate)


@compiled
def _estimate_attitude(settings: Record, state: Record, quat: NDArray[np.float64]) -> None:
    if state.started:
        for i in range(HISTORY - 1, 0, -1):
            for j in range(4):
                state.attitudes[i, j] = state.attitudes[i - 1, j]
    for i in range(1 if state.started else HISTORY):
        for j in range(4):
            state.attitudes[i, j] = quat[j]
    whole = int(settings.attitude_late_ticks)
    part = settings.attitude_late_ticks - whole
    a = state.attitudes[whole]
    b = state.attitudes[min(whole + 1, HISTORY - 1)]
    sign = 1.0 if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] >= 0.0 else -1.0
    q = normalise(
        (
            a[0] * (1.0 - part) + sign * b[0] * part,
            a[1] * (1.0 - part) + sign * b[1] * part,
            a[2] * (1.0 - part) + sign * b[2] * part,
            a[3] * (1.0 - part) + sign * b[3] * part,
        )
    )
    for j in range(4):
        state.attitude[j] = q[j]


@compiled
def _attitude_law(settings: Record, request: Record, state: Record) -> None:
    if request.level != ATTITUDE:
        for axis in range(3):
            state.rates_sp[axis] = request.rates_sp[axis] if request.level == RATES else 0.0
        return
    a = state.attitude
    quat = (a[0], a[1], a[2], a[3])
    s = request.quat_sp
    quat_sp = (s[0], s[1], s[2], s[3])
    gain = (settings.att_gain[0], settings.att_gain[1], settings.att_gain[2])
    if not 0.0 < s[0] ** 2 + s[1] ** 2 + s[2] ** 2 + s[3] ** 2 < math.inf:
        wanted = (math.nan, math.nan, math.nan)
    elif settings.linear:
        wanted = linear_attitude_control(to_euler(quat), to_euler(normalise(quat_sp)), gain)
    else:
        rate_max = (settings.rate_max[0], settings.rate_max[1], settings.rate_max[2])
        wanted = attitude_control(quat, quat_sp, gain, settings.yaw_weight, rate_max, request.yaw_rate_sp)
    for axis in range(3):
        state.rates_sp[axis] = constrain(wanted[axis], -_ABSURD, _ABSURD)


@compiled
def _rate_law(settings: Record, request: Record, state: Record) -> None:
    for axis in range(3):
        if request.level == OFF:
            state.integral[axis] = 0.0
        torque, state.integral[axis] = rate_control(
            state.rates[axis],
            state.rates_sp[axis],
            state.accel[axis],
            state.integral[axis],
            settings.k[axis],
            settings.kp[axis],
            settings.ki[axis],
            settings.kd[axis],
            settings.kff[axis],
            settings.int_lim[axis],
            state.positive[axis] != 0,
            state.negative[axis] != 0,
            request.landed or request.level == OFF,
            settings.dt_s,
        )
        state.torque_sp[axis] = torque
    state.yaw_torque += settings.yaw_torque_alpha * (state.torque_sp[2] - state.yaw_torque)
    state.torque_sp[2] = state.yaw_torque


@compiled
def _allocation(settings: Record, request: Record, state: Record) -> None:
    n = settings.motor_count
    for i in range(n, MAX_MOTORS):
        state.motors[i] = 0.0
        state.outputs[i] = 0.0
    if request.level == OFF:
        for i in range(n):
            state.motors[i] = 0.0
            state.outputs[i] = 0.0
        for axis in range(3):
            state.positive[axis] = 0
            state.negative[axis] = 0
        return
    if not settings.limits:
        allocate(settings.mix, n, state.torque_sp, request.thrust_sp, 0, 0, state.motors)
        for i in range(n):
            state.motors[i] = constrain(state.motors[i], -_ABSURD, _ABSURD)
            state.outputs[i] = state.motors[i] if math.isfinite(state.motors[i]) else 0.0
        return
    wanted = np.empty(MAX_MOTORS)
    allocate(settings.mix, n, state.torque_sp, request.thrust_sp, settings.method, settings.airmode, wanted)
    for i in range(n):
        slew = settings.slew_per_tick[i]
        # PX4 stops a motor whose command is not a number
        value = wanted[i] if math.isfinite(wanted[i]) else 0.0
        value = constrain(value, state.motors[i] - slew, state.motors[i] + slew)
        state.motors[i] = constrain(value, 0.0, 1.0)
        state.outputs[i] = motor_output(state.motors[i], settings.thr_mdl_fac)
    state.status_age += 1
    if state.status_age >= settings.status_ticks:
        state.status_age = 0
        saturation(settings.inverse, n, state.torque_sp, state.motors, state.positive, state.negative)


@compiled
def control_tick(
    settings_array: NDArray[np.void],
    input_array: NDArray[np.void],
    state_array: NDArray[np.void],
    gyro: NDArray[np.float64],
    quat: NDArray[np.float64],
) -> None:
    """Run one tick of gyro filter, attitude law, rate law and allocation, in PX4's order.

    Args:
        settings_array: (1,) of CONTROL_SETTINGS.
        input_array: (1,) of CONTROL_INPUT.
        state_array: (1,) of CONTROL_STATE, updated in place; its ``outputs`` go to the motors.
        gyro: (3,) measured body rates of this tick, rad/s.
        quat: (4,) true attitude of this tick, body to world.
    """
    settings: Record = settings_array[0]
    request: Record = input_array[0]
    state: Record = state_array[0]
    _filter_gyro(settings, state, gyro)
    _estimate_attitude(settings, state, quat)
    state.started = True
    # what is late is the attitude law's answer: a rate set-point that was asked for is flown at once
    late: bool = settings.rate_sp_late and request.level == ATTITUDE
    if not late:
        _attitude_law(settings, request, state)
    _rate_law(settings, request, state)
    _allocation(settings, request, state)
    if late:
        _attitude_law(settings, request, state)
