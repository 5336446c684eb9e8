"""A run's folder: `run.json` and the files of its flights.

    <utc>_<scenario>_<vehicle>/
        run.json  compare.rrd  junit.xml  report.html
        flights/<gain set>.rrd .parquet .tlog .params .backup.params
        flights/<gain set>.own.rrd ...     the same gains with our own autopilot, beside a real one

Every file is written under a temporary name beside its place and moved, so a file that is there is whole.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.flight import FlightRecord, RunRecord
from scenarios.limits import METRICS, Metric, Outcome
from scenarios.run_schema import SCHEMA_VERSION, migrate
from scenarios.table import own_flight, own_gains_fly
from sitl.errors import FileError

if TYPE_CHECKING:
    from scenarios.twin import Twin
    from sitl.vehicle_spec import VehicleModel

RUN_JSON = "run.json"
FLIGHT_SUFFIXES = (".rrd", ".partial.rrd", ".parquet", ".tlog", ".partial.tlog", ".params", ".backup.params")

DERIVATIVE_UNITS: Mapping[str, str] = {
    "Yv": "1/s",
    "Yp": "m/(s rad)",
    "Yd": "m/s^2",
    "Lv": "rad/(m s)",
    "Lp": "1/s",
    "Ld": "rad/s^2",
}


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """One run's folder; make it with `create`."""

    path: Path

    @classmethod
    def create(cls, base: Path, utc_stamp: str, scenario: str, vehicle: str) -> RunFolder:
        """Make a new folder; one that exists already is left alone and the name gets `_2`, `_3`, ...

        Args:
            base: where runs are kept; made if it does not exist.
            utc_stamp: `20261122T200000Z`.
            scenario: its name.
            vehicle: its spec; characters that do not belong in a file name become `_`.

        Raises:
            FileError: it cannot be made.
        """
        name = "_".join(_file_name(part) for part in (utc_stamp, scenario, vehicle))
        path = base / name
        try:
            base.mkdir(parents=True, exist_ok=True)
            attempt = 1
            while True:
                try:
                    path.mkdir()
                    break
                except FileExistsError:
                    attempt += 1
                    path = base / f"{name}_{attempt}"
            folder = cls(path)
            folder.flights.mkdir()
        except OSError as error:
            raise FileError(
                path, f"the run's folder cannot be made: {error}", "Choose another folder with --out"
            ) from error
        return folder

    @property
    def flights(self) -> Path:
        """Where the flights' files are."""
        return self.path / "flights"

    @property
    def run_json(self) -> Path:
        """The record of the run."""
        return self.path / RUN_JSON

    @property
    def compare(self) -> Path:
        """The recording with all candidates."""
        return self.path / "compare.rrd"

    def flight_file(self, slug: str, suffix: str) -> Path:
        """A file of one flight.

        Args:
            slug: of the gain set.
            suffix: `.rrd`, `.parquet`, `.tlog` or `.params`.
        """
        return self.flights / f"{slug}{suffix}"

    def flight_files(self, slug: str) -> dict[str, str]:
        """Files of a flight that exist: suffix without dot -> path relative to the run's folder."""
        files = {suffix.lstrip("."): self.flight_file(slug, suffix) for suffix in FLIGHT_SUFFIXES}
        return {kind: str(file.relative_to(self.path)) for kind, file in files.items() if file.is_file()}

    def write_run_json(self, run: RunRecord, command: Sequence[str] = ()) -> Path:
        """Write `run.json`; may be called after every flight, the file is whole at any time.

        Args:
            run: as far as it is known.
            command: as typed, word by word.

        Raises:
            FileError: it cannot be written; an earlier one is kept.
        """
        text = json.dumps(run_object(run, self, command), indent=2, ensure_ascii=False, allow_nan=False)
        write_atomically(self.run_json, (text + "\n").encode())
        return self.run_json


def run_object(run: RunRecord, folder: RunFolder | None = None, command: Sequence[str] = ()) -> dict[str, Any]:
    """A run as plain data: what `run.json` holds and `--json` prints.

    No NaN and no infinity: such a value is null, and its reason says so.

    Args:
        run: the run.
        folder: to name the files in it; None if nothing was kept.
        command: as typed, word by word.
    """
    scenario = run.scenario
    own = own_flight(run)
    flights = [flight_object(flight, folder) for flight in run.flights]
    return {
        "schema_version": SCHEMA_VERSION,
        "complete": run.complete,
        "started_utc": run.started_utc,
        "command": list(command),
        "versions": dict(run.versions),
        "seed": scenario.seed,
        "folder": None if folder is None else str(folder.path),
        "scenario": {
            "name": scenario.name,
            "title": scenario.title,
            "file": None if scenario.path is None else str(scenario.path),
            "vehicle": scenario.vehicle,
            "scaling": sorted(scenario.scaling),
            "profile": scenario.profile,
            "overrides": plain(scenario.overrides),
            "assumptions": plain(scenario.assumptions),
            "axes": scenario.axes,
            "takeoff_altitude_m": scenario.takeoff_altitude_m,
            "setpoint_rate_hz": scenario.setpoint_rate_hz,
            "gain_sets": list(scenario.gain_sets),
            "manoeuvres": [
                {"name": m.name, "kind": m.kind, "duration_s": m.duration_s, "settings": plain(m.settings)}
                for m in scenario.manoeuvres
            ],
            "limits_name": scenario.limits_name,
            "limits": plain(scenario.limits),
            "gate": plain(scenario.gate),
            "faults": plain(scenario.faults),
        },
        "vehicle": plain(run.vehicle),
        "profile": [{"item": item, "value": plain(value), "unit": unit} for item, value, unit in run.profile],
        "own_gains": None
        if own is None
        else {
            "gain_set": own.gain_set.name,
            "fly": own_gains_fly(own),
            "outcome": own.outcome.value,
            "reason": own.reason,
        },
        "flown": len(run.flights),
        "passed": sum(flight.outcome is Outcome.PASS for flight in run.flights),
        "flights": flights,
        "baseline": None if run.baseline is None else flight_object(run.baseline, folder),
        "twins": [_twin_object(twin, folder) for twin in run.twins],
    }


def _twin_object(twin: Twin, folder: RunFolder | None) -> dict[str, Any]:
    from scenarios.twin import OWN_SUFFIX, QUANTITIES

    difference = twin.difference
    return {
        "gain_set": twin.name,
        "outcome": twin.flight.outcome.value,
        "own_outcome": twin.own.outcome.value,
        "verdicts_agree": difference.verdicts_agree,
        "agree": difference.agree,
        "cycling": difference.cycling,
        "alone": list(difference.alone),
        "outside": [one.name for one in difference.outside()],
        "quantities": [
            {
                **plain(one),
                "unit": one.unit,
                "tolerance": one.tolerance,
                "meaning": QUANTITIES[one.name][2],
            }
            for one in difference.quantities
        ],
        "own": flight_object(twin.own, folder, OWN_SUFFIX),
    }


def flight_object(flight: FlightRecord, folder: RunFolder | None = None, suffix: str = "") -> dict[str, Any]:
    """A flight as `run.json` holds it.

    Args:
        flight: its record. folder: where its files are; None leaves them out. suffix: of the files' names.
    """
    gain_set = flight.gain_set
    return {
        "gain_set": {
            "name": gain_set.name,
            "source": gain_set.source,
            "note": gain_set.note,
            "file": None if gain_set.path is None else str(gain_set.path),
            "parameters": plain(gain_set.parameters),
        },
        "vehicle": flight.vehicle_spec,
        "seed": flight.seed,
        "outcome": flight.outcome.value,
        "reason": flight.reason,
        "warnings": list(flight.warnings),
        "timing": flight.timing,
        "uploaded": plain(flight.parameters),
        "metrics": [_metric_object(metric) for metric in flight.metrics],
        "margins": plain(flight.margins),
        "segments": plain(flight.segments),
        "faults": plain(flight.faults),
        "events": plain(flight.events),
        "rows": len(flight.telemetry),
        "telemetry_sha256": flight.telemetry_sha256,
        "files": {} if folder is None else folder.flight_files(gain_set.slug + suffix),
    }


def _metric_object(metric: Metric) -> dict[str, Any]:
    reason = metric.reason
    if metric.value is not None and not math.isfinite(metric.value):
        reason = "; ".join(filter(None, ("infinite" if math.isinf(metric.value) else "not a number", reason)))
    return {
        "name": metric.name,
        "segment": metric.segment,
        "value": plain(metric.value),
        "unit": metric.unit,
        "meaning": METRICS[metric.name][1] if metric.name in METRICS else "",
        "limit": metric.limit,
        "outcome": metric.outcome.value,
        "reason": reason,
    }


def plain(value: Any) -> Any:
    """Data as JSON knows it: dataclasses and mappings become objects, NaN and infinities null."""
    if isinstance(value, Enum):
        return plain(value.value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, set | frozenset):
        return sorted(plain(item) for item in value)
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy, not imported for this
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def vehicle_description(model: VehicleModel) -> dict[str, Any]:
    """What flies, as plain data for `RunRecord.vehicle`."""
    airframe = model.airframe
    return {
        "spec": model.spec,
        "name": model.name,
        "title": airframe.title,
        "reference": None if model.reference is None else model.reference.name,
        "froude_number": model.froude_number,
        "scaling": sorted(model.scaling),
        "derivatives": model.derivatives.as_dict(),
        "derivative_units": dict(DERIVATIVE_UNITS),
        "sigma_pct": model.sigma_pct.as_dict(),
        "assumptions": dataclasses.asdict(model.assumptions),
        "flight_gains": None if airframe.flight_gains is None else dataclasses.asdict(airframe.flight_gains),
        "layout": airframe.layout,
        "mass_kg": airframe.mass_kg,
        "diagonal_m": airframe.diagonal_m,
        "rotors": [dataclasses.asdict(rotor) for rotor in airframe.rotors],
    }


def load_run(path: Path) -> dict[str, Any]:
    """Read a run.

    Args:
        path: the run's folder, or its `run.json`.

    Returns:
        The object that `run_object` describes; what an older program wrote is brought to its schema.

    Raises:
        FileError: no run there, not JSON, or written by a newer program.
    """
    file = path / RUN_JSON if path.is_dir() else path
    try:
        run = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(file, f"cannot be read: {error.strerror or error}", "Give the folder of a run") from error
    except ValueError as error:
        raise FileError(file, f"is not JSON: {error}", "Give the folder of a run") from error
    return migrate(run, file)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that it is there whole or not at all, even after a power cut.

    Raises:
        FileError: it cannot be written; what was there before is kept.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise FileError(
            path, f"cannot be written: {error}", "Free some space or choose another folder with --out"
        ) from error


def _file_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", Path(text).stem if "/" in text else text).strip("._") or "run"
