"""One Rerun file being written: opening, lines, lanes, texts, and the move to its final name.

The file is the record of truth, so no viewer is allowed near it: one stream with both a file and a `GrpcSink` stalls
the file as soon as the receiver is slow or gone. Who looks on is served by another process (`live`).
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.errors import FileError

Colour = tuple[int, ...]
"""Red, green, blue and perhaps opacity, 0 to 255."""

TIMELINE = "flight_time"
"""The viewer follows one timeline in all views, so flights and comparisons call theirs the same."""

LEAST_FREE_BYTES = 16_000_000
LEAST_LEFT_BYTES = 100_000
FLUSH_PATIENCE_S = 30.0
ABANDON_PATIENCE_S = 2.0
_FOOTER = b"FOOT"
"""Ends the last bytes of a file that was finished."""


class Recording:
    """Writes into one of Rerun's streams.

    Args:
        stream: a `RecordingStream` whose sink is set.
        name: as the viewer lists it.
    """

    def __init__(self, stream: Any, name: str) -> None:
        import rerun as rr

        rr.set_strict_mode(True)  # otherwise a wrong argument is a line on stderr and a hole in the file
        self.stream = stream
        self._time_s: NDArray[np.float64] | None = None
        self._time: Any = None
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.send_recording_name(name)

    def log(self, entity: str, thing: Any, time_s: float | None = None) -> None:
        """Log one of Rerun's archetypes, at a time or (None) for always."""
        if time_s is not None:
            self.stream.set_time(TIMELINE, duration=time_s)
        self.stream.log(entity, thing, static=time_s is None)

    def columns(self, entity: str, time_s: NDArray[np.float64], columns: Any) -> None:
        """Send many rows of Rerun's component columns; time_s is (n,)."""
        import rerun as rr

        if time_s is not self._time_s:
            # many entities have the same rows
            self._time_s, self._time = time_s, rr.TimeColumn(TIMELINE, duration=time_s)
        self.stream.send_columns(entity, [self._time], columns)

    def style(
        self,
        entity: str,
        names: Sequence[str],
        colours: Sequence[Colour],
        *,
        widths: Sequence[float] | None = None,
        step: bool = False,
    ) -> None:
        """Names, colours and widths of an entity's lines.

        Peaks are kept: the viewer's default averages samples that share a pixel and draws saturated motors as
            0.86.
        """
        import rerun as rr

        self.log(
            entity,
            rr.SeriesLines(
                names=list(names),
                colors=list(colours),
                widths=list(widths) if widths is not None else [1.5] * len(names),
                aggregation_policy="MinMax",
                interpolation_mode="StepAfter" if step else "Linear",
            ),
        )

    def lines(self, entity: str, time_s: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        """Samples of an entity's lines.

        Args:
            entity: its path.
            time_s: (n,) on the timeline.
            values: (n,) or (n, lines).
        """
        import rerun as rr

        scalars = rr.Scalars.columns(scalars=values.reshape(-1))
        if values.ndim == 2:
            scalars = scalars.partition(np.full(len(time_s), values.shape[1]))
        self.columns(entity, time_s, scalars)

    def lane(self, entity: str, time_s: float, state: str) -> None:
        """The entity's state from this moment; empty ends the state before."""
        self.lanes(entity, np.array([time_s]), [state])

    def lanes(self, entity: str, time_s: NDArray[np.float64], states: Sequence[str]) -> None:
        """Many states of an entity, each from its moment on; time_s is (n,)."""
        import rerun as rr

        self.columns(entity, time_s, rr.StateChange.columns(state=list(states)))

    def band(self, entity: str, name: str, colour: Colour) -> None:
        """Name and colour of a filled band; see `between`."""
        import rerun as rr

        # the line in the middle of it is of no interest
        style = rr.Measurements.from_fields(names=[name], colors=[colour], widths=[0.0])
        self.log(entity, style)

    def between(
        self, entity: str, time_s: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> None:
        """Edges of a filled band, (n,) each: the viewer fills one standard deviation around a value."""
        import rerun as rr

        half = 0.5 * (high - low)
        self.columns(entity, time_s, rr.Measurements.columns(values=0.5 * (high + low), variances=half * half))

    def text(self, entity: str, time_s: float, level: str, text: str) -> None:
        """A line of a log."""
        import rerun as rr

        self.log(entity, rr.TextLog(text, level=level), time_s)

    def document(self, entity: str, markdown: str) -> None:
        """A page of markdown, at no particular time."""
        import rerun as rr

        self.log(entity, rr.TextDocument(markdown, media_type="text/markdown"))

    def properties(self, groups: Mapping[str, Mapping[str, Any]]) -> None:
        """Searchable facts: group -> name -> number or text; None and NaN are left out."""
        import rerun as rr

        for group, values in groups.items():
            known = {
                name: value
                for name, value in values.items()
                if value is not None and not (isinstance(value, float) and math.isnan(value))
            }
            if known:
                self.stream.send_property(group, rr.AnyValues(**known))

    def layout(self, blueprint: Any) -> None:
        """The layout that the viewer opens with; the last one counts."""
        self.stream.send_blueprint(blueprint)


class FileRecording(Recording):
    """A `.rrd` file under construction, called `<name>.partial.rrd` until `finish`.

    Args:
        path: the finished file.
        application_id: the viewer keeps one layout per application id.
        recording_id: unique among the recordings that are opened together.
        name: as the viewer lists it.

    Raises:
        FileError: the file cannot be created, or the disk is nearly full.
    """

    def __init__(self, path: Path, *, application_id: str, recording_id: str, name: str) -> None:
        import rerun as rr

        self.path = path
        self.partial = path.with_name(path.stem + ".partial.rrd")
        _check_space(path)
        stream = rr.RecordingStream(application_id, recording_id=recording_id)
        try:
            stream.set_sinks(rr.FileSink(str(self.partial)))
        except RuntimeError as error:
            raise FileError(path, f"cannot be written: {error}", "Choose another folder with --out") from error
        super().__init__(stream, name)
        # in the file before anything else: one that is cut off anywhere still says whose it is
        with contextlib.suppress(RuntimeError):
            stream.flush(timeout_sec=FLUSH_PATIENCE_S)

    def finish(self) -> Path:
        """Write everything and give the file its name.

        Raises:
            FileError: not everything could be written; the partial file stays.
        """
        try:
            _check_space(self.path, LEAST_LEFT_BYTES)
            self.stream.flush(timeout_sec=FLUSH_PATIENCE_S)
            self._let_go()
            with self.partial.open("rb") as file:
                file.seek(-64, 2)
                whole = _FOOTER in file.read()
            if not whole:
                raise RuntimeError("the file has no end")
            self.partial.replace(self.path)
        except (RuntimeError, OSError, FileError) as error:
            self._let_go()
            problem = error.problem if isinstance(error, FileError) else error
            raise FileError(
                self.path,
                f"could not be finished: {problem}",
                f"Free some space; what was flown is in {self.partial}",
            ) from error
        return self.path

    def abandon(self) -> None:
        """Stop: the partial file keeps what was written and opens in the viewer."""
        self._let_go()

    def _let_go(self) -> None:
        """Rerun's writer may die of a full disk on the way, and then nobody answers: wait for a while only."""
        import rerun as rr

        closing = threading.Thread(target=self.stream.disconnect, daemon=True)
        closing.start()
        closing.join(ABANDON_PATIENCE_S)
        if closing.is_alive():
            rr.unregister_shutdown()  # which would wait for the same writer when the program ends


def _check_space(path: Path, least_bytes: int = LEAST_FREE_BYTES) -> None:
    import shutil

    try:
        free = shutil.disk_usage(path.parent).free
    except OSError as error:
        raise FileError(path, f"cannot be written: {error}", "Choose another folder with --out") from error
    if free < least_bytes:
        raise FileError(
            path,
            f"cannot be written: {free / 1e6:.1f} MB are free on its disk",
            "Free some space or choose another --out",
        )
