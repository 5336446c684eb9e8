"""One message from a flight to its live view: plain data, of a length that is known before it is read.

    LENGTHS   length of the header, of the arrays, in bytes
    header    JSON: [what, fact, ...]; where a fact holds arrays, it says of which kind and how long each is
    arrays    their bytes, one after the other

Only what is listed here can be said, and reading it makes nothing but text, numbers and arrays of them: whoever could
write into the file between the two processes could draw nonsense, and run nothing.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from scenarios.flight import Segment
from scenarios.recorder.flight_drawing import FlownVehicle
from scenarios.recorder.link_lines import LinkCounts
from sitl.airframe import Rotor
from sitl.control_loop import CONTROL_SETTINGS

LENGTHS: Final = struct.Struct("<II")
MOST_HEADER: Final = 4 << 20
MOST_ARRAYS: Final = 64 << 20
"""Bytes. A flight's summary has some thousands, a chunk of its rows some hundred thousands."""

_KINDS: Final = ("<f4", "<f8", "<i2", "<i4", "<i8", "|i1", "|u1", "|b1")


class BadMessage(ValueError):
    """Bytes that are no message, or a message that is larger than any may be."""


def encode(what: str, *about: Any) -> bytes:
    """A message's bytes.

    Args:
        what: a name of `WORDS`. about: its facts.

    Raises:
        BadMessage: it would be too large.
    """
    arrays: list[bytes] = []
    facts = _PACK[what](arrays, *about)
    header = json.dumps([what, *facts], default=_plain).encode()
    data = b"".join(arrays)
    if len(header) > MOST_HEADER or len(data) > MOST_ARRAYS:
        raise BadMessage(f"a message of {len(header)} and {len(data)} bytes: {MOST_HEADER} and {MOST_ARRAYS} at most")
    return LENGTHS.pack(len(header), len(data)) + header + data


def size_of(waiting: bytes, start: int) -> int | None:
    """How long the message is that begins here, its lengths included; None: not even these are there yet.

    Args:
        waiting: what has been read. start: where it begins.

    Raises:
        BadMessage: longer than any message may be.
    """
    if len(waiting) < start + LENGTHS.size:
        return None
    header, arrays = LENGTHS.unpack_from(waiting, start)
    if header > MOST_HEADER or arrays > MOST_ARRAYS:
        raise BadMessage(f"a message of {header} and {arrays} bytes: {MOST_HEADER} and {MOST_ARRAYS} at most")
    return LENGTHS.size + int(header) + int(arrays)


def decode(message: bytes) -> tuple[Any, ...]:
    """What was said: its name and its facts, as they were given to `encode`.

    Args:
        message: whole, its lengths included.

    Raises:
        BadMessage: it is none.
    """
    try:
        header, arrays = LENGTHS.unpack_from(message)
        what, *facts = json.loads(message[LENGTHS.size : LENGTHS.size + header])
        data = message[LENGTHS.size + header :]
        if len(data) != arrays:
            raise BadMessage(f"{len(data)} bytes of arrays where {arrays} were announced")
        return what, *_UNPACK[what](data, *facts)
    except (struct.error, LookupError, TypeError, ValueError, RecursionError) as error:
        raise BadMessage(f"no message of a flight: {error}") from error


def _plain(value: Any) -> Any:
    """A number of numpy's as one of Python's."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be told to a live view")


def _pack_facts(_: list[bytes], *facts: Any) -> tuple[Any, ...]:
    return facts


def _pack_begin(
    arrays: list[bytes], application_id: str, recording_id: str, name: str, vehicle: FlownVehicle
) -> tuple[Any, ...]:
    rotors = [[rotor.px_m, rotor.py_m, rotor.pz_m, rotor.km] for rotor in vehicle.rotors]
    if vehicle.settings is not None:
        arrays.append(vehicle.settings.tobytes())
    return application_id, recording_id, name, rotors, vehicle.frame_m


def _unpack_begin(
    data: bytes, application_id: str, recording_id: str, name: str, rotors: list[list[float]], frame_m: list[float]
) -> tuple[Any, ...]:
    length, width, height = map(float, frame_m)
    settings: NDArray[np.void] | None = np.frombuffer(data, CONTROL_SETTINGS, count=1).copy() if data else None
    places = [Rotor(*map(float, rotor)) for rotor in rotors]
    return str(application_id), str(recording_id), str(name), FlownVehicle(places, (length, width, height), settings)


def _pack_rows(arrays: list[bytes], batch: Mapping[str, NDArray[Any]]) -> tuple[Any, ...]:
    columns = []
    for name, values in batch.items():
        columns.append([name, values.dtype.str, len(values)])
        arrays.append(values.tobytes())
    return (columns,)


def _unpack_rows(data: bytes, columns: list[tuple[str, str, int]]) -> tuple[Any, ...]:
    batch: dict[str, NDArray[Any]] = {}
    start = 0
    for name, kind, count in columns:
        if kind not in _KINDS or count < 0:
            raise BadMessage(f"column {name!r} of {count} {kind!r}")
        # a copy can be written to, as a flight's own can: compiled laws take the two for different kinds of arrays
        batch[str(name)] = np.frombuffer(data, kind, count=count, offset=start).copy()
        start += batch[str(name)].nbytes
    if start != len(data):
        raise BadMessage(f"columns of {start} bytes in {len(data)}")
    return (batch,)


def _pack_segment(_: list[bytes], segment: Segment) -> tuple[Any, ...]:
    return (asdict(segment),)


def _pack_link(_: list[bytes], t_s: float, counts: LinkCounts) -> tuple[Any, ...]:
    return t_s, asdict(counts)


_PACK: Final[Mapping[str, Callable[..., tuple[Any, ...]]]] = {
    "begin": _pack_begin,
    "rows": _pack_rows,
    "event": _pack_facts,
    "faults": _pack_facts,
    "segment": _pack_segment,
    "link": _pack_link,
    "end": _pack_facts,
}
_UNPACK: Final[Mapping[str, Callable[..., tuple[Any, ...]]]] = {
    "begin": _unpack_begin,
    "rows": _unpack_rows,
    "event": lambda _, t_s, severity, text: (float(t_s), int(severity), str(text)),
    "faults": lambda _, t_s, text: (float(t_s), str(text)),
    "segment": lambda _, segment: (Segment(**segment),),
    "link": lambda _, t_s, counts: (float(t_s), LinkCounts(**counts)),
    "end": lambda _, summary, link, properties: (str(summary), str(link), dict(properties)),
}
WORDS: Final = tuple(_PACK)
"""What a flight can tell; each is a method of `live_viewer.LiveView` or of the drawing."""
