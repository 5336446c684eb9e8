from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import pytest

from bridge.connection import Connection, Message
from bridge.link import MemoryLink
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

NAN = math.nan


class Ground:
    """A ground station on one of a vehicle's links, in the vehicle's thread."""

    def __init__(self, end: MemoryLink, sysid: int = 255, compid: int = 190) -> None:
        self.end = end
        self.connection = Connection(sysid, compid, datagram=True)
        self.heard: list[tuple[int, Message]] = []

    def send(self, name: str, **fields: Any) -> None:
        """Send a message to the vehicle."""
        self.end.send(self.connection.encode(name, **fields))

    def listen(self, now_us: int) -> None:
        """Read what the vehicle sent by now."""
        while (data := self.end.recv()) is not None:
            self.heard += [(now_us, message) for message in self.connection.receive(data)]

    def named(self, *names: str) -> list[Message]:
        """What was heard of these messages."""
        return [message for _, message in self.heard if message.name in names]

    def counts(self) -> Counter[str]:
        """How often each message was heard."""
        return Counter(message.name for _, message in self.heard)

    def texts(self) -> list[str]:
        """The texts that were heard, put together from their chunks."""
        whole: dict[int, str] = {}
        for message in self.named("STATUSTEXT"):
            whole[message["id"]] = whole.get(message["id"], "") + message.text
        return list(whole.values())


class Flight:
    """A real vehicle, its server and a ground station on each link."""

    def __init__(
        self, *modes: Any, heartbeats: bool = True, strict: bool = True, vehicle: str = "ant-x", **options: Any
    ) -> None:
        self.vehicle = Vehicle(resolve_vehicle(vehicle), get_profile("sitl"))
        self.grounds: list[Ground] = []
        self.links: list[ServerLink] = []
        for number, mode in enumerate(modes or ("gcs",)):
            near, far = MemoryLink.pair()
            self.links.append(ServerLink(near, Connection(1, 1, datagram=True), number, mode))
            self.grounds.append(Ground(far, *((255, 190) if number == 0 else (245, 191))))
        self.heartbeats = heartbeats
        self.server = VehicleServer(self.vehicle, self.links, strict=strict, **options)

    @property
    def ground(self) -> Ground:
        """The first ground station."""
        return self.grounds[0]

    @property
    def autopilot(self) -> Any:
        return self.vehicle.autopilot

    def run(self, seconds: float, each_tick: Callable[[], object] | None = None) -> None:
        """Let vehicle time pass."""
        for _ in range(round(seconds * 1e6 / self.vehicle.tick_us)):
            if self.heartbeats and self.vehicle.tick % 125 == 0:
                for ground in self.grounds:
                    ground.send("HEARTBEAT", type=6, autopilot=8)
            if each_tick is not None:
                each_tick()
            self.server.step()
            for ground in self.grounds:
                ground.listen(self.vehicle.time_us)

    def forget(self) -> None:
        """Forget what was heard so far."""
        for ground in self.grounds:
            ground.heard.clear()

    def ask(
        self, name: str, *, only: Iterable[str] = (), wait_s: float = 0.1, link: int = 0, **fields: Any
    ) -> list[Message]:
        """Send a message and return what answers on the same link, telemetry left out."""
        for ground in self.grounds:
            ground.listen(self.vehicle.time_us)
        self.forget()
        self.grounds[link].send(name, **fields)
        self.run(wait_s)
        unasked = {"STATUSTEXT", "EVENT", "CURRENT_EVENT_SEQUENCE", "MISSION_CURRENT"}
        streamed = set() if only else set(self.links[link].schedule.intervals()) | unasked
        heard = [message for _, message in self.grounds[link].heard]
        return [one for one in heard if (one.name in only if only else one.name not in streamed)]

    def command(self, number: int, *params: float, **options: Any) -> list[Message]:
        """Send a COMMAND_LONG and return what answers."""
        fields = {f"param{index}": value for index, value in enumerate(params, start=1)}
        return self.ask(
            "COMMAND_LONG",
            **{"target_system": 1, "target_component": 1, "command": number, **fields, **options},
        )

    def result(self, number: int, *params: float, **options: Any) -> int | None:
        """Send a command and return its one result, None if there was no answer."""
        acks = [one for one in self.command(number, *params, **options) if one.name == "COMMAND_ACK"]
        assert len(acks) <= 1, acks
        if not acks:
            return None
        assert acks[0].command == number
        result: int = acks[0].result
        return result

    def set_point(self, roll_rad: float = 0.0, *, thrust: float = 0.5, mask: int = 7, **fields: Any) -> None:
        """Send one SET_ATTITUDE_TARGET."""
        quat = (math.cos(roll_rad / 2), math.sin(roll_rad / 2), 0.0, 0.0)
        self.ground.send(
            "SET_ATTITUDE_TARGET",
            **{
                "target_system": 1,
                "target_component": 1,
                "type_mask": mask,
                "q": quat,
                "thrust": thrust,
                **fields,
            },
        )

    def hover(self, height_m: float = 5.0) -> Flight:
        """Arm, take off and wait for Hold."""
        self.run(3.0)
        assert self.result(400, 1) == 0
        assert self.result(22, 0, 0, 0, NAN, NAN, NAN, self.vehicle.origin[2] + height_m) == 0
        for _ in range(40):
            self.run(0.5)
            if self.autopilot.mode == 4:
                break
        self.forget()
        return self

    def offboard(self) -> Flight:
        """Hover, then fly in Offboard on level set-points."""
        self.hover()
        self.run(0.2, self.at_20_hz(self.set_point))
        assert self.result(176, 1, 6) == 0
        self.forget()
        return self

    def at_20_hz(self, send: Callable[[], object]) -> Callable[[], object]:
        """Return something for `run` that sends 20 times a second."""
        return lambda: send() if self.vehicle.tick % 13 == 0 else None


@pytest.fixture
def on_ground() -> Flight:
    """A vehicle that is ready to arm, disarmed."""
    flight = Flight()
    flight.run(3.0)
    flight.forget()
    return flight


@pytest.fixture
def flight() -> type[Flight]:
    """For tests that want more than one link, or another moment."""
    return Flight
