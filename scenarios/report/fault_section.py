"""The section on faults: which were planned, when they were in force in each flight, what they did."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scenarios.fault_metrics import NAMES
from scenarios.report.elements import UNSET, Cell, Line, Section, Sets, Table, heading, metric_cell


def faults_section(sets: Sets) -> Section | None:
    """Every fault of every flight; None where none was planned."""
    flights = [one for one in sets.all if one.data["faults"]]
    if not flights:
        return None
    count = max(len(one.data["faults"]) for one in flights)
    rows = []
    for place in range(count):
        told = next(one.data["faults"][place] for one in flights if place < len(one.data["faults"]))
        cells = [Cell(told["plan"], words=True), *(_when(one.data["faults"], place) for one in flights)]
        rows.append(Line(told["text"], cells))
    tables = [
        Table(
            "When they were in force, vehicle time since boot [s]",
            "fault",
            ["planned", *(one.name for one in flights)],
            rows,
        ),
        Table(
            "What they did, the worst of the segments in which one began",
            "gain set",
            [heading(name) for name in NAMES],
            [Line(one.name, [metric_cell(one.flight.metric(name)) for name in NAMES], one.style) for one in flights],
        ),
    ]
    lead = [
        "The same faults were put into every flight, at the same time of the same manoeuvre. Plots show shaded when "
        "they were in force, but for those that lasted throughout."
    ]
    return Section("faults", "Faults", lead, tables=tables, notes=[*_links(flights), *_reasons(flights)])


def _when(faults: list[Mapping[str, Any]], place: int) -> Cell:
    fault = faults[place] if place < len(faults) else None
    if fault is None or fault["start_s"] is None:
        return Cell("never")
    return Cell(f"{fault['start_s']:.2f} to {UNSET if fault['end_s'] is None else format(fault['end_s'], '.2f')}")


def _links(flights: list[Any]) -> list[str]:
    told = []
    for one in flights:
        for fault in one.data["faults"]:
            if fault["datagrams"]:
                seen, hit = fault["datagrams"]
                told.append(f"{one.name}: {fault['text']}: {hit} of {seen} datagrams")
    return told


def _reasons(flights: list[Any]) -> list[str]:
    told = []
    for one in flights:
        reasons = {
            metric["reason"] for name in NAMES if (metric := one.flight.metric(name)) and metric["value"] is None
        }
        told += [f"{UNSET} {one.name}: {reason}" for reason in sorted(reasons)]
    return told
