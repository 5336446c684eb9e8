"""FileTree: the files a vehicle shows over MAVFTP.

It looks like the working directory of a PX4 SITL: `etc/extras` with the component metadata, `log` with the flights.
Three kinds of files hang in it: read-only ones made of bytes or by a function, real directories mounted read-only,
and a scratch space in the root, in memory and bounded, where clients may make files and folders of their own; a PX4
lets them do so on its disk, and nobody needs ours for that.

Paths are relative to the root, with or without a leading slash; empty parts and "." do not count and ".." is
refused wherever it stands, as PX4 does (mavlink_ftp.cpp, 2026).
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path

from bridge.ftp_nodes import (
    SKIPPED,
    Entry,
    FixedFile,
    Folder,
    Node,
    OpenBytes,
    OpenFile,
    OpenFolder,
    OpenScratch,
    Quota,
    RealFolder,
    ScratchFile,
    os_error,
)


def parts_of(path: str) -> tuple[str, ...]:
    """Return the parts of a path; raises EACCES for one with "..", ENOENT for one with a NUL."""
    if "\0" in path:
        raise os_error(errno.ENOENT)
    parts = tuple(part for part in path.split("/") if part not in ("", "."))
    if ".." in parts:
        raise os_error(errno.EACCES)
    return parts


class FileTree:
    """A tree of virtual and real files, with a scratch space for clients.

    Every operation raises OSError with the errno of a POSIX system, and EACCES where clients have no business.

    Args:
        file_bytes: largest scratch file, in bytes.
        total_bytes: all scratch files together, in bytes.
        entries: most scratch files and folders.
    """

    def __init__(self, *, file_bytes: int = 4 << 20, total_bytes: int = 8 << 20, entries: int = 256) -> None:
        self.quota = Quota(file_bytes, total_bytes, entries)
        self._root = Folder(writable=True)
        self._unlisted: dict[tuple[str, ...], FixedFile] = {}

    def add(self, path: str, content: bytes | Callable[[], bytes], *, listed: bool = True) -> None:
        """Show a read-only file, in place of what is there already.

        Args:
            path: where; folders on the way are made.
            content: its bytes, or a function that is called for them whenever the file is opened or listed.
            listed: False hides it: it opens by its exact path, and its folders do not exist.
        """
        if listed:
            self._fix(path, FixedFile(content))
        else:
            self._unlisted[parts_of(path)] = FixedFile(content)

    def mount(self, path: str, directory: Path) -> None:
        """Show a real directory, read-only, with whatever comes to be in it; it need not exist yet.

        Args:
            path: where; folders on the way are made.
            directory: the directory.
        """
        self._fix(path, RealFolder(Path(directory)))

    def entries(self, path: str) -> list[Entry]:
        """Return a folder's entries by name; the first two are skipped ones, for "." and ".."."""
        node, rest = self._find(parts_of(path))
        if isinstance(node, RealFolder):
            return [SKIPPED, SKIPPED, *node.entries(rest)]
        if not isinstance(node, Folder):
            raise os_error(errno.ENOTDIR)
        return [SKIPPED, SKIPPED, *(_entry(name, child) for name, child in sorted(node.entries.items()))]

    def open(self, path: str, *, write: bool = False, empty: bool = False) -> OpenFile:
        """Open a file.

        Args:
            path: the file; a folder opens for reading too, though it cannot be read.
            write: open it for writing, and make it if it is not there.
            empty: with `write`, cut it off to nothing; the size of the opened file is still the old one.
        """
        parts = parts_of(path)
        node: Node | None = self._unlisted.get(parts)
        rest: tuple[str, ...] = ()
        if node is None:
            try:
                node, rest = self._find(parts)
            except FileNotFoundError:
                if not write:
                    raise
                folder = self._writable(parts[:-1])
                node = folder.entries[parts[-1]] = ScratchFile(self.quota)
        if isinstance(node, ScratchFile):
            opened = OpenScratch(node, writing=write)
            if empty:
                node.resize(0)
            return opened
        if write:
            raise os_error(errno.EISDIR if isinstance(node, Folder) else errno.EACCES)
        if isinstance(node, Folder):
            return OpenFolder()
        return OpenBytes(node.data()) if isinstance(node, FixedFile) else node.open(rest)

    def remove(self, path: str) -> None:
        """Remove a scratch file."""
        parts = parts_of(path)
        node = self._own(parts)
        if not isinstance(node, ScratchFile):
            raise os_error(errno.EISDIR)
        del self._writable(parts[:-1]).entries[parts[-1]]
        node.unlink()

    def truncate(self, path: str, size: int) -> None:
        """Cut a scratch file off, or fill it up with zeros, to `size` bytes."""
        node = self._own(parts_of(path))
        if not isinstance(node, ScratchFile):
            raise os_error(errno.EISDIR)
        node.resize(size)

    def make_folder(self, path: str) -> None:
        """Make a scratch folder."""
        parts = parts_of(path)
        if not parts or self._is_there(parts):
            raise os_error(errno.EEXIST)
        folder = self._writable(parts[:-1])
        self.quota.take_entry()
        folder.entries[parts[-1]] = Folder(writable=True)

    def remove_folder(self, path: str) -> None:
        """Remove an empty scratch folder."""
        parts = parts_of(path)
        node = self._own(parts)
        if not isinstance(node, Folder):
            raise os_error(errno.ENOTDIR)
        if not parts:
            raise os_error(errno.EACCES)
        if node.entries:
            raise os_error(errno.ENOTEMPTY)
        del self._writable(parts[:-1]).entries[parts[-1]]
        self.quota.used_entries -= 1

    def rename(self, path: str, new_path: str) -> None:
        """Rename or move a scratch file or folder; a file replaces a file and a folder an empty folder."""
        parts, new = parts_of(path), parts_of(new_path)
        node = self._own(parts)
        if not parts or not new:
            raise os_error(errno.EACCES)
        if parts == new:
            return
        if new[: len(parts)] == parts:
            raise os_error(errno.EINVAL)
        target = self._writable(new[:-1])
        if new[-1] in target.entries:
            replaced = self._own(new)
            if isinstance(node, Folder):
                self.remove_folder(new_path)  # says what is wrong with it if it does not work
            elif isinstance(replaced, Folder):
                raise os_error(errno.EISDIR)
            else:
                self.remove(new_path)
        target.entries[new[-1]] = self._writable(parts[:-1]).entries.pop(parts[-1])

    def _find(self, parts: tuple[str, ...]) -> tuple[Node, tuple[str, ...]]:
        """The node of a path; for a real directory with the parts below it."""
        node: Node = self._root
        for index, name in enumerate(parts):
            if isinstance(node, RealFolder):
                return node, parts[index:]
            if not isinstance(node, Folder):
                raise os_error(errno.ENOTDIR)
            if name not in node.entries:
                raise os_error(errno.ENOENT)
            node = node.entries[name]
        return node, ()

    def _is_there(self, parts: tuple[str, ...]) -> bool:
        try:
            node, rest = self._find(parts)
            if isinstance(node, RealFolder):
                node.find(rest)
        except FileNotFoundError:
            return False
        return True

    def _own(self, parts: tuple[str, ...]) -> ScratchFile | Folder:
        """A node that a client may change; ENOENT if there is nothing, EACCES if it is not a client's."""
        node, rest = self._find(parts)
        if isinstance(node, RealFolder):
            node.find(rest)
        if isinstance(node, ScratchFile) or (isinstance(node, Folder) and node.writable):
            return node
        raise os_error(errno.EACCES)

    def _writable(self, parts: tuple[str, ...]) -> Folder:
        """A folder in which a client may make something."""
        node, rest = self._find(parts)
        if isinstance(node, RealFolder):
            node.find(rest)
        elif isinstance(node, Folder) and node.writable:
            return node
        raise os_error(errno.ENOTDIR if isinstance(node, (FixedFile, ScratchFile)) else errno.EACCES)

    def _fix(self, path: str, node: Node) -> None:
        """Put a node that clients cannot move in its place."""
        *parents, name = parts_of(path)
        folder = self._root
        for parent in parents:
            child = folder.entries.get(parent)
            if not isinstance(child, Folder):
                child = folder.entries[parent] = Folder(writable=False)
            folder = child
        folder.entries[name] = node


def _entry(name: str, node: Node) -> Entry:
    """How a node is listed."""
    if isinstance(node, (Folder, RealFolder)):
        return Entry("D", name)
    return Entry("F", name, len(node.data()) if isinstance(node, FixedFile) else len(node.data))
