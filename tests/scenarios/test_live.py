"""A live view beside a flight: whatever becomes of it, the flight's files are the same."""

import contextlib
import ctypes.util
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.flight import Segment
from scenarios.one_flight import fly
from scenarios.recorder import live, live_message
from scenarios.recorder.flight_drawing import FlownVehicle
from scenarios.recorder.link_lines import LinkCounts
from scenarios.recorder.live_viewer import messages
from scenarios.recorder.viewer import free_port, started
from sitl.airframe import Rotor
from sitl.control_loop import CONTROL_SETTINGS
from sitl.errors import UsageError


@pytest.fixture
def port():
    number = free_port()
    yield number
    feed = live._feeds.pop(number, None)
    if feed is not None:
        feed.close()
        for sent in (signal.SIGKILL, signal.SIGCONT):
            with contextlib.suppress(ProcessLookupError):
                os.kill(feed.process.pid, sent)
        feed.process.wait(10)


@pytest.fixture(scope="module")
def alone(quick_job, tmp_path_factory):
    """Files of a flight that nobody looks on at."""
    return flown(quick_job, tmp_path_factory.mktemp("alone"))


def flown(quick_job, folder, **job):
    fly(quick_job(job={"folder": folder, **job}))
    return {name: (folder / name).read_bytes() for name in ("set.parquet", "set.tlog")}, rows(folder / "set.rrd")


def rows(path):
    import rerun as rr

    count = 0
    for chunk in rr.chunk.RrdReader(path).stream():
        if chunk.entity_path == "/roll" and not chunk.is_static:
            count += chunk.to_record_batch().num_rows
    return count


def until_listening(port):
    pause = threading.Event()
    for _ in range(600):
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        pause.wait(0.1)
    raise AssertionError("the live view does not listen")


@pytest.mark.parametrize("fate", ["nobody looks on", "frozen", "killed"])
def test_the_flight_is_the_same_whatever_becomes_of_the_view(alone, quick_job, tmp_path, port, fate):
    feed = live.feed(port)
    if fate == "frozen":
        until_listening(port)
        os.kill(feed.process.pid, signal.SIGSTOP)
    elif fate == "killed":
        os.kill(feed.process.pid, signal.SIGKILL)
        feed.process.wait(10)
    assert flown(quick_job, tmp_path, live_port=port) == alone


@pytest.mark.skipif(ctypes.util.find_library("vulkan") is None, reason="no Vulkan driver: the viewer cannot draw")
def test_who_looks_on_sees_the_flight_and_a_viewer_that_hangs_changes_nothing(alone, quick_job, tmp_path, port):
    from rerun.experimental import ViewerClient

    live.feed(port)
    until_listening(port)
    own = free_port()
    with started("--headless", "--hide-welcome-screen", "--port", str(own), live.address(port)) as process:
        until_listening(own)
        viewer = ViewerClient(f"rerun+http://127.0.0.1:{own}/proxy")
        for folder in ("seen", "hanging"):
            (tmp_path / folder).mkdir()
        assert flown(quick_job, tmp_path / "seen", live_port=port) == alone
        pause, ids = threading.Event(), []
        for _ in range(300):
            ids = [one.store_id for one in viewer.get_state().recordings]
            if any(one.endswith("-set") for one in ids):
                break
            pause.wait(0.1)
        assert any(one.endswith("-set") for one in ids), ids
        os.killpg(process.pid, signal.SIGSTOP)
        try:
            assert flown(quick_job, tmp_path / "hanging", live_port=port) == alone
        finally:
            os.killpg(process.pid, signal.SIGCONT)


def test_a_taken_port_is_named():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        with pytest.raises(UsageError, match=f"port {taken} of 127.0.0.1.*choose another port"):
            live.feed(taken)


def said_by_a_flight():
    rows = {
        "t_s": np.arange(3.0),
        "phi_rad": np.array([0.1, np.nan, -np.inf], np.float32),
        "nav_state": np.arange(3, dtype=np.int16),
        "armed": np.array([True, False, True]),
    }
    vehicle = FlownVehicle((Rotor(0.1, 0.2, 0.0, -0.05),), (0.3, 0.2, 0.1), np.ones(1, CONTROL_SETTINGS))
    return [
        ("begin", "froude", "run-set", "a <set>", vehicle),
        ("rows", rows),
        ("event", 1.25, 6, "text \u00e9 \ud800 " * 5000),
        ("faults", 1.5, "gust, motor 2 out"),
        ("segment", Segment("step", "step", "step", 1.0, 2.0, 0.17, 0.0)),
        ("link", 0.1, LinkCounts(1, 2, 3, 4, 5)),
        ("end", "# summary", "", {"run": {"seed": 1, "share": 0.5, "vehicle": "ANT-X", "none": None}}),
    ]


def read_back(tmp_path, data):
    spool = tmp_path / "spool"
    spool.write_bytes(data)
    with spool.open("rb") as file:
        return list(messages(file, flying=-1))


def test_messages_come_whole_and_end_with_the_flight(tmp_path):
    said = said_by_a_flight()
    assert {what for what, *_ in said} == set(live_message.WORDS)
    heard = read_back(tmp_path, b"".join(live_message.encode(*one) for one in said) + b"\x09")
    (_, *begun), (_, batch), *rest = heard
    assert begun[:3] == list(said[0][1:4])
    assert (list(begun[3].rotors), begun[3].frame_m) == (list(said[0][4].rotors), said[0][4].frame_m)
    assert begun[3].settings == said[0][4].settings
    for name, values in said[1][1].items():
        assert batch[name].dtype == values.dtype
        assert batch[name].tobytes() == values.tobytes()
    assert rest == said[2:]


def test_numbers_of_numpy_are_told_as_numbers():
    told = live_message.decode(live_message.encode("end", "", "", {"run": {"a": np.int64(3), "b": np.float32(0.5)}}))
    assert told == ("end", "", "", {"run": {"a": 3, "b": 0.5}})


@pytest.mark.parametrize(
    "bad",
    [
        live_message.LENGTHS.pack(1 << 31, 0),
        live_message.LENGTHS.pack(2, 1 << 31) + b"[]",
        live_message.LENGTHS.pack(2, 0) + b"[]",
        live_message.LENGTHS.pack(4, 0) + b"null",
        live_message.LENGTHS.pack(12, 0) + b'["__init__"]',
        live_message.LENGTHS.pack(50_000, 0) + b"[" * 50_000,
        live_message.LENGTHS.pack(36, 8) + b'["rows",[["t_s","|O",1]]]'.ljust(36) + bytes(8),
        live_message.LENGTHS.pack(36, 8) + b'["rows",[["t_s","<f8",-1]]]'.ljust(36) + bytes(8),
        live_message.LENGTHS.pack(36, 8) + b'["rows",[["t_s","<f8",99999]]]'.ljust(36) + bytes(8),
        live_message.LENGTHS.pack(36, 8) + b'["rows",[["t_s","<f4",1]]]'.ljust(36) + bytes(8),
        live_message.LENGTHS.pack(36, 8) + b'["rows",[["t_s",["<f4"],1]]]'.ljust(36) + bytes(8),
        live_message.LENGTHS.pack(40, 0) + b'["segment",{"name":"x","__class__":1}]'.ljust(40),
        pickle.dumps(("event", 1.0, 6, "x")),
    ],
)
def test_what_is_no_message_ends_the_view_and_is_not_waited_for(tmp_path, bad):
    good = live_message.encode("event", 1.0, 6, "x")
    assert read_back(tmp_path, good + bad + good) == [("event", 1.0, 6, "x")]


@given(data=st.binary(max_size=200), header=st.text(max_size=80))
def test_any_bytes_are_a_message_or_none(data, header):
    for message in (data, live_message.LENGTHS.pack(len(header.encode()), len(data)) + header.encode() + data):
        with contextlib.suppress(live_message.BadMessage):
            assert live_message.decode(message)[0] in live_message.WORDS


def test_a_message_that_is_too_large_ends_the_view_not_the_flight(port):
    feed = live.feed(port)
    feed.tell("event", 0.0, 6, "x" * (live_message.MOST_HEADER + 1))
    assert feed._lost


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_flight_that_is_killed_leaves_what_was_flown(tmp_path):
    program = f"""
import dataclasses, os, pathlib, signal, threading
from scenarios.gain_set import load_gain_sets
from scenarios.one_flight import fly
from scenarios.runner import plan
from scenarios.scenario import load_scenario

def progress(phase):
    if phase == "land":
        threading.Event().wait(1.0)
        os.kill(os.getpid(), signal.SIGKILL)

scenario = load_scenario("roll_step")
(gain_set,) = load_gain_sets("table_2_2/ANT-X")
job = plan(gain_set, scenario, scenario.resolve_vehicle(), scenario.resolve_profile())
fly(dataclasses.replace(job, folder=pathlib.Path({str(tmp_path)!r})), progress)
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -signal.SIGKILL
    (partial,) = tmp_path.glob("*.partial.rrd")
    assert rows(partial) >= 2000
    assert list(tmp_path.glob("*.partial.tlog"))
