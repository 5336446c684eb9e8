"""One pair of chapter 7 in a line of numbers: what the text, the JSON and the page show of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scenarios.study.result import FloatArray, Pair
from scenarios.tuning.requirements import requirements_for


@dataclass(frozen=True)
class PairLine:
    """Over all samples of one pair; NaN where nothing could be measured on any.

    Attributes:
        settling_s: median and worst (5 % band). overshoot_pct: worst. vaf_pct: median. peak_delta_lat: worst.
        phase_margin_deg, delay_margin_s, gain_margin_high_db: least; of the loop as `Pair.margins` says.
        oscillation_rad_s: worst. meets: share of the samples that meet the requirements of
            the profile (`scenarios.tuning.requirements`): those of the study for its own.
    """

    settling_s: tuple[float, float]
    overshoot_pct: float
    vaf_pct: float
    peak_delta_lat: float
    phase_margin_deg: float
    delay_margin_s: float
    gain_margin_high_db: float
    oscillation_rad_s: float
    meets: float


def line_of(pair: Pair) -> PairLine:
    """The pair's numbers.

    Args:
        pair: flown.
    """
    required = requirements_for(pair.profile)
    settling, overshoot = pair.metrics["settling_time_5pct_s"], pair.metrics["overshoot_pct"]
    good = (settling <= required.settling_time_s) & (overshoot <= required.overshoot_pct)
    good &= (pair.margins["closed_loop_stable"] > 0.0) & (pair.margins["delay_margin_s"] >= required.delay_margin_s)
    return PairLine(
        settling_s=(_of(settling, np.median), _worst(settling)),
        overshoot_pct=_worst(overshoot),
        vaf_pct=_of(pair.metrics["vaf_pct"], np.median),
        peak_delta_lat=_worst(pair.metrics["peak_delta_lat"]),
        phase_margin_deg=_of(pair.margins["phase_margin_deg"], np.min),
        delay_margin_s=_of(pair.margins["delay_margin_s"], np.min),
        gain_margin_high_db=_of(pair.margins["gain_margin_high_db"], np.min),
        oscillation_rad_s=_worst(pair.metrics["oscillation_rad_s"]),
        meets=float(good.mean()),
    )


def _worst(values: FloatArray) -> float:
    """Largest; NaN if a single sample has none: what was not measured on all was not shown to be good."""
    return math.nan if np.isnan(values).any() else float(values.max())


def _of(values: FloatArray, pick: object) -> float:
    known = values[~np.isnan(values)]
    return float(pick(known)) if len(known) else math.nan  # type: ignore[operator]
