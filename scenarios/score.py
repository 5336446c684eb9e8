"""The score of a flight: its telemetry and segments become metrics, of each segment and of the whole flight.

The whole flight's value of a metric is that of its worst segment. If one segment could not be measured,
neither could the flight: a set that is fine on one step and unmeasured on the next was not shown to be fine.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from scenarios.fault_metrics import fault_metrics, not_measured
from scenarios.flight import Segment
from scenarios.injected_fault import InjectedFault
from scenarios.limits import METRICS, Metric, Outcome, measured
from scenarios.metrics import (
    FloatArray,
    Oscillation,
    divergence,
    effort_metrics,
    oscillation,
    step_metrics,
    track_metrics,
)
from scenarios.telemetry import Telemetry

SAME_SETPOINT_RAD = math.radians(0.5)

ESTIMATE_LATE_S = 0.0, 0.004, 0.008
"""How late an estimate may be without being called wrong."""

WORST: Mapping[str, Callable[[Metric], float]] = {
    # metric: sort key, the largest is the worst; by default the value itself
    "vaf_pct": lambda metric: -(metric.value or 0.0),
    "vaf_lag_removed_pct": lambda metric: -(metric.value or 0.0),
    "droop_deg": lambda metric: abs(metric.value or 0.0),
}


def flight_metrics(
    telemetry: Telemetry,
    segments: Sequence[Segment],
    margins: Mapping[str, Any] | None = None,
    faults: Sequence[InjectedFault] = (),
) -> tuple[Metric, ...]:
    """Everything measured on a flight: the flight's own metrics first, then those of each segment.

    Args:
        telemetry: of the flight.
        segments: of the flight; one that the telemetry does not cover gives UNSET metrics.
        margins: of the loop that was flown, fields of `sitl.stability.Margins`; None if not computed.
        faults: that were planned for the flight, and what became of them.
    """
    shakes = {s.name: _oscillation(telemetry, s) for s in segments if s.kind in ("step", "hold")}
    cycles = [shake for shake in shakes.values() if shake.is_limit_cycle]
    cycle = max(cycles, key=lambda shake: shake.worst_rad_s) if cycles else None
    of_segments: list[Metric] = []
    for segment in segments:
        of_segments += _segment_metrics(telemetry, segment, cycle)
    of_faults = fault_metrics(telemetry, segments, faults)
    of_segments += of_faults
    whole = [_worst(name, of_segments) for name in dict.fromkeys(m.name for m in of_segments)]
    whole += _shake_metrics(list(shakes.values()), "") if shakes else []
    for name, shake in shakes.items():
        of_segments += _shake_metrics([shake], name)
    whole += margin_metrics(margins) if margins else []
    whole += not_measured(faults, {metric.name for metric in of_faults}) if faults else []
    whole += _estimate_metrics(telemetry, segments)
    whole += _data_metrics(telemetry, segments)
    order = {name: place for place, name in enumerate(METRICS)}
    return (*sorted(whole, key=lambda metric: order[metric.name]), *of_segments)


def margin_metrics(margins: Mapping[str, Any]) -> list[Metric]:
    """Margins of the loop broken at delta_lat (`sitl.stability.Margins`); negative: how unstable it is."""
    names = (
        "gain_margin_low_db",
        "gain_margin_high_db",
        "phase_margin_deg",
        "delay_margin_s",
        "modulus_margin",
    )
    if margins["closed_loop_stable"]:
        return [measured(n, margins[n], "no such limit" if margins[n] is None else "") for n in names]
    reason = "the linear loop is unstable"
    return [measured(n, None if n == "modulus_margin" else margins[n], reason) for n in names]


def diverged(telemetry: Telemetry) -> str:
    """Why the armed part of the flight is no flight any more; empty if it is one."""
    armed = telemetry.select(telemetry["armed"])
    return divergence(armed["t_s"], armed["phi_rad"], armed["theta_rad"])


def _oscillation(telemetry: Telemetry, segment: Segment) -> Oscillation:
    t, p, q, r = (telemetry[name] for name in ("t_s", "p_rad_s", "q_rad_s", "r_rad_s"))
    return oscillation(t, p, q, r, start_s=segment.start_s, end_s=segment.end_s)


def _segment_metrics(telemetry: Telemetry, segment: Segment, cycle: Oscillation | None) -> list[Metric]:
    t, phi, phi_sp = (telemetry[name] for name in ("t_s", "phi_rad", "phi_sp_rad"))
    start, end, name = segment.start_s, segment.end_s, segment.name
    metrics: list[Metric] = []
    if segment.kind == "step":
        reported, reason = _reported_setpoint(t, phi_sp, segment)
        steps = step_metrics(
            *(t, phi),
            start_s=start,
            end_s=end,
            phi_from_rad=segment.phi_from_rad,
            phi_to_rad=segment.phi_to_rad if reason else reported,
            cycle=cycle,
            segment=name,
        )
        metrics += [measured(m.name, None, reason, name) for m in steps] if reason else steps
    elif segment.kind == "track":
        metrics += track_metrics(t, phi, phi_sp, start_s=start, end_s=end, segment=name)
    metrics += effort_metrics(t, telemetry["delta_lat"], start_s=start, end_s=end, segment=name)
    return metrics


def _reported_setpoint(t: FloatArray, phi_sp: FloatArray, segment: Segment) -> tuple[float, str]:
    """Roll set-point that the vehicle reports for a step; with the reason if it is not the one asked for."""
    late = (t > 0.5 * (segment.start_s + segment.end_s)) & (t < segment.end_s) & np.isfinite(phi_sp)
    if not late.any():
        return math.nan, "the vehicle reported no roll set-point"
    reported = float(np.median(phi_sp[late].astype(np.float64)))
    if abs(reported - segment.phi_to_rad) > SAME_SETPOINT_RAD:
        asked, seen = math.degrees(segment.phi_to_rad), math.degrees(reported)
        return reported, f"the vehicle's roll set-point was {seen:.1f} deg, not the {asked:.1f} deg asked for"
    return reported, ""


def _worst(name: str, metrics: Sequence[Metric]) -> Metric:
    found = [metric for metric in metrics if metric.name == name]
    for metric in found:
        if metric.outcome is Outcome.UNSET:
            where = f" ({metric.segment})" if len(found) > 1 else ""
            return dataclasses.replace(metric, reason=metric.reason + where, segment="")
    worst = max(found, key=WORST.get(name, lambda metric: metric.value or 0.0))
    return dataclasses.replace(worst, segment="")


def _shake_metrics(shakes: Sequence[Oscillation], segment: str) -> list[Metric]:
    """Oscillation of one segment, or of the flight: its worst segment that is long enough to tell."""
    axes = ("p_std_rad_s", "q_std_rad_s", "r_std_rad_s")
    known = [shake for shake in shakes if not shake.reason]
    if not known:
        names = ("oscillation_rad_s", "oscillation_hz", *axes)
        return [measured(name, None, shakes[0].reason, segment) for name in names]
    worst = max(known, key=lambda shake: shake.worst_rad_s)
    quiet = "too quiet to have a frequency" if worst.frequency_hz is None else ""
    return [
        measured("oscillation_rad_s", worst.worst_rad_s, str(worst) if worst.is_limit_cycle else "", segment),
        measured("oscillation_hz", worst.frequency_hz, quiet, segment),
        *(measured(name, max(shake.std_rad_s[k] for shake in known), "", segment) for k, name in enumerate(axes)),
    ]


def _estimate_metrics(telemetry: Telemetry, segments: Sequence[Segment]) -> list[Metric]:
    """How far the vehicle's own roll angle is from the truth, its lateness taken off.

    An estimate is stamped with the tick of its sample in one flight and of its publication in the next; four
    milliseconds of a fast step are as much as all that is worth knowing.
    """
    name = "roll_estimate_error_deg"
    rows = [telemetry.between(segment.start_s, segment.end_s) for segment in segments]
    errors = [[_largest_error(one, late_s) for one in rows] for late_s in ESTIMATE_LATE_S]
    known = [[error for error in of_one if error is not None] for of_one in errors]
    if not known[0]:
        return [measured(name, None, "the simulator's truth is not known")]
    return [measured(name, math.degrees(min(max(of_one) for of_one in known if of_one)))]


def _largest_error(rows: Telemetry, late_s: float) -> float | None:
    """Largest magnitude, rad, of estimated minus true roll so much earlier; None where the truth is not known."""
    phi, true, t = (rows[name].astype(np.float64) for name in ("phi_rad", "phi_true_rad", "t_s"))
    known = np.isfinite(true)
    if not known.any():
        return None
    off = phi - np.interp(t - late_s, t[known], np.unwrap(true[known]))
    return float(np.abs((off + math.pi) % (2.0 * math.pi) - math.pi)[known].max())


def _data_metrics(telemetry: Telemetry, segments: Sequence[Segment]) -> list[Metric]:
    """How densely the vehicle reported during the segments: what the other metrics rest on."""
    names = ("attitude_rate_hz", "largest_gap_s")
    gaps = []
    for segment in segments:
        times = telemetry.between(segment.start_s, segment.end_s)["t_s"]
        gaps += list(np.diff(times))
    if not gaps:
        return [measured(name, None, "no telemetry in any segment") for name in names]
    return [measured(names[0], len(gaps) / math.fsum(gaps)), measured(names[1], max(gaps))]
