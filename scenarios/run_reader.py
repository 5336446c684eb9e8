"""A run on disk, read back: whole, interrupted, half-written, damaged, or of an older froude.

    run = read_run(Path("logs/20261122T200000Z_demo_ANT-X"))
    run.data["flights"][0]["outcome"]      # run.json in the present schema, every key there
    run.flights[0].files["rrd"]            # what exists of a flight's files
    run.telemetry(run.flights[0])          # read when asked for; None if there is none
    run.problems                           # what is missing or damaged, a sentence each

Only what is no run at all, or was written by a newer froude, is refused.
"""

from __future__ import annotations

import contextlib
import json
import re
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.run_schema import SCHEMA_VERSION, NewerError, migrate
from scenarios.run_shape import RUN, conform, nothing
from scenarios.stored_flight import FLIGHTS, OWN, StoredFlight, damage, find_files, from_files, split_name
from sitl.errors import FileError, FroudeError, UsageError
from sitl.keyed_table import nearest

if TYPE_CHECKING:
    from scenarios.telemetry import Telemetry

RUN_JSON, COMPARE, REPORT = "run.json", "compare.rrd", "report.html"
LARGEST_JSON = 400_000_000
"""Bytes. A run of a thousand gain sets has a twentieth of it."""

STAMPED = re.compile(r"(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)Z_(.+?)_([^_]+?)(?:_(\d+))?")
"""Name of a run's folder: date, time, scenario, vehicle, and a number for the second of its kind in one second."""


_HALF = re.compile(r"\\u[dD][89a-fA-F]")


class StoredRun:
    """A run on disk; get it from `read_run`.

    Attributes:
        folder: of the run.
        data: what `run.json` holds, in the present schema, every key of `scenarios/run_shape.py` there. Without a
            readable `run.json`: put together from the names and files of the folder, `complete` false.
        known: `run.json` was there and could be read.
        flights: the gain sets, in the order flown (by name without a `run.json`).
        baseline: the own gains, if they were flown along; not known without a `run.json`.
        owns: flights of our own autopilot beside a real one.
    """

    def __init__(
        self,
        folder: Path,
        data: dict[str, Any],
        flights: Iterable[StoredFlight],
        baseline: StoredFlight | None,
        owns: Iterable[StoredFlight],
        problems: Iterable[str],
        *,
        known: bool,
    ) -> None:
        self.folder = folder
        self.data: Mapping[str, Any] = data
        self.known = known
        self.flights = tuple(flights)
        self.baseline = baseline
        self.owns = tuple(owns)
        self._problems = dict.fromkeys(problems)

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.folder.name

    @property
    def complete(self) -> bool:
        """Flown to its end and written."""
        return self.known and bool(self.data["complete"])

    @property
    def problems(self) -> tuple[str, ...]:
        """What is missing or damaged; telemetry's damage is added when it is read."""
        return tuple(self._problems)

    @property
    def compare(self) -> Path | None:
        """The recording of all gain sets; None if it is not there."""
        path = self.folder / COMPARE
        return path if path.is_file() else None

    @property
    def report(self) -> Path:
        """Where the page is, or would be."""
        return self.folder / REPORT

    @property
    def everything(self) -> tuple[StoredFlight, ...]:
        """Flights, baseline and those of our own autopilot."""
        return (*self.flights, *((self.baseline,) if self.baseline else ()), *self.owns)

    def flight(self, name: str) -> StoredFlight:
        """A flight by the name of its gain set, its slug, or a unique part of one of them, in any case.

        Args:
            name: as typed.

        Raises:
            UsageError: none, or several.
        """
        wanted = name.casefold()
        exact = [one for one in self.everything if wanted in (one.slug.casefold(), one.name.casefold())]
        found = exact[:1] or [one for one in self.everything if wanted in one.slug or wanted in one.name.casefold()]
        if len(found) == 1:
            return found[0]
        names = [one.name + (" (own autopilot)" if one.own else "") for one in self.everything]
        if found:
            raise UsageError(f"{self.folder}: {name!r} is in the names of several flights. It has {', '.join(names)}")
        if not names:
            raise UsageError(f"{self.folder}: holds no flight, and so none that is called {name!r}")
        raise UsageError(f"{self.folder}: no flight {name!r}{nearest(name, names)}. It has {', '.join(names)}")

    def telemetry(self, flight: StoredFlight) -> Telemetry | None:
        """A flight's telemetry, read from its Parquet.

        Args:
            flight: one of this run, own and baseline, too.

        Returns:
            None if there is none or it cannot be read; then `problems` says why. Telemetry that does not have the
            fingerprint that was written with it is given all the same, and told.
        """
        from scenarios.telemetry import Telemetry, column_names

        if flight.parquet is None:
            return None
        place = f"{FLIGHTS}/{flight.parquet.name}"
        try:
            telemetry, about = Telemetry.from_parquet(flight.parquet)
        except FroudeError as error:
            problem = error.problem if isinstance(error, FileError) else str(error)
            self._problems[f"{place} {problem}"] = None
            return None
        written = about.get("telemetry_sha256")
        # an older file has fewer columns, and its fingerprint is of those
        found = telemetry.sha256(column_names(flight.parquet))
        if {written, flight.data["telemetry_sha256"] or written} != {found}:
            self._problems[f"{place} is not what was flown: its fingerprint (telemetry_sha256) is another"] = None
        return telemetry


def read_run(path: Path) -> StoredRun:
    """Read a run as far as it is there.

    Args:
        path: the run's folder, or any file of it.

    Raises:
        FileError: there is no run, or a newer froude wrote it.
    """
    folder = folder_of(path)
    try:
        files = find_files(folder)
    except OSError as error:
        raise FileError(folder / FLIGHTS, f"cannot be read: {error.strerror or error}", "Check permissions") from error
    problems: list[str] = []
    data = None
    try:
        raw, told = load_json(folder / RUN_JSON)
        data, wrong = conform(migrate(raw, folder / RUN_JSON))
        problems += [*told, *(f"{RUN_JSON}: {one}" for one in wrong)]
    except NewerError:
        raise
    except FileError as error:
        if not files and not _may_be_run(folder):
            raise _no_run(folder, error) from error
        why = "" if (folder / RUN_JSON).exists() else ": the run was killed, or is still being flown"
        problems.append(
            f"{RUN_JSON} {error.problem}{why}. Segments, limits and assumptions are not known; the rest is read off "
            "the flights' files"
        )
    if data is None:
        return _from_files(folder, files, problems)
    return _from_json(folder, data, files, problems)


def folder_of(path: Path) -> Path:
    """The folder of the run that a folder or file belongs to; it need not be a run.

    Args:
        path: a folder, its `run.json`, `compare.rrd` or `report.html`, or a file in its `flights`.

    Raises:
        FileError: there is nothing of that name.
    """
    try:
        if path.is_dir():
            return path.parent if path.name == FLIGHTS and not (path / RUN_JSON).exists() else path
        if path.exists():
            return path.parent.parent if path.parent.name == FLIGHTS else path.parent
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read: {error}", "Give the folder of a run") from error
    raise FileError(path, "there is no such file or folder", "Give the folder of a run; `froude review --list`")


def load_json(file: Path) -> tuple[Any, list[str]]:
    """What a `run.json` holds, unchecked, and what was noticed on the way, a sentence each.

    Raises:
        FileError: no such file, no plain file, too large, or not JSON.
    """
    remedy = "Give the folder of a run"
    try:
        if not file.is_file():
            raise FileError(file, "is missing" if not file.exists() else "is no file", remedy)
        if file.stat().st_size > LARGEST_JSON:
            raise FileError(file, f"has more than {LARGEST_JSON // 10**6} MB", remedy)
        raw = file.read_bytes()
    except OSError as error:
        raise FileError(file, f"cannot be read: {error.strerror or error}", remedy) from error
    told = []
    try:
        text = raw.decode()
    except UnicodeDecodeError as error:
        text = raw.decode(errors="replace")
        told.append(f"{RUN_JSON} is damaged: byte {error.start} is no text")
    try:
        # JSON has no NaN; where damage or another program made one, it is no value
        run = json.loads(text, parse_constant=lambda _: None)
        return (_encodable(run) if _HALF.search(text) else run), told
    except ValueError as error:
        raise FileError(file, f"is not JSON: {error}", remedy) from error
    except RecursionError:
        raise FileError(file, "is not JSON of a run: it is nested too deeply", remedy) from None


def _encodable(value: Any) -> Any:
    """Half a character, which JSON can write and no output takes, becomes `?`."""
    if isinstance(value, str):
        return value.encode(errors="replace").decode()
    if isinstance(value, list):
        return [_encodable(item) for item in value]
    return {_encodable(key): _encodable(item) for key, item in value.items()} if isinstance(value, dict) else value


def _no_run(folder: Path, error: FileError) -> FileError:
    if (folder / RUN_JSON).exists():
        return error
    inside = []
    with contextlib.suppress(OSError):
        inside = [entry.name for entry in folder.iterdir() if (entry / RUN_JSON).is_file()]
    if inside:
        remedy = f"It holds {len(inside)} of them: froude review --out {shlex.quote(str(folder))} --list"
    else:
        remedy = "Give the folder of a run; `froude review --list` shows those in logs"
    return FileError(folder, f"is no run: neither {RUN_JSON} nor files of flights are in it", remedy)


def _may_be_run(folder: Path) -> bool:
    return (folder / FLIGHTS).is_dir() and STAMPED.fullmatch(folder.resolve().name) is not None


def _from_json(folder: Path, data: dict[str, Any], files: dict[str, dict[str, Path]], problems: list[str]) -> StoredRun:
    if not data["complete"]:
        problems.append("the run was interrupted: flights that are not listed were not flown")
    if not (folder / COMPARE).is_file():
        problems.append(f"{COMPARE} is missing")
    elif wrong := damage("rrd", folder / COMPARE):
        problems.append(f"{COMPARE} {wrong}")
    left = dict(files)

    def stored(flight: dict[str, Any], own: bool = False) -> StoredFlight:
        slug = _slug(flight, own)
        found = left.pop(slug, {})
        name = flight["gain_set"]["name"] or slug
        problems.extend(_file_problems(slug, flight, found))
        return StoredFlight(name, slug, flight, found, own=own)

    flights = [stored(flight) for flight in data["flights"]]
    baseline = None if data["baseline"] is None else stored(data["baseline"])
    owns = [stored(twin["own"], own=True) for twin in data["twins"]]
    for slug, found in left.items():
        # killed while it was stopping: files of a flight that its run.json does not know
        extra, told = from_files(slug, found)
        problems.append(f"{RUN_JSON} does not tell of the flight {slug}; what is known of it is read off its files")
        problems.extend(told)
        (owns if extra.own else flights).append(extra)
    return StoredRun(folder, data, flights, baseline, owns, problems, known=True)


def _from_files(folder: Path, files: dict[str, dict[str, Path]], problems: list[str]) -> StoredRun:
    data: dict[str, Any] = nothing(RUN) | {"schema_version": SCHEMA_VERSION, "folder": str(folder)}
    stamp = STAMPED.fullmatch(folder.resolve().name)
    if stamp:
        year, month, day, hour, minute, second, scenario, vehicle = stamp.groups()[:8]
        data["started_utc"] = f"{year}-{month}-{day}T{hour}:{minute}:{second}Z"
        data["scenario"]["name"] = scenario
        data["vehicle"]["name"] = vehicle
    flights = []
    for slug, found in files.items():
        flight, told = from_files(slug, found)
        problems += [*told, *_file_problems(slug, {"files": {}}, found)]
        if not flight.finished:
            problems.append(f"flight {flight.name} was not finished: {_left(flight)}")
        flights.append(flight)
    candidates = [one for one in flights if not one.own]
    data["flights"] = [one.data for one in candidates]
    data["flown"] = len(candidates)
    if not flights:
        problems.append("no flight was recorded")
    specs = [one.data["vehicle"] for one in flights if one.data["vehicle"]]
    if specs:
        data["vehicle"]["spec"] = data["scenario"]["vehicle"] = specs[0]
    return StoredRun(folder, data, candidates, None, [one for one in flights if one.own], problems, known=False)


def _left(flight: StoredFlight) -> str:
    """What a killed flight has left."""
    kinds = [kind for kind in ("partial.rrd", "partial.tlog") if kind in flight.files]
    if not kinds:
        return "neither recording nor log are left"
    span = flight.log_span_s()
    until = "" if span is None else f" up to {span[1]:.1f} s of vehicle time"
    return f"{' and '.join(f'{FLIGHTS}/{flight.files[kind].name}' for kind in kinds)} open{until}"


def _slug(flight: Mapping[str, Any], own: bool) -> str:
    for listed in flight["files"].values():
        slug, kind = split_name(Path(listed).name)
        if kind:
            return slug
    from scenarios.gain_set import GainSet

    return GainSet(flight["gain_set"]["name"], {}).slug + (OWN if own else "")


def _file_problems(slug: str, flight: Mapping[str, Any], found: Mapping[str, Path]) -> list[str]:
    missing = [kind for kind in flight["files"] if kind not in found]
    told = [f"{FLIGHTS}/{slug}.{kind} is missing" for kind in missing]
    return told + [f"{FLIGHTS}/{path.name} {wrong}" for kind, path in found.items() if (wrong := damage(kind, path))]
