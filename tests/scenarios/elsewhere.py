"""A vehicle that is not ours, behind an address, though in this thread: no socket, and time passes when one listens."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from bridge.client import Client
from bridge.clock import SimClock
from bridge.connection import Connection
from bridge.drive import SharedDrive
from bridge.errors import PeerLost
from bridge.link import Link, MemoryLink
from bridge.vehicle_server import ServerLink, VehicleServer
from scenarios import one_flight, restore_tasks
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

URL = "udpin://127.0.0.1:14540"
TICKS_AT_A_TIME = 5


class Elsewhere:
    """A vehicle and its one link.

    Attributes:
        silent: it neither hears nor says anything. only: names of the messages that get through to us; None for all.
    """

    def __init__(self, *, sysid: int = 1, spec: str = "ant-x") -> None:
        self.vehicle = Vehicle(resolve_vehicle(spec), get_profile("sitl"), seed=3)
        self.clock = SimClock(self.vehicle.tick_us)
        self.near, far = MemoryLink.pair()
        server = VehicleServer(self.vehicle, [ServerLink(far, Connection(sysid, 1, datagram=True), 0, "memory")])
        self.clock.every_tick(server.step)
        self.silent = False
        self.only: frozenset[str] | None = None
        self._ears = Connection(254, 1, datagram=True)

    def raws(self) -> dict[str, bytes]:
        """Every parameter, to the bit."""
        return {name: self.vehicle.parameters.raw(name) for name in self.vehicle.parameters.names}

    def switched_off_and_on(self) -> Elsewhere:
        """The same vehicle, on the ground, with the parameters it had."""
        again = Elsewhere()
        for name, raw in self.raws().items():
            again.vehicle.parameters.set_raw(name, raw)
        return again

    def passes(self, data: bytes) -> bool:
        return self.only is None or any(message.name in self.only for message in self._ears.receive(data))

    def client(self) -> Client:
        """A client that shares the vehicle's time."""
        return Client(WireTo(URL, self), SharedDrive(self.clock))

    def arm(self) -> None:
        while not self.vehicle.autopilot.healthy:
            self.clock.advance(50)
        assert self.vehicle.autopilot.command_arm(True).name == "ACCEPTED"


class WireTo(Link):
    """A link to a vehicle elsewhere."""

    def __init__(self, url: str, peer: Elsewhere) -> None:
        super().__init__(url)
        self._peer = peer
        while peer.near.recv() is not None:  # nobody listened to it
            pass

    def send(self, data: bytes) -> None:
        if not self._peer.silent:
            self._peer.near.send(data)

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        peer = self._peer
        if peer.silent:
            return None
        for _ in range(TICKS_AT_A_TIME if timeout_s else 1):
            data = peer.near.recv()
            if data is not None:
                return data if peer.passes(data) else None
            if timeout_s:
                peer.clock.advance()
        return None

    def close(self) -> None:
        pass


@pytest.fixture
def vehicles(monkeypatch: pytest.MonkeyPatch) -> dict[str, Elsewhere]:
    """What is there at which address; flights and `froude restore` find it there."""
    there: dict[str, Elsewhere] = {}

    def open_link(url: str, **_: Any) -> Link:
        if url not in there:
            raise PeerLost(url, "nobody lives here")
        return WireTo(url, there[url])

    monkeypatch.setattr(one_flight, "open_link", open_link)
    monkeypatch.setattr(restore_tasks, "open_link", open_link)
    monkeypatch.setattr(restore_tasks, "PATIENCE_S", 0.3)
    return there


@pytest.fixture
def elsewhere(vehicles: dict[str, Elsewhere]) -> Elsewhere:
    """One vehicle, at URL."""
    vehicles[URL] = Elsewhere()
    return vehicles[URL]


def dies_in(phase: str, peer: Elsewhere) -> Callable[[str], None]:
    """A flight's progress: the vehicle falls silent when a phase begins."""

    def progress(now: str) -> None:
        peer.silent = peer.silent or now == phase

    return progress
