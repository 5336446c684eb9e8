"""What hangs in a vehicle's file tree: files made of bytes, folders, scratch files, real directories.

Failures are OSError with the errno a POSIX system gives; EACCES means "not for you": read-only places and whatever
lies outside a mounted directory. `bridge.ftp_files` arranges the nodes to a tree, `bridge.ftp` serves it.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple, Protocol, TypeAlias

FOLDER_SIZE: Final = 4096
"""Size a folder is said to have, in bytes, as the file system of a PX4 SITL says."""

LARGEST_FILE: Final = 0xFFFF_FFFF
"""Bytes of a file that can be asked for: an offset has 32 bits. A larger file ends there."""

MOST_ENTRIES: Final = 10_000
"""Most entries of one real directory that are shown."""

_OPEN_FLAGS: Final = (
    os.O_RDONLY
    | getattr(os, "O_NOFOLLOW", 0)
    | getattr(os, "O_NONBLOCK", 0)  # opening a FIFO must not wait for its writer
    | getattr(os, "O_CLOEXEC", 0)
    | getattr(os, "O_BINARY", 0)
)


def os_error(number: int) -> OSError:
    """Return the OSError (or its subclass) of an errno."""
    return OSError(number, os.strerror(number))


class Entry(NamedTuple):
    """One line of a listing.

    Attributes:
        kind: "F" file, "D" folder, "S" something that is only counted.
        name: its name; empty for "S".
        size: of a file, in bytes.
    """

    kind: str
    name: str = ""
    size: int = 0


SKIPPED: Final = Entry("S")


class OpenFile(Protocol):
    """What a session holds: a file or a folder that was opened."""

    size: int
    """Size in bytes when it was opened; reading ends there."""

    def read(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset` on; raises OSError."""

    def write(self, offset: int, data: bytes) -> int:
        """Write at `offset` and return the number of bytes written; raises OSError."""

    def close(self) -> None:
        """Let go of it; it is not used again."""


class OpenBytes:
    """Bytes opened for reading; what made them may make others meanwhile."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.size = len(data)

    def read(self, offset: int, size: int) -> bytes:
        """See OpenFile."""
        return self._data[offset : offset + size]

    def write(self, offset: int, data: bytes) -> int:
        """Raise EBADF: it is open for reading."""
        raise os_error(errno.EBADF)

    def close(self) -> None:
        """Nothing to let go of."""


class OpenFolder(OpenBytes):
    """A folder opened as if it were a file: that works, as on Linux, and reading it does not."""

    def __init__(self) -> None:
        super().__init__(b"")
        self.size = FOLDER_SIZE

    def read(self, offset: int, size: int) -> bytes:
        """Raise EISDIR."""
        raise os_error(errno.EISDIR)


@dataclass(slots=True)
class FixedFile:
    """A read-only file.

    Attributes:
        content: its bytes, or what makes them each time it is opened or listed.
    """

    content: bytes | Callable[[], bytes]

    def data(self) -> bytes:
        """Return the file's bytes as of now."""
        return self.content() if callable(self.content) else self.content


class Quota:
    """How much clients may leave in the scratch space.

    Args:
        file_bytes: largest file, in bytes.
        total_bytes: all files together, in bytes.
        entries: most files and folders.
    """

    def __init__(self, file_bytes: int, total_bytes: int, entries: int) -> None:
        self.file_bytes = file_bytes
        self.total_bytes = total_bytes
        self.entries = entries
        self.used_bytes = 0
        self.used_entries = 0

    def take_entry(self) -> None:
        """Count a new file or folder; raises ENOSPC."""
        if self.used_entries >= self.entries:
            raise os_error(errno.ENOSPC)
        self.used_entries += 1

    def resize(self, old: int, new: int) -> None:
        """Count a file's change of size in bytes; raises EFBIG, ENOSPC."""
        if new > old:
            if new > self.file_bytes:
                raise os_error(errno.EFBIG)
            if self.used_bytes + new - old > self.total_bytes:
                raise os_error(errno.ENOSPC)
        self.used_bytes += new - old


class ScratchFile:
    """A file a client made; it lives in memory. One that is removed while it is open lives until it is closed."""

    def __init__(self, quota: Quota) -> None:
        quota.take_entry()
        self.data = bytearray()
        self._quota = quota
        self._users = 1  # the folder it is in, and each session that has it open

    def resize(self, size: int) -> None:
        """Cut it off or fill it up with zeros to `size` bytes; raises EFBIG, ENOSPC."""
        old = len(self.data)
        self._quota.resize(old, size)
        if size < old:
            del self.data[size:]
        else:
            self.data.extend(bytes(size - old))

    def write(self, offset: int, data: bytes) -> int:
        """Write at `offset`, beyond the end too; raises EFBIG, ENOSPC."""
        end = offset + len(data)
        if data and end > len(self.data):
            self.resize(end)
        self.data[offset:end] = data
        return len(data)

    def hold(self) -> None:
        """One user more."""
        self._users += 1

    def release(self) -> None:
        """One user less; the last one frees the memory."""
        self._users -= 1
        if not self._users:
            self.resize(0)

    def unlink(self) -> None:
        """It was taken out of its folder."""
        self._quota.used_entries -= 1
        self.release()


class OpenScratch:
    """A scratch file that a session has open."""

    def __init__(self, file: ScratchFile, *, writing: bool) -> None:
        self._file = file
        self._writing = writing
        self.size = len(file.data)
        file.hold()

    def read(self, offset: int, size: int) -> bytes:
        """See OpenFile; EBADF when it is open for writing."""
        if self._writing:
            raise os_error(errno.EBADF)
        return bytes(self._file.data[offset : offset + size])

    def write(self, offset: int, data: bytes) -> int:
        """See OpenFile; EBADF when it is open for reading."""
        if not self._writing:
            raise os_error(errno.EBADF)
        return self._file.write(offset, data)

    def close(self) -> None:
        """Let go of it."""
        self._file.release()


class OpenReal:
    """A file on disk, open for reading."""

    def __init__(self, descriptor: int, size: int) -> None:
        self._descriptor = descriptor
        self.size = min(size, LARGEST_FILE)

    def read(self, offset: int, size: int) -> bytes:
        """See OpenFile."""
        os.lseek(self._descriptor, offset, os.SEEK_SET)
        return os.read(self._descriptor, min(size, LARGEST_FILE - offset))

    def write(self, offset: int, data: bytes) -> int:
        """Raise EBADF: it is open for reading."""
        raise os_error(errno.EBADF)

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self._descriptor)


@dataclass(slots=True)
class Folder:
    """A folder of nodes.

    Attributes:
        writable: clients may make files and folders here.
        entries: what is in it, by name.
    """

    writable: bool
    entries: dict[str, Node] = field(default_factory=dict)


@dataclass(slots=True)
class RealFolder:
    """A directory on disk, read-only; nothing outside of it is reached, whatever links lie in it.

    Attributes:
        path: the directory; it need not exist yet.
    """

    path: Path

    def find(self, parts: tuple[str, ...]) -> str:
        """Return the real path of what `parts` names; raises OSError, EACCES for what a link leads out to."""
        try:
            root = os.path.realpath(self.path, strict=True)
            found = os.path.realpath(Path(root, *parts), strict=True)
        except ValueError:  # a name this machine's file system cannot have
            raise os_error(errno.ENOENT) from None
        if found != root and not found.startswith(root.rstrip(os.sep) + os.sep):
            raise os_error(errno.EACCES)
        return found

    def open(self, parts: tuple[str, ...]) -> OpenFile:
        """Open a file or a directory; raises OSError, EACCES for devices, FIFOs and sockets."""
        path = self.find(parts)
        mode = Path(path).stat().st_mode
        if stat.S_ISDIR(mode):
            return OpenFolder()
        if not stat.S_ISREG(mode):
            raise os_error(errno.EACCES)
        descriptor = os.open(path, _OPEN_FLAGS)
        state = os.fstat(descriptor)
        if not stat.S_ISREG(state.st_mode):  # it was replaced meanwhile
            os.close(descriptor)
            raise os_error(errno.EACCES)
        return OpenReal(descriptor, state.st_size)

    def entries(self, parts: tuple[str, ...]) -> list[Entry]:
        """Return the entries of a directory by name; links and devices are only counted. Raises OSError."""
        if not parts and not self.path.exists():
            return []  # nothing was recorded yet
        found: list[Entry] = []
        with os.scandir(self.find(parts)) as entries:
            for entry in entries:
                if len(found) >= MOST_ENTRIES:
                    break
                if entry.is_dir(follow_symlinks=False):
                    found.append(Entry("D", entry.name))
                elif entry.is_file(follow_symlinks=False):
                    found.append(Entry("F", entry.name, _size(entry)))
                else:
                    found.append(SKIPPED)
        return sorted(found, key=lambda entry: entry.name)


def _size(entry: os.DirEntry[str]) -> int:
    """Size of a file in bytes; 0 when it is gone already."""
    try:
        return entry.stat(follow_symlinks=False).st_size
    except OSError:
        return 0


Node: TypeAlias = FixedFile | ScratchFile | Folder | RealFolder
