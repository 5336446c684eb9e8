"""ComponentMetadata: what the vehicle's parameters mean, as files for ground stations.

A ground station asks for COMPONENT_METADATA, which names the general file and its checksum; that names the file of
each kind of metadata, and those are read over MAVFTP. All are JSON, compressed as .xz, in `etc/extras` as on a PX4.
They describe this vehicle: its parameters with its airframe's defaults, and which of them it does not act on.

The same parameters give the same bytes and so the same checksums: a ground station keeps files it has.
Source: MAVLink's component metadata protocol and component_metadata/*.schema.json; PX4 src/lib/component_information.
"""

from __future__ import annotations

import functools
import math
import struct
import zlib
from collections.abc import Mapping
from typing import Any, Final

from bridge.ftp_files import FileTree
from sitl.parameters import ParameterSpec, ParameterTable

FOLDER: Final = "etc/extras"
"""Where the files are, from the root of the vehicle's file tree."""

GENERAL: Final = "component_general.json.xz"
PARAMETERS: Final = "parameters.json.xz"

PARAMETER_TYPE: Final = 1
"""COMP_METADATA_TYPE of parameters; 4 is events, 5 actuators."""

_VERSION: Final = 1  # as a PX4 writes: QGroundControl takes no other, though the parameter schema is at 3
_TYPES: Final = {"INT32": "Int32", "REAL32": "Float"}
_KEPT: Final = "Stored and answered like any other, but this vehicle does not act on it."


def file_crc(data: bytes) -> int:
    """MAVLink's checksum of a file: CRC-32 that starts at 0, without a final inversion."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def describe(spec: ParameterSpec, default: int | float) -> dict[str, Any]:
    """Describe one parameter as parameter.schema.json wants it.

    Args:
        spec: what is known of it.
        default: this vehicle's default, in the parameter's unit.
    """
    entry: dict[str, Any] = {"name": spec.name, "type": _TYPES[spec.type]}
    if math.isfinite(default):
        entry["default"] = _short(default)
    entry.update(category="Standard", group=spec.group, shortDesc=spec.short)
    if not spec.obeyed:
        entry["longDesc"] = _KEPT
    optional = {
        "units": spec.unit or None,
        "min": spec.minimum,
        "max": spec.maximum,
        "increment": spec.increment,
        "decimalPlaces": spec.decimals,
        "rebootRequired": spec.reboot or None,
        "volatile": spec.volatile or None,
        "values": [{"value": value, "description": text} for value, text in spec.values.items()] or None,
    }
    entry.update((key, value) for key, value in optional.items() if value is not None)
    return entry


class ComponentMetadata:
    """The metadata files of one vehicle, made when they are first asked for.

    Args:
        table: its parameters.
        more: further files by COMP_METADATA_TYPE: the name, ending in ".json", and the JSON text.

    Attributes:
        general_uri: for COMPONENT_METADATA.uri and COMPONENT_INFORMATION.general_metadata_uri.
    """

    general_uri: Final = f"mftp://{FOLDER}/{GENERAL}"

    def __init__(self, table: ParameterTable, *, more: Mapping[int, tuple[str, bytes]] | None = None) -> None:
        self._table = table
        self._more = dict(more or {})

    @property
    def general_crc(self) -> int:
        """Checksum of the general file, for COMPONENT_METADATA.file_crc."""
        return file_crc(self.files()[f"{FOLDER}/{GENERAL}"])

    def files(self) -> Mapping[str, bytes]:
        """Return the files by their path in the vehicle's file tree."""
        return self._files

    def mount(self, files: FileTree) -> None:
        """Hang the files into a tree; their content is made when it is first needed."""
        for name in (GENERAL, PARAMETERS, *(f"{name}.xz" for name, _ in self._more.values())):
            path = f"{FOLDER}/{name}"
            files.add(path, functools.partial(self._content, path))

    def _content(self, path: str) -> bytes:
        return self.files()[path]

    @functools.cached_property
    def _files(self) -> dict[str, bytes]:
        """All files; the general one last, because it holds the checksums of the others."""
        table = self._table
        parameters = [describe(table.spec(name), table.default(name)) for name in table]
        made = {PARAMETER_TYPE: (PARAMETERS, _compress(_json({"version": _VERSION, "parameters": parameters})))}
        made.update((kind, (f"{name}.xz", _compress(text))) for kind, (name, text) in self._more.items())
        types = [
            {"type": kind, "uri": f"mftp://{FOLDER}/{name}", "fileCrc": file_crc(data)}
            for kind, (name, data) in sorted(made.items())
        ]
        general = _compress(_json({"version": _VERSION, "metadataTypes": types}))
        files = {f"{FOLDER}/{name}": data for name, data in made.values()}
        return {**files, f"{FOLDER}/{GENERAL}": general}


def _json(content: Mapping[str, Any]) -> bytes:
    """Return JSON without blanks, which are what takes longest to read over a radio."""
    import json

    return json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


@functools.lru_cache(maxsize=8)  # vehicles of one kind have the same files
def _compress(data: bytes) -> bytes:
    """Return an .xz file that small decoders can read: one block, CRC-32, a dictionary of 1 MiB."""
    import lzma

    filters = [{"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 1 << 20}]
    return lzma.compress(data, lzma.FORMAT_XZ, check=lzma.CHECK_CRC32, filters=filters)


def _short(value: int | float) -> int | float:
    """Return the number with the fewest digits that is the same float32: 0.15, not 0.15000000596."""
    if isinstance(value, int):
        return value
    raw = struct.pack("<f", value)
    return next(short for digits in range(1, 18) if struct.pack("<f", short := float(f"{value:.{digits}g}")) == raw)
