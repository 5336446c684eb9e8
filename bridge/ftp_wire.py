"""What MAVFTP's messages hold: a header of 12 bytes and up to 239 bytes of data in FILE_TRANSFER_PROTOCOL.payload.

Source: MAVLink's file transfer protocol, https://mavlink.io/en/services/ftp.html, and PX4's mavlink_ftp.h.
"""

from __future__ import annotations

import enum
import struct
from typing import Any, Final, NamedTuple, TypeAlias

from bridge.ftp_nodes import Entry
from bridge.messages import Message

Outgoing: TypeAlias = tuple[str, dict[str, Any]]
"""A message to be encoded: its name and its fields."""

DATA_BYTES: Final = 239
"""Most bytes of data in a message."""

ACK: Final = 128
NAK: Final = 129

_HEADER: Final = struct.Struct("<HBBBBBxI")


class Opcode(enum.IntEnum):
    """What a request asks for."""

    NONE = 0
    TERMINATE = 1
    RESET = 2
    LIST = 3
    OPEN_READ = 4
    READ = 5
    CREATE = 6
    WRITE = 7
    REMOVE = 8
    MAKE_FOLDER = 9
    REMOVE_FOLDER = 10
    OPEN_WRITE = 11
    TRUNCATE = 12
    RENAME = 13
    CRC = 14
    BURST = 15


class FtpError(enum.IntEnum):
    """Why a request was refused: the first byte of a NAK's data."""

    FAIL_ERRNO = 2
    BAD_SIZE = 3
    BAD_SESSION = 4
    NO_SESSION = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    PROTECTED = 9
    NOT_FOUND = 10


class Peer(NamedTuple):
    """Who asks."""

    sysid: int
    compid: int


class Request(NamedTuple):
    """A request taken apart."""

    seq: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes
    peer: Peer

    @property
    def path(self) -> str:
        """The text up to the first NUL."""
        return text_of(self.data)


def request_of(msg: Message) -> Request:
    """Take a FILE_TRANSFER_PROTOCOL apart."""
    payload = bytes(msg.payload).ljust(_HEADER.size, b"\0")
    seq, session, opcode, size, _, _, offset = _HEADER.unpack_from(payload)
    data = payload[_HEADER.size : _HEADER.size + min(size, DATA_BYTES)]
    return Request(seq, session, opcode, size, offset, data, Peer(msg.sysid, msg.compid))


def payload_of(
    seq: int, session: int, kind: int, request: int, offset: int, data: bytes, *, complete: bool = False
) -> bytes:
    """Return the payload of an answer.

    Args:
        seq: sequence number.
        session: session number.
        kind: ACK or NAK.
        request: opcode of the request it answers.
        offset: offset of the data, in bytes; as in the request where there is none.
        data: at most DATA_BYTES.
        complete: this is the last packet of a burst, though not of the file.
    """
    return _HEADER.pack(seq, session, kind, len(data), request, complete, offset) + data


def message_to(peer: Peer, payload: bytes) -> Outgoing:
    """Return the message that carries a payload to a peer."""
    target = {"target_system": peer.sysid, "target_component": peer.compid}
    return "FILE_TRANSFER_PROTOCOL", {**target, "payload": payload}


def text_of(data: bytes) -> str:
    """Text up to the first NUL; what is no UTF-8 stays recognisable."""
    # a PX4 ends a full message's text one byte early, to have room for the NUL
    return data[: DATA_BYTES - 1].partition(b"\0")[0].decode(errors="surrogateescape")


def line_of(entry: Entry) -> bytes:
    """An entry as it is listed; one that cannot be is only counted."""
    name = entry.name.encode(errors="surrogateescape")
    size = b"\t%d" % min(entry.size, 0xFFFFFFFF) if entry.kind == "F" else b""
    line = entry.kind.encode() + name + size + b"\0"
    if len(line) > DATA_BYTES or b"\t" in name:
        return b"S\0"
    return line


def u32(number: int) -> bytes:
    """Return a size, count or checksum as four bytes; a size beyond them is the largest."""
    return min(number, 0xFFFFFFFF).to_bytes(4, "little")
