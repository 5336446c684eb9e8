"""Framing: where messages begin and end in the bytes of a link, damaged ones included.

A frame is good when its id is known and its checksum agrees. MAVLink 2 (0xFD), MAVLink 1 (0xFE) and signed
frames are read; a frame with incompatibility flags we do not know is none. How damage is contained:

- **Nothing is skipped on the word of a length byte.** Whatever is not a good frame is searched again from the
  byte after its magic, so a wrong length, id or payload costs the damaged frame and no other.
- **A frame with an unknown id cannot be checked.** It is searched like damage; if no good frame starts inside
  it and the next frame (or the end) comes right behind it, it counts as unknown, else as bad bytes.
- **A datagram stands alone**: whatever is in it is decided with it.
- **In a stream** a frame that has begun is waited for only while it can be true: its id is known and it is
  not longer than its message. A good frame behind any other beginning is given out at once. A damaged frame
  can so hold back what follows for no longer than its own message, and `flush` decides on what there is.
- What is kept between calls is bounded: an unfinished frame, at most behind one unknown one (`BUFFER_LIMIT`
  bytes).
- **A whole frame that its signature does not vouch for** is refused and counted, and nothing inside it is looked at:
  it costs no more than itself, and tells nothing of the packet counters.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from enum import Enum, auto

import fastcrc

from bridge.messages import (
    HEADER_1,
    HEADER_2,
    MAGIC_1,
    MAGIC_2,
    SIGNATURE,
    SIGNED,
    Message,
    MessageType,
)
from bridge.signing import Signer, Verdict

# CRC-16/MCRF4XX of the bytes, optionally going on from an earlier checksum.
crc16: Callable[..., int] = fastcrc.crc16.mcrf4xx

LARGEST = HEADER_2 + 255 + 2 + SIGNATURE
BUFFER_LIMIT = 2 * LARGEST

_MAGIC = re.compile(rb"[\xfd\xfe]")

# A packet counter this little behind is a repeated or overtaken frame; anything else is a gap (or a restart).
_LATE = 16


class Counters:
    """What became of the bytes and frames of one link.

    Attributes:
        received: good frames.
        bad_crc: frames of a known message whose checksum was wrong.
        unknown: frames whose id we do not know.
        bad_bytes: bytes that belong to none of the good or unknown frames.
        resyncs: times a good frame was found again behind bad bytes.
        lost: frames missing from the senders' packet counters.
        late: frames that came twice or were overtaken (an overtaken one was counted as lost before).
        bad_signature: frames signed with another key, or damaged in their signature. Only links with a `Signer`
            count these and the two below; what they count is not received.
        replayed: frames with a genuine signature whose timestamp is not new.
        unsigned_refused: frames without a signature where one is required.
    """

    __slots__ = (
        "_last",
        "bad_bytes",
        "bad_crc",
        "bad_signature",
        "late",
        "lost",
        "received",
        "replayed",
        "resyncs",
        "unknown",
        "unsigned_refused",
    )

    def __init__(self) -> None:
        self.received = self.bad_crc = self.unknown = self.bad_bytes = 0
        self.resyncs = self.lost = self.late = 0
        self.bad_signature = self.replayed = self.unsigned_refused = 0
        self._last: dict[int, int] = {}

    @property
    def refused(self) -> int:
        """Frames that were whole and not believed."""
        return self.bad_signature + self.replayed + self.unsigned_refused

    def heard(self, sysid: int, compid: int, seq: int) -> None:
        """Follow the packet counter of one sender."""
        sender = sysid << 8 | compid
        last = self._last.get(sender)
        if last is not None:
            gap = (seq - last - 1) & 0xFF
            if gap:
                if gap >= 256 - _LATE:
                    self.late += 1
                    return
                self.lost += gap
        self._last[sender] = seq

    def knows(self, sysid: int, compid: int) -> bool:
        """Whether this sender has been heard before."""
        return (sysid << 8 | compid) in self._last

    def __repr__(self) -> str:
        names = [name for name in self.__slots__ if name[0] != "_"]
        return f"<Counters {', '.join(f'{name} {getattr(self, name)}' for name in names)}>"


class _Verdict(Enum):
    """Why no message was read at a magic byte."""

    NO_FRAME = auto()
    BAD_CRC = auto()
    UNKNOWN = auto()
    UNFINISHED = auto()  # and credible: worth waiting for
    DOUBTFUL = auto()  # unfinished, and more likely damage


class FrameSplitter:
    """Finds the good frames in what a link delivers.

    Args:
        types: the messages that can be checked, by id.
        counters: where to count.
        datagram: every `feed` is a datagram of its own.

    Attributes:
        signer: verifies what comes in; None: signatures are skipped.
    """

    def __init__(self, types: Mapping[int, MessageType], counters: Counters, *, datagram: bool) -> None:
        self._types = types
        self._counters = counters
        self._datagram = datagram
        self.signer: Signer | None = None
        self._rest = b""
        self._adrift = False

    @property
    def pending(self) -> int:
        """Bytes kept for later; never more than BUFFER_LIMIT, always 0 for datagrams."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[Message]:
        """Return the good frames that these bytes complete, in order; never raises."""
        if not self._rest and not self._adrift and len(data) > HEADER_2 and data[0] == MAGIC_2 and not data[2]:
            # Nearly every datagram: one whole, unsigned frame and nothing else.
            kind = self._types.get(data[7] | data[8] << 8 | data[9] << 16)
            stop = HEADER_2 + data[1]
            if (
                kind is not None
                and len(data) == stop + 2
                and crc16(data[1:stop] + kind.crc_extra) == data[stop] | data[stop + 1] << 8
            ):
                if self.signer is not None and not self.signer.accepts_unsigned(kind.id):
                    self._counters.unsigned_refused += 1
                    return []
                self._counters.received += 1
                self._counters.heard(data[5], data[6], data[4])
                return [Message(kind, data, HEADER_2, stop, data[5])]
        return self._split(self._rest + data if self._rest else data, final=self._datagram)

    def lone(self, data: bytes, kind: MessageType) -> bytes | None:
        """The whole payload of a piece that is one good unsigned frame of this message; None, and nothing done, if not.

        Args:
            data: as it came. kind: the message.
        """
        stop = len(data) - 2
        if (
            stop <= HEADER_2
            or data[0] != MAGIC_2
            or data[2]
            or data[1] != stop - HEADER_2
            or data[7:10] != kind.id_bytes
            or self._rest
            or self._adrift
            or self.signer is not None
            or crc16(data[1:stop] + kind.crc_extra) != data[stop] | data[stop + 1] << 8
        ):
            return None
        self._counters.received += 1
        self._counters.heard(data[5], data[6], data[4])
        return data[HEADER_2:stop].ljust(kind.size, b"\0")

    def flush(self) -> list[Message]:
        """Decide on what is kept as if nothing were to follow: the line is quiet, or the stream has ended."""
        return self._split(self._rest, final=True)

    def _split(self, buffer: bytes, *, final: bool) -> list[Message]:
        found: list[Message] = []
        self._rest = b""
        settled = 0
        while settled < len(buffer):
            result = self._read(buffer, settled)
            if isinstance(result, Message):
                message = result
            else:
                sought, settled = self._search(buffer, settled, final)
                if sought is None:
                    break
                message = sought
            if self._adrift:
                self._counters.resyncs += 1
                self._adrift = False
            end = settled + len(message.raw_frame)
            if self.signer is not None:
                verdict = self._judge(self.signer, message)
                if verdict is not Verdict.GENUINE:
                    # Where a byte of the signature got lost, the next frame begins in what was taken for its end.
                    if verdict is Verdict.FORGED and end < len(buffer) and buffer[end] not in (MAGIC_1, MAGIC_2):
                        end -= SIGNATURE
                    settled = end
                    continue
            self._counters.received += 1
            self._counters.heard(message.sysid, message.compid, message.seq)
            found.append(message)
            settled = end
        return found

    def _judge(self, signer: Signer, message: Message) -> Verdict | None:
        """Return whether a frame is to be believed, None for one without a signature it needs; count it if not."""
        if not message.signed:
            if signer.accepts_unsigned(message.id):
                return Verdict.GENUINE
            self._counters.unsigned_refused += 1
            return None
        verdict = signer.verify(message.raw_frame)
        if verdict is Verdict.FORGED:
            self._counters.bad_signature += 1
        elif verdict is Verdict.REPLAYED:
            self._counters.replayed += 1
        return verdict

    def _search(self, buffer: bytes, settled: int, final: bool) -> tuple[Message | None, int]:
        """Return the next good frame after `settled`, where there is none, and where it begins.

        Without one, keep what may still become one.
        """
        suspects: list[tuple[int, int, _Verdict]] = []
        keep: int | None = None
        found: Message | None = None
        at = settled
        while match := _MAGIC.search(buffer, at):
            at = match.start()
            result = self._read(buffer, at)
            if isinstance(result, Message):
                found = result
                break
            verdict, end = result
            if verdict in (_Verdict.UNFINISHED, _Verdict.DOUBTFUL):
                if not final:
                    keep = at if keep is None else keep
                    if verdict is _Verdict.UNFINISHED:
                        break
            elif verdict is not _Verdict.NO_FRAME and (not suspects or at >= suspects[-1][1]):
                # An unknown frame needs a neighbour to be believed.
                joins = end == len(buffer) or buffer[end] in (MAGIC_1, MAGIC_2)
                if verdict is _Verdict.BAD_CRC or joins:
                    suspects.append((at, end, verdict))
            at += 1
        if found is not None:
            limit = at
        else:
            limit = len(buffer) if keep is None else keep
            # What straddles the limit is judged again when the rest is in.
            limit = next((start for start, end, _ in suspects if start < limit < end), limit)
            self._rest = buffer[limit:]
        bad_bytes = self._give_up(buffer, settled, limit, suspects)
        self._counters.bad_bytes += bad_bytes
        self._adrift = self._adrift or bad_bytes > 0
        return found, limit

    def _give_up(self, buffer: bytes, start: int, stop: int, suspects: list[tuple[int, int, _Verdict]]) -> int:
        """Count the frames from start to stop, none good; return the bytes that belong to no frame."""
        bad = stop - start
        for at, end, verdict in suspects:
            if at >= stop:
                continue
            if verdict is _Verdict.BAD_CRC:
                self._counters.bad_crc += 1
            elif end <= stop:
                self._counters.unknown += 1
                bad -= end - at
                # It took a number from its sender's counter; a sender only ever seen here may be an accident.
                head = at + 4 if buffer[at] == MAGIC_2 else at + 2
                seq, sysid, compid = buffer[head : head + 3]
                if self._counters.knows(sysid, compid):
                    self._counters.heard(sysid, compid, seq)
        return bad

    def _read(self, buffer: bytes, at: int) -> Message | tuple[_Verdict, int]:
        """Read the frame at this place, or say what is there instead and where it would end."""
        available = len(buffer) - at
        if buffer[at] == MAGIC_2:
            if available < HEADER_2:
                return _Verdict.DOUBTFUL, at
            length = buffer[at + 1]
            flags = buffer[at + 2]
            if flags & ~SIGNED:
                return _Verdict.NO_FRAME, at
            number = buffer[at + 7] | buffer[at + 8] << 8 | buffer[at + 9] << 16
            kind = self._types.get(number)
            start = HEADER_2
            stop = start + length
            total = stop + 2 + SIGNATURE if flags else stop + 2
            credible = kind is not None and length <= kind.size
            sysid = buffer[at + 5]
        elif buffer[at] == MAGIC_1:
            if available < HEADER_1:
                return _Verdict.DOUBTFUL, at
            length = buffer[at + 1]
            flags = 0
            kind = self._types.get(buffer[at + 5])
            # MAVLink 1 has no extension fields, so no payload is longer than the one we know.
            if kind is not None and length > kind.size:
                return _Verdict.NO_FRAME, at
            start = HEADER_1
            stop = start + length
            total = stop + 2
            credible = kind is not None
            sysid = buffer[at + 3]
        else:
            return _Verdict.NO_FRAME, at
        if available < total:
            return (_Verdict.UNFINISHED if credible else _Verdict.DOUBTFUL), at + total
        if kind is None:
            return _Verdict.UNKNOWN, at + total
        frame = buffer[at : at + total]
        checksum = crc16(kind.crc_extra, crc16(frame[1:stop]))
        if checksum != frame[stop] | frame[stop + 1] << 8:
            return _Verdict.BAD_CRC, at + total
        return Message(kind, frame, start, stop, sysid)
