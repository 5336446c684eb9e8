"""One Rerun file being written: opening, lines, lanes, texts, and the move to its final name.

The file is the record of truth, so a viewer is never allowed to hold it up: a live view is served by
ourselves on the loopback interface (`GrpcServerSink`). Pushing into a viewer (`GrpcSink`) beside a file
stalls the file as soon as that viewer is slow or gone.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.errors import FileError, UsageError

Colour = tuple[int, ...]
"""Red, green, blue and perhaps opacity, 0 to 255."""

TIMELINE = "flight_time"
"""The viewer follows one timeline in all views, so flights and comparisons call theirs the same."""

LEAST_FREE_BYTES = 16_000_000
LIVE_MEMORY = "256MB"
"""What the live server keeps for a viewer that joins late."""
_FOOTER = b"FOOT"
"""Ends the last bytes of a file that was finished."""


class Recording:
    """A `.rrd` file under construction, called `<name>.partial.rrd` until `finish`.

    Args:
        path: the finished file.
        application_id: the viewer keeps one layout per application id.
        recording_id: unique among the recordings that are opened together.
        name: as the viewer lists it.
        live_port: also serve viewers on this port of 127.0.0.1.

    Raises:
        FileError: the file cannot be created, or the disk is nearly full.
        UsageError: the port is taken.
    """

    def __init__(
        self, path: Path, *, application_id: str, recording_id: str, name: str, live_port: int | None = None
    ) -> None:
        import rerun as rr

        self.path = path
        self.partial = path.with_name(path.stem + ".partial.rrd")
        rr.set_strict_mode(True)  # otherwise a wrong argument is a line on stderr and a hole in the file
        self.stream = rr.RecordingStream(application_id, recording_id=recording_id)
        _check_space(path)
        sinks: list[Any] = [rr.FileSink(str(self.partial))]
        if live_port is not None:
            _check_port(live_port)
            sinks.append(rr.GrpcServerSink("127.0.0.1", live_port, server_memory_limit=LIVE_MEMORY))
        try:
            self.stream.set_sinks(*sinks)
        except RuntimeError as error:
            raise FileError(
                path, f"cannot be written: {error}", "Choose another folder with --out"
            ) from error
        self.stream.set_log_time_enabled(False)
        self.stream.set_log_tick_enabled(False)
        self.stream.send_recording_name(name)

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

        self.stream.log(
            entity,
            rr.SeriesLines(
                names=list(names),
                colors=list(colours),
                widths=list(widths) if widths is not None else [1.5] * len(names),
                aggregation_policy="MinMax",
                interpolation_mode="StepAfter" if step else "Linear",
            ),
            static=True,
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
            scalars = scalars.partition([values.shape[1]] * len(time_s))
        self.stream.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=time_s)], scalars)

    def lane(self, entity: str, time_s: float, state: str) -> None:
        """The entity's state from this moment; empty ends the state before."""
        import rerun as rr

        self.stream.set_time(TIMELINE, duration=time_s)
        self.stream.log(entity, rr.StateChange(state=state))

    def text(self, entity: str, time_s: float, level: str, text: str) -> None:
        """A line of a log."""
        import rerun as rr

        self.stream.set_time(TIMELINE, duration=time_s)
        self.stream.log(entity, rr.TextLog(text, level=level))

    def document(self, entity: str, markdown: str) -> None:
        """A page of markdown, at no particular time."""
        import rerun as rr

        self.stream.reset_time()
        self.stream.log(entity, rr.TextDocument(markdown, media_type="text/markdown"), static=True)

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

    def finish(self) -> Path:
        """Write everything and give the file its name.

        Raises:
            FileError: not everything could be written; the partial file stays.
        """
        try:
            self.stream.flush()
            self.stream.disconnect()
            with self.partial.open("rb") as file:
                file.seek(-64, 2)
                whole = _FOOTER in file.read()
            if not whole:
                raise RuntimeError("the file has no end")
            self.partial.replace(self.path)
        except (RuntimeError, OSError) as error:
            raise FileError(
                self.path,
                f"could not be finished: {error}",
                f"Free some space; what was flown is in {self.partial}",
            ) from error
        return self.path

    def abandon(self) -> None:
        """Stop: the partial file keeps what was written and opens in the viewer."""
        self.stream.disconnect()


def _check_space(path: Path) -> None:
    import shutil

    try:
        free = shutil.disk_usage(path.parent).free
    except OSError as error:
        raise FileError(path, f"cannot be written: {error}", "Choose another folder with --out") from error
    if free < LEAST_FREE_BYTES:
        raise FileError(
            path,
            f"cannot be written: {free / 1e6:.1f} MB are free on its disk",
            "Free some space or choose another --out",
        )


def _check_port(port: int) -> None:
    """Rerun only logs that its server's port is taken, and then shows nothing."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"live view: port {port} of 127.0.0.1 cannot be used: {error}; close the program that has it "
                "(perhaps another viewer or run) or choose another port"
            ) from error
