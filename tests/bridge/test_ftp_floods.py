"""MAVFTP under those who ask for too much: what one request costs is bounded, and so is what all of them do."""

from __future__ import annotations

import os
import resource
import time
from pathlib import Path

import pytest

from bridge.connection import Connection
from bridge.ftp import IDLE_US, FtpServer
from bridge.ftp_files import FileTree
from bridge.ftp_session import CRC_FIRST_BYTES, ENTRIES_PER_S
from bridge.ftp_wire import Opcode

TARGET = {"target_system": 1, "target_component": 1}
TICK_US = 4_000
GIANT = 1 << 40


class Flooder:
    """Sends requests, each with a new number, and takes what comes back at once."""

    def __init__(self, directory: Path, peers: int = 1) -> None:
        files = FileTree()
        files.mount("log", directory)
        self.server = FtpServer(files)
        self.now_us = 1_000_000
        self._peers = [Connection(255 - number, 190) for number in range(peers)]
        self._vehicle = Connection(1, 1)
        self._seq = 0

    def ask(self, opcode: int, data: bytes = b"", *, offset: int = 0, link: int = 0, peer: int = 0) -> bytes | None:
        """The data of the answer, None if there is none."""
        self._seq = self._seq + 2 & 0xFFFF
        head = self._seq.to_bytes(2, "little") + bytes([0, opcode, min(len(data), 239), 0, 0, 0])
        payload = (head + offset.to_bytes(4, "little") + data).ljust(251, b"\0")[:251]
        frame = self._peers[peer].encode("FILE_TRANSFER_PROTOCOL", payload=payload, **TARGET)
        (message,) = self._vehicle.receive(frame)
        answers = self.server.handle(message, link, self.now_us)
        assert len(answers) <= 1
        if not answers:
            return None
        payload = bytes(answers[0][1]["payload"])
        return payload[12 : 12 + payload[4]]

    def wait(self, seconds: float, link: int = 0) -> int:
        """Let time pass; how many messages came."""
        count = 0
        for _ in range(round(seconds * 1e6 / TICK_US)):
            self.now_us += TICK_US
            count += len(self.server.poll(link, self.now_us))
        return count


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_a_large_folder_is_read_once_for_all_its_pages(tmp_path: Path) -> None:
    for number in range(3_000):
        (tmp_path / f"{number:06d}_{'x' * 60}.ulg").touch()
    flooder = Flooder(tmp_path)
    found = 0
    began = time.process_time()
    while (data := flooder.ask(Opcode.LIST, b"log", offset=found)) is not None and len(data) > 1:
        found += data.count(b"\0")
    assert found == 3_002
    assert time.process_time() - began < 2.0  # read anew for each page it is two million entries


def test_who_lists_without_end_is_not_answered_without_end(tmp_path: Path) -> None:
    for number in range(1_000):
        (tmp_path / f"{number}.ulg").touch()
    flooder = Flooder(tmp_path)
    answered = sum(flooder.ask(Opcode.LIST, b"log") is not None for _ in range(500))
    assert answered <= ENTRIES_PER_S // 1_000 + 1
    assert flooder.server.refused == 500 - answered
    assert flooder.ask(Opcode.LIST, b"log", link=1) is not None  # another link has what is its own
    flooder.wait(0.2)
    assert flooder.ask(Opcode.LIST, b"log") is not None
    assert flooder.ask(Opcode.NONE) == b""


def test_a_listing_goes_on_as_it_began_and_starts_anew_from_the_first_page(tmp_path: Path) -> None:
    for number in range(20):
        (tmp_path / f"{number:02d}_{'x' * 40}.ulg").touch()
    flooder = Flooder(tmp_path)
    first = flooder.ask(Opcode.LIST, b"log")
    assert first is not None
    (tmp_path / "00_first.ulg").touch()
    page = flooder.ask(Opcode.LIST, b"log", offset=first.count(b"\0"))
    assert page is not None
    assert page.startswith(b"F%02d_" % (first.count(b"\0") - 2))
    again = flooder.ask(Opcode.LIST, b"log")
    assert again is not None
    assert b"00_first.ulg" in again
    flooder.wait(IDLE_US * 1e-6 + 1.0)
    (tmp_path / "00_second.ulg").touch()
    assert flooder.ask(Opcode.LIST, b"log", offset=3).startswith(b"F00_second")  # type: ignore[union-attr]


def test_checksums_asked_for_again_and_again_read_a_piece_of_the_file_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (tmp_path / "giant.ulg").open("wb") as file:
        file.truncate(GIANT)
    read = 0
    really = os.read

    def counted(descriptor: int, size: int) -> bytes:
        nonlocal read
        read += size
        return really(descriptor, size)

    monkeypatch.setattr(os, "read", counted)
    flooder = Flooder(tmp_path)
    before = descriptors()
    for _ in range(100):
        assert flooder.ask(Opcode.CRC, b"log/giant.ulg") is None
    assert read == 100 * CRC_FIRST_BYTES
    assert descriptors() == before + 1
    flooder.server.forget(0)
    assert descriptors() == before


def test_a_giant_file_is_listed_opened_and_read_at_its_end_without_being_held(tmp_path: Path) -> None:
    with (tmp_path / "giant.ulg").open("wb") as file:
        file.truncate(GIANT)
    flooder = Flooder(tmp_path)
    assert b"giant.ulg\t4294967295" in (flooder.ask(Opcode.LIST, b"log") or b"")
    assert flooder.ask(Opcode.OPEN_READ, b"log/giant.ulg") == b"\xff\xff\xff\xff"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert flooder.ask(Opcode.READ, bytes(239), offset=0xFFFFFFFE) == b"\0"
    assert flooder.ask(Opcode.READ, bytes(239), offset=0xFFFFFFFF) == b"\6"
    assert flooder.ask(Opcode.BURST, offset=0xFFFFFF00) is None
    assert flooder.wait(0.2) < 200
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 8_000


def test_many_peers_share_the_one_session_of_their_link(tmp_path: Path) -> None:
    (tmp_path / "a.ulg").write_bytes(b"x")
    flooder = Flooder(tmp_path, peers=100)
    before = descriptors()
    assert flooder.ask(Opcode.OPEN_READ, b"log/a.ulg") == b"\1\0\0\0"
    refused = [flooder.ask(Opcode.OPEN_READ, b"log/a.ulg", peer=peer) for peer in range(1, 100)]
    assert refused == [b"\5"] * 99
    assert descriptors() == before + 1
    flooder.wait(IDLE_US * 1e-6 + 0.1)
    assert descriptors() == before
    assert flooder.ask(Opcode.OPEN_READ, b"log/a.ulg", peer=50) == b"\1\0\0\0"
    flooder.server.forget(0)


@pytest.mark.parametrize(
    "path",
    [
        b"../secret",
        b"log/../../secret",
        b"log/./../secret",
        b"/log//..//secret",
        b"log/outside",
        b"log/outside/secret",
        b"log/loop",
        b"log/loop/secret",
        b"log/absolute",
        b"/proc/self/environ",
        b"//etc/passwd",
        b"log\0/../secret",
        b"log/" + b"a" * 235,
        b"log/" + b"a/" * 117,
        b"log/\xff\xfe\x80",
        b"log/pipe",
        b"log/.",
    ],
)
def test_no_path_reaches_a_secret_beside_the_folder(tmp_path: Path, path: bytes) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    secret = tmp_path / "secret"
    secret.write_bytes(b"a secret")
    (inside / "outside").symlink_to("..")
    (inside / "loop").symlink_to("loop")
    (inside / "absolute").symlink_to(secret.resolve())
    os.mkfifo(inside / "pipe")
    flooder = Flooder(inside)
    for opcode in (
        Opcode.OPEN_READ,
        Opcode.CRC,
        Opcode.LIST,
        Opcode.REMOVE,
        Opcode.OPEN_WRITE,
        Opcode.CREATE,
        Opcode.TRUNCATE,
    ):
        answer = flooder.ask(opcode, path) or b""
        assert b"secret" not in answer
        got = flooder.ask(Opcode.READ, bytes(239)) or b""
        assert b"secret" not in got
        flooder.ask(Opcode.RESET)
    assert secret.read_bytes() == b"a secret"
    assert sorted(one.name for one in inside.iterdir()) == ["absolute", "loop", "outside", "pipe"]
