"""Commands that ask for messages: once, or at a rate. Source: PX4 src/modules/mavlink/mavlink_receiver.cpp."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bridge.identity import REQUESTED
from bridge.streams import HEARTBEAT_ID, STREAMS
from sitl.modes import Result

if TYPE_CHECKING:
    from bridge.commands import Action, Command
    from bridge.vehicle_server import ServerLink, VehicleServer

_INT32_MAX = 2**31 - 1
_MESSAGE_INTERVAL_ID = 244
_OLD_REQUESTS = {
    410: 242,  # GET_HOME_POSITION
    519: 300,  # REQUEST_PROTOCOL_VERSION
    520: 148,  # REQUEST_AUTOPILOT_CAPABILITIES
    525: 261,  # REQUEST_STORAGE_INFORMATION
    528: 264,  # REQUEST_FLIGHT_INFORMATION
}


class MessageCommands:
    """Sends what is asked for, and sets how often messages are streamed.

    Args:
        server: the vehicle's face.
    """

    def __init__(self, server: VehicleServer) -> None:
        self._server = server

    def actions(self) -> dict[int, Action]:
        """Return what carries out each MAV_CMD."""
        return {
            510: self._get_interval,
            511: self._set_interval,
            512: lambda command: self._request(command, command.whole(1), command.whole(2)),
            **dict.fromkeys(_OLD_REQUESTS, self._old_request),
        }

    def _request(self, command: Command, message_id: int, index: int) -> Result:
        """Send a message on the link the command came from; its acknowledgement follows."""
        link, server = command.link, self._server
        server.source.link = link
        if message_id == _MESSAGE_INTERVAL_ID:
            self._send_interval(link, index)
            return Result.ACCEPTED
        if message_id in REQUESTED:
            name, make = REQUESTED[message_id]
            answers = make(server.source, index)
        elif message_id in STREAMS:
            stream = STREAMS[message_id]
            name = stream.name
            fields = stream.build(server.source)
            answers = [] if fields is None else [fields]
        else:
            return Result.DENIED
        for fields in answers:
            link.send(name, fields)
        return Result.ACCEPTED if answers else Result.DENIED

    def _old_request(self, command: Command) -> Result:
        return self._request(command, _OLD_REQUESTS[command.number], 0)

    def _set_interval(self, command: Command) -> Result:
        message_id, interval_us = command.whole(1), command.whole(2)
        reserved = (command.params[2], command.params[3], command.params[6])
        if any(value == value and value != 0.0 for value in reserved):
            return Result.FAILED
        if message_id == HEARTBEAT_ID or message_id not in STREAMS:
            return Result.FAILED
        interval_us = min(interval_us, _INT32_MAX)
        command.link.schedule.set_interval(message_id, interval_us, self._server.vehicle.time_us)
        return Result.ACCEPTED

    def _get_interval(self, command: Command) -> Result:
        self._send_interval(command.link, command.whole(1))
        return Result.ACCEPTED

    def _send_interval(self, link: ServerLink, message_id: int) -> None:
        interval_us = link.schedule.interval_us(message_id)
        link.send("MESSAGE_INTERVAL", {"message_id": message_id & 0xFFFF, "interval_us": interval_us})
