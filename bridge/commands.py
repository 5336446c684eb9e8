"""Commands to the vehicle: COMMAND_LONG, COMMAND_INT and SET_MODE, each answered by one COMMAND_ACK.

Rules are PX4's (src/modules/mavlink/mavlink_receiver.cpp, src/modules/commander/Commander.cpp) but for three:
DO_SET_MODE is acknowledged once and not twice, a command that PX4 leaves unanswered for a payload that is not
there is UNSUPPORTED, and what this vehicle does not fly is refused with a text that says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from bridge.identity import REQUESTED
from bridge.px4_modes import CUSTOM, PX4_MODES, Px4Mode, UnknownModeError, asked_mode, split_custom_mode
from bridge.streams import HEARTBEAT_ID, STREAMS
from sitl.modes import AVAILABLE, Mode, Result, Severity

if TYPE_CHECKING:
    from bridge.vehicle_server import ServerLink, VehicleServer

_INT32_MAX = 2**31 - 1
_NAN_BITS = 0x7FF80000  # a NaN double's upper half: what a broken converter leaves in x and y
_FORCE = 21196
_MESSAGE_INTERVAL_ID = 244
_RELATIVE_FRAMES = (3, 6)  # MAV_FRAME_GLOBAL_RELATIVE_ALT, ..._INT
_LOCAL_FRAMES = (1, 7, 8, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21)


class Cmd(IntEnum):
    """MAV_CMD numbers that this vehicle does something with."""

    NAV_RETURN_TO_LAUNCH = 20
    NAV_LAND = 21
    NAV_TAKEOFF = 22
    DO_SET_MODE = 176
    DO_SET_HOME = 179
    DO_FLIGHTTERMINATION = 185
    DO_REPOSITION = 192
    PREFLIGHT_CALIBRATION = 241
    PREFLIGHT_STORAGE = 245
    PREFLIGHT_REBOOT_SHUTDOWN = 246
    DO_SET_STANDARD_MODE = 262
    MISSION_START = 300
    ACTUATOR_TEST = 310
    COMPONENT_ARM_DISARM = 400
    RUN_PREARM_CHECKS = 401
    GET_HOME_POSITION = 410
    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_PROTOCOL_VERSION = 519
    REQUEST_AUTOPILOT_CAPABILITIES = 520
    REQUEST_FLIGHT_INFORMATION = 528


_ANY_COMPONENT = (Cmd.REQUEST_AUTOPILOT_CAPABILITIES, Cmd.REQUEST_PROTOCOL_VERSION)
_OLD_REQUESTS = {
    Cmd.GET_HOME_POSITION: 242,
    Cmd.REQUEST_PROTOCOL_VERSION: 300,
    Cmd.REQUEST_AUTOPILOT_CAPABILITIES: 148,
    Cmd.REQUEST_FLIGHT_INFORMATION: 264,
}


@dataclass(frozen=True)
class Command:
    """A command, however it came.

    Attributes:
        number: MAV_CMD.
        params: param1 to param7; a COMMAND_INT's x and y in degrees (metres in a local frame), NaN for none.
        link: where it came in; requested messages go out there.
        frame: MAV_FRAME of a COMMAND_INT, None of a COMMAND_LONG (its altitude is above sea level).
    """

    number: int
    params: tuple[float, ...]
    link: ServerLink
    frame: int | None = None

    def whole(self, index: int) -> int:
        """Return param`index` rounded as PX4 does, halves away from zero; NaN is 0, infinity large."""
        value = self.params[index - 1]
        if value != value:
            return 0
        value = max(-1e12, min(1e12, value))
        return math.floor(value + 0.5) if value >= 0.0 else math.ceil(value - 0.5)


class Commands:
    """Carries out commands for one vehicle.

    Args:
        server: the vehicle's face: its links, its texts, its vehicle.
    """

    def __init__(self, server: VehicleServer) -> None:
        self._server = server
        self._autopilot = server.vehicle.autopilot
        self._actions: dict[int, Callable[[Command], Result]] = {
            Cmd.NAV_RETURN_TO_LAUNCH: lambda _: self._switch(PX4_MODES[Mode.RTL]),
            Cmd.NAV_LAND: lambda _: self._autopilot.command_land(),
            Cmd.NAV_TAKEOFF: self._take_off,
            Cmd.DO_SET_MODE: self._set_mode,
            Cmd.DO_SET_HOME: self._set_home,
            Cmd.DO_FLIGHTTERMINATION: self._terminate,
            Cmd.DO_REPOSITION: self._reposition,
            Cmd.PREFLIGHT_CALIBRATION: self._calibrate,
            Cmd.PREFLIGHT_STORAGE: self._storage,
            Cmd.PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            Cmd.DO_SET_STANDARD_MODE: self._set_standard_mode,
            Cmd.MISSION_START: self._start_mission,
            Cmd.ACTUATOR_TEST: lambda _: Result.DENIED if self._autopilot.armed else Result.UNSUPPORTED,
            Cmd.COMPONENT_ARM_DISARM: self._arm,
            Cmd.RUN_PREARM_CHECKS: lambda _: Result.ACCEPTED,
            Cmd.GET_MESSAGE_INTERVAL: self._get_interval,
            Cmd.SET_MESSAGE_INTERVAL: self._set_interval,
            Cmd.REQUEST_MESSAGE: lambda command: self._request(command, command.whole(1), command.whole(2)),
            **dict.fromkeys(_OLD_REQUESTS, self._old_request),
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
        result = self._run(link, msg)
        server.acknowledge(number, result, msg.sysid, msg.compid)

    def handle_set_mode(self, link: ServerLink, msg: Any) -> None:
        """Carry out a SET_MODE message as the DO_SET_MODE it became."""
        if msg.target_system not in (0, self._server.sysid):
            return
        main, sub = split_custom_mode(msg.custom_mode)
        command = Command(Cmd.DO_SET_MODE, (float(msg.base_mode), float(main), float(sub), 0, 0, 0, 0), link)
        self._server.acknowledge(Cmd.DO_SET_MODE, self._set_mode(command), msg.sysid, msg.compid)

    def _run(self, link: ServerLink, msg: Any) -> Result:
        command = _from_long(link, msg) if msg.name == "COMMAND_LONG" else _from_int(link, msg)
        if command is None:
            return Result.DENIED
        action = self._actions.get(command.number)
        return Result.UNSUPPORTED if action is None else action(command)

    # Flying

    def _arm(self, command: Command) -> Result:
        wish = command.whole(1)
        if wish not in (0, 1):
            self._server.say(Severity.CRITICAL, f"Unsupported ARM_DISARM param: {command.params[0]:.3f}")
            return Result.UNSUPPORTED
        # The force number disarms in the air; it never skips the checks before arming.
        force = wish == 0 and command.whole(2) == _FORCE
        return self._autopilot.command_arm(wish == 1, force=force)

    def _take_off(self, command: Command) -> Result:
        altitude_m = command.params[6]
        if not math.isfinite(altitude_m):
            return self._autopilot.command_takeoff(None)
        if command.frame in _RELATIVE_FRAMES:
            home = self._autopilot.home
            altitude_m += self._server.vehicle.origin[2] if home is None else home.alt_m
        return self._autopilot.command_takeoff(altitude_m)

    def _set_mode(self, command: Command) -> Result:
        base_mode, main, sub = (command.whole(index) for index in (1, 2, 3))
        try:
            mode = asked_mode(base_mode & 0xFF, main, sub)
        except UnknownModeError as error:
            self._server.say(Severity.CRITICAL, str(error))
            return Result.TEMPORARILY_REJECTED
        return self._switch(mode)

    def _set_standard_mode(self, command: Command) -> Result:
        wish = command.whole(1)
        for mode in PX4_MODES.values():
            if wish and mode.standard_mode == wish:
                return self._switch(mode)
        return Result.UNSUPPORTED

    def _switch(self, mode: Px4Mode) -> Result:
        if mode.nav_state not in AVAILABLE:
            names = ", ".join(PX4_MODES[available].name for available in AVAILABLE)
            self._server.say(Severity.CRITICAL, f"{mode.name} is not flown by this vehicle: {names} are")
            return Result.TEMPORARILY_REJECTED
        return self._autopilot.command_mode(Mode(mode.nav_state))

    def _reposition(self, command: Command) -> Result:
        if not command.whole(2) & CUSTOM:
            return Result.UNSUPPORTED
        if all(math.isnan(value) for value in command.params[4:7]):
            return self._switch(PX4_MODES[Mode.LOITER])  # how a ground station says "pause"
        self._server.say(Severity.CRITICAL, "Reposition is not flown by this vehicle: Hold stays where it is")
        return Result.TEMPORARILY_REJECTED

    def _set_home(self, command: Command) -> Result:
        if command.whole(1) == 1:
            return self._autopilot.command_set_home_here()
        self._server.say(Severity.CRITICAL, "Home can only be set where the vehicle is (param1 = 1)")
        return Result.DENIED

    def _terminate(self, command: Command) -> Result:
        if command.whole(1) != 1 or not self._autopilot.armed:
            return Result.DENIED
        return self._autopilot.command_terminate(True)

    def _start_mission(self, _: Command) -> Result:
        self._server.say(Severity.CRITICAL, "Mission start denied! No valid mission")
        return Result.DENIED

    # Before flight

    def _calibrate(self, command: Command) -> Result:
        if self._autopilot.armed:
            return Result.TEMPORARILY_REJECTED
        asked = any(value not in (0.0,) and value == value for value in command.params)
        return Result.UNSUPPORTED if asked else Result.ACCEPTED

    def _storage(self, command: Command) -> Result:
        if self._autopilot.armed:
            return Result.TEMPORARILY_REJECTED
        if command.whole(1) in (2, 4):
            self._server.vehicle.parameters.reset(None)
            return Result.ACCEPTED
        return Result.UNSUPPORTED  # nothing outlives the process, so nothing can be loaded or saved

    def _reboot(self, command: Command) -> Result:
        wish = command.whole(1)
        if self._autopilot.armed or wish not in (0, 2):
            return Result.DENIED
        if wish == 2:
            self._server.shutdown_asked = True
        return Result.ACCEPTED

    # Messages

    def _request(self, command: Command, message_id: int, index: int) -> Result:
        """Send a message on the link the command came from; its acknowledgement follows."""
        link, server = command.link, self._server
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
        return self._request(command, _OLD_REQUESTS[Cmd(command.number)], 0)

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


def _from_long(link: ServerLink, msg: Any) -> Command | None:
    """Return the command, None for one whose place is INT32_MAX squeezed into floats."""
    x, y = msg.param5, msg.param6
    if math.isclose(x, _INT32_MAX, rel_tol=1e-6) and math.isclose(y, _INT32_MAX, rel_tol=1e-6):
        return None
    params = (msg.param1, msg.param2, msg.param3, msg.param4, x, y, msg.param7)
    return Command(msg.command, params, link)


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
    return Command(msg.command, params, link, frame=msg.frame)
