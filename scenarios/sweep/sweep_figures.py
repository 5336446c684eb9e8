"""The Pareto front of a sweep as a figure; what figures of a sweep share.

Each figure is drawn twice: for the page in the page's own colours, and as files, SVG and PNG, on white.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from scenarios.report.canvas import INK, SMALL, Drawing, Panel
from scenarios.study.figure_style import finished, panels
from scenarios.sweep.pareto import Front
from scenarios.sweep.ranking import Ranking, value_of
from scenarios.sweep.sweep_words import many, objective_title, unit_of

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
_FEW = 500
_TAIL_PCT = 0.5
"""Of more than a few that pass, per cent at either end that need not be seen."""
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
    made = finished(canvas, "pareto", title_of(ranking, _verdict(ranking), 70), "", "")
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


def title_of(ranking: Ranking, what: str, width: int) -> str:
    """Of a figure, in lines that fit.

    Args:
        ranking: of the sweep. what: is shown. width: letters of a line.
    """
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
    on = front.candidates[drawable[front.candidates]]
    ends = [ends_of(one, drawable, _kept(one[keep], one[on])) for one in (x, y)]
    return ends[0], ends[1]


def _kept(passing: FloatArray, front: FloatArray) -> FloatArray:
    if len(passing) <= _FEW:
        return passing
    return np.concatenate([np.percentile(passing, [_TAIL_PCT, 100.0 - _TAIL_PCT]), front])


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
    for label, which, look in kinds:
        numbers = np.flatnonzero(which)
        if not len(numbers):
            continue
        if len(numbers) > MOST_POINTS:
            label += f" ({MOST_POINTS:,} of {len(numbers):,})"
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
        log_ticks(axis)
    limits(ends.low, ends.high)


def log_ticks(axis: Any) -> None:
    """Ticks at 1, 2 and 5 with plain numbers.

    Args:
        axis: of matplotlib.
    """
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
