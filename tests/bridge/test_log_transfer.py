"""The log protocol: the recorded answers of a PX4, a client that loses packets, and peers that mean harm."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from bridge.connection import Connection
from bridge.log_store import create_log, find_logs
from bridge.log_transfer import PACED_BURST, PERIOD_US, WINDOW_BYTES, LogServer

CASES = Path(__file__).parents[1] / "data" / "px4_answers.jsonl"


class Peer:
    """A ground station and a log server, with the wire's encoding between them."""

    def __init__(self, directory, link=0, server=None, **options):
        self.server = server or LogServer(directory, **options)
        self.link = link
        self.now_us = 1_000_000
        self._ground = Connection(255, 190, datagram=True)
        self._vehicle = Connection(1, 1, datagram=True)

    def send(self, name, *, system=1, component=1, **fields):
        frame = self._ground.encode(name, target_system=system, target_component=component, **fields)
        for message in self._vehicle.receive(frame):
            assert self.server.handle(message, self.link, self.now_us) == []

    def hear(self, seconds=0.6):
        """Everything that comes in so long, as it is on the wire."""
        heard = []
        for _ in range(round(seconds * 250)):
            self.now_us += PERIOD_US
            out = self.server.poll(self.link, self.now_us)
            assert len(out) <= 20
            for name, fields in out:
                heard += self._ground.receive(self._vehicle.encode(name, **fields))
        return heard

    def list(self, start=0, end=0xFFFF, **options):
        self.send("LOG_REQUEST_LIST", start=start, end=end, **options)
        return self.hear(0.1)

    def data(self, number, offset, count, seconds=0.6):
        self.send("LOG_REQUEST_DATA", id=number, ofs=offset, count=count)
        return self.hear(seconds)


def write_log(directory, content, session="sess001"):
    path, file = create_log(directory, session, 0)
    os.write(file, content)
    os.close(file)
    return path


@pytest.fixture
def content():
    return random.Random(1).randbytes(1000)


@pytest.fixture
def peer(tmp_path, content):
    write_log(tmp_path, content)
    write_log(tmp_path, b"second")
    return Peer(tmp_path)


def recorded():
    with CASES.open() as lines:
        cases = [json.loads(line) for line in lines]
    return [case for case in cases if case["family"] == "log"]


@pytest.mark.parametrize("case", recorded(), ids=lambda case: case["id"])
def test_answers_as_the_recorded_px4(case, tmp_path):
    """That PX4 logs from boot on (SDLOG_MODE 1): there is always one log before an erasure."""
    write_log(tmp_path, random.Random(2).randbytes(1_000_000))
    peer = Peer(tmp_path)
    answers = case["answers"]
    for number, step in enumerate(case["steps"]):
        for sent in step["send"]:
            fields = dict(sent["fields"])
            system, component = fields.pop("target_system"), fields.pop("target_component")
            peer.send(sent["name"], system=system, component=component, **fields)
        heard = peer.hear(step["wait"])
        wanted = [one for one in answers if one["step"] == number]
        assert [one.name for one in heard] == [one["name"] for one in wanted]
        for got, want in zip(heard, wanted, strict=True):
            for key, value in want["fields"].items():
                if key not in [*want.get("vary", ()), *want.get("build", ())]:
                    assert got[key] == value, key
                if got.name == "LOG_ENTRY" and key in ("num_logs", "last_log_num"):
                    assert got[key] == value


def test_nothing_was_logged_yet(tmp_path):
    peer = Peer(tmp_path / "none")
    assert peer.list() == []
    assert peer.data(0, 0, 90) == []
    peer.send("LOG_ERASE")
    assert peer.hear() == []


def test_the_list(peer, content):
    first, second = peer.list()
    assert (first["id"], first.size, first.num_logs, first.last_log_num) == (0, len(content), 2, 2)
    assert (second["id"], second.size) == (1, 6)
    assert [entry["id"] for entry in peer.list(1, 1)] == [1]
    assert peer.list(1, 1)[0].last_log_num == 1
    assert peer.list(1, 0) == []


def test_data_comes_whole_packets_at_a_time(peer, content):
    peer.list()
    packets = peer.data(0, 10, 100)
    assert [(one.ofs, one.count) for one in packets] == [(10, 90), (100, 90)]
    assert b"".join(one.data for one in packets) == content[10:190]
    (last,) = peer.data(0, 950, 5000)
    assert (last.count, last.data[:50], last.data[50:]) == (50, content[950:], bytes(40))
    assert [one.count for one in peer.data(0, 0, 0)] == [90], "as PX4: even nothing is one packet"


def test_data_needs_a_list_and_a_log_that_is_there(peer):
    assert peer.data(0, 0, 90) == []
    peer.list()
    assert peer.data(2, 0, 90) == []
    assert [(one.ofs, one.count) for one in peer.data(0, 1000, 90)] == [(1000, 0)]  # the end, and nothing more
    assert [(one.ofs, one.count) for one in peer.data(0, 1089, 90)] == [(1089, 0)]
    assert peer.data(0, 1090, 90) == []
    assert peer.data(0, 0xFFFFFFFF, 0xFFFFFFFF) == []
    assert peer.server.refused == 4


def test_a_new_request_replaces_the_old_one_and_end_stops(peer):
    peer.list()
    peer.send("LOG_REQUEST_DATA", id=0, ofs=0, count=1000)
    peer.send("LOG_REQUEST_DATA", id=1, ofs=0, count=1000)
    assert [one["id"] for one in peer.hear()] == [1]
    peer.send("LOG_REQUEST_DATA", id=0, ofs=0, count=1000)
    peer.send("LOG_REQUEST_END")
    assert peer.hear() == []
    peer.send("LOG_REQUEST_DATA", id=0, ofs=0, count=1000)
    peer.send("LOG_REQUEST_DATA", id=7, ofs=0, count=1000)
    assert peer.hear() == [], "a request that makes no sense ends what was sent, as in PX4"


def test_a_log_that_grows_is_served_up_to_its_listed_size(peer, tmp_path, content):
    peer.list()
    with find_logs(tmp_path)[0].path.open("ab") as file:
        file.write(bytes(500))
    assert sum(one.count for one in peer.data(0, 0, 0xFFFFFFFF)) == len(content)
    peer.now_us += 1_000_000
    assert peer.list()[0].size == len(content) + 500
    assert sum(one.count for one in peer.data(0, 0, 0xFFFFFFFF)) == len(content) + 500


def test_a_log_that_shrinks_or_goes_ends_quietly(peer, tmp_path):
    peer.list()
    path = find_logs(tmp_path)[0].path
    path.write_bytes(b"x" * 100)
    assert [one.count for one in peer.data(0, 0, 1000)] == [90, 10]
    path.unlink()
    peer.send("LOG_REQUEST_END")
    peer.now_us += 1_000_000
    peer.list()
    assert [one.count for one in peer.data(0, 0, 1000)] == [6]


def test_erase_spares_the_log_being_written_and_what_is_no_log(tmp_path):
    old, new = write_log(tmp_path, b"old"), write_log(tmp_path, b"new", "sess002")
    stranger = old.with_name("notes.txt")
    stranger.touch()
    peer = Peer(tmp_path, writing=lambda: Path(os.path.relpath(new)))
    peer.list()
    peer.send("LOG_REQUEST_DATA", id=0, ofs=0, count=90)
    peer.send("LOG_ERASE", component=77)
    assert old.exists()
    peer.send("LOG_ERASE")
    assert peer.hear() == []
    assert (old.exists(), new.exists(), stranger.exists()) == (False, True, True)
    assert peer.server.erased == 1
    assert [entry.size for entry in peer.list()] == [3]


def test_another_system_is_silence(peer):
    assert peer.list(system=2) == []
    peer.send("LOG_ERASE", system=2)
    assert len(peer.list(system=0, component=77)) == 2


def test_links_do_not_disturb_each_other(peer, content):
    other = Peer(None, link=1, server=peer.server)
    peer.list()
    assert other.data(0, 0, 90) == [], "a list is for the link that asked"
    other.list()
    peer.send("LOG_REQUEST_DATA", id=0, ofs=0, count=180)
    assert [one.size for one in other.list()] == [len(content), 6]
    assert len(peer.hear()) == 2
    peer.send("LOG_REQUEST_DATA", id=0, ofs=0, count=180)
    peer.server.forget(0)
    assert peer.hear() == []


def test_pacing(tmp_path):
    write_log(tmp_path, bytes(90 * 1000))
    peer = Peer(tmp_path)
    peer.list()
    peer.send("LOG_REQUEST_DATA", id=0, ofs=0, count=WINDOW_BYTES)
    assert len(peer.server.poll(0, peer.now_us + PERIOD_US)) == 20
    for _ in range(5):  # traffic may bring further polls in the same instant
        assert peer.server.poll(0, peer.now_us + PERIOD_US) == []
    peer.server.add_link(0, burst=3)
    peer.list()
    for count in (WINDOW_BYTES, 0xFFFFFFFF):
        peer.send("LOG_REQUEST_DATA", id=0, ofs=0, count=count)
        peer.now_us += PERIOD_US
        assert len(peer.server.poll(0, peer.now_us)) == 3


def test_a_whole_log_asked_for_at_once_comes_slowly_enough_to_be_read(tmp_path):
    content = random.Random(5).randbytes(90 * 1000 + 17)
    write_log(tmp_path, content)
    peer = Peer(tmp_path)
    peer.list()
    packets = peer.data(0, 0, 0xFFFFFFFF, seconds=0.4)
    assert len(packets) == 0.4e6 / PERIOD_US * PACED_BURST
    packets += peer.hear(2.0)
    assert b"".join(one.data[: one.count] for one in packets) == content
    assert len(peer.data(0, 0, WINDOW_BYTES, seconds=0.1)) == 500, "a window is waited for, and quick"


def test_lists_asked_for_without_end_do_not_read_the_disk_without_end(peer, monkeypatch):
    scans = []
    monkeypatch.setattr("bridge.log_transfer.find_logs", lambda directory: scans.append(directory) or [])
    for _ in range(1000):
        peer.send("LOG_REQUEST_LIST", start=0, end=0xFFFF)
        peer.now_us += 100
    assert len(scans) == 1


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.4])
def test_download_through_loss(tmp_path, loss):
    """A client that asks again for what is missing gets the file, bit for bit."""
    content = random.Random(3).randbytes(50_123)
    write_log(tmp_path, content)
    peer, chance = Peer(tmp_path), random.Random(4)
    (entry,) = peer.list()
    got: dict[int, bytes] = {}
    for _ in range(2000):
        missing = next((at for at in range(0, entry.size, 90) if at not in got), None)
        if missing is None:
            break
        until = next((at for at in range(missing, entry.size, 90) if at in got), entry.size)
        if chance.random() < loss:
            continue  # the request is lost as well
        for packet in peer.data(0, missing, until - missing, 0.2):
            if chance.random() >= loss:
                got[packet.ofs] = packet.data[: packet.count]
    assert b"".join(got[at] for at in sorted(got)) == content


REQUESTS = st.one_of(
    st.tuples(
        st.just("LOG_REQUEST_LIST"),
        st.fixed_dictionaries({"start": st.integers(0, 65535), "end": st.integers(0, 65535)}),
    ),
    st.tuples(
        st.just("LOG_REQUEST_DATA"),
        st.fixed_dictionaries(
            {
                "id": st.one_of(st.integers(0, 3), st.integers(0, 65535)),
                "ofs": st.one_of(st.integers(0, 2000), st.integers(0, 2**32 - 1)),
                "count": st.one_of(st.integers(0, 2000), st.integers(0, 2**32 - 1)),
            }
        ),
    ),
    st.tuples(st.just("LOG_REQUEST_END"), st.just({})),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.lists(st.tuples(REQUESTS, st.integers(0, 3), st.integers(0, 3), st.integers(0, 20_000)), max_size=30))
@example(
    [
        (("LOG_REQUEST_LIST", {"start": 0, "end": 0xFFFF}), 0, 3, 5_000),
        (("LOG_REQUEST_DATA", {"id": 0, "ofs": 1000, "count": 0}), 0, 1, 0),
    ]
)
def test_whatever_is_asked_the_answers_are_true_and_few(peer, content, requests):
    for (name, fields), link, polls, passed_us in requests:
        peer.link = link
        peer.send(name, **fields)
        for _ in range(polls):
            peer.now_us += passed_us
            out = peer.server.poll(link, peer.now_us)
            assert len(out) <= 20
            for kind, values in out:
                if kind == "LOG_DATA" and values["id"] == 0:
                    # just behind the end comes an empty packet
                    assert values.get("data", b"") == content[values["ofs"] : values["ofs"] + 90]
                    assert values["count"] == len(values.get("data", b""))
    assert len(peer.server._links) <= 4
