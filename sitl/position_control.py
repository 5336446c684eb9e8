"""PX4's position, velocity and acceleration controller: from a NED set-point to attitude and thrust.

Source: PX4 ``mc_pos_control/PositionControl``. It runs every 8 ms on velocities one tick old, as PX4's does in SITL
(measured): that is how a side force at the motors finds its way back into the roll set-point in Hold.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.compiled import Record, compiled
from sitl.filters import constrain

PERIOD_S = 0.008

POSITION_SETTINGS = np.dtype(
    [
        ("dt_s", "f8"),
        ("pos_p", "f8", (3,)),
        ("vel_p", "f8", (3,)),
        ("vel_i", "f8", (3,)),
        ("vel_d", "f8", (3,)),
        ("veld_alpha", "f8"),
        ("vel_xy_max", "f8"),
        ("vel_up_max", "f8"),
        ("vel_down_max", "f8"),
        ("hover_thrust", "f8"),
        ("thr_min", "f8"),
        ("thr_max", "f8"),
        ("thr_xy_marg", "f8"),
        ("tilt_max", "f8"),
    ],
    align=True,
)
"""MPC_* parameters in SI; tilt_max in rad."""

POSITION_INPUT = np.dtype(
    [
        ("position_sp", "f8", (3,)),
        ("velocity_sp", "f8", (3,)),
        ("acceleration_sp", "f8", (3,)),
        ("yaw_sp", "f8"),
        ("idle", "?"),
    ],
    align=True,
)
"""NED set-points, m, m/s and m/s^2; idle: on the ground, no thrust.

What is NaN is left out: an axis without a position follows its velocity, one without both its acceleration alone.
"""

POSITION_STATE = np.dtype(
    [
        ("started", "?"),
        ("vel_prev", "f8", (3,)),
        ("vel_dot", "f8", (3,)),
        ("vel_int", "f8", (3,)),
        ("vel_sp", "f8", (3,)),
        ("acc_sp", "f8", (3,)),
        ("quat_sp", "f8", (4,)),
        ("thrust_sp", "f8"),
    ],
    align=True,
)

ONE_G_M_S2 = 9.80665
"""PX4's gravity, which its position controller and take-off ramp reckon with."""


@compiled
def _attitude_from_thrust(thrust: NDArray[np.float64], yaw: float, quat: NDArray[np.float64]) -> None:
    """Attitude whose -z axis points along a NED thrust vector, heading yaw."""
    length = math.sqrt(thrust[0] ** 2 + thrust[1] ** 2 + thrust[2] ** 2)
    if length < 1e-9:
        zx, zy, zz = 0.0, 0.0, 1.0
    else:
        zx, zy, zz = -thrust[0] / length, -thrust[1] / length, -thrust[2] / length
    cx, cy = -math.sin(yaw), math.cos(yaw)
    xx, xy, xz = cy * zz, -cx * zz, cx * zy - cy * zx
    if zz < 0.0:
        xx, xy, xz = -xx, -xy, -xz
    if abs(zz) < 1e-6:
        xx, xy, xz = 0.0, 0.0, 1.0  # thrust lies flat: heading has no meaning
    norm = math.sqrt(xx * xx + xy * xy + xz * xz)
    xx, xy, xz = xx / norm, xy / norm, xz / norm
    yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    trace = xx + yy + zz
    if trace > 0.0:
        s = math.sqrt(trace + 1.0) * 2.0
        w, a, b, c = 0.25 * s, (yz - zy) / s, (zx - xz) / s, (xy - yx) / s
    elif xx > yy and xx > zz:
        s = math.sqrt(1.0 + xx - yy - zz) * 2.0
        w, a, b, c = (yz - zy) / s, 0.25 * s, (yx + xy) / s, (zx + xz) / s
    elif yy > zz:
        s = math.sqrt(1.0 + yy - xx - zz) * 2.0
        w, a, b, c = (zx - xz) / s, (yx + xy) / s, 0.25 * s, (zy + yz) / s
    else:
        s = math.sqrt(1.0 + zz - xx - yy) * 2.0
        w, a, b, c = (xy - yx) / s, (zx + xz) / s, (zy + yz) / s, 0.25 * s
    quat[0], quat[1], quat[2], quat[3] = w, a, b, c


@compiled
def _thrust(s: Record, state: Record) -> tuple[float, float, float]:
    """NED thrust vector (up is negative) for the wanted acceleration, tilt limited."""
    ax, ay, az = state.acc_sp[0], state.acc_sp[1], state.acc_sp[2]
    side = math.sqrt(ax * ax + ay * ay)
    tilt = min(math.atan2(side, ONE_G_M_S2), s.tilt_max)
    bx, by = 0.0, 0.0
    if side > 0.0:
        bx, by = -ax / side * math.sin(tilt), -ay / side * math.sin(tilt)
    bz = math.cos(tilt)
    collective = min((az * s.hover_thrust / ONE_G_M_S2 - s.hover_thrust) / bz, -s.thr_min)
    return bx * collective, by * collective, bz * collective


@compiled
def position_tick(
    settings_array: NDArray[np.void],
    input_array: NDArray[np.void],
    state_array: NDArray[np.void],
    position: NDArray[np.float64],
    velocity: NDArray[np.float64],
) -> None:
    """One run of the position controller.

    Args:
        settings_array: (1,) of POSITION_SETTINGS.
        input_array: (1,) of POSITION_INPUT.
        state_array: (1,) of POSITION_STATE; quat_sp and thrust_sp (0..1) are the result.
        position: (3,) NED, m. velocity: (3,) NED, m/s.
    """
    s: Record = settings_array[0]
    request: Record = input_array[0]
    state: Record = state_array[0]
    for i in range(3):
        if not state.started:
            state.vel_prev[i] = velocity[i]
        slope = (velocity[i] - state.vel_prev[i]) / s.dt_s
        state.vel_dot[i] += s.veld_alpha * (slope - state.vel_dot[i])
        state.vel_prev[i] = velocity[i]
        wanted = request.velocity_sp[i]
        if math.isfinite(request.position_sp[i]):
            wanted = (wanted if math.isfinite(wanted) else 0.0) + s.pos_p[i] * (request.position_sp[i] - position[i])
        state.vel_sp[i] = wanted
    state.started = True
    speed = math.sqrt(state.vel_sp[0] ** 2 + state.vel_sp[1] ** 2)
    if speed > max(0.0, s.vel_xy_max):
        state.vel_sp[0] *= s.vel_xy_max / speed
        state.vel_sp[1] *= s.vel_xy_max / speed
    if math.isfinite(request.position_sp[2]):
        # a speed asked for by itself may pass the limit: the take-off ramp starts from one that means no thrust
        state.vel_sp[2] = constrain(state.vel_sp[2], -s.vel_up_max, s.vel_down_max)
    error = np.empty(3)
    state.vel_int[2] = constrain(state.vel_int[2], -ONE_G_M_S2, ONE_G_M_S2)
    for i in range(3):
        error[i] = state.vel_sp[i] - velocity[i]
        state.acc_sp[i] = s.vel_p[i] * error[i] + state.vel_int[i] - s.vel_d[i] * state.vel_dot[i]
        extra = request.acceleration_sp[i]
        if math.isfinite(extra):
            state.acc_sp[i] = state.acc_sp[i] + extra if math.isfinite(error[i]) else extra
        elif not math.isfinite(error[i]):
            state.acc_sp[i] = 0.0
    if request.idle:
        for i in range(3):
            state.vel_int[i] = 0.0
            state.acc_sp[i] = 0.0
        state.thrust_sp = 0.0
        _attitude_from_thrust(np.array([0.0, 0.0, -1.0]), request.yaw_sp, state.quat_sp)
        return
    tx, ty, tz = _thrust(s, state)
    if (tz >= -s.thr_min and error[2] >= 0.0) or (tz <= -s.thr_max and error[2] <= 0.0):
        error[2] = 0.0
    side = math.sqrt(tx * tx + ty * ty)
    kept = min(side, s.thr_xy_marg)
    tz = max(tz, -math.sqrt(max(0.0, s.thr_max**2 - kept**2)))
    side_max = math.sqrt(max(0.0, s.thr_max**2 - tz**2))
    if side > side_max:
        tx, ty = tx / side * side_max, ty / side * side_max
    got_x, got_y = tx * ONE_G_M_S2 / s.hover_thrust, ty * ONE_G_M_S2 / s.hover_thrust
    if s.vel_p[0] > 0.0 and state.acc_sp[0] ** 2 + state.acc_sp[1] ** 2 > got_x**2 + got_y**2:
        error[0] -= 2.0 / s.vel_p[0] * (state.acc_sp[0] - got_x)
        error[1] -= 2.0 / s.vel_p[1] * (state.acc_sp[1] - got_y)
    for i in range(3):
        moved = state.vel_int[i] + error[i] * s.vel_i[i] * s.dt_s
        if math.isfinite(moved):
            state.vel_int[i] = moved
    thrust = np.array([tx, ty, tz])
    _attitude_from_thrust(thrust, request.yaw_sp, state.quat_sp)
    state.thrust_sp = math.sqrt(tx * tx + ty * ty + tz * tz)
