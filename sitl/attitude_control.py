"""PX4's attitude controller: quaternion P with reduced yaw priority, and rate limits.

Source: PX4 ``mc_att_control/AttitudeControl/AttitudeControl.cpp``.
"""

from __future__ import annotations

import math

from sitl.compiled import compiled
from sitl.filters import constrain
from sitl.rotation import Quat, Vec3, canonical, conjugate, multiply, normalise, to_body, to_world

_INVERTED = 1.0 - 1e-5


@compiled
def reduced_attitude(quat: Quat, quat_sp: Quat) -> Quat:
    """The attitude that reaches the set-point's thrust direction by the shortest rotation, yaw left alone.

    Args:
        quat: attitude, body to world.
        quat_sp: wanted attitude, body to world.
    """
    a = to_world(quat, (0.0, 0.0, 1.0))
    b = to_world(quat_sp, (0.0, 0.0, 1.0))
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    if dot < 0.0 and cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2] < 1e-10:
        # exactly opposite: any axis across the thrust direction does; the rotation is half a turn
        return quat_sp
    tilt = normalise((dot + 1.0, cross[0], cross[1], cross[2]))
    if abs(tilt[1]) > _INVERTED or abs(tilt[2]) > _INVERTED:
        return quat_sp
    return multiply(tilt, quat)


@compiled
def attitude_error(quat: Quat, quat_sp: Quat, yaw_weight: float) -> Vec3:
    """Attitude error in body axes, rad for small errors (2 sin(angle/2) about a single axis).

    Args:
        quat: attitude estimate, body to world.
        quat_sp: wanted attitude, body to world, any length.
        yaw_weight: MC_YAW_WEIGHT, 0..1: how much of the yaw error counts.
    """
    wanted = normalise(quat_sp)
    reduced = reduced_attitude(quat, wanted)
    yaw = canonical(multiply(conjugate(reduced), wanted))
    w = min(1.0, max(-1.0, yaw[0]))
    z = min(1.0, max(-1.0, yaw[3]))
    part = (math.cos(yaw_weight * math.acos(w)), 0.0, 0.0, math.sin(yaw_weight * math.asin(z)))
    error = canonical(multiply(conjugate(quat), multiply(reduced, part)))
    return (2.0 * error[1], 2.0 * error[2], 2.0 * error[3])


@compiled
def attitude_control(
    quat: Quat, quat_sp: Quat, gain: Vec3, yaw_weight: float, rate_max: Vec3, yaw_rate_sp: float
) -> Vec3:
    """Body-rate set-point of the attitude controller.

    Args:
        quat: attitude estimate, body to world.
        quat_sp: attitude set-point, body to world.
        gain: (MC_ROLL_P, MC_PITCH_P, MC_YAW_P), 1/s.
        yaw_weight: MC_YAW_WEIGHT, 0..1.
        rate_max: rate limits about x, y, z, rad/s; infinity for none.
        yaw_rate_sp: yaw rate to feed forward about the world's z axis, rad/s; NaN for none.

    Returns:
        (p_sp, q_sp, r_sp), rad/s.
    """
    ex, ey, ez = attitude_error(quat, quat_sp, yaw_weight)
    yaw_gain = gain[2] / yaw_weight if yaw_weight > 1e-4 else gain[2]
    p_sp, q_sp, r_sp = gain[0] * ex, gain[1] * ey, yaw_gain * ez
    if math.isfinite(yaw_rate_sp):
        down = to_body(quat, (0.0, 0.0, 1.0))
        p_sp += down[0] * yaw_rate_sp
        q_sp += down[1] * yaw_rate_sp
        r_sp += down[2] * yaw_rate_sp
    return (
        constrain(p_sp, -rate_max[0], rate_max[0]),
        constrain(q_sp, -rate_max[1], rate_max[1]),
        constrain(r_sp, -rate_max[2], rate_max[2]),
    )


@compiled
def linear_attitude_control(euler: Vec3, euler_sp: Vec3, gain: Vec3) -> Vec3:
    """The study's attitude hold, K_phi (phi_sp - phi), on each Euler angle alone (profile ``study``).

    Args:
        euler: (phi, theta, psi), rad.
        euler_sp: set-points of the same, rad.
        gain: (MC_ROLL_P, MC_PITCH_P, MC_YAW_P), 1/s.
    """
    return (
        gain[0] * (euler_sp[0] - euler[0]),
        gain[1] * (euler_sp[1] - euler[1]),
        gain[2] * math.atan2(math.sin(euler_sp[2] - euler[2]), math.cos(euler_sp[2] - euler[2])),
    )
