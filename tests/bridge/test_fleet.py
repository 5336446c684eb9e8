from __future__ import annotations

import math
import select
import selectors
from types import SimpleNamespace
from typing import Any

import pytest

from bridge import readiness
from bridge.clock import ScaledClock
from bridge.connection import Connection
from bridge.fleet import Fleet
from bridge.fleet_status import FleetStatus, VehicleStatus, counter_values, vehicle_status
from bridge.framing import Counters
from bridge.readiness import Readiness
from bridge.sitl_links import close_links
from bridge.sitl_server import SitlOptions, build_fleet
from bridge.udp_link import UdpLink
from bridge.vehicle_server import VehicleServer
from sitl.errors import UsageError

URLS = ("udpin://127.0.0.1:0", "udpin://127.0.0.1:0#onboard")


class FakeWall:
    """A wall clock that passes only while somebody sleeps or waits for a socket."""

    def __init__(self) -> None:
        self.time_us = 1_000_000

    def now_us(self) -> int:
        return self.time_us

    def sleep_until_us(self, time_us: int) -> int:
        self.time_us = max(self.time_us, time_us)
        return self.time_us - time_us


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> FakeWall:
    """Waiting for a socket takes no time, but the clock says that it did."""
    wall = FakeWall()

    def no_wait(read: Any, write: Any, failed: Any, timeout_s: float) -> Any:
        ready = select.select(read, write, failed, 0.0)
        if not ready[0]:
            wall.time_us += math.ceil(timeout_s * 1e6)
        return ready

    monkeypatch.setattr(readiness, "select", SimpleNamespace(select=no_wait))
    return wall


@pytest.fixture
def script() -> Any:
    """Makes programs that speak to a vehicle."""
    made: list[Script] = []

    def make(server: VehicleServer, link: int = 0) -> Script:
        made.append(Script(server, link))
        return made[-1]

    yield make
    for one in made:
        one.link.close()


@pytest.fixture
def servers() -> Any:
    made = build_fleet(["ant-x", "ant-r", "ant-x"], 0, SitlOptions(links=URLS, several=True))
    yield made
    for server in made:
        close_links(server.links)


class Script:
    """A program with a socket of its own."""

    def __init__(self, server: VehicleServer, link: int = 0) -> None:
        port = server.links[link].link.port  # type: ignore[attr-defined]
        self.link = UdpLink.to("127.0.0.1", port)
        self.target = {"target_system": server.sysid, "target_component": 1}
        self.connection = Connection(255, 190, datagram=True)

    def send(self, name: str, **fields: Any) -> None:
        self.link.send(self.connection.encode(name, **fields))

    def heard(self) -> list[Any]:
        found: list[Any] = []
        while (data := self.link.recv()) is not None:
            found += self.connection.receive(data)
        return found


def run(fleet: Fleet, ticks: int, **options: Any) -> FleetStatus:
    end = fleet.servers[0].vehicle.tick + ticks
    return fleet.run(stop=lambda: not fleet.servers or fleet.servers[0].vehicle.tick >= end, **options)


def test_all_fly_and_each_answers_for_itself(servers: Any, wall: FakeWall, script: Any) -> None:
    scripts = [script(server) for server in servers]
    for one in scripts:
        one.send("PARAM_SET", **one.target, param_id="MC_ROLL_P", param_value=5.5, param_type=9)
    fleet = Fleet(servers, ScaledClock(1.0, wall), wall=wall)
    run(fleet, 100)
    assert [server.vehicle.tick for server in servers] == [100, 100, 100]
    for number, one in enumerate(scripts, start=1):
        heard = one.heard()
        assert {message.sysid for message in heard} == {number}
        assert {one.param_value for one in heard if one.name == "PARAM_VALUE"} == {5.5}


@pytest.mark.parametrize("speed", [0.5, 1.0, 10.0])
def test_flies_at_the_speed_asked_for(servers: Any, wall: FakeWall, speed: float) -> None:
    reports: list[FleetStatus] = []
    fleet = Fleet(servers, ScaledClock(speed, wall), wall=wall)
    run(fleet, int(3.2 * 250 * speed), report=reports.append)
    assert len(reports) == 3
    for status in reports:
        assert status.speed == pytest.approx(speed, rel=0.02)


def test_an_answer_does_not_wait_for_the_next_tick(servers: Any, wall: FakeWall, script: Any) -> None:
    one = script(servers[1])
    answered_us: list[int] = []
    asked_us: list[int] = []
    wait = readiness.select.select

    def speak_while_they_sleep(*args: Any) -> Any:
        if servers[0].vehicle.tick == 10 and not asked_us:
            wall.time_us += 40
            asked_us.append(wall.time_us)
            one.send("PARAM_REQUEST_READ", **one.target, param_id="MC_ROLL_P", param_index=-1)
        elif asked_us and not answered_us and any(message.name == "PARAM_VALUE" for message in one.heard()):
            answered_us.append(wall.time_us)
        return wait(*args)

    readiness.select.select = speak_while_they_sleep  # type: ignore[assignment]
    run(Fleet(servers, ScaledClock(0.1, wall), wall=wall), 12)  # a tick every 40 ms
    assert answered_us[0] == asked_us[0]


def test_one_that_fails_leaves_and_the_others_fly_on(servers: Any, wall: FakeWall) -> None:
    broken = servers[1]
    step = broken.vehicle.step

    def fail() -> None:
        if broken.vehicle.tick == 20:
            raise ZeroDivisionError("a motor of no mass")
        step()

    broken.vehicle.step = fail
    told: list[str] = []
    closed: list[int] = []
    fleet = Fleet(
        servers, ScaledClock(1.0, wall), wall=wall, tell=told.append, close=lambda server: closed.append(server.sysid)
    )
    status = run(fleet, 60)
    assert [server.vehicle.tick for server in servers] == [60, 20, 60]
    assert fleet.failures[0][0] == 2
    assert "system 2 failed and is no longer served: ZeroDivisionError: a motor of no mass (test_fleet.py:" in told[0]
    assert closed == [2, 1, 3]
    assert status.failed == 1
    assert "failed vehicles 1" in status.line()
    with UdpLink.listen("127.0.0.1", int(broken.links[0].link.name.rpartition(":")[2])):
        pass  # its port is free again


def test_one_that_fails_while_it_listens_leaves_too(servers: Any, wall: FakeWall, script: Any) -> None:
    def fail() -> None:
        raise OSError("the network is gone")

    servers[2].listen = fail
    one = script(servers[2])
    one.send("HEARTBEAT", type=6)
    fleet = Fleet(servers, ScaledClock(1.0, wall), wall=wall)
    run(fleet, 10)
    assert [server.sysid for server in fleet.servers] == [1, 2]


def test_a_vehicle_that_cannot_be_closed_does_not_keep_the_others_from_it(servers: Any, wall: FakeWall) -> None:
    closed: list[int] = []
    told: list[str] = []

    def close(server: VehicleServer) -> None:
        closed.append(server.sysid)
        if server.sysid == 1:
            raise UsageError("mine.params: no space left")

    fleet = Fleet(servers, ScaledClock(1.0, wall), wall=wall, close=close, tell=told.append)
    run(fleet, 5)
    assert closed == [1, 2, 3]
    assert told == ["system 1 could not be closed in order: mine.params: no space left"]
    assert [sysid for sysid, _ in fleet.failures] == [1]


def test_one_that_is_switched_off_leaves_and_the_last_one_ends_it(servers: Any, wall: FakeWall, script: Any) -> None:
    told: list[str] = []
    fleet = Fleet(servers, None, wall=wall, tell=told.append)
    scripts = [script(server) for server in servers]

    def stop() -> bool:
        if servers[0].vehicle.tick == 5:
            scripts[1].send("COMMAND_LONG", **scripts[1].target, command=246, param1=2.0)
        if servers[0].vehicle.tick == 10:
            for one in (scripts[0], scripts[2]):
                one.send("COMMAND_LONG", **one.target, command=246, param1=2.0)
        return servers[0].vehicle.tick > 20

    fleet.run(stop=stop)
    assert [server.vehicle.tick for server in servers] == [10, 5, 10]
    assert told[0] == "system 2 was switched off by a ground station"
    assert not fleet.failures
    acks = [one for one in scripts[1].heard() if one.name == "COMMAND_ACK"]
    assert [one.result for one in acks] == [0]


def test_vehicles_of_different_ticks_do_not_fly_together(servers: Any) -> None:
    servers[1].vehicle.tick_us = 1000
    with pytest.raises(UsageError, match="same tick"):
        Fleet(servers, None)
    with pytest.raises(UsageError, match="needs vehicles"):
        Fleet([], None)


class TestReadiness:
    def test_only_who_was_spoken_to(self, servers: Any, script: Any) -> None:
        ears = Readiness(servers)
        assert ears.hears_all
        assert ears.wait(0.0) == []
        assert ears.wait(0.001) == []
        scripts = [script(servers[2], link) for link in (0, 1)]
        for one in scripts:
            one.send("HEARTBEAT", type=6)
        assert ears.wait(5.0) == [servers[2]]
        assert ears.wait(5.0) == [servers[2]]  # until it has been read
        servers[2].listen()
        assert ears.wait(0.0) == []
        ears.forget(servers[2])
        scripts[0].send("HEARTBEAT", type=6)
        assert ears.wait(0.01) == []
        ears.close()

    def test_links_without_a_descriptor_are_always_asked(self, flight: Any, servers: Any, script: Any) -> None:
        memory = flight(heartbeats=False).server
        ears = Readiness([servers[0], memory])
        assert not ears.hears_all
        assert ears.wait(0.0) == [memory]
        one = script(servers[0])
        one.send("HEARTBEAT", type=6)
        assert set(ears.wait(0.0)) == {servers[0], memory}
        ears.forget(memory)
        assert ears.wait(0.0) == [servers[0]]

    def test_selectors_without_a_descriptor(self, servers: Any, monkeypatch: pytest.MonkeyPatch, script: Any) -> None:
        monkeypatch.setattr(readiness.selectors, "DefaultSelector", selectors.SelectSelector)
        ears = Readiness(servers)
        assert ears.wait(0.001) == []
        one = script(servers[1])
        one.send("HEARTBEAT", type=6)
        assert ears.wait(5.0) == [servers[1]]


def vehicle(sysid: int = 1, **changes: Any) -> VehicleStatus:
    fields = {"mode": "Hold", "armed": False, "links": 2, "heard": 1, "sent": 10, "received": 5, "refusals": {}}
    return VehicleStatus(sysid, **(fields | changes))


class TestStatus:
    def test_one_vehicle(self) -> None:
        line = FleetStatus(12.0, 1.0, 1.0, (vehicle(armed=True),)).line()
        assert line.split("  ") == [
            "",
            "",
            "12.0 s",
            "1.00 x",
            "Hold, armed",
            "links heard 1/2",
            "sent 10",
            "received 5",
        ]

    def test_several(self) -> None:
        fleet = (
            vehicle(),
            vehicle(2, mode="Land", armed=True, refusals={"bad crc": 2}),
            vehicle(3, refusals={"bad crc": 1}),
        )
        line = FleetStatus(1.0, 0.5, 1.0, fleet).line()
        assert "0.50 x (too slow for 1 x)" in line
        assert "3 vehicles: 2 Hold, 1 Land, 1 armed" in line
        assert "links heard 3/6  sent 30  received 15  bad crc 3" in line

    def test_every_refusal_is_counted_and_shown(self, servers: Any, script: Any) -> None:
        server = servers[0]
        one = script(server)
        good = one.connection.encode("HEARTBEAT", type=6)
        one.link.send(good)
        one.link.send(good[:-1] + bytes([good[-1] ^ 1]))
        one.link.send(b"\x00\x01\x02")
        one.send("COMMAND_LONG", target_system=77, command=400)
        server.listen()
        server.refusals, server.defects = 3, 1
        server.links[1].link.strangers = 4
        status = vehicle_status(server)
        assert status.received == 2
        assert status.heard == 1
        for kind, count in (("bad crc", 1), ("refused", server.refused), ("defects", 1), ("strangers", 4)):
            assert status.refusals[kind] == count
        assert status.refusals["bad bytes"] >= 3
        line = FleetStatus(1.0, 1.0, None, (status,)).line()
        assert all(f"{kind} {count}" in line for kind, count in status.refusals.items())

    def test_counters_added_later_show(self) -> None:
        class Later(Counters):
            def __init__(self) -> None:
                super().__init__()
                self.bad_signature = 7

        assert counter_values(Later())["bad_signature"] == 7
        assert "_last" not in counter_values(Counters())
        assert counter_values(Counters())["bad_crc"] == 0
