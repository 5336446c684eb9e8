"""The result as markdown, for the pages beside the plots of a recording."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from scenarios.flight import FlightRecord, RunRecord
from scenarios.injected_fault import InjectedFault
from scenarios.limits import METRICS, Metric, Outcome
from scenarios.table import COLUMNS, UNSET, assumption_lines, blank_cells, cells, number, own_gains_line

ROLL_GAINS = (
    "MC_ROLL_P",
    "MC_ROLLRATE_K",
    "MC_ROLLRATE_P",
    "MC_ROLLRATE_I",
    "MC_ROLLRATE_D",
    "MC_ROLLRATE_FF",
)
"""Shown first, in this order."""


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]], text_columns: Iterable[int] = (0,)) -> str:
    """A markdown table; columns are right-aligned unless they hold text."""
    left = set(text_columns)
    rules = [":---" if column in left else "---:" for column in range(len(head))]
    lines = [head, rules, *rows]
    return "\n".join("| " + " | ".join(_escape(cell) for cell in line) + " |" for line in lines)


def _escape(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def verdicts(run: RunRecord) -> str:
    """Every gain set's metrics, verdict and reason."""
    passed = sum(flight.outcome is Outcome.PASS for flight in run.flights)
    head = [
        "gain set",
        "verdict",
        *(column.name + (f" [{column.unit}]" if column.unit else "") for column in COLUMNS),
        "why",
    ]
    rows = [
        [
            flight.gain_set.name,
            str(flight.outcome),
            *(f"**{text}**" if outcome is Outcome.FAIL else text for text, outcome in cells(flight)),
            flight.reason,
        ]
        for flight in run.flights
    ]
    warnings = [f"{flight.gain_set.name}: warning: {text}" for flight in run.flights for text in flight.warnings]
    parts = [
        f"### {passed} of {len(run.flights)} gain sets pass on {_vehicle_name(run)}, profile {run.scenario.profile}",
        markdown_table(head, rows, text_columns=(0, 1, len(head) - 1)),
        own_gains_line(run),
        _bullets(["Bold: out of its limit.", *blank_cells(run.flights), *warnings]),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def circumstances(run: RunRecord) -> str:
    """What the verdicts rest on: vehicle, profile, assumptions, limits, gains, versions."""
    parts = [
        f"# {run.scenario.title or run.scenario.name}",
        f"Vehicle {_vehicle_name(run)}, seed {run.scenario.seed}.",
    ]
    derivatives = run.vehicle.get("derivatives")
    if isinstance(derivatives, Mapping):
        sigma = run.vehicle.get("sigma_pct", {})
        rows = [[name, f"{value:g}", f"{sigma.get(name, 0):g}"] for name, value in derivatives.items()]
        parts += ["## Derivatives", markdown_table(("derivative", "value", "sigma %"), rows)]
    limits = [str(limit.metric) + " " + str(limit) for limit in run.scenario.limits]
    parts += ["## Limits", _bullets(limits) if limits else "None."]
    parts += ["## Profile and assumptions", _bullets(assumption_lines(run))]
    parts += ["## Gains", gains_table(run.flights)]
    parts += [_bullets(f"{f.gain_set.name}: {f.gain_set.source}" for f in run.flights if f.gain_set.source)]
    if run.versions:
        parts += ["## Versions", _bullets(f"{name} {version}" for name, version in run.versions.items())]
    return "\n\n".join(parts) + "\n"


def flight_page(flight: FlightRecord) -> str:
    """One flight: verdict, gains, every metric that was measured or limited."""
    parts = [f"# {flight.outcome}: {flight.gain_set.name}"]
    parts += [flight.reason] if flight.reason else []
    parts += [f"On {flight.vehicle_spec}. {flight.gain_set.source}"]
    whole = [metric for metric in flight.metrics if not metric.segment]
    limited = [metric for metric in whole if metric.limit is not None]
    if limited:
        rows = [[metric.name, _value(metric), metric.limit or "", str(metric.outcome)] for metric in limited]
        parts += ["## Limits", markdown_table(("metric", "value", "limit", "outcome"), rows, (0, 2, 3))]
    rest = [metric for metric in whole if metric.limit is None]
    measured = [[metric.name, _value(metric)] for metric in rest if metric.value is not None]
    if measured:
        parts += ["## Also measured", markdown_table(("metric", "value"), measured)]
    missing = [f"{metric.name}: {metric.reason}" for metric in whole if metric.value is None]
    if missing:
        parts += ["## Not measured", _bullets(missing)]
    parts += ["## Gains", gains_table([flight])]
    if flight.faults:
        parts += ["## Faults", _bullets(_when(fault) for fault in flight.faults)]
    if flight.warnings:
        parts += ["## Warnings", _bullets(flight.warnings)]
    if flight.timing:
        parts += ["## Timing", flight.timing]
    return "\n\n".join(parts) + "\n"


def _when(fault: InjectedFault) -> str:
    if fault.start_s is None:
        return f"{fault.text}: never injected ({fault.plan})"
    return f"{fault.text}: from {fault.start_s:.2f} s" + ("" if fault.end_s is None else f" to {fault.end_s:.2f} s")


MARGINS = (
    ("gain_margin_low_db", "gain margin, less [dB]"),
    ("gain_margin_high_db", "gain margin, more [dB]"),
    ("phase_margin_deg", "phase margin [deg]"),
    ("delay_margin_s", "delay margin [s]"),
    ("modulus_margin", "modulus margin [-]"),
)


def margins_and_gains(flights: Sequence[FlightRecord]) -> str:
    """Margins of the roll loop, and the parameters of each gain set, one row each."""
    names = _parameter_names(flights)
    rows = [
        [
            flight.gain_set.name,
            *(UNSET if flight.margins.get(key) is None else f"{flight.margins[key]:.3g}" for key, _ in MARGINS),
            *(_gain(flight.gain_set.parameters.get(name)) for name in names),
        ]
        for flight in flights
    ]
    return markdown_table(("gain set", *(title for _, title in MARGINS), *names), rows)


def _parameter_names(flights: Sequence[FlightRecord]) -> list[str]:
    """Of all gain sets, those of roll first."""
    names = list(dict.fromkeys(name for flight in flights for name in flight.gain_set.parameters))
    return sorted(names, key=lambda name: (ROLL_GAINS.index(name) if name in ROLL_GAINS else len(ROLL_GAINS), name))


def gains_table(flights: Sequence[FlightRecord]) -> str:
    """Parameters of each flight's gain set, one row each."""
    names = _parameter_names(flights)
    rows = [[name, *(_gain(flight.gain_set.parameters.get(name)) for flight in flights)] for name in names]
    return markdown_table(("parameter", *(flight.gain_set.name for flight in flights)), rows)


def _gain(value: float | None) -> str:
    return UNSET if value is None else f"{value:g}"


def _value(metric: Metric) -> str:
    unit = METRICS.get(metric.name, (metric.unit, ""))[0]
    finite = metric.value is not None and math.isfinite(metric.value)
    text = f"{metric.value:.3g}" if finite else number(metric.value)
    return text if unit == "1" or metric.value is None else f"{text} {unit}"


def _vehicle_name(run: RunRecord) -> str:
    return str(run.vehicle.get("name") or run.scenario.vehicle)


def _bullets(lines: Iterable[Any]) -> str:
    return "\n".join(f"- {line}" for line in lines)
