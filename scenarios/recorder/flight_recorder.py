"""One flight as a Rerun recording, streamed into its file while it flies."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from scenarios.recorder.flight_drawing import FlightDrawing, FlownVehicle
from scenarios.recorder.flight_plots import Columns
from scenarios.recorder.link_lines import LinkCounts
from scenarios.recorder.stream import FileRecording

if TYPE_CHECKING:
    from scenarios.flight import Segment
    from scenarios.recorder.live import LiveFeed

APPLICATION_ID = "froude"
ROWS_PER_CHUNK = 500


class FlightRecorder:
    """Streams one flight into a `.rrd` file and, if asked, tells a live view of it.

    The file grows under `<name>.partial.rrd` and gets its own name in `close`. A flight that dies leaves the
    partial file, which the viewer opens too, with all but the last chunk. As a context manager it abandons an
    unclosed file.

    Args:
        path: the finished file, `*.rrd`.
        name: of the recording, as the viewer lists it: the gain set.
        recording_id: unique among the recordings that are opened together.
        vehicle: what flies.
        application_id: the viewer keeps one layout per application id.
        feed: a live view to be told everything, too; never waited for.
        rows_per_chunk: telemetry rows written together.

    Raises:
        FileError: the file cannot be created, or the disk is nearly full.
    """

    def __init__(
        self,
        path: Path,
        *,
        name: str,
        recording_id: str,
        vehicle: FlownVehicle,
        application_id: str = APPLICATION_ID,
        feed: LiveFeed | None = None,
        rows_per_chunk: int = ROWS_PER_CHUNK,
    ) -> None:
        self._chunk = rows_per_chunk
        self._waiting: list[Columns] = []
        self._waiting_rows = 0
        self._recording: FileRecording | None = FileRecording(
            path, application_id=application_id, recording_id=recording_id, name=name
        )
        self._drawing = FlightDrawing(self._recording, vehicle)
        self._feed = feed
        self._tell("begin", application_id, recording_id, name, vehicle)

    def __enter__(self) -> FlightRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.abandon()

    @property
    def recording(self) -> FileRecording:
        """The file; an error once it is closed."""
        if self._recording is None:
            raise ValueError("the recording is closed")
        return self._recording

    def append(self, batch: Columns) -> None:
        """Add telemetry rows.

        Args:
            batch: columns of `scenarios.telemetry.COLUMNS`, of equal length, later than everything before;
                `segment` is not used.
        """
        self._tell("rows", batch)
        self._waiting.append(batch)
        self._waiting_rows += len(batch["t_s"])
        if self._waiting_rows >= self._chunk:
            self._write_waiting()

    def event(self, t_s: float, severity: int, text: str) -> None:
        """Add a line to the event log; severity as MAV_SEVERITY (0 emergency to 7 debug)."""
        self.recording  # noqa: B018 an error once it is closed
        self._tell("event", t_s, severity, text)
        self._drawing.event(t_s, severity, text)

    def segment(self, segment: Segment) -> None:
        """Mark a measured part of the flight; may be called as soon as its end is known."""
        self._tell("segment", segment)
        self._drawing.segment(segment)

    def faults(self, t_s: float, text: str) -> None:
        """Mark which faults are in force from a vehicle time on; empty for none."""
        self._tell("faults", t_s, text)
        self._drawing.faults(t_s, text)

    def link(self, t_s: float, counts: LinkCounts) -> None:
        """What the link's counters say at a vehicle time, s."""
        self._tell("link", t_s, counts)
        self._drawing.link(t_s, counts)

    def close(
        self, summary: str = "", properties: Mapping[str, Mapping[str, Any]] | None = None, link: str = ""
    ) -> Path:
        """Write what is left, the summary and the final layout, and give the file its name.

        Args:
            summary: markdown beside the plots: verdict, gains, metrics.
            properties: group -> name -> number or text, searchable in the viewer; None is left out.
            link: markdown on the link to the vehicle.

        Returns:
            The finished file.

        Raises:
            FileError: not everything could be written; the partial file stays.
        """
        recording = self.recording
        self._write_waiting()
        self._tell("end", summary, link, properties or {})
        self._drawing.end(summary, link, properties or {})
        self._recording = None
        return recording.finish()

    def abandon(self) -> None:
        """Stop without finishing: the partial file keeps what was flown. Harmless after `close`."""
        if self._recording is None:
            return
        self._write_waiting()
        self._drawing.end_rows()
        self._recording.abandon()
        self._recording = None

    def _tell(self, what: str, *about: Any) -> None:
        if self._feed is not None:
            self._feed.tell(what, *about)

    def _write_waiting(self) -> None:
        if not self._waiting_rows:
            return
        batches, self._waiting, self._waiting_rows = self._waiting, [], 0
        if len(batches) == 1:
            self._drawing.rows(batches[0])
        else:
            self._drawing.rows({name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]})
