"""ParamJournal: on disk before the first parameter is set, what a vehicle needs to be put back; gone when it has been.

    journal = ParamJournal.begin(owner, entries)    # written, synced, in its place
    journal.extend(more)                            # before these are sent
    journal.remove()                                # every value was read back
    journal.close()                                 # or: left for `froude restore`

Journals live in the user's state folder, where any later start finds them whatever --out was. One that a living process
holds is locked, so that nobody restores under a flight that is under way.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

from bridge.clock import WallClock, utc_stamp
from bridge.param_operation import ParamValue
from bridge.peer_identity import PeerIdentity
from scenarios.journal_text import JournalEntry, Owner, decode, encode
from sitl.errors import FileError, FroudeError, LinkError, UsageError

STATE_VARIABLE: Final = "FROUDE_STATE_DIR"
SUFFIX: Final = ".journal.json"

_LARGEST: Final = 4_000_000
_LOCK_TRIES: Final = 5
_LOCK_WAIT_US: Final = 20_000


def state_folder() -> Path:
    """Where journals are: `restore` in FROUDE_STATE_DIR, or in froude's folder of the user's state directory.

    Raises:
        UsageError: there is no home directory and nothing else is said.
    """
    if own := os.environ.get(STATE_VARIABLE):
        return Path(own).absolute() / "restore"
    base = os.environ.get("XDG_STATE_HOME", "")
    if not Path(base).is_absolute():  # the XDG specification: a relative one is to be ignored
        try:
            base = str(Path.home() / ".local" / "state")
        except RuntimeError:
            raise UsageError(
                f"no home directory to keep a vehicle's own parameters in: set {STATE_VARIABLE} to a folder"
            ) from None
    return Path(base) / "froude" / "restore"


class JournalBusy(LinkError):
    """A journal of a flight that is under way.

    Args:
        path: of the journal.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(f"{path}: another froude is at work on this vehicle. Let it end, or stop it with Ctrl-C")


@dataclass(frozen=True, slots=True)
class Pending:
    """A journal as read: its file, whose, what, and whether a living process holds it."""

    path: Path
    owner: Owner
    entries: tuple[JournalEntry, ...]
    busy: bool = False

    @property
    def values(self) -> dict[str, ParamValue]:
        """Name -> what it was."""
        return {entry.name: entry.value for entry in self.entries}


class ParamJournal:
    """A journal that this process holds; made by `begin` and `take`."""

    def __init__(self, path: Path, owner: Owner, entries: Iterable[JournalEntry], descriptor: int) -> None:
        self.path = path
        self.owner = owner
        self.entries = tuple(entries)
        self._descriptor = descriptor

    @classmethod
    def begin(cls, owner: Owner, entries: Iterable[JournalEntry]) -> Self:
        """Write a new journal; when this returns it outlives a power cut.

        Raises:
            FileError: it cannot be written; nothing is left of it.
        """
        folder = state_folder()
        stamp = owner.utc or utc_stamp()
        stem = f"{stamp}_system{owner.vehicle.sysid}_{os.getpid()}"
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise _unwritable(folder, error) from None
        path, number = folder / f"{stem}{SUFFIX}", 1
        while path.exists():
            number += 1
            path = folder / f"{stem}_{number}{SUFFIX}"
        journal = cls(path, replace(owner, utc=stamp), entries, -1)
        try:
            journal._write()
        except FileError:
            journal.remove()
            raise
        return journal

    @classmethod
    def take(cls, path: Path) -> Self | None:
        """Hold a journal that is there; None if it is gone by now.

        Raises:
            JournalBusy: a living process holds it. FileError: it is damaged or cannot be read.
        """
        try:
            descriptor = os.open(path, os.O_RDWR)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise FileError(path, f"cannot be opened ({error.strerror})", "Change its rights") from None
        held = cls(path, Owner(PeerIdentity("", 0)), (), descriptor)
        try:
            if not _lock_patiently(descriptor):
                raise JournalBusy(path)
            if not held._is_there():
                held.close()
                return None
            read = read_journal(path)
        except FroudeError:
            held.close()
            raise
        held.owner, held.entries = read.owner, read.entries
        return held

    def extend(self, entries: Iterable[JournalEntry]) -> None:
        """Add parameters, before they are sent; what is in it already stays as it is.

        Raises:
            FileError: it cannot be written; the journal is as it was.
        """
        before = self.entries
        there = {entry.name for entry in before}
        self.entries = (*before, *(entry for entry in entries if entry.name not in there))
        try:
            self._write()
        except FileError:
            self.entries = before
            raise

    def remove(self) -> None:
        """Delete it: every value was put back and read back. One that cannot be deleted is restored once more."""
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)
            _sync_folder(self.path.parent)
        self.close()

    def close(self) -> None:
        """Let go of it and leave it where it is; may be repeated."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _is_there(self) -> bool:
        """Whether its path still leads to the file that we opened: it may have been put back while we looked."""
        try:
            return os.path.samestat(os.fstat(self._descriptor), self.path.stat())
        except OSError:
            return False

    def _write(self) -> None:
        """Put the whole journal in its place, in one step, held by us from its first moment on."""
        part = self.path.with_name(f".{self.path.name}.part")
        data = encode(self.owner, self.entries).encode()
        descriptor = -1
        try:
            descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            _lock(descriptor)
            while data:
                data = data[os.write(descriptor, data) :]
            os.fsync(descriptor)
            part.replace(self.path)
        except OSError as error:
            if descriptor >= 0:
                os.close(descriptor)
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise _unwritable(self.path, error) from None
        self.close()
        self._descriptor = descriptor
        try:
            _sync_folder(self.path.parent)
        except OSError as error:
            raise _unwritable(self.path, error) from None


def pending() -> tuple[list[Pending], list[FileError]]:
    """Every journal in the state folder, oldest first, and what is wrong with those that cannot be read."""
    found: list[Pending] = []
    problems: list[FileError] = []
    folder = state_folder()
    try:
        paths = sorted(path for path in folder.iterdir() if path.name.endswith(SUFFIX) and path.name[0] != ".")
    except (FileNotFoundError, NotADirectoryError):
        return [], []
    except OSError as error:
        return [], [FileError(folder, f"cannot be read ({error.strerror})", "Change its rights")]
    for path in paths:
        try:
            found.append(read_journal(path))
        except FileError as problem:
            if path.exists():  # one that was removed while we looked is no trouble
                problems.append(problem)
    return sorted(found, key=lambda one: (one.owner.utc, one.path.name)), problems


def read_journal(path: Path) -> Pending:
    """Read one journal.

    Raises:
        FileError: it cannot be read, is empty, damaged, of another version, or no journal at all.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST)
            busy = not _lock(file.fileno(), shared=True)
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror or error})", "Give the path of a journal") from None
    owner, entries = decode(path, data)
    return Pending(path, owner, entries, busy)


def _lock_patiently(descriptor: int) -> bool:
    """As `_lock`, though somebody may be reading the file just now."""
    clock = WallClock()
    for _ in range(_LOCK_TRIES):
        if _lock(descriptor):
            return True
        clock.sleep_until_us(clock.now_us() + _LOCK_WAIT_US)
    return False


def _lock(descriptor: int, *, shared: bool = False) -> bool:
    """Hold a file until it is closed or the process ends, however that ends; whether nobody else holds it."""
    try:
        import fcntl
    except ImportError:  # a system without these locks does without
        return True
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without them, too
        return True
    return True


def _sync_folder(folder: Path) -> None:
    """Make a new name in a folder outlive a power cut. Raises OSError."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _unwritable(path: Path, error: OSError) -> FileError:
    return FileError(
        path,
        f"the vehicle's own parameters cannot be kept here ({error.strerror or error}), so none is changed",
        f"Free some space, change the folder's rights, or set {STATE_VARIABLE} to another folder",
    )
