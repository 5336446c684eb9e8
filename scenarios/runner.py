"""All flights of one command: gain sets checked, flown one after the other or side by side, written as one run."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from bridge.clock import utc_stamp
from scenarios import interrupts
from scenarios.faults import check_faults
from scenarios.flight import FlightRecord, RunRecord
from scenarios.flown import Flown, Landed, Progress
from scenarios.gain_set import GainSet, check, flies_gains, flight_gain_parameters, load_all
from scenarios.hil_session import geometry_parameters
from scenarios.limits import Outcome
from scenarios.one_flight import MEMORY, FlightJob, FlightStoppedError, fly
from scenarios.run_files import report_draft, tell_landed, write_run
from scenarios.run_folder import RunFolder, vehicle_description
from scenarios.scenario import Scenario
from scenarios.versions import versions
from sitl.errors import FroudeError, LinkError, UsageError
from sitl.parameters import ParameterTable, ParameterType
from sitl.profile import Profile
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import VehicleModel

if TYPE_CHECKING:
    from scenarios.twin import Twin

__all__ = ["Progress", "RunOptions", "RunResult", "plan", "run_scenario", "versions"]


@dataclass(frozen=True)
class RunOptions:
    """How a run is made, beside the scenario.

    Attributes:
        out: folder that run folders are made in; None keeps nothing.
        connect: link URL of the vehicle, memory:// for our own.
        arm_hardware: a serial link may be armed.
        jobs: flights at a time; more than one only for vehicles of our own.
        live_port: port that serves viewers while flying; None for none. live_window: open a viewer's window on it.
        command: as typed, for run.json.
        hil: simulator link on which a real autopilot flies our plant, `tcpin://127.0.0.1:4560`, or the serial port of
            a board; empty for none.
        px4: build directory of a PX4 that is started for every flight; None for none.
        say: called with a line for people.
        twin: where a real autopilot flies our plant, our own flies it, too, to compare the two.
        report: write `report.html`, where a folder is kept.
    """

    out: Path | None = Path("logs")
    connect: str = MEMORY
    arm_hardware: bool = False
    jobs: int = 1
    live_port: int | None = None
    live_window: bool = False
    command: tuple[str, ...] = ()
    hil: str = ""
    px4: Path | None = None
    say: Callable[[str], object] = lambda _: None
    twin: bool = True
    report: bool = True

    def __post_init__(self) -> None:
        """Raise UsageError for options that exclude each other, before anything is read."""
        if self.connect.startswith("serial") and not self.arm_hardware:
            raise UsageError(
                f"--connect {self.connect}: a serial link leads to real hardware, and nothing is armed there without "
                "--arm-hardware. Take the propellers off first"
            )
        if self.px4 is not None and (self.hil or self.connect != MEMORY):
            raise UsageError("--px4 starts an autopilot with ports of its own: leave out --hil and --connect")
        if self.is_board and not self.arm_hardware:
            raise UsageError(
                f"--hil {self.hil}: a serial port leads to real hardware, and nothing is armed there without "
                "--arm-hardware. Take the propellers off first"
            )
        if self.is_board and self.connect != MEMORY:
            raise UsageError(
                f"--hil {self.hil} --connect {self.connect}: a board's MAVLink comes over the same port; leave out "
                "--connect"
            )
        if self.hil and self.connect == MEMORY and not self.is_board:
            raise UsageError(
                f"--hil {self.hil}: say also where the autopilot's MAVLink arrives, such as "
                "--connect udpin://127.0.0.1:14540"
            )
        if self.jobs > 1 and self.is_hil:
            raise UsageError("--jobs above 1 needs vehicles of our own: with --hil or --px4 fly one at a time")
        if self.jobs < 1:
            raise UsageError(f"--jobs {self.jobs}: give 1 or more")
        if self.jobs > 1 and self.connect != MEMORY:
            raise UsageError("--jobs above 1 needs vehicles of our own; leave out --connect or fly one at a time")
        if self.jobs > 1 and self.live_port is not None:
            raise UsageError("--live shows one flight at a time: leave out --jobs, or --live")

    @property
    def is_board(self) -> bool:
        """A board on a serial port flies our plant."""
        return self.hil.startswith("serial")

    @property
    def is_hil(self) -> bool:
        """A real autopilot flies our plant."""
        return bool(self.hil) or self.px4 is not None


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    Attributes:
        run: its record.
        folder: where it is kept; None if it is not.
        stopped: what stopped it early, if anything did.
        owed: what is left to do by hand on a vehicle that is not ours; empty if nothing.
    """

    run: RunRecord
    folder: Path | None
    stopped: BaseException | None = None
    owed: str = ""


def run_scenario(
    scenario: Scenario,
    options: RunOptions,
    progress: Callable[[Progress], object] = lambda _: None,
    gain_sets: Sequence[GainSet] = (),
) -> RunResult:
    """Fly every gain set of a scenario.

    Args:
        scenario: with its gain sets. options: how. progress: called at every phase of every flight.
        gain_sets: flown instead of those that the scenario refers to, if there are any.

    Returns:
        the run; flights that were flown are in it even if something stopped it.

    Raises:
        UsageError, FileError: before anything is flown: a bad file, name or number.
    """
    with ExitStack() as stack:
        return _run_scenario(scenario, options, progress, gain_sets or load_all(scenario.gain_sets), stack)


def _run_scenario(
    scenario: Scenario,
    options: RunOptions,
    progress: Callable[[Progress], object],
    gain_sets: Sequence[GainSet],
    stack: ExitStack,
) -> RunResult:
    model = scenario.resolve_vehicle()
    profile = scenario.resolve_profile()
    if not gain_sets:
        raise UsageError('no gain sets to fly: give --gains, for example "--gains table_7_2"')
    candidates = [plan(gain_set, scenario, model, profile) for gain_set in gain_sets]
    baseline = _baseline(gain_sets, scenario, model, profile)
    check_faults(scenario.faults, model, options.connect, plant=options.hil or str(options.px4 or ""))
    started_utc = utc_stamp()
    folder = None if options.out is None else RunFolder.create(options.out, started_utc, scenario.name, model.name)
    planned = [candidate for candidate in (*candidates, baseline) if candidate is not None]
    jobs = [
        replace(
            job,
            folder=folder.path / "flights" if folder else None,
            connect=options.hil if options.is_board else options.connect,
            parameters={
                **(geometry_parameters(model, board=options.is_board) if options.is_hil else {}),
                **job.parameters,
            },
            live_port=options.live_port,
            live_window=options.live_window,
            command=options.command,
        )
        for job in planned
    ]
    draft = None
    if folder is not None and options.report:
        known = RunRecord(scenario, vehicle_description(model), tuple(profile.describe()), ())
        real_time = options.is_hil or not all(job.in_memory for job in jobs)
        draft = stack.enter_context(report_draft(known, jobs, len(candidates), real_time))
    twins: tuple[Twin, ...] = ()
    if options.is_hil:
        flown, twins = _fly_real(jobs, planned, options, progress)
    else:
        flown = _fly_all(jobs, options.jobs, progress, options.say, lambda *one: tell_landed(draft, folder, *one))
    records, stopped = flown.records, flown.stopped
    if stopped is not None:
        records = {index: record for index, record in records.items() if len(record.telemetry)}
        if not records:
            # nothing was flown, so there is nothing to keep: a folder of empty files would only be in the way
            if folder is not None:
                shutil.rmtree(folder.path, ignore_errors=True)
            raise stopped
    run = RunRecord(
        scenario=scenario,
        vehicle=vehicle_description(model),
        profile=tuple(profile.describe()),
        flights=tuple(records[i] for i in sorted(records) if i < len(candidates)),
        baseline=records.get(len(candidates)),
        started_utc=_extended(started_utc),
        versions=versions(),
        complete=stopped is None,
        twins=twins,
    )
    if folder is not None:
        progress(Progress(len(jobs), len(jobs), "run", "write"))
        try:
            with interrupts.held():
                write_run(run, folder, options.command, draft, options.say)
        except (FroudeError, KeyboardInterrupt) as error:
            # the flights themselves are on disk; the table is still worth printing
            stopped = stopped or error
    return RunResult(run, folder.path if folder else None, stopped, flown.owed)


def plan(gain_set: GainSet, scenario: Scenario, model: VehicleModel, profile: Profile) -> FlightJob:
    """The parameters that flying a set means, checked against the vehicle's table.

    Roll flies the set. Pitch flies the set mirrored (axes "both") or the airframe's own flight gains, and in either
    case what the set itself says of pitch.

    Raises:
        FileError: unknown parameter, NaN, negative or absurd gain.
    """
    table = ParameterTable(airframe_parameters(model, profile))
    warnings = check(gain_set, table)
    values: dict[str, float | int] = {}
    own = model.airframe.flight_gains
    if scenario.axes == "both":
        values.update(gain_set.mirrored().parameters)
    elif own is not None:
        values.update(flight_gain_parameters("PITCH", asdict(own)))
    else:
        warnings.append(f"{model.airframe.name} has no flight gains of its own: pitch flies PX4's defaults")
    values.update(gain_set.parameters)
    typed: dict[str, tuple[float | int, ParameterType]] = {
        name: (value, table.spec(name).type) for name, value in values.items()
    }
    return FlightJob(gain_set, typed, scenario, model, profile, tuple(warnings))


def _baseline(
    gain_sets: Sequence[GainSet], scenario: Scenario, model: VehicleModel, profile: Profile
) -> FlightJob | None:
    """The airframe's own flight gains, unless they are among the candidates or not known."""
    own = model.airframe.flight_gains
    if own is None:
        return None
    if any(flies_gains(gain_set, asdict(own)) for gain_set in gain_sets):
        return None
    wanted = flight_gain_parameters("ROLL", asdict(own))
    gain_set = GainSet(f"own {model.airframe.name}", wanted, "the airframe's own flight gains", "baseline")
    while gain_set.slug in {other.slug for other in gain_sets}:  # a candidate's files must stay the candidate's
        gain_set = replace(gain_set, name=f"{gain_set.name} baseline")
    return plan(gain_set, scenario, model, profile)


def _fly_real(
    jobs: Sequence[FlightJob],
    planned: Sequence[FlightJob],
    options: RunOptions,
    progress: Callable[[Progress], object],
) -> tuple[Flown, tuple[Twin, ...]]:
    """Fly with the real autopilot, then with our own.

    Args:
        jobs: for the real one. planned: the same without what only a real one must be told, for ours.
        options: of the run. progress: as in `run_scenario`.

    Returns:
        what came back from the real one, with what stopped either; the pairs.
    """
    from scenarios.hil_flights import fly_with_autopilot

    count = len(jobs) * (2 if options.twin else 1)
    flown = fly_with_autopilot(
        jobs,
        hil=options.hil,
        px4=options.px4,
        say=options.say,
        progress=lambda now: progress(replace(now, count=count)),
    )
    if not options.twin or isinstance(flown.stopped, KeyboardInterrupt):
        return flown, ()
    return flown, _fly_twins(jobs, planned, flown, progress)


def _fly_twins(
    jobs: Sequence[FlightJob], planned: Sequence[FlightJob], flown: Flown, progress: Callable[[Progress], object]
) -> tuple[Twin, ...]:
    """Our own autopilot flies what the real one has flown; what stops it is told like what stopped the other."""
    from scenarios.twin import OWN_SUFFIX, Twin

    twins = []
    for index, record in sorted(flown.records.items()):
        if not record.segments and record.outcome is Outcome.UNSET:
            continue  # the flight was broken off before there was anything to compare
        job = replace(planned[index], folder=jobs[index].folder, suffix=OWN_SUFFIX)
        where, name = len(jobs) + index, f"{job.gain_set.name}, own autopilot"
        try:
            own = fly(
                job,
                lambda phase, i=where, n=name: progress(Progress(i, 2 * len(jobs), n, phase)),  # type: ignore[misc]
            )
        except FlightStoppedError as stop:
            flown.stopped = flown.stopped or stop.cause
            break
        except KeyboardInterrupt as stop_:
            flown.stopped = flown.stopped or stop_
            break
        twins.append(Twin.of(record, own))
    return tuple(twins)


def _fly_all(
    jobs: Sequence[FlightJob],
    workers: int,
    progress: Callable[[Progress], object],
    say: Callable[[str], object],
    landed: Landed,
) -> Flown:
    if workers > 1 and len(jobs) > 1:
        return _fly_side_by_side(jobs, workers, progress, landed)
    flown = Flown()
    for index, job in enumerate(jobs):
        name = job.gain_set.name
        try:
            flown.records[index] = fly(
                job,
                lambda phase, i=index, n=name: progress(Progress(i, len(jobs), n, phase)),  # type: ignore[misc]
                say=say,
            )
            landed(index, flown.records[index])
        except FlightStoppedError as stop:
            flown.records[index] = stop.record
            flown.stopped, flown.owed = stop.cause, stop.owed
            break
        except KeyboardInterrupt as stop_:
            flown.stopped = stop_
            break
    return flown


def _fly_side_by_side(
    jobs: Sequence[FlightJob], workers: int, progress: Callable[[Progress], object], landed: Landed
) -> Flown:
    """In processes of their own; when something stops the run, flights that have begun are flown to their end."""
    flown = Flown()
    # spawn: a forked child of a process that has started Arrow's or Rerun's threads may hang
    pool = ProcessPoolExecutor(min(workers, len(jobs)), get_context("spawn"), interrupts.end_with_parent)
    flights: dict[Future[FlightRecord], int] = {}
    progress(Progress(0, len(jobs), jobs[0].gain_set.name, f"{min(workers, len(jobs))} at a time"))
    try:
        with interrupts.kept_from_children():
            flights = {pool.submit(fly, job): index for index, job in enumerate(jobs)}
        for number, done in enumerate(as_completed(flights)):
            _collect(done, flights[done], flown)
            if flown.stopped is not None:
                break
            landed(flights[done], flown.records[flights[done]])
            progress(Progress(number, len(jobs), jobs[flights[done]].gain_set.name, "done"))
    except KeyboardInterrupt as stop:
        flown.stopped = stop
    try:
        with interrupts.held():
            pool.shutdown(wait=True, cancel_futures=True)
            for flight, index in flights.items():
                if not flight.cancelled() and index not in flown.records:
                    _collect(flight, index, flown)
    except KeyboardInterrupt as stop:
        flown.stopped = flown.stopped or stop
    return flown


def _collect(flight: Future[FlightRecord], index: int, flown: Flown) -> None:
    try:
        flown.records[index] = flight.result()
    except FlightStoppedError as stop:
        flown.records[index] = stop.record
        flown.stopped = flown.stopped or stop.cause
    except BrokenProcessPool:
        problem = "a process that flew was killed: out of memory? Fly one at a time, without --jobs"
        flown.stopped = flown.stopped or LinkError(problem)


def _extended(stamp: str) -> str:
    """ISO 8601 with its separators, as JUnit's readers want it, of a file name's `20261122T200455Z`."""
    day, clock = stamp.rstrip("Z").split("T")
    return f"{day[:4]}-{day[4:6]}-{day[6:]}T{clock[:2]}:{clock[2:4]}:{clock[4:]}Z"
