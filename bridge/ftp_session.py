"""What an MAVFTP server keeps of one link: the open file, a burst or a checksum under way, the last reply.

Source: PX4 src/modules/mavlink/mavlink_ftp.cpp.
"""

from __future__ import annotations

import zlib
from typing import Final, NamedTuple

from bridge.ftp_nodes import OpenFile
from bridge.ftp_wire import Opcode, Peer, Request

CRC_BYTES: Final = 1 << 20
"""Bytes of a file a checksum goes on by at once; a larger file is answered some ticks later."""


class Burst:
    """A burst being sent."""

    def __init__(self, request: Request, now_us: int) -> None:
        self.peer = request.peer
        self.offset = request.offset
        self.seq = request.seq + 1 & 0xFFFF
        self.sent = 0
        self.due_us = now_us


class Checksum:
    """A checksum being made; the file is closed when it is done or given up."""

    def __init__(self, request: Request, file: OpenFile) -> None:
        self.request = request
        self.file = file
        self.offset = 0
        self.crc = 0xFFFFFFFF

    def go_on(self) -> bool:
        """Take the next piece; returns whether it was the last. Raises OSError."""
        end = min(self.offset + CRC_BYTES, self.file.size)
        while self.offset < end:
            data = self.file.read(self.offset, min(65536, end - self.offset))
            if not data:
                return True
            self.crc = zlib.crc32(data, self.crc)
            self.offset += len(data)
        return self.offset >= self.file.size


class Last(NamedTuple):
    """The last short reply, kept should it have got lost.

    Attributes:
        seq: its sequence number.
        peer: to whom it went.
        opcode: of the request it answered.
        payload: itself.
    """

    seq: int
    peer: Peer
    opcode: int
    payload: bytes

    def answers(self, request: Request) -> bool:
        """Whether a request is taken for a repeat of the one this answered."""
        if self.opcode == Opcode.BURST and request.opcode in (Opcode.TERMINATE, Opcode.RESET):
            return False
        return (self.seq, self.peer) == (request.seq + 1 & 0xFFFF, request.peer)


class Link:
    """What is kept of one link."""

    def __init__(self) -> None:
        self.file: OpenFile | None = None
        self.session = 0  # number of the session the file is open in
        self.burst: Burst | None = None
        self.checksum: Checksum | None = None
        self.active_us = 0
        self.errno = 0  # the one remembered
        self.last: Last | None = None

    def close(self) -> None:
        """Close the session and what it has under way."""
        if self.file is not None:
            self.file.close()
        self.file = self.burst = None

    def drop_checksum(self) -> None:
        """Give up a checksum being made."""
        if self.checksum is not None:
            self.checksum.file.close()
        self.checksum = None
