"""What a flight and the batch's nominal model have in common, metric by metric, and how far apart they are.

The batch flies the roll axis alone, from rest and without noise; a flight has all axes, sensor noise, and begins in
hover. A difference is always the flight's value minus the batch's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from scenarios.limits import LIMIT_CYCLE_RAD_S
from scenarios.stored_flight import StoredFlight
from scenarios.sweep.best_flights import FlownPoint
from scenarios.sweep.evaluation import measured_names
from scenarios.sweep.plan import Plan

PASSING = ("PASS", "INFO")
"""Outcomes of a flight that broke no limit; INFO where none is set."""

CYCLES = "both are in a limit cycle"
SWINGING = ("droop_deg", "vaf_pct", "vaf_lag_removed_pct", "rms_error_deg", "lag_s")
"""Metrics that depend on where in its cycle a vehicle is when a window begins: not judged where both are in one."""


@dataclass(frozen=True)
class Tolerance:
    """How far apart two values of a metric may be: the larger of two measures.

    Attributes:
        absolute: in the metric's unit. share: of the larger value.
    """

    absolute: float
    share: float = 0.0

    def of(self, *values: float) -> float:
        """In the metric's unit.

        Args:
            values: of the metric.
        """
        return max(self.absolute, self.share * max(abs(value) for value in values))


_TICKS = Tolerance(0.012, 0.05)  # three ticks of telemetry
_COMPUTED = Tolerance(1e-6, 1e-6)
TOLERANCES: Mapping[str, Tolerance] = {
    "overshoot_pct": Tolerance(1.0),
    "rise_time_s": _TICKS,
    "settling_time_5pct_s": _TICKS,
    "settling_time_2pct_s": _TICKS,
    "droop_deg": Tolerance(0.2),
    "vaf_pct": Tolerance(1.0),
    "vaf_lag_removed_pct": Tolerance(1.0),
    "rms_error_deg": Tolerance(0.2),
    "lag_s": Tolerance(0.012),
    "oscillation_rad_s": Tolerance(0.05),
    "gain_margin_low_db": _COMPUTED,
    "gain_margin_high_db": _COMPUTED,
    "phase_margin_deg": _COMPUTED,
    "delay_margin_s": _COMPUTED,
    "modulus_margin": _COMPUTED,
}
"""Metrics without one are told and not judged: the torque has the gyro's noise in it, times the gains."""


@dataclass(frozen=True)
class Compared:
    """One metric of the batch's nominal model beside that of the flight.

    Attributes:
        metric: its name. batch, flight: in its unit; None if it could not be measured.
        difference: None if either is missing. expected: of that, what a flight's telemetry makes of it.
        tolerance: of the rest, in the metric's unit; None where it is not judged. within: None where it is not judged.
        reason: why a value is missing, or why it is not judged.
    """

    metric: str
    batch: float | None
    flight: float | None
    difference: float | None
    expected: float
    tolerance: float | None
    within: bool | None
    reason: str = ""


@dataclass(frozen=True)
class Comparison:
    """One flight beside its row of the dataset.

    Attributes:
        point: what was flown. case: name of the case. gain_set: name. batch_passes: the nominal model is within limits.
        outcome, reason: of the flight. compared: metric by metric.
        roll_rms_deg: of the difference of the two roll angles over all segments, lateness taken off; None if not known.
        reasons: what is known to set the two apart.
    """

    point: FlownPoint
    case: str
    gain_set: str
    batch_passes: bool
    outcome: str
    reason: str
    compared: tuple[Compared, ...]
    roll_rms_deg: float | None = None
    reasons: tuple[str, ...] = ()

    @property
    def verdicts_agree(self) -> bool:
        """Both pass, or neither does."""
        return self.batch_passes == (self.outcome in PASSING)

    @property
    def outside(self) -> tuple[Compared, ...]:
        """What is apart by more than is tolerated."""
        return tuple(one for one in self.compared if one.within is False)

    @property
    def agrees(self) -> bool:
        """In verdict and metrics."""
        return self.verdicts_agree and not self.outside


def compare(
    plan: Plan, point: FlownPoint, row: Mapping[str, Any], seen: Mapping[str, float | None], flight: StoredFlight
) -> Comparison:
    """One flight beside its row; why they differ is not looked for.

    Args:
        plan: of the sweep. point: what was flown. row: of the dataset. seen: metrics of `as_flown`. flight: as stored.
    """
    case = plan.cases[point.case]
    compared = tuple(_compared(name, row, seen.get(name), flight) for name in measured_names(plan))
    shaken = next((one for one in compared if one.metric == "oscillation_rad_s"), None)
    if shaken is not None and min(shaken.batch or 0.0, shaken.flight or 0.0) > LIMIT_CYCLE_RAD_S:
        compared = tuple(
            replace(one, within=None, reason=CYCLES) if one.metric in SWINGING else one for one in compared
        )
    passes, reason = bool(row["nominal_passes"]), str(flight.data["reason"])
    return Comparison(point, case.name, flight.name, passes, flight.outcome, reason, compared)


def _compared(name: str, row: Mapping[str, Any], seen: float | None, flight: StoredFlight) -> Compared:
    batch = row[f"{name}_nominal"]
    expected = 0.0 if seen is None or batch is None else seen - batch
    metric = flight.metric(name) or {"value": None, "reason": "not measured"}
    value, why = metric["value"], str(metric["reason"])
    if value is None and why.startswith("infinite"):
        # JSON has no infinity; a loop that no gain makes unstable has it on the batch's side, too
        value = math.copysign(math.inf, batch if batch is not None else 1.0)
    tolerance = TOLERANCES.get(name)
    made = Compared(name, batch, value, None, expected, None, None)
    if batch is None or value is None:
        alike = batch is value
        missing = "" if alike else ("the batch could not measure it" if batch is None else why)
        return replace(made, within=None if tolerance is None else alike, reason=missing)
    if math.isinf(batch) or math.isinf(value):
        alike = batch == value
        reason = "infinite" if alike else "only one of the two is infinite"
        return replace(made, within=None if tolerance is None else alike, reason=reason)
    made = replace(made, difference=value - batch)
    if tolerance is None:
        return made
    allowed = tolerance.of(batch, value)
    # both in a limit cycle: how far it swings depends on what else moves
    cycle = name == "oscillation_rad_s" and min(batch, value) > LIMIT_CYCLE_RAD_S
    return replace(made, tolerance=allowed, within=cycle or abs(value - batch - expected) <= allowed)
