"""The services on their own under storms: bounded answers, bounded memory, nothing beyond their walls."""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1]))

from hostile import Forge, captures
from hostile_vehicle import Watched, weight

from bridge.connection import Connection, Message
from bridge.events import EventServer
from bridge.ftp import FtpServer
from bridge.ftp_files import FileTree
from bridge.link import Link
from bridge.log_transfer import LogServer
from bridge.messages import BY_NAME
from bridge.mission_protocol import MissionServer
from bridge.param_protocol import ParamServer
from bridge.plan_store import MOST_ITEMS, PlanKind, PlanStore
from bridge.services import VehicleFiles
from bridge.signing_setup import SigningSetup
from bridge.udp_link import UdpLink
from sitl.modes import Severity
from sitl.parameters import ParameterTable

TARGET = {"target_system": 1, "target_component": 1}
TICK_US = 4_000
MOST_AT_ONCE = 64
SECRET = b"a secret that lies beside what is served"


def parse(frame: bytes) -> list[Message]:
    return Connection(1, 1, datagram=True).receive(frame)


def storm(service: Any, forge: Forge, *, messages: int = 3000, most: int = MOST_AT_ONCE) -> int:
    """Messages the service takes, one in three of them recorded; every answer must be one that can be sent.

    Returns:
        how many answers came.
    """
    encode = Connection(1, 1).encode_fields
    names = list(service.HANDLES)
    known = [one for one in captures() if one[0] in names]
    rng = forge.rng
    now_us = answers = 0
    for _ in range(messages):
        if known and rng.random() < 0.3:
            frame = Connection(255, 190).encode_fields(*rng.choice(known))
        else:
            frame = forge.frame(BY_NAME[rng.choice(names)])
        link_id = rng.randrange(3)
        out = []
        for msg in parse(frame):
            out += service.handle(msg, link_id, now_us)
        assert len(out) <= most, out[0]
        if rng.random() < 0.3:
            now_us += TICK_US * rng.choice((1, 1, 1, 10, 300))
            for link in range(3):
                due = service.poll(link, now_us)
                assert len(due) <= most, due[0]
                out += due
        if rng.random() < 0.01:
            service.forget(rng.randrange(3))
        for name, fields in out:
            encode(name, fields)
        answers += len(out)
    return answers


def grows(service: Any, forge: Forge, **how: Any) -> int:
    """Bytes that a storm leaves behind when an equal one came before."""
    storm(service, forge, **how)
    before = weight(service)
    storm(service, forge, **how)
    return weight(service) - before


def test_parameters() -> None:
    service = ParamServer(ParameterTable())
    assert grows(service, Forge(1)) < 20_000
    assert service.refused > 100


def test_missions() -> None:
    store = PlanStore()
    service = MissionServer(store, say=lambda *_: None)
    storm(service, Forge(2))
    assert service.refused > 100
    for kind in PlanKind:
        assert len(store.plan(kind).items) <= MOST_ITEMS[kind]
    assert grows(service, Forge(3)) < 50_000


MISSION_NAMES = (
    "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ITEM_INT", "MISSION_ITEM_INT", "MISSION_ITEM", "MISSION_REQUEST_INT",
    "MISSION_REQUEST_LIST", "MISSION_ACK", "MISSION_CLEAR_ALL", "MISSION_SET_CURRENT",
)  # fmt: skip


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(MISSION_NAMES), st.integers(0, 4), st.sampled_from((0, 1, 3, 15)), st.integers(0, 1)),
        max_size=40,
    ),
    st.integers(0, 2),
)
def test_no_order_of_mission_messages_leaves_half_a_plan(steps: list[tuple[str, int, int, int]], kind: int) -> None:
    """A plan changes only with a message that is acknowledged, and then has as many items as were announced."""
    store = PlanStore()
    service = MissionServer(store, say=lambda *_: None)
    announced = {0: 0, 1: 0}
    before = store.plan(kind)
    for name, number, result, link_id in steps:
        asked: dict[str, Any] = {"seq": number, "count": number, "mission_type": kind, "command": 16, "frame": 3}
        asked |= {**TARGET, "type": result}
        known = {field.name for field in BY_NAME[name].fields}
        frame = Connection(255, 190).encode_fields(name, {key: asked[key] for key in asked if key in known})
        out = [answer for msg in parse(frame) for answer in service.handle(msg, link_id, 0)]
        if name == "MISSION_COUNT" and any(answer.startswith("MISSION_REQUEST") for answer, _ in out):
            announced[link_id] = number
        if store.plan(kind) is not before:
            before = store.plan(kind)
            assert [(answer, fields["type"]) for answer, fields in out] == [("MISSION_ACK", 0)]
            assert len(before.items) == (announced[link_id] if name.startswith("MISSION_ITEM") else 0)


def test_a_plan_of_the_most_items_is_all_that_is_kept() -> None:
    """A MISSION_COUNT of 65535 asks for nothing, and one that is never finished is given up."""
    store = PlanStore()
    service = MissionServer(store, say=lambda *_: None)
    encode = Connection(255, 190).encode
    (refusal,) = service.handle(parse(encode("MISSION_COUNT", count=65535, **TARGET))[0], 0, 0)
    assert refusal[0] == "MISSION_ACK"
    assert refusal[1]["type"] == 4
    before = weight(service)
    now_us = 0
    for attempt in range(20):
        link_id = attempt % 3
        service.handle(parse(encode("MISSION_COUNT", count=10_000, **TARGET))[0], link_id, now_us)
        for seq in range(100):
            item = encode("MISSION_ITEM_INT", seq=seq, command=16, frame=6, z=10.0, **TARGET)
            service.handle(parse(item)[0], link_id, now_us)
        for _ in range(4):
            now_us += 2_000_000
            service.poll(link_id, now_us)
    assert store.mission.items == ()
    assert weight(service) - before < 20_000


def test_events_answer_with_a_few_at_a_time() -> None:
    service = EventServer(system_id=1, component_id=1)
    for _ in range(300):
        service.report(Severity.CRITICAL, "Mission start denied! No valid mission", 0)
    assert grows(service, Forge(3)) < 20_000


@pytest.fixture
def tree(tmp_path: Path) -> FileTree:
    """A mounted folder with a flight in it, a secret beside it, and a link that leads there."""
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "flight.ulg").write_bytes(bytes(range(256)) * 40)
    (tmp_path / "secret").write_bytes(SECRET)
    (logs / "link").symlink_to(tmp_path / "secret")
    (logs / "out").symlink_to(tmp_path)
    files = FileTree()
    files.add("etc/extras/component_general.json.xz", bytes(1000))
    files.add("@PARAM/param.pck", bytes(5000), listed=False)
    files.mount("log", logs)
    return files


def test_files_stay_within_their_walls_and_their_quota(tree: FileTree, tmp_path: Path) -> None:
    service = FtpServer(tree)
    forge = Forge(4)
    before = sorted(tmp_path.rglob("*"))
    storm(service, forge, messages=6000)
    assert service.refused > 100
    assert tree.quota.used_bytes <= tree.quota.total_bytes
    assert tree.quota.used_entries <= tree.quota.entries
    assert weight(service) < tree.quota.total_bytes + 2_000_000
    assert sorted(tmp_path.rglob("*")) == before


PARTS = (
    "..",
    ".",
    "",
    "log",
    "out",
    "link",
    "secret",
    "flight.ulg",
    "a",
    "\\",
    "%2e%2e",
    "~",
    "\x01",
    "..\0",
    "...",
    "é",
)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from((3, 4, 4, 4, 5, 6, 7, 8, 10, 11, 12, 13, 14, 15)),
            st.lists(st.sampled_from(PARTS), max_size=5).map("/".join),
            st.sampled_from((0, 10, 0xFFFFFFFF)),
        ),
        max_size=12,
    )
)
def test_no_path_leads_out(tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[int, str, int]]) -> None:
    root = tmp_path_factory.getbasetemp() / "ftp"
    if not root.exists():
        (root / "logs").mkdir(parents=True)
        (root / "logs" / "flight.ulg").write_bytes(bytes(500))
        (root / "secret").write_bytes(SECRET)
        (root / "logs" / "link").symlink_to(root / "secret")
        (root / "logs" / "out").symlink_to(root)
    files = FileTree()
    files.mount("log", root / "logs")
    service = FtpServer(files)
    for number, (opcode, path, offset) in enumerate(steps):
        data = path.encode()[:239]
        header = (
            (number * 2).to_bytes(2, "little") + bytes([0, opcode, len(data), 0, 0, 0]) + offset.to_bytes(4, "little")
        )
        frame = Connection(255, 190).encode("FILE_TRANSFER_PROTOCOL", payload=header + data, **TARGET)
        out = [answer for msg in parse(frame) for answer in service.handle(msg, 0, 0)]
        out += service.poll(0, TICK_US)
        for name, fields in out:
            assert SECRET[:10] not in Connection(1, 1).encode_fields(name, fields)
    service.forget(0)
    assert (root / "secret").read_bytes() == SECRET
    assert (root / "logs" / "flight.ulg").read_bytes() == bytes(500)


def test_logs_keep_no_more_files_open_than_there_are_links(tmp_path: Path) -> None:
    for number in range(5):
        folder = tmp_path / "2026-11-22"
        folder.mkdir(exist_ok=True)
        (folder / f"10_00_0{number}.ulg").write_bytes(bytes(1000 * (number + 1)))
    fds = Path("/proc/self/fd")
    before = len(list(fds.iterdir())) if fds.exists() else 0
    service = LogServer(tmp_path)
    forge = Forge(6, ["LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_REQUEST_END"])
    rng = forge.rng
    now_us = 0
    for _ in range(3000):
        ids = {"id": rng.randrange(6)} if rng.random() < 0.7 else {}
        kind = rng.choice(forge.kinds)
        frame = forge.frame(kind, whole=True, target_system=1, **(ids if kind.name == "LOG_REQUEST_DATA" else {}))
        for msg in parse(frame):
            assert service.handle(msg, rng.randrange(3), now_us) == []
        now_us += TICK_US
        for link in range(3):
            assert len(service.poll(link, now_us)) <= 20
    assert service.refused > 100
    if fds.exists():
        assert len(list(fds.iterdir())) <= before + 3
    for link in range(3):
        service.forget(link)


def test_keys_of_strangers_are_not_taken() -> None:
    """With a key in force, no SETUP_SIGNING that it did not sign changes anything."""
    connections = {0: Connection(1, 1, datagram=True)}
    said: list[str] = []
    service = SigningSetup(
        connections, mode=lambda: 2, armed=lambda: False, say=lambda severity, text: said.append(text)
    )
    setup = Connection(255, 190).encode("SETUP_SIGNING", secret_key=bytes(range(32)), initial_timestamp=5, **TARGET)
    service.handle(parse(setup)[0], 0, 0)
    key = service.key.secret
    assert key == bytes(range(32))
    storm(service, Forge(9), messages=1500)
    assert service.key.secret == key
    assert service.refused > 200


@pytest.fixture
def flown(tmp_path: Path) -> Watched:
    """A vehicle that keeps everything that a vehicle can keep on disk."""
    files = VehicleFiles(logs=tmp_path / "logs", parameters=tmp_path / "own.params")
    return Watched(files=files).hover()


def test_a_vehicle_that_keeps_logs_under_a_storm(flown: Watched, tmp_path: Path) -> None:
    """Files, logs, plans and parameters of one vehicle at once, on both links; its disk holds what it may."""
    forge, rng = Forge(10), random.Random(10)
    names = ["FILE_TRANSFER_PROTOCOL", "LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "PARAM_REQUEST_LIST", "MISSION_COUNT",
             "MISSION_ITEM_INT", "REQUEST_EVENT", "MISSION_REQUEST_LIST", "LOG_ERASE"]  # fmt: skip
    known = [one for one in captures() if one[0] in names]

    def blow() -> int:
        for _ in range(1500):
            if rng.random() < 0.5:
                data = forge.frame(BY_NAME[rng.choice(names)], whole=True, **TARGET)
            else:
                data = Connection(255, 190).encode_fields(*rng.choice(known))
            flown.put(data, rng.randrange(2))
            flown.tick()
        return weight(flown.server)

    first = blow()
    scratch = 8 << 20
    assert blow() - first < scratch
    for link in (0, 1):
        assert flown.answers(link)
    assert flown.finite()
    flown.server.close()
    assert {path.suffix for path in tmp_path.rglob("*") if path.is_file()} <= {".ulg", ".params"}


def test_what_goes_out_while_everything_is_asked_for_is_paced() -> None:
    """The list of parameters, a burst of a file and telemetry together stay within what a link takes per tick."""
    watched = Watched()
    watched.run(2.0)
    size = 0
    for _ in range(250):
        watched.send("PARAM_REQUEST_LIST", **TARGET)
        watched.server.step()
        tick = 0
        while (data := watched.ends[0].recv()) is not None:
            tick += len(data)
        size = max(size, tick)
    assert size < 20_000


class Socket:
    """Says what a socket says of a datagram whose sender claims port 0: nobody can answer that."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def setblocking(self, flag: bool) -> None:
        pass

    def getsockname(self) -> tuple[str, int]:
        return ("127.0.0.1", 18570)

    def recvfrom(self, _: int) -> tuple[bytes, tuple[str, int]]:
        return b"x", ("127.0.0.1", 0)

    def sendto(self, data: bytes, peer: tuple[str, int]) -> int:
        if peer[1] == 0:
            raise OSError(22, "Invalid argument")
        self.sent.append(peer)
        return len(data)


def test_a_sender_without_a_port_is_no_peer() -> None:
    """Anybody can forge port 0 as the sender's; sending there fails, which must not end the vehicle's service."""
    sock = Socket()
    link: Link = UdpLink("udpout://127.0.0.1:14550?local=18570", sock, ("127.0.0.1", 14550), open_port=True)  # type: ignore[arg-type]
    link.recv()
    link.send(b"telemetry")
    assert sock.sent == [("127.0.0.1", 14550)]
