"""The page: everything a run has to say, the verdict first, in one file that needs nothing else."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from scenarios.report.computed import Computed, Done, compute, key_of
from scenarios.report.computed_sections import delay_section, loop_section, samples_section, sensitivity_section
from scenarios.report.elements import UNSET, Cell, Line, Section, Sets, Table
from scenarios.report.fault_section import faults_section
from scenarios.report.flown_model import flown_model
from scenarios.report.flown_sections import (
    numbers_section,
    parameters_section,
    step_sections,
    track_sections,
    twins_section,
    warnings_section,
)
from scenarios.report.verdict import SIGNS, title, verdict_of
from scenarios.run_reader import COMPARE, StoredRun

TEMPLATE = "page.html.j2"


def report_page(run: StoredRun, done: Done | None = None, *, threads: int | None = None) -> str:
    """The page as HTML, without scripts and without requests to anywhere; the same bytes for the same run.

    Args:
        run: read back. done: what has been computed already. threads: None takes all cores.
    """
    sets = Sets.of(run)
    computed = compute(run.data, [one.data["uploaded"] for one in sets.all], done, threads=threads)
    found = {one.number: computed[key_of(run.data, one.data["uploaded"])] for one in sets.all}
    telemetry = {one.number: run.telemetry(one.flight) for one in sets.all}
    sections = [
        numbers_section(sets),
        warnings_section(sets),
        faults_section(sets),
        *step_sections(sets, telemetry),
        *track_sections(sets, telemetry),
        *_loops(sets, found),
        parameters_section(sets),
        twins_section(sets),
        _repeat(run),
    ]
    shares = [_share(found[one.number]) for one in sets.candidates]
    page: str = page_template().render(
        run=run.data,
        name=run.name,
        title=run.data["scenario"]["title"] or run.data["scenario"]["name"] or run.name,
        verdict=verdict_of(run.data, shares),
        styles={one.number: one.style for one in sets.all},
        signs=SIGNS,
        sections=[section for section in sections if section is not None],
        command=shlex.join(run.data["command"]),
        # read last: telemetry that is damaged was found on the way; compare.rrd is no part of this page
        problems=[problem for problem in run.problems if not problem.startswith(COMPARE)],
    )
    return page


@cache
def page_template() -> Any:
    """The page's template, compiled."""
    import jinja2

    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(TEMPLATE)


def _loops(sets: Sets, found: Mapping[int, Computed]) -> Iterable[Section | None]:
    if not sets.all:
        return ()
    model = None
    if any(one.samples is not None for one in found.values()):
        model = flown_model(sets.run.data).model
    return (
        loop_section(sets, found),
        sensitivity_section(sets, found),
        delay_section(sets, found),
        samples_section(sets, found, model),
    )


def _share(one: Computed) -> tuple[int, int] | None:
    return None if one.samples is None else (one.samples.passes, one.samples.of)


def _repeat(run: StoredRun) -> Section:
    data = run.data
    scenario, vehicle = data["scenario"], data["vehicle"]
    lead = [] if data["command"] else ["The command is not known."]
    facts: list[tuple[str, Any]] = [
        ("started", data["started_utc"]),
        ("seed", data["seed"]),
        ("scenario", _named(scenario["name"], scenario["file"])),
        ("profile", scenario["profile"]),
        ("gain sets asked for", ", ".join(scenario["gain_sets"])),
        ("axes", scenario["axes"]),
        ("take-off altitude", _with(scenario["takeoff_altitude_m"], "m")),
        ("set-points", _with(scenario["setpoint_rate_hz"], "Hz")),
        ("folder", run.name),
    ]
    tables = [_facts("The run", facts)]
    tables.append(_facts("Versions", data["versions"].items()))
    tables.append(
        Table(
            "Manoeuvres",
            "name",
            ["kind", "duration [s]", "settings"],
            [
                Line(one["name"], [Cell(one["kind"], words=True), Cell(_text(one["duration_s"])), _settings(one)])
                for one in scenario["manoeuvres"]
            ],
        )
    )
    limits = [
        Line(title(one["metric"]), [Cell(_text(one["minimum"])), Cell(_text(one["maximum"]))])
        for one in scenario["limits"]
    ]
    named = f"Limits ({scenario['limits_name']}), in the metrics' own units"
    tables.append(Table(named, "metric", ["at least", "at most"], limits))
    tables.append(_airframe(vehicle))
    body = [
        ("airframe", _named(vehicle["name"], vehicle["title"])),
        ("spec", vehicle["spec"]),
        ("scaled from", vehicle["reference"]),
        ("Froude number", vehicle["froude_number"]),
        ("scaling", ", ".join(vehicle["scaling"])),
        ("mass", _with(vehicle["mass_kg"], "kg")),
        ("diagonal", _with(vehicle["diagonal_m"], "m")),
        ("layout", f"{vehicle['layout']}, {len(vehicle['rotors'])} rotors" if vehicle["rotors"] else vehicle["layout"]),
    ]
    tables.append(_facts("Airframe", body))
    tables.append(_facts("Assumptions: not measured", vehicle["assumptions"].items()))
    profile = [Line(row["item"], [Cell(_text(row["value"])), Cell(row["unit"], words=True)]) for row in data["profile"]]
    tables.append(Table(f"Profile {scenario['profile']}", "item", ["value", "unit"], profile))
    flights = [
        Line(
            one.name,
            [
                Cell(str(one.data["rows"])),
                Cell(one.data["gain_set"]["source"] or UNSET, words=True),
                Cell(one.data["telemetry_sha256"][:16] or UNSET, words=True),
                Cell(", ".join(sorted(one.files)) or UNSET, words=True),
            ],
        )
        for one in run.everything
    ]
    columns = ["rows", "source of the gains", "SHA-256 of the telemetry, its beginning", "files"]
    tables.append(Table("Flights: the same command gives the same telemetry", "gain set", columns, flights))
    return Section("repeat", "To repeat this run", lead, tables=[table for table in tables if table.rows])


def _airframe(vehicle: Mapping[str, Any]) -> Table:
    rows = [
        Line(
            name,
            [
                Cell(_text(value)),
                Cell(vehicle["derivative_units"].get(name, ""), words=True),
                Cell(_text(vehicle["sigma_pct"].get(name))),
            ],
        )
        for name, value in vehicle["derivatives"].items()
    ]
    return Table("Derivatives, per unit of normalised roll torque", "derivative", ["value", "unit", "sigma [%]"], rows)


def _facts(caption: str, facts: Iterable[tuple[str, Any]]) -> Table:
    rows = [Line(name, [Cell(_text(value), words=True)]) for name, value in facts if value not in (None, "", UNSET)]
    return Table(caption, "what", ["value"], rows)


def _settings(manoeuvre: Mapping[str, Any]) -> Cell:
    shown = (f"{name} {_text(value)}" for name, value in manoeuvre["settings"].items() if name != "kind")
    return Cell(", ".join(shown) or UNSET, words=True)


def _named(name: str, more: str | None) -> str:
    return f"{name} ({more})" if name and more and more != name else name or more or ""


def _with(value: float | None, unit: str) -> str:
    return UNSET if value is None else f"{value:g} {unit}"


def _text(value: Any) -> str:
    if value is None:
        return UNSET
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return " ".join(_text(one) for one in value)
    return str(value)
