"""Sections of what was flown: numbers, steps, tracks, parameters, a real autopilot beside our own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from scenarios.gain_set import load_gain_sets
from scenarios.markdown import ROLL_GAINS
from scenarios.report.canvas import Drawing
from scenarios.report.elements import UNSET, Cell, Figure, Line, Section, Set, Sets, Table, heading, metric_cell
from scenarios.report.flight_figures import (
    Drawn,
    step_figure,
    step_id,
    step_overlay,
    track_end_deg,
    track_figure,
    track_id,
)
from scenarios.report.verdict import is_recorded, limits_of, title
from scenarios.report.windows import MARKED, StepTrace, segments_of, step_trace, track_trace
from sitl.errors import FroudeError

if TYPE_CHECKING:
    from scenarios.telemetry import Telemetry

MAIN = (
    "overshoot_pct",
    "rise_time_s",
    "settling_time_5pct_s",
    "settling_time_2pct_s",
    "droop_deg",
    "vaf_pct",
    "rms_error_deg",
    "oscillation_rad_s",
    "oscillation_hz",
    "peak_delta_lat",
    "delay_margin_s",
)
"""Columns of the first table; what else is limited follows."""

MOST_SEGMENTS = 4
"""So many steps and so many tracks are drawn; of the others the table tells."""

Telemetries = Mapping[int, "Telemetry | None"]
Trace = TypeVar("Trace")


def numbers_section(sets: Sets) -> Section:
    """Every gain set's numbers beside their limits, and why some are missing."""
    asked = limits_of(sets.run.data)
    limits: dict[str, str] = {}
    for one in sets.all:
        for metric in one.data["metrics"]:
            if metric["limit"] and not metric["segment"]:
                limits.setdefault(metric["name"], asked.get(metric["name"], metric["limit"]))
    measured = {m["name"] for one in sets.all for m in one.data["metrics"] if m["value"] is not None}
    names = [name for name in MAIN if name in measured or name in limits]
    names += [name for name in limits if name not in names]
    rows = [Line("limit", [Cell(UNSET), *(Cell(limits.get(name, UNSET)) for name in names)])] if limits else []
    rows += [
        Line(one.name, [Cell(one.outcome, one.outcome, words=True), *_cells(one, names)], one.style) for one in sets.all
    ]
    table = Table(
        "Measured on the flight, the worst of its segments; margins are computed",
        "gain set",
        ["verdict", *(heading(name) for name in names)],
        rows,
    )
    return Section("numbers", "The numbers", tables=[table], notes=_blanks(sets, names))


def _cells(one: Set, names: Sequence[str], segment: str = "") -> list[Cell]:
    return [metric_cell(one.flight.metric(name, segment)) for name in names]


def _blanks(sets: Sets, names: Sequence[str], segment: str = "") -> list[str]:
    """Why cells are empty: a line per reason, naming columns and gain sets."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for one in sets.all:
        blank: dict[str, list[str]] = {}
        for name in names:
            metric = one.flight.metric(name, segment)
            # what the verdict says already is not said twice; of a segment alone it is
            told = not segment and metric is not None and metric["reason"] in one.data["reason"]
            if metric is not None and metric["value"] is None and metric["reason"] and not told:
                blank.setdefault(metric["reason"], []).append(title(name))
        for reason, columns in blank.items():
            reasons.setdefault((reason, ", ".join(columns)), []).append(one.name)
    return [f"{UNSET} {columns} ({', '.join(who)}): {reason}" for (reason, columns), who in reasons.items()]


def step_sections(sets: Sets, telemetry: Telemetries) -> list[Section]:
    """Every step: all gain sets on one time axis, each alone with its marks, and the numbers."""
    names = segments_of((one.data for one in sets.all), "step")
    made = []
    for place, name in enumerate(names[:MOST_SEGMENTS]):
        drawn = _traced(sets, telemetry, name, step_trace)
        lead = [
            "Roll over time from the moment the set-point stepped, in the direction of the step. Grey line: the "
            "set-point; band: 5 % of the step around it; dotted: 2 %."
        ]
        if not drawn:
            made.append(Section(f"step-{place}", _heading("Step response", name, names), _nothing_recorded()))
            continue
        overlay = step_overlay([Drawn(one.name, one.style, one.passed, trace) for one, trace in drawn], f"steps{place}")
        caption = "Thick: passes."
        wide = [Figure(f"steps-{place}", "All gain sets", overlay.svg, overlay.label, caption=caption)]
        if len(drawn) == 1:
            wide = []  # the one is shown alone anyway
        grid = []
        owns = _own_traces(sets, name)
        for one, trace in drawn:
            own = owns.get(one.flight.name)
            figure = step_figure(trace, one.style, one.name, step_id(place, one.number), own)
            beside = "" if own is None else "Dashed and thin: our own autopilot with the same gains."
            grid.append(_figure(f"step-{place}-{one.number}", one, figure, beside))
        columns = (*MARKED, "droop_deg", "peak_delta_lat", "oscillation_rad_s")
        shown = [name_ for name_ in columns if any(one.flight.metric(name_, name) for one in sets.all)]
        table = Table(
            f"The step {name} in numbers; marked in the figures: R rise (10 to 90 %), O overshoot, 5 and 2 settling",
            "gain set",
            [heading(metric) for metric in shown],
            [Line(one.name, _cells(one, shown, name), one.style) for one in sets.all],
        )
        notes = [*_absent(sets, [one for one, _ in drawn]), *_blanks(sets, shown, name)]
        made.append(Section(f"step-{place}", _heading("Step response", name, names), lead, wide, grid, [table], notes))
    return made


def _traced(
    sets: Sets,
    telemetry: Telemetries,
    name: str,
    trace_of: Callable[[Mapping[str, Any], Telemetry, str], Trace | None],
) -> list[tuple[Set, Trace]]:
    """The gain sets that flew a segment, each with what it did there."""
    found = []
    for one in sets.all:
        rows = telemetry.get(one.number)
        trace = None if rows is None else trace_of(one.data, rows, name)
        if trace is not None:
            found.append((one, trace))
    return found


def track_sections(sets: Sets, telemetry: Telemetries) -> list[Section]:
    """Every track: set-point and roll of each gain set, and the numbers."""
    names = segments_of((one.data for one in sets.all), "track")
    made = []
    for place, name in enumerate(names[:MOST_SEGMENTS]):
        drawn = _traced(sets, telemetry, name, track_trace)
        if not drawn:
            made.append(Section(f"track-{place}", _heading("Tracking", name, names), _nothing_recorded()))
            continue
        most_deg = track_end_deg(trace for _, trace in drawn)
        grid = []
        for one, trace in drawn:
            figure = track_figure(trace, one.style, one.name, track_id(place, one.number), most_deg)
            grid.append(_figure(f"track-{place}-{one.number}", one, figure))
        columns = ("vaf_pct", "lag_s", "vaf_lag_removed_pct", "rms_error_deg", "peak_delta_lat")
        shown = [name_ for name_ in columns if any(one.flight.metric(name_, name) for one in sets.all)]
        table = Table(
            f"The track {name} in numbers",
            "gain set",
            [heading(metric) for metric in shown],
            [Line(one.name, _cells(one, shown, name), one.style) for one in sets.all],
        )
        lead = ["Broad grey line: the roll set-point that the vehicle reports; thin line: its roll angle."]
        notes = [*_absent(sets, [one for one, _ in drawn]), *_blanks(sets, shown, name)]
        made.append(
            Section(f"track-{place}", _heading("Tracking", name, names), lead, (), grid, [table], notes),
        )
    return made


def _heading(what: str, name: str, names: Sequence[str]) -> str:
    return what if len(names) == 1 else f"{what}: {name}"


def _nothing_recorded() -> list[str]:
    return ["Nothing of it can be drawn: no telemetry of it is on disk."]


def _absent(sets: Sets, drawn: Sequence[Set]) -> list[str]:
    """Of which gain sets there is nothing to draw, and what became of their flights."""
    return [
        f"{one.name} is not drawn, its flight did not come to it, or no telemetry of it is on disk"
        + (f": {one.data['reason']}" if one.data["reason"] else "")
        for one in sets.all
        if one not in drawn
    ]


def _own_traces(sets: Sets, segment: str) -> dict[str, StepTrace]:
    """Of our own autopilot, where a real one flew."""
    found = {}
    for own in sets.run.owns:
        rows = sets.run.telemetry(own)
        trace = None if rows is None else step_trace(own.data, rows, segment)
        if trace is not None:
            found[own.name] = trace
    return found


def _figure(name: str, one: Set, drawing: Drawing, caption: str = "") -> Figure:
    return Figure(name, one.name, drawing.svg, drawing.label, one.style, one.outcome, caption)


def parameters_section(sets: Sets) -> Section:
    """What each flight set, beside what the vehicle had before it."""
    recorded = is_recorded(sets.run.data)
    had: dict[int, Mapping[str, float]] = {}
    notes = []
    for one in sets.all:
        file = one.flight.files.get("backup.params")
        if file is None and recorded:
            continue
        if file is None:
            notes.append(f"{one.name}: what the vehicle had before is not on disk (no backup of its parameters)")
            continue
        try:
            (found,) = load_gain_sets(file)
            had[one.number] = found.parameters
        except (FroudeError, ValueError) as error:
            notes.append(f"{one.name}: the backup of the vehicle's parameters cannot be read: {error}")
    flown = {one.number: one.data["uploaded"] or one.data["gain_set"]["parameters"] for one in sets.all}
    names = sorted({name for values in flown.values() for name in values}, key=_parameter_order)
    rows = []
    for name in names:
        before = {format(values[name], "g") for values in had.values() if name in values}
        cells = [Cell(" or ".join(sorted(before)) or UNSET)]
        for one in sets.all:
            value = flown[one.number].get(name)
            old = had.get(one.number, {}).get(name)
            changed = value is not None and old is not None and format(value, "g") != format(old, "g")
            text = UNSET if value is None else f"{value:g}"
            cells.append(Cell(f"{text} ({_change(old, value)})" if changed else text, strong=changed))
        if any(cell.strong for cell in cells) or name in ROLL_GAINS or not had:
            rows.append(Line(name, cells))
    if len(rows) < len(names):
        notes.append(f"{len(names) - len(rows)} parameters that were set to what the vehicle had already are left out")
    table = Table(
        "Parameters as flown; bold: other than the vehicle had, with the change",
        "parameter",
        ["vehicle had", *(one.name for one in sets.all)],
        rows,
    )
    if recorded:
        lead = ["As the log has them. What the vehicle had before is not known: nothing was uploaded for this flight."]
        return Section("parameters", "Parameters", lead, tables=[table], notes=notes)
    lead = ["After its flight the vehicle got back what it had before (<gain set>.backup.params in flights/)."]
    return Section("parameters", "Parameters beside the vehicle's backup", lead, tables=[table], notes=notes)


def _parameter_order(name: str) -> tuple[int, str]:
    return (ROLL_GAINS.index(name) if name in ROLL_GAINS else len(ROLL_GAINS), name)


def _change(old: float | None, new: float | None) -> str:
    if not old or new is None:
        return f"{(new or 0.0) - (old or 0.0):+g}"
    ratio = new / old
    return f"× {ratio:.3g}" if ratio > 0.0 else f"{new - old:+g}"


def twins_section(sets: Sets) -> Section | None:
    """A real autopilot beside our own; None where there was none."""
    twins = sets.run.data["twins"]
    if not twins:
        return None
    agree = sum(twin["agree"] for twin in twins)
    recorded = is_recorded(sets.run.data)
    flew = (
        "On the model our own autopilot flew the gains and set-points that were recorded"
        if recorded
        else "A real autopilot flew the plant, and our own flew the same again"
    )
    lead = [
        f"{flew}: they agree within what is tolerated for "
        f"{agree} of {len(twins)} gain set{'' if len(twins) == 1 else 's'}. A difference is the real one's minus ours."
    ]
    tables = []
    for twin in twins:
        rows = [
            Line(_quantity_name(one), _quantity_cells(one))
            for one in twin["quantities"]
            if one["real"] is not None or one["own"] is not None
        ]
        agrees = "agree" if twin["agree"] else "differ"
        caption = f"{twin['gain_set']}: they {agrees}; verdict {twin['outcome']}, with our own {twin['own_outcome']}"
        tables.append(Table(caption, "quantity", ["real", "own", "difference", "tolerated", "within"], rows))
    heading_ = "What was recorded beside our own autopilot" if recorded else "The real autopilot beside our own"
    return Section("twins", heading_, lead, tables=tables, notes=list(_alone(twins)))


def _quantity_name(one: Mapping[str, Any]) -> str:
    where = f", {one['segment']}" if one["segment"] else ""
    return f"{one['meaning'] or one['name']}{where}"


def _quantity_cells(one: Mapping[str, Any]) -> list[Cell]:
    unit = "" if one["unit"] == "1" else f" {one['unit']}"
    within = {True: "yes", False: "NO", None: UNSET}[one["within"]]
    outcome = {True: "PASS", False: "FAIL", None: ""}[one["within"]]
    tolerance = UNSET if one["tolerance"] is None else f"{one['tolerance']:g}{unit}"
    difference = UNSET if one["difference"] is None else f"{one['difference']:+.3g}{unit}"
    return [
        *(Cell(UNSET if one[who] is None else f"{one[who]:.4g}") for who in ("real", "own")),
        Cell(difference),
        Cell(tolerance),
        Cell(within, outcome, words=True),
    ]


def _alone(twins: Iterable[Mapping[str, Any]]) -> Iterable[str]:
    for twin in twins:
        if twin["alone"]:
            yield f"{twin['gain_set']}: only one of the two came to {', '.join(twin['alone'])}"
        if twin["own"]["reason"]:
            yield f"{twin['gain_set']}, our own autopilot: {twin['own']['reason']}"


def warnings_section(sets: Sets) -> Section | None:
    """What the flights warned of; None if of nothing."""
    notes = [f"{one.name}: {'; '.join(one.data['warnings'])}" for one in sets.all if one.data["warnings"]]
    return Section("warnings", "Warnings of the flights", notes=notes) if notes else None
