"""`froude restore`: give vehicles their own parameters back that a flight which ended badly has left changed."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bridge.param_operation import ParamValue
    from bridge.peer_identity import PeerIdentity
    from scenarios.restore_tasks import RestoreResult, RestoreTask

EXIT_OK = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude restore`."""
    add = parser.add_argument
    add(
        "what",
        nargs="*",
        type=Path,
        metavar="JOURNAL|RUN_FOLDER|FILE.backup.params",
        help="what to put back (default: everything that is pending)",
    )
    add("--connect", metavar="URL", help="the vehicle's link, if it is not the one of the flight")
    add("--list", action="store_true", help="show what is pending and change nothing")
    add("--yes-other-vehicle", action="store_true", help="also onto another vehicle than the one it is of")
    add("--json", action="store_true", help="for machines")


def run(args: argparse.Namespace, *, tell: Callable[[str], object]) -> int:
    """Restore, or list, and print the result.

    Args:
        args: the parsed arguments. tell: prints a line for people on standard error.

    Returns:
        exit status: 0 done or nothing pending, 2 a file that cannot be used, 3 the link or the vehicle.
    """
    from bridge import exposure
    from scenarios import interrupts
    from scenarios.param_journal import state_folder
    from scenarios.progress import spinner
    from scenarios.restore_tasks import find_tasks, restore

    # without a word on the link --list shows every file, a backup that needs one, too
    tasks, problems = find_tasks(args.what, args.connect or ("" if args.list else None))
    for problem in problems:
        tell(str(problem))
    status = max((problem.exit_status for problem in problems), default=EXIT_OK)
    if args.list or not tasks:
        if args.json:
            key = "pending" if args.list else "restored"
            _print(json.dumps({"folder": str(state_folder()), key: [task_object(task) for task in tasks]}, indent=2))
        elif tasks:
            _print(_list_text(tasks))
        elif not problems:
            _print(f"Nothing is pending: no journal in {state_folder()}.")
        return status
    for line in exposure.warnings((task.url for task in tasks), exposure.FIRST):
        tell(line)
    done: list[RestoreResult] = []
    with interrupts.caught(lambda: tell("stopping: what is not put back yet is kept")), spinner() as show:
        for result in restore(tasks, any_vehicle=args.yes_other_vehicle, show=show):
            done.append(result)
            if result.problem is not None:
                tell(f"{result.problem}. Not restored: {result.task.path}")
                status = max(status, result.problem.exit_status)
            elif not args.json:
                _print(_result_text(result))
    if args.json:
        _print(json.dumps({"restored": [result_object(result) for result in done]}, indent=2))
    return status


def _print(text: str) -> None:
    if sys.stdout is not None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


# -- for machines ----------------------------------------------------------------------------------------------------


def task_object(task: RestoreTask) -> dict[str, Any]:
    """What is pending, as plain data.

    Args:
        task: it.
    """
    owner = task.owed.owner
    return {
        "file": str(task.path),
        "journal": task.is_journal,
        "utc": owner.utc,
        "vehicle": _vehicle_object(owner.vehicle) if task.is_journal else None,
        "gain_set": owner.gain_set,
        "run": owner.run,
        "command": list(owner.command),
        "in_use": task.owed.busy,
        "parameters": [
            {"name": entry.name, "type": entry.value.type, "was": _value_object(entry.value)}
            | {"set_to": None if entry.set_to is None else _value_object(entry.set_to)}
            for entry in task.owed.entries
        ],
    }


def result_object(result: RestoreResult) -> dict[str, Any]:
    """What became of it, as plain data.

    Args:
        result: it.
    """
    return {
        "file": str(result.task.path),
        "vehicle": None if result.vehicle is None else _vehicle_object(result.vehicle),
        "restored": result.problem is None,
        "problem": "" if result.problem is None else str(result.problem),
        "parameters": [
            {"name": one.name, "type": one.before.type, "found": _value_object(one.before)}
            | {"put_back": _value_object(one.entry.value), "changed_by_others": one.by_others}
            for one in result.parameters or ()
        ],
    }


def _vehicle_object(vehicle: PeerIdentity) -> dict[str, Any]:
    return {"url": vehicle.url, "sysid": vehicle.sysid, "uid": vehicle.uid, "uid2": vehicle.uid2.hex()}


def _value_object(value: ParamValue) -> dict[str, Any]:
    """Number and bits; a number that JSON cannot write is null."""
    return {"value": value.value if math.isfinite(value.value) else None, "bits": _bits(value)}


# -- for people ------------------------------------------------------------------------------------------------------


def _list_text(tasks: Sequence[RestoreTask]) -> str:
    rows = [["written (UTC)", "vehicle", "parameters", "gain set", "run, journal"]]
    for task in tasks:
        owner = task.owed.owner
        vehicle = str(owner.vehicle) if task.is_journal else "not known"
        in_use = " (in use by a flight)" if task.owed.busy else ""
        files = ", ".join(part for part in (owner.run, f"{task.path}{in_use}") if part)
        rows.append([_when(owner.utc), vehicle, str(len(task.owed.entries)), owner.gain_set or "–", files])
    return _columns(rows)


def _result_text(result: RestoreResult) -> str:
    owner = result.task.owed.owner
    of = f"{owner.gain_set}, {_when(owner.utc)} UTC" if result.task.is_journal else str(result.task.path)
    head = f"{result.vehicle}: {of}"
    if result.parameters is None:
        return f"{head}\nIt has been put back by another froude meanwhile."
    rows = [["parameter", "found", "put back", ""]]
    for one in result.parameters:
        remark = "" if one.changed else "was right"
        if one.by_others:
            remark = f"changed by somebody else since: {one.entry.set_to} had been set"
        rows.append([one.name, _shown(one.before), _shown(one.entry.value), remark])
    changed = sum(one.changed for one in result.parameters)
    end = f"{len(result.parameters)} parameters put back and read back; {changed} had been changed."
    return "\n".join([head, _columns(rows), end + (" Journal deleted." if result.task.is_journal else "")])


def _when(utc: str) -> str:
    """A file name's `20261122T200455Z` as people write it."""
    return f"{utc[:4]}-{utc[4:6]}-{utc[6:8]} {utc[9:11]}:{utc[11:13]}:{utc[13:15]}" if len(utc) == 16 else utc or "–"


def _shown(value: ParamValue) -> str:
    return str(value) if math.isfinite(value.value) else f"{value} ({_bits(value)})"


def _bits(value: ParamValue) -> str:
    return f"0x{int.from_bytes(value.raw, 'little'):08x}"


def _columns(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]))]
    return "\n".join("  ".join(cell.ljust(widths[n]) for n, cell in enumerate(row)).rstrip() for row in rows)
