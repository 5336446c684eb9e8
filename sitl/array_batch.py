"""A batch on numpy arrays: what `sitl.batch` flies where nothing is compiled yet and the job is small."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sitl.actuators import ACHIEVED, FLT_EPSILON
from sitl.array_form import array_form
from sitl.compiled import Record
from sitl.filters import biquad_step
from sitl.roll_loop import LOST_RAD, RollTorque, gravity_excess, roll_law

if TYPE_CHECKING:
    from sitl.batch import RollJob

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

ARRAY_WIDTH = 1024
"""Pairs of a gain set and a sample flown side by side."""


def fly_arrays(
    s: Record,
    gains: FloatArray,
    matrices: FloatArray,
    job: RollJob,
    torque_of: RollTorque,
    out: FloatArray,
    lost: BoolArray,
) -> None:
    """`fly_lanes` with numpy: the order of things is the same, the laws are the same lines.

    Args:
        s: of CONTROL_SETTINGS. gains: (6, n). matrices: (4, 6, n). job: what is flown. torque_of: of the motors.
        out: (3, T, n) output: phi, p, delta_lat. lost: (n,) output.
    """
    law, excess, biquad_of = array_form(roll_law), array_form(gravity_excess), array_form(biquad_step)
    phi_out, p_out, delta_out = out
    n = out.shape[2]
    x = np.zeros((4, n))
    y, accel, delay0, delay1, integral, rate_sp = (np.zeros(n) for _ in range(6))
    notch = np.zeros((2, 2, n))
    positive = negative = np.zeros(n, dtype=bool)
    table = np.linspace(-torque_of.most, torque_of.most, len(torque_of.given)) if not torque_of.clips else None
    whole = int(s["attitude_late_ticks"])
    part = float(s["attitude_late_ticks"]) - whole
    fixed = (
        *(float(c) for c in s["low_pass"]), float(s["dgyro_alpha"]), float(s["dt_s"]),
        gains[0], float(s["rate_max"][0]), *gains[1:], float(s["int_lim"][0]),
        bool(s["linear"]), bool(s["rate_sp_late"]),
    )  # fmt: skip
    level = np.zeros(n)
    for t, wanted in enumerate(job.phi_sp_rad.tolist()):
        phi_out[t], p_out[t] = x[2], x[1]
        seen = phi_out[t - whole] if t >= whole else level
        if part:
            seen = (1.0 - part) * seen + part * (phi_out[t - whole - 1] if t > whole else level)
        measured = x[1]
        for i in range(int(s["notch_count"])):
            measured, w = biquad_of(*s["notches"][i], notch[i, 0], notch[i, 1], measured)
            notch[i, 1], notch[i, 0] = notch[i, 0], w
        torque, y, accel, w, integral, rate_sp = law(
            measured, seen, wanted, y, accel, delay0, delay1, integral, rate_sp, positive, negative, *fixed
        )
        delay1, delay0 = delay0, w
        if table is None:
            given = np.clip(torque, -torque_of.limit, torque_of.limit)
            delta_out[t] = given
        else:
            given = np.interp(torque, table, torque_of.given)
            delta_out[t] = np.interp(torque, table, torque_of.delta)
        if s["limits"] and (t + 1) % int(s["status_ticks"]) == 0:
            missing = torque - given
            wanting = missing * missing >= ACHIEVED
            positive, negative = wanting & (missing > FLT_EPSILON), wanting & (missing < -FLT_EPSILON)
        u = delta_out[t - job.delay_ticks] if t >= job.delay_ticks else level
        e = level if s["linear"] else excess(x[2])
        moved = np.einsum("ikn,kn->in", matrices, np.stack([*x, u, e]))
        lost |= ~(np.abs(moved[2]) <= LOST_RAD)
        x = np.where(lost, x, moved)
