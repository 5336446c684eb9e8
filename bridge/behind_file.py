"""Files that are written in whole pieces, at once or by a thread: who flies by the clock never waits for a disk.

Of a piece that does not fit any more nothing stays in the file.
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from collections.abc import Sequence
from os import write
from queue import SimpleQueue
from typing import Final

PATIENCE_S: Final = 30.0
"""How long the end of a file is waited for."""

MOST_WAITING_BYTES: Final = 64_000_000
"""A quarter of an hour of a flight's frames; a disk that is further behind has stopped."""


class DirectFile:
    """Writes each piece before it returns.

    Args:
        file: descriptor of a new, empty file; closed by `close`.
    """

    finished: Final = True

    def __init__(self, file: int) -> None:
        self._file = file
        self._size = 0
        self.closed = False

    def write(self, piece: bytes) -> None:
        """Append a piece. Raises OSError; then it is not in the file."""
        _append(self._file, [piece], self._size)
        self._size += len(piece)

    def finish(self) -> None:
        """All is written."""

    def close(self) -> None:
        """Let go of the file; may be repeated. Raises OSError."""
        if not self.closed:
            self.closed = True
            os.close(self._file)


class BehindFile:
    """Takes pieces at once and writes them as the disk lets it.

    Args:
        file: descriptor of a new, empty file; closed by `close`.

    Attributes:
        closed: no more pieces are taken.

    Raises:
        OSError: from `write`, and from `close` if `write` has not told it: what went wrong with earlier pieces. None is
            written after that.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        self._waiting: SimpleQueue[bytes | None] = SimpleQueue()
        self._given = self._written = 0
        self._error: OSError | None = None
        self._told = False
        self.closed = False
        self._thread = threading.Thread(target=self._run, name="writes a file", daemon=True)
        self._thread.start()

    def write(self, piece: bytes) -> None:
        """Hand a piece over; nothing is waited for."""
        if self._error is None and self._given - self._written > MOST_WAITING_BYTES:
            self._error = _stopped()
        if self._error is not None:
            self._told = True
            raise self._error
        self._given += len(piece)
        self._waiting.put(piece)

    @property
    def finished(self) -> bool:
        """Whether nothing is to be written any more."""
        return not self._thread.is_alive()

    def finish(self) -> None:
        """Take no more pieces; nothing is waited for."""
        if not self.closed:
            self.closed = True
            self._waiting.put(None)

    def close(self) -> None:
        """Wait until all is written, and let go of the file; may be repeated."""
        self.finish()
        self._thread.join(PATIENCE_S)
        if self._thread.is_alive() and self._error is None:
            self._error = _stopped()
        if self._error is not None and not self._told:
            self._told = True
            raise self._error

    def _run(self) -> None:
        try:
            try:
                ended = False
                while not ended:
                    # all that waits at once: a disk that is slow is asked the less often
                    parts = [self._waiting.get()]
                    while not self._waiting.empty():
                        parts.append(self._waiting.get())
                    ended = parts[-1] is None
                    pieces = [part for part in parts if part is not None]
                    _append(self._file, pieces, self._written)
                    self._written += sum(map(len, pieces))
            finally:
                os.close(self._file)
        except OSError as error:
            self._error = error


def _append(file: int, pieces: Sequence[bytes], size: int) -> None:
    """Write pieces at the end of a file of this size; of the one at which it fails nothing stays. Raises OSError."""
    left, done = memoryview(b"".join(pieces)), 0
    try:
        while left:
            count = write(file, left)
            left, done = left[count:], done + count
    except OSError:
        whole = 0
        for piece in pieces:
            if whole + len(piece) > done:
                break
            whole += len(piece)
        with contextlib.suppress(OSError):  # readers cope with half a message at the end
            os.ftruncate(file, size + whole)
        raise


def _stopped() -> OSError:
    return OSError(errno.ETIMEDOUT, f"{os.strerror(errno.ETIMEDOUT)}: the disk takes nothing")
