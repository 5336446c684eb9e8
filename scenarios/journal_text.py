"""What a journal of a vehicle's own parameters says: as data, and as the text of its file.

JSON with a checksum over all of it: what goes onto a vehicle must be what was read from it, to the bit.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bridge.param_operation import ParamValue
from bridge.param_protocol import TYPE_NUMBERS
from bridge.peer_identity import PeerIdentity
from sitl.errors import FileError
from sitl.parameters import NAME_LENGTH

VERSION: Final = 1

_MARK: Final = "froude_restore_journal"
_SUM: Final = "sha256"
_BITS: Final = re.compile(r"0x[0-9a-f]{8}\Z")
_TYPES: Final = {number: type_ for type_, number in TYPE_NUMBERS.items()}
_GIVE_UP: Final = "`froude restore` cannot use it; delete it to give it up"


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """One parameter: what it was, and what it was to be set to; None if only the vehicle itself may change it."""

    name: str
    value: ParamValue
    set_to: ParamValue | None = None


@dataclass(frozen=True, slots=True)
class Owner:
    """Whose parameters these are, and what for.

    Attributes:
        vehicle: the vehicle. gain_set: what was to be flown.
        run: absolute path of the run's folder, empty if nothing was kept. command: as typed.
        utc: when, as `20261122T200455Z`.
    """

    vehicle: PeerIdentity
    gain_set: str = ""
    run: str = ""
    command: tuple[str, ...] = ()
    utc: str = ""


def encode(owner: Owner, entries: Sequence[JournalEntry]) -> str:
    """The text of a journal's file.

    Args:
        owner: whose. entries: the parameters.
    """
    vehicle = owner.vehicle
    held: dict[str, Any] = {
        _MARK: VERSION,
        "utc": owner.utc,
        "command": list(owner.command),
        "gain_set": owner.gain_set,
        "run": owner.run,
        "vehicle": {"url": vehicle.url, "sysid": vehicle.sysid, "uid": vehicle.uid, "uid2": vehicle.uid2.hex()},
        "parameters": [
            {
                "name": entry.name,
                "was": _shown(entry.value),
                "set_to": None if entry.set_to is None else _shown(entry.set_to),
            }
            for entry in entries
        ],
    }
    return json.dumps(held | {_SUM: _checksum(held)}, indent=1) + "\n"


def decode(path: Path, data: bytes) -> tuple[Owner, tuple[JournalEntry, ...]]:
    """Whose parameters a file holds, and which.

    Args:
        path: of the file, for errors. data: its bytes.

    Raises:
        FileError: it is empty, damaged, of another version, or no journal at all.
    """
    if not data:
        raise FileError(path, "is empty, so nothing is known of the vehicle it was for", _GIVE_UP)
    try:
        held = json.loads(data.decode())
    except (ValueError, RecursionError):
        raise FileError(path, "is no whole JSON: it is damaged, or no journal", _GIVE_UP) from None
    if not isinstance(held, dict) or _MARK not in held:
        raise FileError(path, f"is no journal of froude: it has no {_MARK!r}", _GIVE_UP)
    if held[_MARK] != VERSION:
        problem = f"{_MARK} is {held[_MARK]!r}, this program reads {VERSION}"
        raise FileError(path, problem, "Use the version of froude that wrote it")
    if held.pop(_SUM, None) != _checksum(held):
        raise FileError(path, "its checksum is wrong: it is damaged or was changed by hand", _GIVE_UP)
    try:
        return _owner(held), tuple(_entry(item) for item in held["parameters"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileError(path, f"is no whole journal ({type(error).__name__}: {error})", _GIVE_UP) from None


def _shown(value: ParamValue) -> dict[str, Any]:
    """Type and bits are what counts; the text is for people."""
    bits = f"0x{int.from_bytes(value.raw, 'little'):08x}"
    return {"mavlink_type": TYPE_NUMBERS[value.type], "bits": bits, "text": str(value)}


def _owner(held: dict[str, Any]) -> Owner:
    vehicle = held["vehicle"]
    identity = PeerIdentity(
        str(vehicle["url"]), int(vehicle["sysid"]), int(vehicle["uid"]), bytes.fromhex(vehicle["uid2"])
    )
    command = tuple(str(word) for word in held["command"])
    return Owner(identity, str(held["gain_set"]), str(held["run"]), command, str(held["utc"]))


def _entry(item: dict[str, Any]) -> JournalEntry:
    name = item["name"]
    if not (isinstance(name, str) and name.isascii() and 1 <= len(name) <= NAME_LENGTH):
        raise ValueError(f"{name!r} is no parameter's name")

    def value(shown: dict[str, Any]) -> ParamValue:
        bits, number = shown["bits"], shown["mavlink_type"]
        if number not in _TYPES or not _BITS.match(bits):
            raise ValueError(f"{name} has type {number!r} and bits {bits!r}")
        return ParamValue(_TYPES[number], int(bits, 16).to_bytes(4, "little"))

    return JournalEntry(name, value(item["was"]), None if item["set_to"] is None else value(item["set_to"]))


def _checksum(held: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(held, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
