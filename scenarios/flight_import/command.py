"""`froude review FILE.ulg`: recorded flights through the same metrics, beside simulated ones of their gains."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.flight_import import SUFFIXES, is_recording

if TYPE_CHECKING:
    from scenarios.flight import FlightRecord
    from scenarios.flight_import.loop_parameters import Group
    from scenarios.flight_import.recorded import Recorded
    from scenarios.flight_import.step_finder import Found
    from scenarios.manoeuvres import Manoeuvre
    from scenarios.run_folder import RunFolder
    from scenarios.runner import RunResult
    from scenarios.scenario import Scenario
    from scenarios.twin import Twin
    from sitl.airframe import Rotor
    from sitl.vehicle_spec import VehicleModel

SETPOINT_RATE_HZ = 50.0
EXIT_OK, EXIT_GATE, EXIT_LINK, EXIT_INTERRUPTED = 0, 1, 3, 130


@dataclass(frozen=True)
class ImportOptions:
    """How recorded flights are looked at.

    Attributes:
        out: folder that run folders are made in; None keeps nothing.
        vehicle: spec of the model that is flown beside them; empty: nothing is guessed, no margins, no such flight.
        scaling: words of Froude scaling for it. profile: fidelity profile for it.
        limits: name of the limit set to judge by. system: MAVLink system in a .tlog; None: the one that flew.
        command: as typed, for run.json. say: called with a line for people.
    """

    out: Path | None = Path("logs")
    vehicle: str = ""
    scaling: tuple[str, ...] = ("derivatives",)
    profile: str = "sitl"
    limits: str = "none"
    system: int | None = None
    command: tuple[str, ...] = ()
    say: Callable[[str], object] = lambda _: None


@dataclass(frozen=True)
class _Import:
    """One file, read and searched."""

    recorded: Recorded
    found: Found
    groups: tuple[Group, ...]
    notes: tuple[str, ...]


def import_flights(paths: Sequence[Path], options: ImportOptions) -> RunResult:
    """Read, score, judge and keep recorded flights as a run.

    Args:
        paths: .ulg and .tlog files; each gives a flight, or several where its gains were changed on the way.
        options: how.

    Returns:
        the run, its folder, and what stopped a flight beside it, if anything did.

    Raises:
        UsageError, FileError: a file that cannot be judged, with what is missing; an unknown vehicle or limit set.
    """
    from bridge.clock import utc_stamp
    from scenarios.flight import RunRecord
    from scenarios.run_folder import RunFolder, vehicle_description
    from scenarios.runner import RunResult, versions

    scenario, model = _scenario(paths, options)
    geometry = () if model is None else model.airframe.rotors
    imports = _distinct([_read(path, options, geometry) for path in paths])
    profile = scenario.resolve_profile()
    started = utc_stamp()
    name = model.name if model is not None else imports[0].recorded.facts.get("hardware", "recorded")
    folder = None if options.out is None else RunFolder.create(options.out, started, scenario.name, name)
    flights: list[FlightRecord] = []
    twins: list[Twin] = []
    manoeuvres: dict[str, Manoeuvre] = {}
    stopped: BaseException | None = None
    for one in imports:
        for group in one.groups:
            flight, twin, flown, stop = _flight(one, group, scenario, model, folder, options)
            stopped = stopped or stop
            flights.append(flight)
            twins += [] if twin is None else [twin]
            manoeuvres |= {m.name: m for m in flown}
    recorded = imports[0].recorded
    run = RunRecord(
        scenario=replace(scenario, manoeuvres=tuple(manoeuvres.values())),
        vehicle=vehicle_description(model) if model is not None else _unknown_vehicle(recorded, name),
        profile=() if model is None else tuple(profile.describe()),
        flights=tuple(flights),
        started_utc=_extended(started),
        versions=versions(),
        complete=stopped is None,
        twins=tuple(twins),
    )
    if folder is not None:
        _write(run, folder, options)
    return RunResult(run, folder.path if folder else None, stopped)


def run(args: argparse.Namespace, *, tell: Callable[..., object]) -> int:
    """Import the files, print what came of them, and go on to look at the run if that was asked for.

    Args:
        args: of `froude review`; `--profile` and `--scaling` may be missing. tell: prints a line for people.

    Returns:
        exit status: 0 done, 1 with `--gate` unless every set passes, 3 or 130 if the flight beside it was stopped.
    """
    from scenarios.limits import Outcome
    from sitl.errors import UsageError

    paths = [Path(word) for word in args.runs]
    others = [str(path) for path in paths if not is_recording(path)]
    if others:
        raise UsageError(
            f"froude review: {', '.join(others)} beside recorded flights: import those first, then give the folder of "
            "the run that this makes"
        )
    options = ImportOptions(
        out=args.out,
        vehicle=args.vehicle or "",
        scaling=_words(getattr(args, "scaling", None)),
        profile=getattr(args, "profile", None) or "sitl",
        limits=args.limits or "none",
        system=args.system,
        command=("froude", *args.argv),
        say=tell,
    )
    result = import_flights(paths, options)
    sys.stdout.write(_text(args, result, options))
    sys.stdout.flush()
    if result.stopped is not None:
        interrupted = isinstance(result.stopped, KeyboardInterrupt)
        tell("interrupted" if interrupted else f"the flight beside it was stopped: {result.stopped}")
        return EXIT_INTERRUPTED if interrupted else EXIT_LINK
    if args.gate and any(flight.outcome is not Outcome.PASS for flight in result.run.flights):
        return EXIT_GATE
    if args.web or args.html or args.screenshot is not None or args.flight is not None:
        return _look(args, result, tell)
    return EXIT_OK


def _look(args: argparse.Namespace, result: RunResult, tell: Callable[..., object]) -> int:
    """What `froude review` does with any run."""
    from scenarios import review_command

    args.runs, args.json, args.gate = [str(result.folder)], False, False
    args.vehicle = args.limits = args.system = args.profile = args.scaling = None
    return review_command.run(args, tell=tell)


def _words(text: str | None) -> tuple[str, ...]:
    found = tuple(word.strip() for word in (text or "").split(",") if word.strip())
    return found or ("derivatives",)


def _text(args: argparse.Namespace, result: RunResult, options: ImportOptions) -> str:
    import json

    from scenarios.run_folder import RunFolder, run_object
    from scenarios.table import run_text, terminal_width

    if args.json:
        folder = RunFolder(result.folder) if result.folder else None
        shown = run_object(result.run, folder, options.command)
        return json.dumps(shown, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    width, colour = terminal_width(sys.stdout)
    return run_text(result.run, result.folder, width=width, colour=colour)


def _scenario(paths: Sequence[Path], options: ImportOptions) -> tuple[Scenario, VehicleModel | None]:
    from scenarios.scenario import Scenario, limit_set
    from sitl.errors import UsageError

    if not paths:
        raise UsageError("no file to import: give a .ulg or .tlog")
    scenario = Scenario(
        name=f"review_{paths[0].stem}" + (f"_and_{len(paths) - 1}_more" if len(paths) > 1 else ""),
        title="Recorded: " + ", ".join(path.name for path in paths),
        vehicle=options.vehicle,
        scaling=options.scaling,
        profile=options.profile,
        overrides={},
        assumptions={},
        axes="roll",
        takeoff_altitude_m=10.0,
        setpoint_rate_hz=SETPOINT_RATE_HZ,
        seed=0,
        gain_sets=tuple(str(path) for path in paths),
        manoeuvres=(),
        limits=limit_set(options.limits),
        limits_name=options.limits,
    )
    scenario.resolve_profile()
    return scenario, scenario.resolve_vehicle() if options.vehicle else None


def _read(path: Path, options: ImportOptions, geometry: tuple[Rotor, ...]) -> _Import:
    from scenarios.flight_import.excitation import accepted, thin
    from scenarios.flight_import.loop_parameters import groups
    from scenarios.flight_import.step_finder import find
    from scenarios.flight_import.tlog_source import read_tlog
    from scenarios.flight_import.ulog_source import read_ulog
    from sitl.errors import FileError

    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise FileError(path, f"suffix {path.suffix!r} is not known", f"Give a {' or '.join(SUFFIXES)} file")
    if suffix == ".ulg":
        recorded = read_ulog(path, rotors=geometry)
    else:
        recorded = read_tlog(path, system=options.system, rotors=geometry)
    found = find(recorded)
    segments, refused = accepted(recorded, found)
    notes = [*found.notes, *refused, *thin(recorded, segments)]
    if geometry and len(recorded.rotors) != len(geometry):
        notes.append(
            f"the log has {len(recorded.rotors)} rotors, {options.vehicle} has {len(geometry)}: is it this one?"
        )
    return _Import(recorded, found, groups(recorded, found, segments), tuple(notes))


def _distinct(imports: list[_Import]) -> list[_Import]:
    """Gain sets of different files get different names: files and results are told apart by them."""
    taken: set[str] = set()
    made = []
    for one in imports:
        fresh = []
        for group in one.groups:
            gain_set, number = group.gain_set, 2
            while gain_set.slug in taken:
                gain_set = replace(group.gain_set, name=f"{group.gain_set.name} {number}")
                number += 1
            taken.add(gain_set.slug)
            fresh.append(replace(group, gain_set=gain_set))
        made.append(replace(one, groups=tuple(fresh)))
    return made


def _flight(
    one: _Import,
    group: Group,
    scenario: Scenario,
    model: VehicleModel | None,
    folder: RunFolder | None,
    options: ImportOptions,
) -> tuple[FlightRecord, Twin | None, tuple[Manoeuvre, ...], BaseException | None]:
    """One group's record, with that of our own autopilot beside it where a model is given."""
    from scenarios.flight_import.beside import fly_beside, job_of, replayed
    from scenarios.flight_import.imported_flight import flight_record, write_flight
    from scenarios.one_flight import flown_margins
    from scenarios.twin import Twin

    manoeuvres = replayed(one.recorded, one.found, group, SETPOINT_RATE_HZ)
    notes, margins, own, stop = list(one.notes), None, None, None
    if model is not None:
        asked = replace(scenario, manoeuvres=manoeuvres)
        job, why = job_of(group, asked, model, scenario.resolve_profile())
        notes += [why] if why else []
        if job is not None:
            margins = flown_margins(job)
            options.say(f"{group.gain_set.name}: flying the same gains and set-points on {model.name} ...")
            own, stop = fly_beside(job, folder.flights if folder else None)
    record = flight_record(
        one.recorded,
        group,
        limits=scenario.limits,
        spec=model.spec if model is not None else "recorded",
        margins=margins,
        notes=notes,
    )
    if folder is not None:
        write_flight(record, folder.flights, one.recorded.rotors)
    return record, None if own is None else Twin.of(record, own), manoeuvres, stop


def _unknown_vehicle(recorded: Recorded, name: str) -> dict[str, Any]:
    """What a log knows of its vehicle, as `RunRecord.vehicle`: geometry at best, no model."""
    from dataclasses import asdict

    return {
        "spec": "recorded",
        "name": name,
        "title": "recorded vehicle, no model",
        "reference": None,
        "froude_number": None,
        "scaling": [],
        "derivatives": {},
        "derivative_units": {},
        "sigma_pct": {},
        "assumptions": {},
        "flight_gains": None,
        "layout": "custom",
        "mass_kg": None,
        "diagonal_m": None,
        "rotors": [asdict(rotor) for rotor in recorded.rotors],
        "log": dict(recorded.facts),
    }


def _write(run: Any, folder: RunFolder, options: ImportOptions) -> None:
    """The run's own files, as `scenarios.runner` writes them."""
    from scenarios.junit import write_junit
    from scenarios.recorder.comparison import record_compare

    folder.write_run_json(run, options.command)
    write_junit(run, folder.path / "junit.xml")
    record_compare(run, folder.compare)


def _extended(stamp: str) -> str:
    """ISO 8601 with its separators of `20261122T200455Z`."""
    day, clock = stamp.rstrip("Z").split("T")
    return f"{day[:4]}-{day[4:6]}-{day[6:]}T{clock[:2]}:{clock[2:4]}:{clock[4:]}Z"
