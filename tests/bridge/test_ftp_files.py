"""The file tree: what is in it, what clients may do there, that there is no way out."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from bridge.ftp_files import FileTree
from bridge.ftp_nodes import SKIPPED, Entry, OpenFile


def refused(number: int, act: Callable[[], object]) -> None:
    with pytest.raises(OSError) as caught:
        act()
    assert caught.value.errno == number, caught.value


def names(tree: FileTree, path: str) -> list[str]:
    entries = tree.entries(path)
    assert entries[:2] == [SKIPPED, SKIPPED]
    return [entry.name for entry in entries[2:]]


def content(file: OpenFile) -> bytes:
    try:
        return file.read(0, file.size)
    finally:
        file.close()


def make(tree: FileTree, path: str, data: bytes = b"") -> None:
    file = tree.open(path, write=True)
    file.write(0, data)
    file.close()


def test_a_file_is_the_same_by_any_spelling_of_its_path() -> None:
    tree = FileTree()
    tree.add("etc/extras/a.json", b"abc")
    for path in ("etc/extras/a.json", "/etc/extras/a.json", "//etc/./extras//a.json"):
        assert content(tree.open(path)) == b"abc"
    assert tree.entries("/etc/extras") == [SKIPPED, SKIPPED, Entry("F", "a.json", 3)]


def test_a_file_made_by_a_function_stays_the_same_while_it_is_open() -> None:
    tree = FileTree()
    made: list[int] = []

    def make_it() -> bytes:
        made.append(1)
        return b"x" * len(made)

    tree.add("a", make_it)
    assert not made  # not before it is needed
    file = tree.open("a")
    assert content(tree.open("a")) == b"xx"
    assert content(file) == b"x"


def test_an_unlisted_file_opens_by_its_exact_path_only() -> None:
    tree = FileTree()
    tree.add("@PARAM/param.pck", b"abc", listed=False)
    assert content(tree.open("@PARAM/param.pck")) == b"abc"
    assert names(tree, "/") == []
    refused(errno.ENOENT, lambda: tree.entries("@PARAM"))
    refused(errno.ENOENT, lambda: tree.open("@PARAM/param.pck?withdefaults=1"))
    refused(errno.EACCES, lambda: tree.open("@PARAM/param.pck", write=True))


def test_a_mounted_directory_shows_files_as_they_appear(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    tree = FileTree()
    tree.mount("log", logs)
    tree.mount("fs/microsd/log", logs)
    assert names(tree, "log") == []  # the directory is not there yet
    (logs / "day").mkdir(parents=True)
    (logs / "day" / "a.ulg").write_bytes(b"abc")
    (logs / "b.ulg").write_bytes(b"abcd")
    for where in ("log", "fs/microsd/log"):
        assert tree.entries(where)[2:] == [Entry("F", "b.ulg", 4), Entry("D", "day")]
        assert content(tree.open(f"{where}/day/a.ulg")) == b"abc"
        refused(errno.ENOENT, lambda where=where: tree.open(f"{where}/c.ulg"))
        refused(errno.ENOTDIR, lambda where=where: tree.open(f"{where}/b.ulg/c"))
        refused(errno.EISDIR, lambda where=where: tree.open(where).read(0, 1))


def test_links_lead_nowhere_outside(tmp_path: Path) -> None:
    logs, outside = tmp_path / "logs", tmp_path / "logs-outside"  # the one's name begins like the other's
    logs.mkdir(), outside.mkdir()
    (outside / "secret").write_bytes(b"secret")
    (logs / "a.ulg").write_bytes(b"abc")
    (logs / "out").symlink_to(outside)
    (logs / "up").symlink_to("..")
    (logs / "file").symlink_to(outside / "secret")
    (logs / "loop").symlink_to("loop")
    (logs / "inside").symlink_to("a.ulg")
    os.mkfifo(logs / "fifo")
    tree = FileTree()
    tree.mount("log", logs)
    for path in ("log/out", "log/out/secret", "log/up", "log/up/logs-outside/secret", "log/file", "log/fifo"):
        refused(errno.EACCES, lambda path=path: tree.open(path))
    refused(errno.EACCES, lambda: tree.entries("log/out"))
    refused(errno.ELOOP, lambda: tree.open("log/loop"))
    assert content(tree.open("log/inside")) == b"abc"
    assert sorted(tree.entries("log")[2:]) == [Entry("F", "a.ulg", 3), *[SKIPPED] * 6]


def test_nothing_on_disk_is_changed(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    (tmp_path / "d").mkdir()
    tree = FileTree()
    tree.mount("log", tmp_path)
    make(tree, "mine", b"x")
    for act in (
        lambda: tree.open("log/a", write=True),
        lambda: tree.open("log/new", write=True),
        lambda: tree.remove("log/a"),
        lambda: tree.truncate("log/a", 0),
        lambda: tree.make_folder("log/new"),
        lambda: tree.remove_folder("log/d"),
        lambda: tree.rename("log/a", "b"),
        lambda: tree.rename("mine", "log/b"),
        lambda: tree.rename("mine", "log"),
        lambda: tree.rename("log", "mine"),
        lambda: tree.remove_folder("log"),
        lambda: tree.remove_folder("/"),
    ):
        refused(errno.EACCES, act)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "d"]
    assert (tmp_path / "a").read_bytes() == b"abc"
    assert names(tree, "/") == ["log", "mine"]


def test_failures_are_those_of_a_posix_system() -> None:
    tree = FileTree()
    tree.add("etc/a", b"abc")
    make(tree, "f", b"x")
    tree.make_folder("d")
    make(tree, "d/x")
    for number, act in (
        (errno.ENOENT, lambda: tree.open("nothing")),
        (errno.ENOENT, lambda: tree.open("no/thing", write=True)),
        (errno.ENOENT, lambda: tree.open("a\0b", write=True)),
        (errno.ENOTDIR, lambda: tree.open("f/x", write=True)),
        (errno.ENOTDIR, lambda: tree.entries("f")),
        (errno.ENOTDIR, lambda: tree.remove_folder("f")),
        (errno.ENOTDIR, lambda: tree.rename("d", "f")),
        (errno.EISDIR, lambda: tree.open("d", write=True)),
        (errno.EISDIR, lambda: tree.remove("d")),
        (errno.EISDIR, lambda: tree.truncate("d", 0)),
        (errno.EISDIR, lambda: tree.rename("f", "d")),
        (errno.EEXIST, lambda: tree.make_folder("d")),
        (errno.EEXIST, lambda: tree.make_folder("etc")),
        (errno.EEXIST, lambda: tree.make_folder("/")),
        (errno.ENOTEMPTY, lambda: tree.remove_folder("d")),
        (errno.EINVAL, lambda: tree.rename("d", "d/e")),
        (errno.EACCES, lambda: tree.open("etc/new", write=True)),
        (errno.EACCES, lambda: tree.remove("etc/a")),
        (errno.EACCES, lambda: tree.rename("etc", "b")),
        (errno.EACCES, lambda: tree.entries("d/..")),
    ):
        refused(number, act)
    assert names(tree, "/") == ["d", "etc", "f"]


def test_renaming_moves_and_replaces() -> None:
    tree = FileTree()
    make(tree, "a", b"a")
    make(tree, "b", b"bb")
    tree.rename("a", "b")
    assert content(tree.open("b")) == b"a"
    tree.make_folder("d")
    tree.rename("b", "d/c")
    tree.make_folder("e")
    tree.rename("d", "e")
    tree.rename("e", "e")
    assert (names(tree, "/"), names(tree, "e")) == (["e"], ["c"])
    assert (tree.quota.used_bytes, tree.quota.used_entries) == (1, 2)


def test_the_scratch_space_is_bounded() -> None:
    tree = FileTree(file_bytes=100, total_bytes=150, entries=3)
    file = tree.open("a", write=True)
    refused(errno.EFBIG, lambda: file.write(2**32, b"x"))
    refused(errno.EFBIG, lambda: file.write(60, b"x" * 41))
    assert file.write(60, b"x" * 40) == 40
    refused(errno.ENOSPC, lambda: make(tree, "b", b"x" * 51))
    refused(errno.ENOSPC, lambda: tree.truncate("b", 51))
    tree.make_folder("c")
    refused(errno.ENOSPC, lambda: tree.make_folder("d"))
    refused(errno.ENOSPC, lambda: tree.open("d", write=True))
    tree.remove("a")
    assert tree.quota.used_bytes == 100  # it is open still
    refused(errno.ENOSPC, lambda: tree.truncate("b", 51))
    file.close()
    tree.truncate("b", 100)
    assert (tree.quota.used_bytes, tree.quota.used_entries) == (100, 2)


PARTS = st.lists(st.sampled_from(["a", "b", "c", "etc", "log", ".", "é"]), max_size=3).map("/".join)


class Scratch(RuleBasedStateMachine):
    """Whatever clients do, what the tree counts is what lies in it, and the fixed files are there."""

    def __init__(self) -> None:
        super().__init__()
        self.tree = FileTree(file_bytes=64, total_bytes=128, entries=6)
        self.tree.add("etc/a", b"fixed")
        self.open: list[OpenFile] = []

    def attempt(self, act: Callable[[], object]) -> None:
        with contextlib.suppress(OSError):
            act()

    @rule(path=PARTS, write=st.booleans(), empty=st.booleans())
    def open_one(self, path: str, write: bool, empty: bool) -> None:
        self.attempt(lambda: self.open.append(self.tree.open(path, write=write, empty=write and empty)))

    @rule(offset=st.integers(0, 80), data=st.binary(max_size=40))
    def write_one(self, offset: int, data: bytes) -> None:
        if self.open:
            self.attempt(lambda: self.open[-1].write(offset, data))

    @rule()
    def close_one(self) -> None:
        for file in self.open[:1]:
            file.close()
        del self.open[:1]

    @rule(path=PARTS, size=st.integers(0, 80))
    def change(self, path: str, size: int) -> None:
        self.attempt(lambda: self.tree.truncate(path, size))

    @rule(path=PARTS)
    def remove(self, path: str) -> None:
        self.attempt(lambda: self.tree.remove(path))
        self.attempt(lambda: self.tree.remove_folder(path))

    @rule(path=PARTS)
    def make(self, path: str) -> None:
        self.attempt(lambda: self.tree.make_folder(path))

    @rule(path=PARTS, new=PARTS)
    def rename(self, path: str, new: str) -> None:
        self.attempt(lambda: self.tree.rename(path, new))

    @invariant()
    def counted(self) -> None:
        sizes: list[int] = []
        waiting = [""]
        while waiting:
            path = waiting.pop()
            for entry in self.tree.entries(path)[2:]:
                if (path, entry.name) == ("", "etc"):
                    continue
                sizes.append(entry.size)
                waiting += [f"{path}/{entry.name}"] * (entry.kind == "D")
        quota = self.tree.quota
        assert quota.used_entries == len(sizes) <= 6
        assert sum(sizes) <= quota.used_bytes <= 128
        if not self.open:
            assert sum(sizes) == quota.used_bytes
        assert content(self.tree.open("etc/a")) == b"fixed"


TestScratch = Scratch.TestCase
TestScratch.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
