"""Evaluation of a chunk: its candidates flown on every sample of its case, and one row a point of what came out.

This is all that a worker does. It depends on the plan and the chunk alone: the same rows whoever works it out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from scenarios.analysis import HIGH_IS_GOOD, SHOWN_MARGINS, wilson
from scenarios.batch_flight import WorstOf, metrics_of, setpoint_ticks
from scenarios.limits import STANDING, TITLES, Limit
from scenarios.monte_carlo import draw_samples, margins_of
from scenarios.roll_set import RollSet, roll_set
from scenarios.sweep.plan import Case, Chunk, Plan
from sitl.batch import Batch, RollJob
from sitl.control_loop import CONTROL_SETTINGS
from sitl.errors import FroudeError
from sitl.roll_loop import step_matrices
from sitl.sampled_loop import RollGains

FloatArray = npt.NDArray[np.float64]
Columns = dict[str, npt.NDArray[Any]]

PASS, FAIL, ERROR = "PASS", "FAIL", "ERROR"
STATISTICS = ("nominal", "worst", "median", "best")

GAIN_FIELDS: Mapping[str, tuple[str, str]] = {
    # PX4 parameter: (field of CONTROL_SETTINGS, field of RollGains)
    "MC_ROLL_P": ("att_gain", "k_phi"),
    "MC_ROLLRATE_K": ("k", "k"),
    "MC_ROLLRATE_P": ("kp", "kp"),
    "MC_ROLLRATE_I": ("ki", "ki"),
    "MC_ROLLRATE_D": ("kd", "kd"),
    "MC_ROLLRATE_FF": ("kff", "kff"),
}
"""Parameters whose values are set into ready settings; any other takes the way that a flight's take."""

_MODELS_KEPT = 4
"""Cases whose samples a worker keeps."""


@dataclass(frozen=True)
class Task:
    """What a worker is given.

    Attributes:
        chunk: which. values: (n, D) of its candidates, a column a parameter axis.
    """

    chunk: Chunk
    values: FloatArray


def limits_of(plan: Plan) -> tuple[Limit, ...]:
    """Limits that a sample must keep: the sweep's, and the standing one unless the sweep limits the oscillation."""
    return tuple({limit.metric: limit for limit in (STANDING, *plan.sweep.limits)}.values())


def measured_names(plan: Plan) -> tuple[str, ...]:
    """Metrics that every row sums up, the margins last."""
    margins = SHOWN_MARGINS if plan.sweep.margins != "none" else ()
    return (*metrics_of(plan.sweep.manoeuvres), *margins)


@dataclass(frozen=True)
class _Models:
    """What the points of a case share.

    Attributes:
        derivatives: (S, 6), the nominal first. matrices: (S, 4, 6) of `step_matrices`.
        signals: (T,) rad, of every manoeuvre. lag_s: of the motors.
    """

    derivatives: FloatArray
    matrices: FloatArray
    signals: tuple[FloatArray, ...]
    lag_s: float


class Evaluator:
    """Works chunks of one plan out.

    Args:
        plan: of the sweep. pool, workers: threads to fly in, if any.
    """

    def __init__(self, plan: Plan, pool: ThreadPoolExecutor | None = None, workers: int = 1) -> None:
        self.plan = plan
        self._pool, self._workers = pool, workers
        self._models: dict[int, _Models] = {}

    def rows(self, task: Task) -> Columns:
        """The rows of a chunk.

        Args:
            task: chunk and values.

        Returns:
            column -> (n,) array, without the columns of the axes; NaN is UNSET. A point that fails is a row with the
            outcome ERROR and the reason.
        """
        try:
            return self._rows(task)
        except (FroudeError, ArithmeticError, ValueError) as error:
            if len(task.values) == 1:
                return failed(self.plan, 1, str(error))
        # one point spoils what is flown together: each by itself, then
        chunk = task.chunk
        rows = [
            self.rows(Task(Chunk(chunk.number, chunk.case, chunk.start + k, chunk.start + k + 1), row[None, :]))
            for k, row in enumerate(task.values)
        ]
        return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}

    def _rows(self, task: Task) -> Columns:
        plan, case, models = self.plan, self.plan.cases[task.chunk.case], self._of_case(task.chunk.case)
        settings, sets = _settings(plan, case, task.values)
        worst = WorstOf(len(settings), len(models.derivatives))
        for manoeuvre, signal in zip(plan.sweep.manoeuvres, models.signals, strict=True):
            job = RollJob(
                settings,
                models.derivatives,
                models.lag_s,
                case.profile.transport_delay_ticks,
                case.model.assumptions.hover_thrust,
                signal,
            )
            # compiled even where arrays would be quicker on a cold machine: their last bits differ
            batch = Batch(job, True, models.matrices)
            worst.fly(batch, manoeuvre, case.profile.dt_s, self._pool, self._workers)
        values = worst.metrics()
        unstable = None
        if plan.sweep.margins != "none":
            of = models.derivatives if plan.sweep.margins == "samples" else models.derivatives[:1]
            margins = margins_of(of, sets, models.lag_s)
            values |= {name: getattr(margins, name) for name in SHOWN_MARGINS}
            unstable = ~margins.closed_loop_stable
            # of an unstable loop its distance from -1 means nothing
            values["modulus_margin"] = np.where(unstable, math.nan, margins.modulus_margin)
        return _summary(plan, values, worst.diverged, unstable)

    def _of_case(self, number: int) -> _Models:
        if number not in self._models:
            while len(self._models) >= _MODELS_KEPT:
                self._models.pop(next(iter(self._models)))
            sweep, case = self.plan.sweep, self.plan.cases[number]
            drawn = draw_samples(case.model, sweep.samples, sweep.seed, sweep.distribution, sweep.spread_sigma)
            lag_s = case.profile.motor_lag(case.model.assumptions.motor_lag_s)
            signals = tuple(setpoint_ticks(m, case.profile, sweep.setpoint_rate_hz) for m in sweep.manoeuvres)
            matrices = step_matrices(drawn, lag_s, case.profile.dt_s)
            self._models[number] = _Models(drawn, matrices, signals, lag_s)
        return self._models[number]


def failed(plan: Plan, count: int, reason: str) -> Columns:
    """Rows of points that could not be judged.

    Args:
        plan: of the sweep. count: how many rows. reason: of all of them.
    """
    columns: Columns = _counts(count)
    columns["outcome"] = np.full(count, ERROR, dtype=object)
    columns["reason"] = np.full(count, reason, dtype=object)
    columns["pass_pct"] = columns["pass_low_pct"] = columns["pass_high_pct"] = np.full(count, math.nan)
    for limit in limits_of(plan):
        columns[f"failing_{limit.metric}"] = np.zeros(count, dtype=np.int32)
    for name in measured_names(plan):
        columns |= {f"{name}_{statistic}": np.full(count, math.nan) for statistic in STATISTICS}
        columns[f"{name}_unset"] = np.zeros(count, dtype=np.int32)
    return columns


def _counts(count: int) -> Columns:
    names = ("passes", "samples", "unstable", "cycling", "diverged")
    return {name: np.zeros(count, dtype=np.int32) for name in names} | {"nominal_passes": np.zeros(count, dtype=bool)}


def _settings(plan: Plan, case: Case, values: FloatArray) -> tuple[npt.NDArray[np.void], list[RollSet]]:
    """Settings of every candidate; those that differ in roll gains alone are worked out once."""
    axes = plan.sweep.parameters
    gains = [(k, axis.name) for k, axis in enumerate(axes) if axis.name in GAIN_FIELDS]
    others = [(k, axis) for k, axis in enumerate(axes) if axis.name not in GAIN_FIELDS]
    settings = np.zeros(len(values), CONTROL_SETTINGS)
    made: dict[tuple[float, ...], RollSet] = {}
    sets: list[RollSet] = []
    for row in values.tolist():
        key = tuple(row[k] for k, _ in others)
        base = made.get(key)
        if base is None:
            own = {axis.name: int(row[k]) if axis.integer else row[k] for k, axis in others}
            base = made[key] = roll_set(case.model, case.profile, {**plan.sweep.fixed, **own})
        sets.append(base)
    for number, base in enumerate(sets):
        settings[number] = base.settings
    for k, name in gains:
        settings[GAIN_FIELDS[name][0]][:, 0] = values[:, k]
    names = {name: GAIN_FIELDS[name][1] for _, name in gains}
    if plan.sweep.margins != "none":
        sets = [
            RollSet(base.settings, _gains(base.gains, {names[name]: row[k] for k, name in gains}), base.profile)
            for base, row in zip(sets, values.tolist(), strict=True)
        ]
    return settings, sets


def _gains(base: RollGains, changed: Mapping[str, float]) -> RollGains:
    return RollGains(**{field.name: changed.get(field.name, getattr(base, field.name)) for field in fields(RollGains)})


def _summary(
    plan: Plan,
    values: Mapping[str, FloatArray],
    diverged: npt.NDArray[np.bool_],
    unstable: npt.NDArray[np.bool_] | None,
) -> Columns:
    count, samples = diverged.shape
    drawn = slice(1, None) if samples > 1 else slice(None)
    of = samples - drawn.indices(samples)[0]
    columns: Columns = _counts(count)
    good = ~diverged
    failing: dict[str, npt.NDArray[np.int32]] = {}
    for limit in limits_of(plan):
        value = values.get(limit.metric)
        holds = _holds(limit, value) if value is not None else np.zeros((count, 1), dtype=bool)
        good = good & holds  # margins of the nominal model alone hold for all samples, or for none
        failing[limit.metric] = np.broadcast_to(~holds, (count, samples))[:, drawn].sum(axis=1, dtype=np.int32)
    passes = good[:, drawn].sum(axis=1, dtype=np.int32)
    shakes = values.get("oscillation_rad_s")
    columns["samples"][:] = of
    columns["passes"] = passes
    columns["nominal_passes"] = good[:, 0]
    columns["diverged"] = diverged[:, drawn].sum(axis=1, dtype=np.int32)
    if shakes is not None:
        cycling = np.nan_to_num(shakes[:, drawn]) > (STANDING.maximum or 0.0)
        columns["cycling"] = cycling.sum(axis=1, dtype=np.int32)
    if unstable is not None:
        one = unstable.shape[1] == 1
        columns["unstable"] = (unstable[:, 0] * np.int32(of) if one else unstable[:, drawn].sum(axis=1)).astype(
            np.int32
        )
    intervals = np.array([wilson(k, of) for k in range(of + 1)]) * 100.0
    columns["pass_pct"] = 100.0 * passes / of
    columns["pass_low_pct"], columns["pass_high_pct"] = intervals[passes, 0], intervals[passes, 1]
    enough = (columns["pass_pct"] >= plan.sweep.required_pass_pct) & columns["nominal_passes"]
    columns["outcome"] = np.where(enough, PASS, FAIL).astype(object)
    columns["reason"] = _reasons(enough, columns["nominal_passes"], columns["diverged"], failing, of)
    columns |= {f"failing_{name}": number for name, number in failing.items()}
    for name in measured_names(plan):
        columns |= _spread(name, values[name], drawn)
    return columns


def _holds(limit: Limit, value: FloatArray) -> npt.NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        low = value >= (-math.inf if limit.minimum is None else limit.minimum)
        high = value <= (math.inf if limit.maximum is None else limit.maximum)
    return np.asarray(low & high & ~np.isnan(value))


def _spread(name: str, value: FloatArray, drawn: slice) -> Columns:
    """The columns of `scenarios.analysis.Spread`, of every row of (G, S); S is 1 where only the nominal is known."""
    rows = value[:, drawn] if value.shape[1] > 1 else value
    ordered = rows = np.sort(rows, axis=1)  # NaN last
    if name == "droop_deg":
        rows = np.take_along_axis(ordered, np.argsort(np.abs(ordered), axis=1, kind="stable"), axis=1)
    known = rows.shape[1] - np.isnan(rows).sum(axis=1)
    at, last = np.arange(len(rows)), np.maximum(known - 1, 0)
    first, final = rows[:, 0], rows[at, last]
    median = 0.5 * (ordered[at, last // 2] + ordered[at, np.maximum(known, 1) // 2])
    worst, best = (first, final) if name in HIGH_IS_GOOD else (final, first)
    return {
        f"{name}_nominal": value[:, 0].copy(),
        f"{name}_worst": worst.copy(),
        f"{name}_median": median,
        f"{name}_best": best.copy(),
        f"{name}_unset": (rows.shape[1] - known).astype(np.int32),
    }


def _reasons(
    enough: npt.NDArray[np.bool_],
    nominal: npt.NDArray[np.bool_],
    diverged: npt.NDArray[np.int32],
    failing: Mapping[str, npt.NDArray[np.int32]],
    of: int,
) -> npt.NDArray[np.object_]:
    """Which limit fails on most samples; empty for a point that passes."""
    names = list(failing)
    numbers = np.stack([diverged, *(failing[name] for name in names)])
    # a sample that diverged breaks every limit: it is told first
    most = np.argmax(numbers, axis=0)
    made = np.full(len(enough), "", dtype=object)
    for g in np.flatnonzero(~enough).tolist():
        k = int(most[g])
        number = int(numbers[k, g])
        if not number:
            made[g] = "only the nominal model is out of limits" if not nominal[g] else "too few samples pass"
        elif k == 0:
            made[g] = f"diverges on {number} of {of} samples"
        else:
            made[g] = f"{TITLES[names[k - 1]]} out of its limit on {number} of {of} samples"
    return made


def chunk_steps(plan: Plan, chunk: Chunk) -> int:
    """Vehicle-steps of a chunk."""
    ticks = sum(round(m.duration_s * plan.cases[chunk.case].profile.rate_hz) for m in plan.sweep.manoeuvres)
    return (chunk.stop - chunk.start) * plan.samples * ticks
