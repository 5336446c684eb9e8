"""From torque set-points to motors and back: PX4's normalised mix, its desaturation, and the mix's inverse.

Source: PX4 ``lib/control_allocation`` and ``control_allocator``; the inverse is the pseudo-inverse of the normalised
mix, so that delta_lat is exactly the roll torque set-point while nothing saturates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.compiled import compiled

MAX_MOTORS = 12
ROLL, PITCH, YAW, THRUST = 0, 1, 2, 3

_WEAK_ROW = 0.05
"""An axis whose every effectiveness entry is this small counts as uncontrollable."""
_WEAK_ENTRY = 1e-3
_WEAK_DESATURATION = 0.2
_YAW_MARGIN = 0.15
ACHIEVED = 1e-6
"""Squared torque that may be missing before an axis counts as saturated."""
FLT_EPSILON = 1.1920929e-07


@dataclass(frozen=True)
class RotorEffect:
    """What the allocator knows of a rotor (CA_ROTORn_*).

    Attributes:
        position_m: (x, y, z) from the centre of mass, body FRD, m.
        axis: thrust direction, body FRD, any length (normalised here).
        ct: thrust coefficient.
        km: moment ratio; positive for a propeller turning counter-clockwise.
    """

    position_m: tuple[float, float, float]
    axis: tuple[float, float, float] = (0.0, 0.0, -1.0)
    ct: float = 6.5
    km: float = 0.05


@dataclass(frozen=True)
class Mix:
    """Normalised mix of one rotor geometry.

    Attributes:
        columns: (n, 4) motor command per unit of roll, pitch, yaw torque and (upward) thrust set-point.
        inverse: (4, n) roll, pitch, yaw torque and thrust per unit of motor command.
    """

    columns: NDArray[np.float64]
    inverse: NDArray[np.float64]

    @property
    def motors(self) -> int:
        """Number of motors."""
        return int(self.columns.shape[0])


def effectiveness(rotors: Sequence[RotorEffect]) -> NDArray[np.float64]:
    """Torque and force per unit of motor command.

    Args:
        rotors: n rotors in motor order.

    Returns:
        (6, n): roll, pitch, yaw torque, then force along x, y, z (body FRD); rows too weak to use are zero.
    """
    matrix = np.zeros((6, len(rotors)))
    for i, rotor in enumerate(rotors):
        axis = np.asarray(rotor.axis, dtype=float)
        if not np.isfinite([*rotor.position_m, *axis, rotor.ct, rotor.km]).all():
            matrix[:, i] = math.nan
            continue
        length = float(np.linalg.norm(axis))
        if length > 0.0:
            axis = axis / length
        matrix[:3, i] = rotor.ct * np.cross(rotor.position_m, axis) - rotor.ct * rotor.km * axis
        matrix[3:, i] = rotor.ct * axis
    matrix[np.max(np.abs(matrix), axis=1, initial=0.0) <= _WEAK_ROW] = 0.0
    return matrix


def normalised_mix(rotors: Sequence[RotorEffect]) -> Mix:
    """PX4's mix for a multirotor, with roll, pitch, yaw and thrust normalised.

    Roll and pitch share one scale (the larger), so that a frame longer than wide keeps the same torque per unit in
    both; yaw is scaled by its largest entry, thrust by its mean.

    Args:
        rotors: n rotors in motor order, 0 <= n <= 12.

    Returns:
        the mix and its pseudo-inverse; that of no rotors if a number of the geometry is not finite (PX4 would send
        NaN to every motor, which stops them).
    """
    effect = effectiveness(rotors)
    if not np.isfinite(effect).all():
        return normalised_mix([])
    mix = np.linalg.pinv(effect)
    n = len(rotors)

    def column_scale(column: NDArray[np.floating]) -> float:
        used = int(np.count_nonzero(np.abs(column) > _WEAK_ENTRY))
        return math.sqrt(float(column @ column) / (used / 2.0)) if used else 1.0

    tilt = max(column_scale(mix[:, ROLL]), column_scale(mix[:, PITCH]))
    yaw = float(np.max(mix[:, YAW])) if n else 0.0
    vertical = mix[:, 5]
    lifting = np.abs(vertical) > FLT_EPSILON
    thrust = float(np.mean(np.abs(vertical[lifting]))) if lifting.any() else 1.0
    columns = np.column_stack(
        [
            mix[:, ROLL] / tilt,
            mix[:, PITCH] / tilt,
            mix[:, YAW] / yaw if yaw > FLT_EPSILON else np.zeros(n),
            -vertical / thrust,
        ]
    )
    columns[np.abs(columns) < _WEAK_ENTRY] = 0.0
    return Mix(columns=columns, inverse=np.linalg.pinv(columns))


@compiled
def _desaturation_gain(
    mix: NDArray[np.float64], axis: int, sign: float, motors: NDArray[np.float64], n: int, top: float
) -> float:
    low = 0.0
    high = 0.0
    for i in range(n):
        v = sign * mix[i, axis]
        if abs(v) < _WEAK_DESATURATION:
            continue
        if motors[i] < 0.0:
            gain = -motors[i] / v
        elif motors[i] > top:
            gain = (top - motors[i]) / v
        else:
            continue
        low = min(low, gain)
        high = max(high, gain)
    return low + high


@compiled
def _desaturate(
    mix: NDArray[np.float64],
    axis: int,
    sign: float,
    motors: NDArray[np.float64],
    n: int,
    top: float,
    increase_only: bool,
) -> None:
    gain = _desaturation_gain(mix, axis, sign, motors, n, top)
    if increase_only and gain < 0.0:
        return
    for i in range(n):
        motors[i] += gain * sign * mix[i, axis]
    gain = 0.5 * _desaturation_gain(mix, axis, sign, motors, n, top)
    for i in range(n):
        motors[i] += gain * sign * mix[i, axis]


@compiled
def allocate(
    mix: NDArray[np.float64],
    n: int,
    torque: NDArray[np.float64],
    thrust: float,
    method: int,
    airmode: int,
    motors: NDArray[np.float64],
) -> None:
    """Motor commands for torque and thrust set-points, before slew limit and clipping.

    PX4's sequential desaturation: thrust gives way before roll, roll before pitch, pitch before yaw. The thrust
    column of PX4 points down, hence the sign -1 here and "increase only" meaning that thrust may only fall.

    Args:
        mix: (>=n, 4) normalised mix. n: number of motors.
        torque: (3,) roll, pitch, yaw set-points. thrust: upward thrust set-point, 0..1.
        method: CA_METHOD: 0 plain pseudo-inverse, 1 or 2 sequential desaturation.
        airmode: MC_AIRMODE: 0 off, 1 roll and pitch, 2 all axes.
        motors: (>=n,) output, fraction of full thrust.
    """
    for i in range(n):
        motors[i] = mix[i, ROLL] * torque[0] + mix[i, PITCH] * torque[1] + mix[i, THRUST] * thrust
        if method == 0 or airmode == 2:
            motors[i] += mix[i, YAW] * torque[2]
    if method == 0:
        return
    if airmode == 2:
        _desaturate(mix, THRUST, -1.0, motors, n, 1.0, False)
        _desaturate(mix, YAW, 1.0, motors, n, 1.0, False)
        return
    _desaturate(mix, THRUST, -1.0, motors, n, 1.0, airmode == 0)
    if airmode == 0:
        _desaturate(mix, ROLL, 1.0, motors, n, 1.0, False)
        _desaturate(mix, PITCH, 1.0, motors, n, 1.0, False)
    for i in range(n):
        motors[i] += mix[i, YAW] * torque[2]
    _desaturate(mix, YAW, 1.0, motors, n, 1.0 + _YAW_MARGIN, False)
    _desaturate(mix, THRUST, -1.0, motors, n, 1.0, True)


@compiled
def saturation(
    inverse: NDArray[np.float64],
    n: int,
    torque: NDArray[np.float64],
    motors: NDArray[np.float64],
    positive: NDArray[np.uint8],
    negative: NDArray[np.uint8],
) -> None:
    """One-sided saturation flags per axis, as the allocator's status reports them.

    Args:
        inverse: (4, >=n) inverse mix. n: number of motors.
        torque: (3,) set-points. motors: (>=n,) final commands.
        positive: (3,) output: more positive torque was asked than given. negative: (3,) the same the other way.
    """
    missing = np.empty(3)
    for axis in range(3):
        given = 0.0
        for i in range(n):
            given += inverse[axis, i] * motors[i]
        missing[axis] = torque[axis] - given
    achieved = missing[0] ** 2 + missing[1] ** 2 + missing[2] ** 2 < ACHIEVED
    for axis in range(3):
        positive[axis] = 1 if not achieved and missing[axis] > FLT_EPSILON else 0
        negative[axis] = 1 if not achieved and missing[axis] < -FLT_EPSILON else 0


@compiled
def motor_output(command: float, thr_mdl_fac: float) -> float:
    """Signal that makes a motor of curve f s^2 + (1 - f) s give the commanded thrust (THR_MDL_FAC)."""
    if 0.0 < thr_mdl_fac <= 1.0 and command > 0.0:
        half = (1.0 - thr_mdl_fac) / (2.0 * thr_mdl_fac)
        return -half + math.sqrt(half * half + command / thr_mdl_fac)
    return command
