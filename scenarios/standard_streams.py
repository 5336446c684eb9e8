"""Standard streams that whoever started us has closed (`froude fly >&-`, a daemon): they lead nowhere from then on.

Without that the next file that is opened, a recording perhaps, gets the number of standard output or standard error,
and whatever a library or a process that we start says there ends up in the middle of it.
"""

from __future__ import annotations

import os
import sys


def reopen() -> None:
    """Let those that are closed lead nowhere; to be called before any file is opened."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            # the lowest number that is free, so this one
            os.open(os.devnull, os.O_RDWR)
    # closed before Python started
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", closefd=False)


def show(text: str, remedy: str) -> Exception | None:
    """Print a result.

    Args:
        text: the result. remedy: where else it is.

    Returns:
        what went wrong; a reader that went away (froude fly | head) is no trouble.
    """
    from sitl.errors import FileError

    try:
        if sys.stdout is not None:
            sys.stdout.write(text)
            sys.stdout.flush()
    except BrokenPipeError:
        mute_stdout()
    except OSError as error:
        mute_stdout()
        return FileError("standard output", f"cannot be written: {error.strerror}", remedy)
    return None


def mute_stdout() -> None:
    """Let Python's own flush at exit go nowhere instead of failing."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)
