"""Messages: what a payload's bytes mean, both ways.

The tables come from pymavlink's generated classes; packing and unpacking are our own, because pymavlink's
cost several times more per message and cannot carry every INT32 parameter through its float field.

Values in Python:

- integers are int, floats float;
- char arrays are str: cut at the first NUL when read, UTF-8, undecodable bytes shown as U+FFFD;
- uint8 arrays are bytes;
- all other arrays are tuples.

To send, a char array takes str or bytes and a uint8 array bytes or ints; both may be shorter than the field
(the rest is zero), never longer. Other arrays take any sequence of exactly the field's length. **Any field
also takes the raw bytes of its whole width**, and `Message.raw` gives them back: PX4 carries INT32 parameters
as the four bytes of a float field, and a float that goes through Python loses the patterns that are
signalling NaNs.
"""

from __future__ import annotations

import difflib
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Any

from bridge.dialect import message_classes
from bridge.errors import FieldError

_FORMATS = {
    "int8_t": "b",
    "uint8_t": "B",
    "int16_t": "h",
    "uint16_t": "H",
    "int32_t": "i",
    "uint32_t": "I",
    "int64_t": "q",
    "uint64_t": "Q",
    "float": "f",
    "double": "d",
}
MAGIC_1 = 0xFE
MAGIC_2 = 0xFD
HEADER_1 = 6
HEADER_2 = 10
SIGNED = 0x01
SIGNATURE = 13

_FAILURES = (struct.error, OverflowError, TypeError, ValueError)


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a payload.

    Attributes:
        name: MAVLink's name.
        type: MAVLink's type, for example "uint16_t"; "char" for text.
        count: elements of an array, 0 for a single value.
        offset: first byte in the full payload.
        size: width in bytes.
    """

    name: str
    type: str
    count: int
    offset: int
    size: int

    def pack(self, value: Any) -> bytes:
        """Return the field's bytes; raises one of struct.error, OverflowError, TypeError, ValueError."""
        if isinstance(value, (bytes, bytearray, memoryview)) and len(value) == self.size:
            return bytes(value)
        if self.type == "char":
            text = value.encode() if isinstance(value, str) else bytes(memoryview(value))
            return self._padded(text)
        if not self.count:
            return struct.pack("<" + _FORMATS[self.type], value)
        if self.type == "uint8_t":
            return self._padded(bytes(tuple(value)))
        if len(value) != self.count:
            raise ValueError(f"{len(value)} elements, the field has {self.count}")
        return struct.pack(f"<{self.count}{_FORMATS[self.type]}", *value)

    def packer(self) -> Callable[[Any], bytes]:
        """Return the quickest way to pack an array's usual values; it may refuse some that `pack` takes.

        Short bytes are returned as they are: the message's struct fills them up.
        """
        size = self.size
        if self.type in ("char", "uint8_t"):

            def pack_bytes(value: Any) -> bytes:
                data: bytes = value.encode() if value.__class__ is str else value
                if len(data) > size:
                    raise ValueError
                return data

            return pack_bytes

        numbers = struct.Struct(f"<{self.count}{_FORMATS[self.type]}").pack

        def pack_numbers(value: Any) -> bytes:
            if value.__class__ is bytes and len(value) == size:
                return value
            return numbers(*value)

        return pack_numbers

    def unpack(self, data: bytes) -> Any:
        """Return the value of an array field's bytes."""
        if self.type == "char":
            return data.partition(b"\0")[0].decode(errors="replace")
        if self.type == "uint8_t":
            return data
        return struct.unpack(f"<{self.count}{_FORMATS[self.type]}", data)

    def _padded(self, data: bytes) -> bytes:
        if len(data) > self.size:
            raise ValueError(f"{len(data)} bytes, the field holds {self.size}")
        return data.ljust(self.size, b"\0")


class MessageType:
    """How one kind of message looks on the wire.

    Attributes:
        name: for example "ATTITUDE".
        id: message id.
        fields: in wire order.
        size: bytes of the full payload, extension fields included.
        crc_extra: the byte that ends the checksum, so that two dialects that disagree do not understand each
            other.
    """

    __slots__ = (
        "_arrays",
        "_names",
        "_struct",
        "_take",
        "_zeros",
        "crc_extra",
        "fields",
        "id",
        "id_bytes",
        "name",
        "size",
    )

    def __init__(self, definition: Any) -> None:
        self.name: str = definition.msgname
        self.id: int = definition.id
        self.id_bytes: bytes = self.id.to_bytes(3, "little")
        self.crc_extra = bytes([definition.crc_extra])
        types = dict(zip(definition.fieldnames, definition.fieldtypes, strict=True))
        fields: list[Field] = []
        layout = "<"
        for name, count in zip(definition.ordered_fieldnames, definition.array_lengths, strict=True):
            # Text and arrays are one item of raw bytes here, so that every message has one item per field.
            raw = types[name] == "char" or count
            width = max(count, 1) * struct.calcsize("<" + _FORMATS.get(types[name], "c"))
            fields.append(Field(name, types[name], count, struct.calcsize(layout), width))
            layout += f"{width}s" if raw else _FORMATS[types[name]]
        self.fields = tuple(fields)
        self._struct = struct.Struct(layout)
        self.size = self._struct.size
        self._names = tuple(field.name for field in fields)
        self._zeros = {field.name: bytes(field.size) if field.count else 0 for field in fields}
        self._arrays = tuple(
            (index, field.packer(), field.unpack)
            for index, field in enumerate(fields)
            if field.type == "char" or field.count
        )
        take: Callable[[Any], Any] = itemgetter(*self._names)
        self._take = take if len(fields) > 1 else lambda values: (take(values),)

    def pack(self, values: Mapping[str, Any]) -> bytes:
        """Return the full payload; fields that are not given are zero.

        Raises:
            TypeError: a name that is no field of this message.
            FieldError: a value that does not fit its field.
        """
        if len(values) != len(self._names):
            values = {**self._zeros, **values}
            if len(values) != len(self._names):
                raise self._unknown(values)
        try:
            items = self._take(values)
        except KeyError:
            raise self._unknown(values) from None
        try:
            if self._arrays:
                items = list(items)
                for index, pack, _ in self._arrays:
                    items[index] = pack(items[index])
            return self._struct.pack(*items)
        except _FAILURES:
            # Raw bytes for a number, or a value that does not fit: field by field finds out which.
            return b"".join([self._pack_one(field, values[field.name]) for field in self.fields])

    def unpack(self, frame: bytes, start: int, stop: int) -> dict[str, Any]:
        """Return every field's value by name, in wire order.

        Args:
            frame: the bytes the payload is in.
            start: its first byte.
            stop: the byte behind it. Zeros that were cut off are put back, bytes of later extensions ignored.
        """
        items: Any
        if stop - start >= self.size:
            items = self._struct.unpack_from(frame, start)
        else:
            items = self._struct.unpack(frame[start:stop].ljust(self.size, b"\0"))
        if self._arrays:
            items = list(items)
            for index, _, unpack in self._arrays:
                items[index] = unpack(items[index])
        return dict(zip(self._names, items))  # noqa: B905  (the struct has one item per name)

    def _pack_one(self, field: Field, value: Any) -> bytes:
        try:
            return field.pack(value)
        except UnicodeEncodeError:
            problem = "it cannot be written as UTF-8"
        except (struct.error, OverflowError, TypeError, ValueError) as error:
            kind = f"{field.type}[{field.count}]" if field.count else field.type
            problem = f"it does not fit {kind} ({error})"
        raise FieldError(self.name, field.name, value, problem) from None

    def _unknown(self, values: Mapping[str, Any]) -> TypeError:
        strange = next(name for name in values if name not in self._zeros)
        near = difflib.get_close_matches(strange, self._names, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(self._names)}"
        return TypeError(f"{self.name} has no field {strange!r}; {hint}")

    def __repr__(self) -> str:
        return f"<MessageType {self.name} {self.id}>"


class Message:
    """One received message. Fields are attributes: `message.roll`.

    **Names of the envelope come first**: where a field is called `name`, `id` or `seq` too (STATUSTEXT.id,
    PING.seq, every MISSION item's seq, NAMED_VALUE_FLOAT.name ...), the attribute is the envelope's and the
    field is `message["id"]`. Indexing, `get` and `fields` always mean the field.

    Attributes:
        name: message name, for example "ATTITUDE".
        id: message id.
        sysid: who sent it: system.
        compid: who sent it: component.
        seq: the sender's packet counter, 0 to 255.
        signed: whether it carried a signature (which is not checked here).
        raw_frame: the whole frame as received, for logs.
    """

    __slots__ = ("__dict__", "_type", "name", "raw_frame", "sysid")

    def __init__(self, kind: MessageType, raw_frame: bytes, start: int, stop: int, sysid: int) -> None:
        self.__dict__ = kind.unpack(raw_frame, start, stop)
        self._type = kind
        self.name = kind.name
        self.raw_frame = raw_frame
        self.sysid = sysid

    @property
    def id(self) -> int:
        """Message id."""
        return self._type.id

    @property
    def seq(self) -> int:
        """The sender's packet counter, 0 to 255."""
        return self.raw_frame[4 if self.raw_frame[0] == MAGIC_2 else 2]

    @property
    def compid(self) -> int:
        """Who sent it: component."""
        return self.raw_frame[6 if self.raw_frame[0] == MAGIC_2 else 4]

    @property
    def signed(self) -> bool:
        """Whether it carried a signature (which is not checked here)."""
        return self.raw_frame[0] == MAGIC_2 and bool(self.raw_frame[2] & SIGNED)

    if TYPE_CHECKING:
        # The fields are in __dict__; which ones depends on the message.
        def __getattr__(self, field: str) -> Any: ...

    @property
    def raw_payload(self) -> bytes:
        """The payload as received: zeros at its end may be missing."""
        start = HEADER_2 if self.raw_frame[0] == MAGIC_2 else HEADER_1
        return self.raw_frame[start : start + self.raw_frame[1]]

    def fields(self) -> dict[str, Any]:
        """Return every field's value by name, in wire order."""
        return self.__dict__.copy()

    def get(self, field: str, default: Any = None) -> Any:
        """Return a field's value, or `default` where this message has no such field."""
        return self.__dict__.get(field, default)

    def raw(self, field: str) -> bytes:
        """Return a field's bytes exactly as they were sent, zeros at the end put back.

        Raises:
            KeyError: no such field.
        """
        for one in self._type.fields:
            if one.name == field:
                return self.raw_payload[one.offset : one.offset + one.size].ljust(one.size, b"\0")
        raise KeyError(f"{self.name} has no field {field!r}")

    def __getitem__(self, field: str) -> Any:
        return self.__dict__[field]

    def __repr__(self) -> str:
        text = ", ".join(f"{name}={value!r}" for name, value in self.__dict__.items())
        return f"<{self.name} from {self.sysid}/{self.compid} seq {self.seq}: {text}>"


BY_ID: dict[int, MessageType] = {number: MessageType(one) for number, one in message_classes().items()}
BY_NAME: dict[str, MessageType] = {kind.name: kind for kind in BY_ID.values()}
