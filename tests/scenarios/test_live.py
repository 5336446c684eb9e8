"""A live view beside a flight: whatever becomes of it, the flight's files are the same."""

import contextlib
import ctypes.util
import os
import signal
import socket
import subprocess
import sys
import threading

import pytest

from scenarios.one_flight import fly
from scenarios.recorder import live
from scenarios.recorder.live_viewer import messages
from scenarios.recorder.viewer import free_port, started
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


def test_messages_come_whole_and_end_with_the_flight(tmp_path):
    import pickle

    said = [("event", 1.0, 6, "x" * n) for n in (1, 1000, 100_000)]
    spool = tmp_path / "spool"
    spool.write_bytes(
        b"".join(live.LENGTH.pack(len(data)) + data for data in (pickle.dumps(one) for one in said)) + b"\x09"
    )
    with spool.open("rb") as file:
        assert list(messages(file, flying=-1)) == said


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
