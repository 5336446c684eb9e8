"""Statements of our own beside the study's conclusions: what can be held, what flies, what was tuned here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from scenarios.monte_carlo import draw_samples
from scenarios.study.printed import AIRFRAMES
from scenarios.study.result import Conclusion, Pair, Verdict
from scenarios.study.summary import line_of
from scenarios.tuning.requirements import requirements_for
from scenarios.tuning.synthesis import holds_an_angle
from sitl.uncertainty import DISTRIBUTIONS
from sitl.vehicle_spec import resolve_vehicle

SPREAD_SIGMA = 3.0
COUNTED = 100_000
"""Draws that the share of models that cannot hold an angle is counted over: those of a Monte Carlo are too few."""


def judged(condition: bool) -> Verdict:
    """Confirmed if it is so, refuted if not."""
    return Verdict.CONFIRMED if condition else Verdict.REFUTED


def own_statements(pairs: Sequence[Pair]) -> tuple[Conclusion, ...]:
    """All of them.

    Args:
        pairs: flown; those with gains tuned here only after a synthesis.
    """
    return (_holds(), *_reality(pairs), *_tuned(pairs))


def _holds() -> Conclusion:
    """A bound no gains can mend: it decides whether "all samples" can be had at all, whatever the draw."""
    exceptions = []
    for name in AIRFRAMES:
        model = resolve_vehicle(name)
        centre = model.derivatives.as_array()
        reach = SPREAD_SIGMA * np.abs(centre) * model.sigma_pct.as_array() / 100.0
        # what is asked for is linear in each derivative: it is least in a corner
        corners = centre + reach * np.array(list(product((-1.0, 1.0), repeat=len(centre))))
        if holds_an_angle(corners).all():
            continue
        shares = [
            f"{100.0 * float(np.mean(~holds_an_angle(draw_samples(model, COUNTED, 1, one)[1:]))):.2g} % of {one} draws"
            for one in DISTRIBUTIONS
        ]
        exceptions.append(f"{name} ({', '.join(shares)})")
    return Conclusion(
        "ours",
        f"Every model within {SPREAD_SIGMA:g} sigma of an identified one can be held at a roll angle.",
        judged(not exceptions),
        "Where Lv Yd < Ld Yv the torque that holds an angle points the other way than the torque that reaches it: an "
        "integrator of any gain drives the loop away. "
        + (
            f"There are such models of {', '.join(exceptions)}: with them no set, the study's or ours, flies every "
            "sample of every draw, and models next to them settle late whatever the gains."
            if exceptions
            else "There is no such model."
        ),
    )


def _reality(pairs: Sequence[Pair]) -> list[Conclusion]:
    """Ours: do the study's gains fly where the loop is not ideal?"""
    real = [p for p in pairs if p.profile != "study" and p.source.startswith("table")]
    if not real:
        return []
    names = sorted({p.profile for p in real})
    quiet = [p for p in real if float(np.nanmean(np.nan_to_num(p.metrics["oscillation_rad_s"], nan=9.9) <= 0.3)) == 1.0]
    text = ", ".join(f"{p.target} on {p.based_on}" for p in quiet)
    return [
        Conclusion(
            "ours",
            "The study's gains fly on an autopilot with filters, ticks and motor lag.",
            judged(len(quiet) == len(real)),
            f"Profile {', '.join(names)}, motor lag as assumed: {len(quiet)} of {len(real)} pairs are free of limit "
            f"cycles on every sample{' (' + text + ')' if text else ''}.",
        )
    ]


def _tuned(pairs: Sequence[Pair]) -> list[Conclusion]:
    """Ours: what gains tuned here meet on the true models, and by how much they miss it where they do not."""
    made = []
    for profile in dict.fromkeys(p.profile for p in pairs if p.source.startswith("tuned")):
        required = requirements_for(profile)
        for itself in (True, False):
            mine = [
                p
                for p in pairs
                if p.source.startswith("tuned") and p.profile == profile and (p.target == p.based_on) is itself
            ]
            lines = [(p, line_of(p)) for p in mine]
            bad = [(p, n) for p, n in lines if n.meets < 1.0]
            told = "; ".join(
                f"{p.target} on {p.based_on}: {100 * n.meets:.1f} % of the samples, settling "
                + ("not measurable on all" if math.isnan(n.settling_s[1]) else f"{n.settling_s[1]:.2f} s")
                + (
                    ", overshoot not measurable on all"
                    if math.isnan(n.overshoot_pct)
                    else f", overshoot {n.overshoot_pct:.2f} %"
                )
                + f", delay margin {1e3 * n.delay_margin_s:.1f} ms"
                for p, n in bad
            )
            on = "each airframe's own model" if itself else "the scaled models of the other airframes"
            bounds = f"settling {required.settling_time_s:g} s, overshoot {required.overshoot_pct:g} %"
            if required.delay_margin_s:
                bounds += f", delay margin {1e3 * required.delay_margin_s:g} ms"
            made.append(
                Conclusion(
                    "ours",
                    f"Gains tuned here for profile {profile} on {on} meet {bounds} on every sample of the true one.",
                    judged(not bad),
                    f"{len(lines) - len(bad)} of {len(lines)} pairs on all samples."
                    + (f" Not: {told}." if told else ""),
                )
            )
    return made
