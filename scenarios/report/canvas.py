"""How the report's figures are drawn: small, in the page's own colours, the same bytes every time.

Colours are the page's, so that dark mode and print reach them: what matplotlib draws in one of `INK` comes out as a CSS
variable. Lines are told apart by their style, too.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from scenarios.report.styles import HUES, Style

INK = {
    name: f"#fe00{number:02x}"
    for number, name in enumerate(
        ("ink", "dim", "rule", "band", "target", "good", "bad", "soft", *(f"hue{k}" for k in range(HUES)))
    )
}
"""Name of a CSS variable of the page -> the colour that stands for it while drawing."""

FONT = 9.0
SMALL = 8.0
_NAMES = {colour: name for name, colour in INK.items()}
_SETTINGS = {
    "svg.hashsalt": "froude",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": FONT,
    "text.color": INK["ink"],
    "text.parse_math": False,  # a dollar in a gain set's name is a dollar
    "axes.labelcolor": INK["ink"],
    "axes.edgecolor": INK["dim"],
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.labelpad": 2.0,
    "grid.color": INK["rule"],
    "grid.linewidth": 0.5,
    "xtick.color": INK["dim"],
    "ytick.color": INK["dim"],
    "xtick.labelcolor": INK["ink"],
    "ytick.labelcolor": INK["ink"],
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "figure.facecolor": "none",
    "lines.linewidth": 1.4,
    "path.simplify": True,
    "path.simplify_threshold": 0.25,
}


@dataclass(frozen=True)
class Drawing:
    """A figure for the page.

    Attributes:
        svg: to go into the page as it is. label: what it shows, for who cannot see it. caption: to go below it.
    """

    svg: str
    label: str
    caption: str = ""


class Panel:
    """A drawing with one column of axes, made once and used for many figures of the same frame.

    Args:
        width_in, height_in: in inches of 72 SVG units.
        heights: relative, from the top; axes share their abscissa.
        margins_in: left, right, bottom and top, inches.
    """

    def __init__(
        self,
        width_in: float = 4.2,
        height_in: float = 2.7,
        heights: Sequence[float] = (1.0,),
        margins_in: tuple[float, float, float, float] = (0.52, 0.1, 0.42, 0.08),
    ) -> None:
        left, right, bottom, top = margins_in
        gap = 0.12
        room = height_in - bottom - top - gap * (len(heights) - 1)
        with mpl.rc_context(_SETTINGS):
            self.figure = Figure(figsize=(width_in, height_in))
            FigureCanvasSVG(self.figure)
            self.axes: list[Any] = []
            upper = height_in - top
            for share in heights:
                high = room * share / sum(heights)
                box = (left / width_in, (upper - high) / height_in, (width_in - left - right) / width_in)
                self.axes.append(self.figure.add_axes((*box, high / height_in)))
                upper -= high + gap
        self._base = [set(axes.get_children()) for axes in self.axes]

    def settle(self) -> None:
        """What has been drawn until now is the frame: it stays from figure to figure."""
        self._base = [set(axes.get_children()) for axes in self.axes]

    @contextmanager
    def drawn(self) -> Iterator[list[Any]]:
        """The axes, to draw on; what is drawn in this block is gone after it."""
        with mpl.rc_context(_SETTINGS):
            yield self.axes
        for axes, base in zip(self.axes, self._base, strict=True):
            for artist in [one for one in axes.get_children() if one not in base]:
                artist.remove()

    def svg(self, name: str) -> str:
        """What is drawn now, as an SVG element.

        Args:
            name: unique on the page; ids begin with it.
        """
        sink = io.StringIO()
        with mpl.rc_context(_SETTINGS), warnings.catch_warnings():
            # the browser's fonts draw the text, matplotlib's only measure it
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            self.figure.savefig(sink, format="svg", metadata={"Date": None, "Creator": None, "Type": None})
        return _lean(sink.getvalue(), name)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers from low to high, about so many."""
    return [float(tick) for tick in MaxNLocator(count, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)]


def within(axes: Any, x: tuple[float, float], y: tuple[float, float], *, xs: int = 6, ys: int = 5) -> None:
    """Set the ends of both axes and round ticks inside them.

    Args:
        axes: to set. x, y: lowest and highest. xs, ys: about so many ticks.
    """
    for ends, count, limit, mark in ((x, xs, axes.set_xlim, axes.set_xticks), (y, ys, axes.set_ylim, axes.set_yticks)):
        limit(*ends)
        mark([tick for tick in ticks(*ends, count) if ends[0] <= tick <= ends[1]])


def line(style: Style, width: float = 1.4, alpha: float = 1.0) -> dict[str, Any]:
    """How a gain set's line is drawn.

    Args:
        style: of the gain set. width: in SVG units. alpha: 1 covers what is below.
    """
    # matplotlib multiplies dashes by the width; a thin line's would be too short to be told apart
    stretch = max(1.0, 1.4 / width)
    dashes: Any = (0, tuple(0.7 * stretch * length for length in style.dashes)) if style.dashes else "-"
    return {"color": INK[style.hue], "linewidth": width, "linestyle": dashes, "alpha": alpha}


def emphasis(passed: bool, among: int) -> dict[str, float]:
    """Width and cover of a line among others: what passes stands out.

    Args:
        passed: every limit holds. among: so many lines; many that swing would hide everything.
    """
    if passed:
        return {"width": 2.6}
    return {"width": 1.0, "alpha": 0.75} if among <= 6 else {"width": 0.8, "alpha": 0.35}


def _lean(svg: str, name: str) -> str:
    """Without preamble and what nothing refers to, in the page's colours and font; texts stay as they are."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>", "", svg, flags=re.DOTALL)
    used = set(re.findall(r'(?:href="|url\()#([^")]+)', svg))
    prefix = re.sub(r"[^a-z0-9]+", "-", name.lower()) + "-"

    def attribute(found: re.Match[str]) -> str:
        key, value = found.group(1), found.group(2)
        if key == "id":
            return f' id="{prefix}{value}"' if value in used else ""
        if key.endswith("href"):
            return f' href="#{prefix}{value[1:]}"'
        if key == "xmlns:xlink" or (key == "transform" and value.startswith("rotate(-0 ")):
            return ""
        value = re.sub(r"#fe00[0-9a-f]{2}", lambda colour: f"var(--{_NAMES[colour.group(0)]})", value)
        value = re.sub(r"url\(#", f"url(#{prefix}", value)
        value = re.sub(r"font-family: [^;]*; ", "", value).partition("; transform")[0].replace("\n", "")
        value = re.sub(r"(\d\.\d\d)\d+", r"\1", value).strip()  # a hundredth of a point is finer than any screen
        return f' {key}="{value}"'

    svg = re.sub(r"<[^<>]+>", lambda tag: re.sub(r'\s+([\w:-]+)="([^"]*)"', attribute, tag.group(0)), svg)
    svg = re.sub(r' width="[^"]*"| height="[^"]*"', "", svg, count=2)
    svg = svg.replace("<svg", '<svg aria-hidden="true" focusable="false"', 1)
    return re.sub(r">\s+<", "><", svg).strip()
