"""A file that a thread of its own writes: who flies never waits for a disk that is slow or stands still."""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from pathlib import Path
from queue import SimpleQueue
from typing import Final

PATIENCE_S: Final = 30.0
"""How long the end of a file is waited for."""

MOST_WAITING_BYTES: Final = 64_000_000
"""A quarter of an hour of a flight's frames; a disk that is further behind has stopped."""


class BehindFile:
    """Takes bytes at once and writes them as the disk lets it.

    Args:
        path: the file, overwritten if it exists.

    Raises:
        OSError: it cannot be opened; from `write` and `close` also what went wrong with earlier bytes.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._waiting: SimpleQueue[bytes | None] = SimpleQueue()
        self._given = self._written = 0
        self._error: OSError | None = None
        self.closed = False
        self._thread = threading.Thread(target=self._run, name=f"writes {path.name}", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Hand bytes over; nothing is waited for."""
        if self._error is None and self._given - self._written > MOST_WAITING_BYTES:
            self._error = _stopped()
        if self._error is not None:
            raise self._error
        self._given += len(data)
        self._waiting.put(data)

    def close(self) -> None:
        """Wait until all is written, and let go of the file; may be repeated."""
        if self.closed:
            return
        self.closed = True
        self._waiting.put(None)
        self._thread.join(PATIENCE_S)
        if self._thread.is_alive():
            raise _stopped()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            with contextlib.closing(self._file) as file:
                ended = False
                while not ended:
                    # all that waits at once: a disk that is slow is asked the less often
                    parts = [self._waiting.get()]
                    while not self._waiting.empty():
                        parts.append(self._waiting.get())
                    ended = parts[-1] is None
                    left = memoryview(b"".join(part for part in parts if part is not None))
                    count = len(left)
                    while left:
                        left = left[file.write(left) :]
                    self._written += count
        except OSError as error:
            self._error = error


def _stopped() -> OSError:
    return OSError(errno.ETIMEDOUT, f"{os.strerror(errno.ETIMEDOUT)}: the disk takes nothing")
