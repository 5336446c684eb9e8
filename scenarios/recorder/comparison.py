"""All candidates of a run over each other, every manoeuvre from its own start.

The viewer cannot lay recordings over each other, so a run gets one more recording with everything in it.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scenarios import markdown
from scenarios.limits import LIMIT_CYCLE_RAD_S, Outcome
from scenarios.recorder import blueprints
from scenarios.recorder.blueprints import (
    BEFORE_S,
    LIMIT,
    PALETTE,
    RANKS,
    SETPOINT,
    TWIN_WIDTH,
    Page,
    candidate_colour,
    twin_colour,
)
from scenarios.recorder.compare_layout import ComparePage, compare_blueprint
from scenarios.recorder.flight_plots import DEG
from scenarios.recorder.flight_properties import flight_properties
from scenarios.recorder.spread import NAME as BAND_NAME
from scenarios.recorder.spread import Spread, spreads
from scenarios.recorder.stream import FileRecording, Recording

if TYPE_CHECKING:
    from scenarios.flight import FlightRecord, RunRecord, Segment

APPLICATION_ID = "froude-compare"
"""The viewer keeps one layout per application id, so comparisons need their own."""

DASHES, DASH = 90, 0.6
"""Dashes over the width of a page, and the share of each that is drawn."""

OSCILLATING = (110, 110, 110, 110)
"""Colour of those that share a line of the legend."""

BAND = 0.05
"""Half width of the settling band that is drawn, of the step's amplitude."""


def record_compare(run: RunRecord, path: Path) -> Path:
    """Write the comparison of a run.

    Args:
        run: flights with telemetry and segments; a flight that never reached a manoeuvre is only in the
            table.
        path: `compare.rrd`.

    Returns:
        The finished file.

    Raises:
        FileError: it cannot be written.
    """
    from scenarios import twin_table

    recording = FileRecording(
        path,
        application_id=APPLICATION_ID,
        recording_id=f"{run.scenario.name}-{run.started_utc}-compare",
        name=f"{run.scenario.name}: {run.vehicle.get('name', run.scenario.vehicle)}",
    )
    manoeuvres = dict.fromkeys(segment.manoeuvre for flight in run.flights for segment in flight.segments)
    ranks, best = _ranks(run.flights), best_flight(run.flights)
    looks = _looks(run.flights, ranks)
    bands = spreads(run.scenario, run.flights)
    pages = []
    for number, manoeuvre in enumerate(manoeuvres, start=1):
        parts = _parts(run.flights, ranks, manoeuvre, [twin.own for twin in run.twins])
        if parts:
            prefix = f"/{number}_" + re.sub(r"[^A-Za-z0-9_-]+", "_", manoeuvre)
            page = _write_manoeuvre(recording, prefix, manoeuvre, parts, looks)
            spread = _write_spread(recording, prefix, parts, looks, bands.get(manoeuvre))
            quiet = tuple(entity for entity, rank in spread if rank != "oscillates")
            pages.append(ComparePage(prefix, page, quiet, spread=bool(spread)))
    best_name = best.gain_set.name if best is not None else ""
    recording.document("/summary", _summary(run, ranks, best_name))
    recording.document("/circumstances", markdown.circumstances(run))
    for flight in run.flights:
        recording.properties(flight_properties(flight, prefix=f"{flight.gain_set.slug}_"))
    recording.properties({"run": _run_properties(run, best_name)})
    if run.twins:
        recording.document("/twins", twin_table.markdown(run.twins))
    title = f"Best: {best_name}" if best_name else "None passes"
    if len(run.flights) == 1:
        title = f"{run.flights[0].gain_set.name}: {run.flights[0].outcome}"
    recording.layout(compare_blueprint(pages, title, twins=bool(run.twins)))
    return recording.finish()


def best_flight(flights: Sequence[FlightRecord]) -> FlightRecord | None:
    """Of those that pass, the closest to its set-point: least RMS error, without tracking shortest rise."""
    passed = [flight for flight in flights if flight.outcome is Outcome.PASS]

    def rank(flight: FlightRecord) -> tuple[float, float]:
        values = [flight.metric(name) for name in ("rms_error_deg", "rise_time_s")]
        error, rise = (np.inf if metric is None or metric.value is None else metric.value for metric in values)
        return error, rise

    return min(passed, key=rank) if passed else None


def _ranks(flights: Sequence[FlightRecord]) -> list[str]:
    best = best_flight(flights)

    def rank(flight: FlightRecord) -> str:
        if flight is best:
            return "best"
        if flight.outcome is Outcome.FAIL:
            return "oscillates" if _oscillates(flight) else "failed"
        return "failed" if flight.outcome is Outcome.UNSET else "passed"

    return [rank(flight) for flight in flights]


@dataclass(frozen=True)
class _Look:
    """How a candidate is shown: hue, and a name of its own or None for one that it shares in the legend."""

    hue: int
    name: str | None


def _looks(flights: Sequence[FlightRecord], ranks: Sequence[str]) -> list[_Look]:
    """A legend has room for as many lines as there are hues: of more, those that oscillate share one."""
    if len(flights) <= len(PALETTE):
        return [_Look(number, flight.gain_set.name) for number, flight in enumerate(flights)]
    order = sorted(range(len(flights)), key=lambda n: -list(RANKS).index(ranks[n]))
    hues = {number: hue for hue, number in enumerate(order)}
    return [
        _Look(hues[number], None if rank == "oscillates" else flight.gain_set.name)
        for number, (flight, rank) in enumerate(zip(flights, ranks, strict=True))
    ]


def _summary(run: RunRecord, ranks: Sequence[str], best: str) -> str:
    """The winner, every verdict and metric with the best first, then margins and gains."""
    order = sorted(range(len(ranks)), key=lambda n: -list(RANKS).index(ranks[n]))
    ordered = dataclasses.replace(run, flights=tuple(run.flights[n] for n in order))
    head = f"## Best: {best}, of those that pass the closest to its set-point" if best else "## No gain set passes"
    if len(ranks) == 1:
        head = f"## {run.flights[0].gain_set.name}: {run.flights[0].outcome}"
    return f"{head}\n\n{markdown.verdicts(ordered)}\n{markdown.margins_and_gains(ordered.flights)}\n"


def _run_properties(run: RunRecord, best: str) -> dict[str, Any]:
    """Facts on the run."""
    return {
        "scenario": run.scenario.name,
        "vehicle": run.scenario.vehicle,
        "profile": run.scenario.profile,
        "seed": run.scenario.seed,
        "started_utc": run.started_utc,
        "gain_sets": len(run.flights),
        "passed": sum(flight.outcome is Outcome.PASS for flight in run.flights),
        "best": best or None,
        "complete": str(run.complete),
    }


@dataclass(frozen=True)
class _Part:
    """One flight's rows of one manoeuvre, time counted from its start; `own`: of our autopilot beside a real one."""

    flight: FlightRecord
    number: int
    rank: str
    segments: tuple[Segment, ...]
    time: NDArray[np.float64]
    phi_sp_deg: NDArray[np.float64]
    phi_deg: NDArray[np.float64]
    p_rad_s: NDArray[np.float64]
    delta_lat: NDArray[np.float64]
    own: bool = False

    @property
    def dashed(self) -> bool:
        """A line of its own kind, where one can see it: what oscillates is all edges already."""
        return self.own and self.rank != "oscillates"

    @property
    def width(self) -> float:
        """Of its line."""
        return TWIN_WIDTH if self.own else RANKS[self.rank]

    @property
    def duration_s(self) -> float:
        return self.segments[-1].end_s - self.segments[0].start_s

    @property
    def error_deg(self) -> NDArray[np.float64]:
        return self.phi_sp_deg - self.phi_deg


def _parts(
    flights: Sequence[FlightRecord], ranks: Sequence[str], manoeuvre: str, twins: Sequence[FlightRecord] = ()
) -> list[_Part]:
    """Of every flight that came to the manoeuvre, the last to be drawn on top last; own ones right after the real."""
    owns = {twin.gain_set.slug: twin for twin in twins}
    parts = []
    for number, (flight, rank) in enumerate(zip(flights, ranks, strict=True)):
        own = owns.get(flight.gain_set.slug)
        parts += [_part(flight, number, rank, manoeuvre)]
        if own is not None:
            quiet = rank if rank != "oscillates" else "passed"
            parts += [_part(own, number, "oscillates" if _oscillates(own) else quiet, manoeuvre, own=True)]
    order = list(RANKS)
    known = [part for part in parts if part is not None]
    return sorted(known, key=lambda part: (order.index(part.rank), part.number, part.own))


def _part(flight: FlightRecord, number: int, rank: str, manoeuvre: str, *, own: bool = False) -> _Part | None:
    segments = tuple(segment for segment in flight.segments if segment.manoeuvre == manoeuvre)
    if not segments:
        return None
    start = segments[0].start_s
    rows = flight.telemetry.between(start - BEFORE_S, segments[-1].end_s)
    if not len(rows):
        return None
    names = ("phi_sp_rad", "phi_rad", "p_rad_s", "delta_lat")
    phi_sp, phi, p, delta_lat = (rows[name].astype(np.float64) for name in names)
    return _Part(
        *(flight, number, rank, segments, rows["t_s"] - start, phi_sp * DEG, phi * DEG, p, delta_lat),
        own=own,
    )


def _write_manoeuvre(
    recording: Recording, prefix: str, manoeuvre: str, parts: Sequence[_Part], looks: Sequence[_Look]
) -> Page:
    """Every flight's part of one manoeuvre; returns its page."""
    # A flight that was broken off shows only the beginning of the set-point.
    longest = max((part for part in parts if not part.own), key=lambda part: part.duration_s, default=parts[0])
    tracking = any(segment.kind == "track" for segment in longest.segments)
    _write_setpoint(recording, prefix, longest)
    for place, part in enumerate(parts, start=1):
        look = looks[part.number]
        best = ", best" if part.rank == "best" and not part.own and len(looks) > 1 else ""
        who = ", own autopilot" if part.own else ""
        shared = f"{sum(one.name is None for one in looks)} sets that oscillate"
        name = f"{look.name or shared}{who}: {part.flight.outcome}{best}"
        for quantity, unit, values in (
            ("roll", "deg", part.phi_deg),
            ("error", "deg", part.error_deg),
            ("roll_rate", "rad/s", part.p_rad_s),
            ("delta_lat", "-", part.delta_lat),
        ):
            entity = f"{prefix}/{quantity}/{place:02d}_{part.flight.gain_set.slug}" + ("_own" if part.own else "")
            colour = OSCILLATING if look.name is None else _colour(part, look)
            recording.style(entity, [f"{name} [{unit}]"], [colour], widths=[part.width])
            recording.lines(entity, part.time, _dashed(part.time, values) if part.dashed else values)
    quiet = [part for part in parts if not _oscillates(part.flight)]
    return Page(
        manoeuvre,
        -BEFORE_S,
        longest.duration_s,
        roll_deg=blueprints.roll_range_deg(
            longest.phi_sp_deg, np.concatenate([part.phi_deg for part in parts]), spans=0.5
        ),
        rate_rad_s=_range([part.p_rad_s for part in quiet]),
        error_deg=_range([part.error_deg for part in quiet]),
        delta_lat=_range([part.delta_lat for part in quiet]),
        tracking=tracking,
    )


def _colour(part: _Part, look: _Look) -> tuple[int, int, int, int]:
    return (twin_colour if part.own else candidate_colour)(look.hue, part.rank)


def _write_spread(
    recording: Recording, prefix: str, parts: Sequence[_Part], looks: Sequence[_Look], spread: Spread | None
) -> list[tuple[str, str]]:
    """The band of each candidate that has one; returns (entity, rank)."""
    written = []
    for place, part in enumerate(parts, start=1):
        slug = part.flight.gain_set.slug
        if spread is None or part.own or slug not in spread.low_rad:
            continue
        entity = f"{prefix}/spread/{place:02d}_{slug}"
        look = looks[part.number]
        # one name: in the legend they share a line; the viewer makes bands transparent by itself
        recording.band(entity, BAND_NAME, OSCILLATING[:3] if look.name is None else _colour(part, look)[:3])
        recording.between(entity, spread.t_s, spread.low_rad[slug] * DEG, spread.high_rad[slug] * DEG)
        written.append((entity, part.rank))
    return written


def _dashed(time: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaps in a line, `DASHES` of them; the viewer has no dashed lines of its own."""
    phase = (time - time[0]) * DASHES / (time[-1] - time[0] + 1e-9) % 1.0
    return np.where(phase < DASH, values, np.nan)


def _write_setpoint(recording: Recording, prefix: str, part: _Part) -> None:
    """The set-point, and the band around the target of each scored step."""
    entity = f"{prefix}/roll/00_setpoint"
    recording.style(entity, ["set-point [deg]"], [SETPOINT], widths=[2.0], step=True)
    recording.lines(entity, part.time, part.phi_sp_deg)
    begin = part.segments[0].start_s
    for number, segment in enumerate(segment for segment in part.segments if segment.kind == "step"):
        entity = f"{prefix}/roll/00_band_{number}"
        names = [f"within {100 * BAND:g} % of the step [deg]"] * 2
        half = BAND * abs(segment.amplitude_rad)
        edges = np.array([segment.phi_to_rad + half, segment.phi_to_rad - half]) * DEG
        recording.style(entity, names, [LIMIT, LIMIT], widths=[1.0, 1.0])
        times = np.array([segment.start_s, segment.end_s]) - begin
        recording.lines(entity, times, np.array([edges, edges]))


def _oscillates(flight: FlightRecord) -> bool:
    metric = flight.metric("oscillation_rad_s")
    return metric is None or metric.value is None or metric.value > LIMIT_CYCLE_RAD_S


def _range(parts: Sequence[NDArray[np.float64]]) -> tuple[float, float] | None:
    """Axis for the flights that do not oscillate; the others would make them a flat line."""
    values = np.concatenate([np.zeros(0), *parts])
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    low, high = float(values.min()), float(values.max())
    margin = 0.3 * (high - low)
    return (low - margin, high + margin) if margin > 0.0 else None
