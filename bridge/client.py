"""The ground's face: connect, make ready, upload gains, arm, take off, send set-points, land, restore.

Blocking calls over a `Drive`, without threads: every wait lets vehicle time pass and handles what came. All limits
are in vehicle time, except for a silent peer, which the drive gives up on in wall time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from bridge.connection import Connection, Message
from bridge.drive import Drive
from bridge.errors import CommandRefused, NotReady, PeerSilent, UploadFailed
from bridge.link import Link
from bridge.param_client import ParamClient
from bridge.param_operation import Outcome, ParamOperation, ParamResult, ParamValue
from bridge.px4_modes import PX4_MODES
from bridge.vehicle_state import VehicleState
from sitl.modes import Mode
from sitl.parameters import ParameterType

ACK_TIMEOUT_US = 500_000
ACK_TRIES = 20  # where 30 % are lost each way, half the tries fail
HEARTBEAT_US = 1_000_000
LONGEST_WAIT_US = 20_000
_MOST_AT_ONCE = 1_000
"""Datagrams handled before anything else is done: whoever sends them faster than we read must not hold us."""

CMD_NAV_LAND = 21
CMD_NAV_TAKEOFF = 22
CMD_DO_SET_MODE = 176
CMD_COMPONENT_ARM_DISARM = 400
CMD_SET_MESSAGE_INTERVAL = 511
CMD_REQUEST_MESSAGE = 512

_GCS, _INVALID_AUTOPILOT = 6, 8
_FORCE = 21196.0
_ACCEPTED, _IN_PROGRESS = 0, 5


class Client:
    """One conversation with one autopilot.

    Args:
        link: the wire.
        drive: how time passes on it.
        sysid: our system id; 255 is a ground station's.
        compid: our component id.
        log: called with (vehicle time us, frame) for every frame of both directions.

    Attributes:
        state: what the vehicle last said.
        on_text: called with (vehicle time s, severity, text) of every STATUSTEXT.
        background: called with the vehicle time (us) before every wait, returns when it is due again: a set-point
            stream that must not pause.
    """

    def __init__(
        self,
        link: Link,
        drive: Drive,
        *,
        sysid: int = 255,
        compid: int = 190,
        log: Callable[[int, bytes], object] | None = None,
    ) -> None:
        self.link = link
        self.drive = drive
        self.connection = Connection(sysid, compid, datagram=link.datagram)
        if log is not None:
            now_us = drive.now_us
            self.connection.on_frame = lambda frame: log(now_us(), frame)
        self.state = VehicleState()
        self.target_system = 0
        self.target_component = 1
        self.on_text: Callable[[float, int, str], object] | None = None
        self.background: Callable[[int], int] | None = None
        self.params = ParamClient(0, 1, own_system=sysid)
        self._acks: list[tuple[int, int]] = []
        self._next_heartbeat_us = -1
        own: dict[str, Callable[[Message], object]] = {
            **self.state.handlers(),
            "HEARTBEAT": self._on_heartbeat,
            "ATTITUDE": self._on_attitude,
            "LOCAL_POSITION_NED": self._on_local_position,
            "SYSTEM_TIME": self._on_system_time,
            "COMMAND_ACK": self._on_ack,
            "STATUSTEXT": self._on_text,
            **dict.fromkeys(("PARAM_VALUE", "PARAM_ERROR"), self._on_param),
        }
        # our own look at a message comes before any subscriber's
        self._handlers = {name: [handler] for name, handler in own.items()}

    def now_us(self) -> int:
        """Vehicle time, us."""
        return self.drive.now_us()

    def subscribe(self, name: str, handler: Callable[[Message], object]) -> None:
        """Call a handler with every message of that name, after the client has looked at it itself."""
        self._handlers.setdefault(name, []).append(handler)

    # -- time and messages -------------------------------------------------------------------------------------

    def pump(self, until_us: int | None = None) -> None:
        """Let time pass and handle what came; send our heartbeat and what the background has due.

        Args:
            until_us: vehicle time not to let pass; 20 ms from now if None, or if that is sooner.
        """
        now = self.drive.now_us()
        if now >= self._next_heartbeat_us:
            self._next_heartbeat_us = now + HEARTBEAT_US
            self.send("HEARTBEAT", type=_GCS, autopilot=_INVALID_AUTOPILOT, mavlink_version=3)
        until = now + LONGEST_WAIT_US if until_us is None or until_us > now + LONGEST_WAIT_US else until_us
        if self.background is not None:
            until = min(until, self.background(now))
        data = self.drive.wait(self.link, until)
        for _ in range(_MOST_AT_ONCE):
            if data is None:
                break
            for message in self.connection.receive(data):
                self._take(message)
            # where more comes than we can read, set-points are sent all the same
            if self.drive.now_us() > now + LONGEST_WAIT_US:
                break
            data = self.link.recv()

    def send(self, name: str, /, **fields: Any) -> None:
        """Send one message."""
        self.link.send(self.connection.encode(name, **fields))

    def wait_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Let time pass until a condition holds.

        Args:
            condition: looked at after every pump. timeout_s: vehicle time, s.

        Returns:
            whether it held in time.
        """
        deadline = self.now_us() + round(timeout_s * 1e6)
        while not condition():
            if self.now_us() >= deadline:
                return False
            self.pump(deadline)
        return True

    def wait(self, duration_s: float) -> None:
        """Let vehicle time pass, s."""
        self.wait_until(lambda: False, duration_s)

    def _take(self, message: Message) -> None:
        if message.sysid != self.target_system and (self.target_system or message.name != "HEARTBEAT"):
            return  # another system's; before the first heartbeat nobody knows whose
        for handler in self._handlers.get(message.name, ()):
            handler(message)

    def _on_param(self, message: Message) -> None:
        self.params.handle(message, self.now_us())

    def _on_heartbeat(self, m: Message) -> None:
        if m.compid != 1 or m.autopilot == _INVALID_AUTOPILOT:
            return
        if not self.target_system:
            self.target_system = m.sysid
            self.params.target_system = m.sysid
        self.state.on_heartbeat(m)

    def _on_attitude(self, m: Message) -> None:
        self.drive.heard(m.time_boot_ms * 1000)
        self.state.euler = (m.roll, m.pitch, m.yaw)
        self.state.rates = (m.rollspeed, m.pitchspeed, m.yawspeed)

    def _on_local_position(self, m: Message) -> None:
        self.drive.heard(m.time_boot_ms * 1000)
        self.state.position_ned = (m.x, m.y, m.z)
        self.state.velocity_ned = (m.vx, m.vy, m.vz)

    def _on_system_time(self, m: Message) -> None:
        self.drive.heard(m.time_boot_ms * 1000)

    def _on_ack(self, m: Message) -> None:
        self._acks.append((m.command, m.result))

    def _on_text(self, m: Message) -> None:
        text = self.state.on_text(m, self.now_us())
        if text is not None and self.on_text is not None:
            self.on_text(self.now_us() * 1e-6, m.severity, text)

    # -- connect -----------------------------------------------------------------------------------------------

    def connect(self, timeout_s: float = 10.0) -> None:
        """Wait for the autopilot's first heartbeat and for its time: from then on timeouts mean something.

        Raises:
            PeerSilent: they did not come in time (over a network: within the drive's patience).
        """
        if not self.wait_until(lambda: self.target_system != 0 and self.drive.knows_time, timeout_s):
            raise PeerSilent(self.link.name, timeout_s, "a HEARTBEAT of an autopilot (component 1)")

    def make_ready(self, timeout_s: float = 60.0) -> None:
        """Choose Hold if the vehicle is on the ground in another mode, then `wait_ready`.

        A vehicle that landed out of Offboard is in Offboard again, where no vehicle is ready without set-points.

        Raises:
            CommandRefused, PeerSilent, NotReady: as `set_mode` and `wait_ready`.
        """
        if not self.state.armed and self.state.nav_state != Mode.LOITER:
            self.set_mode(Mode.LOITER)
        self.wait_ready(timeout_s)

    def wait_ready(self, timeout_s: float = 60.0) -> None:
        """Wait for health, home and position, as one does before arming.

        Raises:
            NotReady: names what is still missing.
        """

        def missing() -> list[str]:
            state = self.state
            wanted = {
                "pre-arm checks": state.prearm_ok,
                "home position": state.home_alt_m is not None,
                "local position": state.position_ned is not None,
                "attitude": state.euler is not None,
            }
            return [what for what, there in wanted.items() if not there]

        if not self.wait_until(lambda: not missing(), timeout_s):
            raise NotReady(self.link.name, timeout_s, missing())

    # -- commands ----------------------------------------------------------------------------------------------

    def command(self, name: str, command: int, *params: float, timeout_s: float = 0.0, tries: int = ACK_TRIES) -> None:
        """Send a COMMAND_LONG and wait for its COMMAND_ACK; sent again when no answer comes.

        Args:
            name: for the error. command: MAV_CMD number. params: up to seven.
            timeout_s: longest wait after an IN_PROGRESS, s. tries: how often it is sent at most.

        Raises:
            CommandRefused: with the vehicle's own words.
            PeerSilent: no answer at all.
        """
        padded = (*params, *(0.0 for _ in range(7 - len(params))))
        texts_before = len(self.state.texts)
        for attempt in range(tries):
            self._acks.clear()
            self.send(
                "COMMAND_LONG",
                target_system=self.target_system,
                target_component=self.target_component,
                command=command,
                confirmation=attempt,
                **{f"param{i + 1}": value for i, value in enumerate(padded)},
            )
            if self.wait_until(lambda: any(acked == command for acked, _ in self._acks), ACK_TIMEOUT_US * 1e-6):
                break
        else:
            raise PeerSilent(self.link.name, tries * ACK_TIMEOUT_US * 1e-6, f"an answer to {name}")
        result = next(result for acked, result in self._acks if acked == command)
        if result == _IN_PROGRESS and timeout_s > 0.0:
            self.wait_until(lambda: (command, _ACCEPTED) in self._acks, timeout_s)
            result = self._acks[-1][1]
        if result != _ACCEPTED:
            self.wait(0.1)
            reasons = [text for _, _, text in self.state.texts[texts_before:]]
            raise CommandRefused(name, result, "; ".join(reasons))

    def set_interval(self, message_id: int, interval_us: float) -> None:
        """Stream a message at an interval in us; -1 stops it, 0 is the default."""
        self.command(f"interval of message {message_id}", CMD_SET_MESSAGE_INTERVAL, message_id, interval_us)

    def try_interval(self, message_id: int, interval_us: float) -> bool:
        """As `set_interval`, for a message the vehicle may not have; whether it has."""
        try:
            self.set_interval(message_id, interval_us)
        except CommandRefused:
            return False
        return True

    def request(self, message_id: int, *, tries: int = ACK_TRIES) -> None:
        """Ask for one message once."""
        self.command(f"request of message {message_id}", CMD_REQUEST_MESSAGE, message_id, tries=tries)

    def set_mode(self, mode: Mode) -> None:
        """Ask for a flight mode; `state.nav_state` shows it with the vehicle's next CURRENT_MODE or HEARTBEAT.

        Raises:
            CommandRefused, PeerSilent.
        """
        px4 = PX4_MODES[mode]
        self.command(f"mode {px4.name}", CMD_DO_SET_MODE, 1, px4.main, px4.sub)

    def arm(self) -> None:
        """Arm. Raises CommandRefused with the vehicle's reason."""
        self.command("arm", CMD_COMPONENT_ARM_DISARM, 1)
        self.state.armed = True  # the next heartbeat, up to a second away, says the same

    def disarm(self, *, force: bool = False) -> None:
        """Disarm; force stops the motors in the air, too."""
        self.command("disarm", CMD_COMPONENT_ARM_DISARM, 0, _FORCE if force else 0.0)
        self.state.armed = False

    def takeoff(self, height_m: float) -> None:
        """Command a take-off to a height above home, m."""
        home = self.state.home_alt_m or 0.0
        nan = math.nan
        self.command("take-off", CMD_NAV_TAKEOFF, nan, 0.0, 0.0, nan, nan, nan, home + height_m)

    def land(self) -> None:
        """Command a landing."""
        self.command("land", CMD_NAV_LAND, 0.0, 0.0, 0.0, math.nan, math.nan, math.nan, 0.0)

    def attitude_setpoint(self, quat: tuple[float, float, float, float], thrust: float) -> None:
        """Send an attitude set-point, rates ignored.

        Args:
            quat: body to world, w first. thrust: collective, 0..1.
        """
        self.send(
            "SET_ATTITUDE_TARGET",
            time_boot_ms=self.now_us() // 1000,
            target_system=self.target_system,
            target_component=self.target_component,
            type_mask=7,
            q=quat,
            thrust=thrust,
        )
        self.drive.sent_setpoint(quat)

    # -- parameters --------------------------------------------------------------------------------------------

    def read_parameters(self, names: Iterable[str], timeout_s: float = 60.0) -> dict[str, ParamValue]:
        """Read parameters one by one.

        Raises:
            UploadFailed: one that does not exist or does not come; names it.
        """
        operations = [self.params.start_read(name) for name in names]
        self._finish(operations, timeout_s)
        values = {}
        for operation in operations:
            result = operation.result
            if result is None or result.seen is None or result.outcome is not Outcome.VERIFIED:
                raise UploadFailed(operation.name, math.nan, None, result.reason if result else "no answer in time")
            values[operation.name] = result.seen
        return values

    def try_read(self, names: Iterable[str], timeout_s: float = 5.0) -> dict[str, ParamResult]:
        """Read parameters that may not exist.

        Args:
            names: of them. timeout_s: vehicle time for all, s.

        Returns:
            name -> what came of it: `seen` holds the value where the outcome is VERIFIED.
        """
        operations = [self.params.start_read(name) for name in names]
        self._finish(operations, timeout_s)
        silent = "no answer in time"
        return {
            one.name: one.result or ParamResult(one.name, Outcome.TIMEOUT, None, None, silent, one.tries)
            for one in operations
        }

    def upload(self, values: Mapping[str, tuple[float | int | bytes, ParameterType]], timeout_s: float = 60.0) -> None:
        """Set parameters and read each back; float32-exact, or it has failed.

        Args:
            values: name -> (number or raw bytes, type). timeout_s: vehicle time for all, s.

        Raises:
            UploadFailed: the first that is not on the vehicle exactly as asked.
        """
        operations = [
            self.params.start_set(name, value, type_, read_back=True) for name, (value, type_) in values.items()
        ]
        self._finish(operations, timeout_s)
        for operation in operations:
            result = operation.result
            if result is None or result.outcome is not Outcome.VERIFIED:
                wanted, _ = values[operation.name]
                shown = wanted if not isinstance(wanted, bytes) else math.nan
                seen = result.seen.value if result is not None and result.seen is not None else None
                raise UploadFailed(operation.name, shown, seen, result.reason if result else "no answer in time")

    def _finish(self, operations: list[ParamOperation], timeout_s: float) -> None:
        def finished() -> bool:
            for name, fields in self.params.poll(self.now_us()):
                self.send(name, **fields)
            return all(operation.done for operation in operations)

        self.wait_until(finished, timeout_s)
