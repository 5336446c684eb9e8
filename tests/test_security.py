"""The README's section on security: every test it names is there, and what no other test holds to is held to here."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from sockets import opened

from bridge.connection import Connection
from bridge.exposure import exposed
from bridge.ground_router import GroundRouter
from bridge.link import MemoryLink
from bridge.signing import Signer, SigningKey, Timestamps
from bridge.sitl_links import default_urls
from scenarios.board_session import GROUNDS
from scenarios.hil_command import SIMULATOR_PORT
from scenarios.recorder import live, viewer, web_viewer

ROOT = Path(__file__).parents[1]
LOOPBACK = "127.0.0.1"
NOW_US = 1_800_000_000_000_000


def section() -> str:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return text.partition("\n## Security: who could do what\n")[2].partition("\n## ")[0]


def test_every_test_that_is_named_is_there() -> None:
    named = set(re.findall(r"`(?:[\w/]+/)?(test_\w+\.py)`", section()))
    assert len(named) >= 10
    assert named <= {path.name for path in (ROOT / "tests").rglob("test_*.py")}


def test_addresses_and_ports_are_those_of_the_program() -> None:
    text = section()
    ports = [re.search(r"local=(\d+)", url) for url in default_urls(0)]
    assert all(f"{found[1]} + i" in text for found in ports if found)
    assert f"{SIMULATOR_PORT} + N" in text
    assert f"127.0.0.1, {web_viewer.PORT}" in text
    assert {viewer.HOST, live.HOST, web_viewer.HOST} == {LOOPBACK}
    assert viewer.LOOPBACK == ("--bind", LOOPBACK)


def test_a_boards_mavlink_goes_to_this_computer_only() -> None:
    assert [exposed(url) for url in GROUNDS] == ["", ""]
    assert all(f"{re.search(r'local=(.*)', url)[1]}" in section() for url in GROUNDS)  # type: ignore[index]


def test_a_cluster_of_the_sweeps_own_is_on_the_loopback() -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    from scenarios.sweep import cluster

    before = opened(os.getpid())
    with cluster._quiet(), cluster._local_cluster(1):
        new = opened(os.getpid()) - before
    assert new
    assert all(one.loopback for one in new), new


def test_not_protected_parameters_reach_a_board_that_nobody_may_arm() -> None:
    near, far = MemoryLink.pair()
    frame = Connection(255, 190).encode("PARAM_SET", target_system=1, param_id="MC_ROLL_P", param_type=9)
    far.send(frame)
    assert GroundRouter([near]).from_grounds(0) == [frame]


@pytest.mark.parametrize(("age_s", "believed"), [(30, 1), (90, 0)])
def test_not_protected_the_last_minute_before_a_kill_can_be_played_back(age_s: int, believed: int) -> None:
    """A restart after a kill knows of what was signed only what its key file tells, which may be a minute old."""
    key = SigningKey(bytes(range(32)), 1)
    theirs = Connection(255, 190, signer=Signer(key, 0, utc_us=lambda: NOW_US))
    frame = theirs.encode("COMMAND_LONG", command=400, param1=1.0)
    again = Timestamps(1, lambda: NOW_US + age_s * 1_000_000)
    ours = Connection(1, 1, datagram=True, signer=Signer(key, 1, timestamps=again))
    assert len(ours.receive(frame)) == believed
    assert ours.receive(frame) == []


def test_not_protected_an_unsigned_vehicle_obeys_whoever_speaks() -> None:
    stranger = Connection(99, 99).encode("COMMAND_LONG", command=400, param1=1.0)
    assert len(Connection(1, 1, datagram=True).receive(stranger)) == 1
