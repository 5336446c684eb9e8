"""Our additions to pymavlink's dialect are MAVLink's own messages."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from bridge.dialect import froude_messages, message_classes
from bridge.dialect.generate import generate
from bridge.messages import BY_ID, BY_NAME

ROOT = Path(__file__).parents[2]

# The checksum byte MAVLink publishes for each: it hashes name, field types, names and order.
PUBLISHED = {
    "LINK_NODE_STATUS": (8, 117),
    "MISSION_CURRENT": (42, 28),
    "MISSION_COUNT": (44, 221),
    "MISSION_ACK": (47, 153),
    "COMMAND_CANCEL": (80, 14),
    "SET_ATTITUDE_TARGET": (82, 49),
    "TIMESYNC": (111, 34),
    "SERIAL_CONTROL": (126, 220),
    "ESC_INFO": (290, 251),
    "ESC_STATUS": (291, 10),
    "PROTOCOL_VERSION": (300, 217),
    "TIME_ESTIMATE_TO_TARGET": (380, 232),
    "COMPONENT_INFORMATION": (395, 0),
    "COMPONENT_INFORMATION_BASIC": (396, 50),
    "COMPONENT_METADATA": (397, 182),
    "PLAY_TUNE_V2": (400, 110),
    "EVENT": (410, 160),
    "CURRENT_EVENT_SEQUENCE": (411, 106),
    "REQUEST_EVENT": (412, 33),
    "RESPONSE_EVENT_ERROR": (413, 77),
    "AVAILABLE_MODES": (435, 134),
    "CURRENT_MODE": (436, 193),
    "AVAILABLE_MODES_MONITOR": (437, 30),
}

# Extension fields are not in the checksum, so they are held by name and width.
EXTENSIONS = {
    "MISSION_CURRENT": [("mission_id", 4), ("fence_id", 4), ("rally_points_id", 4)],
    "MISSION_COUNT": [("mission_type", 1), ("opaque_id", 4)],
    "MISSION_ACK": [("mission_type", 1), ("opaque_id", 4)],
    "SET_ATTITUDE_TARGET": [("thrust_body", 12)],
    "TIMESYNC": [("target_system", 1), ("target_component", 1)],
    "SERIAL_CONTROL": [("target_system", 1), ("target_component", 1)],
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_id_and_checksum_byte_are_the_published_ones(name: str) -> None:
    kind = BY_NAME[name]
    assert (kind.id, kind.crc_extra[0]) == PUBLISHED[name]


def test_the_file_holds_exactly_these() -> None:
    assert {kind.msgname for kind in froude_messages.mavlink_map.values()} == set(PUBLISHED)


@pytest.mark.parametrize("name", EXTENSIONS)
def test_extension_fields_end_the_message(name: str) -> None:
    expected = EXTENSIONS[name]
    assert [(field.name, field.size) for field in BY_NAME[name].fields[-len(expected) :]] == expected


def test_ours_only_adds_to_pymavlinks() -> None:
    for number, theirs in common.mavlink_map.items():
        ours = BY_ID[number]
        names = [field.name for field in ours.fields]
        assert names[: len(theirs.ordered_fieldnames)] == list(theirs.ordered_fieldnames)
        assert ours.crc_extra[0] == theirs.crc_extra
    assert len(message_classes()) == len(BY_ID) == len(BY_NAME) > 220


def test_the_generated_file_is_what_the_xml_gives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate(tmp_path / "froude_messages.py")
    capsys.readouterr()
    spec = importlib.util.spec_from_file_location("fresh_messages", tmp_path / "froude_messages.py")
    assert spec is not None
    assert spec.loader is not None
    fresh = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fresh)

    def table(module: object) -> dict[int, tuple[object, ...]]:
        return {
            number: (
                kind.msgname,
                kind.ordered_fieldnames,
                kind.fieldtypes,
                kind.array_lengths,
                kind.crc_extra,
            )
            for number, kind in module.mavlink_map.items()  # type: ignore[attr-defined]
        }

    assert table(fresh) == table(froude_messages)


def test_only_the_dialect_knows_pymavlink() -> None:
    importers = set()
    for path in (path for package in ("sitl", "bridge", "scenarios") for path in ROOT.glob(f"{package}/**/*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.split(".")[0] == "pymavlink" for name in names):
                importers.add(path.parent.relative_to(ROOT).as_posix())
    assert importers == {"bridge/dialect"}
