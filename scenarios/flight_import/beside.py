"""A recorded flight flown again by our own autopilot: the same gains, filters and roll set-points on a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenarios.flight import FlightRecord
from scenarios.flight_import.loop_parameters import UNKNOWN, Group
from scenarios.flight_import.recorded import Recorded
from scenarios.flight_import.series import FloatArray
from scenarios.flight_import.step_finder import LEVEL_RAD, Found
from scenarios.manoeuvres import RECORDED, Manoeuvre, Window

if TYPE_CHECKING:
    from scenarios.flight_job import FlightJob
    from scenarios.scenario import Scenario
    from sitl.profile import Profile
    from sitl.vehicle_spec import VehicleModel

LEAD_S = 2.0
"""How long the level before the first movement is held, where it was not level."""


@dataclass(frozen=True)
class Replay:
    """A recorded signal, held from sample to sample.

    Attributes:
        duration_s: length. at_s: (n,) local times, the first one 0. values_rad: (n,).
    """

    duration_s: float
    at_s: FloatArray
    values_rad: FloatArray

    def values(self, t_s: FloatArray) -> FloatArray:
        """Roll set-point in rad at local times, shape of t_s."""
        at = np.searchsorted(self.at_s, t_s + 1e-6, side="right") - 1
        return np.asarray(self.values_rad[np.maximum(at, 0)])


def replayed(recorded: Recorded, found: Found, group: Group, rate_hz: float) -> tuple[Manoeuvre, ...]:
    """The manoeuvres of a group of segments as they were recorded, with windows of the same names.

    Args:
        recorded: the flight. found: when each manoeuvre begins. group: what to replay. rate_hz: of the set-points.
    """
    made = []
    for name in dict.fromkeys(segment.manoeuvre for segment in group.segments):
        parts = [segment for segment in group.segments if segment.manoeuvre == name]
        first = parts[0]
        lead_s = LEAD_S if abs(first.phi_from_rad) > LEVEL_RAD else 0.0
        begin_s = min(found.begins[name], first.start_s)

        def due(t_s: float, begin_s: float = begin_s, lead_s: float = lead_s) -> float:
            """The set-point that is next at a recorded time, s from the manoeuvre's start."""
            return round((lead_s + t_s - begin_s) * rate_hz) / rate_hz

        windows = tuple(
            Window(
                kind=segment.kind,
                start_s=due(segment.start_s),
                end_s=due(segment.end_s),
                phi_from_rad=segment.phi_from_rad,
                phi_to_rad=segment.phi_to_rad if segment.kind != "track" else segment.amplitude_rad,
            )
            for segment in parts
        )
        duration_s = windows[-1].end_s
        part = _part(recorded, begin_s, lead_s, duration_s, first.phi_from_rad)
        made.append(Manoeuvre(name, RECORDED, (part,), windows))
    return tuple(made)


def _part(recorded: Recorded, begin_s: float, lead_s: float, duration_s: float, before_rad: float) -> Replay:
    t, phi_sp = recorded.setpoint.t_s, recorded.setpoint.values[:, 0]
    rows = (t > begin_s) & (t < begin_s + duration_s)
    # the change that begins it may have been logged after it came
    at = np.concatenate([[0.0], lead_s + t[rows] - begin_s])
    values = np.concatenate([[before_rad], phi_sp[rows]])
    if not lead_s and rows.any():
        later = np.flatnonzero(t >= begin_s - 1e-6)
        values[0] = phi_sp[later[0]] if len(later) else before_rad
    return Replay(duration_s, at, values)


def job_of(group: Group, scenario: Scenario, model: VehicleModel, profile: Profile) -> tuple[FlightJob | None, str]:
    """What flying the group's gains on a model means; None, with the reason, where it cannot be flown."""
    from scenarios.runner import plan
    from sitl.errors import UsageError

    if group.gain_set.note == UNKNOWN:
        return None, f"{UNKNOWN}: no margins, and nothing is flown beside it"
    try:
        job = plan(group.gain_set, scenario, model, profile)
    except UsageError as error:
        return None, f"not flown beside it: {error}"
    # what the log says of ranges and of pitch is no news about this flight
    return replace(job, warnings=()), ""


def fly_beside(
    job: FlightJob, folder: Path | None, progress: Callable[[str], object] = lambda _: None
) -> tuple[FlightRecord | None, BaseException | None]:
    """Fly the job with our own autopilot.

    Args:
        job: of `job_of`, its scenario with the recorded manoeuvres. folder: where the files go; None keeps nothing.
        progress: called with a short text at every phase.

    Returns:
        the flight, or what stopped it.
    """
    from scenarios.one_flight import FlightStoppedError, fly
    from scenarios.twin import OWN_SUFFIX

    try:
        return fly(replace(job, folder=folder, suffix=OWN_SUFFIX), progress), None
    except FlightStoppedError as stop:
        return None, stop.cause
