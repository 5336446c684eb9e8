"""Margins and a Monte Carlo of gain sets, without a flight: `froude analyse`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from scenarios.gain_set import GainSet
from scenarios.limits import LIMIT_SETS, METRICS, STANDING, Limit
from scenarios.manoeuvres import Manoeuvre, make_manoeuvre
from scenarios.monte_carlo import FloatArray, MonteCarlo, monte_carlo
from scenarios.roll_set import RollSet
from sitl.airframe import DERIVATIVE_NAMES
from sitl.margin_batch import MarginArrays
from sitl.profile import Profile
from sitl.uncertainty import Distribution
from sitl.vehicle_spec import VehicleModel

HIGH_IS_GOOD = (
    "vaf_pct",
    "vaf_lag_removed_pct",
    "phase_margin_deg",
    "delay_margin_s",
    "gain_margin_high_db",
    "modulus_margin",
)
"""Metrics whose worst is the lowest; droop's is the largest magnitude, all others' the highest."""

SHOWN_MARGINS = ("gain_margin_low_db", "gain_margin_high_db", "phase_margin_deg", "delay_margin_s", "modulus_margin")
EXPLAINED = ("settling_time_5pct_s", "overshoot_pct", "rise_time_s", "vaf_pct", "delay_margin_s")
"""Metrics whose sensitivity to the derivatives is shown."""

_Z = 1.959963984540054
"""Of a 95 % interval."""


@dataclass(frozen=True)
class Spread:
    """A metric over the samples.

    Attributes:
        nominal: on the nominal model; None if it could not be measured.
        worst, median, best: over the random samples on which it could; None if on none. Without random samples, of
            the nominal model.
        unset: random samples on which it could not be measured.
    """

    nominal: float | None
    worst: float | None
    median: float | None
    best: float | None
    unset: int


@dataclass(frozen=True)
class Sensitivity:
    """What a metric depends on.

    Attributes:
        metric: its name.
        shares: derivative -> share of the metric's spread that it explains (squared standardised coefficient of a
            linear regression on ranks, 0 to 1); empty if the metric does not vary or was not measured.
        per_sigma: derivative -> change of the metric for one standard deviation of it, in the metric's unit.
    """

    metric: str
    shares: Mapping[str, float]
    per_sigma: Mapping[str, float]

    @property
    def dominant(self) -> str:
        """The derivative that matters most; empty if none does."""
        return max(self.shares, key=lambda name: self.shares[name]) if self.shares else ""


@dataclass(frozen=True)
class SetAnalysis:
    """One gain set.

    Attributes:
        gain_set: what was tried. spreads: by metric and margin. nominal_passes: the nominal model meets every limit.
        passes: random samples that do. of: random samples (without any, the nominal model is the only one).
        interval: Wilson's, 95 %, of the fraction.
        unstable: samples whose linear loop is unstable. cycling: samples that shake in a limit cycle.
        diverged: samples that were lost. sensitivities: of `EXPLAINED`.
    """

    gain_set: GainSet
    spreads: Mapping[str, Spread]
    nominal_passes: bool
    passes: int
    of: int
    interval: tuple[float, float]
    unstable: int
    cycling: int
    diverged: int
    sensitivities: tuple[Sensitivity, ...]


@dataclass(frozen=True)
class Analysis:
    """All gain sets on one vehicle.

    Attributes:
        model, profile: what flies how. limits: name of the set. samples: random models beside the nominal, 0 if the
            airframe states no uncertainty. seed, distribution, spread_sigma: of the draw. sets: one by one.
    """

    model: VehicleModel
    profile: Profile
    limits: str
    samples: int
    seed: int
    distribution: str
    spread_sigma: float
    sets: tuple[SetAnalysis, ...]


def manoeuvres() -> tuple[Manoeuvre, ...]:
    """What is flown: the step and the tracking input of the built-in scenario."""
    return make_manoeuvre("step", amplitude_deg=10.0, hold_s=3.0, return_s=3.0), make_manoeuvre("track")


def analyse(
    model: VehicleModel,
    profile: Profile,
    sets: Sequence[tuple[GainSet, RollSet]],
    *,
    limits: str = "practical",
    samples: int = 500,
    seed: int = 1,
    distribution: Distribution = "gaussian",
    spread_sigma: float = 3.0,
) -> Analysis:
    """Every gain set on the nominal model and its samples.

    Args:
        model, profile: what flies how. sets: gain sets as files have them and as the batch flies them.
        limits: name of one of `scenarios.limits.LIMIT_SETS`.
        samples, seed, distribution, spread_sigma: of the draw.

    Raises:
        UsageError: numbers that cannot be used.
    """
    sure = any(value > 0.0 for value in model.sigma_pct.as_dict().values())
    count = samples if sure else 0
    found = monte_carlo(
        model,
        {str(number): one for number, (_, one) in enumerate(sets)},
        profile,
        manoeuvres(),
        samples=count,
        seed=seed,
        distribution=distribution,
        spread_sigma=spread_sigma,
    )
    values = _values(found)
    made = tuple(_of_set(g, one, found, values, LIMIT_SETS[limits], model) for g, (one, _) in enumerate(sets))
    return Analysis(model, profile, limits, count, seed, distribution, spread_sigma, made)


def _values(found: MonteCarlo) -> dict[str, FloatArray]:
    """Metrics and margins alike, (G, S)."""
    assert found.margins is not None
    stable = found.margins.closed_loop_stable
    margins = {f.name: getattr(found.margins, f.name) for f in fields(MarginArrays) if f.name in SHOWN_MARGINS}
    # of an unstable loop its distance from -1 means nothing
    margins["modulus_margin"] = np.where(stable, margins["modulus_margin"], math.nan)
    return {**found.metrics, **margins}


def _of_set(
    g: int,
    gain_set: GainSet,
    found: MonteCarlo,
    values: Mapping[str, FloatArray],
    limits: Sequence[Limit],
    model: VehicleModel,
) -> SetAnalysis:
    assert found.margins is not None
    good = np.ones(len(found.derivatives), dtype=bool)
    for limit in {one.metric: one for one in (STANDING, *limits)}.values():
        row = values[limit.metric][g]
        good &= np.array([not math.isnan(value) and limit.holds(value) for value in row.tolist()])
    good &= ~found.diverged[g]
    drawn = _drawn(len(good))
    passes, of = int(good[drawn].sum()), len(good[drawn])
    shakes = np.nan_to_num(found.metrics["oscillation_rad_s"][g], nan=0.0)
    return SetAnalysis(
        gain_set=gain_set,
        spreads={name: spread(name, row[g]) for name, row in values.items() if name in METRICS},
        nominal_passes=bool(good[0]),
        passes=passes,
        of=of,
        interval=wilson(passes, of),
        unstable=int((~found.margins.closed_loop_stable[g][drawn]).sum()),
        cycling=int((shakes[drawn] > (STANDING.maximum or 0.0)).sum()),
        diverged=int(found.diverged[g][drawn].sum()),
        sensitivities=tuple(sensitivity(name, values[name][g], found.derivatives, model) for name in EXPLAINED),
    )


def spread(name: str, row: FloatArray) -> Spread:
    """A metric's spread.

    Args:
        name: of the metric. row: (S,) over the samples, the nominal first; NaN is UNSET.
    """
    nominal = None if math.isnan(row[0]) else float(row[0])
    drawn = row[_drawn(len(row))]
    known = np.sort(drawn[~np.isnan(drawn)])
    if not len(known):
        return Spread(nominal, None, None, None, len(drawn))
    if name == "droop_deg":
        known = known[np.argsort(np.abs(known), kind="stable")]
    low_is_worst = name in HIGH_IS_GOOD
    worst, best = (known[0], known[-1]) if low_is_worst else (known[-1], known[0])
    return Spread(nominal, float(worst), float(np.median(known)), float(best), len(drawn) - len(known))


def _drawn(samples: int) -> slice:
    """The random samples: all behind the nominal one, or that one if it is alone."""
    return slice(1, None) if samples > 1 else slice(None)


def wilson(passes: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a fraction.

    Args:
        passes, of: counted.
    """
    p, z2 = passes / of, _Z**2
    centre = (p + z2 / (2 * of)) / (1 + z2 / of)
    half = _Z * math.sqrt(p * (1 - p) / of + z2 / (4 * of**2)) / (1 + z2 / of)
    return max(0.0, centre - half), min(1.0, centre + half)


def sensitivity(name: str, row: FloatArray, derivatives: FloatArray, model: VehicleModel) -> Sensitivity:
    """What a metric depends on, over the random samples.

    Args:
        name: of the metric. row: (S,), the nominal first. derivatives: (S, 6). model: whose sigma counts.
    """
    used = np.flatnonzero(np.isfinite(row))
    used = used[used > 0]
    nothing = Sensitivity(name, {}, {})
    if len(used) < 20 or float(np.ptp(row[used])) < 1e-12:
        return nothing
    x, y = derivatives[used], row[used]
    varies = np.flatnonzero(np.ptp(x, axis=0) > 0.0)
    if not len(varies):
        return nothing
    ranks = np.column_stack([_standard(_ranks(x[:, k])) for k in varies])
    weights = np.linalg.lstsq(ranks, _standard(_ranks(y)), rcond=None)[0]
    sigma = np.abs(model.derivatives.as_array()) * model.sigma_pct.as_array() / 100.0
    slopes = np.linalg.lstsq(
        np.column_stack([x[:, varies] - x[:, varies].mean(axis=0), np.ones(len(x))]), y, rcond=None
    )
    names = [DERIVATIVE_NAMES[k] for k in varies]
    return Sensitivity(
        name,
        {one: float(min(1.0, w**2)) for one, w in zip(names, weights, strict=True)},
        {one: float(s * sigma[k]) for one, s, k in zip(names, slopes[0], varies, strict=False)},
    )


def _ranks(values: FloatArray) -> FloatArray:
    """Ranks, ties sharing their mean."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * (counts - 1))[inverse])


def _standard(values: FloatArray) -> FloatArray:
    deviation = float(values.std())
    return (values - values.mean()) / deviation if deviation > 0.0 else np.zeros_like(values)
