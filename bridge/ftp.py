"""FtpServer: the vehicle's side of MAVFTP, as PX4 speaks it.

What a client can meet, all of it recorded from a PX4 SITL of May 2026 or read in its mavlink_ftp.cpp:

- One session on each link; a second open is refused, and after 10 s without a request it is closed. Its number is
  that in the request that opened it: 0, as a PX4's always is, but for MAVProxy, which makes numbers up and takes no
  other for an answer. (So MAVProxy 1.8.74 reads no file from a PX4, and reads ours.)
- A request whose sequence number plus one is that of the last short reply to the same peer, the last of a burst
  included, is taken for a repeat and gets that reply again, whatever its opcode. Except, here, the end of the session
  behind a burst: MAVProxy counts on by one where the burst's packets have counted too, and would leave it open.
- A burst is 35 kB long or up to the end of the file, ignores the size asked for, and the end is a NAK.
- The errno of a failure is remembered, and three failures give the remembered one in place of their own: the CRC of
  a file that cannot be opened, a truncation, a rename without a new name. We do so too; where nothing was
  remembered the failure's own is given. (There a PX4 gives 0. And after an EEXIST a PX4 calls every failure "file
  exists"; we do not.)

Messages in, messages out: no socket and no clock. What files there are is `bridge.ftp_files`' business.
Source: PX4 src/modules/mavlink/mavlink_ftp.cpp; MAVLink's file transfer protocol, https://mavlink.io/en/services/ftp.html.
"""

from __future__ import annotations

import errno
from itertools import islice
from typing import Final

from bridge.ftp_files import FileTree
from bridge.ftp_nodes import OpenFile, os_error
from bridge.ftp_session import Burst, Checksum, Last, Link
from bridge.ftp_wire import (
    ACK,
    DATA_BYTES,
    NAK,
    FtpError,
    Opcode,
    Outgoing,
    Request,
    line_of,
    message_to,
    payload_of,
    request_of,
    text_of,
    u32,
)
from bridge.messages import Message

BURST_BYTES: Final = 35_000
"""A burst ends with the first packet beyond this many bytes; the client then asks for the next one."""

BURST_PACKETS: Final = 20
"""Most packets of a burst sent at once, so that a reader's socket buffer outlives them."""

BURST_PERIOD_US: Final = 4_000
"""Least time between two such groups, us."""

IDLE_US: Final = 10_000_000
"""A session that nobody asks anything is closed after this time, us."""

_OF_ERRNO: Final = {
    errno.EEXIST: FtpError.FILE_EXISTS,
    errno.ENOENT: FtpError.NOT_FOUND,
    errno.EACCES: FtpError.PROTECTED,
    errno.EPERM: FtpError.PROTECTED,
}
_SENSELESS: Final = (FtpError.BAD_SIZE, FtpError.UNKNOWN_COMMAND, FtpError.PROTECTED)


class _Refused(Exception):
    """A request that gets a NAK."""

    def __init__(self, error: FtpError) -> None:
        self.error = error


class _Unanswered(Exception):
    """A request too many: it is as if it had been lost on the way."""


class _Masked(Exception):
    """A failure that a PX4 reports with the errno it remembers of an earlier one."""

    def __init__(self, error: OSError) -> None:
        self.error = error


class FtpServer:
    """Serves a tree of files to any number of links.

    Args:
        files: the tree.
        system_id: own system; requests to it or to system 0 are answered.
        component_id: own component; requests to it or to component 0 are answered.

    Attributes:
        refused: requests for us that made no sense or reached for what is not theirs.
    """

    HANDLES: Final = ("FILE_TRANSFER_PROTOCOL",)

    def __init__(self, files: FileTree, *, system_id: int = 1, component_id: int = 1) -> None:
        self.files = files
        self.refused = 0
        self._system_id = system_id
        self._component_id = component_id
        self._links: dict[int, Link] = {}

    def handle(self, msg: Message, link_id: int, now_us: int) -> list[Outgoing]:
        """Answer a request; what `poll` sends may belong to the answer.

        Args:
            msg: a FILE_TRANSFER_PROTOCOL.
            link_id: link it came from; the answers belong there.
            now_us: vehicle time, us.
        """
        if msg.target_system not in (0, self._system_id) or msg.target_component not in (0, self._component_id):
            return []
        request = request_of(msg)
        link = self._links.setdefault(link_id, Link())
        link.active_us = now_us
        if request.size > DATA_BYTES:
            return [self._refuse(link, request, FtpError.BAD_SIZE)]
        if link.last is not None and link.last.answers(request):
            return [message_to(request.peer, link.last.payload)]
        if link.checksum is not None:
            if link.checksum.request == request:
                return []  # asked again before it was done
            link.drop_checksum()
        link.last = None
        if request.opcode != Opcode.LIST:
            link.listing.end()
        try:
            if request.opcode == Opcode.BURST:
                self._session(link, request)
                link.burst = Burst(request, now_us)
                return []
            if request.opcode == Opcode.CRC:
                return self._checksum(link, request)
            answer = self._work(link, request)
        except _Unanswered:
            self.refused += 1
            return []
        except (_Refused, _Masked, OSError) as error:
            return [self._fail(link, request, error)]
        return [self._reply(link, request, ACK, answer)]

    def poll(self, link_id: int, now_us: int) -> list[Outgoing]:
        """Return what is due on a link: the next packets of a burst, or a checksum that took longer.

        Args:
            link_id: the link.
            now_us: vehicle time, us.
        """
        link = self._links.get(link_id)
        if link is None:
            return []
        if link.checksum is not None:
            return self._go_on(link)
        if link.file is None:
            return []
        if link.burst is not None and now_us >= link.burst.due_us:
            link.active_us = now_us
            return self._burst(link, link.burst, link.file, now_us)
        if now_us - link.active_us >= IDLE_US:
            link.close()
            link.last = None
        return []

    def forget(self, link_id: int) -> None:
        """Close the session of a link whose peer is gone.

        Args:
            link_id: the link.
        """
        link = self._links.pop(link_id, None)
        if link is not None:
            link.close()
            link.drop_checksum()

    def _work(self, link: Link, request: Request) -> bytes:
        """Do what a request asks for and return the data of its ACK."""
        path = request.path
        match request.opcode:
            case Opcode.NONE:
                return request.data
            case Opcode.TERMINATE:
                self._session(link, request)
                link.close()
            case Opcode.RESET:
                link.close()
            case Opcode.LIST:
                return self._list(link, path, request.offset)
            case Opcode.OPEN_READ:
                return self._open(link, request)
            case Opcode.CREATE:
                return self._open(link, request, write=True, empty=True)
            case Opcode.OPEN_WRITE:
                return self._open(link, request, write=True)
            case Opcode.READ:
                file = self._session(link, request)
                data = file.read(request.offset, request.size) if request.offset < file.size else b""
                if not data and (request.size or request.offset >= file.size):
                    raise _Refused(FtpError.END_OF_FILE)
                return data
            case Opcode.WRITE:
                return u32(self._session(link, request).write(request.offset, request.data))
            case Opcode.REMOVE:
                self.files.remove(path)
            case Opcode.MAKE_FOLDER:
                self.files.make_folder(path)
            case Opcode.REMOVE_FOLDER:
                self.files.remove_folder(path)
            case Opcode.TRUNCATE:
                self._truncate(path, request.offset)
            case Opcode.RENAME:
                self._rename(request)
            case _:
                raise _Refused(FtpError.UNKNOWN_COMMAND)
        return b""

    def _session(self, link: Link, request: Request) -> OpenFile:
        """The open file of the session a request names."""
        if request.session != link.session or link.file is None:
            raise _Refused(FtpError.BAD_SESSION)
        return link.file

    def _open(self, link: Link, request: Request, **how: bool) -> bytes:
        """Open a file and return its size."""
        if link.file is not None:
            raise _Refused(FtpError.NO_SESSION)
        link.file = self.files.open(request.path, **how)
        link.session = request.session
        return u32(link.file.size)

    def _list(self, link: Link, path: str, offset: int) -> bytes:
        """As many entries as fit, from the one numbered `offset` on."""
        listing, now_us = link.listing, link.active_us
        try:
            if not listing.has_page(path, offset, now_us):
                if not listing.may_look(now_us):
                    raise _Unanswered
                listing.begin(path, self.files.entries(path), now_us)
        except OSError as error:
            if error.errno == errno.EACCES:
                raise
            link.errno = error.errno or 0
            raise _Refused(FtpError.NOT_FOUND) from None
        data = b""
        for entry in islice(listing.entries, offset, None):
            line = line_of(entry)
            if len(data) + len(line) > DATA_BYTES:
                return data
            data += line
        link.errno = 0  # as reading a directory to its end leaves it
        if not data:
            raise _Refused(FtpError.END_OF_FILE)
        return data

    def _truncate(self, path: str, size: int) -> None:
        try:
            self.files.truncate(path, size)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EFBIG, errno.ENOSPC):
                raise
            raise _Masked(error) from None

    def _rename(self, request: Request) -> None:
        """Both names follow each other, with a NUL between; PX4 wants at least two characters of the new one."""
        old, _, new = request.data.partition(b"\0")
        if len(old) + 2 >= request.size:
            raise _Masked(os_error(errno.EINVAL))
        self.files.rename(text_of(old), text_of(new))

    def _checksum(self, link: Link, request: Request) -> list[Outgoing]:
        """CRC-32 of a file: start 0 and no final inversion, like that of the parameters."""
        try:
            file = self.files.open(request.path)
        except OSError as error:
            if error.errno == errno.EACCES:
                raise
            raise _Masked(error) from None
        link.checksum = Checksum(request, file)
        return self._go_on(link)

    def _go_on(self, link: Link) -> list[Outgoing]:
        """Take a piece of the file whose checksum was asked for; the answer, when it was the last one."""
        checksum = link.checksum
        assert checksum is not None
        request = checksum.request
        try:
            if not checksum.go_on():
                return []
        except OSError as error:
            link.drop_checksum()
            return [self._fail(link, request, error)]
        link.drop_checksum()
        return [self._reply(link, request, ACK, u32(checksum.crc ^ 0xFFFFFFFF))]

    def _burst(self, link: Link, burst: Burst, file: OpenFile, now_us: int) -> list[Outgoing]:
        """The next packets of a burst."""
        # keep the grid whatever the tick, but never catch up on groups that were missed
        burst.due_us = max(burst.due_us + BURST_PERIOD_US, now_us + BURST_PERIOD_US // 2)
        out: list[Outgoing] = []
        while len(out) < BURST_PACKETS and link.burst is not None:
            error = b""
            data = b""
            try:
                if burst.offset < file.size:
                    data = file.read(burst.offset, DATA_BYTES)
                if not data:
                    error = bytes([FtpError.END_OF_FILE])
            except OSError as failure:
                error = bytes([FtpError.FAIL_ERRNO, (link.errno or failure.errno or 0) & 0xFF])
            burst.sent += len(data)
            complete = burst.sent > BURST_BYTES
            if error or complete:
                link.burst = None
            kind = NAK if error else ACK
            payload = payload_of(
                burst.seq, link.session, kind, Opcode.BURST, burst.offset, error or data, complete=complete
            )
            if len(error or data) <= 4:
                link.last = Last(burst.seq, burst.peer, Opcode.BURST, payload)
            out.append(message_to(burst.peer, payload))
            burst.seq = burst.seq + 1 & 0xFFFF
            burst.offset += len(data)
        return out

    def _fail(self, link: Link, request: Request, error: _Refused | _Masked | OSError) -> Outgoing:
        """The NAK of whatever went wrong."""
        if isinstance(error, _Refused):
            return self._refuse(link, request, error.error)
        if isinstance(error, _Masked):
            number = link.errno or error.error.errno or errno.EIO
        else:
            number = error.errno or errno.EIO
            if number not in (errno.EACCES, errno.EPERM):
                link.errno = number
        return self._refuse(link, request, _OF_ERRNO.get(number, FtpError.FAIL_ERRNO), number)

    def _refuse(self, link: Link, request: Request, error: FtpError, number: int = 0) -> Outgoing:
        self.refused += error in _SENSELESS
        data = bytes([error, number & 0xFF]) if error == FtpError.FAIL_ERRNO else bytes([error])
        return self._reply(link, request, NAK, data, keep=error != FtpError.NO_SESSION)

    def _reply(self, link: Link, request: Request, kind: int, data: bytes, *, keep: bool = True) -> Outgoing:
        """The answer to a request; a short one is kept, should it get lost and be asked for again."""
        seq = request.seq + 1 & 0xFFFF
        payload = payload_of(seq, request.session, kind, request.opcode, request.offset, data)
        link.last = Last(seq, request.peer, request.opcode, payload) if keep and len(data) <= 4 else None
        return message_to(request.peer, payload)
