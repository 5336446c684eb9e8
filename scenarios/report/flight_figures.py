"""Figures of what was flown: steps laid over one another, each step with its marks, tracks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from scenarios.limits import TITLES
from scenarios.report.canvas import INK, SMALL, Drawing, Panel, emphasis, line, within
from scenarios.report.kept import kept
from scenarios.report.styles import Style
from scenarios.report.windows import BAND, BEFORE_S, StepTrace, TrackTrace
from scenarios.study.figure_style import extremes, stretched
from scenarios.table import number

LOWEST, HIGHEST = -0.45, 1.6
"""Ends of the angle's axis over the step's size, the same in every figure, so that they can be compared."""

BINS = 300
SHADE = {"color": INK["band"], "linewidth": 0}


@dataclass(frozen=True)
class Drawn:
    """A trace with what it is called and how it looks.

    Attributes:
        name: of the gain set. style: of its line. passed: it met every limit. trace: what was flown.
    """

    name: str
    style: Style
    passed: bool
    trace: StepTrace


def step_overlay(sets: Sequence[Drawn], figure: str) -> Drawing:
    """All gain sets on one time axis; those that pass are drawn thick.

    Args:
        sets: at least one. figure: its name on the page.
    """
    first = sets[0].trace
    panel = _step_panel(first.amplitude_deg, max(one.trace.duration_s for one in sets), 6.2, 3.4)
    with panel.drawn() as (axes,):
        _shade_faults(axes, first.faults)
        for one in sorted(sets, key=lambda drawn: drawn.passed):
            axes.plot(
                *_thinned(one.trace.t_s, one.trace.roll_deg), **line(one.style, **emphasis(one.passed, len(sets)))
            )
        svg = panel.svg(figure)
    names = ", ".join(f"{one.name} ({'passes' if one.passed else 'does not pass'})" for one in sets)
    return Drawing(
        svg,
        f"Roll angle over time after a step of {first.amplitude_deg:g} degrees, with the set-point and a band of 5 % "
        f"around it. Gain sets: {names}.{_told(first.faults)}",
    )


@kept
def step_figure(trace: StepTrace, style: Style, name: str, figure: str, own: StepTrace | None = None) -> Drawing:
    """One step with rise, overshoot and settling marked.

    Args:
        trace: what was flown. style: of its line. name: of the gain set. figure: its name on the page.
        own: the same with our own autopilot, where a real one flew.
    """
    panel = _step_panel(trace.amplitude_deg, trace.duration_s, 4.2, 2.6)
    size = trace.amplitude_deg
    notes = []
    with panel.drawn() as (axes,):
        _shade_faults(axes, trace.faults)
        if own is not None:
            axes.plot(*_thinned(own.t_s, own.roll_deg), color=INK["ink"], linewidth=0.9, linestyle=(0, (4, 2)))
        axes.plot(*_thinned(trace.t_s, trace.roll_deg), **line(style, 1.7))
        if trace.rise is not None:
            for time_s, level in zip(trace.rise, (0.1, 0.9), strict=True):
                axes.plot([time_s, time_s], [0.0, level * size], color=INK["dim"], linewidth=0.8)
            axes.plot(trace.rise, [0.0, 0.0], color=INK["ink"], linewidth=2.2, solid_capstyle="butt")
            axes.text(trace.rise[0], -0.03 * size, "R", va="top", ha="left", fontsize=SMALL, fontweight="bold")
            notes.append(f"R rise {trace.metrics['rise_time_s']:.3f} s")
        elif trace.metrics.get("overshoot_pct") is not None:
            notes += _wrapped(f"R {trace.reasons.get('rise_time_s') or 'not measured'}")
        overshoot = trace.metrics.get("overshoot_pct")
        if overshoot is not None:
            notes.append(f"O overshoot {number(overshoot, 1)} %")
        if trace.peak is not None and overshoot is not None and round(overshoot, 1) > 0.0:
            axes.plot([trace.peak[0]], [trace.peak[1]], marker="v", markersize=5, color=INK["ink"], linestyle="none")
            axes.text(trace.peak[0], trace.peak[1] + 0.06 * size, "O", ha="center", fontsize=SMALL, fontweight="bold")
        for metric, sign in (("settling_time_5pct_s", "5"), ("settling_time_2pct_s", "2")):
            settled_s = trace.metrics.get(metric)
            if settled_s is None:
                if metric in trace.metrics and overshoot is not None:
                    notes.append(f"{sign} never settles in {100 * BAND[metric]:g} %")
                continue
            axes.axvline(settled_s, ymin=0.0, color=INK["ink"], linewidth=0.9, linestyle=(0, (3, 2)))
            beside_s = settled_s + 0.01 * trace.duration_s
            axes.text(beside_s, (HIGHEST - 0.02) * size, sign, va="top", fontsize=SMALL, fontweight="bold")
            notes.append(f"{sign} settles in {100 * BAND[metric]:g} % {settled_s:.2f} s")
        reason = next((text for text in trace.reasons.values() if text), "")
        shown = notes or _wrapped(reason or "nothing was measured")
        for row, text in enumerate(reversed(shown)):
            axes.text(
                0.985, 0.03 + 0.085 * row, text, transform=axes.transAxes, ha="right", fontsize=SMALL, color=INK["ink"]
            )
        svg = panel.svg(figure)
    values = [
        f"{TITLES[metric]} " + (f"{value:.3g}" if value is not None else f"not measured: {trace.reasons[metric]}")
        for metric, value in trace.metrics.items()
    ]
    return Drawing(svg, f"Step response of {name}: {'; '.join(values) or 'nothing was measured'}.{_told(trace.faults)}")


def _wrapped(text: str) -> list[str]:
    import textwrap

    return textwrap.wrap(text, 46)[:4]


@kept
def track_figure(trace: TrackTrace, style: Style, name: str, figure: str, most_deg: float) -> Drawing:
    """A track: set-point and roll.

    Args:
        trace: what was flown. style: of its line. name: of the gain set. figure: its name on the page.
        most_deg: end of the angle's axis, the same for all gain sets.
    """
    panel = _track_panel(trace.duration_s, most_deg)
    with panel.drawn() as (axes,):
        _shade_faults(axes, trace.faults)
        axes.plot(*_thinned(trace.t_s, trace.setpoint_deg), color=INK["target"], linewidth=2.6, alpha=0.55)
        axes.plot(*_thinned(trace.t_s, trace.roll_deg), color=INK[style.hue], linewidth=1.1)
        svg = panel.svg(figure)
    parts = [f"{TITLES[key]} {value:.3g}" for key, value in trace.metrics.items() if value is not None]
    over = f"Roll set-point and roll angle of {name} over {trace.duration_s:g} s: {', '.join(parts)}."
    return Drawing(svg, over + _told(trace.faults))


def track_end_deg(traces: Iterable[TrackTrace]) -> float:
    """End of the angle's axis for the tracks of a run: room for what was asked, whatever the vehicles made of it."""
    peaks = [float(np.nanmax(np.abs(trace.setpoint_deg), initial=0.0)) for trace in traces]
    return 1.5 * max([*(peak for peak in peaks if np.isfinite(peak)), 2.0])


def step_id(place: int, number: int) -> str:
    """Name of a step's figure: of the step with that place on the page, of the gain set with that number."""
    return f"step{place}-{number}"


def track_id(place: int, number: int) -> str:
    """Name of a track's figure, as `step_id`."""
    return f"track{place}-{number}"


@lru_cache(maxsize=8)
def _step_panel(size: float, duration_s: float, width_in: float, height_in: float) -> Panel:
    panel = Panel(width_in, height_in)
    with panel.drawn() as (axes,):
        within(axes, (-BEFORE_S, duration_s), (LOWEST * size, HIGHEST * size))
        axes.set_xlabel("time from the step [s]")
        axes.set_ylabel("roll from start [deg]")
        axes.axhspan(0.95 * size, 1.05 * size, **SHADE)
        for edge in (0.98, 1.02):
            axes.axhline(edge * size, color=INK["dim"], linewidth=0.6, linestyle=(0, (1, 2)))
        axes.plot([-BEFORE_S, 0.0, 0.0, duration_s], [0.0, 0.0, size, size], color=INK["target"], linewidth=1.4)
        panel.settle()
    return panel


@lru_cache(maxsize=4)
def _track_panel(duration_s: float, most_deg: float) -> Panel:
    panel = Panel(4.2, 2.2)
    with panel.drawn() as (axes,):
        within(axes, (0.0, duration_s), (-most_deg, most_deg))
        axes.set_xlabel("time from the start [s]")
        axes.set_ylabel("roll [deg]")
        panel.settle()
    return panel


def _shade_faults(axes: Any, faults: Sequence[tuple[float, float]]) -> None:
    for begin_s, end_s in faults:
        axes.axvspan(begin_s, end_s, color=INK["bad"], alpha=0.12, linewidth=0)


def _told(faults: Sequence[tuple[float, float]]) -> str:
    """Shaded spans for who cannot see them."""
    spans = ", ".join(f"{begin_s:.1f} to {end_s:.1f} s" for begin_s, end_s in faults)
    return f" Faults in force, shaded: {spans}." if spans else ""


def _thinned(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A long signal by its extremes, so that what shakes shows as a band; a short one as it is."""
    if len(t) <= 4 * BINS:
        return t, values
    return stretched(t, BINS), extremes(values, BINS)
