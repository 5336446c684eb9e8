"""What `froude study` found: tables, errata, conclusions and the pairs of chapter 7, as plain data.

Filled by the modules of this package, shown as text, as JSON and as a page. Nothing here computes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from sitl.sampled_loop import RollGains

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One number of a table.

    Attributes:
        item: row of the table, such as "Yv".
        column: column of the table, such as "ANT-R".
        unit: of both values.
        printed: as the study prints it; None where it prints nothing.
        ours: recomputed; None where it is an input that nothing recomputes.
        digits: decimals that the study prints, so that its rounding is not taken for a difference.
        compared: whether ours is meant to be the printed number; not where it is another design.
    """

    item: str
    column: str
    unit: str
    printed: float | None
    ours: float | None
    digits: int | None = None
    compared: bool = True

    @property
    def difference(self) -> float | None:
        """Ours minus the printed value."""
        return None if self.printed is None or self.ours is None else self.ours - self.printed

    @property
    def agrees(self) -> bool | None:
        """Whether ours rounds to the printed value, to one unit of its last digit; None if there is no pair."""
        if self.printed is None or self.ours is None or not self.compared:
            return None
        step = 10.0**-self.digits if self.digits is not None else 1e-9 * max(1.0, abs(self.printed))
        return abs(self.ours - self.printed) <= 1.0001 * step


@dataclass(frozen=True)
class Table:
    """One table of the study.

    Attributes:
        number: such as "5.2".
        title: what it holds, in our words.
        rows: every number of it.
        note: how ours was computed, and what to make of the differences.
    """

    number: str
    title: str
    rows: tuple[Row, ...]
    note: str = ""


@dataclass(frozen=True)
class Erratum:
    """A place where the print contradicts its own inputs.

    Attributes:
        where: table or section.
        printed: what it says.
        follows: what follows from tables 2.1 and 4.1, or from the argument around it.
        why: the evidence.
        found_by_us: whether our numbers show it (a table's row differs), not the reading alone.
    """

    where: str
    printed: str
    follows: str
    why: str
    found_by_us: bool


class Verdict(Enum):
    """On a conclusion of the study."""

    CONFIRMED = "confirmed"
    REFUTED = "refuted"
    UNDECIDED = "undecided"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Conclusion:
    """A statement of the study, in our words, and what our numbers say of it.

    Attributes:
        section: where it stands.
        statement: what it claims.
        verdict: ours.
        evidence: the numbers behind the verdict, one or two sentences.
    """

    section: str
    statement: str
    verdict: Verdict
    evidence: str


@dataclass(frozen=True)
class Pair:
    """Chapter 7 for one target and one reference: gains made on the scaled reference, flown on the true target.

    Attributes:
        target: airframe that flies, with its identified model and uncertainty.
        based_on: airframe whose model, scaled to the target, the gains were made on; the target itself: its own.
        gains: of the roll axis.
        source: "table 7.2" or "tuned here".
        profile: fidelity profile that was flown.
        metrics: METRICS name -> (S,) over the samples; NaN is UNSET. Sample 0 is the nominal model.
        margins: field of `sitl.margin_batch.MarginArrays` -> (S,).
        step_t_s: (T,) s from the step.
        step_sp_rad: (T,) set-point.
        step_phi_rad: (4, T): nominal, lowest, median and highest over the samples at each time.
        step_delta_lat: (4, T) alike.
        track_t_s: (U,) s.
        track_sp_rad: (U,) set-point.
        track_phi_rad: (4, U) alike.
        track_delta_lat: (4, U) alike.
    """

    target: str
    based_on: str
    gains: RollGains
    source: str
    profile: str
    metrics: Mapping[str, FloatArray]
    margins: Mapping[str, FloatArray]
    step_t_s: FloatArray
    step_sp_rad: FloatArray
    step_phi_rad: FloatArray
    step_delta_lat: FloatArray
    track_t_s: FloatArray
    track_sp_rad: FloatArray
    track_phi_rad: FloatArray
    track_delta_lat: FloatArray


PRINTED_FIGURES = ("6.13", "8.2", "8.4")
"""Figures of ours that stand for one that the study numbers; the others stand for a chapter or section."""


@dataclass(frozen=True)
class Figure:
    """One drawn figure.

    Attributes:
        name: file stem, such as "fig_6_13_ant-x".
        title: one line.
        caption: what it shows and how it was computed; also its text alternative.
        section: chapter, section or figure (PRINTED_FIGURES) of the study that it stands for.
        svg: the drawing, self-contained.
        png: the same as pixels.
    """

    name: str
    title: str
    caption: str
    section: str
    svg: str
    png: bytes

    @property
    def place(self) -> str:
        """Where in the study it belongs, in words."""
        kind = "figure" if self.section in PRINTED_FIGURES else "section" if "." in self.section else "chapter"
        return f"{kind} {self.section}"


@dataclass(frozen=True)
class Study:
    """Everything `froude study` recomputed.

    Attributes:
        tables: in the study's order.
        errata: found in the print.
        conclusions: of the study, judged.
        pairs: chapter 7 with the printed gains; with --tune also with ours.
        extra: further tables of ours (cross-validation flown over MAVLink, scaling with rotor count, ...).
        settings: seed, samples, distribution, profile and the like, for whoever wants to repeat it.
    """

    tables: tuple[Table, ...]
    errata: tuple[Erratum, ...]
    conclusions: tuple[Conclusion, ...]
    pairs: tuple[Pair, ...]
    extra: tuple[Table, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
