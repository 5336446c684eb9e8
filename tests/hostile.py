"""Bytes that nobody should send to a vehicle, made by chance from a seed.

`captures` are the requests of ground stations that a PX4 was recorded with; `Forge` makes frames of every message with
senseless fields, headers and lengths; `mutate` damages bytes. Who gets them is in hostile_vehicle.py.
"""

from __future__ import annotations

import math
import random
import struct
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from px4_answers import load_cases
from px4_rig import to_wire

from bridge.connection import Connection
from bridge.framing import crc16
from bridge.messages import BY_ID, BY_NAME, MAGIC_1, MAGIC_2, SIGNED, Field, MessageType
from bridge.signing import Signer, SigningKey
from sitl.parameters import ParameterTable

Fields = dict[str, Any]

KEY = SigningKey(bytes(range(32)), 1)

_FORMATS = {"int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H", "int32_t": "i", "uint32_t": "I"}
_FORMATS |= {"int64_t": "q", "uint64_t": "Q", "float": "f", "double": "d"}
_FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1.0, -1.0, 3.4e38, -3.4e38, 1e-45, 0.5, 1e6, 1e9, -90.0, 360.0)
_SYSTEMS = (0, 1, 1, 1, 2, 9, 255, 255, 245)
_COMPONENTS = (0, 1, 1, 2, 77, 190, 191, 255)
_FTP = struct.Struct("<HBBBBBBI")
_PATHS = (
    b"", b"/", b"@PARAM/param.pck", b"etc/extras/component_general.json.xz", b"log", b"log/../../etc/passwd", b"..",
    b"/etc/passwd", b"a", b"b", b"a/b", b"a\0b", b"/" * 239, b"\xff" * 239, b"a/" * 119, b"x" * 239, b"@PARAM",
)  # fmt: skip


@cache
def parameter_names() -> tuple[bytes, ...]:
    """Names that parameter messages are about: real ones, and some that are none."""
    return (*(name.encode() for name in ParameterTable().names), b"_HASH_CHECK", b"", b"NOPE", b"\xff" * 16, b"A" * 16)


@cache
def captures() -> tuple[tuple[str, Fields], ...]:
    """Every request of the recorded cases: message and fields."""
    named = {"hash": bytes(4), "now_us": bytes(8)}
    found = []
    for case in load_cases():
        for step in [*case.get("steps", ()), *case.get("teardown", ()), *case.get("before", ())]:
            for message in [*step.get("send", ()), *(step.get("stream") or {}).get("msgs", ())]:
                found.append((message["name"], to_wire(message, named)))
    return tuple(found)


@cache
def capture_frames() -> tuple[bytes, ...]:
    """The same as bytes, from the ground station 255/190, each only once."""
    encode = Connection(255, 190).encode_fields
    return tuple({repr(one): encode(*one) for one in captures()}.values())


def frame_of(
    kind: MessageType,
    payload: bytes,
    *,
    seq: int = 0,
    sysid: int = 255,
    compid: int = 190,
    version: int = 2,
    incompat: int = 0,
    compat: int = 0,
    signer: Signer | None = None,
    crc_error: int = 0,
) -> bytes:
    """A frame exactly as it is asked for, sense or none; a signer makes its flag part of it."""
    if version == 1:
        body = bytes([len(payload), seq, sysid, compid, kind.id & 0xFF]) + payload
        return bytes([MAGIC_1]) + body + (crc16(body + kind.crc_extra) ^ crc_error).to_bytes(2, "little")
    if signer is not None:
        incompat |= SIGNED
    body = bytes([len(payload), incompat, compat, seq, sysid, compid]) + kind.id_bytes + payload
    frame = bytes([MAGIC_2]) + body + (crc16(body + kind.crc_extra) ^ crc_error).to_bytes(2, "little")
    return frame if signer is None else frame + signer.signature(frame)


class Forge:
    """Makes frames by chance.

    Args:
        seed: the only source of chance.
        names: the messages to make; every one of the dialect if left out.
        signer: signs one frame in four.
        systems: their senders.
    """

    def __init__(
        self,
        seed: int,
        names: Iterable[str] = (),
        *,
        signer: Signer | None = None,
        systems: Sequence[int] = _SYSTEMS,
    ) -> None:
        self.rng = random.Random(seed)
        self.kinds = [BY_NAME[name] for name in names] or list(BY_ID.values())
        self._signer = signer
        self._systems = systems
        self._seq = 0

    def frame(self, kind: MessageType | None = None, *, whole: bool = False, **fixed: Any) -> bytes:
        """A frame of a message with senseless fields.

        Args:
            kind: the message; any if left out.
            whole: its header, length and checksum are in order.
            fixed: fields that are not left to chance.
        """
        rng = self.rng
        kind = kind or rng.choice(self.kinds)
        payload = self.payload(kind, fixed)
        self._seq = self._seq + 1 & 0xFF
        if whole:
            payload = payload.rstrip(b"\0") or payload[:1]
            return frame_of(kind, payload, seq=self._seq, sysid=255, compid=190)
        dice = rng.random()
        if dice < 0.5:
            payload = payload.rstrip(b"\0") or payload[:1]
        elif dice < 0.7:
            payload = payload[: rng.choice((0, 1, rng.randint(0, len(payload))))]
        elif dice < 0.8:
            payload = (payload + rng.randbytes(rng.randint(1, 255)))[:255]
        address: Fields = {"sysid": rng.choice(self._systems), "compid": rng.choice(_COMPONENTS), "seq": self._seq}
        dice = rng.random()
        if dice < 0.2:
            return frame_of(kind, payload, version=1, **address)
        if dice < 0.25:
            return frame_of(kind, payload, incompat=rng.randint(1, 255), compat=rng.randint(0, 255), **address)
        if dice < 0.5 and self._signer is not None:
            return frame_of(kind, payload, signer=self._signer, **address)
        if dice < 0.55:
            return frame_of(kind, payload, crc_error=rng.randint(1, 0xFFFF), **address)
        return frame_of(kind, payload, **address)

    def payload(self, kind: MessageType, fixed: Mapping[str, Any] | None = None) -> bytes:
        """The whole payload of a message: most fields extreme, targets and names that often hit."""
        given = fixed or {}
        return b"".join(
            field.pack(given[field.name]) if field.name in given else self.value(kind.name, field)
            for field in kind.fields
        )

    def value(self, message: str, field: Field) -> bytes:
        """The bytes of one field."""
        rng = self.rng
        if field.name == "target_system":
            return bytes([rng.choice((1, 1, 1, 1, 0, 2, 255))])
        if field.name == "target_component":
            return bytes([rng.choice((1, 1, 1, 0, 190, 77, 255))])
        if field.name == "param_id":
            return rng.choice(parameter_names())[:16].ljust(16, b"\0")
        if message == "FILE_TRANSFER_PROTOCOL" and field.name == "payload":
            return self.ftp()
        if rng.random() < 0.1:
            return rng.randbytes(field.size)
        if field.type == "char":
            return rng.choice((b"", b"A" * field.size, b"\xff\xfe", b"%s%n"))[: field.size].ljust(field.size, b"\0")
        form = _FORMATS[field.type]
        return b"".join(struct.pack("<" + form, self._number(field.type)) for _ in range(field.count or 1))

    def ftp(self) -> bytes:
        """A payload of MAVFTP, mostly one that makes sense up to a point."""
        rng = self.rng
        opcode = rng.choice((*range(16), 4, 5, 7, 11, 15, 128, 255))
        data = rng.choice(_PATHS) if rng.random() < 0.8 else rng.randbytes(rng.randint(0, 239))
        size = len(data) if rng.random() < 0.8 else rng.randint(0, 255)
        offset = rng.choice((0, 0, 1, 239, 4096, 1 << 20, (1 << 22) - 1, 1 << 31, 0xFFFFFFFF))
        session = rng.choice((0, 0, 0, 1, 255))
        header = _FTP.pack(rng.randint(0, 0xFFFF), session, opcode, size, 0, rng.randint(0, 1), 0, offset)
        return (header + data).ljust(251, b"\0")[:251]

    def _number(self, kind: str) -> float | int:
        rng = self.rng
        if kind in ("float", "double"):
            return rng.choice(_FLOATS) if rng.random() < 0.8 else rng.uniform(-1e3, 1e3)
        bits = int(kind.strip("uint_")) if kind.strip("uint_") else 8
        low, high = (0, (1 << bits) - 1) if kind[0] == "u" else (-(1 << bits - 1), (1 << bits - 1) - 1)
        dice = rng.random()
        if dice < 0.3:
            return rng.choice((0, 0, 1, high, low, high - 1, high // 2))
        if dice < 0.6:
            return rng.randint(0, min(high, 20))
        return rng.randint(low, high)


def mutate(rng: random.Random, data: bytes, pool: Sequence[bytes]) -> bytes:
    """Damage bytes in one to four ways: flip, insert, delete, double, splice with another frame, put in other order."""
    for _ in range(rng.randint(1, 4)):
        if not data:
            return rng.randbytes(rng.randint(0, 20))
        at = rng.randrange(len(data))
        end = min(len(data), at + rng.randint(1, 16))
        match rng.randrange(8):
            case 0:
                data = data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
            case 1:
                data = data[:at] + rng.randbytes(end - at) + data[end:]
            case 2:
                data = data[:at] + rng.choice((rng.randbytes(end - at), b"\xfd", b"\xfe")) + data[at:]
            case 3:
                data = data[:at] + data[end:]
            case 4:
                data = data[:end] + data[at:]
            case 5:
                other = rng.choice(pool)
                data = data[:at] + other[rng.randrange(len(other)) :]
            case 6:
                data = data[end:] + data[at:end] + data[:at]
            case _:
                data = data[:at]
    return data[:4096]


def damaged(rng: random.Random, frame: bytes) -> bytes:
    """A frame with damage that its checksum finds for certain: up to 16 bits behind its id, or its end cut off.

    A signed frame must not be given: damage behind its checksum is for the signature to find.
    """
    first = 10 if frame[0] == MAGIC_2 else 6
    if rng.random() < 0.2:
        return frame[: rng.randrange(1, len(frame))]
    at = rng.randrange(first, len(frame) - 1)
    bits = rng.randint(1, 0xFFFF)
    pair = int.from_bytes(frame[at : at + 2], "little") ^ bits
    return frame[:at] + pair.to_bytes(2, "little") + frame[at + 2 :]


def cut_up(rng: random.Random, data: bytes, most: int = 400) -> list[bytes]:
    """A stream in the pieces it may come in."""
    pieces = []
    while data:
        size = rng.randint(1, most)
        pieces.append(data[:size])
        data = data[size:]
    return pieces
