"""ParamClient: the ground's side of MAVLink's parameter protocol, made for links that lose and delay packets.

    client = ParamClient(target_system=1, target_component=1)
    operation = client.start_set("MC_ROLLRATE_P", 0.17, "REAL32", read_back=True)
    while not operation.done:
        for name, fields in client.poll(now_us):
            link.send(connection.encode(name, **fields))
        for message in received:
            client.handle(message, now_us)
    operation.result.outcome    # VERIFIED, REFUSED, TIMEOUT or MISMATCH

Messages in, messages out: no socket, no clock; `now_us` is vehicle time. A set is VERIFIED only when the
vehicle has stated the very bits that were sent, after they were sent.

PARAM_VALUE does not say which request it answers, and a doubled PARAM_SET may arrive late. So a set waits
until every packet of an older set of that parameter to another value must have died (LIFETIME_US), and where
the wanted value was there before, its answers count only when the old ones must have died too. On links whose
packets live no longer than that, VERIFIED means the vehicle holds the value.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from bridge.messages import Message
from bridge.param_operation import SILENT_TRIES, TIMEOUT_US, Outcome, ParamList, ParamOperation, ParamValue
from bridge.param_protocol import HASH_NAME, NO_INDEX, TYPE_NUMBERS, Outgoing, ParamError
from sitl.errors import UsageError
from sitl.parameters import NAME_LENGTH, ParameterType, to_raw

LIFETIME_US: Final = 500_000
"""Longest time a packet is taken to spend on its way, us of vehicle time."""

TRIES: Final = 20
"""Sends after which one request is given up although the vehicle does answer others."""

_TYPES: Final[dict[int, ParameterType]] = {number: type_ for type_, number in TYPE_NUMBERS.items()}
_TRACE_LENGTH: Final = 16


class ParamClient:
    """Reads and sets the parameters of one component of one vehicle.

    Args:
        target_system: the vehicle.
        target_component: its component, 1 for an autopilot.
        window: sets and reads in flight at once; those of one name go one after the other.
        own_system: our system; with it, refusals addressed to others are not taken for ours.
    """

    def __init__(
        self, target_system: int, target_component: int, *, window: int = 10, own_system: int | None = None
    ) -> None:
        self.target_system = target_system
        self.target_component = target_component
        self.window = window
        self.own_system = own_system
        self.known: dict[str, ParamValue] = {}
        """Last value heard of every parameter, whatever the reason it was sent."""
        self.hash: int | None = None
        """Last `_HASH_CHECK` heard."""
        self._waiting: deque[ParamOperation] = deque()
        self._active: dict[str, ParamOperation] = {}
        self._list: ParamList | None = None
        self._verified: dict[str, ParamValue] = {}
        self._traces: dict[str, dict[ParamValue, int]] = {}  # by name, the values of `_note`
        self._refused_us: dict[str, int] = {}
        self._heard_us = -1

    @property
    def busy(self) -> bool:
        """Whether anything is under way."""
        return bool(self._waiting or self._active or self._list is not None)

    def start_set(
        self, name: str, value: float | int | bytes, type_: ParameterType, *, read_back: bool = False
    ) -> ParamOperation:
        """Begin to set a parameter.

        Args:
            name: its name.
            value: a number, or the four bytes that `ParamValue.raw` gave, which restores any value exactly.
            type_: the type the vehicle gives it.
            read_back: after the echo, ask for the value once more before it counts.

        Raises:
            WrongParameterType, UnstorableValue: from a value that the type cannot hold.
            UsageError: a name that MAVLink cannot carry.
        """
        raw = bytes(value) if isinstance(value, bytes) and len(value) == 4 else to_raw(name, type_, value)
        return self._start(ParamOperation(name, ParamValue(type_, raw), read_back))

    def start_read(self, name: str) -> ParamOperation:
        """Begin to read one parameter; the value is `result.seen`. Raises UsageError as `start_set`."""
        return self._start(ParamOperation(name, None, False))

    def start_read_all(self) -> ParamList:
        """Begin to read every parameter; one such reading at a time, a new one takes the old one's place."""
        if self._list is not None:
            self._list.end(Outcome.TIMEOUT, "a new reading was begun")
        self._list = ParamList(self.target_system, self.target_component, window=self.window)
        return self._list

    def drifted(self) -> dict[str, tuple[ParamValue, ParamValue]]:
        """Parameters set and VERIFIED whose last value heard is another: name -> (set, heard).

        Some modules of PX4 correct a value half a second after it was set.
        """
        pairs = {name: (wanted, self.known[name]) for name, wanted in self._verified.items()}
        return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}

    def handle(self, msg: Message, now_us: int) -> None:
        """Take a message from the link; anything but the target's PARAM_VALUE and PARAM_ERROR is ignored.

        Args:
            msg: the message.
            now_us: vehicle time, us.
        """
        if msg.name not in ("PARAM_VALUE", "PARAM_ERROR"):
            return
        if (msg.sysid, msg.compid) != (self.target_system, self.target_component):
            return
        self._heard_us = now_us
        if msg.name == "PARAM_ERROR":
            if self.own_system in (None, msg.target_system):
                self._refused(msg.param_id, msg.error, now_us)
        elif msg.param_id == HASH_NAME:
            self.hash = int.from_bytes(msg.raw("param_value"), "little")
            if self._list is not None:
                self._list.heard(None, "", None, msg.param_count, now_us)
        elif msg.param_type in _TYPES:
            value = ParamValue(_TYPES[msg.param_type], msg.raw("param_value"))
            index = None if msg.param_index == NO_INDEX else msg.param_index
            if self._list is not None:
                self._list.heard(index, msg.param_id, value, msg.param_count, now_us)
            self._stated(msg.param_id, value, now_us)

    def poll(self, now_us: int) -> list[Outgoing]:
        """Messages to send now: first sends, repeats, read-backs. Call it every tick.

        Args:
            now_us: vehicle time, us.
        """
        if not self.busy:
            return []
        out: list[Outgoing] = []
        for operation in [each for each in self._active.values() if now_us >= each.deadline_us]:
            self._send(operation, now_us, out)
        if self._waiting and len(self._active) < self.window:
            self._fill(now_us, out)
        if self._list is not None:
            out.extend(self._list.poll(now_us))
            if self._list.done:
                self._list = None
        return out

    def _start(self, operation: ParamOperation) -> ParamOperation:
        name = operation.name
        if not name.isascii() or not 1 <= len(name) <= NAME_LENGTH:
            raise UsageError(f"parameter name {name!r}: MAVLink carries 1 to {NAME_LENGTH} ASCII characters")
        self._waiting.append(operation)
        return operation

    def _fill(self, now_us: int, out: list[Outgoing]) -> None:
        """Let waiting operations begin, in order, while the window has room and their name is free."""
        held: list[ParamOperation] = []
        while self._waiting and len(self._active) < self.window:
            operation = self._waiting.popleft()
            others_us = self._others_us(operation)
            if operation.name in self._active or now_us < others_us:
                held.append(operation)
                continue
            self._active[operation.name] = operation
            operation.started_us = now_us
            known = operation.wanted in self._traces.get(operation.name, ())
            operation.trust_us = others_us + LIFETIME_US if known else now_us
            self._send(operation, now_us, out)
        self._waiting.extendleft(reversed(held))

    def _others_us(self, operation: ParamOperation) -> int:
        """Latest time at which the vehicle may have taken, or stated, another value than a set wants."""
        if operation.wanted is None:
            return -LIFETIME_US
        trace = self._traces.get(operation.name, {})
        others = [time_us for value, time_us in trace.items() if value != operation.wanted]
        return max(others, default=-LIFETIME_US)

    def _send(self, operation: ParamOperation, now_us: int, out: list[Outgoing]) -> None:
        """Send or repeat the request of an operation, or end it when that has been done often enough."""
        operation.contrary += operation.differed
        operation.differed = False
        silent = self._heard_us < operation.started_us
        if operation.tries >= (SILENT_TRIES if silent else TRIES) or operation.contrary >= SILENT_TRIES:
            self._give_up(operation, silent)
            return
        operation.tries += 1
        operation.deadline_us = now_us + TIMEOUT_US
        target = {"target_system": self.target_system, "target_component": self.target_component}
        if operation.wanted is None or operation.reading:
            out.append(("PARAM_REQUEST_READ", {**target, "param_id": operation.name, "param_index": -1}))
            return
        wanted = operation.wanted
        self._note(operation.name, wanted, now_us + LIFETIME_US)
        fields = {
            "param_id": operation.name,
            "param_value": wanted.raw,
            "param_type": TYPE_NUMBERS[wanted.type],
        }
        out.append(("PARAM_SET", {**target, **fields}))

    def _give_up(self, operation: ParamOperation, silent: bool) -> None:
        del self._active[operation.name]
        seen = operation.seen
        asked = f"asked {operation.tries} times in {operation.tries * TIMEOUT_US / 1e6:g} s"
        if seen is not None and seen != operation.wanted:
            operation.end(Outcome.MISMATCH, f"the vehicle keeps {seen} ({seen.type}), {asked}")
        elif seen is not None:
            operation.end(Outcome.TIMEOUT, f"echoed once, but the read-back had no answer, {asked}")
        elif silent:
            operation.end(Outcome.TIMEOUT, f"no answer, {asked}")
        else:
            hint = "an older autopilot says nothing to an unknown name or a wrong type"
            operation.end(Outcome.TIMEOUT, f"no answer to this one, though to others, {asked}: {hint}")

    def _refused(self, name: str, code: int, now_us: int) -> None:
        """PARAM_ERROR: the operation of that name ends, unless the refusal may be an earlier one's."""
        operation = self._active.get(name)
        stale = now_us < self._refused_us.get(name, -LIFETIME_US) + LIFETIME_US
        if operation is None or (stale and operation.tries < 2):
            return
        del self._active[name]
        self._refused_us[name] = now_us
        known = code in list(ParamError)
        what = ParamError(code).name.lower().replace("_", " ") if known else "for an unknown reason"
        operation.end(Outcome.REFUSED, f"PARAM_ERROR {code} ({what})")

    def _stated(self, name: str, value: ParamValue, now_us: int) -> None:
        """PARAM_VALUE: compare with what is wanted of that name."""
        self.known[name] = value
        self._note(name, value, now_us)
        operation = self._active.get(name)
        if operation is None:
            return
        if operation.wanted is not None and value != operation.wanted:
            operation.seen = value
            operation.differed = True
            operation.reading = False
            return
        if now_us < operation.trust_us:
            return
        operation.seen = value
        operation.differed = False
        if operation.read_back and not operation.reading:
            operation.reading = True
            operation.deadline_us = now_us
            return
        del self._active[name]
        if operation.wanted is not None:
            self._verified[name] = value
        operation.end(Outcome.VERIFIED)

    def _note(self, name: str, value: ParamValue, time_us: int) -> None:
        """Remember until when the vehicle may have taken or stated a value."""
        trace = self._traces.setdefault(name, {})
        trace[value] = max(time_us, trace.pop(value, time_us))
        if len(trace) > _TRACE_LENGTH:
            del trace[next(iter(trace))]
