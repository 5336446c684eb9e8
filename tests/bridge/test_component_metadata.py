"""The metadata files: schema, checksums, and that they describe this vehicle."""

from __future__ import annotations

import json
import lzma
import math
import re
import struct
import subprocess
import sys
import zlib
from typing import Any

import pytest

from bridge.component_metadata import ComponentMetadata, describe, file_crc
from bridge.ftp_files import FileTree
from sitl.parameters import ParameterSpec, ParameterTable

GENERAL = "etc/extras/component_general.json.xz"
PARAMETERS = "etc/extras/parameters.json.xz"

# the rules of MAVLink's component_metadata/parameter.schema.json: no other key, and these kinds of values
KINDS: dict[str, Any] = {
    "name": str,
    "type": str,
    "shortDesc": str,
    "longDesc": str,
    "units": str,
    "default": (int, float),
    "decimalPlaces": int,
    "min": (int, float),
    "max": (int, float),
    "increment": (int, float),
    "rebootRequired": bool,
    "group": str,
    "category": str,
    "volatile": bool,
    "values": list,
}


def bitwise_crc(data: bytes) -> int:
    """MAVLink's CRC-32, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc


def loaded(metadata: ComponentMetadata, path: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(lzma.decompress(metadata.files()[path]), parse_constant=pytest.fail)
    return content


@pytest.fixture(scope="module")
def table() -> ParameterTable:
    return ParameterTable({"MC_ROLLRATE_P": 0.11, "CA_ROTOR_COUNT": 6})


@pytest.fixture(scope="module")
def metadata(table: ParameterTable) -> ComponentMetadata:
    return ComponentMetadata(table)


def test_the_general_file_names_the_others_with_their_checksums(metadata: ComponentMetadata) -> None:
    general = loaded(metadata, GENERAL)
    assert metadata.general_uri == f"mftp://{GENERAL}"
    assert metadata.general_crc == bitwise_crc(metadata.files()[GENERAL])
    crc = file_crc(metadata.files()[PARAMETERS])
    assert general == {
        "version": 1,
        "metadataTypes": [{"type": 1, "uri": f"mftp://{PARAMETERS}", "fileCrc": crc}],
    }


def test_the_parameters_keep_to_the_schema(metadata: ComponentMetadata, table: ParameterTable) -> None:
    content = loaded(metadata, PARAMETERS)
    # the published schema is at 3, but a PX4 writes 1 and QGroundControl takes nothing else
    assert content.keys() == {"version", "parameters"}
    assert content["version"] == 1
    assert [entry["name"] for entry in content["parameters"]] == list(table.names)
    for entry in content["parameters"]:
        assert entry.keys() <= KINDS.keys(), entry
        for key, value in entry.items():
            assert isinstance(value, KINDS[key]), (entry["name"], key)
        assert re.fullmatch(r"[.\-a-zA-Z0-9_{}]{1,16}", entry["name"])
        assert entry["type"] in ("Int32", "Float")
        assert entry.get("decimalPlaces", 0) >= 0
        for choice in entry.get("values", []):
            assert choice.keys() == {"value", "description"}


def test_they_say_what_the_vehicle_has(metadata: ComponentMetadata, table: ParameterTable) -> None:
    described = {entry["name"]: entry for entry in loaded(metadata, PARAMETERS)["parameters"]}
    assert described["MC_ROLLRATE_P"] == {
        "name": "MC_ROLLRATE_P",
        "type": "Float",
        "default": 0.11,  # the airframe's, and not 0.10999999940395355
        "category": "Standard",
        "group": "Multicopter Rate Control",
        "shortDesc": table.spec("MC_ROLLRATE_P").short,
        "min": 0.01,
        "max": 0.5,
        "increment": 0.01,
        "decimalPlaces": 3,
    }
    assert described["CA_ROTOR_COUNT"]["default"] == 6
    assert {"value": 0, "description": "never"} in described["MC_AIRMODE"]["values"]
    assert described["IMU_GYRO_CUTOFF"]["rebootRequired"] is True
    assert described["IMU_GYRO_CUTOFF"]["units"] == "Hz"
    for name, entry in described.items():
        spec, default = table.spec(name), table.default(name)
        assert ("longDesc" in entry) == (not spec.obeyed)
        if spec.type == "REAL32" and math.isfinite(default):
            assert struct.pack("<f", entry["default"]) == struct.pack("<f", default)


def test_a_default_that_json_cannot_say_is_left_out() -> None:
    spec = ParameterSpec(name="A", type="REAL32", default=math.nan, volatile=True)
    assert "default" not in describe(spec, math.nan)
    assert describe(spec, 1.5) == {
        "name": "A",
        "type": "Float",
        "default": 1.5,
        "category": "Standard",
        "group": "",
        "shortDesc": "",
        "volatile": True,
    }


def test_the_same_parameters_give_the_same_files_whatever_is_set(metadata: ComponentMetadata) -> None:
    other = ParameterTable({"MC_ROLLRATE_P": 0.11, "CA_ROTOR_COUNT": 6})
    other.set("MC_ROLLRATE_P", 0.3)
    assert ComponentMetadata(other).files() == metadata.files()
    assert ComponentMetadata(ParameterTable()).general_crc != metadata.general_crc


def test_further_files_are_named_and_served() -> None:
    text = b'{"version":2}'
    metadata = ComponentMetadata(ParameterTable(), more={4: ("all_events.json", text)})
    assert lzma.decompress(metadata.files()["etc/extras/all_events.json.xz"]) == text
    types = {entry["type"]: entry for entry in loaded(metadata, GENERAL)["metadataTypes"]}
    assert types[4]["uri"] == "mftp://etc/extras/all_events.json.xz"
    assert types[4]["fileCrc"] == file_crc(metadata.files()["etc/extras/all_events.json.xz"])
    files = FileTree()
    metadata.mount(files)
    for path, data in metadata.files().items():
        file = files.open(path)
        assert file.read(0, file.size) == data


def test_small_decoders_can_read_them(metadata: ComponentMetadata) -> None:
    for data in metadata.files().values():
        assert data[:8] == b"\xfd7zXZ\0\0\x01"  # CRC-32
        assert lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=2 << 20).decompress(data)
        assert zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF == file_crc(data)


def test_nothing_is_made_before_it_is_asked_for() -> None:
    code = (
        "import sys; from bridge.component_metadata import ComponentMetadata; from bridge.ftp_files import FileTree;"
        "from sitl.parameters import ParameterTable; sys.modules.pop('lzma', None);"
        "ComponentMetadata(ParameterTable()).mount(FileTree()); print('lzma' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
