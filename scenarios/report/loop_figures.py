"""Figures of the loop, cut at delta_lat: Bode with margins, sensitivity, delay margins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from scenarios.report.canvas import INK, SMALL, Drawing, Panel, emphasis, line, within
from scenarios.report.computed import LOWEST_HZ, LoopCurves
from scenarios.report.styles import Style
from scenarios.study.figure_style import phase_deg
from scenarios.table import number

GAIN_DB = (-50.0, 60.0)
PHASE_DEG = (-540.0, 60.0)
PEAK_DB = (-40.0, 22.0)
MS = 1e3


@lru_cache(maxsize=64)
def bode_figure(curves: LoopCurves, style: Style, name: str, figure: str) -> Drawing:
    """Magnitude and phase of the loop with its margins.

    Args:
        curves: of the loop. style: of its line. name: of the gain set. figure: its name on the page.
    """
    loop = curves.open_loop
    top_hz = float(curves.hz[-1])
    panel = _bode_panel(top_hz)
    level_db = 20.0 * np.log10(np.maximum(np.abs(loop), 1e-12))
    phase = _phase_deg(curves)
    notes = []
    with panel.drawn() as (gain, turn):
        gain.plot(curves.hz, level_db, **line(style, 1.6))
        turn.plot(curves.hz, phase, **line(style, 1.6))
        for mark, end in zip(curves.gains, ("lower", "upper"), strict=False):
            end = end if len(curves.gains) == 2 else ("lower" if mark.size < 0 and mark.at > 0 else "upper")
            gain.plot([mark.hz, mark.hz], [0.0, mark.at], color=INK["ink"], linewidth=2.0, solid_capstyle="butt")
            gain.plot([mark.hz], [mark.at], marker="o", markersize=3.5, color=INK["ink"])
            side = {"x": 1.12 * mark.hz, "ha": "left", "va": "bottom"}
            if mark.at < 0.0:
                side = {"x": 0.9 * mark.hz, "ha": "right", "va": "top"}
            gain.text(**side, y=mark.at, s=f"{mark.size:.1f} dB", fontsize=SMALL)
            notes.append(f"{end} gain margin {mark.size:.1f} dB at {mark.hz:.2f} Hz")
        if curves.phase is not None:
            here = float(np.interp(math.log(curves.phase.hz), np.log(curves.hz), phase))
            # the nearest odd multiple of 180 degrees is where the loop would meet -1
            edge = 180.0 * (2.0 * round((here / 180.0 - 1.0) / 2.0) + 1.0)
            turn.plot([curves.phase.hz] * 2, [edge, here], color=INK["ink"], linewidth=2.0, solid_capstyle="butt")
            turn.plot([curves.phase.hz], [here], marker="o", markersize=3.5, color=INK["ink"])
            above = max(edge, here) + 15.0
            turn.text(1.05 * curves.phase.hz, above, f"{curves.phase.size:.1f} deg", fontsize=SMALL, va="bottom")
            gain.plot([curves.phase.hz], [0.0], marker="o", markersize=3.5, color=INK["ink"])
            notes.append(f"phase margin {curves.phase.size:.1f} deg at {curves.phase.hz:.2f} Hz")
        delay_s = curves.margins.delay_margin_s
        if delay_s is not None:
            notes.append(f"delay margin {number(MS * delay_s, 1)} ms")
        if not curves.margins.closed_loop_stable:
            notes.append("the closed loop is UNSTABLE")
        svg = panel.svg(figure)
    said = "; ".join(notes) or "it has no margins"
    return Drawing(svg, f"Bode diagram of the loop of {name}: {said}.", said[0].upper() + said[1:] + ".")


def _phase_deg(curves: LoopCurves) -> np.ndarray:
    """Unwrapped phase, such that the phase margin is measured to -180 degrees where it can be."""
    phase = phase_deg(curves.open_loop)
    if curves.phase is None:
        return phase
    here = float(np.interp(math.log(curves.phase.hz), np.log(curves.hz), phase))
    wanted = curves.phase.at - 180.0 if curves.phase.at <= 180.0 else curves.phase.at - 540.0
    return np.asarray(phase + 360.0 * round((wanted - here) / 360.0))


@lru_cache(maxsize=4)
def _bode_panel(top_hz: float) -> Panel:
    panel = Panel(4.2, 3.7, heights=(1.0, 1.25), margins_in=(0.56, 0.1, 0.42, 0.08))
    with panel.drawn() as (gain, turn):
        for axes, ends in ((gain, GAIN_DB), (turn, PHASE_DEG)):
            _decades(axes, LOWEST_HZ, top_hz)
            axes.set_ylim(*ends)
        gain.set_yticks(range(-40, 61, 20))
        turn.set_yticks(range(-540, 1, 180))
        gain.tick_params(labelbottom=False)
        gain.axhline(0.0, color=INK["target"], linewidth=1.0)
        for odd in (-180.0, -540.0):
            turn.axhline(odd, color=INK["target"], linewidth=1.0)
        gain.set_ylabel("|L| [dB]")
        turn.set_ylabel("phase of L [deg]")
        turn.set_xlabel("frequency [Hz]")
        panel.settle()
    return panel


def _decades(axes: Any, low: float, high: float) -> None:
    from matplotlib.ticker import NullFormatter, NullLocator

    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    marks = [mark for mark in (0.1, 1.0, 10.0, 100.0, 1000.0) if low <= mark <= high]
    axes.set_xticks(marks, [f"{mark:g}" for mark in marks])


@dataclass(frozen=True)
class DrawnLoop:
    """A loop with what it is called and how it looks.

    Attributes:
        name: of the gain set. style: of its line. passed: it met every limit. curves: its loop.
    """

    name: str
    style: Style
    passed: bool
    curves: LoopCurves


def sensitivity_figure(loops: Sequence[DrawnLoop], figure: str) -> Drawing:
    """|S| of every stable loop, its peak marked; an unstable loop has none.

    Args:
        loops: at least one. figure: its name on the page.
    """
    panel = Panel(6.2, 3.0)
    stable = [one for one in loops if one.curves.margins.closed_loop_stable]
    with panel.drawn() as (axes,):
        _decades(axes, LOWEST_HZ, max(float(one.curves.hz[-1]) for one in loops))
        axes.set_ylim(*PEAK_DB)
        axes.set_yticks(range(-40, 21, 10))
        axes.axhline(0.0, color=INK["target"], linewidth=1.0)
        axes.axhline(6.0, color=INK["dim"], linewidth=0.8, linestyle=(0, (3, 2)))
        axes.text(LOWEST_HZ * 1.1, 6.6, "6 dB", fontsize=SMALL, color=INK["ink"])
        axes.set_xlabel("frequency [Hz]")
        axes.set_ylabel("|S| [dB]")
        for one in stable:
            level_db = 20.0 * np.log10(one.curves.sensitivity)
            axes.plot(one.curves.hz, level_db, **line(one.style, **emphasis(one.passed, len(stable))))
            k = int(np.argmax(level_db))
            axes.plot([one.curves.hz[k]], [level_db[k]], marker="o", markersize=4, color=INK[one.style.hue])
        svg = panel.svg(figure)
    peaks = ", ".join(
        f"{one.name} {20.0 * math.log10(1.0 / one.curves.margins.modulus_margin):.1f} dB" for one in stable
    )
    return Drawing(svg, f"Sensitivity over frequency, peak marked: {peaks or 'no loop is stable'}.")


@dataclass(frozen=True)
class DelayBar:
    """One gain set's bar.

    Attributes:
        name: of the gain set. style: of its line. margin_s: None if there is none; may be infinite.
        loop_delay_s: the loop's own, None if not known.
    """

    name: str
    style: Style
    margin_s: float | None
    loop_delay_s: float | None


def delay_figure(bars: Sequence[DelayBar], limit_s: float | None, figure: str) -> Drawing:
    """How much more delay each loop bears, beside the delay that it has.

    Args:
        bars: at least one, from the top. limit_s: least margin that the scenario asks for. figure: its name.
    """
    high = 0.34 * len(bars)
    panel = Panel(6.2, high + 0.55, margins_in=(0.1, 0.12, 0.42, 0.06))
    known = [MS * one.margin_s for one in bars if one.margin_s is not None and math.isfinite(one.margin_s)]
    delays = [MS * one.loop_delay_s for one in bars if one.loop_delay_s is not None]
    most = 1.08 * max([*known, *delays, 1.0])
    least = min([1.25 * min([*known, 0.0]), -0.06 * most])
    with panel.drawn() as (axes,):
        within(axes, (least, most), (-len(bars) + 0.5, 0.5), xs=8)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xlabel("delay [ms]")
        axes.axvline(0.0, color=INK["target"], linewidth=1.0)
        if limit_s is not None:
            axes.axvline(MS * limit_s, color=INK["ink"], linewidth=1.1, linestyle=(0, (3, 2)))
        for row, one in enumerate(bars):
            text = "no margin known"
            if one.margin_s is not None:
                infinite = math.isinf(one.margin_s)
                width = most if infinite else MS * one.margin_s
                hatch = "////" if width < 0.0 else ""
                axes.barh(
                    -row - 0.15,
                    width,
                    height=0.42,
                    facecolor="none" if hatch else INK[one.style.hue],
                    edgecolor=INK[one.style.hue],
                    hatch=hatch,
                    linewidth=0.8,
                )
                text = "any delay" if infinite else f"{width:.1f} ms"
            if one.loop_delay_s is not None:
                axes.plot([MS * one.loop_delay_s] * 2, [-row - 0.42, -row + 0.12], color=INK["ink"], linewidth=2.4)
            axes.text(least, -row + 0.14, f" {short(one.name)}: {text}", va="bottom", fontsize=SMALL)
        svg = panel.svg(figure)
    told = "; ".join(
        f"{one.name} {'none known' if one.margin_s is None else number(MS * one.margin_s, 1) + ' ms'}" for one in bars
    )
    return Drawing(svg, f"Delay margin of each loop beside its own delay: {told}.")


def short(name: str, most: int = 40) -> str:
    """A name cut to fit a figure."""
    flat = " ".join("".join(c if c.isprintable() else " " for c in name).split())
    return flat if len(flat) <= most else flat[: most - 1] + "…"
