"""One gain set flown through one scenario: connect, back up, upload, fly, land, restore, record, score.

Whatever goes wrong, what was flown so far is on disk and in the record before anybody is told.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import cache
from typing import Any

from bridge.client import Client
from bridge.clock import SimClock
from bridge.connection import Connection
from bridge.drive import Drive, NetworkDrive, SharedDrive
from bridge.errors import AlreadyArmed, PeerLost, PeerSilent
from bridge.link import Link, MemoryLink, open_link
from bridge.vehicle_server import ServerLink, VehicleServer
from scenarios import hil_flight, interrupts, sampler
from scenarios.flight import Event, FlightRecord
from scenarios.flight_faults import FlightFaults
from scenarios.flight_files import FlightFiles
from scenarios.flight_job import MEMORY, FlightJob
from scenarios.injected_fault import judge_faults
from scenarios.limits import Outcome, judge
from scenarios.param_loan import ParamLoan, open_loan
from scenarios.pilot import FlightLog, Pilot
from scenarios.plant_session import PlantSession
from scenarios.sampler import Sampler
from scenarios.score import diverged, flight_metrics
from scenarios.telemetry import Telemetry
from sitl.control_settings import mix_of
from sitl.errors import FroudeError, LinkError
from sitl.sampled_loop import RollGains
from sitl.stability import loop_margins
from sitl.vehicle import Vehicle

__all__ = ["MEMORY", "FlightJob", "FlightStoppedError", "flown_margins", "fly"]

_INTERVALS_US = {
    **dict.fromkeys(sampler.SAMPLED, sampler.CRUISE_INTERVAL_US),
    sampler.LOCAL_POSITION_NED: 20_000,
    sampler.CURRENT_MODE: 100_000,
}
_UNUSED_STREAMS = (4, 24, 26, 29, 31, 33, 36, 74, 85, 105, 111, 141, 147, 230, 241, 331)
_READY_TIMEOUT_S = 60.0
SETTLE_S = 2.5
"""Vehicle time that a real autopilot is given to take up new outputs: it looks once a second, and never while armed."""
_BACKUP = ".backup.params"


class FlightStoppedError(Exception):
    """The flight is over before its time, and so is the run: record first, then tell.

    Args:
        record: what was flown. cause: what to tell. owed: what is left to do on the vehicle by hand, if anything.
    """

    def __init__(self, record: FlightRecord, cause: BaseException, owed: str = "") -> None:
        super().__init__(str(cause))
        self.record, self.cause, self.owed = record, cause, owed

    def __reduce__(self) -> tuple[Any, ...]:
        return FlightStoppedError, (self.record, self.cause, self.owed)


def fly(
    job: FlightJob,
    progress: Callable[[str], object] = lambda _: None,
    session: PlantSession | None = None,
    say: Callable[[str], object] = lambda _: None,
) -> FlightRecord:
    """Fly one job.

    Args:
        job: what to fly. progress: called with a short text at every phase.
        session: a real autopilot on our plant, already open; without one the job's own link is opened.
        say: called with a line for people.

    Returns:
        the record, scored.

    Raises:
        FlightStoppedError: the link died, a parameter was refused, a file could not be written, or Ctrl-C; carries
            the record so far.
    """
    flight = _Flight(job, progress, session, say)
    try:
        flight.run()
    except (FroudeError, KeyboardInterrupt) as cause:
        with suppress(KeyboardInterrupt), interrupts.held():
            record = flight.finish(stopped=cause)
        raise FlightStoppedError(record, cause, flight.owed) from cause
    except BaseException:
        flight.close()
        raise
    try:
        with interrupts.held():
            record = flight.finish()
    except KeyboardInterrupt as late:
        raise FlightStoppedError(record, late) from late
    if flight.problem is not None:
        raise FlightStoppedError(record, flight.problem)
    return record


@cache
def _spare_the_collector() -> None:
    """Take what is loaded by now out of the garbage collector's rounds, once per process.

    A full round over the libraries' objects costs as much as a take-off, and they live as long as the process.
    """
    gc.freeze()


class _Flight:
    """The moving parts of one flight."""

    def __init__(
        self,
        job: FlightJob,
        progress: Callable[[str], object],
        session: PlantSession | None,
        say: Callable[[str], object],
    ) -> None:
        self._job = job
        self._session = session
        self._progress = progress
        self._tell = say
        self._stack = ExitStack()
        self._events: list[Event] = []
        self._log = FlightLog()
        self._notes: list[str] = []
        self._loan: ParamLoan | None = None
        self._sampler: Sampler | None = None
        self._files: FlightFiles | None = None
        self._vehicle: Vehicle | None = None
        self._faults = FlightFaults(job, self._on_text)

    def run(self) -> None:
        """Everything that talks to the vehicle, with a teardown that always runs."""
        job = self._job
        self._progress("connect")
        if job.folder is not None:
            self._files = self._stack.enter_context(
                FlightFiles(
                    job.folder,
                    job.slug,
                    name=job.gain_set.name,
                    vehicle=job.flown_vehicle(),
                    live_port=job.live_port,
                    live_window=job.live_window,
                    rows_per_chunk=job.rows_per_chunk,
                    log_s=job.batch_s,
                )
            )
            self._files.about = job.about()
            self._faults.show = self._files.faults
        client = self._open_client()
        _spare_the_collector()
        client.on_text = self._on_text
        client.connect()
        self._borrow(client)
        self._set_streams(client)
        session = self._session
        if session is None:
            client.make_ready(_READY_TIMEOUT_S)
        else:
            hil_flight.make_ready(client, session, job.model, _READY_TIMEOUT_S)
        if client.state.armed:
            raise AlreadyArmed(client.link.name)
        pilot = Pilot(client, job.scenario, self._say(client), self._progress, self._sampled)
        if session is not None:
            pilot.watch = hil_flight.motor_watch(client, session, job.model)
        self._log = pilot.log
        try:
            self._upload(client)
            self._prepare_faults(client, pilot)
            pilot.fly()
        finally:
            with interrupts.landing():
                self._tear_down(client, pilot)

    def _prepare_faults(self, client: Client, pilot: Pilot) -> None:
        assert self._loan is not None
        body: Any = self._vehicle if self._session is None else self._session.body
        self._faults.begin(
            client,
            pilot,
            self._loan,
            body=None if body is None else lambda: body.faults,
            autopilot=None if self._vehicle is None else self._vehicle.autopilot,
        )
        self._stack.callback(self._faults.end)

    def _tear_down(self, client: Client, pilot: Pilot) -> None:
        """Land, restore, leave the streams as they were: each is tried even if the one before failed."""
        trouble: LinkError | None = None
        steps: list[Callable[[], object]] = [
            lambda: pilot.come_down(may_force=self._job.in_memory or self._session is not None),
            self._restore,
            lambda: self._default_streams(client),
        ]
        for step in steps:
            try:
                step()
            except LinkError as error:
                trouble = trouble or error
                if isinstance(error, PeerLost | PeerSilent):
                    break
        if trouble is not None:
            # a vehicle of our own that came to grief is thrown away; another is flown again, by somebody
            if not (self._job.in_memory and self._log.failure):
                raise trouble
            self._log.notes.append(f"teardown incomplete: {trouble}")

    def _open_client(self) -> Client:
        job = self._job
        link: Link
        drive: Drive
        session = self._session
        if session is not None:
            link, drive = session.link, session.drive
        elif job.in_memory:
            vehicle = self._vehicle = Vehicle(job.model, job.profile, seed=job.scenario.seed)
            clock = SimClock(vehicle.tick_us)
            link, far = MemoryLink.pair()
            server = VehicleServer(vehicle, [ServerLink(far, Connection(1, 1, datagram=True), 0, "memory")])
            clock.every_tick(server.step)
            drive = SharedDrive(clock)
        else:
            link, drive = open_link(job.connect), NetworkDrive(job.patience_s)
        if session is None:
            self._stack.callback(link.close)
        files = self._files
        client = Client(self._faults.on_link(link, drive), drive, log=files.frame if files else None)
        if files is not None:
            from scenarios.recorder.link_lines import LinkCounts

            files.counts = lambda: LinkCounts.of(client.connection.counters)
        inverse = mix_of(job.flown_table()).inverse[:2]
        self._sampler = Sampler(client, inverse, files.rows if files else None, batch_s=job.batch_s)
        if session is not None:
            self._sampler.truth_at = session.truth_at
        return client

    def _set_streams(self, client: Client) -> None:
        for message_id, interval_us in _INTERVALS_US.items():
            if message_id in self._sampled or message_id not in sampler.SAMPLED:
                client.try_interval(message_id, interval_us)
        if self._job.in_memory:
            for message_id in _UNUSED_STREAMS:
                client.set_interval(message_id, -1)

    @property
    def _sampled(self) -> tuple[int, ...]:
        """What is streamed fast; a plant of ours tells its own truth, tick by tick."""
        own = self._session is not None
        return tuple(one for one in sampler.SAMPLED if not (own and one in sampler.SIMULATORS))

    def _borrow(self, client: Client) -> None:
        """Open the loan of the vehicle's parameters; what earlier flights still owe is given back first."""
        job = self._job

        def note(text: str) -> None:
            self._tell(text)
            self._notes.append(text)
            self._say(client)(5, text)

        if job.in_memory:
            self._loan = ParamLoan(client, None)
        else:
            self._loan = open_loan(
                client, job.connect, gain_set=job.gain_set.name, folder=job.folder, command=job.command, tell=note
            )
        self._stack.callback(self._loan.close)

    def _upload(self, client: Client) -> None:
        assert self._loan is not None
        self._progress("upload")
        parameters = self._job.parameters
        self._loan.back_up({**self._faults.parameters, **parameters})
        if self._files is not None:
            self._files.parameters(_BACKUP, {name: value.value for name, value in self._loan.was.items()})
            self._files.parameters(".params", {name: value for name, (value, _) in parameters.items()})
        self._loan.set(parameters)
        if self._session is not None:
            client.wait(SETTLE_S)

    def _restore(self) -> None:
        if self._loan is not None and self._loan.is_owed:
            self._progress("restore")
            self._loan.give_back()

    def _default_streams(self, client: Client) -> None:
        if not self._job.in_memory:
            for message_id in _INTERVALS_US:
                client.try_interval(message_id, 0)

    def _on_text(self, t_s: float, severity: int, text: str) -> None:
        self._events.append(Event(t_s, severity, text))
        if self._files is not None:
            self._files.event(t_s, severity, text)

    def _say(self, client: Client) -> Callable[[int, str], object]:
        return lambda severity, text: self._on_text(client.now_us() * 1e-6, severity, text)

    # -- the record --------------------------------------------------------------------------------------------

    @property
    def problem(self) -> FroudeError | None:
        """The first file that could not be written."""
        return self._files.problem if self._files is not None else None

    @property
    def owed(self) -> str:
        """What is left to do on a vehicle that is not ours, in a sentence; empty if nothing."""
        backup = self._files.path(_BACKUP) if self._files is not None else None
        return self._loan.owed(backup) if self._loan is not None else ""

    def close(self) -> None:
        """Let go of link and files as they are."""
        self._stack.close()

    def finish(self, stopped: BaseException | None = None) -> FlightRecord:
        """Score what was flown, write its files and close everything.

        Args:
            stopped: what ended the flight before its time.
        """
        job, log = self._job, self._log
        failure = log.failure
        if stopped is not None:
            why = "interrupted" if isinstance(stopped, KeyboardInterrupt) else str(stopped)
            self._on_text(max(0.0, self._sampler.last_s) if self._sampler else 0.0, 2, f"flight stopped: {why}")
            failure = failure or why
            if self.owed:
                log.notes.append(self.owed)
        segments = tuple(log.segments)
        telemetry = self._sampler.telemetry(segments) if self._sampler else Telemetry.empty()
        margins = flown_margins(job)
        faults = self._faults.injected
        metrics = flight_metrics(telemetry, segments, margins, faults)
        failure = failure or diverged(telemetry)
        outcome, reason, metrics = judge(metrics, job.scenario.limits, failure)
        if stopped is not None and not log.failure:
            outcome = Outcome.UNSET
        else:
            outcome, reason = judge_faults(outcome, reason, faults)
        notes = [*self._notes, *log.notes]
        timing = ""
        if self._session is not None:
            timing = self._session.summary()
            if self._session.faults:
                outcome, reason = Outcome.UNSET, "invalid: " + "; ".join(self._session.faults)
        record = FlightRecord(
            gain_set=job.gain_set,
            vehicle_spec=job.model.spec,
            telemetry=telemetry,
            segments=segments,
            events=tuple(self._events),
            metrics=metrics,
            margins=margins,
            outcome=outcome,
            reason=reason,
            warnings=(*job.warnings, *notes),
            telemetry_sha256=telemetry.sha256(),
            seed=job.scenario.seed,
            parameters={name: value for name, (value, _) in job.parameters.items()},
            timing=timing,
            faults=faults,
        )
        with self._stack:
            if self._files is not None:
                self._files.finish(record)
        return record


def flown_margins(job: FlightJob) -> dict[str, Any]:
    """Margins of the roll loop with the gains and filters that this job flies (`sitl.stability.Margins`)."""
    table = job.flown_table()

    def get(name: str) -> float:
        return float(table.get(name))

    gains = RollGains(
        k_phi=get("MC_ROLL_P"),
        k=get("MC_ROLLRATE_K"),
        kp=get("MC_ROLLRATE_P"),
        ki=get("MC_ROLLRATE_I"),
        kd=get("MC_ROLLRATE_D"),
        kff=get("MC_ROLLRATE_FF"),
    )
    profile = replace(job.profile, gyro_cutoff_hz=get("IMU_GYRO_CUTOFF"), dgyro_cutoff_hz=get("IMU_DGYRO_CUTOFF"))
    lag_s = job.profile.motor_lag(job.model.assumptions.motor_lag_s)
    return asdict(loop_margins(job.model.derivatives, gains, profile, lag_s))
