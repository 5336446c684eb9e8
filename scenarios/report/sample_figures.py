"""Figures of the uncertain models: which share passes, and how each metric is spread.

They depend on no flight and are kept, so that a helper draws them while the run is flown.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scenarios.analysis import wilson
from scenarios.report.canvas import INK, SMALL, Drawing, Panel, within
from scenarios.report.computed import SampleSet
from scenarios.report.loop_figures import short
from scenarios.report.styles import Style
from scenarios.report.verdict import shown, title

BINS = 90
ROW_IN = 0.42
TAIL_PCT = 0.5
"""Per cent of the samples at either end that may lie beyond the axis."""

Bounds = tuple[float | None, float | None]
"""Least and largest value that is allowed."""


@dataclass(frozen=True)
class Entry:
    """One gain set's row.

    Attributes:
        name: of the gain set. style: of its line. samples: what became of it.
    """

    name: str
    style: Style
    samples: SampleSet


@lru_cache(maxsize=4)
def share_figure(entries: tuple[Entry, ...], figure: str) -> Drawing:
    """Bars of the share of the random models that pass, with 95 % intervals.

    Args:
        entries: at least one, from the top. figure: its name on the page.
    """
    panel = _rows_panel(len(entries))
    with panel.drawn() as (axes,):
        within(axes, (0.0, 100.0), (-len(entries) + 0.4, 0.55))
        axes.set_xlabel("share of the models that meet every limit [%]")
        for row, one in enumerate(entries):
            passes, of = one.samples.passes, one.samples.of
            axes.barh(-row - 0.2, 100.0 * passes / of, height=0.32, color=INK[one.style.hue])
            axes.plot([100.0 * end for end in wilson(passes, of)], [-row - 0.2] * 2, color=INK["ink"], linewidth=1.4)
            axes.text(0.5, -row + 0.04, f"{short(one.name)}: {passes} of {of}", va="bottom", fontsize=SMALL)
        svg = panel.svg(figure)
    told = "; ".join(f"{one.name} {one.samples.passes} of {one.samples.of}" for one in entries)
    return Drawing(svg, f"Share of the uncertain models that meet every limit: {told}.")


@lru_cache(maxsize=32)
def spread_figure(entries: tuple[Entry, ...], metric: str, bounds: Bounds, figure: str) -> Drawing | None:
    """How a metric is spread over the random models, a histogram per gain set on one axis.

    Args:
        entries: from the top. metric: its name, one that every entry has. bounds: of its limit, in its own unit.
        figure: its name on the page.

    Returns:
        None if no model of any gain set has a value.
    """
    unit, factor = shown(metric)
    values = [one.samples.values[metric] * factor for one in entries]
    known = [row[1:][np.isfinite(row[1:])] for row in values]
    if not any(len(row) for row in known):
        return None
    limits = [bound * factor for bound in bounds if bound is not None]
    low, high = _ends([row for row in known if len(row)], limits)
    panel = _rows_panel(len(entries))
    with panel.drawn() as (axes,):
        within(axes, (low, high), (-len(entries) + 0.4, 0.55))
        axes.set_xlabel(f"{title(metric)} [{unit}]" if unit else title(metric))
        for limit in limits:
            axes.axvline(limit, color=INK["ink"], linewidth=1.1, linestyle=(0, (3, 2)))
        edges = np.linspace(low, high, BINS + 1)
        for row, (one, every, some) in enumerate(zip(entries, values, known, strict=True)):
            floor = -row - 0.42
            unset = one.samples.of - len(some)
            note = f" ({unset} of {one.samples.of} not measured)" if unset else ""
            if len(some):
                counts = np.histogram(np.clip(some, low, high), edges)[0]
                heights = floor + 0.48 * counts / counts.max()
                axes.stairs(heights, edges, baseline=floor, fill=True, color=INK[one.style.hue])
                axes.plot([np.median(some)] * 2, [floor - 0.06, floor + 0.52], color=INK["ink"], linewidth=1.2)
            if low <= every[0] <= high:
                look = {"markerfacecolor": INK["soft"], "markeredgecolor": INK["ink"], "linestyle": "none"}
                axes.plot([every[0]], [floor], marker="D", markersize=4.5, clip_on=False, **look)
            axes.text(low, -row + 0.1, f" {short(one.name, 28)}{note}", va="bottom", fontsize=SMALL)
        svg = panel.svg(figure)
    told = "; ".join(
        f"{one.name} " + (f"median {np.median(some):.3g}" if len(some) else "never measured")
        for one, some in zip(entries, known, strict=True)
    )
    return Drawing(svg, f"Distribution of {title(metric)} over the uncertain models: {told}.")


def _ends(known: list[np.ndarray], limits: list[float]) -> tuple[float, float]:
    """Of the axis: nearly all values and every limit."""
    ends = np.concatenate([np.percentile(values, [TAIL_PCT, 100.0 - TAIL_PCT]) for values in known])
    low, high = float(min([*ends, *limits])), float(max([*ends, *limits]))
    positive = low >= 0.0
    room = 0.04 * (high - low) or 0.05 * abs(high) or 0.5
    return (max(low - room, -0.02 * high) if positive else low - room), high + room


def _rows_panel(rows: int) -> Panel:
    panel = Panel(4.2, ROW_IN * rows + 0.5, margins_in=(0.1, 0.16, 0.42, 0.06))
    for axes in panel.axes:
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
    return panel
