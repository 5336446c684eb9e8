"""The status line of a program that serves: over itself on a terminal, line below line elsewhere if asked for."""

from __future__ import annotations

import sys
from collections.abc import Callable


class StatusLine:
    """Writes to standard error.

    Args:
        always: also where there is no terminal. tell: prints a line for people.

    Attributes:
        shows: anything is written at all.
    """

    def __init__(self, *, always: bool, tell: Callable[[str], object]) -> None:
        self._terminal = sys.stderr is not None and sys.stderr.isatty()
        self.shows = self._terminal or (always and sys.stderr is not None)
        self._tell = tell
        self._dirty = False

    def show(self, line: str) -> None:
        """Show a status.

        Args:
            line: without its end.
        """
        if self._terminal:
            sys.stderr.write(f"\r{line}\x1b[K")
            self._dirty = True
        else:
            sys.stderr.write(f"{line}\n")
        sys.stderr.flush()

    def tell(self, text: str) -> None:
        """Say something between two statuses.

        Args:
            text: a line for people.
        """
        if self._dirty:
            sys.stderr.write("\n")
            self._dirty = False
        self._tell(text)
