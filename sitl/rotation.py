"""Quaternions (w, x, y, z; Hamilton, body to world) and Euler angles (ZYX: phi, theta, psi), compiled."""

from __future__ import annotations

import math

from sitl.compiled import compiled

Quat = tuple[float, float, float, float]
Vec3 = tuple[float, float, float]


@compiled
def multiply(a: Quat, b: Quat) -> Quat:
    """Hamilton product a b."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@compiled
def conjugate(a: Quat) -> Quat:
    """Inverse of a unit quaternion."""
    return (a[0], -a[1], -a[2], -a[3])


@compiled
def normalise(a: Quat) -> Quat:
    """The quaternion at unit length; (1, 0, 0, 0) if it has no length."""
    length = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + a[3] * a[3])
    if not length > 0.0:
        return (1.0, 0.0, 0.0, 0.0)
    return (a[0] / length, a[1] / length, a[2] / length, a[3] / length)


@compiled
def canonical(a: Quat) -> Quat:
    """The one of the two equal quaternions with w >= 0."""
    if a[0] < 0.0:
        return (-a[0], -a[1], -a[2], -a[3])
    return a


@compiled
def to_world(q: Quat, v: Vec3) -> Vec3:
    """A body vector in world axes."""
    tx = 2.0 * (q[2] * v[2] - q[3] * v[1])
    ty = 2.0 * (q[3] * v[0] - q[1] * v[2])
    tz = 2.0 * (q[1] * v[1] - q[2] * v[0])
    return (
        v[0] + q[0] * tx + q[2] * tz - q[3] * ty,
        v[1] + q[0] * ty + q[3] * tx - q[1] * tz,
        v[2] + q[0] * tz + q[1] * ty - q[2] * tx,
    )


@compiled
def to_body(q: Quat, v: Vec3) -> Vec3:
    """A world vector in body axes."""
    return to_world(conjugate(q), v)


@compiled
def from_euler(phi: float, theta: float, psi: float) -> Quat:
    """Quaternion of ZYX Euler angles, rad."""
    cr, sr = math.cos(phi / 2.0), math.sin(phi / 2.0)
    cp, sp = math.cos(theta / 2.0), math.sin(theta / 2.0)
    cy, sy = math.cos(psi / 2.0), math.sin(psi / 2.0)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@compiled
def to_euler(q: Quat) -> Vec3:
    """ZYX Euler angles (phi, theta, psi) of a unit quaternion, rad."""
    phi = math.atan2(2.0 * (q[0] * q[1] + q[2] * q[3]), 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))
    s = 2.0 * (q[0] * q[2] - q[3] * q[1])
    theta = math.asin(min(1.0, max(-1.0, s)))
    psi = math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
    return (phi, theta, psi)
