"""What a fault did to the flight: how far roll was pushed away, how long it took to be back, how much height it cost.

Roll is measured where its set-point stands still and has stood for a second, that is in steps and holds, from the
fault's begin to the end of that segment: against where roll was when the fault began, so that the droop of a long hold
is not taken for the fault's doing. Where the set-point moves, the metrics of step and track tell.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from scenarios.flight import Segment
from scenarios.injected_fault import InjectedFault
from scenarios.limits import Metric, measured
from scenarios.metrics import LARGEST_GAP_S, FloatArray
from scenarios.telemetry import Telemetry

NAMES = ("fault_roll_deviation_deg", "fault_recovery_s", "fault_height_loss_m")

CALM_S = 1.0
"""The set-point must have stood for so long before the fault, or the step would be in the deviation."""

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
        of_one: dict[str, list[Metric]] = {}
        for fault in faults:
            start_s = fault.start_s
            if start_s is not None and segment.start_s - 1e-6 <= start_s < segment.end_s - 1e-6:
                for metric in _measured(telemetry, segment, start_s):
                    of_one.setdefault(metric.name, []).append(metric)
        for metrics in of_one.values():
            unset = [one for one in metrics if one.value is None]
            found.append(unset[0] if unset else max(metrics, key=lambda one: one.value or 0.0))
    return found


def not_measured(faults: Sequence[InjectedFault], measured_ones: Collection[str]) -> list[Metric]:
    """The metrics that no fault of a flight could be measured by, with the reason.

    Args:
        faults: of the flight. measured_ones: names of those that it could.
    """
    began = any(fault.start_s is not None for fault in faults)
    reason = (
        "no fault began where the roll set-point had stood still for a second" if began else "no fault was injected"
    )
    return [measured(name, None, reason) for name in NAMES if name not in measured_ones]


def _measured(telemetry: Telemetry, segment: Segment, start_s: float) -> list[Metric]:
    """Height always, roll only where nothing else moves it."""
    t_s = telemetry["t_s"]
    first, last = np.searchsorted(t_s, [start_s - 1e-6, segment.end_s - 1e-6])
    rows = slice(int(first), int(last))
    t, down = t_s[rows], telemetry["down_m"][rows].astype(np.float64)
    calm = segment.kind != "track" and start_s - segment.start_s >= CALM_S - 1e-6
    hole = _hole(t, start_s, segment.end_s)
    if hole:
        return [measured(name, None, hole, segment.name) for name in (NAMES if calm else NAMES[2:])]
    height = measured(NAMES[2], max(0.0, float(np.max(down - down[0]))), "", segment.name)
    if not calm:
        return [height]
    earlier = int(np.searchsorted(t_s, start_s - BEFORE_S - 1e-6))
    phi = np.unwrap(telemetry["phi_rad"][earlier : rows.stop].astype(np.float64))
    before = int(first) - earlier
    moved = np.degrees(phi[before:] - (float(np.mean(phi[:before])) if before else phi[0]))
    return [*_roll(t - start_s, moved, segment.name), height]


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
