"""One gain set flown through one scenario: connect, back up, upload, fly, land, restore, record, score.

Whatever goes wrong, what was flown so far is on disk and in the record before anybody is told.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bridge.client import Client
from bridge.clock import SimClock
from bridge.connection import Connection
from bridge.drive import Drive, NetworkDrive, SharedDrive
from bridge.errors import CommandRefused, PeerLost, PeerSilent, UploadFailed
from bridge.link import Link, MemoryLink, open_link
from bridge.param_operation import ParamValue
from bridge.tlog import TlogWriter
from bridge.vehicle_server import ServerLink, VehicleServer
from scenarios import sampler
from scenarios.flight import Event, FlightRecord
from scenarios.gain_set import GainSet, save_params
from scenarios.limits import Outcome, judge
from scenarios.pilot import FlightLog, Pilot
from scenarios.sampler import Sampler
from scenarios.scenario import Scenario
from scenarios.score import diverged, flight_metrics
from scenarios.telemetry import Telemetry
from sitl.control_settings import mix_of
from sitl.errors import FroudeError
from sitl.parameters import ParameterTable, ParameterType
from sitl.profile import Profile
from sitl.sampled_loop import RollGains
from sitl.stability import loop_margins
from sitl.vehicle import Vehicle, airframe_parameters
from sitl.vehicle_spec import VehicleModel

MEMORY = "memory://"

_INTERVALS_US = {
    **dict.fromkeys(sampler.SAMPLED, sampler.CRUISE_INTERVAL_US),
    sampler.LOCAL_POSITION_NED: 20_000,
    sampler.CURRENT_MODE: 100_000,
}
_UNUSED_STREAMS = (4, 24, 26, 29, 31, 33, 36, 74, 85, 105, 111, 141, 147, 230, 241, 331)
_READY_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class FlightJob:
    """Everything one flight needs; plain data, so that it can go to another process.

    Attributes:
        gain_set: what is tried.
        parameters: name -> (value, type): everything that is uploaded, the other axes' gains too.
        scenario, model, profile: what flies how.
        warnings: of the gain set's check.
        folder: where the flight's files go; None keeps nothing.
        connect: link URL of a vehicle, or memory:// for one of our own.
        live_port: port for viewers, None for none.
        patience_s: wall-clock silence after which a vehicle elsewhere counts as lost, s.
    """

    gain_set: GainSet
    parameters: Mapping[str, tuple[float | int, ParameterType]]
    scenario: Scenario
    model: VehicleModel
    profile: Profile
    warnings: tuple[str, ...] = ()
    folder: Path | None = None
    connect: str = MEMORY
    live_port: int | None = None
    patience_s: float = 5.0

    @property
    def in_memory(self) -> bool:
        """The vehicle is ours, in this thread."""
        return self.connect.startswith(MEMORY)


class FlightStoppedError(Exception):
    """The flight is over before its time, and so is the run: record first, then tell.

    Args:
        record: what was flown. cause: what to tell.
    """

    def __init__(self, record: FlightRecord, cause: BaseException) -> None:
        super().__init__(str(cause))
        self.record = record
        self.cause = cause


def fly(job: FlightJob, progress: Callable[[str], object] = lambda _: None) -> FlightRecord:
    """Fly one job.

    Args:
        job: what to fly. progress: called with a short text at every phase.

    Returns:
        the record, scored.

    Raises:
        FlightStoppedError: the link died, a parameter was refused, or Ctrl-C; carries the record so far.
    """
    flight = _Flight(job, progress)
    try:
        flight.run()
    except (FroudeError, KeyboardInterrupt) as cause:
        raise FlightStoppedError(flight.finish(interrupted=cause), cause) from cause
    return flight.finish()


class _Flight:
    """The moving parts of one flight."""

    def __init__(self, job: FlightJob, progress: Callable[[str], object]) -> None:
        self._job = job
        self._progress = progress
        self._stack = ExitStack()
        self._events: list[Event] = []
        self._log = FlightLog()
        self._backup: dict[str, ParamValue] = {}
        self._uploaded = False
        self._restored = False
        self._sampler: Sampler | None = None
        self._recorder: Any = None
        self._base = job.folder / job.gain_set.slug if job.folder else None
        self._version: dict[str, Any] = {}

    def run(self) -> None:
        """Everything that talks to the vehicle, with a teardown that always runs."""
        job = self._job
        self._progress("connect")
        self._open_recorder()
        client = self._open_client()
        client.on_text = self._on_text
        client.connect()
        self._set_streams(client)
        client.wait_ready(_READY_TIMEOUT_S)
        pilot = Pilot(client, job.scenario, self._say(client), self._progress)
        self._log = pilot.log
        try:
            self._upload(client)
            pilot.fly()
        finally:
            self._tear_down(client, pilot)

    def _tear_down(self, client: Client, pilot: Pilot) -> None:
        try:
            pilot.come_down(may_force=self._job.in_memory)
            self._restore(client)
            if not self._job.in_memory:
                for message_id in _INTERVALS_US:
                    client.try_interval(message_id, 0)
        except (PeerLost, PeerSilent, CommandRefused, UploadFailed) as error:
            self._log.notes.append(f"teardown incomplete: {error}")
            if not self._log.failure:
                raise

    def _open_client(self) -> Client:
        job = self._job
        log = None
        if self._base is not None:
            log = self._stack.enter_context(TlogWriter(self._base.with_name(self._base.name + ".tlog"))).write
        link: Link
        drive: Drive
        if job.in_memory:
            vehicle = Vehicle(job.model, job.profile, seed=job.scenario.seed)
            clock = SimClock(vehicle.tick_us)
            link, far = MemoryLink.pair()
            server = VehicleServer(vehicle, [ServerLink(far, Connection(1, 1, datagram=True), 0, "memory")])
            clock.every_tick(server.step)
            drive = SharedDrive(clock)
        else:
            link, drive = open_link(job.connect), NetworkDrive(job.patience_s)
        self._stack.callback(link.close)
        client = Client(link, drive, log=log)
        self._sampler = Sampler(client, self._inverse(), self._recorder.append if self._recorder else None)
        return client

    def _inverse(self) -> Any:
        job = self._job
        table = ParameterTable(airframe_parameters(job.model, job.profile))
        for name, (value, _) in job.parameters.items():
            if name.startswith("CA_"):
                table.set(name, value)
        return mix_of(table).inverse[:2]

    def _open_recorder(self) -> None:
        if self._base is None:
            return
        from scenarios.recorder import FlightRecorder

        job = self._job
        self._recorder = self._stack.enter_context(
            FlightRecorder(
                self._base.with_name(self._base.name + ".rrd"),
                name=job.gain_set.name,
                recording_id=f"{job.folder.parent.name if job.folder else 'flight'}-{job.gain_set.slug}",
                rotors=job.model.airframe.rotors,
                live_port=job.live_port,
            )
        )

    def _set_streams(self, client: Client) -> None:
        for message_id, interval_us in _INTERVALS_US.items():
            client.try_interval(message_id, interval_us)
        if self._job.in_memory:
            for message_id in _UNUSED_STREAMS:
                client.set_interval(message_id, -1)

    def _upload(self, client: Client) -> None:
        self._progress("upload")
        self._backup = client.read_parameters(self._job.parameters)
        if self._base is not None:
            before = {name: value.value for name, value in self._backup.items()}
            self._save(self._base.with_name(self._base.name + ".backup.params"), before)
            flown = {name: value for name, (value, _) in self._job.parameters.items()}
            self._save(self._base.with_name(self._base.name + ".params"), flown)
        self._uploaded = True
        client.upload(self._job.parameters)

    def _save(self, path: Path, values: Mapping[str, float | int]) -> None:
        save_params(path, values, ParameterTable())

    def _restore(self, client: Client) -> None:
        if not self._uploaded or self._restored:
            return
        self._progress("restore")
        client.upload({name: (value.raw, value.type) for name, value in self._backup.items()})
        self._restored = True

    def _on_text(self, t_s: float, severity: int, text: str) -> None:
        self._events.append(Event(t_s, severity, text))
        if self._recorder is not None:
            self._recorder.event(t_s, severity, text)

    def _say(self, client: Client) -> Callable[[int, str], object]:
        return lambda severity, text: self._on_text(client.now_us() * 1e-6, severity, text)

    # -- the record --------------------------------------------------------------------------------------------

    def finish(self, interrupted: BaseException | None = None) -> FlightRecord:
        """Score what was flown and write its files."""
        job, log = self._job, self._log
        failure = log.failure
        if interrupted is not None:
            failure = "interrupted" if isinstance(interrupted, KeyboardInterrupt) else str(interrupted)
        segments = tuple(log.segments)
        telemetry = self._sampler.telemetry(segments) if self._sampler else Telemetry.empty()
        margins = flown_margins(job)
        metrics = flight_metrics(telemetry, segments, margins)
        failure = failure or diverged(telemetry)
        outcome, reason, metrics = judge(metrics, job.scenario.limits, failure)
        if interrupted is not None and not log.failure:
            outcome = Outcome.UNSET
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
            warnings=(*job.warnings, *log.notes),
            telemetry_sha256=telemetry.sha256(),
            seed=job.scenario.seed,
            parameters={name: value for name, (value, _) in job.parameters.items()},
        )
        self._write(record)
        return record

    def _write(self, record: FlightRecord) -> None:
        try:
            if self._base is not None and len(record.telemetry):
                record.telemetry.to_parquet(
                    self._base.with_name(self._base.name + ".parquet"),
                    {"gain_set": record.gain_set.name, "vehicle": record.vehicle_spec},
                )
            if self._recorder is not None:
                from scenarios.markdown import flight_page
                from scenarios.recorder.comparison import flight_properties

                for segment in record.segments:
                    self._recorder.segment(segment)
                self._recorder.close(flight_page(record), flight_properties(record))
        finally:
            self._stack.close()


def flown_margins(job: FlightJob) -> dict[str, Any]:
    """Margins of the roll loop with the gains and filters that this job flies (`sitl.stability.Margins`)."""
    table = ParameterTable(airframe_parameters(job.model, job.profile))
    for name, (value, _) in job.parameters.items():
        table.set(name, value)

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
