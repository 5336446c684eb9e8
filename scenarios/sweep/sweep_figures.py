"""Figures of a sweep: the Pareto front, and heat maps of what two parameters do together.

Each is drawn twice: for the page in the page's own colours, and as files, SVG and PNG, on white.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from scenarios.report.canvas import FONT, INK, SMALL, Drawing, Panel
from scenarios.study.figure_style import finished, panels
from scenarios.sweep.pareto import Front
from scenarios.sweep.ranking import Ranking, value_of
from scenarios.sweep.sweep_maps import COST, PASSED, SHARE, HeatMap, Side, kinds_of
from scenarios.sweep.sweep_words import many, objective_heading, objective_title, shown, unit_of

FloatArray = npt.NDArray[np.float64]

PRINT = {
    "ink": "#1b1d21",
    "dim": "#8a929c",
    "paper": "#ffffff",
    "rule": "#d8d8d8",
    "hue0": "#0072b2",
    "hue1": "#d55e00",
}
"""Colours of the files, by the names of the page's."""
PAGE = {**INK, "paper": "#ffffff"}

MOST_POINTS = 1200
"""Candidates of a kind that are drawn; more would be a blot of megabytes."""
_LOG_SPAN = 30.0
_AROUND = 0.8
"""Of the span of what passes: how far around it the axes show what does not."""
_LEVELS = 20
_MOST_NUMBERS = 120
"""Cells of a map that have room for their number."""
_TICKS = 12
_MOST_LETTERS = 32
"""Of all names below an axis, side by side."""
SHARE_TITLE = "models that pass in the worst case [%]"


@dataclass(frozen=True)
class FigureFile:
    """A figure as files.

    Attributes:
        name: of the files, without suffix. svg, png: their bytes.
    """

    name: str
    svg: bytes
    png: bytes


def pareto_file(ranking: Ranking, front: Front) -> FigureFile:
    """The front among all candidates, on white.

    Args:
        ranking, front: of the sweep.
    """
    canvas, grid = panels(1, 1, 7.6, 5.2)
    axes = grid[0, 0]
    _draw_pareto(axes, ranking, front, PRINT)
    made = finished(canvas, "pareto", _title(ranking, _verdict(ranking), 70), "", "")
    return FigureFile("pareto", made.svg.encode(), made.png)


def pareto_drawing(ranking: Ranking, front: Front, figure: str) -> Drawing:
    """The same for the page.

    Args:
        ranking, front: of the sweep. figure: its name on the page.
    """
    panel = Panel(6.2, 4.0, margins_in=(0.62, 0.12, 0.42, 0.32))
    with panel.drawn() as (axes,):
        told = _draw_pareto(axes, ranking, front, PAGE)
        svg = panel.svg(figure)
    return Drawing(svg, f"Candidates by {_axis_title(ranking, 0)} and {_axis_title(ranking, 1)}. {told}", told)


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
    made = finished(canvas, name, _title(ranking, "every other parameter at its best", 34 * len(kinds)), "", "")
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


def _title(ranking: Ranking, what: str, width: int) -> str:
    return "\n".join([*textwrap.wrap(ranking.sweep.title, width), *textwrap.wrap(what, width)])


def _verdict(ranking: Ranking) -> str:
    if not ranking.passing:
        return "no candidate passes everywhere"
    return (
        f"{ranking.passing:,} of {many(len(ranking.order), 'candidate')} pass{'es' * (ranking.passing == 1)} everywhere"
    )


# -- the front -------------------------------------------------------------------------------------------------------


def axis_values(ranking: Ranking, number: int) -> FloatArray:
    """(N,) of an axis as people read it: an objective, or behind the only one the share that passes.

    Args:
        ranking: of the sweep. number: 0 across, 1 up.
    """
    objectives = ranking.sweep.objectives
    if number < len(objectives):
        one = objectives[number]
        return np.asarray(value_of(one, ranking.costs[:, number]) * unit_of(one.metric)[1])
    return 100.0 * np.maximum(ranking.worst_passes, 0) / ranking.sweep.of


def _axis_title(ranking: Ranking, number: int) -> str:
    objectives = ranking.sweep.objectives
    if number < len(objectives):
        return objective_title(objectives[number])
    return SHARE_TITLE


def drawable_of(ranking: Ranking) -> npt.NDArray[np.bool_]:
    """(N,) candidates that are complete and have finite values on both axes.

    Args:
        ranking: of the sweep.
    """
    return np.asarray(ranking.complete & np.isfinite(axis_values(ranking, 0)) & np.isfinite(axis_values(ranking, 1)))


def candidate_ends(ranking: Ranking, front: Front) -> tuple[Ends, Ends]:
    """Ends of both axes: what passes everywhere is seen, or the front where nothing does.

    Args:
        ranking, front: of the sweep.
    """
    drawable = drawable_of(ranking)
    keep = np.flatnonzero(ranking.everywhere & drawable)
    keep = keep if len(keep) else front.candidates[drawable[front.candidates]]
    x, y = axis_values(ranking, 0), axis_values(ranking, 1)
    return ends_of(x, drawable, x[keep]), ends_of(y, drawable, y[keep])


def _draw_pareto(axes: Any, ranking: Ranking, front: Front, ink: Mapping[str, str]) -> str:
    """Draw, and say what is drawn."""
    x, y = axis_values(ranking, 0), axis_values(ranking, 1)
    drawable = drawable_of(ranking)
    kinds = [
        (
            "fails somewhere",
            drawable & ~ranking.everywhere,
            {"marker": "x", "s": 13, "color": ink["dim"], "linewidths": 0.9},
        ),
        (
            "passes everywhere",
            drawable & ranking.everywhere,
            {"marker": "o", "s": 16, "color": ink["hue0"], "linewidths": 0},
        ),
    ]
    left_out = []
    for label, which, look in kinds:
        numbers = np.flatnonzero(which)
        if not len(numbers):
            continue
        if len(numbers) > MOST_POINTS:
            left_out.append(f"{MOST_POINTS:,} of {len(numbers):,} that {label.replace('s ', ' ', 1)}")
            numbers = numbers[np.linspace(0, len(numbers) - 1, MOST_POINTS).astype(int)]
        axes.scatter(x[numbers], y[numbers], label=label, **look)
    on = front.candidates[drawable[front.candidates]]
    on = on[np.argsort(x[on], kind="stable")]
    if len(on):
        line = {"color": ink["hue1"], "linewidth": 1.1, "zorder": 3, "drawstyle": "steps-post"}
        if len(ranking.sweep.objectives) != 2:
            line["linestyle"] = "none"  # the front is a surface: seen from one side it is no line
        label = "Pareto front" if front.passing else "Pareto front of all"
        axes.plot(x[on], y[on], marker="o", markersize=6.0, markerfacecolor="none", label=label, **line)
    best = ranking.best
    if best is not None and drawable[best]:
        label = "winner" if ranking.everywhere[best] else "best"
        star = {
            "marker": "*",
            "s": 150,
            "color": ink["ink"],
            "edgecolors": ink["paper"],
            "linewidths": 0.6,
            "zorder": 4,
        }
        axes.scatter(x[best], y[best], label=label, **star)
    x_ends, y_ends = candidate_ends(ranking, front)
    inside = drawable & x_ends.within(x) & y_ends.within(y)
    _scale(axes.xaxis, axes.set_xlim, x_ends)
    _scale(axes.yaxis, axes.set_ylim, y_ends)
    axes.set_xlabel(axis_label(ranking, 0))
    axes.set_ylabel(axis_label(ranking, 1))
    if drawable.any():
        place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.1}
        axes.legend(ncols=4, frameon=False, fontsize=SMALL, handletextpad=0.4, columnspacing=1.2, **place)
    missing = int(np.count_nonzero(ranking.complete & ~drawable))
    told = [f"Each in its worst case. {many(len(front.candidates), 'candidate')} on the front"]
    told += [f"drawn are {text}" for text in left_out]
    told += [f"{missing:,} have no value, or an infinite one, in some case and are not drawn"] if missing else []
    beyond = int(np.count_nonzero(drawable & ~inside))
    told += [f"{beyond:,} lie beyond the axes"] if beyond else []
    return "; ".join(told) + "."


def axis_label(ranking: Ranking, number: int) -> str:
    """What is along an axis, and which way is good.

    Args:
        ranking: of the sweep. number: 0 across, 1 up.
    """
    objectives = ranking.sweep.objectives
    large = number >= len(objectives) or objectives[number].maximise
    return f"{_axis_title(ranking, number)}, {'large' if large else 'small'} is good"


@dataclass(frozen=True)
class Ends:
    """Of an axis.

    Attributes:
        low, high: what it shows, in its unit. log: it is logarithmic.
    """

    low: float
    high: float
    log: bool

    def within(self, values: FloatArray) -> npt.NDArray[np.bool_]:
        """Which of them it shows."""
        return np.asarray((values >= self.low) & (values <= self.high))


def ends_of(every: FloatArray, drawable: npt.NDArray[np.bool_], keep: FloatArray) -> Ends:
    """What an axis shows.

    All that is to be kept is, and of the rest what lies about it: a candidate that hardly moves has a rise time that
    would press all others into a corner. A logarithm where they span much.

    Args:
        every: (N,) values of all candidates. drawable: (N,) which have one. keep: values that must be seen.
    """
    values = every[drawable]
    if not len(values):
        return Ends(0.0, 1.0, False)
    low, high = (float(end) for end in np.percentile(values, [1.0, 97.0]))
    if len(keep):
        span = _AROUND * float(np.ptp(keep)) or high - low
        low, high = max(low, float(keep.min()) - span), min(high, float(keep.max()) + span)
        low, high = min(low, float(keep.min())), max(high, float(keep.max()))
    if values.min() > 0.0 and high / low > _LOG_SPAN:
        room = (high / low) ** 0.05
        return Ends(low / room, high * room, True)
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return Ends(low - room, high + room, False)


def _scale(axis: Any, limits: Any, ends: Ends) -> None:
    if ends.log:
        axis._set_axes_scale("log")
        _log_ticks(axis)
    limits(ends.low, ends.high)


def _log_ticks(axis: Any) -> None:
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


# -- heat maps -------------------------------------------------------------------------------------------------------


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
    from sitl.parameters import parameter_specs

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
        _log_ticks(axis)


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
