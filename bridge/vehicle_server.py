"""The vehicle's MAVLink face: what a ground station takes for a PX4.

    server = VehicleServer(vehicle, [ServerLink(link, connection, 0, "memory")])
    while flying:
        server.step()        # one tick of the vehicle, then one of its links

Everything happens in vehicle time and in the caller's thread: each tick reads every link, answers, and sends
the telemetry that is due. Services hang on a table from message name to handler, so a new one adds its names
and nothing else changes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from bridge.absent_services import AbsentServices
from bridge.commands import Commands
from bridge.connection import Connection, Message
from bridge.errors import FieldError, LinkClosed, PeerLost
from bridge.link import Link
from bridge.offboard import OffboardSetpoints
from bridge.param_protocol import ParamServer
from bridge.streams import LinkMode, Schedule
from bridge.telemetry import Fields, Source
from sitl.modes import Result, Severity
from sitl.vehicle import Vehicle

GCS_TIMEOUT_US = 2_500_000
"""A link without a ground station's HEARTBEAT for this long gets no STATUSTEXT (PX4 HEARTBEAT_TIMEOUT_US)."""

_MAV_TYPE_GCS = 6
_HOUSEKEEPING_US = 4_000
_TEXT_BYTES = 50
_TEXT_LIFE_US = 5_000_000
_TEXTS_KEPT = 32
_REPEAT_US = 1_000_000
_DATAGRAMS_PER_TICK = 64
_LOST_PEER_PAUSE_US = 100_000
_LARGEST_FLOAT32 = 3.4028234663852886e38


class ServerLink:
    """One link of the vehicle, with stream rates and a ground station of its own.

    Args:
        link: carries the bytes.
        connection: frames them; its sysid and compid are the vehicle's.
        link_id: a number of its own among the vehicle's links.
        mode: whose default rates.

    Attributes:
        schedule: when each message is due here.
        peers: (sysid, compid) of everybody heard here.
        gcs_seen_us: vehicle time of a ground station's last HEARTBEAT, None before the first.
    """

    def __init__(self, link: Link, connection: Connection, link_id: int, mode: LinkMode) -> None:
        self.link = link
        self.connection = connection
        self.link_id = link_id
        self.mode = mode
        self.schedule = Schedule(mode)
        self.peers: set[tuple[int, int]] = set()
        self.gcs_seen_us: int | None = None
        self.resting_until_us = 0
        self.texts: deque[tuple[int, Severity, str]] = deque(maxlen=_TEXTS_KEPT)
        self._text_id = 0

    def send(self, name: str, fields: Fields) -> None:
        """Send one message now; what a diverging vehicle drives beyond float32 is sent as infinity."""
        try:
            frame = self.connection.encode_fields(name, fields)
        except FieldError:
            fields = {key: _float32(value) for key, value in fields.items()}
            frame = self.connection.encode_fields(name, fields)
        self.link.send(frame)

    def hears_gcs(self, now_us: int) -> bool:
        """Return whether a ground station is there."""
        return self.gcs_seen_us is not None and now_us - self.gcs_seen_us <= GCS_TIMEOUT_US

    def send_texts(self, now_us: int) -> None:
        """Send the texts that wait, to a ground station only; what is older than 5 s is no longer news."""
        while self.texts:
            said_us, severity, text = self.texts[0]
            if now_us - said_us <= _TEXT_LIFE_US:
                if not self.hears_gcs(now_us):
                    return
                self._send_text(severity, text)
            self.texts.popleft()

    def _send_text(self, severity: Severity, text: str) -> None:
        """Send a text in chunks of 50 bytes; one that ends at a full chunk is closed by an empty one."""
        data = text.encode()
        self._text_id = self._text_id % 65535 + 1  # 0 would mean: not in chunks
        for chunk in range(len(data) // _TEXT_BYTES + 1):
            part = data[chunk * _TEXT_BYTES : (chunk + 1) * _TEXT_BYTES]
            self.send(
                "STATUSTEXT",
                {"severity": int(severity), "text": part, "id": self._text_id, "chunk_seq": chunk & 0xFF},
            )


class VehicleServer:
    """Serves one vehicle on any number of links.

    Args:
        vehicle: the vehicle; `step` advances it, or the caller does and calls `tick`.
        links: its links, all with the same system and component id.
        utc_boot_us: UTC of vehicle time zero in microseconds, for SYSTEM_TIME; 0 = unknown.
        strict: let a defect in a handler out of `tick` instead of counting it. Tests are strict.

    Attributes:
        source: what telemetry is made of.
        defects: handlers that failed on a message; 0 unless there is a bug in here.
        refused: messages that were for us and made no sense.
        shutdown_asked: a ground station asked the vehicle to switch off.
    """

    def __init__(
        self, vehicle: Vehicle, links: Sequence[ServerLink], *, utc_boot_us: int = 0, strict: bool = False
    ) -> None:
        self.vehicle = vehicle
        self.links = list(links)
        self.sysid = self.links[0].connection.sysid if self.links else 1
        self.compid = self.links[0].connection.compid if self.links else 1
        self.source = Source(vehicle, self.sysid, utc_boot_us)
        self.strict = strict
        self.defects = 0
        self.refused = 0
        self.shutdown_asked = False
        self._params = ParamServer(vehicle.parameters, system_id=self.sysid, component_id=self.compid)
        self._said_us: dict[str, int] = {}
        self._housekeeping_us = 0
        commands = Commands(self)
        self._handlers: dict[str, Callable[[ServerLink, Any], None]] = {
            "HEARTBEAT": self._heartbeat,
            "COMMAND_LONG": commands.handle,
            "COMMAND_INT": commands.handle,
            "SET_MODE": commands.handle_set_mode,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
            **dict.fromkeys(ParamServer.HANDLES, self._parameter),
            **OffboardSetpoints(self).handlers(),
            **AbsentServices(self).handlers(),
        }

    def step(self) -> None:
        """Take what has come, advance the vehicle by one tick, then send what is due.

        In this order a set-point sent after the telemetry of tick k is flown by the attitude law of tick k + 1 and
        reaches the motors at k + 2, as measured on a PX4 in lockstep.
        """
        self.listen()
        self.vehicle.step()
        self.speak()

    def tick(self) -> None:
        """Read every link, answer, send what is due."""
        self.listen()
        self.speak()

    def speak(self) -> None:
        """Send the telemetry, texts and parameters that are due on every link."""
        now_us = self.vehicle.time_us
        for link in self.links:
            if now_us >= link.resting_until_us:
                try:
                    link.schedule.run(now_us, self.source, link.send)
                except (PeerLost, LinkClosed):
                    self._peer_lost(link)
                except Exception as error:
                    self._defect("telemetry", error)
        if now_us >= self._housekeeping_us:
            self._housekeeping_us = now_us + _HOUSEKEEPING_US
            self._keep_house()

    def listen(self) -> None:
        """Read every link and answer; between two ticks this makes answers quicker than the tick is long."""
        now_us = self.vehicle.time_us
        for link in self.links:
            if now_us >= link.resting_until_us:
                try:
                    data = link.link.recv()
                    if data is not None:
                        self._receive(link, data)
                        self._housekeeping_us = now_us
                except (PeerLost, LinkClosed):
                    self._peer_lost(link)

    def say(self, severity: Severity, text: str) -> None:
        """Send a text to every ground station that is there."""
        for link in self.links:
            link.texts.append((self.vehicle.time_us, severity, text))

    def say_at_times(self, severity: Severity, topic: str, text: str) -> None:
        """Send a text, one on a topic at most once a second: for what a stream of messages brings up."""
        now_us = self.vehicle.time_us
        if now_us - self._said_us.get(topic, -_REPEAT_US) >= _REPEAT_US:
            self._said_us[topic] = now_us
            self.say(severity, text)

    def acknowledge(self, command: int, result: Result, sysid: int, compid: int) -> None:
        """Send the one COMMAND_ACK of a command, on every link where its sender was heard."""
        for link in self.links:
            if (sysid, compid) in link.peers:
                link.send(
                    "COMMAND_ACK",
                    {
                        "command": command,
                        "result": int(result),
                        "target_system": sysid,
                        "target_component": compid,
                    },
                )

    def is_for_us(self, msg: Any, *, any_component: bool = False) -> bool:
        """Return whether a message's target is this vehicle, or everybody."""
        return msg.target_system in (0, self.sysid) and (any_component or msg.target_component in (0, self.compid))

    def hears_gcs(self) -> bool:
        """Return whether a ground station is there on any link."""
        return any(link.hears_gcs(self.vehicle.time_us) for link in self.links)

    def _receive(self, link: ServerLink, data: bytes | None) -> None:
        """Handle what came in on a link; a flood is left for the next ticks."""
        for _ in range(_DATAGRAMS_PER_TICK):
            if data is None:
                return
            for msg in link.connection.receive(data):
                self._handle(link, msg)
            data = link.link.recv()
        if data is not None:
            for msg in link.connection.receive(data):
                self._handle(link, msg)

    def _handle(self, link: ServerLink, msg: Message) -> None:
        link.peers.add((msg.sysid, msg.compid))
        handler = self._handlers.get(msg.name)
        if handler is None:
            return
        try:
            handler(link, msg)
        except (PeerLost, LinkClosed):
            raise
        except Exception as error:
            self._defect(msg.name, error)

    def _defect(self, where: str, error: Exception) -> None:
        """Count and say a bug: a vehicle in the air outlives a message that nobody thought of."""
        if self.strict:
            raise error
        self.defects += 1
        self.say_at_times(Severity.ERROR, where, f"{where} hit a defect: {type(error).__name__}: {error}")

    def _keep_house(self) -> None:
        """Send texts and parameters that wait."""
        now_us = self.vehicle.time_us
        for text in self.vehicle.autopilot.take_texts():
            self.say(text.severity, text.text)
        for notice in self._params.take_notices():
            self.say_at_times(Severity.WARNING, "parameters", notice)
        for link in self.links:
            if now_us < link.resting_until_us:
                continue
            try:
                if link.texts:
                    link.send_texts(now_us)
                for name, fields in self._params.poll(link.link_id, now_us):
                    link.send(name, fields)
            except (PeerLost, LinkClosed):
                self._peer_lost(link)

    def _peer_lost(self, link: ServerLink) -> None:
        """Forget who was there; a listening link may get another peer, so try again a little later."""
        link.peers.clear()
        link.gcs_seen_us = None
        link.resting_until_us = self.vehicle.time_us + _LOST_PEER_PAUSE_US

    def _heartbeat(self, link: ServerLink, msg: Any) -> None:
        if msg.type == _MAV_TYPE_GCS:
            link.gcs_seen_us = self.vehicle.time_us

    def _parameter(self, link: ServerLink, msg: Any) -> None:
        for name, fields in self._params.handle(msg, link.link_id, self.vehicle.time_us):
            link.send(name, fields)

    def _timesync(self, link: ServerLink, msg: Any) -> None:
        """Answer a request with nanoseconds of vehicle time; the target does not matter, as on a PX4."""
        if msg.tc1 == 0:
            target = {"target_system": msg.sysid, "target_component": msg.compid}
            link.send("TIMESYNC", {"tc1": self.vehicle.time_us * 1000, "ts1": msg.ts1, **target})

    def _ping(self, link: ServerLink, msg: Any) -> None:
        """Return a PING that is meant for everybody; others are answers."""
        if msg.target_system == 0 and msg.target_component == 0:
            fields = {"time_usec": msg.time_usec, "seq": msg["seq"]}
            link.send("PING", {**fields, "target_system": msg.sysid, "target_component": msg.compid})


def _float32(value: Any) -> Any:
    """Return floats that float32 cannot hold as infinities, alone or in a sequence; anything else as it is."""
    if isinstance(value, float) and abs(value) > _LARGEST_FLOAT32:
        return math.copysign(math.inf, value)
    if isinstance(value, (tuple, list)):
        return [_float32(one) for one in value]
    return value
