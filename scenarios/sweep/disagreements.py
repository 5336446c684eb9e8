"""Where the batch and flights of the same candidates differ: a file for machines, a table for people.

`disagreements.json` holds, beside `schema_version`, `fingerprint` of the plan and `complete` (nothing was broken off):

    tolerances      metric -> unit, absolute (in it), share (of the larger value), judged
    agreeing        how many of the flights do
    flights         one each: candidate, case, case_name, autopilot (own, px4), run (folder beside this file), gain_set;
                    batch_passes (its nominal model), outcome, reason (of the flight), verdicts_agree, agrees,
                    roll_rms_deg (of the difference of the roll angles), reasons (why they differ, as far as known);
                    metrics: metric, unit, batch, flight, difference (flight minus batch), expected (what telemetry
                    alone makes of it), tolerance (of the rest), within (null: not judged), reason; in the unit
    disagreements   those that do not agree: candidate, case, autopilot, run, and all of it in one line, text
    left_out        what was not flown: case, case_name, candidate (null: all), autopilot, reason
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from scenarios.limits import METRICS, TITLES
from scenarios.run_folder import plain, write_atomically
from scenarios.run_reader import StoredRun, read_run
from scenarios.stored_flight import StoredFlight
from scenarios.sweep.as_flown import as_flown
from scenarios.sweep.best_flights import OWN, Flights, FlownPoint, row_of
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.evaluation import measured_names
from scenarios.sweep.explanations import explained
from scenarios.sweep.flight_comparison import TOLERANCES, Compared, Comparison, compare
from scenarios.sweep.plan import Plan
from scenarios.table import UNSET, number

DISAGREEMENTS_JSON = "disagreements.json"
SCHEMA_VERSION = 1


def compare_flights(plan: Plan, dataset: Dataset, flights: Flights, folder: Path) -> tuple[Comparison, ...]:
    """Every flight beside its row, with what is known to set the two apart.

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
        run = runs[point.run]
        flight = _flight_of(run, point)
        if flight is not None:
            row = row_of(plan, dataset, point.candidate, point.case)
            seen = as_flown(plan, point.case, row)
            found.append(explained(plan, compare(plan, point, row, seen.metrics, flight), seen, run, flight))
    return tuple(found)


def _flight_of(run: StoredRun, point: FlownPoint) -> StoredFlight | None:
    beside = run.owns if point.autopilot == OWN and run.owns else run.flights
    return next((one for one in beside if one.name == f"candidate {point.candidate}"), None)


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
        "left_out": [{**asdict(one), "case_name": plan.cases[one.case].name} for one in flights.left_out],
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
        "roll_rms_deg": one.roll_rms_deg,
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
    seen = f"{one.expected:+.3g} expected, " if abs(one.expected) > 1e-3 * abs(one.difference) else ""
    allowed = "" if one.tolerance is None else f" ({seen}{one.tolerance:.3g} allowed)"
    return f"{name} {one.difference:+.3g} {unit}{allowed}"
