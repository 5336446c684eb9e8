"""How the study's figures look: one colour and one line style per airframe everywhere, the same bytes every time."""

from __future__ import annotations

import io
import re
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure as Canvas

from scenarios.study.result import Figure, FloatArray

# Okabe and Ito's palette: told apart by the colour-blind; the styles do it in grey.
COLOURS = {"ANT-R": "#d55e00", "ANT-X": "#0072b2", "CARRIER-1": "#009e73", "ADAM-0": "#a6458d"}
STYLES: dict[str, Any] = {"ANT-R": "--", "ANT-X": "-.", "CARRIER-1": (0, (1, 1.2)), "ADAM-0": (0, (5, 1.5, 1, 1.5))}
MARKERS = {"ANT-R": "o", "ANT-X": "s", "CARRIER-1": "^", "ADAM-0": "D"}
TRUE = {"color": "#111111", "linewidth": 2.0}
LIMIT = {"color": "#777777", "linewidth": 0.9, "linestyle": "--"}

_SETTINGS = {
    "svg.hashsalt": "froude",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Helvetica", "Arial"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.grid": True,
    "grid.color": "#d8d8d8",
    "grid.linewidth": 0.6,
    "axes.edgecolor": "#888888",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "lines.linewidth": 1.3,
    "figure.facecolor": "white",
}
_DPI = 110


def panels(rows: int, columns: int, width: float = 9.0, height: float = 5.0, **options: Any) -> tuple[Canvas, Any]:
    """A drawing with a grid of axes, (rows, columns) always.

    Args:
        rows, columns: of axes. width, height: inches. options: as `matplotlib.figure.Figure.subplots`.
    """
    with mpl.rc_context(_SETTINGS):
        canvas = Canvas(figsize=(width, height), layout="constrained")
        return canvas, canvas.subplots(rows, columns, squeeze=False, **options)


def legend(canvas: Canvas, axes: Any, columns: int) -> None:
    """One legend for all axes, below them: it never covers data.

    Args:
        canvas: the drawing. axes: whose lines are named. columns: names side by side.
    """
    handles, labels = axes.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))
    with mpl.rc_context(_SETTINGS):
        canvas.legend(list(named.values()), list(named), loc="outside lower center", ncols=columns)


def finished(canvas: Canvas, name: str, title: str, caption: str, section: str) -> Figure:
    """The drawing as SVG and PNG.

    Args:
        canvas: the drawing. name, title, caption, section: as `Figure`.
    """
    with mpl.rc_context(_SETTINGS):
        canvas.suptitle(title, fontsize=11.0, fontweight="bold")
        vector, pixels = io.BytesIO(), io.BytesIO()
        canvas.savefig(vector, format="svg", metadata={"Date": None, "Creator": "froude"})
        canvas.set_layout_engine("none")  # the places are found: half of the work is not done twice
        canvas.savefig(pixels, format="png", dpi=_DPI, metadata={"Software": "froude"})
    return Figure(name, title, caption, section, _own_ids(vector.getvalue().decode(), name), pixels.getvalue())


def _own_ids(svg: str, name: str) -> str:
    """The drawing without its preamble, and its ids with the figure's name: many drawings share a page."""
    svg = svg[svg.index("<svg") :]
    prefix = re.sub(r"[^a-z0-9]+", "-", name.lower()) + "-"
    svg = re.sub(r"(\d\.\d\d)\d+", r"\1", svg)  # a hundredth of a point is finer than any screen
    svg = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}\1"', svg)
    svg = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}\1)", svg)
    return re.sub(r'(xlink:href|href)="#([^"]+)"', rf'\1="#{prefix}\2"', svg)


def extremes(values: FloatArray, bins: int) -> FloatArray:
    """A long signal with no more than `bins` pairs of points: the least and the most of each stretch, in turn.

    What shakes between two points then shows as a band instead of as some slow motion that is not there.

    Args:
        values: (T,). bins: stretches.

    Returns:
        (T,) if that is few enough, else (2 bins,); `stretched` gives the times.
    """
    if len(values) <= 2 * bins:
        return values
    edges = np.linspace(0, len(values), bins + 1).astype(int)[:-1]
    return np.stack([np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)], axis=1).ravel()


def stretched(t: FloatArray, bins: int) -> FloatArray:
    """The times that go with `extremes`."""
    if len(t) <= 2 * bins:
        return t
    edges = np.linspace(0, len(t), bins + 1).astype(int)[:-1]
    return np.repeat(t[edges], 2)


def phase_deg(value: np.ndarray) -> FloatArray:
    """Unwrapped phase along the last axis, such that at the highest frequency it lies within (-180, 180].

    Args:
        value: (..., F) complex.
    """
    phase = np.degrees(np.unwrap(np.angle(value), axis=-1))
    return np.asarray(phase - 360.0 * np.ceil((phase[..., -1:] - 180.0) / 360.0))
