"""Files that somebody else may have made: looked at before they are read, so that reading ends and memory suffices."""

from __future__ import annotations

import stat
from pathlib import Path

from sitl.errors import FileError

LARGEST_TEXT = 16_000_000
"""Bytes of a file that people write: gains, airframes, scenarios."""


def check_plain(path: Path, most_bytes: int = LARGEST_TEXT) -> None:
    """Refuse devices, pipes and sockets, and a larger file than anybody has use for.

    One that is missing, a folder or a link in a loop is for whoever opens it to refuse.

    Args:
        path: of the file; a link to it will do. most_bytes: of it.

    Raises:
        FileError: which of these.
    """
    try:
        found = path.stat()
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(found.st_mode) and not stat.S_ISDIR(found.st_mode):
        raise FileError(path, "is a device, a pipe or a socket", "Give a file")
    if found.st_size > most_bytes:
        raise FileError(
            path, f"has {found.st_size} bytes, and at most {most_bytes} are read", "Check that it is the right file"
        )
