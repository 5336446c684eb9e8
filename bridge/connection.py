"""Connection: bytes in, messages out; fields in, bytes out. It owns no socket and no clock.

    connection = Connection(sysid=1, compid=1, datagram=link.datagram)
    link.send(connection.encode("ATTITUDE", time_boot_ms=40, roll=0.1))
    while (data := link.recv()) is not None:
        for message in connection.receive(data):
            print(message.name, message.sysid, message.fields())

One Connection for each link: it counts the packets of that link, both ways. What goes out is MAVLink 2, signed
where the connection has a signer; then only frames it vouches for come in.
"""

from __future__ import annotations

import difflib
import struct
from collections.abc import Callable, Mapping
from typing import Any

from bridge.framing import Counters, FrameSplitter, crc16
from bridge.messages import BY_ID, BY_NAME, MAGIC_2, SIGNATURE, SIGNED, Message, MessageType
from bridge.signing import Signer
from sitl.errors import UsageError

__all__ = ["Connection", "Counters", "Message"]

_HEADER = struct.Struct("<6B3s")
_MAGIC = bytes([MAGIC_2])
_SETUP_SIGNING_ID = BY_NAME["SETUP_SIGNING"].id_bytes


class Connection:
    """One end of a MAVLink conversation.

    Args:
        sysid: our system id, 1 to 255.
        compid: our component id, 1 to 255.
        datagram: every `receive` is a datagram of its own (`Link.datagram`), so that a damaged one never
            reaches into the next.
        signer: signs what goes out and verifies what comes in; None: neither.

    Attributes:
        counters: what became of the bytes and frames received.
        sent: frames encoded.
        on_frame: called with every frame, encoded or received, for a log of both directions: without signatures,
            which an attacker could collect, and not with a SETUP_SIGNING, which holds the key.

    Raises:
        UsageError: an id outside 1 to 255.
    """

    def __init__(self, sysid: int, compid: int, *, datagram: bool = False, signer: Signer | None = None) -> None:
        for what, value in (("system", sysid), ("component", compid)):
            if not 1 <= value <= 255:
                raise UsageError(f"MAVLink {what} id {value}: choose one from 1 to 255")
        self.sysid = sysid
        self.compid = compid
        self.counters = Counters()
        self.sent = 0
        self.on_frame: Callable[[bytes], object] | None = None
        self._splitter = FrameSplitter(BY_ID, self.counters, datagram=datagram)
        self.signer = signer

    @property
    def signer(self) -> Signer | None:
        """Signs what goes out and verifies what comes in; may be exchanged between two messages."""
        return self._signer

    @signer.setter
    def signer(self, signer: Signer | None) -> None:
        self._signer = self._splitter.signer = signer

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
        return self.encode_payload(kind, kind.pack(fields))

    def encode_payload(self, kind: MessageType, payload: bytes) -> bytes:
        """Return one frame of a payload that is packed already.

        Args:
            kind: the message. payload: in wire order; zeros at its end may be missing.
        """
        # MAVLink 2 cuts the zeros off the end but keeps one byte.
        payload = payload.rstrip(b"\0") or payload[:1]
        signer = self._signer
        flags = 0 if signer is None else signer.flags
        seq = self.sent & 0xFF
        body = _HEADER.pack(len(payload), flags, 0, seq, self.sysid, self.compid, kind.id_bytes) + payload
        frame = _MAGIC + body + crc16(body + kind.crc_extra).to_bytes(2, "little")
        if signer is not None and flags:
            frame += signer.signature(frame)
        self.sent += 1
        if self.on_frame is not None:
            if flags or kind.id_bytes == _SETUP_SIGNING_ID:
                self._log(frame)
            else:
                self.on_frame(frame)
        return frame

    def receive(self, data: bytes) -> list[Message]:
        """Return the messages these bytes complete, in order; damage is counted and never raises."""
        messages = self._splitter.feed(data)
        return messages if self.on_frame is None else self._logged(messages)

    def lone_payload(self, data: bytes, kind: MessageType) -> tuple[int, bytes] | None:
        """The payload of a piece that is one whole good unsigned frame of this message, and nothing else; or None.

        Where it is not None the frame is received, as by `receive`; where it is, nothing has happened yet. For loops in
        which somebody waits for every microsecond.

        Args:
            data: as it came. kind: the message.

        Returns:
            (sender's system, payload with its zeros put back).
        """
        payload = self._splitter.lone(data, kind)
        if payload is None:
            return None
        if self.on_frame is not None:
            self._log(data)
        return data[5], payload

    def flush(self) -> list[Message]:
        """Return what a quiet stream still holds: messages that waited for bytes that do not come."""
        return self._logged(self._splitter.flush())

    def _logged(self, messages: list[Message]) -> list[Message]:
        log = self.on_frame
        if log is not None:
            for message in messages:
                frame = message.raw_frame
                # most frames are as they may be logged, and there are thousands a second
                if frame[0] == MAGIC_2 and (frame[2] or frame[7:10] == _SETUP_SIGNING_ID):
                    self._log(frame)
                else:
                    log(frame)
        return messages

    def _log(self, frame: bytes) -> None:
        """Give a frame to the log as MAVLink's page on message signing wants it logged."""
        if self.on_frame is None or (frame[0] == MAGIC_2 and frame[7:10] == _SETUP_SIGNING_ID):
            return
        if frame[0] == MAGIC_2 and frame[2] & SIGNED:
            body = frame[1:2] + b"\0" + frame[3 : -SIGNATURE - 2]
            kind = BY_ID[int.from_bytes(frame[7:10], "little")]
            frame = _MAGIC + body + crc16(body + kind.crc_extra).to_bytes(2, "little")
        self.on_frame(frame)
