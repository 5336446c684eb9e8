"""The vehicle's MAVLink face: what a ground station takes for a PX4.

    server = VehicleServer(vehicle, [ServerLink(link, connection, 0, "memory")])
    while flying:
        server.step()        # one tick of the vehicle, then one of its links

Everything happens in vehicle time and in the caller's thread: each tick reads every link, answers, and sends
the telemetry that is due. Services (bridge.services) and handlers hang on a table from message name to handler, so
a new one adds its names and nothing else changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from bridge.commands import Commands
from bridge.connection import Message
from bridge.errors import LinkClosed, PeerLost
from bridge.flight_log import FlightLog
from bridge.forwarding import Forwarder
from bridge.manual_control import ManualControl
from bridge.offboard import OffboardSetpoints
from bridge.server_link import ServerLink
from bridge.services import Service, Services, VehicleFiles
from bridge.telemetry import Source
from bridge.text_budget import TextBudget
from sitl.modes import Mode, Result, Severity
from sitl.vehicle import Vehicle

__all__ = ["ServerLink", "VehicleServer"]

_MAV_TYPE_GCS = 6
_BURST_US = 4_000
_SLOW_US = 20_000
"""How often services are asked for what is due: while one sends in bursts, and otherwise."""
_REPEAT_US = 1_000_000
_MESSAGES_PER_TICK = 32
_ANSWERS_PER_TICK = 128
_BYTES_PER_TICK = 4_096
"""What one link is listened to before the vehicle flies on: 8000 messages a second, or 1 MB. More waits its turn, and
is lost where its wire loses what is not read; so whoever floods one link does not keep the vehicle from the others."""

_QUIET_US = 100_000
"""A stream that is silent for so long does not go on with the frame it has begun."""
_PEERS_KEPT = 128
_PUT_OFF_MOST = 10
_LOST_PEER_PAUSE_US = 100_000


class VehicleServer:
    """Serves one vehicle on any number of links.

    Args:
        vehicle: the vehicle; `step` advances it, or the caller does and calls `tick`.
        links: its links, all with the same system and component id.
        utc_boot_us: UTC of vehicle time zero in microseconds, for SYSTEM_TIME; 0 = unknown.
        strict: let a defect in a handler out of `tick` instead of counting it. Tests are strict.
        files: what the vehicle keeps on disk.

    Attributes:
        source: what telemetry is made of.
        services: parameters, plans, files, logs, events.
        forwarder: passes frames on between the links.
        refusals: messages that made no sense to a handler here; `refused` counts those of the services, too.
        defects: handlers that failed on a message; 0 unless there is a bug in here.
        behind: the next tick is due already. What is sent in bursts then waits, or ticks that are made up for would
            send it faster than anybody can read; it waits for ten of them at most.
        shutdown_asked: a ground station asked the vehicle to switch off.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        links: Sequence[ServerLink],
        *,
        utc_boot_us: int = 0,
        strict: bool = False,
        files: VehicleFiles = VehicleFiles(),  # noqa: B008 - frozen
    ) -> None:
        self.vehicle = vehicle
        self.links = list(links)
        self.sysid = self.links[0].connection.sysid if self.links else 1
        self.compid = self.links[0].connection.compid if self.links else 1
        self.strict = strict
        self.defects = 0
        self.refusals = 0
        self.shutdown_asked = False
        self.behind = False
        self._put_off = 0
        self._said_us: dict[str, int] = {}
        self._texts, self._own_texts = TextBudget(), TextBudget()
        self._acknowledged: list[tuple[int, Result, int, int]] = []
        self._log: FlightLog | None = None
        self.services = Services(
            vehicle,
            self.links,
            sysid=self.sysid,
            compid=self.compid,
            say=self.say,
            say_at_times=self.say_at_times,
            files=files,
            utc_boot_us=utc_boot_us,
        )
        self.source = Source(vehicle, self.sysid, utc_boot_us)
        self.source.metadata = self.services.metadata
        self.services.events.report(Severity.INFO, "Sensors and estimator are starting", vehicle.time_us)
        self.forwarder = Forwarder(self.links, system_id=self.sysid, component_id=self.compid, lost=self._peer_lost)
        self._log = self.services.log
        self._forwards = len(self.links) > 1
        self._housekeeping_us = self._slow_us = 0
        self.commands = Commands(self)
        self._handlers: dict[str, Callable[[ServerLink, Any], None]] = {
            "HEARTBEAT": self._heartbeat,
            "COMMAND_LONG": self.commands.handle,
            "COMMAND_INT": self.commands.handle,
            "SET_MODE": self.commands.handle_set_mode,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
            **OffboardSetpoints(self).handlers(),
            **ManualControl(self).handlers(),
        }
        for service in self.services.all:
            self._handlers.update(dict.fromkeys(service.HANDLES, self._carry(service)))

    @property
    def refused(self) -> int:
        """Messages that were for us and made no sense."""
        return self.refusals + self.services.refused

    def step(self) -> None:
        """Take what has come, advance the vehicle by one tick, then send what is due.

        In this order a set-point sent after the telemetry of tick k is flown by the attitude law of tick k + 1 and
        reaches the motors at k + 2, as measured on a PX4 in lockstep.
        """
        self.listen()
        self.advance()

    def advance(self) -> None:
        """Advance the vehicle by one tick, log it, and send what is due."""
        self.vehicle.step()
        if self._log is not None:
            self._log.tick()
        self.speak()

    def tick(self) -> None:
        """Read every link, answer, send what is due."""
        self.listen()
        self.speak()

    def speak(self) -> None:
        """Send the telemetry, texts and parameters that are due on every link."""
        now_us = self.vehicle.time_us
        if self._acknowledged:
            self._send_acknowledgements()
        for link in self.links:
            if now_us >= link.resting_until_us:
                self.source.link = link
                try:
                    link.schedule.run(now_us, self.source, link.send)
                except (PeerLost, LinkClosed):
                    self._peer_lost(link)
                except Exception as error:
                    self._defect("telemetry", error)
        if now_us >= self._housekeeping_us:
            self._housekeeping_us = now_us + (_BURST_US if self._keep_house() else _SLOW_US)

    def listen(self) -> None:
        """Read every link and answer; between two ticks this makes answers quicker than the tick is long."""
        now_us = self.vehicle.time_us
        for link in self.links:
            if now_us >= link.resting_until_us:
                try:
                    data = None if link.waiting else link.link.recv()
                    if data is not None or link.waiting:
                        link.heard_us = now_us
                        self._receive(link, data)
                        self._housekeeping_us = now_us
                    elif link.connection.pending and now_us - link.heard_us >= _QUIET_US:
                        link.waiting.extend(link.connection.flush())
                        self._receive(link, None)
                except (PeerLost, LinkClosed):
                    self._peer_lost(link)
                except Exception as error:
                    self._defect("link", error)

    def close(self) -> None:
        """End what is being written; the links stay open. Raises FileError as `Services.close`."""
        self._send_acknowledgements()
        self.services.close()

    def say(self, severity: Severity, text: str) -> None:
        """Say what somebody's message has brought about; there is only room for so much of that."""
        if self._texts.allows(text, self.vehicle.time_us):
            self._say(severity, text)

    def _say(self, severity: Severity, text: str) -> None:
        """Send a text to every ground station that is there, and as an event what is one.

        A text that ends with a TAB is one that ground stations with events drop; if it is none of ours it keeps no TAB.
        """
        now_us = self.vehicle.time_us
        if self._log is not None:
            self._log.text(int(severity), text.rstrip("\t"))
        if text.endswith("\t") and not self.services.events.report(severity, text[:-1], now_us):
            text = text[:-1]
        for link in self.links:
            link.texts.append((now_us, severity, text))

    def say_at_times(self, severity: Severity, topic: str, text: str) -> None:
        """Send a text, one on a topic at most once a second: for what a stream of messages brings up."""
        now_us = self.vehicle.time_us
        if now_us - self._said_us.get(topic, -_REPEAT_US) >= _REPEAT_US:
            self._said_us[topic] = now_us
            self.say(severity, text)

    def acknowledge(self, command: int, result: Result, sysid: int, compid: int, *, now: bool = False) -> None:
        """Send the one COMMAND_ACK of a command, on every link where its sender was heard.

        Args:
            command: MAV_CMD. result: what became of it. sysid, compid: who sent it.
            now: before anything else that came with it is read; otherwise after, as when a PX4's commander has
                taken its turn.
        """
        if now:
            self._acknowledge(command, result, sysid, compid)
        else:
            self._acknowledged.append((command, result, sysid, compid))

    def _send_acknowledgements(self) -> None:
        while self._acknowledged:
            self._acknowledge(*self._acknowledged.pop(0))

    def _acknowledge(self, command: int, result: Result, sysid: int, compid: int) -> None:
        fields = {"command": command, "result": int(result), "target_system": sysid, "target_component": compid}
        for link in self.links:
            if (sysid, compid) in link.peers:
                try:
                    link.send("COMMAND_ACK", fields)
                except (PeerLost, LinkClosed):
                    self._peer_lost(link)

    def is_for_us(self, msg: Any, *, any_component: bool = False) -> bool:
        """Return whether a message's target is this vehicle, or everybody."""
        return msg.target_system in (0, self.sysid) and (any_component or msg.target_component in (0, self.compid))

    def hears_gcs(self) -> bool:
        """Return whether a ground station is there on any link."""
        return any(link.hears_gcs(self.vehicle.time_us) for link in self.links)

    def _receive(self, link: ServerLink, data: bytes | None) -> None:
        """Handle what came in on a link, and more while there is room for it.

        Args:
            link: the link. data: what was read already.
        """
        connection, waiting = link.connection, link.waiting
        most_sent = connection.sent + _ANSWERS_PER_TICK
        messages, room = _MESSAGES_PER_TICK, _BYTES_PER_TICK
        while messages > 0 and connection.sent < most_sent:
            if waiting:
                messages -= 1
                self._handle(link, waiting.popleft())
                continue
            if data is None and (room <= 0 or (data := link.link.recv()) is None):
                return
            room -= len(data)
            waiting.extend(connection.receive(data))
            messages -= not waiting  # to look through nonsense is work, too
            data = None

    def _handle(self, link: ServerLink, msg: Message) -> None:
        sender = (msg.sysid, msg.compid)
        if sender not in link.peers:
            if len(link.peers) >= _PEERS_KEPT:
                link.peers.pop()
            link.peers.add(sender)
        if self._forwards:
            self.forwarder.route(link, msg, self.vehicle.time_us)
        handler = self._handlers.get(msg.name)
        if handler is None:
            return
        try:
            handler(link, msg)
        except (PeerLost, LinkClosed):
            raise
        except Exception as error:
            self._defect(msg.name, error)

    def _carry(self, service: Service) -> Callable[[ServerLink, Any], None]:
        """Return the handler that carries a service's messages."""

        def handle(link: ServerLink, msg: Any) -> None:
            for name, fields in service.handle(msg, link.link_id, self.vehicle.time_us):
                link.send(name, fields)

        return handle

    def _defect(self, where: str, error: Exception) -> None:
        """Count and say a bug: a vehicle in the air outlives a message that nobody thought of."""
        if self.strict:
            raise error
        self.defects += 1
        self.say_at_times(Severity.ERROR, where, f"{where} hit a defect: {type(error).__name__}: {error}")

    def _keep_house(self) -> bool:
        """Send texts, parameters, files and whatever else waits; return whether there is likely to be more at once."""
        now_us = self.vehicle.time_us
        # items of a mission may be reached one right after the other
        busy = self._put_off > 0 or self.vehicle.autopilot.mode is Mode.MISSION
        for text in self.vehicle.autopilot.take_texts():
            if self._own_texts.allows(text.text, now_us):
                self._say(text.severity, text.text)
        self._put_off = self._put_off + 1 if self.behind and self._put_off < _PUT_OFF_MOST else 0
        services = () if self._put_off else self.services.bursting
        if now_us >= self._slow_us:
            self._slow_us = now_us + _SLOW_US
            if self.hears_gcs():
                self.vehicle.autopilot.gcs_heard()
            self.services.poll(now_us)
            self.commands.ground.poll(now_us)
            services = self.services.all
        for link in self.links:
            if now_us < link.resting_until_us:
                continue
            try:
                if link.texts:
                    link.send_texts(now_us)
                for service in services:
                    busy = self._poll(service, link, now_us) or busy
            except (PeerLost, LinkClosed):
                self._peer_lost(link)
        return busy

    def _poll(self, service: Service, link: ServerLink, now_us: int) -> bool:
        """Send what a service owes a link; return whether there was anything. A defect keeps no other from its turn."""
        busy = False
        try:
            for name, fields in service.poll(link.link_id, now_us):
                link.send(name, fields)
                busy = True
        except (PeerLost, LinkClosed):
            raise
        except Exception as error:
            self._defect("housekeeping", error)
        return busy

    def _peer_lost(self, link: Any) -> None:
        """Forget who was there; a listening link may get another peer, so try again a little later."""
        link.peers.clear()
        link.waiting.clear()
        link.gcs_seen_us = None
        link.resting_until_us = self.vehicle.time_us + _LOST_PEER_PAUSE_US
        self.forwarder.forget(link.link_id)
        for service in self.services.all:
            service.forget(link.link_id)

    def _heartbeat(self, link: ServerLink, msg: Any) -> None:
        if msg.type == _MAV_TYPE_GCS:
            link.gcs_seen_us = self.vehicle.time_us

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
