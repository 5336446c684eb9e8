"""One colour and one line style per gain set, the same in every figure and beside its name in every table."""

from __future__ import annotations

from dataclasses import dataclass

HUES = 8
"""Colours of the page, `--hue0` and so on; told apart by the colour-blind, and by their dashes in grey."""

_DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (6.0, 2.0),
    (2.0, 1.5),
    (8.0, 2.0, 2.0, 2.0),
    (4.0, 1.5, 1.5, 1.5, 1.5, 1.5),
)


@dataclass(frozen=True)
class Style:
    """How a gain set's line looks.

    Attributes:
        hue: name of a CSS variable. dashes: lengths on and off in SVG units; empty for a whole line.
    """

    hue: str
    dashes: tuple[float, ...]


BASELINE = Style("dim", (1.0, 2.0))
"""Of the airframe's own flight gains where they are flown along and are no candidate."""


def style_of(number: int) -> Style:
    """The style of the gain set of that number, from 0; forty are different."""
    return Style(f"hue{number % HUES}", _DASHES[number % len(_DASHES)])
