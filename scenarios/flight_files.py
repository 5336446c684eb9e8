"""The files of one flight: recording, telemetry, log of the wire, parameters.

Recording and log grow while the vehicle flies, under names with `.partial` in them, and get their own when they are
finished: a file that has its name is whole. A disk that runs full must not keep a vehicle in the air: from the first
failure on nothing more is streamed, the flight goes on, and `problem` says what happened.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from bridge.tlog import TlogWriter
from scenarios.flight import FlightRecord
from scenarios.gain_set import save_params
from sitl.airframe import Rotor
from sitl.errors import FileError, FroudeError
from sitl.parameters import ParameterTable

if TYPE_CHECKING:
    from scenarios.recorder import FlightRecorder
    from scenarios.sampler import Columns


class FlightFiles:
    """Use it as a context manager: what is not finished is left as it is, under its partial name.

    Args:
        folder: where the files go; it exists.
        slug: the gain set's name as a file name; all files are called so.
        name: of the recording in the viewer.
        rotors: of the airframe, to draw it.
        live_port: port that serves viewers while flying; None for none.

    Attributes:
        problem: the first file that could not be written; None while all is well.

    Raises:
        FileError: the files cannot be created.
    """

    def __init__(
        self,
        folder: Path,
        slug: str,
        *,
        name: str,
        rotors: tuple[Rotor, ...],
        live_port: int | None = None,
        rows_per_chunk: int | None = None,
    ) -> None:
        from scenarios.recorder import FlightRecorder

        self.problem: FroudeError | None = None
        self._base = folder / slug
        self._recorder: FlightRecorder = FlightRecorder(
            self.path(".rrd"),
            name=name,
            recording_id=f"{folder.parent.name}-{slug}",
            rotors=rotors,
            live_port=live_port,
            rows_per_chunk=rows_per_chunk,
        )
        try:
            self._tlog = TlogWriter(self.path(".partial.tlog"))
        except FileError:
            self._recorder.abandon()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._attempt(self._tlog.close)
        self._recorder.abandon()

    def path(self, suffix: str) -> Path:
        """A file of this flight, `.parquet` for example."""
        return self._base.with_name(self._base.name + suffix)

    def frame(self, time_us: int, frame: bytes) -> None:
        """Log a MAVLink frame that passed at a vehicle time, us."""
        if self.problem is None:
            # written out, because it runs at every frame
            try:
                self._tlog.write(time_us, frame)
            except FroudeError as error:
                self.problem = error

    def rows(self, batch: Columns) -> None:
        """Record finished rows of telemetry."""
        if self.problem is None:
            self._attempt(lambda: self._recorder.append(batch))

    def event(self, t_s: float, severity: int, text: str) -> None:
        """Record a text and its MAV_SEVERITY."""
        if self.problem is None:
            self._attempt(lambda: self._recorder.event(t_s, severity, text))

    def parameters(self, suffix: str, values: Mapping[str, float | int]) -> None:
        """Write parameters as QGroundControl does, before anything is changed.

        Raises:
            FileError: they cannot be written; without a copy of the old values nothing is to be changed.
        """
        save_params(self.path(suffix), values, ParameterTable())

    def finish(self, record: FlightRecord) -> None:
        """Write what is left of a flight and give the files their names; failures are in `problem`."""
        from scenarios.markdown import flight_page
        from scenarios.recorder.comparison import flight_properties

        streamed = self.problem is None
        if len(record.telemetry):
            about = {"gain_set": record.gain_set.name, "vehicle": record.vehicle_spec}
            self._attempt(lambda: record.telemetry.to_parquet(self.path(".parquet"), about))
        for segment in record.segments:
            self._recorder.segment(segment)
        if streamed:
            self._attempt(self._finish_log)
            self._attempt(lambda: self._recorder.close(flight_page(record), flight_properties(record)))

    def _finish_log(self) -> None:
        self._tlog.close()
        self._tlog.path.replace(self.path(".tlog"))

    def _attempt(self, write: Callable[[], Any]) -> None:
        try:
            write()
        except FroudeError as error:
            self.problem = self.problem or error
        except OSError as error:
            remedy = "Free some space or choose another folder with --out"
            self.problem = self.problem or FileError(
                error.filename or self._base, f"cannot be written: {error.strerror or error}", remedy
            )
