"""A recorded flight's segments scored and judged as flown ones are: the same functions, and no others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scenarios.flight import FlightRecord
from scenarios.flight_import.loop_parameters import Group
from scenarios.flight_import.recorded import Recorded
from scenarios.limits import Limit, judge
from scenarios.score import diverged, flight_metrics
from scenarios.telemetry import NO_SEGMENT, Telemetry
from sitl.airframe import Rotor

PICTURE = tuple(Rotor(x, y, 0.0, 0.05 if x * y > 0 else -0.05) for x, y in ((1, 1), (-1, -1), (1, -1), (-1, 1)))
"""Drawn where no geometry is known; nothing is computed from it."""


def flight_record(
    recorded: Recorded,
    group: Group,
    *,
    limits: Sequence[Limit],
    spec: str = "recorded",
    margins: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> FlightRecord:
    """Score and judge what was flown with one set of gains.

    Args:
        recorded: the flight. group: its segments and gains. limits: to judge by; empty for none.
        spec: of the model that is looked at beside it. margins: of these gains on that model.
        notes: what is to be known when its metrics are read, beside the log's own.
    """
    telemetry = _marked(recorded.telemetry, group)
    metrics = flight_metrics(telemetry, group.segments, margins)
    outcome, reason, metrics = judge(metrics, limits, diverged(telemetry))
    return FlightRecord(
        gain_set=group.gain_set,
        vehicle_spec=spec,
        telemetry=telemetry,
        segments=group.segments,
        events=recorded.events,
        metrics=metrics,
        margins=dict(margins or {}),
        outcome=outcome,
        reason=reason,
        warnings=(*recorded.notes, *notes),
        telemetry_sha256=telemetry.sha256(),
        seed=0,
        parameters=dict(group.gain_set.parameters),
    )


def _marked(telemetry: Telemetry, group: Group) -> Telemetry:
    """The telemetry with its column `segment`."""
    t = telemetry["t_s"]
    segment = np.full(len(t), NO_SEGMENT, dtype=np.int16)
    for index, part in enumerate(group.segments):
        segment[(t >= part.start_s - 1e-9) & (t < part.end_s - 1e-9)] = index
    return Telemetry.from_columns({**telemetry.columns, "segment": segment})


def write_flight(record: FlightRecord, folder: Path, rotors: Sequence[Rotor]) -> None:
    """Telemetry, recording and parameters of one flight, named like those of a flown one.

    Args:
        record: the flight. folder: of the flights. rotors: to draw; empty where they are not known.

    Raises:
        FileError: something cannot be written.
    """
    from scenarios.gain_set import save_params
    from scenarios.markdown import flight_page
    from scenarios.recorder import FlightRecorder
    from scenarios.recorder.flight_drawing import FlownVehicle
    from scenarios.recorder.flight_properties import flight_properties

    slug = record.gain_set.slug
    about = {"gain_set": record.gain_set.name, "vehicle": record.vehicle_spec}
    record.telemetry.to_parquet(folder / f"{slug}.parquet", about)
    if record.parameters:
        save_params(folder / f"{slug}.params", record.parameters)
    with FlightRecorder(
        folder / f"{slug}.rrd",
        name=record.gain_set.name,
        recording_id=f"{folder.parent.name}-{slug}",
        vehicle=FlownVehicle(rotors or PICTURE),
    ) as recorder:
        recorder.append(record.telemetry.columns)
        for event in record.events:
            recorder.event(event.t_s, event.severity, event.text)
        for segment in record.segments:
            recorder.segment(segment)
        recorder.close(flight_page(record), flight_properties(record))
