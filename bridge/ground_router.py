"""A board's MAVLink for ground stations, while its port is taken by the simulator.

Whole frames pass byte for byte, signatures included. What does not pass: the simulator's own messages, either way, so
that nobody else moves the plant or feeds the board's sensors; more than the line can carry beside the sensors; and,
unless it was allowed, anything that arms the board or turns a motor, its shell included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bridge.connection import Connection, Message
from bridge.errors import PeerLost
from bridge.link import Link

BYTES_PER_S = 30_000
"""Most that ground stations send to the board, bytes per second: a third of a 921600 baud line."""

BURST_BYTES = 8_192

_MOST_AT_ONCE = 64
"""Datagrams of one ground station that are read before the plant goes on."""

_ARM, _SET_MODE, _CALIBRATE = 400, 176, 241
_ALWAYS_ARMING = frozenset((300, 209, 310, 183, 184, 187))
"""MISSION_START, for which a PX4 arms by itself; tests of motors and actuators; servos and actuators set outright."""
_ARMED = 128
_DENIED = 2
_ERROR = 3
_KEPT_BACK = ("HIL_ACTUATOR_CONTROLS",)
_OPAQUE = ("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE", "SERIAL_CONTROL")
"""Sticks arm by gesture and a shell by a word, and nobody can tell from one message that they do."""
_READER_SYSID, _READER_COMPID = 254, 51


class GroundRouter:
    """Passes frames between a board and ground stations.

    Args:
        grounds: their links.
        may_arm: commands that arm may pass.
        say: called with a line for people.

    Attributes:
        dropped_bytes: what ground stations sent beyond what the line has room for.
        refused_arming: commands that would have armed and were kept back.
    """

    def __init__(
        self, grounds: Sequence[Link], *, may_arm: bool = False, say: Callable[[str], object] = lambda _: None
    ) -> None:
        self.grounds = tuple(grounds)
        self.may_arm = may_arm
        self.dropped_bytes = 0
        self.refused_arming = 0
        self._say = say
        # one reader for each ground station; ids of our own are of no account, nothing is encoded but refusals
        self._readers = [Connection(_READER_SYSID, _READER_COMPID, datagram=link.datagram) for link in self.grounds]
        self._left_bytes = float(BURST_BYTES)
        self._filled_us: int | None = None

    def from_board(self, message: Message) -> None:
        """Pass a message of the board on to every ground station.

        Args:
            message: as received.
        """
        if message.name not in _KEPT_BACK:
            for link in self.grounds:
                _send(link, message.raw_frame)

    def from_grounds(self, now_us: int) -> list[bytes]:
        """What ground stations have for the board.

        Args:
            now_us: wall clock.

        Returns:
            whole frames, in order, no more than the line has room for.
        """
        frames: list[bytes] = []
        for link, reader in zip(self.grounds, self._readers, strict=True):
            for _ in range(_MOST_AT_ONCE):
                if (data := _recv(link)) is None:
                    break
                for message in reader.receive(data):
                    if self._may_pass(message, link) and self._has_room(len(message.raw_frame), now_us):
                        frames.append(message.raw_frame)
        return frames

    def _may_pass(self, message: Message, link: Link) -> bool:
        if message.name.startswith("HIL_") or (message.name in _OPAQUE and not self.may_arm):
            return False
        if self.may_arm or not arms(message):
            return True
        self.refused_arming += 1
        if self.refused_arming == 1:
            self._say("a ground station asked to arm the board: refused, that needs --arm-hardware")
        self._refuse(message, link)
        return False

    def _refuse(self, message: Message, link: Link) -> None:
        """Answer in the board's name, so that the ground station does not ask for ever."""
        voice = Connection(message.fields().get("target_system") or 1, 1)
        frames = [voice.encode("STATUSTEXT", severity=_ERROR, text="Arming refused: needs froude's --arm-hardware")]
        if message.name.startswith("COMMAND"):
            ack = {"command": message.command, "result": _DENIED}
            frames.insert(0, voice.encode_fields("COMMAND_ACK", {**ack, "target_system": message.sysid}))
        for frame in frames:
            _send(link, frame)

    def _has_room(self, size: int, now_us: int) -> bool:
        if self._filled_us is not None:
            gained = (now_us - self._filled_us) * 1e-6 * BYTES_PER_S
            self._left_bytes = min(float(BURST_BYTES), self._left_bytes + gained)
        self._filled_us = now_us
        if size > self._left_bytes:
            self.dropped_bytes += size
            return False
        self._left_bytes -= size
        return True


def arms(message: Message) -> bool:
    """Whether a message asks an autopilot to arm, or to turn a motor unarmed.

    Args:
        message: of a ground station.
    """
    if message.name in ("COMMAND_LONG", "COMMAND_INT"):
        if message.command == _ARM:
            return bool(message.param1 != 0.0)
        if message.command == _CALIBRATE:  # its last parameter is the motors' speed controllers, which then turn
            last = message.param7 if message.name == "COMMAND_LONG" else message.z
            return bool(last != 0.0)
        if message.command in _ALWAYS_ARMING:
            return True
        return bool(message.command == _SET_MODE and _armed_bit(message.param1))
    return bool(message.name == "SET_MODE" and message.base_mode & _ARMED)


def _armed_bit(value: float) -> bool:
    return 0.0 <= value < 256.0 and bool(int(value) & _ARMED)


def _send(link: Link, frame: bytes) -> None:
    try:
        link.send(frame)
    except PeerLost:
        return  # a ground station that went away is no reason to stop the plant


def _recv(link: Link) -> bytes | None:
    try:
        return link.recv(0.0)
    except PeerLost:
        return None
