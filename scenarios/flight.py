"""The record of a flight and of a run: filled by the runner, read by every report and recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from scenarios.gain_set import GainSet
from scenarios.injected_fault import InjectedFault
from scenarios.limits import Metric, Outcome
from scenarios.scenario import Scenario
from scenarios.telemetry import Telemetry

if TYPE_CHECKING:
    from scenarios.twin import Twin


@dataclass(frozen=True)
class Segment:
    """A part of the flight that is measured: one window of one manoeuvre, in vehicle time.

    Attributes:
        name: unique in the flight, `<manoeuvre>` or `<manoeuvre>/<n>`.
        kind: "step" (scored as a step), "hold" (oscillation only) or "track" (set-point following).
        manoeuvre: name of the manoeuvre it belongs to.
        start_s: vehicle time since boot at which its first set-point was sent.
        end_s: vehicle time at which the next window's first set-point was sent.
        amplitude_rad: signed change of the roll set-point at the start (step, hold) or its peak (track).
        phi_from_rad: roll set-point before the start.
    """

    name: str
    kind: str
    manoeuvre: str
    start_s: float
    end_s: float
    amplitude_rad: float
    phi_from_rad: float

    @property
    def phi_to_rad(self) -> float:
        """Roll set-point that a step or hold asks for."""
        return self.phi_from_rad + self.amplitude_rad


@dataclass(frozen=True)
class Event:
    """Something said during the flight: a STATUSTEXT of the vehicle, or a phase of the runner.

    Attributes:
        t_s: vehicle time since boot.
        severity: MAV_SEVERITY, 0 emergency to 7 debug.
        text: as sent.
    """

    t_s: float
    severity: int
    text: str


@dataclass(frozen=True)
class FlightRecord:
    """One gain set flown through one scenario.

    Attributes:
        gain_set: what was tried.
        vehicle_spec: `ant-x`, or `ant-r:ant-x` for a scaled model.
        telemetry: one row per ATTITUDE message.
        segments: in order of time; the telemetry's `segment` column points into it.
        events: in order of time.
        metrics: of the whole flight (`segment` empty) and of each segment.
        margins: loop margins of this gain set on this vehicle (`sitl.stability.Margins` as a mapping);
            empty if not computed.
        outcome: the verdict, with `reason` in one line.
        warnings: out-of-range parameters and the like; flown anyway.
        telemetry_sha256: `telemetry.sha256()`.
        seed: of this flight's sensors and link.
        parameters: everything that was uploaded, the other axes' gains too.
        timing: how a real autopilot and our plant kept time, in a line; empty where none flew it.
        faults: of the scenario, in its order: what became of each.
    """

    gain_set: GainSet
    vehicle_spec: str
    telemetry: Telemetry
    segments: tuple[Segment, ...]
    events: tuple[Event, ...]
    metrics: tuple[Metric, ...]
    margins: Mapping[str, Any]
    outcome: Outcome
    reason: str
    warnings: tuple[str, ...]
    telemetry_sha256: str
    seed: int
    parameters: Mapping[str, float | int] = field(default_factory=dict)
    timing: str = ""
    faults: tuple[InjectedFault, ...] = ()

    def metric(self, name: str, segment: str = "") -> Metric | None:
        """The flight's metric of that name, or one segment's; None if it was not asked for."""
        for metric in self.metrics:
            if metric.name == name and metric.segment == segment:
                return metric
        return None


@dataclass(frozen=True)
class RunRecord:
    """All flights of one command.

    Attributes:
        scenario: as flown, after the command line's changes.
        vehicle: the model's description: derivatives, sigma, scaling, assumptions.
        profile: every item of the fidelity profile as (item, value, unit).
        flights: one per gain set, in the order asked for.
        baseline: the airframe's own flight gains, flown under the same assumptions; None if they are among
            `flights` or not known. If they do not fly, the assumptions are wrong, not the candidates.
        started_utc: ISO 8601; in no hash.
        versions: program and libraries.
        complete: False if the run was interrupted.
        twins: where a real autopilot flew our plant: its flights beside those of our own, the baseline's too.
    """

    scenario: Scenario
    vehicle: Mapping[str, Any]
    profile: tuple[tuple[str, Any, str], ...]
    flights: tuple[FlightRecord, ...]
    baseline: FlightRecord | None = None
    started_utc: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    complete: bool = True
    twins: tuple[Twin, ...] = ()
