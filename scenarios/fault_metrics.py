"""What a fault did to the flight: how far roll was pushed away, how long it took to be back, how much height it cost.

Roll is measured where its set-point stands still, that is in steps and holds, from the fault's begin to the end of that
segment: against the error that roll had when the fault began, so that the droop of a long hold is not taken for the
fault's doing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenarios.flight import Segment
from scenarios.injected_fault import InjectedFault
from scenarios.limits import Metric, measured
from scenarios.metrics import LARGEST_GAP_S, FloatArray
from scenarios.telemetry import Telemetry

NAMES = ("fault_roll_deviation_deg", "fault_recovery_s", "fault_height_loss_m")

CALM_S = 1.0
"""A set-point must have stood for so long before the fault: else the step is in the deviation."""

BEFORE_S = 0.1
"""The error before the fault is the mean over so long."""

BACK_DEG = 1.0
BACK_SHARE = 0.2
"""Roll is back when it stays within a degree of where it was, or within a fifth of the deviation, if that is more."""


def fault_metrics(telemetry: Telemetry, segments: Sequence[Segment], faults: Sequence[InjectedFault]) -> list[Metric]:
    """Of each segment that a fault began in, the worst of its faults.

    Args:
        telemetry: of the flight. segments: of it. faults: what became of them.
    """
    found: list[Metric] = []
    for segment in segments:
        of_one = [
            _measured(telemetry, segment, fault.start_s)
            for fault in faults
            if fault.start_s is not None and segment.start_s - 1e-6 <= fault.start_s < segment.end_s - 1e-6
        ]
        for metrics in zip(*of_one, strict=True):
            unset = [one for one in metrics if one.value is None]
            found.append(unset[0] if unset else max(metrics, key=lambda one: one.value or 0.0))
    return found


def no_segment(faults: Sequence[InjectedFault]) -> list[Metric]:
    """The metrics of a flight whose faults all began outside of what is measured, with the reason.

    Args:
        faults: of the flight.
    """
    began = any(fault.start_s is not None for fault in faults)
    reason = "every fault began between two manoeuvres" if began else "no fault was injected"
    return [measured(name, None, reason) for name in NAMES]


def _measured(telemetry: Telemetry, segment: Segment, start_s: float) -> tuple[Metric, Metric, Metric]:
    t_s = telemetry["t_s"]
    first, last = np.searchsorted(t_s, [start_s - 1e-6, segment.end_s - 1e-6])
    rows = slice(int(first), int(last))
    t, down = t_s[rows], telemetry["down_m"][rows].astype(np.float64)
    name = segment.name
    hole = _hole(t, start_s, segment.end_s)
    if hole:
        none = tuple(measured(one, None, hole, name) for one in NAMES)
        return none[0], none[1], none[2]
    height = measured(NAMES[2], max(0.0, float(np.max(down - down[0]))), "", name)
    stood_s = start_s - segment.start_s
    if segment.kind == "track":
        reason = "the set-point moves: see rms_error_deg"
    elif stood_s < CALM_S - 1e-6:
        reason = f"the set-point stepped {stood_s:.2g} s before the fault: {CALM_S:g} s are needed"
    else:
        reason = ""
    if reason:
        return measured(NAMES[0], None, reason, name), measured(NAMES[1], None, reason, name), height
    earlier = int(np.searchsorted(t_s, start_s - BEFORE_S - 1e-6))
    phi = np.unwrap(telemetry["phi_rad"][earlier : rows.stop].astype(np.float64))
    before = int(first) - earlier
    moved = np.degrees(phi[before:] - (float(np.mean(phi[:before])) if before else phi[0]))
    return (*_roll(t - start_s, moved, name), height)


def _roll(t: FloatArray, moved_deg: FloatArray, segment: str) -> tuple[Metric, Metric]:
    deviation_deg = float(np.max(np.abs(moved_deg)))
    band_deg = max(BACK_DEG, BACK_SHARE * deviation_deg)
    outside = np.flatnonzero(np.abs(moved_deg) > band_deg)
    recovery: Metric
    if not len(outside):
        recovery = measured(NAMES[1], 0.0, "", segment)
    elif outside[-1] == len(t) - 1:
        reason = f"still {abs(float(moved_deg[-1])):.1f} deg away at the end of the hold"
        recovery = measured(NAMES[1], None, reason, segment)
    else:
        recovery = measured(NAMES[1], float(t[outside[-1] + 1]), "", segment)
    return measured(NAMES[0], deviation_deg, "", segment), recovery


def _hole(t: FloatArray, start_s: float, end_s: float) -> str:
    edges = np.concatenate([[start_s], t, [end_s]])
    if len(t) < 2:
        return "no telemetry while the fault was in force"
    gap_s = float(np.max(np.diff(edges)))
    return f"a gap of {gap_s:.2g} s in the telemetry after the fault" if gap_s > LARGEST_GAP_S else ""
