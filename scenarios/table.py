"""The result of a run as text: one row per gain set, then the reasons, the assumptions and where to look.

A value that could not be measured is shown as "–"; its reason stands below the table.
"""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from scenarios.flight import FlightRecord, RunRecord
from scenarios.gain_set import flies_gains
from scenarios.limits import LIMIT_CYCLE_RAD_S, Outcome

if TYPE_CHECKING:
    from rich.console import Console

UNSET = "–"
MINIMUM_WIDTH = 80
PIPED_WIDTH = 120
"""Columns used where the output is not a terminal and COLUMNS does not say otherwise."""


@dataclass(frozen=True)
class TableColumn:
    """One column of the result table.

    Attributes:
        title: heading; "/" breaks the line in a terminal.
        unit: shown under the heading; empty for none.
        metrics: names of the metrics in a cell, the first decides the cell's colour.
        cell: text of the metrics' values, in that order.
    """

    title: str
    unit: str
    metrics: tuple[str, ...]
    cell: Callable[..., str]

    @property
    def name(self) -> str:
        """The title on one line."""
        return self.title.replace("-/", "").replace("/_", "_").replace("/", " ")


def number(value: float | None, decimals: int = 2) -> str:
    """A value for people: fixed decimals, "–" for none, "∞" for an infinite margin."""
    if value is None or math.isnan(value):
        return UNSET
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def _fixed(decimals: int, factor: float = 1.0) -> Callable[[float | None], str]:
    return lambda value: number(None if value is None else value * factor, decimals)


def _oscillation(amplitude: float | None, hertz: float | None) -> str:
    if amplitude is None or hertz is None or amplitude < 0.05:
        return number(amplitude)
    return f"{number(amplitude)} @ {number(hertz, 1)}"


COLUMNS: tuple[TableColumn, ...] = (
    TableColumn("over-/shoot", "%", ("overshoot_pct",), _fixed(1)),
    TableColumn("settle/5 %", "s", ("settling_time_5pct_s",), _fixed(2)),
    TableColumn("settle/2 %", "s", ("settling_time_2pct_s",), _fixed(2)),
    TableColumn("rise", "s", ("rise_time_s",), _fixed(3)),
    TableColumn("droop", "deg", ("droop_deg",), _fixed(2)),
    TableColumn("VAF", "%", ("vaf_pct",), _fixed(1)),
    TableColumn("RMS/error", "deg", ("rms_error_deg",), _fixed(2)),
    TableColumn("oscil-/lation", "rad/s @ Hz", ("oscillation_rad_s", "oscillation_hz"), _oscillation),
    TableColumn("peak/delta/_lat", "", ("peak_delta_lat",), _fixed(2)),
    TableColumn("delay/margin", "ms", ("delay_margin_s",), _fixed(1, 1000.0)),
)

WIDE = 98
"""Columns of a terminal from which on everything fits; below it what `SPARED` names is left to run.json."""

SPARED = ("settling_time_2pct_s", "rms_error_deg", "peak_delta_lat")

STYLES: Mapping[Outcome, str] = {
    Outcome.PASS: "green",
    Outcome.FAIL: "red",
    Outcome.UNSET: "yellow",
    Outcome.INFO: "",
}


def cells(flight: FlightRecord) -> list[tuple[str, Outcome]]:
    """Text of each of `COLUMNS` for one flight, and the outcome of the cell's first metric."""
    row = []
    for column in COLUMNS:
        metrics = [flight.metric(name) for name in column.metrics]
        values = [None if metric is None else metric.value for metric in metrics]
        first = metrics[0]
        # Without a limit a metric that was not measured is no complaint: the dash says enough.
        judged = first is not None and first.limit is not None
        row.append((column.cell(*values), first.outcome if first is not None and judged else Outcome.INFO))
    return row


def notes(flight: FlightRecord) -> list[str]:
    """Why it did not pass, the warnings it was flown with, and how a real autopilot kept time."""
    lines = [flight.reason] if flight.reason else []
    lines += [f"warning: {warning}" for warning in flight.warnings]
    return lines + ([flight.timing] if flight.timing else [])


def blank_cells(flights: Sequence[FlightRecord]) -> list[str]:
    """Why cells of flights that were flown are empty: one line per reason, naming columns and gain sets."""
    reasons: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for flight in (flight for flight in flights if flight.segments):
        blanks: dict[str, list[str]] = {}
        for column in COLUMNS:
            metric = flight.metric(column.metrics[0])
            # What the verdict says already is not said twice.
            if metric is not None and metric.value is None and metric.reason and metric.reason not in flight.reason:
                blanks.setdefault(metric.reason, []).append(column.name)
        for reason, columns in blanks.items():
            reasons.setdefault((reason, tuple(columns)), []).append(flight.gain_set.name)
    return [
        f"{UNSET} {', '.join(columns)} ({', '.join(sets)}): {reason}" for (reason, columns), sets in reasons.items()
    ]


def own_flight(run: RunRecord) -> FlightRecord | None:
    """The flight of the airframe's own gains: the baseline, or the candidate with the same roll gains."""
    own = run.vehicle.get("flight_gains")
    if run.baseline is not None or not own:
        return run.baseline
    return next((flight for flight in run.flights if flies_gains(flight.gain_set, own)), None)


def own_gains_fly(flight: FlightRecord) -> bool | None:
    """Did this flight, of the airframe's own gains, fly: nothing went wrong and nothing oscillates?

    The scenario's other limits are for candidates; gains that flew may well be slow. None: it was broken off, or too
    short to tell.
    """
    if flight.outcome is Outcome.UNSET:
        return True if _quiet(flight) else None
    if flight.outcome is not Outcome.FAIL:
        return True
    return _quiet(flight) and any(metric.outcome is Outcome.FAIL for metric in flight.metrics)


def _quiet(flight: FlightRecord) -> bool:
    metric = flight.metric("oscillation_rad_s")
    return metric is not None and metric.value is not None and metric.value <= LIMIT_CYCLE_RAD_S


def own_gains_line(run: RunRecord) -> str:
    """Whether the airframe's own flight gains fly under the run's assumptions; empty if that was not flown.

    If they do not, the assumptions are wrong, and no candidate's verdict deserves trust.
    """
    flight = own_flight(run)
    if flight is None:
        return ""
    name = flight.gain_set.name
    fly = own_gains_fly(flight)
    if fly is None:
        return f"Whether the airframe's own flight gains ({name}) fly here is not known: {flight.reason}."
    if fly:
        verdict = "" if not flight.reason else f" ({flight.outcome} here: {flight.reason})"
        return f"The airframe's own flight gains ({name}) fly under these assumptions{verdict}."
    return (
        f"The airframe's own flight gains ({name}) do NOT fly under these assumptions: {flight.reason}. "
        "They flew in reality: doubt the assumptions before the candidates."
    )


def assumption_lines(run: RunRecord) -> list[str]:
    """Items of the fidelity profile and assumptions in force, as `item value`; units are in the names."""
    profile = {item: value for item, value, _ in run.profile if value != "airframe"}
    lines = [f"{item} {_plain(value)}" for item, value in profile.items() if item != "name"]
    assumptions = run.vehicle.get("assumptions", {})
    lines += [f"{item} {_plain(value)} (assumed)" for item, value in assumptions.items() if item not in profile]
    return lines


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def text_console(sink: TextIO, width: int, *, colour: bool) -> Console:
    """A console that writes text as it is, whatever the terminal.

    Args:
        sink: where to. width: columns. colour: with ANSI colours.
    """
    from rich.console import Console

    return Console(
        file=sink,
        width=width,
        force_terminal=colour,
        color_system="standard" if colour else None,
        highlight=False,
        emoji=False,
        markup=False,
        legacy_windows=False,
    )


def run_text(
    run: RunRecord,
    folder: Path | None = None,
    *,
    width: int | None = None,
    colour: bool = False,
    viewer: str = "",
) -> str:
    """The whole result as text.

    Args:
        run: at least one flight, or none (an interrupted run).
        folder: where the run's files are; None if nothing was kept.
        width: columns to use; None for `PIPED_WIDTH`. Below `MINIMUM_WIDTH` the lines will be broken by the
            terminal.
        colour: with ANSI colours; meaningful only on a terminal.
        viewer: how the Rerun viewer is called here; empty: `viewer_command()`.

    Returns:
        Lines, with a newline at the end.
    """
    import io

    columns = max(width or PIPED_WIDTH, MINIMUM_WIDTH)
    sink = io.StringIO()
    console = text_console(sink, columns, colour=colour)
    console.print(_rich_table(run.flights, columns))
    for flight in run.flights:
        for index, note in enumerate(notes(flight)):
            lead = f"  {flight.gain_set.name}: " if index == 0 else "    "
            console.print(_wrapped(lead + note, columns, "      "))
    for line in blank_cells(run.flights):
        console.print(_wrapped(f"  {line}", columns, "      "))
    if run.twins:
        _print_twins(console, run, columns)
    tail = []
    own = own_gains_line(run)
    if own:
        tail.append(_wrapped(own, columns, "  "))
    assumed = assumption_lines(run)
    if assumed:
        tail.append(_wrapped(f"Profile {run.scenario.profile}: " + ", ".join(assumed) + ".", columns, "  "))
    if not run.complete:
        tail.append("The run was interrupted; flights that are not listed were not flown.")
    if folder is not None:
        # Paths stand alone on their line and are never wrapped: they are there to be copied.
        tail.append(f"Run folder: {folder}")
        tail.append(f"Look at it: {viewer or viewer_command()} {shlex.quote(str(folder / 'compare.rrd'))}")
    if tail:
        console.print()
        for line in tail:
            console.print(line, soft_wrap=True)
    return "\n".join(line.rstrip() for line in sink.getvalue().splitlines()) + "\n"


def _print_twins(console: Any, run: RunRecord, columns: int) -> None:
    """Real and own autopilot beside each other, and where they are further apart than is tolerated."""
    from scenarios import twin_table

    console.print()
    console.print(_wrapped(twin_table.headline(run.twins), columns, "  "))
    response, rest = twin_table.rich_tables(run.twins, columns)
    console.print(response)
    for line in twin_table.remarks(run.twins):
        console.print(_wrapped(f"  {line}", columns, "      "))
    console.print("\nAUTO modes, ground, estimate, saturation: real/own")
    console.print(rest)


def _wrapped(text: str, columns: int, indent: str) -> str:
    return textwrap.fill(text, columns, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False)


def _rich_table(flights: Sequence[FlightRecord], width: int) -> Any:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    table.add_column("gain set", overflow="fold")
    shown = [k for k, column in enumerate(COLUMNS) if width >= WIDE or column.metrics[0] not in SPARED]
    for column in (COLUMNS[k] for k in shown):
        title = column.title.replace("/", "\n")
        table.add_column(f"{title}\n{column.unit}" if column.unit else title, justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    for flight in flights:
        row, filled = [Text(flight.gain_set.name)], cells(flight)
        row += [Text(text, style=STYLES[outcome]) for text, outcome in (filled[k] for k in shown)]
        table.add_row(*row, Text(str(flight.outcome), style=f"bold {STYLES[flight.outcome]}".strip()))
    return table


def viewer_command() -> str:
    """How to call the Rerun viewer that matches this installation: `rerun`, or its path if that is not on PATH."""
    import shutil
    import sys

    beside = Path(sys.executable).with_name("rerun")
    if shutil.which("rerun") or not beside.is_file():
        return "rerun"
    here = Path.cwd()
    return shlex.quote(str(beside.relative_to(here) if beside.is_relative_to(here) else beside))


def terminal_width(stream: Any) -> tuple[int, bool]:
    """Columns and whether colours are wanted for an output stream.

    Colours only on a terminal, and not where NO_COLOR is set (no-color.org).
    """
    import os
    import shutil

    terminal = bool(getattr(stream, "isatty", lambda: False)())
    width = shutil.get_terminal_size((PIPED_WIDTH, 24)).columns if terminal or "COLUMNS" in os.environ else PIPED_WIDTH
    return width, terminal and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
