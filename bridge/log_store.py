"""Log files on disk: how they are named, found and removed.

As on a PX4, a log lies one folder deep: `2026-11-22/22_45_45.ulg` when the time of day is known, `sess001/log100.ulg`
when it is not. Only files called *.ulg in such a place count as logs, symbolic links never do, and nothing else is ever
removed.
"""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

SUFFIX: Final = ".ulg"
MAX_LOGS: Final = 4096
"""Most logs that are listed."""

_SESSION = re.compile(r"sess(\d{3,6})\Z")
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)\Z")
_TIME = re.compile(r"(\d\d)_(\d\d)_(\d\d)(?:_\d+)?\Z")
_FIRST_NUMBER = 100
_MOST_NUMBERS = 1000


class StoredLog(NamedTuple):
    """One log.

    Attributes:
        path: the file. size: bytes now. utc_s: when it began, s since 1970; 0 for unknown.
    """

    path: Path
    size: int
    utc_s: int


def find_logs(directory: Path, *, most: int = MAX_LOGS) -> list[StoredLog]:
    """The logs below a directory, oldest first; an unreadable or missing directory has none.

    Args:
        directory: where the logs are. most: how many; the newest count. 0 for all.
    """
    found = []
    for folder in _folders(directory):
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.name.endswith(SUFFIX) and entry.is_file(follow_symlinks=False):
                        size = entry.stat(follow_symlinks=False).st_size
                        found.append(StoredLog(Path(entry.path), size, _utc_s(folder.name, entry.name)))
        except OSError:
            continue  # it went away meanwhile
    found.sort(key=lambda log: (log.utc_s, *_order(log.path.parent.name), *_order(log.path.name)))
    return found[-most:]


def remove_log(path: Path) -> bool:
    """Delete a log, and its folder when that is empty now. Returns whether the log is gone."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return False
    with contextlib.suppress(OSError):  # other logs, or something that is not ours, may lie there still
        path.parent.rmdir()
    return True


def make_room(directory: Path, *, most_bytes: int, most_folders: int) -> int:
    """Delete the oldest logs until there are no more bytes and folders than asked for.

    Args:
        directory: where the logs are. most_bytes: of all together. most_folders: with logs in them; 0 for any number.

    Returns:
        how many were deleted.
    """
    logs = find_logs(directory, most=0)
    total = sum(log.size for log in logs)
    folders = list(dict.fromkeys(log.path.parent for log in logs))
    surplus = set(folders[: len(folders) - most_folders]) if 0 < most_folders < len(folders) else set()
    removed = 0
    for log in logs:
        if total <= most_bytes and log.path.parent not in surplus:
            continue
        if remove_log(log.path):
            total -= log.size
            removed += 1
    return removed


def next_session(directory: Path) -> str:
    """Name of the folder for a vehicle that does not know the time of day: one more than the last there is."""
    numbers = [int(match[1]) for folder in _folders(directory) if (match := _SESSION.match(folder.name))]
    return f"sess{max(numbers, default=0) + 1:03d}"


def create_log(directory: Path, session: str, utc_us: int, *, earlier: int = 0) -> tuple[Path, int]:
    """Make a new, empty log that nobody else has.

    Args:
        directory: where the logs are; made if missing.
        session: folder for a log without a time of day. utc_us: UTC, us; 0 for unknown.
        earlier: logs of this session so far: a number is not used again when its log was deleted.

    Returns:
        the path and a file descriptor to write to.

    Raises:
        OSError: it cannot be made.
    """
    if utc_us:
        date, clock = str(np.datetime64(utc_us // 1_000_000, "s")).split("T")
        folder, stem = directory / date, clock.replace(":", "_")
        names = [stem + SUFFIX, *(f"{stem}_{number}{SUFFIX}" for number in range(1, _MOST_NUMBERS))]
    else:
        folder = directory / session
        first = _FIRST_NUMBER + earlier
        names = [f"log{number}{SUFFIX}" for number in range(first, first + _MOST_NUMBERS)]
    folder.mkdir(parents=True, exist_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    for name in names:
        try:
            return folder / name, os.open(folder / name, flags, 0o644)
        except FileExistsError:
            continue
    raise FileExistsError(f"{folder} is full: {_MOST_NUMBERS} logs of one name")


def _folders(directory: Path) -> list[Path]:
    try:
        with os.scandir(directory) as entries:
            return [
                Path(entry.path)
                for entry in entries
                if entry.is_dir(follow_symlinks=False) and (_SESSION.match(entry.name) or _DATE.match(entry.name))
            ]
    except OSError:
        return []


def _order(name: str) -> tuple[int, str]:
    return len(name), name


def _utc_s(folder: str, name: str) -> int:
    date, clock = _DATE.match(folder), _TIME.match(name.removesuffix(SUFFIX))
    if not date or not clock:
        return 0
    try:
        return max(int(np.datetime64(f"{date[1]}T{clock[1]}:{clock[2]}:{clock[3]}", "s").astype(np.int64)), 0)
    except ValueError:
        return 0  # such as the 31st of February
