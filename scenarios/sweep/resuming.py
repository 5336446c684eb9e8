"""Going on with a sweep: the plan that a dataset was begun with, or why it cannot be gone on with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from scenarios.sweep.dataset import Dataset
from scenarios.sweep.plan import Plan, make_plan, plain
from scenarios.sweep.program import program_facts
from scenarios.sweep.sweep_file import load_sweep
from sitl.errors import FileError, UsageError


def plan_of(dataset: Dataset, path: Path | None = None, *, same_program: bool = True) -> Plan:
    """The plan of a dataset.

    Args:
        dataset: begun before. path: of the sweep file; where it was read from without.
        same_program: rows are to be added: only by the program that began it.

    Raises:
        FileError: the dataset is of another schema or another sweep, or the file has gone; names what differs.
        UsageError: another version of the program began it: its rows would not be of one kind.
    """
    facts = dataset.facts()
    source = path or Path(facts["file"])
    if not source.is_file():
        raise FileError(source, "the sweep file is not there any more", "Name it: froude sweep SWEEP.toml --resume DIR")
    plan = make_plan(load_sweep(source))
    if plan.fingerprint != facts["fingerprint"]:
        mine = json.loads(json.dumps(plan.description(), sort_keys=True, default=plain))
        raise FileError(
            dataset.path,
            f"was begun with another sweep than {source} is now: {difference(facts['plan'], mine)}",
            "Put that back, or start a new sweep without --resume",
        )
    here = program_facts() if same_program else {}
    for name in here:
        if facts.get(name) != here[name]:
            differing = difference({name: facts.get(name)}, {name: here[name]})
            raise UsageError(
                f"{dataset.path}: was begun with another version of the program: {differing}. Its rows would not be of "
                "one kind: go on with that version, or start a new sweep"
            )
    return plan


def difference(before: Any, now: Any, where: str = "") -> str:
    """The first thing that two descriptions do not share, for people.

    Args:
        before, now: as JSON has them. where: name of the place.
    """
    if isinstance(before, dict) and isinstance(now, dict):
        for key in dict.fromkeys([*before, *now]):
            if before.get(key) != now.get(key):
                return difference(before.get(key), now.get(key), f"{where}.{key}" if where else str(key))
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for k, (one, other) in enumerate(zip(before, now, strict=True)):
            if one != other:
                return difference(one, other, f"{where}[{k}]")
    return f"{where} was {_short(before)}, is {_short(now)}"


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."
