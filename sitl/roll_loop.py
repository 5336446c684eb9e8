"""The roll axis alone, one tick at a time: set-point, laws, actuators, lateral plant; the other axes stay level.

The laws are those that fly live on three axes (`filters`, `rate_control`), in the order of `control_loop`. What is
particular to one axis is here: the attitude law of a rotation about the roll axis, the roll torque that the motors
give (`RollTorque`), and the exact step of the lateral plant between two ticks. Every function runs compiled in lanes
and, by `array_form`, on arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from sitl.actuators import MAX_MOTORS, ROLL, allocate, motor_output
from sitl.array_form import plain_form
from sitl.compiled import compiled, inlined, is_compiled, select
from sitl.errors import UsageError
from sitl.filters import biquad_step, constrain, slope_step
from sitl.lateral import G_M_S2
from sitl.rate_control import rate_control

FloatArray = npt.NDArray[np.float64]

LOST_RAD = math.radians(80.0)
"""Beyond this roll angle it is no flight any more: the sample is frozen and counts as diverged."""

_PROBES, _TABLE = 161, 4001
_TAYLOR = 15
_MOST_TORQUE = 4.0
"""Torque set-points up to which the mix is probed: far beyond, nothing new happens."""


_SINE = tuple((-1.0) ** n / math.factorial(2 * n + 1) for n in range(10))


@compiled
def sine(angle: float) -> float:
    """Sine by its series, to 1e-13 up to 100 degrees: unlike the library's it runs in lanes.

    Args:
        angle: rad, within +-1.75.
    """
    s = angle * angle
    high = _SINE[5] + s * (_SINE[6] + s * (_SINE[7] + s * (_SINE[8] + s * _SINE[9])))
    low = _SINE[1] + s * (_SINE[2] + s * (_SINE[3] + s * (_SINE[4] + s * high)))
    return angle * (_SINE[0] + s * low)


@compiled
def roll_attitude_control(phi: float, phi_sp: float, k_phi: float, rate_max: float, linear: bool) -> float:
    """Roll-rate set-point, rad/s: what `attitude_control` gives when both attitudes are rolls about one axis.

    Args:
        phi: roll angle, rad. phi_sp: its set-point, rad.
        k_phi: MC_ROLL_P, 1/s. rate_max: MC_ROLLRATE_MAX, rad/s.
        linear: the study's K_phi (phi_sp - phi) instead, without limit.
    """
    error = phi_sp - phi
    limited = constrain(k_phi * 2.0 * sine(0.5 * error), -rate_max, rate_max)
    return select(linear, k_phi * error, limited)


@inlined
def roll_law(
    p: float, phi: float, phi_sp: float,
    y: float, accel: float, delay0: float, delay1: float, integral: float, rate_sp: float,
    positive: bool, negative: bool,
    b0: float, b1: float, b2: float, a1: float, a2: float, alpha: float, dt_s: float,
    k_phi: float, rate_max: float, k: float, kp: float, ki: float, kd: float, kff: float, int_lim: float,
    linear: bool, late: bool,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """One tick of gyro filter, attitude law and rate law about the roll axis, in the order of `control_loop`.

    Args:
        p: measured roll rate, rad/s. phi: roll angle as late as the estimate has it. phi_sp: its set-point, rad.
        y, accel: filtered rate and its slope of the tick before. delay0, delay1: the filter's memory.
        integral, rate_sp: of the tick before. positive, negative: saturation flags of the allocator.
        b0 to a2: gyro low pass. alpha: of the D filter. dt_s: tick, s.
        k_phi, rate_max, k, kp, ki, kd, kff, int_lim: gains and limits as in CONTROL_SETTINGS.
        linear: the study's attitude law. late: the rate law uses the rate set-point of the tick before.

    Returns:
        (torque set-point, y, accel, delay0, integral, rate_sp) of this tick; delay1 becomes the old delay0.
    """
    wanted = roll_attitude_control(phi, phi_sp, k_phi, rate_max, linear)
    filtered, w = biquad_step(b0, b1, b2, a1, a2, delay0, delay1, p)
    slope = slope_step(accel, filtered, y, alpha, dt_s)
    torque, moved = rate_control(
        filtered, select(late, rate_sp, wanted), slope, integral,
        k, kp, ki, kd, kff, int_lim, positive, negative, False, dt_s,
    )  # fmt: skip
    return torque, filtered, slope, w, moved, wanted


@compiled
def gravity_excess(phi: float) -> float:
    """What the side force of gravity, g sin phi, lacks of the linear model's g phi; m/s^2.

    Args:
        phi: roll angle, rad.
    """
    return G_M_S2 * (sine(phi) - phi)


@compiled
def lateral_row(
    a0: float, a1: float, a2: float, a3: float, b: float, e: float,
    v: float, p: float, phi: float, m: float, u: float, excess: float,
) -> float:  # fmt: skip
    """One state at the next tick: a row of the exact step matrix times (v, p, phi, motors, command, excess)."""
    return a0 * v + a1 * p + a2 * phi + a3 * m + b * u + e * excess


@dataclass(frozen=True)
class RollTorque:
    """Roll torque that the motors give for a set-point, with pitch and yaw level and the thrust of hover.

    A function of the set-point alone, worked out by the very allocation that flies.

    Attributes:
        limit: largest torque that can be had; inf without limits.
        clips: the torque given is the set-point up to the limit and the limit beyond. If not, `given` and `delta`
            hold the function at torques evenly spaced over +-`most`, constant beyond.
        most: half width of the table.
        given: (n,) torque of the motor commands, which the saturation flags see.
        delta: (n,) torque of the motors' thrust, which the plant feels: the same unless THR_MDL_FAC is set.
    """

    limit: float
    clips: bool
    most: float
    given: FloatArray
    delta: FloatArray


def roll_torque(settings: npt.NDArray[np.void], hover_thrust: float) -> RollTorque:
    """The roll torque function of one gain set's settings.

    Args:
        settings: () or (1,) of CONTROL_SETTINGS. hover_thrust: collective command, 0..1.

    Raises:
        UsageError: the settings limit how fast motors change (CA_Rn_SLEW), which has a memory.
    """
    s = settings.reshape(-1)[0]
    n = int(s["motor_count"])
    none = np.zeros(0)
    if not s["limits"]:
        return RollTorque(math.inf, True, 0.0, none, none)
    if np.isfinite(s["slew_per_tick"][:n]).any():
        raise UsageError("CA_Rn_SLEW: the batch has no slew limit of motors; set it to 0, or fly the set instead")
    numbers = (n, int(s["method"]), int(s["airmode"]), float(s["thr_mdl_fac"]), hover_thrust)
    return _worked_out(s["mix"].tobytes(), s["inverse"].tobytes(), *numbers)


@lru_cache(maxsize=64)
def _worked_out(
    mix: bytes, inverse: bytes, n: int, method: int, airmode: int, curve: float, hover_thrust: float
) -> RollTorque:
    """`roll_torque` of a geometry: worked out once, however often its gains change."""
    columns, rows = np.frombuffer(mix).reshape(-1, 4), np.frombuffer(inverse).reshape(4, -1)
    allocation = (columns, rows[ROLL, :n], n, method, airmode, curve, hover_thrust)
    none = np.zeros(0)
    given, delta = _probe(np.linspace(-_MOST_TORQUE, _MOST_TORQUE, _PROBES), *allocation)
    limit = float(given.max())
    clipped = np.clip(np.linspace(-_MOST_TORQUE, _MOST_TORQUE, _PROBES), -limit, limit)
    if np.abs(clipped - delta).max() < 1e-9:
        return RollTorque(limit, True, 0.0, none, none)
    given, delta = _probe(np.linspace(-_MOST_TORQUE, _MOST_TORQUE, _TABLE), *allocation)
    return RollTorque(limit, False, _MOST_TORQUE, given, delta)


def _probe(
    torques: FloatArray,
    mix: FloatArray,
    inverse: FloatArray,
    n: int,
    method: int,
    airmode: int,
    curve: float,
    hover_thrust: float,
) -> tuple[FloatArray, FloatArray]:
    """(given, delta) of `RollTorque` at some torques, by the allocation that flies."""
    ready = is_compiled(allocate)
    motors_for, output_of = (allocate, motor_output) if ready else (plain_form(allocate), plain_form(motor_output))
    mix = mix.copy()  # the compiled allocation knows arrays that may be written to
    given, delta = np.empty(len(torques)), np.empty(len(torques))
    motors, wanted = np.empty(MAX_MOTORS), np.zeros(3)
    for i, torque in enumerate(torques):
        wanted[0] = torque
        motors_for(mix, n, wanted, hover_thrust, method, airmode, motors)
        commands = motors[:n].clip(0.0, 1.0)
        given[i] = inverse @ commands
        delta[i] = given[i] if curve <= 0.0 else inverse @ [output_of(float(c), curve) for c in commands]
    return given, delta


def step_matrices(derivatives: FloatArray, motor_lag_s: float, dt_s: float) -> FloatArray:
    """The lateral plant from tick to tick, exact for a command held over the tick.

    Args:
        derivatives: (S, 6) in the order of DERIVATIVE_NAMES.
        motor_lag_s: first-order lag of the motors, s; 0 for none.
        dt_s: length of a tick, s.

    Returns:
        (S, 4, 6): rows v, p, phi, motor torque; columns the same four, the command, the excess of gravity (held).

    Raises:
        UsageError: a model so unstable that a tick is beyond all numbers.
    """
    count = len(derivatives)
    a = np.zeros((count, 6, 6))
    Yv, Yp, Yd, Lv, Lp, Ld = derivatives.T
    a[:, 0, 0], a[:, 0, 1], a[:, 0, 2], a[:, 0, 5] = Yv, Yp, G_M_S2, 1.0
    a[:, 1, 0], a[:, 1, 1] = Lv, Lp
    a[:, 2, 1] = 1.0
    torque = 3 if motor_lag_s > 0.0 else 4
    a[:, 0, torque], a[:, 1, torque] = Yd, Ld
    if motor_lag_s > 0.0:
        a[:, 3, 3], a[:, 3, 4] = -1.0 / motor_lag_s, 1.0 / motor_lag_s
    with np.errstate(over="ignore", invalid="ignore"):
        made = _exponential(a * dt_s)[:, :4, :]
    wild = ~np.isfinite(made).all(axis=(1, 2))
    if wild.any():
        values = ", ".join(f"{value:.3g}" for value in derivatives[int(np.argmax(wild))])
        raise UsageError(
            f"the derivatives {values} make a model that grows beyond all numbers within a tick of {1e3 * dt_s:g} ms: "
            "no aircraft. Check the lengths of the airframes, or the file's derivatives"
        )
    if motor_lag_s <= 0.0:
        made[:, 3, :] = 0.0
    return made


def _exponential(a: FloatArray) -> FloatArray:
    """Exponentials of a stack of matrices, (S, n, n): Taylor's series of a / 2^k, squared k times.

    With a norm of 1/2 at most, fifteen terms leave less than rounding does; for a stack of small matrices this is
    several times as fast as one general exponential after the other.
    """
    norm = np.abs(a).sum(axis=1).max(axis=1)
    # each matrix by itself: what a sample flies must not depend on its neighbours
    halvings = np.maximum(0, np.ceil(np.log2(np.maximum(2.0 * norm, 1.0)))).astype(int)
    a = a * (0.5**halvings)[:, None, None]
    unit = np.eye(a.shape[-1])
    total = unit + a / _TAYLOR
    for n in range(_TAYLOR - 1, 0, -1):
        total = unit + (a @ total) / n
    for k in range(int(halvings.max(initial=0))):
        rows = halvings > k
        total[rows] = total[rows] @ total[rows]
    return np.asarray(total)
