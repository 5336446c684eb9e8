"""A live view beside a flight: another process, told what happens and never waited for.

What a flight has to tell goes into a file without a name, which the other process reads at its own pace and draws for
whoever looks on (`live_viewer`). So nothing that happens to a viewer, frozen, slow, killed or never there, reaches the
flight: not its pace, not its memory, not its files.

One such process per flying process and port. It lives until all is drawn after the flying process has ended.
"""

from __future__ import annotations

import atexit
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from scenarios.recorder.live_message import BadMessage, encode
from sitl.errors import UsageError

HOST: Final = "127.0.0.1"

_feeds: dict[int, LiveFeed] = {}


def address(port: int) -> str:
    """What a viewer connects to."""
    return f"rerun+http://{HOST}:{port}/proxy"


class LiveFeed:
    """The flying process's end.

    Args:
        port: of 127.0.0.1, where viewers look on.
        window: open a viewer's window, too.

    Raises:
        UsageError: the port is taken, or there is no room for temporary files.
    """

    def __init__(self, port: int, *, window: bool = False) -> None:
        _check_free(port)
        try:
            handle, self._path = tempfile.mkstemp(prefix="froude-live-")
        except OSError as error:
            raise UsageError(f"live view: no temporary file: {error.strerror or error}") from error
        self._spool = os.fdopen(handle, "wb", buffering=0)
        words = [self._path, str(port), str(os.getpid()), *(("window",) if window else ())]
        self.process = subprocess.Popen(
            # -P: a file of the working directory that is called like one of ours is not run
            [sys.executable, "-P", "-m", "scenarios.recorder.live_viewer", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the flight
        )
        self._lost = False
        atexit.register(self.close)

    def tell(self, what: str, *about: Any) -> None:
        """Tell of something; returns at once, whatever has become of the view.

        Args:
            what: one of `live_message.WORDS`. about: its facts.
        """
        if self._lost:
            return
        try:
            message = encode(what, *about)
            # nobody reads it any more: do not fill the disk
            self._lost = self.process.poll() is not None
            if not self._lost:
                self._spool.write(message)
        except (OSError, BadMessage):
            self._lost = True  # a full disk ends the view, not the flight; so does what is too large to be shown

    def close(self) -> None:
        """Nothing more will be told."""
        self._lost = True
        self._spool.close()
        if self.process.poll() is not None:  # else the file is its own to remove
            Path(self._path).unlink(missing_ok=True)


def feed(port: int, *, window: bool = False) -> LiveFeed:
    """The feed of this process, begun by the first call.

    Args:
        port: of 127.0.0.1. window: open a viewer's window with the first call.

    Raises:
        UsageError: the port is taken.
    """
    if port not in _feeds or _feeds[port].process.poll() is not None:
        _feeds[port] = LiveFeed(port, window=window)
    return _feeds[port]


def _check_free(port: int) -> None:
    """Rerun only logs that its server's port is taken, and then shows nothing."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"live view: port {port} of {HOST} cannot be used: {error}. Close the program that has it "
                "(another viewer or run; this run's other process: fly one at a time) or choose another port"
            ) from error
