"""Two runs compared: each gain set that both have flown, metric by metric; what got worse is a regression.

A gain set is the same if its name is, or else its parameters are; parameters that differ are told. A regression is a
verdict that got worse, a limited metric that is beyond its limit and was not, that could be measured and cannot be any
more, or that is worse by more than its tolerance, and a gain set that was flown and is not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scenarios.run_reader import StoredRun
from scenarios.stored_flight import StoredFlight

LOWER, HIGHER, NEARER, NEITHER = "lower", "higher", "nearer to zero", "neither"

SENSES: Mapping[str, tuple[str, float]] = {
    # name: (which is better, tolerance in the metric's unit)
    "overshoot_pct": (LOWER, 1.5),
    "rise_time_s": (LOWER, 0.02),
    "settling_time_5pct_s": (LOWER, 0.05),
    "settling_time_2pct_s": (LOWER, 0.05),
    "droop_deg": (NEARER, 0.2),
    "peak_delta_lat": (LOWER, 0.05),
    "rms_delta_lat": (LOWER, 0.02),
    "oscillation_rad_s": (LOWER, 0.05),
    "oscillation_hz": (NEITHER, 0.2),
    "p_std_rad_s": (LOWER, 0.05),
    "q_std_rad_s": (LOWER, 0.05),
    "r_std_rad_s": (LOWER, 0.05),
    "vaf_pct": (HIGHER, 1.0),
    "lag_s": (LOWER, 0.004),
    "vaf_lag_removed_pct": (HIGHER, 1.0),
    "rms_error_deg": (LOWER, 0.2),
    "gain_margin_low_db": (LOWER, 0.5),
    "gain_margin_high_db": (HIGHER, 0.5),
    "phase_margin_deg": (HIGHER, 2.0),
    "delay_margin_s": (HIGHER, 0.001),
    "modulus_margin": (HIGHER, 0.02),
    "fault_roll_deviation_deg": (LOWER, 0.5),
    "fault_recovery_s": (LOWER, 0.05),
    "fault_height_loss_m": (LOWER, 0.2),
    "roll_estimate_error_deg": (LOWER, 0.5),
    "attitude_rate_hz": (HIGHER, 5.0),
    "largest_gap_s": (LOWER, 0.02),
}
"""Of every metric of `scenarios/limits.py`; a difference within the tolerance is none."""

RELATIVE = 0.05
"""Of the older value, where that is more: the amplitude of a limit cycle is known to 5 %."""

RANKS = {"PASS": 0, "INFO": 0, "UNSET": 1, "FAIL": 2}
"""Verdicts; a larger one is worse. A flight without limits cannot be worse than one that held them, and one that could
not be judged is no better than one that failed."""


@dataclass(frozen=True)
class MetricChange:
    """One metric of one gain set in two runs.

    Attributes:
        name, unit: of the metric.
        old, new: its values; infinite margins are infinite, None: not measured.
        difference: new minus old; None if either is not there or infinite.
        change: "same" (within the tolerance), "better", "worse", "other" (a metric that has no better), "lost" or
            "found" (measured in one of them only), "none" (in neither).
        limit, outcome: of the newer run; `limit` is None without one.
        old_outcome: of the older run.
        tolerance: in the metric's unit.
        regression: as this module's head says.
    """

    name: str
    unit: str
    old: float | None
    new: float | None
    difference: float | None
    change: str
    limit: str | None
    outcome: str
    old_outcome: str
    tolerance: float
    regression: bool


@dataclass(frozen=True)
class FlightChange:
    """One gain set in two runs.

    Attributes:
        name: in the newer run; of the older one, if it is only there.
        old, new: the flights; None: that run has not flown it.
        verdict: "same", "better", "worse", or "other" (FAIL, and now UNSET); empty if only one run has flown it.
        parameters: those that differ: name -> (old, new), None: not stated.
        identical: the same telemetry, bit for bit.
        metrics: of the whole flight.
    """

    name: str
    old: StoredFlight | None
    new: StoredFlight | None
    verdict: str
    parameters: Mapping[str, tuple[float | None, float | None]]
    identical: bool
    metrics: tuple[MetricChange, ...]

    @property
    def regression(self) -> bool:
        """Worse than it was."""
        return self.new is None or self.verdict == "worse" or any(metric.regression for metric in self.metrics)


@dataclass(frozen=True)
class RunChange:
    """A run compared with an older one.

    Attributes:
        old, new: the runs.
        circumstances: what else differs between them, a sentence each: then a change need not be the gains'.
        flights: those of the newer run in its order, then those that only the older one has.
    """

    old: StoredRun
    new: StoredRun
    circumstances: tuple[str, ...]
    flights: tuple[FlightChange, ...]

    @property
    def compared(self) -> int:
        """Gain sets that both have flown."""
        return sum(flight.old is not None and flight.new is not None for flight in self.flights)

    @property
    def regressions(self) -> tuple[FlightChange, ...]:
        """Gain sets that got worse."""
        return tuple(flight for flight in self.flights if flight.regression)


def compare(old: StoredRun, new: StoredRun) -> RunChange:
    """Compare two runs.

    Args:
        old: what is compared with. new: what may be better or worse.
    """
    left = [*old.flights, *([old.baseline] if old.baseline else [])]
    changes = []
    rest = []
    for flight in (*new.flights, *([new.baseline] if new.baseline else [])):
        match = next((one for one in left if one.name == flight.name), None)
        match = match or next((one for one in left if one.slug == flight.slug), None)
        if match is None:
            rest.append(flight)
        else:
            left.remove(match)
        changes.append((match, flight))
    for flight in rest:  # renamed?
        twin = next((one for one in left if _parameters(one) and _parameters(one) == _parameters(flight)), None)
        if twin is not None:
            left.remove(twin)
            changes[changes.index((None, flight))] = (twin, flight)
    flights = [_flight_change(before, after) for before, after in changes]
    return RunChange(old, new, _circumstances(old, new), (*flights, *(_flight_change(one, None) for one in left)))


def _flight_change(old: StoredFlight | None, new: StoredFlight | None) -> FlightChange:
    if old is None or new is None:
        one = new or old
        assert one is not None
        return FlightChange(one.name, old, new, "", {}, False, ())
    step = RANKS[new.outcome] - RANKS[old.outcome]
    # a run without run.json knows what was uploaded and not what of it the gain set stated
    before, after = (_parameters(one, uploaded=not (old.known and new.known)) for one in (old, new))
    differing = {
        name: (before.get(name), after.get(name))
        for name in dict.fromkeys((*before, *after))
        if before.get(name) != after.get(name)
    }
    fingerprints = {old.data["telemetry_sha256"], new.data["telemetry_sha256"]}
    names = dict.fromkeys(m["name"] for flight in (old, new) for m in flight.data["metrics"] if not m["segment"])
    return FlightChange(
        new.name,
        old,
        new,
        "same" if step == 0 else "worse" if step > 0 else "better" if new.outcome != "UNSET" else "other",
        differing,
        len(fingerprints) == 1 and "" not in fingerprints,
        tuple(_metric_change(name, old.metric(name), new.metric(name), limited=new.known) for name in names),
    )


def _metric_change(
    name: str, old: Mapping[str, Any] | None, new: Mapping[str, Any] | None, *, limited: bool
) -> MetricChange:
    """Of one metric; `limited`: the newer run tells its limits, else those of the older one count."""
    sense, tolerance = SENSES.get(name, (NEITHER, 0.0))
    before, after = _value(old, sense), _value(new, sense)
    difference = None
    if before is None or after is None:
        change = "none" if before is after else "found" if before is None else "lost"
    else:
        worse = _worse_by(before, after, sense)
        if math.isfinite(before) and math.isfinite(after):
            difference = after - before
            tolerance = max(tolerance, RELATIVE * abs(before))
        if worse == 0 or (difference is not None and abs(worse) <= tolerance):
            change = "same"
        else:
            change = "other" if sense == NEITHER else "worse" if worse > 0 else "better"
    limit = ((new if limited else old) or {}).get("limit")
    outcome = "UNSET" if new is None else str(new["outcome"])
    was = "UNSET" if old is None else str(old["outcome"])
    crossed = outcome == "FAIL" and was != "FAIL"
    return MetricChange(
        name,
        str((new or old or {}).get("unit", "")),
        before,
        after,
        difference,
        change,
        limit,
        outcome,
        was,
        tolerance,
        regression=limit is not None and (crossed or change in ("worse", "lost")),
    )


def _worse_by(old: float, new: float, sense: str) -> float:
    if old == new:
        return 0.0  # both infinite, too
    if sense == NEARER:
        return abs(new) - abs(old)
    return old - new if sense == HIGHER else new - old


def _value(metric: Mapping[str, Any] | None, sense: str) -> float | None:
    """The value; JSON has no infinity, so an infinite margin is null and its reason says so."""
    if metric is None:
        return None
    if metric["value"] is None and str(metric["reason"]).startswith("infinite"):
        return -math.inf if sense == LOWER else math.inf
    return None if metric["value"] is None else float(metric["value"])


def _parameters(flight: StoredFlight, *, uploaded: bool = False) -> dict[str, float]:
    """What the gain set states, or everything that was uploaded."""
    values = flight.data["uploaded"] if uploaded else flight.data["gain_set"]["parameters"]
    return {name: float(value) for name, value in values.items()}


def _circumstances(old: StoredRun, new: StoredRun) -> tuple[str, ...]:
    pairs: Sequence[tuple[str, Any, Any]] = [
        ("vehicle", old.data["vehicle"]["spec"], new.data["vehicle"]["spec"]),
        ("derivatives", old.data["vehicle"]["derivatives"], new.data["vehicle"]["derivatives"]),
        ("assumptions", old.data["vehicle"]["assumptions"], new.data["vehicle"]["assumptions"]),
        ("profile", _profile(old), _profile(new)),
        ("manoeuvres", old.data["scenario"]["manoeuvres"], new.data["scenario"]["manoeuvres"]),
        ("limits", old.data["scenario"]["limits"], new.data["scenario"]["limits"]),
        ("axes", old.data["scenario"]["axes"], new.data["scenario"]["axes"]),
        ("seed", old.data["seed"], new.data["seed"]),
        ("froude", old.data["versions"].get("froude"), new.data["versions"].get("froude")),
    ]
    if not (old.known and new.known):
        return ("the circumstances of one of the runs are not known: its run.json is missing",)
    return tuple(_differs(what, one, other) for what, one, other in pairs if one != other)


def _differs(what: str, old: Any, new: Any) -> str:
    if isinstance(old, dict) and isinstance(new, dict):
        parts = [f"{key} {old.get(key)} → {new.get(key)}" for key in {**old, **new} if old.get(key) != new.get(key)]
        return f"{what}: {', '.join(parts)}"
    if isinstance(old, list):
        return f"{what}: not the same"
    return f"{what}: {old} → {new}"


def _profile(run: StoredRun) -> dict[str, Any]:
    return {item["item"]: item["value"] for item in run.data["profile"]}
