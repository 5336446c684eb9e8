"""Recordings that were cut off in the middle of a message: reader and viewer refuse them as a whole.

A killed program, a full disk or a copy that was interrupted leaves such a file. Without the unfinished message at its
end it opens; the file itself is left as it is.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

from sitl.errors import FileError

_MAGIC = b"RRF2"
_FILE_HEADER = 12
_MESSAGE = struct.Struct("<QQ")
"""Kind and length of the payload behind it."""

_END = 0
_FOOTER = b"FOOT"
"""Stands in the last bytes, behind the message that is the end."""


def whole_bytes(rrd: Path) -> int:
    """How much of a recording is whole messages, in bytes; all of it if its form is not known here.

    Args:
        rrd: the recording.

    Raises:
        OSError: it cannot be read.
    """
    size = rrd.stat().st_size
    with rrd.open("rb") as file:
        if file.read(4) != _MAGIC:
            return size
        at = _FILE_HEADER
        while at + _MESSAGE.size <= size:
            file.seek(at)
            kind, length = _MESSAGE.unpack(file.read(_MESSAGE.size))
            if at + _MESSAGE.size + length > size:
                return at
            at += _MESSAGE.size + length
            if kind == _END:
                file.seek(at)
                return size if _FOOTER in file.read() else at
    return min(at, size)


@contextlib.contextmanager
def whole_recording(rrd: Path, *, keep: bool = False) -> Iterator[Path]:
    """The recording itself, or a copy without the unfinished message at its end, as long as the block lasts.

    Args:
        rrd: the recording.
        keep: leave the copy among the temporary files: a viewer that goes on after us still needs it.

    Raises:
        FileError: it cannot be read, or the copy cannot be written.
    """
    copy = None
    try:
        whole = whole_bytes(rrd)
        if whole not in (0, rrd.stat().st_size):
            copy = Path(tempfile.mkdtemp(prefix="froude-")) / rrd.name
            shutil.copyfile(rrd, copy)
            os.truncate(copy, whole)
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise FileError(rrd, problem, "Check permissions and the space for temporary files") from error
    try:
        yield copy or rrd
    finally:
        if copy is not None and not keep:
            shutil.rmtree(copy.parent, ignore_errors=True)
