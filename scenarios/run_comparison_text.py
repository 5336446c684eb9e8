"""Runs compared, as text for people and as data for machines."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from scenarios.limits import MILLISECONDS, TITLES, Limit
from scenarios.run_comparison import FlightChange, MetricChange, RunChange
from scenarios.run_text import printable
from scenarios.table import text_console

if TYPE_CHECKING:
    from rich.console import Console

    from scenarios.run_reader import StoredRun

SCHEMA_VERSION = 1
WORDS: Mapping[str, tuple[str, str]] = {
    # change: (word, style)
    "same": ("same", ""),
    "better": ("better", "green"),
    "worse": ("worse", "yellow"),
    "other": ("differs", ""),
    "lost": ("not measured any more", "yellow"),
    "found": ("measured now", ""),
    "none": ("", ""),
}
REGRESSION = "REGRESSION"
_DASH = "–"


def comparison_object(changes: Sequence[RunChange]) -> dict[str, Any]:
    """As plain data; an infinite margin is null, as in `run.json`, and its change says what became of it.

    Args:
        changes: each run's, compared with the first.
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "regressions": sum(len(change.regressions) for change in changes),
        "comparisons": [
            {
                "old": str(change.old.folder),
                "new": str(change.new.folder),
                "circumstances": list(change.circumstances),
                "problems": {"old": list(change.old.problems), "new": list(change.new.problems)},
                "compared": change.compared,
                "regressions": [flight.name for flight in change.regressions],
                "gain_sets": [_flight_object(flight) for flight in change.flights],
            }
            for change in changes
        ],
    }


def _flight_object(flight: FlightChange) -> dict[str, Any]:
    return {
        "gain_set": flight.name,
        "old_gain_set": None if flight.old is None else flight.old.name,
        "old_outcome": None if flight.old is None else flight.old.outcome,
        "outcome": None if flight.new is None else flight.new.outcome,
        "verdict": flight.verdict,
        "regression": flight.regression,
        "identical": flight.identical,
        "parameters": {name: {"old": old, "new": new} for name, (old, new) in flight.parameters.items()},
        "metrics": [
            {
                "name": metric.name,
                "unit": metric.unit,
                "old": _finite(metric.old),
                "new": _finite(metric.new),
                "difference": metric.difference,
                "change": metric.change,
                "limit": metric.limit,
                "old_outcome": metric.old_outcome,
                "outcome": metric.outcome,
                "tolerance": metric.tolerance,
                "regression": metric.regression,
            }
            for metric in flight.metrics
        ],
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def comparison_text(changes: Sequence[RunChange], *, width: int, colour: bool) -> str:
    """Per gain set the verdicts, the limited metrics and what is not the same.

    Args:
        changes: each run's, compared with the first. width: columns. colour: with ANSI colours.
    """
    sink = io.StringIO()
    console = text_console(sink, width, colour=colour)
    for number, change in enumerate(changes):
        if number:
            console.print()
        _print_change(console, change)
    return "\n".join(line.rstrip() for line in sink.getvalue().splitlines()) + "\n"


def _print_change(console: Console, change: RunChange) -> None:
    console.print(f"old  {printable(str(change.old.folder))}", soft_wrap=True)
    console.print(f"new  {printable(str(change.new.folder))}", soft_wrap=True)
    for line in change.circumstances:
        console.print(f"  differs besides: {printable(line)}", soft_wrap=True)
    for which, run in (("old", change.old), ("new", change.new)):
        for problem in run.problems:
            console.print(f"  {which}: {printable(problem)}", soft_wrap=True)
    for flight in change.flights:
        console.print()
        _print_flight(console, flight, change.new)
    console.print()
    worse = change.regressions
    names = ", ".join(printable(flight.name) for flight in worse)
    sets = f"{change.compared} gain set{'s' * (change.compared != 1)} compared"
    console.print(
        f"{sets}, {len(worse)} with a regression: {names}" if worse else f"{sets}, no regression",
        style="bold red" if worse else "bold green",
        soft_wrap=True,
    )


def _print_flight(console: Console, flight: FlightChange, new_run: StoredRun) -> None:
    from rich.table import Table
    from rich.text import Text

    name = printable(flight.name)
    if flight.old is None:
        console.print(f"{name}: {flight.new.outcome if flight.new else ''}, not flown in the old run", soft_wrap=True)
        return
    if flight.new is None:
        console.print(
            f"{name}: was {flight.old.outcome}, not flown in the new run   {REGRESSION}", style="red", soft_wrap=True
        )
        return
    renamed = f" (was called {printable(flight.old.name)})" if flight.old.name != flight.new.name else ""
    same = flight.old.outcome == flight.new.outcome
    verdict = flight.new.outcome if same else f"{flight.old.outcome} → {flight.new.outcome}"
    mark = f"   {REGRESSION}" if flight.verdict == "worse" else ""
    console.print(f"{name}{renamed}: {verdict}{mark}", style="bold red" if mark else "bold", soft_wrap=True)
    if not same and flight.new.data["reason"]:
        console.print(f"  {printable(flight.new.data['reason'])}", soft_wrap=True)
    for parameter, (old, new) in flight.parameters.items():
        console.print(f"  {printable(parameter)} {_plain(old)} → {_plain(new)}", soft_wrap=True)
    if flight.identical:
        console.print("  the same telemetry, bit for bit")
    shown = [metric for metric in flight.metrics if metric.limit or metric.change not in ("same", "none")]
    if shown:
        limits = {one["metric"]: one for one in new_run.data["scenario"]["limits"]}
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        for title in ("  metric", "old", "new", "difference", "limit", ""):
            table.add_column(title, justify="left" if title in ("  metric", "") else "right", overflow="fold")
        for metric in shown:
            word, style = _word(metric)
            table.add_row(*_cells(metric, limits), Text(word, style=style))
        console.print(table)
    rest = sum(metric.change == "same" for metric in flight.metrics if metric not in shown)
    if rest and shown:
        console.print(f"  {rest} others are the same within their tolerances")


def _word(metric: MetricChange) -> tuple[str, str]:
    word, style = WORDS[metric.change]
    return (f"{word}   {REGRESSION}".strip(), "bold red") if metric.regression else (word, style)


def _cells(metric: MetricChange, limits: Mapping[str, Mapping[str, Any]]) -> tuple[str, str, str, str, str]:
    factor = 1000.0 if metric.name in MILLISECONDS else 1.0
    unit = "ms" if factor != 1.0 else "" if metric.unit == "1" else metric.unit
    title = f"  {TITLES.get(metric.name, printable(metric.name))}" + (f" [{printable(unit)}]" if unit else "")
    old, new = (_number(value, factor) for value in (metric.old, metric.new))
    difference = "" if metric.difference is None else f"{metric.difference * factor:+.3g}"
    limit = metric.limit or ""
    if limit and metric.name in limits and metric.name in TITLES:  # in the unit of the values beside it
        bounds = limits[metric.name]
        limit = Limit(metric.name, bounds["minimum"], bounds["maximum"]).for_people()
    return title, old, new, "0" if metric.difference == 0 else difference, printable(limit)


def _number(value: float | None, factor: float) -> str:
    if value is None:
        return _DASH
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value * factor:.4g}"


def _plain(value: float | None) -> str:
    return "(not stated)" if value is None else f"{value:g}"
