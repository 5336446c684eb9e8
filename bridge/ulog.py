"""ULog, PX4's log format: what the bytes of a file mean; no file is opened here.

A file is a 16-byte header, definitions (flag bits, formats, information, parameters) and data (subscriptions, samples,
texts, changed parameters, marks). Everything is little-endian. A message is its size (uint16), one letter and `size`
bytes.

Fields of a format stand widest first, as PX4's uORB keeps them in memory, so no gap lies between them. What remains to
a multiple of eight bytes is declared as `_padding0` at the end and not written with the samples: that is PX4's rule and
what pyulog, PlotJuggler and Flight Review expect.

Source: PX4's documentation "ULog file format", src/modules/logger.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

MAGIC: Final = b"ULog\x01\x12\x35\x01"
SYNC_MAGIC: Final = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))

MAX_TEXT: Final = 500
"""Longest logged text, bytes; longer ones are cut."""

SYSTEM_DEFAULT, SETUP_DEFAULT = 1, 2
"""Bits of a parameter default: PX4's own, the airframe's."""

_HAS_DEFAULTS = 1
"""Compatibility flag: parameter defaults are in the file."""

_TYPES: Final[dict[str, tuple[str, str, int]]] = {
    "uint64_t": ("Q", "<u8", 8),
    "int64_t": ("q", "<i8", 8),
    "double": ("d", "<f8", 8),
    "uint32_t": ("I", "<u4", 4),
    "int32_t": ("i", "<i4", 4),
    "float": ("f", "<f4", 4),
    "uint16_t": ("H", "<u2", 2),
    "int16_t": ("h", "<i2", 2),
    "uint8_t": ("B", "u1", 1),
    "int8_t": ("b", "i1", 1),
    "bool": ("?", "?", 1),
    "char": ("c", "S1", 1),
}
"""ULog's type -> code of struct, of numpy, width in bytes."""

_FLOAT32_MAX = 3.4028234663852886e38


def message(kind: str, payload: bytes) -> bytes:
    """One message. Raises ValueError for more than 65535 bytes. kind: its letter."""
    if len(payload) > 0xFFFF:
        raise ValueError(f"a ULog message {kind} of {len(payload)} bytes; it holds 65535")
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def header(start_us: int) -> bytes:
    """First 16 bytes of a file. start_us: vehicle time of its first sample, us."""
    return MAGIC + struct.pack("<Q", start_us)


def flag_bits() -> bytes:
    """The message every file has first: parameter defaults are in it, nothing was appended."""
    return message("B", bytes((_HAS_DEFAULTS, *[0] * 7)) + bytes(8) + struct.pack("<3Q", 0, 0, 0))


def _keyed(type_: str, name: str, value: bytes) -> bytes:
    key = f"{type_} {name}".encode()
    if len(key) > 255:
        raise ValueError(f"the ULog key {name!r} is too long")
    return bytes((len(key),)) + key + value


def _information(name: str, value: str | int, type_: str) -> bytes:
    if isinstance(value, str):
        text = value.encode()
        return _keyed(f"char[{len(text)}]", name, text)
    return _keyed(type_, name, struct.pack("<" + _TYPES[type_][0], value))


def info(name: str, value: str | int, type_: str = "uint32_t") -> bytes:
    """One fact about the vehicle.

    Args:
        name: PX4's key, such as ver_hw. value: text or a whole number. type_: of a number.
    """
    return message("I", _information(name, value, type_))


def info_multiple(name: str, value: str, *, continued: bool = False) -> bytes:
    """A fact that comes several times, or a part of a long one. continued: belongs to the one before."""
    return message("M", bytes((continued,)) + _information(name, value, "uint32_t"))


def parameter(type_: str, name: str, raw: bytes) -> bytes:
    """A parameter's value, at first or when it changed. type_: int32_t or float; raw: its four bytes."""
    return message("P", _keyed(type_, name, raw))


def parameter_default(type_: str, name: str, raw: bytes, kinds: int) -> bytes:
    """A parameter's default, written where it is not the value. kinds: SYSTEM_DEFAULT, SETUP_DEFAULT or both."""
    return message("Q", bytes((kinds,)) + _keyed(type_, name, raw))


def subscription(message_id: int, topic: str, multi_id: int = 0) -> bytes:
    """From here on samples of `topic` come under this id. multi_id: instance of the topic."""
    return message("A", struct.pack("<BH", multi_id, message_id) + topic.encode())


def logged_text(severity: int, time_us: int, text: str) -> bytes:
    """A line for people, cut at MAX_TEXT bytes. severity: MAV_SEVERITY, 0..7; time_us: vehicle time."""
    data = text.encode(errors="replace")[:MAX_TEXT].decode(errors="ignore").encode()
    return message("L", struct.pack("<BQ", ord("0") + min(max(severity, 0), 7), time_us) + data)


def dropout(duration_ms: int) -> bytes:
    """Samples are missing here for so long, ms."""
    return message("O", struct.pack("<H", min(max(duration_ms, 0), 0xFFFF)))


def sync() -> bytes:
    """A mark from which a reader of a damaged file can go on."""
    return message("S", SYNC_MAGIC)


class Layout:
    """The fields of one topic and how a sample of it is written.

    Args:
        topic: uORB's name.
        fields: ULog's format text without the topic, such as ``"uint64_t timestamp;float[4] q"``; widest first,
            the time stamp first of all, without padding.

    Raises:
        ValueError: an unknown type, or a field that is wider than the one before it.
    """

    def __init__(self, topic: str, fields: str) -> None:
        self.topic = topic
        self.names: tuple[str, ...] = ()
        codes, numpy_fields, size, last = "", [], 0, 8
        for field in fields.replace("\n", "").split(";"):
            type_, name = field.split()
            base, _, count = type_.rstrip("]").partition("[")
            if base not in _TYPES:
                raise ValueError(f"{topic}.{name}: ULog has no type {type_}")
            code, numpy_code, width = _TYPES[base]
            if width > last:
                raise ValueError(f"{topic}.{name}: a {type_} after narrower fields; write the widest first")
            last = width
            number = int(count) if count else 1
            codes += f"{number}{code}"
            numpy_fields.append((name, numpy_code, (number,)) if count else (name, numpy_code))
            size += number * width
            self.names += (name,)
        if self.names[0] != "timestamp":
            raise ValueError(f"{topic}: its first field is {self.names[0]}, want timestamp")
        self.size = size
        """Bytes of a sample without the message's frame, without padding."""
        padding = -size % 8
        text = ";".join(field.strip() for field in fields.replace("\n", "").split(";")) + ";"
        self.format = f"{topic}:{text}" + (f"uint8_t[{padding}] _padding0;" if padding else "")
        self._struct = struct.Struct("<HBH" + codes)
        self._dtype = np.dtype([("_size", "<u2"), ("_kind", "u1"), ("_id", "<u2"), *numpy_fields])

    def definition(self) -> bytes:
        """The format message."""
        return message("F", self.format.encode())

    def pack(self, message_id: int, values: Sequence[Any]) -> bytes:
        """One sample as a data message.

        Args:
            message_id: of the subscription.
            values: every element in the order of the fields, arrays flattened. What a float32 cannot hold is cut.
        """
        try:
            return self._struct.pack(self.size + 2, ord("D"), message_id, *values)
        except OverflowError:
            cut = (
                min(max(value, -_FLOAT32_MAX), _FLOAT32_MAX)
                if isinstance(value, float) and math.isfinite(value)
                else value
                for value in values
            )
            return self._struct.pack(self.size + 2, ord("D"), message_id, *cut)

    def rows(self, message_id: int, count: int) -> NDArray[np.void]:
        """`count` samples to be filled by field name; ``tobytes()`` gives their data messages."""
        rows = np.zeros(count, self._dtype)
        rows["_size"], rows["_kind"], rows["_id"] = self.size + 2, ord("D"), message_id
        return rows
