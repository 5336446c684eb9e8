"""All parameters in one file, `@PARAM/param.pck`: what ground stations read over MAVFTP instead of asking for a list.

The format is ArduPilot's (libraries/AP_Filesystem/AP_Filesystem_Param.cpp); a PX4 has no such file and its ground
stations then ask for the list. Header: magic, number of parameters here, number of parameters, each uint16. Then for
each parameter, sorted by name: type (3 int32, 4 float) with bit 4 set if a default follows the value; how many
characters of the name are the previous one's (low half) and how many follow, less one (high half); those; value;
default. All little-endian.

ArduPilot makes its file while it is being read and pads it with zeros so that no value crosses two packets. Ours
stays the same for as long as it is open, so it needs no padding.
"""

from __future__ import annotations

import struct
from typing import Final

from bridge.ftp_files import FileTree
from sitl.parameters import ParameterTable, to_raw

PATH: Final = "@PARAM/param.pck"
"""Where ground stations look for it."""

MAGIC: Final = 0x671B
MAGIC_DEFAULTS: Final = 0x671C
TYPES: Final = {"INT32": 3, "REAL32": 4}
"""Type numbers of the format."""

_HAS_DEFAULT: Final = 0x10
_MOST_IN_COMMON: Final = 15


def pack_parameters(table: ParameterTable, *, defaults: bool = False) -> bytes:
    """Return the file as of now.

    Args:
        table: the vehicle's parameters.
        defaults: add the default of each parameter that is not at it.
    """
    out = [struct.pack("<HHH", MAGIC_DEFAULTS if defaults else MAGIC, len(table), len(table))]
    previous = ""
    for name in table:
        type_ = table.spec(name).type
        value = table.raw(name)
        kind = TYPES[type_]
        if defaults:
            default = to_raw(name, type_, table.default(name))
            if default != value:
                kind |= _HAS_DEFAULT
                value += default
        common = _in_common(previous, name)
        rest = name[common:].encode()
        out.append(bytes((kind, common | len(rest) - 1 << 4)) + rest + value)
        previous = name
    return b"".join(out)


def _in_common(previous: str, name: str) -> int:
    """How many characters of a name are the previous one's; at least one is left over."""
    most = min(_MOST_IN_COMMON, len(name) - 1)
    return next((index for index in range(most) if name[: index + 1] != previous[: index + 1]), most)


def serve_parameters(files: FileTree, table: ParameterTable, *, defaults: bool = False) -> None:
    """Hang the file into a tree; like on an ArduPilot it opens by its path and is listed nowhere.

    Args:
        files: the tree.
        table: the vehicle's parameters.
        defaults: also answer `@PARAM/param.pck?withdefaults=1`. MAVProxy asks for that first and then takes every
            parameter for a float (mavproxy_param.py, ftp_callback), so that its `param set` of an INT32 is
            refused for its type; told that there is none it asks for the list, which has the types.
    """
    made: dict[bool, tuple[int, bytes]] = {}

    def packed(with_defaults: bool) -> bytes:
        if made.get(with_defaults, (-1, b""))[0] != table.revision:
            made[with_defaults] = (table.revision, pack_parameters(table, defaults=with_defaults))
        return made[with_defaults][1]

    files.add(PATH, lambda: packed(False), listed=False)
    if defaults:
        files.add(f"{PATH}?withdefaults=1", lambda: packed(True), listed=False)
