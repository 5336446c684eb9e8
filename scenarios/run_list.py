"""The runs of a folder: which there are, the newest, and what a line can say of each.

A line reads `run.json` and nothing else, and of a folder with thousands of runs only those that are shown are read.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bridge.clock import utc_stamp
from scenarios.flight_import import is_recording
from scenarios.run_reader import RUN_JSON, STAMPED, load_json
from scenarios.run_schema import SCHEMA_VERSION
from scenarios.stored_flight import FLIGHTS
from sitl.errors import FileError

VERDICTS = ("PASS", "FAIL", "UNSET", "INFO")


@dataclass(frozen=True)
class RunSummary:
    """A run in one line.

    Attributes:
        folder: of the run. started_utc: `2026-11-22T20:00:00Z`, empty if not known.
        scenario: its name. vehicle: its spec, or name.
        autopilot: "own", "PX4", "board", "recorded", or "other" behind a link.
        verdicts: verdict -> number of gain sets.
        best: of the gain sets that passed the one closest to its set-point; empty if there is none.
        complete: flown to its end and written. problem: why not, or what hinders reading it; empty if nothing.
    """

    folder: Path
    started_utc: str = ""
    scenario: str = ""
    vehicle: str = ""
    autopilot: str = ""
    verdicts: Mapping[str, int] = field(default_factory=dict)
    best: str = ""
    complete: bool = False
    problem: str = ""

    @property
    def flown(self) -> int:
        """Number of gain sets that have a verdict."""
        return sum(self.verdicts.values())


def run_folders(out: Path) -> list[Path]:
    """Folders of runs, the newest first; a link to a run in the same folder is not counted twice.

    Args:
        out: where runs are kept.

    Returns:
        Empty if there are none, or no such folder.

    Raises:
        FileError: the folder cannot be read.
    """
    try:
        with os.scandir(out) as entries:
            found = list(entries)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise FileError(out, f"cannot be read: {error.strerror or error}", "Give another folder with --out") from error
    runs = []
    for entry in found:
        key = _run_key(entry)
        if key is not None and not (entry.is_symlink() and Path(entry.path).resolve().parent == out.resolve()):
            runs.append((key, Path(entry.path)))
    return [path for _, path in sorted(runs, reverse=True)]


def newest(out: Path) -> Path | None:
    """The folder of the run that was begun last; None if there is none.

    Args:
        out: where runs are kept.

    Raises:
        FileError: the folder cannot be read.
    """
    return next(iter(run_folders(out)), None)


def list_runs(out: Path, *, last: int | None = None, part: str = "") -> list[RunSummary]:
    """Runs of a folder, the newest first.

    Args:
        out: where runs are kept. last: at most so many. part: only those with it in their folder's name, in any case.

    Raises:
        FileError: the folder cannot be read; a run that cannot is in the list, with its problem.
    """
    folders = [folder for folder in run_folders(out) if part.casefold() in folder.name.casefold()]
    return [summary(folder) for folder in folders[:last]]


def _run_key(entry: os.DirEntry[str]) -> tuple[str, int, str] | None:
    """What a run is sorted by: its date, then its number in that second; None if it is no run."""
    try:
        if entry.name.startswith(".") or not entry.is_dir():
            return None
        stamp = STAMPED.fullmatch(entry.name)
        if stamp is not None:
            return entry.name[:16], int(stamp.group(9) or 1), entry.name
        # renamed by somebody: its date is that of what is in it
        for inside in (RUN_JSON, FLIGHTS):
            path = Path(entry.path, inside)
            if path.exists():
                return utc_stamp(path.stat().st_mtime_ns // 1000), 1, entry.name
    except OSError:
        return None
    return None


def summary(folder: Path) -> RunSummary:
    """One line's worth of a run; what cannot be read of it is left empty and told.

    Args:
        folder: of the run.
    """
    stamp = STAMPED.fullmatch(folder.name)
    started = scenario = vehicle = ""
    if stamp:
        year, month, day, hour, minute, second, scenario, vehicle = stamp.groups()[:8]
        started = f"{year}-{month}-{day}T{hour}:{minute}:{second}Z"
    try:
        run, told = load_json(folder / RUN_JSON)
    except FileError as error:
        return RunSummary(folder, started, scenario, vehicle, problem=f"{RUN_JSON} {error.problem}")
    version = run.get("schema_version") if isinstance(run, dict) else None
    if not isinstance(version, int):
        return RunSummary(folder, started, scenario, vehicle, problem=f"{RUN_JSON} is not of froude")
    if version > SCHEMA_VERSION:
        problem = f"written by a newer froude (schema_version {version})"
        return RunSummary(folder, started, scenario, vehicle, problem=problem)
    flights = [flight for flight in _list(run, "flights") if isinstance(flight, dict)]
    counted = Counter(flight.get("outcome") for flight in flights if isinstance(flight.get("outcome"), str))
    complete = run.get("complete") is True
    return RunSummary(
        folder,
        _text(run, "started_utc") or started,
        _text(_object(run, "scenario"), "name") or scenario,
        _text(_object(run, "vehicle"), "spec") or _text(_object(run, "vehicle"), "name") or vehicle,
        autopilot([word for word in _list(run, "command") if isinstance(word, str)]),
        {verdict: counted[verdict] for verdict in VERDICTS if counted[verdict]},
        best(flights),
        complete and not told,
        "; ".join([*told, *([] if complete else ["interrupted"])]),
    )


def autopilot(command: Iterable[str]) -> str:
    """Which autopilot flew, as far as the command tells: "own", "PX4", "board", or "other" that was there already.

    A flight that was imported is "recorded", whoever flew it.

    Args:
        command: as typed, word by word.
    """
    options: dict[str, str] = {}
    words = list(command)
    for word, after in zip(words, (*words[1:], ""), strict=False):
        name, equals, value = word.partition("=")
        options[name] = value if equals else after
    if any(is_recording(Path(word)) for word in words):
        return "recorded"
    if "--px4" in options:
        return "PX4"
    if "--hil" in options:
        return "board" if options["--hil"].startswith("serial") else "PX4"
    return "other" if options.get("--connect", "memory").partition(":")[0] != "memory" else "own"


def best(flights: Sequence[Mapping[str, Any]]) -> str:
    """Of those that pass the one closest to its set-point: least RMS error, without tracking the shortest rise.

    Args:
        flights: as in `run.json`, perhaps damaged.

    Returns:
        The gain set's name; empty if none passed.
    """

    def rank(flight: Mapping[str, Any]) -> tuple[float, float]:
        values = {
            metric.get("name"): metric.get("value")
            for metric in _list(flight, "metrics")
            if isinstance(metric, dict) and metric.get("segment") == "" and isinstance(metric.get("name"), str)
        }
        error, rise = (values.get(name) for name in ("rms_error_deg", "rise_time_s"))
        return tuple(float(v) if isinstance(v, int | float) else math.inf for v in (error, rise))  # type: ignore[return-value]

    passed = [flight for flight in flights if flight.get("outcome") == "PASS"]
    return _text(_object(min(passed, key=rank), "gain_set"), "name") if passed else ""


def _object(value: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    inner = value.get(key)
    return inner if isinstance(inner, dict) else {}


def _list(value: Mapping[str, Any], key: str) -> list[Any]:
    inner = value.get(key)
    return inner if isinstance(inner, list) else []


def _text(value: Mapping[str, Any], key: str) -> str:
    inner = value.get(key)
    return inner if isinstance(inner, str) else ""
