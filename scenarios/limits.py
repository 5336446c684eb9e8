"""Measurements, the limits set on them, and the verdict.

A metric is declared with its unit and limit, then measured. "Never measured" is not "failed": it is UNSET,
with the reason.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from sitl.errors import FileError
from sitl.keyed_table import nearest

LIMIT_CYCLE_RAD_S = 0.3
"""Standard deviation of a body rate over one second above which an axis is in a limit cycle. Uncritical:
recorded flights show at most 0.037 when quiet and at least 0.62 when cycling."""


class Outcome(Enum):
    """Of a metric, a flight or a run."""

    PASS = "PASS"
    FAIL = "FAIL"
    UNSET = "UNSET"  # limited, but could not be measured
    INFO = "INFO"  # no limit was set

    def __str__(self) -> str:
        return self.value


METRICS: Mapping[str, tuple[str, str]] = {
    # name: (unit, meaning)
    "overshoot_pct": ("%", "largest excess over the set-point, of the step's amplitude"),
    "rise_time_s": ("s", "10 to 90 % of the step"),
    "settling_time_5pct_s": ("s", "last time outside 5 % of the step's amplitude"),
    "settling_time_2pct_s": ("s", "last time outside 2 % of the step's amplitude"),
    "droop_deg": ("deg", "mean error in the last second of the hold; negative: rolled back"),
    "peak_delta_lat": ("1", "largest magnitude of the normalised roll torque"),
    "rms_delta_lat": ("1", "root mean square of the normalised roll torque"),
    "oscillation_rad_s": ("rad/s", "largest of p, q, r standard deviations in the last second"),
    "oscillation_hz": ("Hz", "dominant frequency of that rate"),
    "p_std_rad_s": ("rad/s", "standard deviation of the roll rate in the last second"),
    "q_std_rad_s": ("rad/s", "standard deviation of the pitch rate in the last second"),
    "r_std_rad_s": ("rad/s", "standard deviation of the yaw rate in the last second"),
    "vaf_pct": ("%", "variance of the set-point accounted for"),
    "lag_s": ("s", "delay of the roll angle behind the set-point, by cross-correlation"),
    "vaf_lag_removed_pct": ("%", "variance accounted for once the lag is taken out"),
    "rms_error_deg": ("deg", "root mean square of set-point minus roll angle"),
    "gain_margin_low_db": ("dB", "lower end of the stable loop gains, relative to the present one"),
    "gain_margin_high_db": ("dB", "upper end of the stable loop gains, relative to the present one"),
    "phase_margin_deg": ("deg", "of the loop broken at delta_lat"),
    "delay_margin_s": ("s", "extra delay that makes the loop unstable"),
    "modulus_margin": ("1", "least distance of the loop from -1"),
    "fault_roll_deviation_deg": ("deg", "largest change of roll after a fault began, while its set-point stood still"),
    "fault_recovery_s": ("s", "from a fault's begin until roll stays within 1 deg, or a fifth, of where it was"),
    "fault_height_loss_m": ("m", "largest loss of height after a fault began"),
    "roll_estimate_error_deg": (
        "deg",
        "largest difference between estimated and true roll, up to 8 ms of lateness taken off",
    ),
    "attitude_rate_hz": ("Hz", "ATTITUDE messages per second of vehicle time, as received"),
    "largest_gap_s": ("s", "longest time between two ATTITUDE messages"),
}


TITLES: Mapping[str, str] = {
    "overshoot_pct": "overshoot",
    "rise_time_s": "rise time",
    "settling_time_5pct_s": "settling time (5 %)",
    "settling_time_2pct_s": "settling time (2 %)",
    "droop_deg": "droop",
    "peak_delta_lat": "peak delta_lat",
    "rms_delta_lat": "RMS delta_lat",
    "oscillation_rad_s": "oscillation",
    "oscillation_hz": "oscillation frequency",
    "p_std_rad_s": "roll rate deviation",
    "q_std_rad_s": "pitch rate deviation",
    "r_std_rad_s": "yaw rate deviation",
    "vaf_pct": "VAF",
    "lag_s": "lag",
    "vaf_lag_removed_pct": "VAF without lag",
    "rms_error_deg": "RMS error",
    "gain_margin_low_db": "lower gain margin",
    "gain_margin_high_db": "upper gain margin",
    "phase_margin_deg": "phase margin",
    "delay_margin_s": "delay margin",
    "modulus_margin": "modulus margin",
    "fault_roll_deviation_deg": "roll deviation by a fault",
    "fault_recovery_s": "recovery from a fault",
    "fault_height_loss_m": "height lost by a fault",
    "roll_estimate_error_deg": "roll estimate error",
    "attitude_rate_hz": "ATTITUDE rate",
    "largest_gap_s": "largest gap",
}
"""What a metric is called in sentences."""

MILLISECONDS = ("delay_margin_s", "lag_s", "largest_gap_s")
"""Metrics that sentences give in ms."""


@dataclass(frozen=True)
class Metric:
    """One measurement.

    Attributes:
        name: a key of `METRICS`; the unit is its suffix.
        value: None if it could not be measured; may be infinite (margins).
        unit: of the value.
        limit: text of the limit that was applied, such as "<= 10 %"; None without one.
        outcome: PASS, FAIL or UNSET against the limit, INFO without one.
        reason: why there is no value, or what the value does not say by itself.
        segment: name of the part of the flight it belongs to; empty for the whole flight.
    """

    name: str
    value: float | None
    unit: str
    limit: str | None = None
    outcome: Outcome = Outcome.INFO
    reason: str = ""
    segment: str = ""


def measured(name: str, value: float | None, reason: str = "", segment: str = "") -> Metric:
    """A metric without a limit yet; a value that is None or NaN is UNSET and needs the reason."""
    unit, _ = METRICS[name]
    if value is None or math.isnan(value):
        return Metric(name, None, unit, outcome=Outcome.UNSET, reason=reason, segment=segment)
    return Metric(name, float(value), unit, reason=reason, segment=segment)


@dataclass(frozen=True)
class Limit:
    """A bound on one metric, both ends inclusive, in the unit of the metric's name."""

    metric: str
    minimum: float | None = None
    maximum: float | None = None

    def __str__(self) -> str:
        return self._text(METRICS[self.metric][0], 1.0)

    def for_people(self) -> str:
        """As the metric's value is given in sentences."""
        return self._text(*_shown(self.metric))

    def _text(self, unit: str, factor: float) -> str:
        suffix = "" if unit == "1" else f" {unit}"
        bounds = ((">=", self.minimum), ("<=", self.maximum))
        return " and ".join(f"{sign} {bound * factor:g}{suffix}" for sign, bound in bounds if bound is not None)

    def holds(self, value: float) -> bool:
        """Is the value inside?"""
        if self.minimum is not None and value < self.minimum:
            return False
        return not (self.maximum is not None and value > self.maximum)


STANDING = Limit("oscillation_rad_s", maximum=LIMIT_CYCLE_RAD_S)
"""Applied to every flight unless the scenario limits the oscillation itself: no list of limits lets a
vehicle pass that shakes."""

LIMIT_SETS: Mapping[str, tuple[Limit, ...]] = {
    "practical": (
        STANDING,
        Limit("overshoot_pct", maximum=10.0),
        Limit("rise_time_s", maximum=0.4),
        Limit("delay_margin_s", minimum=0.010),
    ),
    # The study's section 7.1; it does not print the settling band: 5 % is ours.
    "study": (
        STANDING,
        Limit("settling_time_5pct_s", maximum=0.5),
        Limit("overshoot_pct", maximum=0.15),
    ),
    "none": (),
}


def parse_limits(value: Any, path: str | Path, key: str = "limits") -> tuple[Limit, ...]:
    """Limits of a scenario file: the name of a set, or a list of tables {metric, min, max}.

    Raises:
        FileError: unknown set, metric or key, no bound, bounds that exclude each other, or not a number.
    """
    if isinstance(value, str):
        if value not in LIMIT_SETS:
            problem = f'{key}: unknown limit set "{value}"{nearest(value, LIMIT_SETS)}'
            raise FileError(path, problem, f"Sets are {', '.join(LIMIT_SETS)}")
        return LIMIT_SETS[value]
    if not isinstance(value, list):
        raise FileError(path, f"{key} = {value!r} is neither a name nor a list", 'Write limits = "practical"')
    limits = tuple(_parse_limit(entry, path, f"limit {n}") for n, entry in enumerate(value, 1))
    names = [limit.metric for limit in limits]
    for name in names:
        if names.count(name) > 1:
            raise FileError(path, f"{name} is limited twice", "Put min and max into one [[limit]]")
    return limits


def _parse_limit(entry: Any, path: str | Path, key: str) -> Limit:
    if not isinstance(entry, dict) or "metric" not in entry:
        raise FileError(path, f"{key} has no metric", 'Write [[limit]] metric = "overshoot_pct", max = 10.0')
    for name in entry:
        if name not in ("metric", "min", "max"):
            raise FileError(path, f"{key}: unknown key {name!r}", "Keys are metric, min, max")
    name = entry["metric"]
    if name not in METRICS:
        problem = f"{key}: unknown metric {name!r}{nearest(str(name), METRICS)}"
        raise FileError(path, problem, f"Metrics are {', '.join(METRICS)}")
    for bound in ("min", "max"):
        number = entry.get(bound)
        if number is None:
            continue
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            raise FileError(path, f"{key} ({name}): {bound} = {number!r} is not a finite number", "Write a number")
    low, high = entry.get("min"), entry.get("max")
    if low is None and high is None:
        raise FileError(path, f"{key} ({name}) has no bound", "Give min, max or both")
    if low is not None and high is not None and low > high:
        raise FileError(path, f"{key} ({name}): min {low:g} exceeds max {high:g}", "Swap them")
    return Limit(name, None if low is None else float(low), None if high is None else float(high))


def judge(
    metrics: Sequence[Metric], limits: Sequence[Limit], failure: str = ""
) -> tuple[Outcome, str, tuple[Metric, ...]]:
    """The verdict on a flight.

    Args:
        metrics: of the flight and its segments; limits apply to the flight's own (`segment` empty).
        limits: of the scenario; `STANDING` is added unless they limit the oscillation.
        failure: why the flight itself failed (diverged, failsafe, refused, timed out); that is a FAIL
            whatever was measured.

    Returns:
        The outcome, the reason in one line (empty for PASS), and all metrics with limit and outcome filled
        in. FAIL beats UNSET beats PASS. A limited metric that was not measured is UNSET. Without any limit
        a flight that neither failed nor cycles is INFO.
    """
    applied = {limit.metric: limit for limit in (STANDING, *limits)}
    by_name = {metric.name: metric for metric in metrics if not metric.segment}
    checked: dict[str, Metric] = {}
    for name, limit in applied.items():
        metric = by_name.get(name) or measured(name, None, "not measured in this scenario")
        outcome = Outcome.UNSET
        if metric.value is not None:
            outcome = Outcome.PASS if limit.holds(metric.value) else Outcome.FAIL
        checked[name] = dataclasses.replace(metric, limit=str(limit), outcome=outcome)

    complete = [checked.get(m.name, m) if not m.segment else m for m in metrics]
    complete += [metric for name, metric in checked.items() if name not in by_name]
    failed = [_failed(m, applied[m.name]) for m in checked.values() if m.outcome is Outcome.FAIL]
    unset = [f"{TITLES[m.name]} unset: {m.reason}" for m in checked.values() if m.outcome is Outcome.UNSET]
    if failure or failed:
        return Outcome.FAIL, "; ".join(([failure] if failure else []) + failed), tuple(complete)
    if not limits:
        return Outcome.INFO, "no limits set", tuple(complete)
    if unset:
        return Outcome.UNSET, "; ".join(unset), tuple(complete)
    return Outcome.PASS, "", tuple(complete)


def _failed(metric: Metric, limit: Limit) -> str:
    if metric.name == STANDING.metric and metric.reason:
        return metric.reason
    assert metric.value is not None
    unit, factor = _shown(metric.name)
    value = f"{metric.value * factor:.3g}" + ("" if unit == "1" else f" {unit}")
    text = f"{TITLES[metric.name]} {value}, limit {limit.for_people()}"
    return text + (f" ({metric.reason})" if metric.reason else "")


def _shown(name: str) -> tuple[str, float]:
    """Unit of a metric in sentences, and the factor to it from the metric's own."""
    return ("ms", 1000.0) if name in MILLISECONDS else (METRICS[name][0], 1.0)
