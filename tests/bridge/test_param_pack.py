"""The packed parameter file, against a reader of its own and MAVProxy's."""

from __future__ import annotations

import importlib
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.ftp_files import FileTree
from bridge.param_pack import PATH, pack_parameters, serve_parameters
from sitl.parameters import ParameterTable, to_raw

Unpacked = dict[str, tuple[int, bytes, bytes | None]]


def unpack(data: bytes) -> tuple[int, Unpacked]:
    """Magic, and type, value and default of each parameter; written after ArduPilot's description of the format."""
    magic, count, total = struct.unpack_from("<HHH", data)
    assert count == total
    found: Unpacked = {}
    name, at = b"", 6
    while at < len(data):
        kind, lengths = data[at], data[at + 1]
        assert kind & 15 in (3, 4)
        own = (lengths >> 4) + 1
        name = name[: lengths & 15] + data[at + 2 : at + 2 + own]
        at += 2 + own
        value, default = data[at : at + 4], None
        at += 4
        if kind & 16:
            assert magic == 0x671C
            default, at = data[at : at + 4], at + 4
        found[name.decode()] = kind & 15, value, default
    assert at == len(data)
    assert len(found) == count
    return magic, found


@settings(max_examples=30, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(min_size=4, max_size=4)), max_size=20))
def test_every_parameter_comes_back_bit_for_bit(changes: list[tuple[int, bytes]]) -> None:
    table = ParameterTable({"MC_ROLLRATE_P": 0.11, "CA_ROTOR_COUNT": 6})
    for index, raw in changes:
        table.set_raw(table.names[index % len(table)], raw)
    magic, plain = unpack(pack_parameters(table))
    assert (magic, tuple(plain)) == (0x671B, table.names)
    magic, full = unpack(pack_parameters(table, defaults=True))
    assert (magic, tuple(full)) == (0x671C, table.names)
    for name in table:
        type_ = table.spec(name).type
        default = to_raw(name, type_, table.default(name))
        kind = 3 if type_ == "INT32" else 4
        assert plain[name] == (kind, table.raw(name), None)
        assert full[name] == (kind, table.raw(name), None if default == table.raw(name) else default)


def test_it_is_the_file_of_now_and_listed_nowhere() -> None:
    table, files = ParameterTable(), FileTree()
    serve_parameters(files, table)
    before = files.open(PATH)
    table.set("MC_ROLLRATE_P", 0.25)
    after = files.open(PATH)
    values = [unpack(file.read(0, file.size))[1]["MC_ROLLRATE_P"][1] for file in (before, after)]
    assert values == [struct.pack("<f", 0.15), struct.pack("<f", 0.25)]
    assert len(files.entries("/")) == 2


def test_the_file_with_defaults_is_served_when_asked_for() -> None:
    table, files = ParameterTable(), FileTree()
    serve_parameters(files, table)
    with pytest.raises(FileNotFoundError):
        files.open(f"{PATH}?withdefaults=1")
    serve_parameters(files, table, defaults=True)
    file = files.open(f"{PATH}?withdefaults=1")
    assert unpack(file.read(0, file.size))[0] == 0x671C


@pytest.mark.parametrize("module", ["MAVProxy.modules.lib.param_ftp", "pymavlink.mavftp"])
@pytest.mark.parametrize("defaults", [False, True])
def test_ground_stations_read_it(module: str, defaults: bool) -> None:
    pytest.importorskip(module.partition(".")[0])
    reader = importlib.import_module(module)
    decode = getattr(reader, "ftp_param_decode", None) or reader.MAVFTP.ftp_param_decode
    table = ParameterTable()
    table.set("MC_ROLLRATE_P", 0.25)
    table.set("MC_AIRMODE", 2)
    found = decode(pack_parameters(table, defaults=defaults))
    got = {name.decode(): (value, kind) for name, value, kind in found.params}
    assert got == {name: (table.get(name), 3 if table.spec(name).type == "INT32" else 4) for name in table}
    if defaults:
        assert {name.decode(): value for name, value, _ in found.defaults} == {
            name: table.default(name) for name in table
        }
