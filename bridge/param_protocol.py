"""ParamServer: the vehicle's side of MAVLink's parameter protocol, as PX4 speaks it.

It answers PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET from a ParameterTable:

- An INT32 travels as its four bytes in the float field, both ways. No range is enforced: NaN is stored.
- Every PARAM_SET is echoed; a changed value is announced once more, a little later, on every link.
- A refusal is a PARAM_ERROR; a request for another system is silence, and so is target system 0.
- The list begins with `_HASH_CHECK` and is paced: one burst would overflow most clients' socket buffers.

Messages in, messages out: no socket, no clock. The ground's side is `bridge.param_client`.
Source: PX4 src/modules/mavlink/mavlink_parameters.cpp, MAVLink's parameter microservice, and answers recorded
from a PX4 SITL of May 2026.
"""

from __future__ import annotations

import enum
import math
import struct
from collections import deque
from typing import Any, Final, TypeAlias

from bridge.messages import Message
from sitl.parameters import ParameterSpec, ParameterTable, ParameterType, from_raw, range_problem

HASH_NAME: Final = "_HASH_CHECK"
"""Name under which the CRC of all parameters is sent; not a parameter of the table."""

NO_INDEX: Final = 65535
"""PARAM_VALUE.param_index of something that is not in the list."""

TYPE_UINT32: Final = 5
TYPE_NUMBERS: Final[dict[ParameterType, int]] = {"INT32": 6, "REAL32": 9}
"""MAV_PARAM_TYPE of the two types PX4 has."""

BURST_PERIOD_US: Final = 4_000
"""Time between two bursts of the list on one link, us; PX4 takes 10 ms for as many."""

ANNOUNCE_DELAY_US: Final = 20_000
"""Time from a change to its announcement, us; PX4 takes 10 to 500 ms."""

Outgoing: TypeAlias = tuple[str, dict[str, Any]]
"""A message to be encoded: its name and its fields. param_value is always the four raw bytes."""


class ParamError(enum.IntEnum):
    """PARAM_ERROR.error (MAV_PARAM_ERROR)."""

    DOES_NOT_EXIST = 1
    VALUE_OUT_OF_RANGE = 2
    PERMISSION_DENIED = 3
    COMPONENT_NOT_FOUND = 4
    READ_ONLY = 5
    TYPE_UNSUPPORTED = 6
    TYPE_MISMATCH = 7
    READ_FAIL = 8


def float_in_disguise(spec: ParameterSpec, raw: bytes) -> float | None:
    """The float whose bits an INT32 set carries, if that is what the sender must have meant, else None.

    Clients that put the number itself into the float field turn 5 into 1084227584, and PX4 stores that. It
    counts only when the number is outside what PX4 documents and its bits are a float of ordinary size.
    """
    value = from_raw("INT32", raw)
    documented = spec.values or spec.minimum is not None or spec.maximum is not None
    if documented and range_problem(spec, value) is None:
        return None
    meant: float = struct.unpack("<f", raw)[0]
    return meant if math.isfinite(meant) and 1e-3 <= abs(meant) <= 1e6 else None


class _LinkState:
    """What one link is still owed."""

    __slots__ = ("burst", "due_us", "hash_first", "list_index", "pending", "revision")

    def __init__(self, burst: int, revision: int) -> None:
        self.burst = burst
        self.revision = revision  # of the table, when changes were last collected for this link
        self.list_index: int | None = None  # next index of a list being sent
        self.hash_first = False
        self.pending: dict[str, None] = {}  # changed names, not announced yet, in order
        self.due_us = 0  # of the next burst


class ParamServer:
    """Serves one ParameterTable to any number of links.

    Args:
        table: the vehicle's parameters; changes made to it by anybody are announced on every link.
        system_id: own system.
        component_id: own component; requests to it or to component 0 are answered.

    Attributes:
        refused: requests that were answered with a PARAM_ERROR.
    """

    HANDLES: Final = frozenset(("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET"))

    def __init__(self, table: ParameterTable, *, system_id: int = 1, component_id: int = 1) -> None:
        self.table = table
        self.system_id = system_id
        self.component_id = component_id
        self.refused = 0
        self._links: dict[int, _LinkState] = {}
        self._notices: deque[str] = deque(maxlen=64)

    def add_link(self, link_id: int, *, burst: int = 20) -> None:
        """Make a link known; `handle` and `poll` do it by themselves with the burst PX4 uses over UDP.

        Args:
            link_id: any number the caller keeps for the link.
            burst: most messages per 4 ms; 20 is PX4's number over UDP, TCP and USB.
        """
        self._links[link_id] = _LinkState(burst, self.table.revision)

    def forget(self, link_id: int) -> None:
        """Drop whatever a link is still owed: its peer is gone, or it was closed."""
        self._links.pop(link_id, None)

    def take_notices(self) -> list[str]:
        """Warnings for the log since the last call, such as an INT32 that was sent as a float."""
        notices = list(self._notices)
        self._notices.clear()
        return notices

    def handle(self, msg: Message, link_id: int, now_us: int) -> list[Outgoing]:
        """Answer one message; anything that is no parameter request, or not for us, gets no answer.

        Args:
            msg: the message.
            link_id: link it came from; the answers belong there.
            now_us: vehicle time, us.
        """
        if msg.name not in self.HANDLES or msg.target_system != self.system_id:
            return []
        if msg.target_component not in (self.component_id, 0):
            return []
        link = self._link(link_id)
        if msg.name == "PARAM_SET":
            return self._set(msg, link)
        if msg.name == "PARAM_REQUEST_READ":
            return self._read(msg)
        link.hash_first = link.list_index is None  # a restart does without
        link.list_index = 0
        link.due_us = now_us
        return []

    def poll(self, link_id: int, now_us: int) -> list[Outgoing]:
        """Messages due now on a link: the next burst of a list, or announcements. Call it every tick.

        Args:
            link_id: the link.
            now_us: vehicle time, us.
        """
        link = self._links.get(link_id) or self._link(link_id)
        if link.revision != self.table.revision:
            changed = self.table.changed_since(link.revision)
            link.revision = self.table.revision
            if changed and not link.pending and link.list_index is None:
                link.due_us = now_us + ANNOUNCE_DELAY_US
            link.pending.update(dict.fromkeys(changed))
        elif link.list_index is None and not link.pending:
            return []
        if now_us < link.due_us:
            return []
        # keep the grid whatever the tick, but never catch up on bursts that were missed
        link.due_us = max(link.due_us + BURST_PERIOD_US, now_us + BURST_PERIOD_US // 2)
        if link.list_index is not None:
            return self._list_burst(link, link.list_index)
        names = list(link.pending)[: link.burst]
        for name in names:
            del link.pending[name]
        return [self._value(name) for name in names]

    def _link(self, link_id: int) -> _LinkState:
        if link_id not in self._links:
            self.add_link(link_id)
        return self._links[link_id]

    def _list_burst(self, link: _LinkState, index: int) -> list[Outgoing]:
        """The next part of the list; what it carries needs no announcement of its own."""
        out = [self._hash()] if link.hash_first else []
        link.hash_first = False
        names = self.table.names[index : index + link.burst - len(out)]
        for name in names:
            link.pending.pop(name, None)
            out.append(self._value(name))
        index += len(names)
        link.list_index = index if index < len(self.table) else None
        return out

    def _read(self, msg: Message) -> list[Outgoing]:
        """PARAM_REQUEST_READ: by index from 0 on, whatever the name; by name for any negative index."""
        index = msg.param_index
        if index >= 0:
            if index >= len(self.table):
                return [self._error(msg, ParamError.DOES_NOT_EXIST, index)]
            return [self._value(self.table.names[index])]
        if msg.param_id == HASH_NAME:
            return [self._hash()]
        if msg.param_id not in self.table:
            return [self._error(msg, ParamError.DOES_NOT_EXIST)]
        return [self._value(msg.param_id)]

    def _set(self, msg: Message, link: _LinkState) -> list[Outgoing]:
        """PARAM_SET: store four bytes and echo them, or say why not. An unknown name wins over a bad type."""
        name: str = msg.param_id
        if name == HASH_NAME:  # the ground has these values already
            if self.table.get("MAV_HASH_CHK_EN"):
                link.list_index = None
            return [self._error(msg, ParamError.READ_ONLY)]
        if name not in self.table:
            return [self._error(msg, ParamError.DOES_NOT_EXIST)]
        if msg.param_type not in TYPE_NUMBERS.values():
            return [self._error(msg, ParamError.TYPE_UNSUPPORTED)]
        spec = self.table.spec(name)
        if msg.param_type != TYPE_NUMBERS[spec.type]:
            return [self._error(msg, ParamError.TYPE_MISMATCH)]
        raw = msg.raw("param_value")
        meant = float_in_disguise(spec, raw) if spec.type == "INT32" else None
        if meant is not None:
            self._notices.append(
                f"{msg.sysid}/{msg.compid} set {name} to {from_raw('INT32', raw)}, the bits of the float "
                f"{meant:g}: an INT32 goes into param_value as its four bytes. Stored as sent, as PX4 does"
            )
        self.table.set_raw(name, raw)
        return [self._value(name)]

    def _value(self, name: str) -> Outgoing:
        table = self.table
        return "PARAM_VALUE", {
            "param_id": name,
            "param_value": table.raw(name),
            "param_type": TYPE_NUMBERS[table.spec(name).type],
            "param_count": len(table),
            "param_index": table.index(name),
        }

    def _hash(self) -> Outgoing:
        return "PARAM_VALUE", {
            "param_id": HASH_NAME,
            "param_value": self.table.hash_check().to_bytes(4, "little"),
            "param_type": TYPE_UINT32,
            "param_count": len(self.table),
            "param_index": NO_INDEX,
        }

    def _error(self, msg: Message, error: ParamError, index: int = 0) -> Outgoing:
        self.refused += 1
        return "PARAM_ERROR", {
            "target_system": msg.sysid,
            "target_component": msg.compid,
            "param_id": msg.raw("param_id"),  # as it came: what is no text need not fit as text
            "param_index": index,
            "error": int(error),
        }
