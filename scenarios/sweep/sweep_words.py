"""What the results of a sweep are called and how their numbers are written, the same in text, page and pictures."""

from __future__ import annotations

import math

from scenarios.limits import METRICS, MILLISECONDS, TITLES
from scenarios.sweep.objectives import Objective

DIVERGED = "diverged"


def unit_of(metric: str) -> tuple[str, float]:
    """Unit that people read a metric in, empty for none, and the factor to it from its own.

    Args:
        metric: a key of METRICS.
    """
    if metric in MILLISECONDS:
        return "ms", 1e3
    unit = METRICS[metric][0]
    return "" if unit == "1" else unit, 1.0


def objective_heading(objective: Objective) -> str:
    """`rise time`, or with the statistic, `rise time (median)`.

    Args:
        objective: which.
    """
    title = TITLES[objective.metric]
    return title if objective.statistic == "worst" else f"{title} ({objective.statistic})"


def objective_title(objective: Objective) -> str:
    """The same with its unit in brackets.

    Args:
        objective: which.
    """
    unit = unit_of(objective.metric)[0]
    return objective_heading(objective) + (f" [{unit}]" if unit else "")


def shown_objective(objective: Objective, value: float, *, unit: bool = True) -> str:
    """A value for people.

    Args:
        objective: which. value: in the metric's unit; NaN is not measured. unit: behind the number.
    """
    name, factor = unit_of(objective.metric)
    text = shown(value * factor)
    return f"{text} {name}" if unit and name and not math.isnan(value) else text


def shown(value: float) -> str:
    """A number with four digits, "–" for none, "∞" for an infinite one.

    Args:
        value: any.
    """
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.4g}"


def limit_title(metric: str) -> str:
    """What fails: a limit's metric, or that the sample was lost.

    Args:
        metric: a key of METRICS, or DIVERGED.
    """
    return "diverges" if metric == DIVERGED else TITLES[metric]


def many(count: int, noun: str) -> str:
    """`1 case`, `4 cases`.

    Args:
        count: how many. noun: of one.
    """
    return f"{count:,} {noun}" + ("" if count == 1 else "s")
