"""What the page is made of: sections of text, figures and tables, as plain data for the template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from scenarios.report.styles import BASELINE, Style, style_of
from scenarios.report.verdict import SIGNS, shown, title, value_text

if TYPE_CHECKING:
    from scenarios.run_reader import StoredRun
    from scenarios.stored_flight import StoredFlight

UNSET = "–"
TOLD = {"PASS": "within its limit", "FAIL": "beyond its limit", "UNSET": "limited, but not measured"}


@dataclass(frozen=True)
class Cell:
    """Of a table.

    Attributes:
        text: as shown. outcome: PASS, FAIL or UNSET where the value is limited; empty otherwise. words: it holds
            text, not a number. strong: it stands out.
    """

    text: str
    outcome: str = ""
    words: bool = False
    strong: bool = False

    @property
    def sign(self) -> str:
        """A character for the outcome."""
        return SIGNS.get(self.outcome, "")

    @property
    def told(self) -> str:
        """The outcome for who cannot see it."""
        return TOLD.get(self.outcome, "")


@dataclass(frozen=True)
class Line:
    """A row of a table.

    Attributes:
        name: heads the row. cells: as many as the table has columns. style: of the gain set's line; None for none.
    """

    name: str
    cells: Sequence[Cell]
    style: Style | None = None


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        caption: what it holds. corner: heading of the rows' names. columns: headings. rows: from the top.
    """

    caption: str
    corner: str
    columns: Sequence[str]
    rows: Sequence[Line]

    @property
    def wordy(self) -> list[bool]:
        """Which columns hold text."""
        return [any(row.cells[k].words for row in self.rows) for k in range(len(self.columns))]


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        name: its id. title: above it. svg, label: as `scenarios.report.canvas.Drawing`. style, outcome: of the gain
            set that it is about. caption: below it. table: its numbers, if they are in no table of the section.
    """

    name: str
    title: str
    svg: str
    label: str
    style: Style | None = None
    outcome: str = ""
    caption: str = ""
    table: Table | None = None


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        name: its id. title: its heading. lead: paragraphs before the figures. wide: figures over the whole width.
        grid: figures side by side. tables: below. notes: a list at the end.
    """

    name: str
    title: str
    lead: Sequence[str] = ()
    wide: Sequence[Figure] = ()
    grid: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Set:
    """A gain set of the run as the page shows it.

    Attributes:
        number: from 0, unique on the page. name: with "(baseline)" if it is no candidate. flight: of the run.
        style: of its line. baseline: the airframe's own gains, flown along.
    """

    number: int
    name: str
    flight: StoredFlight
    style: Style
    baseline: bool = False

    @property
    def data(self) -> Mapping[str, Any]:
        """As in run.json."""
        return self.flight.data

    @property
    def outcome(self) -> str:
        """PASS, FAIL, UNSET or INFO."""
        return self.flight.outcome

    @property
    def passed(self) -> bool:
        """It is a candidate that met every limit."""
        return self.outcome == "PASS" and not self.baseline


@dataclass(frozen=True)
class Sets:
    """All of a run.

    Attributes:
        run: read back. all: candidates in the order flown, then the baseline, if there is one.
    """

    run: StoredRun
    all: tuple[Set, ...] = field(default=())

    @classmethod
    def of(cls, run: StoredRun) -> Sets:
        """The gain sets of a run."""
        stored = [*run.flights, *([run.baseline] if run.baseline is not None else [])]
        made = []
        for number, flight in enumerate(stored):
            baseline = flight is run.baseline
            name, style = look_of(number, flight.name, baseline=baseline)
            made.append(Set(number, name, flight, style, baseline))
        return cls(run, tuple(made))

    @property
    def candidates(self) -> tuple[Set, ...]:
        """Without the baseline."""
        return tuple(one for one in self.all if not one.baseline)


def look_of(number: int, name: str, *, baseline: bool) -> tuple[str, Style]:
    """What a gain set is called on the page, and how its line looks.

    Args:
        number: from 0, in the order of the run. name: of the gain set. baseline: it is no candidate.
    """
    return (f"{name} (baseline)", BASELINE) if baseline else (name, style_of(number))


def metric_cell(metric: Mapping[str, Any] | None) -> Cell:
    """A metric of run.json as a cell.

    Args:
        metric: as in run.json; None if it was not asked for.
    """
    if metric is None:
        return Cell(UNSET)
    text = value_text(metric["name"], metric["value"], unit=False)
    if metric["value"] is None and metric["reason"].startswith("infinite"):
        text = "∞"
    return Cell(text, metric["outcome"] if metric["limit"] else "")


def heading(metric: str) -> str:
    """Of a metric's column: its name and unit."""
    unit = shown(metric)[0]
    return title(metric) + (f" [{unit}]" if unit else "")


def number_of(value: Any) -> float | None:
    """A number of a mapping that may hold anything; None if it is none."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
