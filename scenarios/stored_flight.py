"""One flight of a run on disk: what `run.json` says of it, or, where there is none, what its files tell.

    flights/<slug>.rrd .parquet .tlog .params .backup.params        a flight that was flown to its end
    flights/<slug>.partial.rrd .partial.tlog .params .backup.params one that was killed
    flights/<slug>.own...                                           our own autopilot beside a real one

Nothing here opens a big file unless it is asked for.
"""

from __future__ import annotations

import json
import mmap
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.tlog import SIMULATED_EPOCH_US, whole_frames
from scenarios.run_shape import FLIGHT, METRIC, fitted, nothing
from sitl.errors import FileError

FLIGHTS = "flights"
OWN = ".own"
SUFFIXES = (".partial.rrd", ".partial.tlog", ".backup.params", ".rrd", ".parquet", ".tlog", ".params")
"""Longest first: `x.partial.rrd` is no `.rrd`."""

_SEVERITIES = {"CRITICAL": 2, "ERROR": 3, "WARN": 4, "INFO": 6, "DEBUG": 7}
"""MAV_SEVERITY of each of Rerun's levels that a recording of ours has."""


@dataclass(frozen=True, eq=False)
class StoredFlight:
    """A flight of a stored run.

    Attributes:
        name: of its gain set. slug: the same as a file name; unique in the run.
        data: as in `run.json`; every key is there.
        files: kind without its first dot (`rrd`, `partial.rrd`, `parquet`, `tlog`, `partial.tlog`, `params`,
            `backup.params`) -> path; only what exists.
        known: `run.json` tells of it; False: put together from its files. Then segments and limits are not known, and
            verdict and metrics only if its recording was finished.
        own: our own autopilot flew it beside a real one.
    """

    name: str
    slug: str
    data: Mapping[str, Any]
    files: Mapping[str, Path]
    known: bool = True
    own: bool = False

    @property
    def outcome(self) -> str:
        """PASS, FAIL, UNSET or INFO."""
        return str(self.data["outcome"])

    @property
    def finished(self) -> bool:
        """Its recording was finished; False: killed in flight, or nothing was recorded."""
        return "rrd" in self.files

    @property
    def recording(self) -> Path | None:
        """Its .rrd, a partial one if there is no other."""
        return self.files.get("rrd") or self.files.get("partial.rrd")

    @property
    def log(self) -> Path | None:
        """Its .tlog, a partial one if there is no other."""
        return self.files.get("tlog") or self.files.get("partial.tlog")

    @property
    def parquet(self) -> Path | None:
        """Its telemetry."""
        return self.files.get("parquet")

    def metric(self, name: str, segment: str = "") -> Mapping[str, Any] | None:
        """The flight's metric of that name, or one segment's; None if it is not there."""
        for metric in self.data["metrics"]:
            if metric["name"] == name and metric["segment"] == segment:
                found: Mapping[str, Any] = metric
                return found
        return None

    def log_span_s(self) -> tuple[float, float] | None:
        """Vehicle time of the first and the last whole frame of the .tlog, s; None without one. Reads the file."""
        return None if self.log is None else log_span_s(self.log)


def find_files(folder: Path) -> dict[str, dict[str, Path]]:
    """Files of all flights of a run: slug -> kind -> path; own flights have slugs that end in `.own`.

    Args:
        folder: the run's.

    Raises:
        OSError: the folder cannot be read.
    """
    found: dict[str, dict[str, Path]] = {}
    where = folder / FLIGHTS
    if not where.is_dir():
        return found
    with os.scandir(where) as entries:
        for entry in sorted(entries, key=lambda one: one.name):
            slug, kind = split_name(entry.name)
            if kind and not slug.startswith(".") and entry.is_file():
                found.setdefault(slug, {})[kind] = Path(entry.path)
    return found


def split_name(name: str) -> tuple[str, str]:
    """Slug and kind of a flight's file; kind is empty for a file of another sort."""
    for suffix in SUFFIXES:
        if name.endswith(suffix) and len(name) > len(suffix):
            return name.removesuffix(suffix), suffix.removeprefix(".")
    return name, ""


def from_files(slug: str, files: Mapping[str, Path]) -> tuple[StoredFlight, tuple[str, ...]]:
    """A flight that no `run.json` tells of.

    Args:
        slug: of its files. files: kind -> path.

    Returns:
        The flight, and what is wrong with its files, a sentence each.
    """
    from scenarios.gain_set import load_gain_sets

    data = nothing(FLIGHT)
    own = slug.endswith(OWN)
    name = slug.removesuffix(OWN)
    problems = []
    uploaded: dict[str, float | int] = {}
    if "params" in files:
        try:
            uploaded = dict(load_gain_sets(files["params"])[0].parameters)
        except FileError as error:
            problems.append(f"{FLIGHTS}/{error.path.name}: {error.problem}; what was uploaded is not known")
    else:
        problems.append(f"{FLIGHTS}/{slug}.params is missing: what was uploaded is not known")
    if "parquet" in files:
        try:
            about, data["rows"] = _about(files["parquet"])
            name = _text(about, "gain_set") or name
            data["vehicle"] = _text(about, "vehicle")
            data["telemetry_sha256"] = _text(about, "telemetry_sha256")
        except FileError as error:
            problems.append(f"{FLIGHTS}/{error.path.name}: {error.problem}")
    data["gain_set"] |= {"name": name, "parameters": uploaded}
    data["uploaded"] = uploaded
    data["files"] = {kind: f"{FLIGHTS}/{path.name}" for kind, path in files.items()}
    data["reason"] = "the result is not known" if "rrd" in files else "killed in flight: not judged"
    recording = files.get("rrd") or files.get("partial.rrd")
    if recording is not None:
        try:
            data |= _recorded(recording)
        except FileError as error:
            problems.append(f"{FLIGHTS}/{recording.name}: {error.problem}")
    recorded_name = data.pop("recorded_name", "")
    if name == slug.removesuffix(OWN):  # the telemetry did not tell
        data["gain_set"]["name"] = name = recorded_name or name
    return StoredFlight(name, slug, data, files, known=False, own=own), tuple(problems)


def _recorded(recording: Path) -> dict[str, Any]:
    """What a recording tells of its flight, as in `run.json`; limits are not in it."""
    from scenarios.limits import METRICS
    from scenarios.recorder.recorded_facts import recorded_facts

    facts = recorded_facts(recording)
    told: dict[str, Any] = {
        "recorded_name": facts.name,
        "events": [
            {"t_s": time_s, "severity": _SEVERITIES.get(level, 6), "text": text} for time_s, level, text in facts.events
        ],
    }
    verdict = facts.properties.get("verdict", {})
    told |= {
        key: verdict[key] for key in ("outcome", "reason", "vehicle", "seed", "telemetry_sha256") if key in verdict
    }
    told["metrics"] = [
        nothing(METRIC)
        | {"name": name, "value": value, "outcome": "INFO", "unit": METRICS[name][0], "meaning": METRICS[name][1]}
        for name, value in facts.properties.get("metrics", {}).items()
        if name in METRICS
    ]
    whole = fitted(told, FLIGHT)  # what a damaged recording tells passes the same customs as a damaged run.json
    return {key: whole[key] for key in told}


def _text(about: Mapping[str, Any], key: str) -> str:
    value = about.get(key, "")
    return value if isinstance(value, str) else ""


def _about(parquet: Path) -> tuple[dict[str, Any], int]:
    """What the telemetry says of itself, and its number of rows, from the end of the file alone."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from scenarios.telemetry import METADATA_KEY

    try:
        footer = pq.read_metadata(parquet)
        about = json.loads((footer.metadata or {}).get(METADATA_KEY, b"{}"))
    except (OSError, ValueError, MemoryError, pa.ArrowException) as error:
        raise FileError(parquet, f"cannot be read as Parquet: {_first_line(error)}") from error
    return about if isinstance(about, dict) else {}, int(footer.num_rows)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def damage(kind: str, path: Path) -> str:
    """What is wrong with a file as far as its ends tell, in a few words; empty if nothing is.

    Args:
        kind: as in `StoredFlight.files`. path: of the file.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(4)
            file.seek(max(0, size - 64))
            tail = file.read()
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    if size == 0:
        return "is empty"
    if kind == "parquet" and (size < 12 or head != b"PAR1" or tail[-4:] != b"PAR1"):
        return "is damaged: it does not begin and end as Parquet does"
    if kind in ("rrd", "partial.rrd") and not head.startswith(b"RRF"):
        return "is damaged: it does not begin as a Rerun recording does"
    if kind == "rrd" and b"FOOT" not in tail:
        return "is cut off: it has no end"
    return ""


def log_span_s(path: Path) -> tuple[float, float] | None:
    """Vehicle time of the first and the last whole frame of a .tlog, s.

    Args:
        path: the file; its end may be missing.

    Returns:
        None if there is not one whole frame in it, or it cannot be read.
    """
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _span_s(data)
    except (OSError, ValueError):  # there is nothing in an empty file to look at
        return None


def _span_s(data: mmap.mmap) -> tuple[float, float] | None:
    first = last = None
    for time_us, _, _ in whole_frames(data):
        last = (time_us - SIMULATED_EPOCH_US) * 1e-6
        first = last if first is None else first
    return None if first is None or last is None else (first, last)
