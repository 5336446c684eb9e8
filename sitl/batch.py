"""Gain sets x samples x ticks of the roll axis in one call, with the laws that fly live (`roll_loop`).

A block of samples is flown side by side in compiled lanes, which the machine's vector unit takes several at a time.
Where nothing is compiled yet and the job is small, the same laws run on arrays instead (`array_form`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sitl.actuators import ACHIEVED, FLT_EPSILON
from sitl.airframe import DERIVATIVE_NAMES
from sitl.array_batch import ARRAY_WIDTH, fly_arrays
from sitl.compiled import Record, compiled, is_compiled, select
from sitl.errors import UsageError
from sitl.filters import biquad_step, constrain
from sitl.roll_loop import LOST_RAD, RollTorque, gravity_excess, lateral_row, roll_law, roll_torque, step_matrices

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IndexArray = npt.NDArray[np.intp]

GAINS = ("att_gain", "k", "kp", "ki", "kd", "kff")
"""Fields of CONTROL_SETTINGS that each lane has its own value of; those of the roll axis."""

LANES = 32
"""Pairs of a gain set and a sample flown side by side: enough for the vector unit, few enough to stay in the cache."""

COMPILE_STEPS = 8_000_000
"""Steps that numpy flies in the time that compiling takes: a smaller job on a cold machine is not compiled."""


# Rows of what a lane remembers: plant, gyro filter and its slope, laws, saturation, notches.
_V, _P, _PHI, _M, _FLIES, _PHI_BEFORE, _SEEN, _MEASURED = range(8)
_Y, _ACCEL, _DELAY0, _DELAY1, _INTEGRAL, _RATE_SP, _TORQUE, _GIVEN, _POSITIVE, _NEGATIVE = range(8, 18)
_NOTCH = 18
_ROWS = _NOTCH + 4


@dataclass(frozen=True)
class RollJob:
    """What a batch flies: one manoeuvre, from level flight, on every sample with every gain set.

    Attributes:
        settings: (G,) of CONTROL_SETTINGS, one per gain set, all at one rate.
        derivatives: (S, 6) in the order of DERIVATIVE_NAMES.
        motor_lag_s: first-order lag of the motors; 0 for none.
        delay_ticks: whole ticks between a command and its motor.
        hover_thrust: collective command, 0..1.
        phi_sp_rad: (T,) roll set-point of every tick.
    """

    settings: npt.NDArray[np.void]
    derivatives: FloatArray
    motor_lag_s: float
    delay_ticks: int
    hover_thrust: float
    phi_sp_rad: FloatArray

    def __post_init__(self) -> None:
        """Raise UsageError for shapes and numbers that cannot be flown."""
        shape = self.derivatives.shape
        if len(shape) != 2 or shape[1] != len(DERIVATIVE_NAMES) or not shape[0]:
            raise UsageError(f"samples of derivatives: shape {shape}, want (samples, {len(DERIVATIVE_NAMES)})")
        if not np.isfinite(self.derivatives).all():
            row = int(np.flatnonzero(~np.isfinite(self.derivatives).all(axis=1))[0])
            raise UsageError(f"sample {row} of the derivatives is not finite: {self.derivatives[row].tolist()}")
        if self.phi_sp_rad.ndim != 1 or not len(self.phi_sp_rad) or not np.isfinite(self.phi_sp_rad).all():
            raise UsageError(f"set-points: shape {self.phi_sp_rad.shape}, want one finite number per tick")
        if not (math.isfinite(self.motor_lag_s) and self.motor_lag_s >= 0.0 and self.delay_ticks >= 0):
            raise UsageError(f"motor lag {self.motor_lag_s} s, delay {self.delay_ticks} ticks: give 0 or more")

    @property
    def steps(self) -> int:
        """Vehicle-steps of the whole job."""
        return len(self.settings) * len(self.derivatives) * len(self.phi_sp_rad)


@dataclass(frozen=True)
class Block:
    """What some pairs of a gain set and a sample flew.

    Attributes:
        gain_set, sample: (n,) number of each.
        flown: (3, T, lanes) of phi_rad, p_rad_s and delta_lat; lanes beyond the first n are nobody's.
        lost: (n,) the roll angle passed 80 degrees; the rest of that sample is frozen.
    """

    gain_set: IndexArray
    sample: IndexArray
    flown: FloatArray
    lost: BoolArray

    @property
    def phi_rad(self) -> FloatArray:
        """(T, n) rad at every tick, before the tick's motion."""
        return self.flown[0, :, : len(self.sample)]

    @property
    def p_rad_s(self) -> FloatArray:
        """(T, n) rad/s, likewise."""
        return self.flown[1, :, : len(self.sample)]

    @property
    def delta_lat(self) -> FloatArray:
        """(T, n) torque of the tick's commands."""
        return self.flown[2, :, : len(self.sample)]


@compiled
def fly_lanes(
    settings_array: npt.NDArray[np.void],
    gains: FloatArray,
    matrices: FloatArray,
    phi_sp: FloatArray,
    delay_ticks: int,
    limit: float,
    clips: bool,
    most: float,
    given_table: FloatArray,
    delta_table: FloatArray,
    out: FloatArray,
    lost: BoolArray,
) -> None:
    """Fly LANES pairs of a gain set and a sample.

    Args:
        settings_array: (1,) of CONTROL_SETTINGS: all but the gains. gains: (6, LANES) in the order of GAINS.
        matrices: (4, 6, LANES) of `step_matrices`, lanes last.
        phi_sp: (T,). delay_ticks, limit, clips, most, given_table, delta_table: see `RollJob`, `RollTorque`.
        out: (3, T, LANES) output: phi, p, delta_lat. lost: (LANES,) output.
    """
    s: Record = settings_array[0]
    b0, b1, b2, a1, a2 = s.low_pass[0], s.low_pass[1], s.low_pass[2], s.low_pass[3], s.low_pass[4]
    alpha, dt_s, linear, late = s.dgyro_alpha, s.dt_s, s.linear, s.rate_sp_late
    rate_max, int_lim = s.rate_max[0], s.int_lim[0]
    whole = int(s.attitude_late_ticks)
    part = s.attitude_late_ticks - whole
    limits, status_ticks, notches = s.limits, s.status_ticks, s.notch_count
    # one array for everything a lane remembers: the compiler then sees by itself that its rows do not overlap
    x = np.zeros((_ROWS, LANES))
    for j in range(LANES):
        x[_FLIES, j] = 1.0
    steps_per_unit = (len(given_table) - 1) / (2.0 * most) if not clips else 0.0
    for t in range(len(phi_sp)):
        wanted_phi = phi_sp[t]
        now, before = t - whole, t - whole - 1
        for j in range(LANES):
            out[0, t, j] = x[_PHI, j]
            out[1, t, j] = x[_P, j]
            x[_MEASURED, j] = x[_P, j]
        if whole == 0:
            for j in range(LANES):
                x[_SEEN, j] = (1.0 - part) * x[_PHI, j] + part * x[_PHI_BEFORE, j]
                x[_PHI_BEFORE, j] = x[_PHI, j]
        else:
            for j in range(LANES):
                x[_SEEN, j] = (1.0 - part) * (out[0, now, j] if now >= 0 else 0.0) + part * (
                    out[0, before, j] if before >= 0 else 0.0
                )
        for i in range(notches):
            n = s.notches[i]
            n0, n1, n2, n3, n4 = n[0], n[1], n[2], n[3], n[4]
            first, second = _NOTCH + 2 * i, _NOTCH + 2 * i + 1
            for j in range(LANES):
                sample, w = biquad_step(n0, n1, n2, n3, n4, x[first, j], x[second, j], x[_MEASURED, j])
                x[_MEASURED, j] = sample
                x[second, j] = x[first, j]
                x[first, j] = w
        for j in range(LANES):
            torque, y, accel, w, integral, rate_sp = roll_law(
                x[_MEASURED, j], x[_SEEN, j], wanted_phi,
                x[_Y, j], x[_ACCEL, j], x[_DELAY0, j], x[_DELAY1, j], x[_INTEGRAL, j], x[_RATE_SP, j],
                x[_POSITIVE, j] != 0.0, x[_NEGATIVE, j] != 0.0,
                b0, b1, b2, a1, a2, alpha, dt_s,
                gains[0, j], rate_max, gains[1, j], gains[2, j], gains[3, j], gains[4, j], gains[5, j], int_lim,
                linear, late,
            )  # fmt: skip
            x[_TORQUE, j] = torque
            x[_Y, j] = y
            x[_ACCEL, j] = accel
            x[_DELAY1, j] = x[_DELAY0, j]
            x[_DELAY0, j] = w
            x[_INTEGRAL, j] = integral
            x[_RATE_SP, j] = rate_sp
        if clips:
            for j in range(LANES):
                given = constrain(x[_TORQUE, j], -limit, limit)
                x[_GIVEN, j] = given
                out[2, t, j] = given
        else:
            for j in range(LANES):
                place = (constrain(x[_TORQUE, j], -most, most) + most) * steps_per_unit
                at = min(int(place), len(given_table) - 2)
                share = place - at
                x[_GIVEN, j] = given_table[at] + share * (given_table[at + 1] - given_table[at])
                out[2, t, j] = delta_table[at] + share * (delta_table[at + 1] - delta_table[at])
        if limits and (t + 1) % status_ticks == 0:
            for j in range(LANES):
                missing = x[_TORQUE, j] - x[_GIVEN, j]
                wanting = select(missing * missing < ACHIEVED, 0.0, 1.0)
                x[_POSITIVE, j] = select(missing > FLT_EPSILON, wanting, 0.0)
                x[_NEGATIVE, j] = select(missing < -FLT_EPSILON, wanting, 0.0)
        acting = t - delay_ticks
        for j in range(LANES):
            u = out[2, acting, j] if acting >= 0 else 0.0
            v, p, phi, m = x[_V, j], x[_P, j], x[_PHI, j], x[_M, j]
            e = select(linear, 0.0, gravity_excess(phi))
            v1 = lateral_row(matrices[0, 0, j], matrices[0, 1, j], matrices[0, 2, j], matrices[0, 3, j],
                             matrices[0, 4, j], matrices[0, 5, j], v, p, phi, m, u, e)  # fmt: skip
            p1 = lateral_row(matrices[1, 0, j], matrices[1, 1, j], matrices[1, 2, j], matrices[1, 3, j],
                             matrices[1, 4, j], matrices[1, 5, j], v, p, phi, m, u, e)  # fmt: skip
            phi1 = lateral_row(matrices[2, 0, j], matrices[2, 1, j], matrices[2, 2, j], matrices[2, 3, j],
                               matrices[2, 4, j], matrices[2, 5, j], v, p, phi, m, u, e)  # fmt: skip
            m1 = lateral_row(matrices[3, 0, j], matrices[3, 1, j], matrices[3, 2, j], matrices[3, 3, j],
                             matrices[3, 4, j], matrices[3, 5, j], v, p, phi, m, u, e)  # fmt: skip
            # a motion that is no number any more is lost too: it is not within
            flies = select(abs(phi1) <= LOST_RAD, x[_FLIES, j], 0.0)
            x[_FLIES, j] = flies
            x[_V, j] = select(flies != 0.0, v1, v)
            x[_P, j] = select(flies != 0.0, p1, p)
            x[_PHI, j] = select(flies != 0.0, phi1, phi)
            x[_M, j] = select(flies != 0.0, m1, m)
    for j in range(LANES):
        lost[j] = x[_FLIES, j] == 0.0


class Batch:
    """A job, prepared: `blocks` may be flown in any order and by several threads at once.

    Args:
        job: what is flown.
        compiled: True or False to choose how; None lets the size of the job and the machine decide.
        matrices: of `step_matrices` for the job's samples, where they are known already.

    Raises:
        UsageError: a gain set's settings have what the batch cannot fly.
    """

    def __init__(self, job: RollJob, compiled: bool | None = None, matrices: FloatArray | None = None) -> None:
        self.job = job
        self.compiled = is_compiled(fly_lanes) or job.steps > COMPILE_STEPS if compiled is None else compiled
        if matrices is None:
            matrices = step_matrices(job.derivatives, job.motor_lag_s, float(job.settings["dt_s"][0]))
        self.matrices = matrices
        self._by_sample = np.ascontiguousarray(np.moveaxis(matrices, 0, 2))
        self._gains = np.stack(
            [job.settings[name][:, 0] if job.settings[name].ndim > 1 else job.settings[name] for name in GAINS]
        )
        self.blocks: list[tuple[int, IndexArray, IndexArray]] = []
        self._torques: dict[int, RollTorque] = {}
        width = LANES if self.compiled else ARRAY_WIDTH
        samples = len(job.derivatives)
        for members in _alike(job.settings):
            first = int(members[0])
            self._torques[first] = roll_torque(job.settings[first], job.hover_thrust)
            for at in range(0, len(members) * samples, width):
                pairs = np.arange(at, min(at + width, len(members) * samples))
                self.blocks.append((first, members[pairs // samples], pairs % samples))

    @property
    def room(self) -> tuple[int, int, int]:
        """Shape of the array that the largest block flies into."""
        most = max(len(sample) for _, _, sample in self.blocks)
        return 3, len(self.job.phi_sp_rad), LANES if self.compiled else most

    def fly(self, number: int, room: FloatArray | None = None) -> Block:
        """Fly one of `blocks`.

        Args:
            number: of the block.
            room: of the shape `room`, to fly into; the block is then good until the next one flies into it. Fresh
                memory for every block costs as much as half of the flying.
        """
        job = self.job
        first, gain_set, sample = self.blocks[number]
        torque, count = self._torques[first], len(sample)
        width = LANES if self.compiled else count
        sets, samples = gain_set, sample
        if count < width:
            # the last block is filled up with its own last pair
            lanes = np.minimum(np.arange(width), count - 1)
            sets, samples = gain_set[lanes], sample[lanes]
        matrices, gains = self._by_sample.take(samples, axis=2), self._gains.take(sets, axis=1)
        shape = 3, len(job.phi_sp_rad), width
        out = np.empty(shape) if room is None or room.shape != shape else room
        lost = np.zeros(width, dtype=bool)
        settings = job.settings[first : first + 1]
        if self.compiled:
            fly_lanes(
                settings, gains, matrices, job.phi_sp_rad, job.delay_ticks, torque.limit, torque.clips, torque.most,
                torque.given, torque.delta, out, lost,
            )  # fmt: skip
        else:
            fly_arrays(settings[0], gains, matrices, job, torque, out, lost)
        return Block(gain_set, sample, out, lost[:count])


def _alike(settings: npt.NDArray[np.void]) -> list[IndexArray]:
    """Numbers of the gain sets that differ in their roll gains alone."""
    # into zeros: what lies between the fields of a record is not ours
    rest = np.zeros(len(settings), settings.dtype)
    for name in settings.dtype.names or ():
        if name not in GAINS:
            rest[name] = settings[name]
    groups: dict[bytes, list[int]] = {}
    for number, row in enumerate(rest):
        groups.setdefault(row.tobytes(), []).append(number)
    return [np.array(members) for members in groups.values()]
