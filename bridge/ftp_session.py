"""What an MAVFTP server keeps of one link: the open file, a burst or a checksum under way, the last reply.

Source: PX4 src/modules/mavlink/mavlink_ftp.cpp.
"""

from __future__ import annotations

import zlib
from typing import Final, NamedTuple

from bridge.ftp_nodes import Entry, OpenFile
from bridge.ftp_wire import Opcode, Peer, Request

CRC_FIRST_BYTES: Final = 1 << 16
"""Bytes of a file whose checksum is taken when it is asked for, however often; a larger one is answered later."""

CRC_BYTES: Final = 1 << 20
"""Bytes that such a checksum goes on by each time."""

ENTRIES_PER_S: Final = 20_000
"""Most entries of folders that one link has looked up in a second of vehicle time; more is not answered."""

LISTED_US: Final = 10_000_000
"""How long the further pages of a listing are those of the first, us: nobody reads a folder of 10,000 once a page."""


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
        end = min(self.offset + (CRC_BYTES if self.offset else CRC_FIRST_BYTES), self.file.size)
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


class Listing:
    """The folder that a link reads, as it was at the first page, and how much it may still look up."""

    def __init__(self) -> None:
        self.path = ""
        self.entries: list[Entry] = []
        self._taken_us = -LISTED_US
        self._room = ENTRIES_PER_S
        self._filled_us = 0

    def has_page(self, path: str, offset: int, now_us: int) -> bool:
        """Return whether a page is one of the listing that was begun."""
        return offset > 0 and path == self.path and now_us - self._taken_us < LISTED_US

    def may_look(self, now_us: int) -> bool:
        """Return whether a folder may be looked up now."""
        gained = (now_us - self._filled_us) * ENTRIES_PER_S // 1_000_000
        if gained > 0:
            self._room, self._filled_us = min(ENTRIES_PER_S, self._room + gained), now_us
        return self._room > 0

    def begin(self, path: str, entries: list[Entry], now_us: int) -> None:
        """Keep what was looked up."""
        self.path, self.entries, self._taken_us = path, entries, now_us
        self._room -= len(entries)

    def end(self) -> None:
        """What comes next is looked up anew: something may have been changed."""
        self.path, self.entries, self._taken_us = "", [], -LISTED_US


class Link:
    """What is kept of one link."""

    def __init__(self) -> None:
        self.listing = Listing()
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
