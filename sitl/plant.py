"""The airframe's motion: the study's lateral model, its longitudinal mirror, heave, yaw, ground and position.

Lateral is equations 2.2 and 2.3 of the study; with delta the torque that the motors give at that moment:

    fy = Yv v + Yp p + Yd delta_lat          p' = Lv v + Lp p + Ld delta_lat
    fx = Yv u - Yp q - Yd delta_lon          q' = -Lv u + Lp q + Ld delta_lon
    fz = -g T/T_hover - heave w              r' = -yaw_damping r + yaw_gain delta_yaw

f is the specific force an accelerometer reads (a_y of the study), so motion and measurement cannot disagree. The
full form turns f and gravity with a quaternion; the linear form (profile ``study``) keeps g phi and -g theta and lets
phi' = p, which is the study's model exactly.

The motors follow their commands with a first-order lag, integrated exactly; the rest is a fourth-order Runge-Kutta
in steps of at most 1 ms.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sitl.actuators import MAX_MOTORS, Mix
from sitl.airframe import Assumptions, Derivatives
from sitl.compiled import Record, compiled
from sitl.rotation import from_euler, to_euler, to_world

Floats = NDArray[np.float64]

G_M_S2 = 9.81
"""Gravity that reproduces table 3.1 of the study to its printed digits, m/s^2."""

MAX_STEP_S = 1e-3
LOST_M, LOST_M_S, LOST_RAD_S = 1e5, 300.0, 1e4
"""Beyond these (position, speed, body rate) the model means nothing any more: see ``Plant.lost``."""
MAX_DELAY_TICKS = 64

PLANT_SETTINGS = np.dtype(
    [
        ("Yv", "f8"),
        ("Yp", "f8"),
        ("Yd", "f8"),
        ("Lv", "f8"),
        ("Lp", "f8"),
        ("Ld", "f8"),
        ("hover_thrust", "f8"),
        ("heave_damping", "f8"),
        ("yaw_gain", "f8"),
        ("yaw_damping", "f8"),
        ("motor_lag_s", "f8"),
        ("inverse", "f8", (4, MAX_MOTORS)),
        ("motor_count", "i8"),
        ("delay_ticks", "i8"),
        ("steps", "i8"),
        ("step_s", "f8"),
        ("gust_m_s2", "f8"),
        ("gust_rad_s2", "f8"),
        ("gusts", "?"),
        ("linear", "?"),
    ],
    align=True,
)

PLANT_STATE = np.dtype(
    [
        # north, east, down (m); u, v, w (m/s); quaternion or, in the linear form, phi, theta, psi, 0; p, q, r (rad/s)
        ("x", "f8", (13,)),
        ("motors", "f8", (MAX_MOTORS,)),
        ("queue", "f8", (MAX_DELAY_TICKS + 1, MAX_MOTORS)),
        ("force", "f8", (3,)),
        ("delta", "f8", (4,)),
        ("quat", "f8", (4,)),
        ("velocity", "f8", (3,)),
        ("contact", "?"),
        ("lost", "?"),
    ],
    align=True,
)

_GROUND_STIFFNESS = 400.0
_GROUND_DAMPING = 36.0
_GROUND_FRICTION = 6.0
_GROUND_LEVELLING = 120.0
_GROUND_LEVELLING_DAMPING = 16.0
_REST = G_M_S2 / _GROUND_STIFFNESS


@compiled
def _derivative(s: Record, x: Floats, d: Floats, dx: Floats, force: Floats) -> bool:
    u, v, w = x[3], x[4], x[5]
    p, q, r = x[10], x[11], x[12]
    force[0] = s.Yv * u - s.Yp * q - s.Yd * d[1]
    force[1] = s.Yv * v + s.Yp * p + s.Yd * d[0]
    force[2] = -G_M_S2 * d[3] / s.hover_thrust - s.heave_damping * w
    if s.linear:
        phi, theta, psi = x[6], x[7], x[8]
        gx, gy, gz = -G_M_S2 * theta, G_M_S2 * phi, G_M_S2
        c, n = math.cos(psi), math.sin(psi)
        dx[0], dx[1], dx[2] = c * u - n * v, n * u + c * v, w
        dx[6], dx[7], dx[8], dx[9] = p, q, r, 0.0
    else:
        a, b, c, e = x[6], x[7], x[8], x[9]
        gx, gy, gz = (
            2.0 * (b * e - a * c) * G_M_S2,
            2.0 * (c * e + a * b) * G_M_S2,
            (a * a - b * b - c * c + e * e) * G_M_S2,
        )
        dx[0] = (a * a + b * b - c * c - e * e) * u + 2.0 * (b * c - a * e) * v + 2.0 * (b * e + a * c) * w
        dx[1] = 2.0 * (b * c + a * e) * u + (a * a - b * b + c * c - e * e) * v + 2.0 * (c * e - a * b) * w
        dx[2] = 2.0 * (b * e - a * c) * u + 2.0 * (c * e + a * b) * v + (a * a - b * b - c * c + e * e) * w
        dx[6] = 0.5 * (-b * p - c * q - e * r)
        dx[7] = 0.5 * (a * p + c * r - e * q)
        dx[8] = 0.5 * (a * q - b * r + e * p)
        dx[9] = 0.5 * (a * r + b * q - c * p)
        phi = math.atan2(gy, gz)
        theta = math.asin(min(1.0, max(-1.0, -gx / G_M_S2)))
    dx[10] = s.Lv * v + s.Lp * p + s.Ld * d[0]
    dx[11] = -s.Lv * u + s.Lp * q + s.Ld * d[1]
    dx[12] = -s.yaw_damping * r + s.yaw_gain * d[2]
    if s.gusts:
        force[1] += s.gust_m_s2
        dx[10] += s.gust_rad_s2
    depth = x[2] + _REST
    contact: bool = depth > 0.0
    if contact:
        # the reading of an accelerometer at rest on the ground is exactly -g: the contact force is a specific force
        push = max(0.0, _GROUND_STIFFNESS * depth + _GROUND_DAMPING * dx[2])
        force[0] -= push * gx / G_M_S2 + _GROUND_FRICTION * u
        force[1] -= push * gy / G_M_S2 + _GROUND_FRICTION * v
        force[2] -= push * gz / G_M_S2
        dx[10] -= _GROUND_LEVELLING * phi + _GROUND_LEVELLING_DAMPING * p
        dx[11] -= _GROUND_LEVELLING * theta + _GROUND_LEVELLING_DAMPING * q
        dx[12] -= _GROUND_LEVELLING_DAMPING * r
    dx[3] = force[0] + gx
    dx[4] = force[1] + gy
    dx[5] = force[2] + gz
    if not s.linear:
        dx[3] -= q * w - r * v
        dx[4] -= r * u - p * w
        dx[5] -= p * v - q * u
    return contact


@compiled
def _torque(s: Record, motors: Floats, d: Floats) -> None:
    for axis in range(4):
        total = 0.0
        for i in range(s.motor_count):
            total += s.inverse[axis, i] * motors[i]
        d[axis] = total


@compiled
def _step(s: Record, state: Record, start: Floats, middle: Floats, end: Floats, h: float) -> None:
    x = state.x
    k1, k2, k3, k4, y = np.empty(13), np.empty(13), np.empty(13), np.empty(13), np.empty(13)
    f1, f2, f3, f4 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    state.contact = _derivative(s, x, start, k1, f1)
    for i in range(13):
        y[i] = x[i] + 0.5 * h * k1[i]
    _derivative(s, y, middle, k2, f2)
    for i in range(13):
        y[i] = x[i] + 0.5 * h * k2[i]
    _derivative(s, y, middle, k3, f3)
    for i in range(13):
        y[i] = x[i] + h * k3[i]
    _derivative(s, y, end, k4, f4)
    for i in range(13):
        x[i] += h * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]) / 6.0
    for i in range(3):
        state.force[i] += (f1[i] + 2.0 * f2[i] + 2.0 * f3[i] + f4[i]) / 6.0 / s.steps
    if not s.linear:
        length = math.sqrt(x[6] ** 2 + x[7] ** 2 + x[8] ** 2 + x[9] ** 2)
        for i in range(6, 10):
            x[i] /= length


@compiled
def _makes_sense(x: Floats) -> bool:
    good = True
    for i in range(3):
        # NaN makes no sense either: it is below nothing
        good = good and abs(x[i]) < LOST_M and abs(x[3 + i]) < LOST_M_S and abs(x[10 + i]) < LOST_RAD_S
    return good


@compiled
def plant_tick(settings_array: NDArray[np.void], state_array: NDArray[np.void], commands: Floats) -> None:
    """Move the plant by one tick with the motors commanded at its start (after the transport delay).

    Args:
        settings_array: (1,) of PLANT_SETTINGS.
        state_array: (1,) of PLANT_STATE, updated in place; ``force`` is the mean specific force over the tick.
        commands: (MAX_MOTORS,) motor signals, fraction of full thrust.
    """
    s: Record = settings_array[0]
    state: Record = state_array[0]
    if state.lost:
        return
    for i in range(MAX_MOTORS):
        for k in range(s.delay_ticks, 0, -1):
            state.queue[k, i] = state.queue[k - 1, i]
        state.queue[0, i] = commands[i]
    target = state.queue[s.delay_ticks]
    half = math.exp(-0.5 * s.step_s / s.motor_lag_s) if s.motor_lag_s > 0.0 else 0.0
    motors = np.empty(MAX_MOTORS)
    start, middle, end = np.empty(4), np.empty(4), np.empty(4)
    before = state.x.copy()
    for i in range(3):
        state.force[i] = 0.0
    for i in range(MAX_MOTORS):
        if s.motor_lag_s <= 0.0:
            state.motors[i] = target[i]
    _torque(s, state.motors, start)
    for _ in range(s.steps):
        for i in range(MAX_MOTORS):
            motors[i] = target[i] + (state.motors[i] - target[i]) * half
        _torque(s, motors, middle)
        for i in range(MAX_MOTORS):
            state.motors[i] = target[i] + (motors[i] - target[i]) * half
        _torque(s, state.motors, end)
        _step(s, state, start, middle, end, s.step_s)
        for i in range(4):
            start[i] = end[i]
    x = state.x
    if not _makes_sense(x):
        state.lost = True
        for i in range(13):
            x[i] = before[i] if i < 3 else 0.0
        x[6 if s.linear else 7] = math.pi if s.linear else 1.0
        for i in range(MAX_MOTORS):
            state.motors[i] = 0.0
        for i in range(4):
            end[i] = 0.0
        for i in range(3):
            state.force[i] = G_M_S2 if i == 2 else 0.0
    if s.linear:
        quat = from_euler(x[6], x[7], x[8])
        for i in range(4):
            state.quat[i] = quat[i]
    else:
        for i in range(4):
            state.quat[i] = x[6 + i]
    for i in range(4):
        state.delta[i] = end[i]
    if s.linear:
        c, n = math.cos(x[8]), math.sin(x[8])
        velocity = (c * x[3] - n * x[4], n * x[3] + c * x[4], x[5])
    else:
        velocity = to_world((x[6], x[7], x[8], x[9]), (x[3], x[4], x[5]))
    for i in range(3):
        state.velocity[i] = velocity[i]


class Plant:
    """One airframe in the air or on the ground.

    Args:
        derivatives: the model that flies.
        assumptions: what the study does not give: hover thrust, heave, yaw.
        mix: normalised mix of the rotors; its inverse turns motor commands into delta_lat, delta_lon, delta_yaw, T.
        tick_us: length of a tick, us.
        motor_lag_s: time constant of every motor, s; 0 for none.
        delay_ticks: whole ticks between a command and its motor, 0..64.
        linear: the study's linear form instead of the full one.
    """

    def __init__(
        self,
        derivatives: Derivatives,
        assumptions: Assumptions,
        mix: Mix,
        *,
        tick_us: float,
        motor_lag_s: float,
        delay_ticks: int = 0,
        linear: bool = False,
    ) -> None:
        if not 0 <= delay_ticks <= MAX_DELAY_TICKS:
            raise ValueError(f"delay_ticks is {delay_ticks}, want 0..{MAX_DELAY_TICKS}")
        self.tick = 0
        self.weaken: Callable[[Floats], Floats] | None = None
        """What faults of motors and battery make of the commands; None while there are none."""
        self.settings = np.zeros(1, PLANT_SETTINGS)
        self.state = np.zeros(1, PLANT_STATE)
        for name, value in derivatives.as_dict().items():
            self.settings[name] = value
        self.settings["hover_thrust"] = assumptions.hover_thrust
        self.settings["heave_damping"] = assumptions.heave_damping_1_s
        self.settings["yaw_gain"] = assumptions.yaw_gain_rad_s2
        self.settings["yaw_damping"] = assumptions.yaw_damping_1_s
        self.settings["motor_lag_s"] = motor_lag_s
        self.settings["inverse"][0, :, : mix.motors] = mix.inverse
        self.settings["motor_count"] = mix.motors
        self.settings["delay_ticks"] = delay_ticks
        self.set_tick(tick_us)
        self.settings["linear"] = linear
        self.linear = linear
        self.x = self.state["x"][0]
        self.quat = self.state["quat"][0]
        self.force = self.state["force"][0]
        self.delta = self.state["delta"][0]
        self.velocity = self.state["velocity"][0]
        self.rates = self.x[10:13]
        self.position = self.x[0:3]
        self.quat[0] = 1.0
        if not linear:
            self.x[6] = 1.0
        self.force[2] = -G_M_S2

    @property
    def lost(self) -> bool:
        """The motion diverged out of all sense, as a loop without limits can. It lies still then, upside down."""
        return bool(self.state["lost"][0])

    def set_tick(self, tick_us: float) -> None:
        """Go on from here in ticks of another length.

        Args:
            tick_us: length of a tick, us.
        """
        steps = math.ceil(tick_us * 1e-6 / MAX_STEP_S - 1e-9)
        self.tick_us = tick_us
        self.settings["steps"] = steps
        self.settings["step_s"] = tick_us * 1e-6 / steps

    def set_delay(self, ticks: int) -> None:
        """Let commands act later or sooner from here on; those that have acted already stay meanwhile.

        Args:
            ticks: between a command and its motor, 0..64.
        """
        before = int(self.settings["delay_ticks"][0])
        if ticks != before:
            queue = self.state["queue"][0]
            queue[before + 1 : ticks + 1] = queue[before]
            self.settings["delay_ticks"] = ticks

    def step(self, commands: Floats) -> None:
        """Move by one tick.

        Args:
            commands: (12,) motor signals, fraction of full thrust, held over the tick.
        """
        if self.weaken is not None:
            commands = self.weaken(commands)
        plant_tick(self.settings, self.state, commands)
        self.tick += 1

    def euler(self) -> tuple[float, float, float]:
        """(phi, theta, psi), rad."""
        if self.linear:
            return float(self.x[6]), float(self.x[7]), float(self.x[8])
        euler: tuple[float, float, float] = to_euler(tuple(self.quat.tolist()))
        return euler

    def velocity_ned(self) -> tuple[float, float, float]:
        """Velocity north, east, down, m/s."""
        north, east, down = self.velocity.tolist()
        return north, east, down

    def position_ned(self) -> tuple[float, float, float]:
        """Position north, east, down of where it started, m."""
        north, east, down = self.x[:3].tolist()
        return north, east, down
