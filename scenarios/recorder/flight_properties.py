"""What a recording carries for searches over many of them: gains, metrics, margins, verdict."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.flight import FlightRecord


def flight_properties(flight: FlightRecord, prefix: str = "") -> dict[str, dict[str, Any]]:
    """Gains, metrics, margins and verdict of a flight as properties of a recording.

    Args:
        flight: what was flown. prefix: of each group, where a recording has several flights.

    Returns:
        group -> name, with the unit -> number or text; None where a metric could not be measured.
    """
    return {
        f"{prefix}gains": dict(flight.parameters or flight.gain_set.parameters),
        f"{prefix}margins": {name: value for name, value in flight.margins.items() if _is_number(value)},
        f"{prefix}metrics": {metric.name: metric.value for metric in flight.metrics if not metric.segment},
        f"{prefix}verdict": {
            "outcome": str(flight.outcome),
            "reason": flight.reason,
            "vehicle": flight.vehicle_spec,
            "seed": flight.seed,
            "telemetry_sha256": flight.telemetry_sha256,
        },
    }


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
