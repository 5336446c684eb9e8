"""The live view's process: reads what a flight tells and draws it for viewers that connect.

    python -m scenarios.recorder.live_viewer SPOOL PORT PID [window]

It is started by `live`, for a flight in process PID. Only this machine can reach its port.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from scenarios.recorder.flight_drawing import FlightDrawing, FlownVehicle
from scenarios.recorder.flight_plots import Columns
from scenarios.recorder.live import HOST, address
from scenarios.recorder.live_message import WORDS, BadMessage, decode, size_of
from scenarios.recorder.stream import Recording

MEMORY = "256MB"
"""What is kept for a viewer that joins late; the oldest is dropped first."""

POLL_S = 0.05
READ_BYTES = 4 << 20
LINGER_S = 3.0
"""How long viewers are given to fetch the end."""


class LiveView:
    """Draws flights, one after the other, for who looks on.

    Args:
        port: of 127.0.0.1.
    """

    def __init__(self, port: int) -> None:
        import rerun as rr

        # Rerun's server holds its port for as long as a viewer is connected: one for all flights
        self._server = rr.RecordingStream("froude-live", send_properties=False)
        self._server.set_sinks(rr.GrpcServerSink(HOST, port, server_memory_limit=MEMORY))
        self._uri = address(port)
        self._drawing: FlightDrawing | None = None

    def begin(self, application_id: str, recording_id: str, name: str, vehicle: FlownVehicle) -> None:
        """Another flight begins."""
        import rerun as rr

        self.finish()
        stream = rr.RecordingStream(application_id, recording_id=recording_id)
        stream.set_sinks(rr.GrpcSink(self._uri))
        self._drawing = FlightDrawing(Recording(stream, name), vehicle, live=True)

    def rows(self, batch: Columns) -> None:
        """Telemetry rows."""
        if self._drawing is not None and len(batch["t_s"]):
            self._drawing.rows(batch)

    def finish(self) -> None:
        """Send what is on its way."""
        if self._drawing is not None:
            with contextlib.suppress(RuntimeError):
                self._drawing.recording.stream.flush(timeout_sec=LINGER_S)

    def take(self, what: str, *about: Any) -> None:
        """Draw one message of the flight; what is none of `live_message.WORDS` is left alone."""
        if what in ("begin", "rows"):
            getattr(self, what)(*about)
        elif what in WORDS and self._drawing is not None:
            getattr(self._drawing, what)(*about)


def messages(spool: IO[bytes], flying: int) -> Iterator[tuple[Any, ...]]:
    """What is told, until the process that tells has ended and all is read, or until it makes no sense.

    Args:
        spool: being written. flying: that process.
    """
    pause = threading.Event()
    waiting = b""
    while True:
        ended = os.getppid() != flying
        data = spool.read(READ_BYTES)
        waiting += data
        start = 0
        try:
            while (size := size_of(waiting, start)) is not None and len(waiting) >= start + size:
                yield decode(waiting[start : start + size])
                start += size
        except BadMessage:
            return  # where the next one would begin is not known either
        waiting = waiting[start:]
        if not data:
            if ended:
                return
            pause.wait(POLL_S)


def main(words: list[str]) -> None:
    """Serve until the flight is over.

    Args:
        words: the command line: spool, port, process, perhaps "window".
    """
    spool, port, flying, *more = words
    with Path(spool).open("rb") as file:
        Path(spool).unlink()  # the space is free when both processes have ended, however they do
        view = LiveView(int(port))
        if "window" in more:
            _open_window(view, int(port))
        for message in messages(file, int(flying)):
            view.take(*message)
    view.finish()
    threading.Event().wait(LINGER_S)
    os._exit(0)  # a viewer that hangs would hold Rerun's own ending up


def _open_window(view: LiveView, port: int) -> None:
    from scenarios.recorder.viewer import LOOPBACK, viewer_path
    from sitl.errors import UsageError

    quiet = subprocess.DEVNULL
    with contextlib.suppress(OSError, UsageError):
        command = [viewer_path(), *LOOPBACK, "--connect", address(port)]
        window = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
        window.returncode = 0  # it lives on without us


if __name__ == "__main__":
    main(sys.argv[1:])
