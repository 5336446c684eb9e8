"""What was flown, cut out of the telemetry for drawing: steps on one time axis with their marks, tracks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from scenarios.telemetry import Telemetry

FloatArray = npt.NDArray[np.float64]

BEFORE_S = 0.25
"""So much is shown before a step."""

MARKED = ("overshoot_pct", "rise_time_s", "settling_time_5pct_s", "settling_time_2pct_s")
BAND = {"settling_time_5pct_s": 0.05, "settling_time_2pct_s": 0.02}


@dataclass(frozen=True, eq=False)
class StepTrace:
    """One step of one flight; angles in deg from the set-point before it, in the direction of the step.

    Attributes:
        segment: its name. t_s: (n,) from the step. roll_deg: (n,). setpoint_deg: (n,) as the vehicle reports it.
        amplitude_deg: of the step, positive. duration_s: until the set-point changed again.
        metrics: name -> value in run.json; None where it was not measured. reasons: why not.
        from_s: when the rise begins, the first crossing of 10 %; None without a rise.
        peak: time and angle of the largest excess; None without an overshoot.
        faults: from when to when one was in force, s from the step.
    """

    segment: str
    t_s: FloatArray
    roll_deg: FloatArray
    setpoint_deg: FloatArray
    amplitude_deg: float
    duration_s: float
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)
    from_s: float | None = None
    peak: tuple[float, float] | None = None
    faults: Sequence[tuple[float, float]] = ()

    @property
    def rise(self) -> tuple[float, float] | None:
        """From when to when it rises from 10 to 90 %; as long as the metric says."""
        length_s = self.metrics.get("rise_time_s")
        return None if self.from_s is None or length_s is None else (self.from_s, self.from_s + length_s)


@dataclass(frozen=True, eq=False)
class TrackTrace:
    """One track of one flight.

    Attributes:
        segment: its name. t_s: (n,) from its start. roll_deg, setpoint_deg: (n,). duration_s: of it.
        metrics: name -> value in run.json. reasons: why not. faults: as for a step.
    """

    segment: str
    t_s: FloatArray
    roll_deg: FloatArray
    setpoint_deg: FloatArray
    duration_s: float
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)
    faults: Sequence[tuple[float, float]] = ()


def segments_of(flights: Iterable[Mapping[str, Any]], kind: str) -> list[str]:
    """Names of the segments of a kind, of all flights, in order.

    Args:
        flights: as in run.json. kind: "step" or "track".
    """
    return list(dict.fromkeys(one["name"] for flight in flights for one in flight["segments"] if one["kind"] == kind))


def step_trace(flight: Mapping[str, Any], telemetry: Telemetry, name: str) -> StepTrace | None:
    """One step.

    Args:
        flight: as in run.json. telemetry: of it. name: of the segment.

    Returns:
        None if the flight did not come to it, or nothing was recorded there.
    """
    segment = _segment(flight, name)
    if segment is None or not segment["amplitude_rad"]:
        return None
    start_s, end_s = segment["start_s"], segment["end_s"]
    rows = telemetry.between(start_s - BEFORE_S, end_s)
    if len(rows) < 2:
        return None
    t = rows["t_s"] - start_s
    amplitude = segment["amplitude_rad"]
    sign = math.copysign(1.0, amplitude)
    roll, setpoint = (
        sign * np.degrees(rows[column].astype(np.float64) - segment["phi_from_rad"])
        for column in ("phi_rad", "phi_sp_rad")
    )
    metrics, reasons = _metrics(flight, name, (*MARKED, "droop_deg"))
    size = math.degrees(abs(amplitude))
    after = (t >= -1e-6) & (t < end_s - start_s - 1e-6)
    t_after, done = t[after], roll[after] / size
    from_s, peak = None, None
    if metrics.get("rise_time_s") is not None:
        from_s = _first_crossing(t_after, done, 0.1)
    if metrics.get("overshoot_pct") and len(done):
        k = int(np.argmax(done))
        peak = float(t_after[k]), float(done[k] * size)
    faults = _faults(flight, segment)
    return StepTrace(name, t, roll, setpoint, size, end_s - start_s, metrics, reasons, from_s, peak, faults)


def track_trace(flight: Mapping[str, Any], telemetry: Telemetry, name: str) -> TrackTrace | None:
    """One track; arguments and result as `step_trace`."""
    segment = _segment(flight, name)
    if segment is None:
        return None
    rows = telemetry.between(segment["start_s"], segment["end_s"])
    if len(rows) < 2:
        return None
    roll, setpoint = (np.degrees(rows[column].astype(np.float64)) for column in ("phi_rad", "phi_sp_rad"))
    metrics, reasons = _metrics(flight, name, ("vaf_pct", "lag_s", "vaf_lag_removed_pct", "rms_error_deg"))
    length_s = segment["end_s"] - segment["start_s"]
    t, faults = rows["t_s"] - segment["start_s"], _faults(flight, segment)
    return TrackTrace(name, t, roll, setpoint, length_s, metrics, reasons, faults)


def _faults(flight: Mapping[str, Any], segment: Mapping[str, Any]) -> list[tuple[float, float]]:
    """From when to when faults were in force within a segment, s from its start; not those of its whole length."""
    start_s, end_s = segment["start_s"], segment["end_s"]
    spans = []
    for fault in flight["faults"]:
        if fault["start_s"] is not None:
            until_s = end_s if fault["end_s"] is None else fault["end_s"]
            if fault["start_s"] > start_s or until_s < end_s:
                spans.append((max(fault["start_s"], start_s) - start_s, min(until_s, end_s) - start_s))
    return [(begin, end) for begin, end in spans if end > begin]


def _segment(flight: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    return next((one for one in flight["segments"] if one["name"] == name), None)


def _metrics(
    flight: Mapping[str, Any], segment: str, names: Sequence[str]
) -> tuple[dict[str, float | None], dict[str, str]]:
    found = {one["name"]: one for one in flight["metrics"] if one["segment"] == segment and one["name"] in names}
    return {n: one["value"] for n, one in found.items()}, {n: one["reason"] for n, one in found.items()}


def _first_crossing(t: FloatArray, done: FloatArray, level: float) -> float | None:
    """As `scenarios.metrics` finds it: interpolated between two samples."""
    above = np.flatnonzero(done >= level)
    if not len(above):
        return None
    k = int(above[0])
    if k == 0 or done[k] == done[k - 1]:
        return float(t[k])
    return float(t[k - 1] + (t[k] - t[k - 1]) * (level - done[k - 1]) / (done[k] - done[k - 1]))
