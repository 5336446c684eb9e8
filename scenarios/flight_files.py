"""The files of one flight: recording, telemetry, log of the wire, parameters.

Recording and log grow while the vehicle flies, under names with `.partial` in them, and get their own when they are
finished: a file that has its name is whole. A disk that runs full must not keep a vehicle in the air: from the first
failure on nothing more is streamed, the flight goes on, and `problem` says what happened.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from bridge.tlog import TlogWriter
from scenarios.flight import FlightRecord
from scenarios.gain_set import save_params
from sitl.errors import FileError, FroudeError
from sitl.parameters import ParameterTable

if TYPE_CHECKING:
    from scenarios.recorder import FlightRecorder
    from scenarios.recorder.flight_drawing import FlownVehicle
    from scenarios.recorder.link_lines import LinkCounts
    from scenarios.sampler import Columns


class FlightFiles:
    """Use it as a context manager: what is not finished is left as it is, under its partial name.

    Args:
        folder: where the files go; it exists.
        slug: the gain set's name as a file name; all files are called so.
        name: of the recording in the viewer.
        vehicle: what flies, to draw it.
        live_port: port that serves viewers while flying; None for none.
        live_window: open a viewer's window on it.
        rows_per_chunk: telemetry rows that are written together; None for the recorder's own choice.
        log_s: vehicle time of frames that the log may hold back.

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
        vehicle: FlownVehicle,
        live_port: int | None = None,
        live_window: bool = False,
        rows_per_chunk: int | None = None,
        log_s: float = math.inf,
    ) -> None:
        from scenarios.recorder import FlightRecorder, live
        from scenarios.recorder.flight_recorder import ROWS_PER_CHUNK
        from scenarios.recorder.link_lines import LinkCounts

        self.problem: FroudeError | None = None
        self._base = folder / slug
        self._counts = LinkCounts()
        self.about: Mapping[str, Any] = {}
        """Facts on the run, name -> number or text, for the recording's properties."""
        self.counts: Callable[[], LinkCounts] | None = None
        """What the link has counted so far; looked at with every batch of rows."""
        feed = None if live_port is None else live.feed(live_port, window=live_window)
        self._recorder: FlightRecorder = FlightRecorder(
            self.path(".rrd"),
            name=name,
            recording_id=f"{folder.parent.name}-{slug}",
            vehicle=vehicle,
            feed=feed,
            rows_per_chunk=rows_per_chunk or ROWS_PER_CHUNK,
        )
        try:
            self._tlog = TlogWriter(self.path(".partial.tlog"), waits_s=log_s)
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
            self._count(float(batch["t_s"][-1]))

    def _count(self, t_s: float) -> None:
        if self.counts is not None:
            self._counts = self.counts()
            self._attempt(lambda: self._recorder.link(t_s, self._counts))

    def event(self, t_s: float, severity: int, text: str) -> None:
        """Record a text and its MAV_SEVERITY."""
        if self.problem is None:
            self._attempt(lambda: self._recorder.event(t_s, severity, text))

    def faults(self, t_s: float, text: str) -> None:
        """Record which faults are in force from a vehicle time on; empty for none."""
        if self.problem is None:
            self._attempt(lambda: self._recorder.faults(t_s, text))

    def parameters(self, suffix: str, values: Mapping[str, float | int]) -> None:
        """Write parameters as QGroundControl does, before anything is changed.

        Raises:
            FileError: they cannot be written; without a copy of the old values nothing is to be changed.
        """
        save_params(self.path(suffix), values, ParameterTable())

    def finish(self, record: FlightRecord) -> None:
        """Write what is left of a flight and give the files their names; failures are in `problem`."""
        from scenarios.markdown import flight_page
        from scenarios.recorder.flight_properties import flight_properties
        from scenarios.recorder.link_lines import link_figures, link_page

        streamed = self.problem is None
        if len(record.telemetry):
            about = {"gain_set": record.gain_set.name, "vehicle": record.vehicle_spec}
            self._attempt(lambda: record.telemetry.to_parquet(self.path(".parquet"), about))
        for segment in record.segments:
            self._recorder.segment(segment)
        if streamed:
            self._attempt(self._finish_log)
            figures = link_figures(self._counts, record.telemetry, record.segments)
            properties = {**flight_properties(record), "run": self.about, "link": figures}
            page = link_page(figures, record.timing)
            self._attempt(lambda: self._recorder.close(flight_page(record), properties, page))

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
