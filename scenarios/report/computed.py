"""What the report computes beside what was flown: the loop over frequency, and the uncertain models.

Nothing of it depends on the flights, so a helper computes it while they are flown (`scenarios/report/helper.py`).
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scenarios.limits import METRICS, STANDING, Limit
from scenarios.monte_carlo import monte_carlo
from scenarios.report.flown_model import FlownModel, flown_model
from scenarios.roll_set import RollSet
from sitl.crossings import Crossings
from sitl.errors import FroudeError
from sitl.margin_batch import MarginArrays, Sampled
from sitl.sampled_loop import ComplexArray, SampledLoop
from sitl.stability import Margins, margins_of

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

SAMPLES = 500
SEED = 1
POINTS = 240
"""Of the loop's curves."""
LOWEST_HZ = 0.05
SAME_DEG, SAME_DB = 0.05, 0.01


@dataclasses.dataclass(frozen=True)
class Mark:
    """Where a margin is on the loop's curves.

    Attributes:
        hz: frequency. size: the margin, deg of phase or dB of gain, as in run.json.
        at: value of the curve there, deg above -180 (0 to 360) or dB.
    """

    hz: float
    size: float
    at: float


@dataclasses.dataclass(frozen=True, eq=False)
class LoopCurves:
    """The loop of one gain set, cut at delta_lat, as it flies.

    Attributes:
        hz: (F,). open_loop: (F,) L. margins: found now, with the code that found those in run.json.
        phase: where the phase margin is, if there is one. gains: lower and upper gain margin, as far as there are.
    """

    hz: FloatArray
    open_loop: ComplexArray
    margins: Margins
    phase: Mark | None
    gains: tuple[Mark, ...]

    @property
    def sensitivity(self) -> FloatArray:
        """(F,) |1 / (1 + L)|."""
        return np.asarray(1.0 / np.abs(1.0 + self.open_loop))


@dataclasses.dataclass(frozen=True, eq=False)
class SampleSet:
    """One gain set on the nominal model and on random ones.

    Attributes:
        values: metric or margin -> (S,), the nominal model first; NaN could not be measured.
        good: (S,) every limit that can be computed holds. unstable, cycling, lost: (S,).
    """

    values: Mapping[str, FloatArray]
    good: BoolArray
    unstable: BoolArray
    cycling: BoolArray
    lost: BoolArray

    @property
    def passes(self) -> int:
        """Random models on which every limit holds."""
        return int(self.good[1:].sum())

    @property
    def of(self) -> int:
        """Random models."""
        return len(self.good) - 1


@dataclasses.dataclass(frozen=True)
class Computed:
    """Of one gain set; None where it could not be computed.

    Attributes:
        curves: of the loop. samples: None also where the airframe states no uncertainty.
        derivatives: (S, 6) of the models, the same for all gain sets.
        problem: why something is None; empty if nothing is, or there is no uncertainty to vary.
    """

    curves: LoopCurves | None = None
    samples: SampleSet | None = None
    derivatives: FloatArray | None = None
    problem: str = ""


Done = Mapping[str, Computed]
"""What has been computed, by `key_of`."""


def key_of(data: Mapping[str, Any], uploaded: Mapping[str, float]) -> str:
    """Everything that a gain set's computation depends on.

    Args:
        data: a `run.json`, or what is known of it before the flights. uploaded: PX4 name -> value.
    """
    scenario = data["scenario"]
    parts = [data["vehicle"], data["profile"], scenario["manoeuvres"], scenario["limits"], scenario["setpoint_rate_hz"]]
    return json.dumps([*parts, dict(uploaded)], sort_keys=True)


def compute(
    data: Mapping[str, Any],
    uploads: Sequence[Mapping[str, float]],
    done: Done | None = None,
    *,
    threads: int | None = None,
    samples: int = SAMPLES,
) -> dict[str, Computed]:
    """Curves and samples of gain sets.

    Args:
        data: a `run.json` in the present schema, or what is known of it before the flights.
        uploads: of each flight, PX4 name -> value. done: what need not be computed again.
        threads: None takes all cores. samples: random models.

    Returns:
        by `key_of`, of every upload.
    """
    keys = {key_of(data, uploaded): uploaded for uploaded in uploads}
    found = {key: done[key] for key in keys if done is not None and key in done}
    missing = {key: uploaded for key, uploaded in keys.items() if key not in found}
    if not missing:
        return found
    try:
        flown = flown_model(data)
    except FroudeError as error:
        return found | dict.fromkeys(missing, Computed(problem=str(error)))
    sets: dict[str, RollSet] = {}
    for key, uploaded in missing.items():
        if not uploaded:
            found[key] = Computed(problem="run.json does not say what was uploaded")
            continue
        try:
            sets[key] = flown.roll_set(uploaded)
        except FroudeError as error:
            found[key] = Computed(problem=str(error))
    return found | _computed(flown, sets, _limits(data["scenario"]["limits"]), samples, threads)


def _limits(listed: Sequence[Mapping[str, Any]]) -> tuple[Limit, ...]:
    limits = [Limit(one["metric"], one["minimum"], one["maximum"]) for one in listed if one["metric"] in METRICS]
    return tuple({one.metric: one for one in (STANDING, *limits)}.values())


def _computed(
    flown: FlownModel, sets: Mapping[str, RollSet], limits: Sequence[Limit], samples: int, threads: int | None
) -> dict[str, Computed]:
    curves = {key: loop_curves(flown, one) for key, one in sets.items()}
    uncertain = any(flown.model.sigma_pct.as_dict().values())
    if not (sets and uncertain and flown.manoeuvres):
        problem = (
            "" if flown.manoeuvres else "the manoeuvres were recorded, not planned, so no other model can fly them"
        )
        return {key: Computed(curves[key], problem=problem) for key in sets}
    try:
        many = monte_carlo(
            flown.model,
            sets,
            flown.profile,
            flown.manoeuvres,
            samples=samples,
            seed=SEED,
            setpoint_rate_hz=flown.setpoint_rate_hz,
            threads=threads,
        )
    except FroudeError as error:
        return {key: Computed(curves[key], problem=str(error)) for key in sets}
    assert many.margins is not None
    values = {name: rows for name, rows in many.metrics.items() if name in METRICS}
    margins = {f.name: getattr(many.margins, f.name) for f in dataclasses.fields(MarginArrays) if f.name in METRICS}
    stable = many.margins.closed_loop_stable
    margins["modulus_margin"] = np.where(stable, margins["modulus_margin"], math.nan)
    values |= margins
    done = {}
    for g, key in enumerate(sets):
        row = {name: rows[g] for name, rows in values.items()}
        good = ~many.diverged[g]
        for limit in limits:
            if limit.metric in row:
                good &= np.array([not math.isnan(one) and limit.holds(one) for one in row[limit.metric].tolist()])
        shakes = np.nan_to_num(row["oscillation_rad_s"]) if "oscillation_rad_s" in row else np.zeros(len(good))
        cycling = shakes > (STANDING.maximum or 0.0)
        samples_of = SampleSet(row, good, ~stable[g], cycling, many.diverged[g])
        done[key] = Computed(curves[key], samples_of, many.derivatives)
    return done


def loop_curves(flown: FlownModel, one: RollSet) -> LoopCurves:
    """The loop of one gain set over frequency, with its margins where they are.

    Args:
        flown: vehicle and profile. one: the gain set.
    """
    lag_s = flown.profile.motor_lag(flown.model.assumptions.motor_lag_s)
    loop = SampledLoop(flown.model.derivatives, one.gains, one.profile, lag_s)
    margins = margins_of(loop)
    crossings = Crossings(Sampled(loop.as_samples()), 1)
    unity = crossings.unity
    phase = _marked(
        margins.phase_margin_deg,
        unity.omega,
        lambda k: min((abs(unity.phase_deg[k]), abs(360.0 - unity.phase_deg[k]))),
        SAME_DEG,
        lambda k: float(unity.phase_deg[k]),
    )
    critical = crossings.critical
    level_db = 20.0 * np.log10(np.maximum(critical.gain, 1e-300))
    gains = []
    for size in (margins.gain_margin_low_db, margins.gain_margin_high_db):
        mark = _marked(
            size, critical.omega, lambda k: float(level_db[k]), SAME_DB, lambda k: -float(level_db[k]), signed=True
        )
        gains += [mark] if mark is not None else []
    top = 0.5 / one.profile.dt_s
    hz = np.geomspace(LOWEST_HZ, top * (1.0 - 1e-6), POINTS)
    return LoopCurves(hz, loop.transfer(2.0 * np.pi * hz), margins, phase, tuple(gains))


def _marked(
    size: float | None,
    omega: FloatArray,
    measure: Callable[[int], float],
    same: float,
    at: Callable[[int], float],
    *,
    signed: bool = False,
) -> Mark | None:
    """The crossing that a margin was measured at; None if there is no margin, or it is infinite."""
    if size is None or not math.isfinite(size) or not len(omega):
        return None
    wanted = size if signed else abs(size)
    k = min(range(len(omega)), key=lambda n: abs(measure(n) - wanted))
    if abs(measure(k) - wanted) > same:
        return None
    return Mark(float(omega[k]) / (2.0 * math.pi), size, at(k))
