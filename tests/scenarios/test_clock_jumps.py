"""The computer's clock is set forward and back while we fly: it names files and stamps logs, and nothing else."""

from __future__ import annotations

import ast
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from bridge.client import Client
from bridge.drive import ListeningDrive
from bridge.link import open_link

ROOT = Path(__file__).parents[2]
PATIENCE_S = 100.0
GAINS = ("MC_ROLL_P", "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D", "MC_PITCH_P")

READS = {
    "time": {
        "time",
        "time_ns",
        "localtime",
        "gmtime",
        "ctime",
        "asctime",
        "strftime",
        "clock_gettime",
        "CLOCK_REALTIME",
    },
    "datetime": {"now", "utcnow", "today"},
    "date": {"today"},
}
"""What tells the time of day in Python's library."""

NAMES_AND_STAMPS = {
    "bridge/sitl_server.py",  # what a vehicle's GPS tells at boot; from then on it goes on with vehicle time
    "scenarios/flight_import/command.py",
    "scenarios/flight_import/ulog_source.py",  # the time that a log tells itself, as text
    "scenarios/param_journal.py",
    "scenarios/run_list.py",  # when a file was written
    "scenarios/runner.py",
    "scenarios/sweep/sweep_command.py",
}
"""Who asks `bridge.clock` for it."""

JUMPING = """
import random, sys, time
chance, ours = random.Random(5), time.time_ns
time.time_ns = lambda: ours() + chance.randrange(-86_400, 86_400) * 10**9
time.time = lambda: time.time_ns() * 1e-9
from scenarios.cli import main
sys.exit(main())
"""
"""The program on a computer whose clock is set by up to a day, either way, between any two looks at it."""

QUICK = """
title = "quick"
vehicle = "ant-x"
gain_sets = ["table_2_2/ANT-X"]
takeoff_altitude_m = 3.0
[gate]
hold_s = 0.5
timeout_s = 2.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = 2.0
return_s = 2.0
"""


def modules() -> list[Path]:
    found = [path for name in ("sitl", "bridge", "scenarios") for path in (ROOT / name).rglob("*.py")]
    return [path for path in found if path.name != "froude_messages.py"]


def test_one_module_reads_the_time_of_day() -> None:
    readers = set()
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                owner = node.value.id if isinstance(node.value, ast.Name) else getattr(node.value, "attr", "")
                if node.attr in READS.get(owner, ()):
                    readers.add(path.relative_to(ROOT).as_posix())
            elif isinstance(node, ast.ImportFrom) and node.module in ("time", "datetime"):
                assert not {one.name for one in node.names} - {"timedelta", "timezone", "UTC"}, path
    assert readers == {"bridge/clock.py"}


def test_it_is_asked_for_names_and_stamps_only() -> None:
    askers = set()
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == "bridge.clock":
                asked = {one.name for one in node.names} & {"utc_us", "utc_stamp"}
                askers |= {path.relative_to(ROOT).as_posix()} if asked else set()
    assert askers == NAMES_AND_STAMPS


def start(*words: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", JUMPING, *map(str, words)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def values_at(port: int) -> dict[str, float]:
    with open_link(f"udpin://127.0.0.1:{port}") as link:
        client = Client(link, ListeningDrive(PATIENCE_S))
        client.connect(PATIENCE_S)
        return {name: value.value for name, value in client.read_parameters(GAINS).items()}


def test_a_vehicle_and_a_flight(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    (tmp_path / "quick.toml").write_text(QUICK)
    url, log = f"udpout://127.0.0.1:{port}#onboard", tmp_path / "ulog"
    vehicle = start("sitl", "ant-x", "--speed", 1, "--log-dir", log, "--link", url)
    try:
        assert vehicle.stdout is not None
        assert "serving" in vehicle.stdout.readline()
        before = values_at(port)
        words = ("--connect", f"udpin://127.0.0.1:{port}", "--out", tmp_path / "runs", "--json")
        out, err = start("fly", tmp_path / "quick.toml", *words).communicate(timeout=PATIENCE_S)
        assert err == ""
        run = json.loads(out)
        (flight,) = run["flights"]
        assert (run["complete"], flight["outcome"]) == (True, "PASS"), flight["reason"]
        assert values_at(port) == before
    finally:
        vehicle.terminate()
        vehicle.communicate()
    from pyulog import ULog

    (file,) = log.rglob("*.ulg")
    times_us = ULog(str(file)).get_dataset("vehicle_attitude").data["timestamp"]
    assert (times_us[1:] > times_us[:-1]).all()
    assert not list((Path(os.environ["FROUDE_STATE_DIR"]) / "restore").glob("*.json"))


@pytest.mark.parametrize("jump_s", [-86_400, 86_400])
def test_a_journal_is_found_whenever_it_was_written(jump_s: int) -> None:
    from bridge.clock import utc_stamp, utc_us
    from bridge.peer_identity import PeerIdentity
    from scenarios.journal_text import Owner
    from scenarios.param_journal import ParamJournal, pending

    stamp = utc_stamp(utc_us() + jump_s * 1_000_000)
    ParamJournal.begin(Owner(PeerIdentity("udpin://127.0.0.1:14540", 1), utc=stamp), []).close()
    ((found,), problems) = pending()
    assert (found.owner.utc, problems) == (stamp, [])
