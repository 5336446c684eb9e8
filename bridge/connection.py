"""Connection: bytes in, messages out; fields in, bytes out. It owns no socket and no clock.

    connection = Connection(sysid=1, compid=1, datagram=link.datagram)
    link.send(connection.encode("ATTITUDE", time_boot_ms=40, roll=0.1))
    while (data := link.recv()) is not None:
        for message in connection.receive(data):
            print(message.name, message.sysid, message.fields())

One Connection for each link: it counts the packets of that link, both ways. What goes out is MAVLink 2,
unsigned.
"""

from __future__ import annotations

import difflib
import struct
from collections.abc import Callable, Mapping
from typing import Any

from bridge.framing import Counters, FrameSplitter, crc16
from bridge.messages import BY_ID, BY_NAME, MAGIC_2, Message
from sitl.errors import UsageError

__all__ = ["Connection", "Counters", "Message"]

_HEADER = struct.Struct("<6B3s")
_MAGIC = bytes([MAGIC_2])


class Connection:
    """One end of a MAVLink conversation.

    Args:
        sysid: our system id, 1 to 255.
        compid: our component id, 1 to 255.
        datagram: every `receive` is a datagram of its own (`Link.datagram`), so that a damaged one never
            reaches into the next.

    Attributes:
        counters: what became of the bytes and frames received.
        sent: frames encoded.
        on_frame: called with every frame, encoded or received, for a log of both directions.

    Raises:
        UsageError: an id outside 1 to 255.
    """

    def __init__(self, sysid: int, compid: int, *, datagram: bool = False) -> None:
        for what, value in (("system", sysid), ("component", compid)):
            if not 1 <= value <= 255:
                raise UsageError(f"MAVLink {what} id {value}: choose one from 1 to 255")
        self.sysid = sysid
        self.compid = compid
        self.counters = Counters()
        self.sent = 0
        self.on_frame: Callable[[bytes], object] | None = None
        self._splitter = FrameSplitter(BY_ID, self.counters, datagram=datagram)

    @property
    def pending(self) -> int:
        """Bytes of an unfinished frame that are kept; bounded, and always 0 for datagrams."""
        return self._splitter.pending

    def encode(self, name: str, /, **fields: Any) -> bytes:
        """Return one frame, with the next packet number.

        Args:
            name: message name, for example "PARAM_SET".
            fields: values by field name; the ones left out are zero. `bridge.messages` says what they may be.

        Raises:
            UsageError: no such message.
            TypeError: the message has no such field.
            FieldError: the value does not fit the field.
        """
        return self.encode_fields(name, fields)

    def encode_fields(self, name: str, fields: Mapping[str, Any]) -> bytes:
        """Return one frame, as `encode`, of fields that are a mapping already."""
        kind = BY_NAME.get(name)
        if kind is None:
            near = difflib.get_close_matches(name, BY_NAME, n=1)
            raise UsageError(f"no MAVLink message {name!r}" + (f"; did you mean {near[0]}?" if near else ""))
        # MAVLink 2 cuts the zeros off the end but keeps one byte.
        payload = kind.pack(fields)
        payload = payload.rstrip(b"\0") or payload[:1]
        body = _HEADER.pack(len(payload), 0, 0, self.sent & 0xFF, self.sysid, self.compid, kind.id_bytes) + payload
        frame = _MAGIC + body + crc16(body + kind.crc_extra).to_bytes(2, "little")
        self.sent += 1
        if self.on_frame is not None:
            self.on_frame(frame)
        return frame

    def receive(self, data: bytes) -> list[Message]:
        """Return the messages these bytes complete, in order; damage is counted and never raises."""
        messages = self._splitter.feed(data)
        return messages if self.on_frame is None else self._logged(messages)

    def flush(self) -> list[Message]:
        """Return what a quiet stream still holds: messages that waited for bytes that do not come."""
        return self._logged(self._splitter.flush())

    def _logged(self, messages: list[Message]) -> list[Message]:
        if self.on_frame is not None:
            for message in messages:
                self.on_frame(message.raw_frame)
        return messages
