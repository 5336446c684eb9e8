"""The vehicle's MAVFTP, against what a real PX4 answered and over wires that lose and shuffle."""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.component_metadata import ComponentMetadata
from bridge.connection import Connection, Message
from bridge.ftp import BURST_BYTES, BURST_PACKETS, IDLE_US, FtpServer
from bridge.ftp_files import FileTree
from bridge.ftp_wire import FtpError, Opcode
from bridge.param_pack import serve_parameters
from sitl.parameters import ParameterTable

CASES = Path(__file__).parents[1] / "data" / "px4_answers.jsonl"
TICK_US = 4_000
ACK, NAK = 128, 129
GCS, API = 0, 1
TEXT = b"A" * 200 + b"B" * 200 + b"C" * 100
"""The file the recorded cases write, and its CRC as a PX4 gave it."""
TEXT_CRC = 484263055

# what we serve although a PX4 does not: the whole of what differs
DEVIATIONS = {"ftp-param": "the packed parameter file of ArduPilot exists here"}


def tree(log: Path | None = None) -> FileTree:
    files = FileTree()
    table = ParameterTable()
    ComponentMetadata(table).mount(files)
    serve_parameters(files, table)
    for path in ("log", "fs/microsd/log") if log else ():
        files.mount(path, log)  # type: ignore[arg-type]
    return files


def pack(
    op: int, data: bytes = b"", *, seq: int = 1, session: int = 0, offset: int = 0, size: int | None = None
) -> bytes:
    header = struct.pack("<HBBBBBBI", seq, session, op, len(data) if size is None else size, 0, 0, 0, offset)
    return (header + data[:239]).ljust(251, b"\0")


class Reply:
    """An answer taken apart."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self.seq, self.session, self.op, self.size, self.request, self.complete, _, self.offset = struct.unpack(
            "<HBBBBBBI", message.payload[:12]
        )
        self.data: bytes = message.payload[12 : 12 + self.size]

    @property
    def error(self) -> int | None:
        return self.data[0] if self.op == NAK else None

    @property
    def number(self) -> int:
        return int.from_bytes(self.data[:4], "little")


class Ground:
    """A ground station that keeps every answer, over real frames."""

    def __init__(self, files: FileTree | None = None, sysid: int = 255) -> None:
        self.server = FtpServer(files or tree(), system_id=1, component_id=1)
        self.now_us = 1_000_000
        self.seq = 100
        self._up, self._up_rx = Connection(sysid, 190), Connection(1, 1)
        self._down, self._down_rx = Connection(1, 1), Connection(sysid, 190)

    def send(self, payload: bytes, link: int = GCS, system: int = 1, component: int = 1) -> list[Reply]:
        target = {"target_system": system, "target_component": component}
        frame = self._up.encode("FILE_TRANSFER_PROTOCOL", payload=payload, **target)
        out: list[Reply] = []
        for message in self._up_rx.receive(frame):
            out += self._heard(self.server.handle(message, link, self.now_us))
        return out

    def wait(self, seconds: float, link: int = GCS) -> list[Reply]:
        out: list[Reply] = []
        for _ in range(max(1, round(seconds * 1e6 / TICK_US))):
            out += self._heard(self.server.poll(link, self.now_us))
            self.now_us += TICK_US
        return out

    def ask(self, op: int, data: bytes = b"", *, seconds: float = 0.0, **how: Any) -> list[Reply]:
        self.seq = how.setdefault("seq", self.seq + 100 & 0xFFFF)
        out = self.send(pack(op, data, **how))
        return out + (self.wait(seconds) if seconds else [])

    def one(self, op: int, data: bytes = b"", **how: Any) -> Reply:
        (reply,) = self.ask(op, data, **how)
        return reply

    def read_all(self, path: bytes) -> bytes:
        """Download with bursts, asking for the next whenever one is complete."""
        opened = self.one(Opcode.OPEN_READ, path)
        assert opened.op == ACK, opened.error
        data = b""
        while len(data) < opened.number:
            for reply in self.ask(Opcode.BURST, offset=len(data), seconds=1.0):
                assert reply.offset == len(data)
                data += reply.data if reply.op == ACK else b""
        self.ask(Opcode.TERMINATE)
        return data

    def _heard(self, out: list[tuple[str, dict[str, Any]]]) -> list[Reply]:
        frames = b"".join(self._down.encode(name, **fields) for name, fields in out)
        return [Reply(message) for message in self._down_rx.receive(frames)]


@pytest.fixture
def ground() -> Ground:
    return Ground()


# what a PX4 answered


def recorded() -> list[dict[str, Any]]:
    with CASES.open(encoding="utf-8") as lines:
        cases = [json.loads(line) for line in lines]
    return [case for case in cases if case["family"] == "ftp"]


def request_bytes(payload: dict[str, Any]) -> bytes:
    text = payload.get("data", "")
    data = bytes.fromhex(text[4:]) if text.startswith("hex:") else text.encode("latin1")
    how = {key: payload[key] for key in ("seq", "session", "offset", "size") if key in payload}
    return pack(payload["opcode"], data, **how)


def as_recorded(reply: Reply) -> dict[str, Any]:
    known = {
        "seq": reply.seq,
        "session": reply.session,
        "opcode": reply.op,
        "size": reply.size,
        "req_opcode": reply.request,
        "burst_complete": reply.complete,
        "offset": reply.offset,
    }
    if reply.op == NAK:
        return {**known, "error": reply.data[0], "errno": reply.data[1] if reply.size > 1 else None}
    if reply.request in (4, 6, 11, 14) and reply.size == 4:
        return {**known, "data_u32": reply.number}
    printable = all(32 <= byte < 127 or byte in (0, 9, 10) for byte in reply.data)
    return {**known, "data": reply.data.decode("latin1") if printable else f"hex:{reply.data.hex()}"}


def replay(grounds: dict[str, Ground], case: dict[str, Any]) -> Iterator[tuple[int, Reply]]:
    """Every answer with its step; set-up and tear-down are played and not told."""
    for part in ("setup", "steps", "teardown"):
        for index, step in enumerate(case.get(part, [])):
            who = step.get("link", case.get("link", "gcs"))
            link = API if who == "api" else GCS
            answers: list[Reply] = []
            for message in step.get("send", []):
                fields = message["fields"]
                target = fields["target_system"], fields["target_component"]
                answers += grounds[who].send(request_bytes(fields["payload"]), link, *target)
            answers += grounds[who].wait(step["wait"], link)
            if part == "steps":
                yield from ((index, answer) for answer in answers)


def test_every_recorded_case_is_answered_as_a_px4_answered_it() -> None:
    files = tree()
    grounds = {"gcs": Ground(files, 255), "api": Ground(files, 245)}
    grounds["api"].server = grounds["gcs"].server
    different: dict[str, list[Any]] = {}
    cases = recorded()
    for case in cases:
        got = list(replay(grounds, case))
        if case.get("informative"):
            continue
        wanted = [answer for answer in case["answers"] for _ in range(answer.get("count", 1))]
        for index in range(max(len(got), len(wanted))):
            pair = [got[index : index + 1], wanted[index : index + 1]]
            if not pair[0] or not pair[1]:
                different.setdefault(case["id"], []).append(pair)
                continue
            (step, reply), answer = got[index], wanted[index]
            left, right = as_recorded(reply), dict(answer["fields"]["payload"])
            loose = {key.partition(".")[2] for key in answer["vary"]}
            if case["id"] == "ftp-open-slash":
                loose.add("data_u32")  # the size of the file: ours describes fewer parameters
            for key in loose:
                left.pop(key, None), right.pop(key, None)
            target = reply.message.target_system, reply.message.target_component
            if (step, left, *target) != (answer["step"], right, answer["fields"]["target_system"], 190):
                different.setdefault(case["id"], []).append((left, right))
    assert len(cases) >= 30
    assert set(different) == set(DEVIATIONS), different


# one session


def test_one_session_on_each_link(ground: Ground) -> None:
    path = b"etc/extras/parameters.json.xz"
    assert ground.one(Opcode.OPEN_READ, path).op == ACK
    assert ground.one(Opcode.OPEN_READ, path).error == FtpError.NO_SESSION
    assert [reply.op for reply in ground.send(pack(Opcode.OPEN_READ, path, seq=9), API)] == [ACK]
    assert ground.one(Opcode.TERMINATE).op == ACK
    assert ground.one(Opcode.READ, size=10).error == FtpError.BAD_SESSION
    (still,) = ground.send(pack(Opcode.READ, seq=40, size=6), API)
    assert still.data == b"\xfd7zXZ\0"


def test_a_session_has_the_number_its_client_gave_it(ground: Ground) -> None:
    assert ground.one(Opcode.OPEN_READ, b"etc/extras/parameters.json.xz", session=241).session == 241
    assert ground.one(Opcode.READ, size=9).error == FtpError.BAD_SESSION
    assert ground.one(Opcode.READ, size=9, session=241).op == ACK
    assert {reply.session for reply in ground.ask(Opcode.BURST, session=241, seconds=0.1)} == {241}
    assert ground.one(Opcode.TERMINATE, session=241).op == ACK


def test_a_session_ends_after_ten_idle_seconds_or_with_its_link(ground: Ground) -> None:
    path = b"etc/extras/parameters.json.xz"
    ground.ask(Opcode.OPEN_READ, path)
    ground.wait(IDLE_US / 1e6 - 0.1)
    assert ground.one(Opcode.READ, size=1).op == ACK
    ground.wait(IDLE_US / 1e6 + 0.1)
    assert ground.one(Opcode.READ, size=1).error == FtpError.BAD_SESSION
    ground.ask(Opcode.OPEN_READ, path)
    ground.server.forget(GCS)
    assert ground.one(Opcode.READ, size=1).error == FtpError.BAD_SESSION


def test_requests_for_others_are_silence(ground: Ground) -> None:
    payload = pack(Opcode.RESET)
    assert ground.send(payload, system=2) == []
    assert ground.send(payload, component=77) == []
    assert len(ground.send(payload, system=0, component=0)) == 1


def test_a_lost_reply_is_given_again_and_nothing_done_twice(ground: Ground) -> None:
    first = ground.one(Opcode.CREATE, b"a.txt", seq=500)
    again = ground.one(Opcode.CREATE, b"a.txt", seq=500)
    assert (first.op, first.seq) == (ACK, 501)
    assert again.message.payload == first.message.payload
    other = Ground(ground.server.files, sysid=254)
    other.server = ground.server
    assert other.one(Opcode.CREATE, b"a.txt", seq=500).error == FtpError.NO_SESSION  # another peer's is its own


def test_whatever_its_opcode_but_not_the_end_of_a_session_behind_a_burst(ground: Ground) -> None:
    opened = ground.one(Opcode.OPEN_READ, b"etc/extras/component_general.json.xz", seq=10)
    assert ground.one(Opcode.TERMINATE, seq=10).message.payload == opened.message.payload
    data, end = ground.ask(Opcode.BURST, seq=20, seconds=0.1)
    assert (data.seq, end.seq, end.error) == (21, 22, FtpError.END_OF_FILE)
    assert ground.one(Opcode.READ, seq=21, size=1).message.payload == end.message.payload
    assert ground.one(Opcode.TERMINATE, seq=21).op == ACK  # as MAVProxy counts
    assert ground.one(Opcode.OPEN_READ, b"etc/extras/component_general.json.xz", seq=30).op == ACK


def test_the_sequence_number_wraps(ground: Ground) -> None:
    assert ground.one(Opcode.OPEN_READ, b"etc/extras/parameters.json.xz", seq=65535).seq == 0
    assert ground.one(Opcode.OPEN_READ, b"etc/extras/parameters.json.xz", seq=65535).op == ACK  # a repeat
    burst = ground.ask(Opcode.BURST, seq=65530, seconds=0.1)
    assert [reply.seq for reply in burst] == [(65531 + index) & 0xFFFF for index in range(len(burst))]
    assert burst[-1].error == FtpError.END_OF_FILE


# reading


def test_a_burst_is_paced_and_ends_at_35_kb(tmp_path: Path) -> None:
    content = random.Random(1).randbytes(100_000)
    (tmp_path / "a.ulg").write_bytes(content)
    ground = Ground(tree(tmp_path))
    assert ground.one(Opcode.OPEN_READ, b"/fs/microsd/log/a.ulg").number == len(content)
    ground.ask(Opcode.BURST)
    got: list[Reply] = []
    while not got or not got[-1].complete:
        some = ground.wait(0.0)
        assert len(some) <= BURST_PACKETS
        assert ground._heard(ground.server.poll(GCS, ground.now_us - TICK_US)) == []  # at the same time again
        got += some
    data = b"".join(reply.data for reply in got)
    assert data == content[: len(data)]
    assert BURST_BYTES < len(data) <= BURST_BYTES + 239
    assert ground.wait(0.1) == []
    ground.ask(Opcode.TERMINATE)
    assert ground.read_all(b"log/a.ulg") == content


def test_a_burst_ends_when_its_session_does(ground: Ground) -> None:
    ground.ask(Opcode.OPEN_READ, b"etc/extras/parameters.json.xz")
    ground.ask(Opcode.BURST)
    ground.wait(0.0)
    assert ground.one(Opcode.TERMINATE).op == ACK
    assert ground.wait(0.1) == []


def test_a_burst_of_what_cannot_be_read(ground: Ground) -> None:
    ground.ask(Opcode.OPEN_READ, b"etc")
    assert [(reply.op, reply.data) for reply in ground.ask(Opcode.BURST, seconds=0.1)] == [(NAK, b"\x02\x15")]


@pytest.mark.parametrize("offset", [500, 501, 2**31, 2**32 - 1])
def test_beyond_the_end_there_is_nothing(ground: Ground, offset: int) -> None:
    ground.server.files.add("a.txt", TEXT)
    ground.ask(Opcode.OPEN_READ, b"a.txt")
    assert ground.one(Opcode.READ, offset=offset, size=239).error == FtpError.END_OF_FILE
    (end,) = ground.ask(Opcode.BURST, offset=offset, seconds=0.1)
    assert (end.error, end.offset) == (FtpError.END_OF_FILE, offset)
    assert ground.one(Opcode.LIST, b"/", offset=offset).error == FtpError.END_OF_FILE


def test_a_log_that_shrinks_and_one_that_grows_while_it_is_read(tmp_path: Path) -> None:
    log = tmp_path / "a.ulg"
    log.write_bytes(bytes(2000))
    ground = Ground(tree(tmp_path))
    ground.ask(Opcode.OPEN_READ, b"log/a.ulg")
    log.write_bytes(b"x" * 10)
    replies = ground.ask(Opcode.BURST, seconds=0.1)
    assert [reply.op for reply in replies] == [ACK, NAK]
    assert replies[0].data == b"x" * 10
    log.write_bytes(b"y" * 5000)
    assert ground.one(Opcode.READ, offset=1990, size=239).data == b"y" * 239
    assert ground.one(Opcode.READ, offset=2000, size=239).error == FtpError.END_OF_FILE


def test_the_checksum_of_a_large_file_is_taken_piece_by_piece(tmp_path: Path) -> None:
    content = random.Random(2).randbytes(3_500_000)
    (tmp_path / "a.ulg").write_bytes(content)
    ground = Ground(tree(tmp_path))
    assert ground.ask(Opcode.CRC, b"log/a.ulg", seq=7) == []
    assert ground.ask(Opcode.CRC, b"log/a.ulg", seq=7) == []  # asked again meanwhile
    (reply,) = ground.wait(0.1)
    assert (reply.seq, reply.number) == (8, zlib.crc32(content, 0xFFFFFFFF) ^ 0xFFFFFFFF)
    assert ground.one(Opcode.CRC, b"log/a.ulg", seq=7).number == reply.number
    ground.ask(Opcode.CRC, b"log/a.ulg")
    assert ground.one(Opcode.NONE).op == ACK  # gives it up
    assert ground.wait(0.1) == []


# listing


def listing(ground: Ground, path: bytes) -> list[str]:
    """All entries, asked for until the end."""
    found: list[str] = []
    while True:
        reply = ground.one(Opcode.LIST, path, offset=len(found))
        if reply.op == NAK:
            assert reply.error == FtpError.END_OF_FILE
            return found
        assert reply.size <= 239
        assert reply.data.endswith(b"\0")
        found += reply.data.decode(errors="replace").split("\0")[:-1]


def test_a_long_listing_goes_over_several_messages(tmp_path: Path) -> None:
    ground = Ground(tree(tmp_path))
    assert listing(ground, b"log") == ["S", "S"]
    for index in range(40):
        (tmp_path / f"flight_{index:02}.ulg").write_bytes(bytes(index))
    wanted = [f"Fflight_{index:02}.ulg\t{index}" for index in range(40)]
    assert listing(ground, b"/log/") == ["S", "S", *wanted]
    assert listing(ground, b"fs/microsd/log") == ["S", "S", *wanted]
    assert listing(ground, b"/") == ["S", "S", "Detc", "Dfs", "Dlog"]
    assert [entry.partition("\t")[0] for entry in listing(ground, b"etc/extras")[2:]] == [
        "Fcomponent_general.json.xz",
        "Fparameters.json.xz",
    ]


def test_names_that_cannot_be_listed_are_only_counted(tmp_path: Path) -> None:
    (tmp_path / ("n" * 240)).touch()
    (tmp_path / "a\tb").touch()
    (tmp_path / "link").symlink_to("/etc/passwd")
    (tmp_path / "ü.ulg").touch()
    ground = Ground(tree(tmp_path))
    assert sorted(listing(ground, b"log")) == ["Fü.ulg\t0", "S", "S", "S", "S", "S"]


# refusing


@pytest.mark.parametrize("op", [3, 4, 6, 8, 9, 10, 11, 12, 13, 14])
def test_the_way_out_is_protected(op: int, ground: Ground) -> None:
    for path in (b"..", b"../a", b"etc/../../a", b"log/.."):
        data = path + b"\0" + path if op == Opcode.RENAME else path
        assert ground.one(op, data).error == FtpError.PROTECTED
    assert ground.server.refused == 4


@pytest.mark.parametrize("op", [6, 8, 11, 12])
def test_what_is_not_a_clients_cannot_be_changed(op: int, tmp_path: Path) -> None:
    (tmp_path / "a.ulg").write_bytes(b"abc")
    ground = Ground(tree(tmp_path))
    for path in (b"etc/extras/parameters.json.xz", b"log/a.ulg", b"@PARAM/param.pck"):
        wanted = (
            FtpError.NOT_FOUND if path.startswith(b"@") and op in (8, 12) else FtpError.PROTECTED
        )  # its folder is not there
        assert ground.one(op, path).error == wanted
    assert (tmp_path / "a.ulg").read_bytes() == b"abc"


def test_unknown_and_oversized_requests_are_counted(ground: Ground) -> None:
    for op in (16, 64, 127, 128, 129, 255):
        assert ground.one(op).error == FtpError.UNKNOWN_COMMAND
    assert ground.one(Opcode.NONE, size=240).error == FtpError.BAD_SIZE
    assert ground.server.refused == 7


def test_a_failure_without_errno_of_its_own_gives_the_one_remembered(ground: Ground) -> None:
    assert ground.one(Opcode.CRC, b"nothing").error == FtpError.NOT_FOUND
    ground.ask(Opcode.CRC, b"etc")  # EISDIR
    assert ground.one(Opcode.CRC, b"nothing").data == b"\x02\x15"
    assert ground.one(Opcode.TRUNCATE, b"nothing").data == b"\x02\x15"
    assert ground.one(Opcode.RENAME, b"nothing").data == b"\x02\x15"
    listing(ground, b"/")
    assert ground.one(Opcode.RENAME, b"nothing").data == b"\x02\x16"


# writing


def test_a_file_of_a_clients_own(ground: Ground) -> None:
    assert ground.one(Opcode.MAKE_FOLDER, b"d").op == ACK
    assert ground.one(Opcode.CREATE, b"d/a.txt").number == 0
    assert ground.one(Opcode.WRITE, TEXT[:239]).number == 239
    assert ground.one(Opcode.WRITE, TEXT[239:478], offset=239).number == 239
    assert ground.one(Opcode.WRITE, TEXT[478:], offset=478).number == 22
    assert ground.one(Opcode.READ, size=9).data == b"\x06"  # its size was 0 when it was opened
    ground.ask(Opcode.TERMINATE)
    assert ground.read_all(b"d/a.txt") == TEXT
    assert ground.one(Opcode.CRC, b"d/a.txt").number == TEXT_CRC
    assert ground.one(Opcode.TRUNCATE, b"d/a.txt", offset=3).op == ACK
    assert ground.one(Opcode.OPEN_WRITE, b"d/a.txt").number == 3
    assert ground.one(Opcode.READ, size=9).data == b"\x02\x09"
    ground.ask(Opcode.WRITE, b"B", offset=1)
    ground.ask(Opcode.RESET)
    assert ground.read_all(b"d/a.txt") == b"ABA"
    assert ground.one(Opcode.RENAME, b"d/a.txt\0bb").op == ACK
    assert ground.one(Opcode.REMOVE_FOLDER, b"d").op == ACK
    assert ground.one(Opcode.REMOVE, b"bb").op == ACK
    assert ground.one(Opcode.OPEN_READ, b"bb").error == FtpError.NOT_FOUND


def test_giant_files_are_refused_without_being_made(ground: Ground) -> None:
    ground.ask(Opcode.CREATE, b"a")
    assert ground.one(Opcode.WRITE, b"x", offset=2**32 - 1).data == b"\x02\x1b"  # EFBIG
    assert ground.one(Opcode.TRUNCATE, b"a", offset=2**32 - 1).data == b"\x02\x1b"
    assert ground.server.files.quota.used_bytes == 0


# any wire, any request


class Wire:
    """A client that downloads over a wire that loses, doubles and delays in both directions."""

    def __init__(self, files: FileTree, seed: int, loss: float) -> None:
        self.ground = Ground(files)
        self.ground.seq = 65_000
        self.random = random.Random(seed)
        self.loss = loss
        self.up: list[tuple[int, bytes]] = []
        self.down: list[tuple[int, Reply]] = []

    def put(self, queue: list[Any], thing: Any) -> None:
        for _ in range(2 if self.random.random() < 0.05 else 1):
            if self.random.random() >= self.loss:
                queue.append((self.ground.now_us + self.random.choice((0, 0, 4_000, 12_000)), thing))

    def tick(self) -> list[Reply]:
        now_us = self.ground.now_us
        due = [payload for at_us, payload in self.up if at_us <= now_us]
        self.up = [item for item in self.up if item[0] > now_us]
        for payload in due:
            for reply in self.ground.send(payload):
                self.put(self.down, reply)
        for reply in self.ground.wait(0.0):
            self.put(self.down, reply)
        arrived = [reply for at_us, reply in self.down if at_us <= now_us]
        self.down = [item for item in self.down if item[0] > now_us]
        return arrived

    def ask(self, op: int, data: bytes = b"", **how: Any) -> Reply:
        """Ask until the answer comes: the same request with the same number."""
        self.ground.seq = seq = self.ground.seq + 1000 & 0xFFFF
        for _ in range(200):
            self.put(self.up, pack(op, data, seq=seq, **how))
            for _ in range(10):
                for reply in self.tick():
                    if (reply.seq, reply.request) == (seq + 1 & 0xFFFF, op):
                        return reply
        raise AssertionError("no answer")

    def download(self, path: bytes) -> bytes:
        self.ask(Opcode.RESET)
        size = self.ask(Opcode.OPEN_READ, path).number
        blocks: dict[int, bytes] = {}
        self.ground.seq = seq = self.ground.seq + 1000 & 0xFFFF
        self.put(self.up, pack(Opcode.BURST, seq=seq))
        quiet = 0
        while quiet < 25:
            replies = self.tick()
            quiet = 0 if replies else quiet + 1
            blocks.update((reply.offset, reply.data) for reply in replies if (reply.op, reply.request) == (ACK, 15))
        for offset in range(0, size, 239):
            while offset not in blocks:
                reply = self.ask(Opcode.READ, offset=offset, size=239)
                if reply.error == FtpError.BAD_SESSION:  # a delayed reset closed it
                    self.ask(Opcode.OPEN_READ, path)
                elif reply.op == ACK:
                    blocks[offset] = reply.data
        crc = self.ask(Opcode.CRC, path).number
        data = b"".join(blocks[offset] for offset in sorted(blocks))
        assert zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF == crc
        return data


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    size=st.sampled_from([0, 1, 239, 240, 478, 5_000, 40_000]),
    loss=st.sampled_from([0.0, 0.1, 0.3]),
)
def test_a_download_over_a_bad_wire_is_whole(seed: int, size: int, loss: float) -> None:
    content = random.Random(seed).randbytes(size)
    files = tree()
    files.add("a.bin", content)
    assert Wire(files, seed, loss).download(b"a.bin") == content


MANY_PATHS = (
    *(b"", b"/", b"\0", b"etc", b"etc/extras", b"etc/extras/parameters.json.xz", b"@PARAM", b"@PARAM/param.pck"),
    *(b"log", b"log/a.ulg", b"log/out", b"log/out/secret", b"log/loop", b"log/abs/passwd", "log/ü".encode()),
    *(b"a", b"b", b"a/b", b"a\0bb", b"b\0a/b", b"a/b\0log/c", b"a/b\0etc/c", b"../secret", b"\xff\xfe"),
    *(b"x" * 239, b"a/" * 119),
)
PATHS = st.one_of(
    st.sampled_from(MANY_PATHS),
    st.binary(max_size=239),
)
REQUESTS = st.lists(
    st.builds(
        pack,
        st.one_of(st.integers(0, 16), st.integers(0, 255)),
        PATHS,
        seq=st.one_of(st.integers(0, 5), st.integers(0, 65535)),
        session=st.one_of(st.just(0), st.integers(0, 255)),
        offset=st.one_of(st.integers(0, 1000), st.integers(0, 2**32 - 1)),
        size=st.one_of(st.none(), st.integers(0, 255)),
    ),
    max_size=40,
)


@settings(max_examples=150, deadline=None)
@given(requests=REQUESTS)
def test_no_request_raises_leaves_the_tree_or_takes_memory(
    requests: list[bytes], tmp_path_factory: pytest.TempPathFactory
) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (outside / "secret").write_bytes(b"TOP SECRET" * 100)
    log = tmp_path_factory.mktemp("log")
    (log / "a.ulg").write_bytes(b"log" * 1000)
    (log / "out").symlink_to(outside)
    (log / "abs").symlink_to("/etc")
    (log / "loop").symlink_to("loop")
    before = sorted(log.iterdir()), sorted(outside.iterdir())
    ground = Ground(tree(log))
    for payload in requests:
        for reply in ground.send(payload) + ground.wait(0.0):
            assert reply.size <= 239
            assert reply.seq == (struct.unpack_from("<H", payload)[0] + 1) & 0xFFFF or reply.request == Opcode.BURST
            assert b"TOP SECRET" not in reply.data
    quota = ground.server.files.quota
    assert 0 <= quota.used_bytes <= quota.total_bytes
    assert 0 <= quota.used_entries <= quota.entries
    assert (sorted(log.iterdir()), sorted(outside.iterdir())) == before
    assert (log / "a.ulg").read_bytes() == b"log" * 1000
