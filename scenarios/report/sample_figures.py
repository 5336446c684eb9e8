"""Figures of the uncertain models: which share passes, and how each metric is spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scenarios.report.canvas import INK, SMALL, Drawing, Panel, within
from scenarios.report.computed import FloatArray
from scenarios.report.loop_figures import short
from scenarios.report.styles import Style

BINS = 90
ROW_IN = 0.42
TAIL_PCT = 0.5
"""Per cent of the samples at either end that may lie beyond the axis."""


@dataclass(frozen=True, eq=False)
class Row:
    """One gain set's row.

    Attributes:
        name: of the gain set. style: of its line. values: (S,) of the random models, in the unit shown; NaN not
            measured. flown: what was flown, in that unit; None if it was not measured.
    """

    name: str
    style: Style
    values: FloatArray
    flown: float | None


@dataclass(frozen=True)
class Share:
    """How many of the random models pass, with the interval of that share, 0 to 1."""

    name: str
    style: Style
    passes: int
    of: int
    interval: tuple[float, float]


def share_figure(shares: Sequence[Share], figure: str) -> Drawing:
    """Bars of the share that passes, with 95 % intervals.

    Args:
        shares: at least one, from the top. figure: its name on the page.
    """
    panel = Panel(4.2, ROW_IN * len(shares) + 0.5, margins_in=(0.1, 0.16, 0.42, 0.06))
    with panel.drawn() as (axes,):
        within(axes, (0.0, 100.0), (-len(shares) + 0.4, 0.55))
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xlabel("share of the models that meet every limit [%]")
        for row, one in enumerate(shares):
            width = 100.0 * one.passes / one.of
            axes.barh(-row - 0.2, width, height=0.32, color=INK[one.style.hue])
            axes.plot([100.0 * end for end in one.interval], [-row - 0.2] * 2, color=INK["ink"], linewidth=1.4)
            axes.text(0.5, -row + 0.04, f"{short(one.name)}: {one.passes} of {one.of}", va="bottom", fontsize=SMALL)
        svg = panel.svg(figure)
    told = "; ".join(f"{one.name} {one.passes} of {one.of}" for one in shares)
    return Drawing(svg, f"Share of the uncertain models that meet every limit: {told}.")


def spread_figure(
    rows: Sequence[Row], title: str, unit: str, limits: tuple[float | None, float | None], figure: str
) -> Drawing | None:
    """How a metric is spread over the random models, a histogram per gain set on one axis.

    Args:
        rows: from the top. title, unit: of the metric. limits: least and largest allowed, in that unit.
        figure: its name on the page.

    Returns:
        None if no model of any gain set has a value.
    """
    known = [row.values[np.isfinite(row.values)] for row in rows]
    if not any(len(values) for values in known):
        return None
    ends = np.concatenate([np.percentile(values, [TAIL_PCT, 100.0 - TAIL_PCT]) for values in known if len(values)])
    marks = [row.flown for row in rows if row.flown is not None and np.isfinite(row.flown)]
    low, high = (float(end) for end in (min([*ends, *marks]), max([*ends, *marks])))
    positive = low >= 0.0
    for limit in limits:
        if limit is not None:
            low, high = min(low, limit), max(high, limit)
    room = 0.04 * (high - low) or 0.05 * abs(high) or 0.5
    low, high = (max(low - room, -0.02 * high) if positive else low - room), high + room
    panel = Panel(4.2, ROW_IN * len(rows) + 0.5, margins_in=(0.1, 0.16, 0.42, 0.06))
    with panel.drawn() as (axes,):
        within(axes, (low, high), (-len(rows) + 0.4, 0.55))
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xlabel(f"{title} [{unit}]" if unit else title)
        for limit in limits:
            if limit is not None and low <= limit <= high:
                axes.axvline(limit, color=INK["ink"], linewidth=1.1, linestyle=(0, (3, 2)))
        edges = np.linspace(low, high, BINS + 1)
        for row, (one, values) in enumerate(zip(rows, known, strict=True)):
            floor = -row - 0.42
            unset = len(one.values) - len(values)
            note = f" ({unset} of {len(one.values)} not measured)" if unset else ""
            if len(values):
                counts = np.histogram(np.clip(values, low, high), edges)[0]
                heights = floor + 0.48 * counts / counts.max()
                axes.stairs(heights, edges, baseline=floor, fill=True, color=INK[one.style.hue])
                middle = float(np.median(values))
                axes.plot([middle, middle], [floor - 0.06, floor + 0.52], color=INK["ink"], linewidth=1.2)
            if one.flown is not None and low <= one.flown <= high:
                axes.plot(
                    [one.flown],
                    [floor],
                    marker="D",
                    markersize=4.5,
                    markerfacecolor=INK["soft"],
                    markeredgecolor=INK["ink"],
                    linestyle="none",
                    clip_on=False,
                )
            axes.text(low, -row + 0.1, f" {short(one.name, 28)}{note}", va="bottom", fontsize=SMALL)
        svg = panel.svg(figure)
    told = "; ".join(
        f"{row.name} " + (f"median {np.median(values):.3g}" if len(values) else "never measured")
        for row, values in zip(rows, known, strict=True)
    )
    return Drawing(svg, f"Distribution of {title} over the uncertain models: {told}.")
