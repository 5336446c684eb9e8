"""Commands to the vehicle: COMMAND_LONG, COMMAND_INT and SET_MODE, each answered by at most one COMMAND_ACK.

Rules are PX4's (src/modules/mavlink/mavlink_receiver.cpp, src/modules/commander/Commander.cpp): what another module
of a PX4 would answer, and this vehicle has not, is met with the silence of a PX4 without it. DO_SET_MODE is
acknowledged once and not twice. What flies is in flight_commands.py, what happens on the ground in
ground_commands.py, what asks for messages in message_commands.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bridge.flight_commands import FlightCommands
from bridge.ground_commands import GroundCommands
from bridge.message_commands import MessageCommands
from bridge.px4_modes import split_custom_mode
from sitl.modes import Result

if TYPE_CHECKING:
    from bridge.vehicle_server import ServerLink, VehicleServer

_INT32_MAX = 2**31 - 1
_NAN_BITS = 0x7FF80000  # a NaN double's upper half: what a broken converter leaves in x and y
_LOCAL_FRAMES = (1, 7, 8, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21)
_DO_SET_MODE = 176
_REQUEST_AUTOPILOT_CAPABILITIES, _REQUEST_PROTOCOL_VERSION = 520, 519
_ANY_COMPONENT = (_REQUEST_AUTOPILOT_CAPABILITIES, _REQUEST_PROTOCOL_VERSION)

_SILENT = frozenset(
    {
        *(0, 1, 2),  # PX4's own custom commands
        *(203, 204, 205, 206, 214, 220, 260, 521, 530, 531, 532, 1000, 1001, 2003),  # cameras and gimbals
        *(211, 30001, 30002, 42600),  # gripper, payload, winch
        *(242, 243, 311, 500),  # sensor offsets, UAVCAN, actuator set-up, receiver pairing
        *(93, 3000),  # NAV_DELAY outside a mission, VTOL transition
    }
)
"""Commands that PX4's commander leaves to modules which, where they are absent, answer nothing."""


@dataclass(frozen=True)
class Command:
    """A command, however it came.

    Attributes:
        number: MAV_CMD.
        params: param1 to param7; a COMMAND_INT's x and y in degrees (metres in a local frame), NaN for none.
        link: where it came in; requested messages go out there.
        frame: MAV_FRAME of a COMMAND_INT, None of a COMMAND_LONG (its altitude is above sea level).
        sender: (sysid, compid).
    """

    number: int
    params: tuple[float, ...]
    link: ServerLink
    frame: int | None = None
    sender: tuple[int, int] = (0, 0)

    @property
    def local(self) -> bool:
        """Are x and y metres?"""
        return self.frame in _LOCAL_FRAMES

    def whole(self, index: int) -> int:
        """Return param`index` rounded as PX4 does, halves away from zero; NaN is 0, infinity large."""
        value = self.params[index - 1]
        if value != value:
            return 0
        value = max(-1e12, min(1e12, value))
        return math.floor(value + 0.5) if value >= 0.0 else math.ceil(value - 0.5)


Action = Callable[[Command], "Result | None"]
"""Carries a command out; None: no acknowledgement."""


class Commands:
    """Carries out commands for one vehicle.

    Args:
        server: the vehicle's face: its links, its texts, its vehicle.
    """

    def __init__(self, server: VehicleServer) -> None:
        self._server = server
        self._flight = FlightCommands(server)
        self.ground = GroundCommands(server)
        self._messages = MessageCommands(server).actions()
        self._actions: dict[int, Action] = {
            **dict.fromkeys(_SILENT, _stay_silent),
            **self._flight.actions(),
            **self.ground.actions(),
            **self._messages,
        }

    def handle(self, link: ServerLink, msg: Any) -> None:
        """Carry out a COMMAND_LONG or COMMAND_INT that is meant for this vehicle and acknowledge it once.

        Silent for other systems and components, as PX4, and for an echo of our own.
        """
        server = self._server
        number = msg.command
        if not server.is_for_us(msg, any_component=number in _ANY_COMPONENT):
            return
        if msg.sysid == server.sysid and msg.compid == server.compid:
            return
        command = _from_long(link, msg) if msg.name == "COMMAND_LONG" else _from_int(link, msg)
        if command is None:
            server.acknowledge(number, Result.DENIED, msg.sysid, msg.compid)
            return
        action = self._actions.get(number)
        result = Result.UNSUPPORTED if action is None else action(command)
        if result is not None:
            # what asks for messages is answered where it is read, the rest by the commander in its turn
            server.acknowledge(number, result, msg.sysid, msg.compid, now=number in self._messages)

    def handle_set_mode(self, link: ServerLink, msg: Any) -> None:
        """Carry out a SET_MODE message as the DO_SET_MODE it became."""
        server = self._server
        if msg.target_system not in (0, server.sysid) or (msg.sysid, msg.compid) == (server.sysid, server.compid):
            return
        main, sub = split_custom_mode(msg.custom_mode)
        params = (float(msg.base_mode), float(main), float(sub), 0.0, 0.0, 0.0, 0.0)
        result = self._flight.set_mode(Command(_DO_SET_MODE, params, link, None, (msg.sysid, msg.compid)))
        self._server.acknowledge(_DO_SET_MODE, result, msg.sysid, msg.compid)


def _stay_silent(_: Command) -> None:
    return None


def _from_long(link: ServerLink, msg: Any) -> Command | None:
    """Return the command, None for one whose place is INT32_MAX squeezed into floats."""
    x, y = msg.param5, msg.param6
    if math.isclose(x, _INT32_MAX, rel_tol=1e-6) and math.isclose(y, _INT32_MAX, rel_tol=1e-6):
        return None
    params = (msg.param1, msg.param2, msg.param3, msg.param4, x, y, msg.param7)
    return Command(msg.command, params, link, None, (msg.sysid, msg.compid))


def _from_int(link: ServerLink, msg: Any) -> Command | None:
    """Return the command, None for one whose place is half of a NaN double."""
    if msg.x == _NAN_BITS and msg.y == _NAN_BITS:
        return None
    if msg.x == _INT32_MAX and msg.y == _INT32_MAX:
        x = y = math.nan
    else:
        scale = 1e-4 if msg.frame in _LOCAL_FRAMES else 1e-7
        x, y = msg.x * scale, msg.y * scale
    params = (msg.param1, msg.param2, msg.param3, msg.param4, x, y, msg.z)
    return Command(msg.command, params, link, msg.frame, (msg.sysid, msg.compid))
