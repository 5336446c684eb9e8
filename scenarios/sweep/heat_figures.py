"""Heat maps of a sweep as figures: what two parameters do together, for the page and as files."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np

from scenarios.report.canvas import FONT, SMALL, Drawing, Panel
from scenarios.study.figure_style import finished, panels
from scenarios.sweep.ranking import Ranking, value_of
from scenarios.sweep.sweep_figures import PAGE, PRINT, SHARE_TITLE, FigureFile, log_ticks, title_of
from scenarios.sweep.sweep_maps import COST, PASSED, SHARE, HeatMap, Side, kinds_of
from scenarios.sweep.sweep_words import many, objective_heading, objective_title, shown, unit_of
from sitl.parameters import parameter_specs

_LEVELS = 20
_MOST_NUMBERS = 120
"""Cells of a map that have room for their number."""
_TICKS = 12
_MOST_LETTERS = 32
"""Of all names below an axis, side by side."""


def heat_file(ranking: Ranking, heat: HeatMap) -> FigureFile:
    """A heat map on white: what passes, and how well what passes everywhere does.

    Args:
        ranking: of the sweep. heat: two of its parameters.
    """
    kinds = kinds_of(heat)
    canvas, grid = panels(1, len(kinds), 5.4 * len(kinds), 4.6)
    for axes, kind in zip(grid[0], kinds, strict=True):
        mesh, label = _draw_heat(axes, ranking, heat, kind, PRINT)
        canvas.colorbar(mesh, ax=axes, drawedges=False).ax.tick_params(labelsize=SMALL)
        axes.set_title(textwrap.fill(label, 44), fontsize=FONT)
    name = f"heat_{heat.x.axis.name}_{heat.y.axis.name}"
    made = finished(canvas, name, title_of(ranking, "every other parameter at its best", 34 * len(kinds)), "", "")
    return FigureFile(name, made.svg.encode(), made.png)


def heat_drawing(ranking: Ranking, heat: HeatMap, kind: str, figure: str) -> Drawing:
    """One of the two for the page.

    Args:
        ranking: of the sweep. heat: two of its parameters. kind: one of `kinds_of`. figure: its name on the page.
    """
    width, height = 4.3, 3.5
    panel = Panel(width, height, margins_in=(0.68, 0.78, 0.74, 0.1))
    with panel.drawn() as (axes,):
        mesh, label = _draw_heat(axes, ranking, heat, kind, PAGE)
        box = axes.get_position()
        place = panel.figure.add_axes((1 - 0.66 / width, box.y0, 0.14 / width, box.height))
        panel.figure.colorbar(mesh, cax=place)
        svg = panel.svg(figure)
    return Drawing(svg, _heat_told(ranking, heat, kind), label)


def _draw_heat(axes: Any, ranking: Ranking, heat: HeatMap, kind: str, ink: Mapping[str, str]) -> tuple[Any, str]:
    """Draw; gives what the colour bar needs, and what is shown. Bright is good always."""
    values, ends, colours = heat.share_pct, (0.0, 100.0), "cividis"
    label = f"{SHARE_TITLE}, of each cell's best candidate"
    levels = _LEVELS
    if kind == PASSED:
        cases = len(ranking.sweep.cases)
        values, ends = heat.passed, (-0.5, cases + 0.5)
        label = f"cases passed, of {cases}, by each cell's best candidate"
        levels = min(cases + 1, _LEVELS)
    elif kind == COST:
        one = ranking.sweep.objectives[0]
        values = np.asarray(value_of(one, heat.cost) * unit_of(one.metric)[1])
        colours = "cividis" if one.maximise else "cividis_r"
        known = values[np.isfinite(values)]
        ends = (float(known.min()), float(known.max()))
        if ends[0] == ends[1]:
            ends = (ends[0] - 0.5 * abs(ends[0]) - 1e-9, ends[1] + 0.5 * abs(ends[1]) + 1e-9)
        label = f"{objective_title(one)} in the worst case, the best that passes everywhere; hatched: none does"
    axes.grid(False)
    axes.patch.set(hatch="////", edgecolor=ink["rule"], linewidth=0.0)
    table = mpl.colormaps[colours].resampled(levels)
    mesh = axes.pcolormesh(
        heat.x.edges, heat.y.edges, np.ma.masked_invalid(values), cmap=table, vmin=ends[0], vmax=ends[1],
        edgecolors="face", linewidth=0.2,
    )  # fmt: skip
    _side(axes.xaxis, axes.set_xscale, heat.x)
    _side(axes.yaxis, axes.set_yscale, heat.y)
    axes.set_xlim(heat.x.edges[0], heat.x.edges[-1])
    axes.set_ylim(heat.y.edges[0], heat.y.edges[-1])
    if values.size <= _MOST_NUMBERS and heat.x.names and heat.y.names and heat.x.cells <= 12:
        for row, column in np.argwhere(np.isfinite(values)).tolist():
            value = float(values[row, column])
            red, green, blue, _ = table((value - ends[0]) / (ends[1] - ends[0]))
            dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
            text = shown(float(f"{value:.3g}")) if kind == COST else f"{value:.0f}"
            style = {"color": "#ffffff" if dark else "#000000", "fontsize": 7.0, "ha": "center", "va": "center"}
            axes.text(column, row, text, **style)
    best = ranking.best
    if best is not None:
        places = [_place(side, best, ranking) for side in (heat.x, heat.y)]
        ring = {"marker": "o", "markersize": 19.0, "markerfacecolor": "none", "linestyle": "none", "clip_on": False}
        axes.plot(*places, markeredgecolor="#ffffff", markeredgewidth=3.4, **ring)
        axes.plot(*places, markeredgecolor="#d55e00", markeredgewidth=1.6, **ring)
    axes.tick_params(length=2.5)
    return mesh, label


def _place(side: Side, candidate: int, ranking: Ranking) -> float:
    return float(side.of[candidate]) if side.names else float(ranking.values[side.axis.name][candidate])


def _side(axis: Any, set_scale: Any, side: Side) -> None:
    unit = parameter_specs()[side.axis.name].unit
    axis.set_label_text(f"{side.axis.name} [{unit}]" if unit else side.axis.name)
    if side.names:
        step = -(-side.cells // _TICKS)
        names = [side.names[k] for k in range(0, side.cells, step)]
        long = axis.axis_name == "x" and sum(len(name) for name in names) > _MOST_LETTERS
        slant = {"rotation": 40.0, "ha": "right", "rotation_mode": "anchor"} if long else {}
        axis.set_ticks(range(0, side.cells, step), names, **slant)
        return
    if side.axis.log and side.edges[0] > 0.0:
        set_scale("log")
        log_ticks(axis)


def _heat_told(ranking: Ranking, heat: HeatMap, kind: str) -> str:
    names = f"{heat.x.axis.name} and {heat.y.axis.name}"
    passing = int(np.count_nonzero(np.isfinite(heat.cost)))
    where = f"in {passing} of {many(int(np.count_nonzero(heat.counts)), 'cell')} a candidate passes everywhere"
    if kind == COST:
        one = ranking.sweep.objectives[0]
        return f"Heat map over {names}: the best {objective_heading(one)} of what passes everywhere; {where}."
    what, values, unit = "cases passed", heat.passed, f"of {len(ranking.sweep.cases)}"
    if kind == SHARE:
        what, values, unit = "share of the models that pass in the worst case", heat.share_pct, "%"
    known = values[np.isfinite(values)]
    span = f", from {known.min():.0f} to {known.max():.0f} {unit}" if len(known) else ""
    return f"Heat map over {names}: {what}, of the best candidate of each cell{span}; {where}."
