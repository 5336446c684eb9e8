"""A vehicle that hostile bytes are sent to, every one of them accounted for, and what its memory holds."""

from __future__ import annotations

import gc
import math
import sys
from collections.abc import Sequence
from types import FunctionType, ModuleType
from typing import Any

from bridge.connection import Connection, Message
from bridge.link import MemoryLink
from bridge.messages import SIGNATURE
from bridge.services import VehicleFiles
from bridge.streams import LinkMode
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

Fields = dict[str, Any]

US, COMPONENT = 1, 1
"""The vehicle's address."""


class Watched:
    """A vehicle with two links, what came in on them accounted for.

    Args:
        datagram: whether the links keep datagrams whole.
        modes: of the links.
        files: what the vehicle keeps on disk.

    Attributes:
        server: serves it; strict, so a defect in a handler comes out.
        ends: the far ends of its links.
        good: what its links gave out as messages.
    """

    def __init__(
        self,
        *,
        datagram: bool = True,
        modes: Sequence[LinkMode] = ("gcs", "onboard"),
        files: VehicleFiles | None = None,
    ) -> None:
        self.vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"))
        pairs = [MemoryLink.pair() for _ in modes]
        self.ends = [far for _, far in pairs]
        self.links = [
            ServerLink(near, Connection(US, COMPONENT, datagram=datagram), number, mode)
            for number, (mode, (near, _)) in enumerate(zip(modes, pairs, strict=True))
        ]
        self.server = VehicleServer(
            self.vehicle,
            self.links,
            utc_boot_us=1_800_000_000_000_000,
            strict=True,
            files=files or VehicleFiles(),
        )
        self.stations = [Connection(255 - 10 * number, 190, datagram=True) for number in range(len(modes))]
        self.heard: list[list[Message]] = [[] for _ in modes]
        self.fed = [0 for _ in modes]
        self.good = [0 for _ in modes]
        for link in self.links:
            self._account(link)

    def put(self, data: bytes, link: int = 0) -> None:
        """Hand bytes to a link."""
        self.fed[link] += len(data)
        self.ends[link].send(data)

    def send(self, name: str, link: int = 0, **fields: Any) -> None:
        """Send a message as a ground station."""
        self.put(self.stations[link].encode(name, **fields), link)

    def tick(self, count: int = 1) -> None:
        """Let vehicle time pass; what the vehicle says is forgotten."""
        for _ in range(count):
            self.server.step()
            for end in self.ends:
                while end.recv() is not None:
                    pass

    def run(self, seconds: float, *, heartbeats: bool = True) -> None:
        for k in range(round(seconds * 1e6 / self.vehicle.tick_us)):
            if heartbeats and k % 125 == 0:
                for link in range(len(self.ends)):
                    self.send("HEARTBEAT", link, type=6, autopilot=8)
            self.tick()

    def ask(self, name: str, *, link: int = 0, ticks: int = 2, **fields: Any) -> list[Message]:
        """Send a message and return what is heard within some ticks on the same link."""
        while self.ends[link].recv() is not None:
            pass
        self.send(name, link, **fields)
        heard = []
        for _ in range(ticks):
            self.server.step()
            while (data := self.ends[link].recv()) is not None:
                heard += self.stations[link].receive(data)
        return heard

    def command(self, number: int, *params: float, link: int = 0, ticks: int = 2) -> int | None:
        """The result of a COMMAND_LONG, None if there is no answer."""
        fields = {f"param{k}": value for k, value in enumerate(params, start=1)}
        target = {"target_system": US, "target_component": COMPONENT}
        heard = self.ask("COMMAND_LONG", link=link, ticks=ticks, command=number, **target, **fields)
        results = [m.result for m in heard if m.name == "COMMAND_ACK" and m.command == number]
        return results[-1] if results else None

    def answers(self, link: int = 0, ticks: int = 2) -> bool:
        """Whether a parameter and a message that are asked for come back within some ticks."""
        target = {"target_system": US, "target_component": COMPONENT}
        read = self.ask("PARAM_REQUEST_READ", link=link, ticks=ticks, param_id="MC_ROLL_P", param_index=-1, **target)
        found = any(m.name == "PARAM_VALUE" and m.param_id == "MC_ROLL_P" for m in read)
        return found and self.command(512, 148.0, link=link, ticks=ticks) == 0

    def hover(self, height_m: float = 10.0) -> Watched:
        """Take off and wait for Hold."""
        self.run(4.0)
        assert self.command(400, 1.0) == 0
        nan = math.nan
        assert self.command(22, 0.0, 0.0, 0.0, nan, nan, nan, self.vehicle.origin[2] + height_m) == 0
        for _ in range(100):
            self.run(0.5)
            if self.vehicle.autopilot.mode == 4:
                self.run(1.0)
                return self
        raise AssertionError("no Hold within 50 s")

    def state(self) -> Fields:
        """What only a valid command changes."""
        autopilot = self.vehicle.autopilot
        parameters = self.vehicle.parameters
        return {
            "armed": autopilot.armed,
            "mode": autopilot.mode,
            "home": repr(autopilot.home),
            "terminated": autopilot.terminated,
            "parameters": (parameters.hash_check(), len(parameters)),
            "shutdown": self.server.shutdown_asked,
            "intervals": [dict(link.schedule.intervals()) for link in self.links],
            "signers": [link.connection.signer is None for link in self.links],
            "plans": repr([self.server.services.plans.plan(kind) for kind in range(3)]),
            "set-points": getattr(autopilot, "_offboard_us", None),
        }

    def finite(self) -> bool:
        """Whether the vehicle is somewhere."""
        estimate = self.vehicle.truth
        return all(
            math.isfinite(value)
            for values in (estimate.position_ned(), estimate.velocity_ned(), estimate.quat(), estimate.rates())
            for value in values
        )

    def adds_up(self, link: int = 0) -> bool:
        """Whether every byte that came belongs to a good, an unknown or a refused frame, or is a bad byte."""
        connection = self.links[link].connection
        counters = connection.counters
        rest = self.fed[link] - self.good[link] - counters.bad_bytes - connection.pending
        others = counters.unknown + counters.refused
        return 8 * others <= rest <= (255 + 12 + SIGNATURE) * others

    def _account(self, link: ServerLink) -> None:
        receive = link.connection.receive

        def counted(data: bytes) -> list[Message]:
            messages = receive(data)
            self.good[link.link_id] += sum(len(message.raw_frame) for message in messages)
            return messages

        link.connection.receive = counted  # type: ignore[method-assign]


def weight(*roots: object) -> int:
    """Bytes of all objects that can be reached, code and modules left out."""
    seen: set[int] = set()
    waiting: list[object] = list(roots)
    total = 0
    while waiting:
        one = waiting.pop()
        if id(one) in seen or isinstance(one, (type, ModuleType)):
            continue
        seen.add(id(one))
        if isinstance(one, FunctionType):
            waiting.extend(cell.cell_contents for cell in one.__closure__ or ())
            continue
        total += sys.getsizeof(one, 64)
        waiting.extend(_inside(one))
    return total


def _inside(one: object) -> list[object]:
    if isinstance(one, (str, bytes, bytearray, int, float)):
        return []
    return gc.get_referents(one)
