"""Where the batch and a flight of the same candidate differ: verdicts, and metrics apart by more than is tolerated.

The batch flies the roll axis alone, from rest and without noise; a flight has all axes, sensor noise, and begins in
hover. Compared is the nominal model of the batch. A difference is always the flight's value minus the batch's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from scenarios.limits import LIMIT_CYCLE_RAD_S, METRICS, TITLES
from scenarios.run_folder import plain, write_atomically
from scenarios.run_reader import StoredRun, read_run
from scenarios.stored_flight import StoredFlight
from scenarios.sweep.best_flights import OWN, Flights, FlownPoint, row_of
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.evaluation import limits_of, measured_names
from scenarios.sweep.plan import Plan
from scenarios.table import UNSET, number

DISAGREEMENTS_JSON = "disagreements.json"
SCHEMA_VERSION = 1

PASSING = ("PASS", "INFO")
"""Outcomes of a flight that broke no limit; INFO where none is set."""


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
        metric: its name. batch, flight: None if it could not be measured. difference: None if either is missing.
        tolerance: in the metric's unit; None where it is not judged. within: None where it is not judged.
        reason: why a value is missing, or what explains the difference.
    """

    metric: str
    batch: float | None
    flight: float | None
    difference: float | None
    tolerance: float | None
    within: bool | None
    reason: str = ""


@dataclass(frozen=True)
class Comparison:
    """One flight beside its row of the dataset.

    Attributes:
        point: what was flown. case: name of the case. gain_set: name. batch_passes: the nominal model is within limits.
        outcome, reason: of the flight. compared: metric by metric. reasons: what is known to set the two apart.
    """

    point: FlownPoint
    case: str
    gain_set: str
    batch_passes: bool
    outcome: str
    reason: str
    compared: tuple[Compared, ...]
    reasons: tuple[str, ...]

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


def compare_flights(plan: Plan, dataset: Dataset, flights: Flights, folder: Path) -> tuple[Comparison, ...]:
    """Every flight beside its row.

    Args:
        plan, dataset: of the sweep. flights: flown. folder: that their runs are in.

    Raises:
        FileError: a run or a row cannot be read.
    """
    runs: dict[str, StoredRun] = {}
    found = []
    for point in flights.points:
        if point.run not in runs:
            runs[point.run] = read_run(folder / point.run)
        flight = _flight_of(runs[point.run], point)
        if flight is not None:
            found.append(compare(plan, point, row_of(plan, dataset, point.candidate, point.case), flight))
    return tuple(found)


def _flight_of(run: StoredRun, point: FlownPoint) -> StoredFlight | None:
    beside = run.owns if point.autopilot == OWN and run.owns else run.flights
    return next((one for one in beside if one.name == f"candidate {point.candidate}"), None)


def compare(plan: Plan, point: FlownPoint, row: Mapping[str, Any], flight: StoredFlight) -> Comparison:
    """One flight beside its row.

    Args:
        plan: of the sweep. point: what was flown. row: of the dataset. flight: as stored.
    """
    data = flight.data
    compared = tuple(_compared(name, row, flight) for name in measured_names(plan))
    made = Comparison(
        point,
        plan.cases[point.case].name,
        flight.name,
        bool(row["nominal_passes"]),
        flight.outcome,
        str(data["reason"]),
        compared,
        (),
    )
    if made.agrees:
        return made
    return replace(made, reasons=tuple(_reasons(plan, made, flight)))


def _compared(name: str, row: Mapping[str, Any], flight: StoredFlight) -> Compared:
    batch = row[f"{name}_nominal"]
    metric = flight.metric(name) or {"value": None, "reason": "not measured"}
    value, why = metric["value"], str(metric["reason"])
    if value is None and why.startswith("infinite"):
        # JSON has no infinity; a loop that no gain makes unstable has it on the batch's side, too
        value = math.copysign(math.inf, batch if batch is not None else 1.0)
    tolerance = TOLERANCES.get(name)
    if batch is None or value is None:
        alike = batch is value
        missing = "the batch could not measure it" if batch is None else why
        return Compared(name, batch, value, None, None, None if tolerance is None else alike, "" if alike else missing)
    if math.isinf(batch) or math.isinf(value):
        same = batch == value
        reason = "infinite" if same else "only one of the two is infinite"
        return Compared(name, batch, value, 0.0 if same else None, None, None if tolerance is None else same, reason)
    difference = value - batch
    if tolerance is None:
        return Compared(name, batch, value, difference, None, None)
    allowed = tolerance.of(batch, value)
    within = abs(difference) <= allowed
    if name == "oscillation_rad_s" and min(batch, value) > LIMIT_CYCLE_RAD_S:
        within = True  # both are in a limit cycle; how far it swings depends on what else moves
    return Compared(name, batch, value, difference, allowed, within)


def _reasons(plan: Plan, made: Comparison, flight: StoredFlight) -> Iterator[str]:
    """What is known of a flight that the batch does not have."""
    values = {one.metric: one for one in made.compared}
    if flight.data["segments"] == [] and made.reason:
        yield f"the flight came to no manoeuvre: {made.reason}"
        return
    for warning in flight.data["warnings"]:
        if "not level, still and at height" in warning:
            yield f"the flight did not begin from rest ({warning})"
    shake = {axis: _value(flight, f"{axis}_std_rad_s") for axis in "pqr"}
    worst = max(shake, key=lambda axis: shake[axis])
    if worst != "p" and shake[worst] > LIMIT_CYCLE_RAD_S:
        axis = {"q": "pitch", "r": "yaw"}[worst]
        yield f"it shakes in {axis}, {shake[worst]:.2g} rad/s: the batch flies the roll axis alone"
    limited = {limit.metric: limit for limit in limits_of(plan)}
    if not made.verdicts_agree:
        for name, limit in limited.items():
            one = values.get(name)
            if one is None or one.batch is None or one.flight is None or one.within is False:
                continue
            if limit.holds(one.batch) != limit.holds(one.flight):
                yield (
                    f"{TITLES[name]} is {one.batch:.4g} in the batch and {one.flight:.4g} in flight, within the "
                    f"tolerance and on either side of the limit {limit}"
                )
    noise = plan.cases[made.point.case].profile.gyro_noise_rad_s
    quiet = values.get("oscillation_rad_s")
    if quiet is None or quiet.batch is None or quiet.flight is None or not noise:
        return
    if quiet.flight - quiet.batch > 0.01 and quiet.batch <= LIMIT_CYCLE_RAD_S:
        yield (
            f"gyro noise of {noise:g} rad/s, which the batch has not, keeps it moving: {quiet.flight:.2g} rad/s at the "
            f"end of the hold instead of {quiet.batch:.2g}"
        )


def _value(flight: StoredFlight, name: str) -> float:
    metric = flight.metric(name)
    return 0.0 if metric is None or metric["value"] is None else float(metric["value"])


def write_disagreements(path: Path, plan: Plan, found: Sequence[Comparison], flights: Flights) -> Path:
    """Write `disagreements.json`: every comparison, those that agree, too.

    Args:
        path: of the folder of the flights. plan: of the sweep. found: comparisons. flights: what was left out, and why.

    Raises:
        FileError: it cannot be written; an earlier one is kept.
    """
    known = {
        "schema_version": SCHEMA_VERSION,
        "fingerprint": plan.fingerprint,
        "tolerances": {
            name: {"unit": METRICS[name][0], **({} if one is None else asdict(one)), "judged": one is not None}
            for name, one in ((name, TOLERANCES.get(name)) for name in measured_names(plan))
        },
        "agreeing": sum(one.agrees for one in found),
        "disagreements": [
            {**{key: value for key, value in asdict(one.point).items() if key != "fingerprint"}, "text": sentence(one)}
            for one in found
            if not one.agrees
        ],
        "flights": [_object(one) for one in found],
        "left_out": [
            {**asdict(one), "case_name": plan.cases[one.case].name, "case": one.case} for one in flights.left_out
        ],
        "complete": flights.stopped is None,
    }
    file = path / DISAGREEMENTS_JSON
    write_atomically(file, json.dumps(plain(known), indent=2, allow_nan=False).encode() + b"\n")
    return file


def _object(one: Comparison) -> dict[str, Any]:
    return {
        "candidate": one.point.candidate,
        "case": one.point.case,
        "case_name": one.case,
        "autopilot": one.point.autopilot,
        "run": one.point.run,
        "gain_set": one.gain_set,
        "batch_passes": one.batch_passes,
        "outcome": one.outcome,
        "reason": one.reason,
        "verdicts_agree": one.verdicts_agree,
        "agrees": one.agrees,
        "reasons": list(one.reasons),
        "metrics": [{**asdict(each), "unit": METRICS[each.metric][0]} for each in one.compared],
    }


def disagreements_text(plan: Plan, found: Sequence[Comparison], flights: Flights) -> str:
    """For people: a line a flight, and what was left out.

    Args:
        plan: of the sweep. found: comparisons. flights: what was left out, and why.
    """
    lines = []
    if found:
        agreeing = sum(one.agrees for one in found)
        lines.append(
            f"Flown over MAVLink beside the batch's nominal model: {agreeing} of {len(found)} "
            f"flight{'s' * (len(found) != 1)} agree{'s' * (len(found) == 1)} within the tolerances."
        )
        rows = [["candidate", "case", "autopilot", "batch", "flight", "apart (flight minus batch)"]]
        for one in found:
            verdict = "PASS" if one.batch_passes else "FAIL"
            apart = "; ".join(_sentence(each) for each in one.outside) or ("verdict" if not one.agrees else "")
            rows.append([str(one.point.candidate), one.case, one.point.autopilot, verdict, one.outcome, apart])
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines += ["  ".join(cell.ljust(widths[k]) for k, cell in enumerate(row)).rstrip() for row in rows]
    for left in flights.left_out:
        what = "every candidate" if left.candidate is None else f"candidate {left.candidate}"
        lines.append(f"not flown: {what}, {plan.cases[left.case].name}, {left.autopilot}: {left.reason}")
    return "\n".join(lines) + "\n" if lines else ""


def sentence(one: Comparison) -> str:
    """What sets a flight apart from the batch, and why, in a line.

    Args:
        one: that does not agree.
    """
    parts = []
    if not one.verdicts_agree:
        why = f" ({one.reason})" if one.reason else ""
        parts.append(f"{one.outcome}{why} in flight, {'PASS' if one.batch_passes else 'FAIL'} in the batch")
    parts += [_sentence(each) for each in one.outside]
    reasons = "; ".join(one.reasons) or "no reason is known"
    return f"{one.gain_set}, {one.case}, {one.point.autopilot}: {'; '.join(parts)}. Why: {reasons}"


def _sentence(one: Compared) -> str:
    name, unit = TITLES[one.metric], METRICS[one.metric][0]
    if one.difference is None:
        pair = "/".join(UNSET if value is None else number(value, 4) for value in (one.batch, one.flight))
        return f"{name} {pair} {unit}" + (f" ({one.reason})" if one.reason else "")
    allowed = "" if one.tolerance is None else f" ({one.tolerance:.3g} allowed)"
    return f"{name} {one.difference:+.3g} {unit}{allowed}"
