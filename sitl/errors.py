"""What can go wrong, by who has to act.

FroudeError
 +-- UsageError   the caller's mistake: a bad file, key, name or number (exit status 2)
 |    +-- FileError   ... in a file: says which file, key and value
 +-- LinkError    the link or the vehicle failed (exit status 3)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any


class FroudeError(Exception):
    """Base of every error whose text is written for a person; it is printed without a traceback."""

    exit_status = 2

    def __reduce__(self) -> tuple[Any, ...]:
        # Flights may run in other processes. By default an unpickled exception is made from its text alone, which
        # is not what the constructors of the subclasses take.
        return _copy, (type(self), self.args, self.__dict__)


def _copy(kind: type[FroudeError], args: tuple[Any, ...], attributes: dict[str, Any]) -> FroudeError:
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(attributes)
    return error


class UsageError(FroudeError):
    """The caller's mistake; the text names the thing and what to do about it."""


class FileError(UsageError):
    """A file that cannot be used.

    Args:
        path: the file.
        problem: what is wrong, naming key and value.
        remedy: what to do next.
    """

    def __init__(self, path: str | Path, problem: str, remedy: str = "") -> None:
        self.path = Path(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path}: {problem}" + (f". {remedy}" if remedy else ""))


class LinkError(FroudeError):
    """The link or the vehicle failed."""

    exit_status = 3
