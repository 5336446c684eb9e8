"""The bytes of ULog: what a reader that knows nothing but the format's description makes of them."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge import ulog
from bridge.ulog import Layout
from bridge.ulog_ring import FAST_TOPICS
from bridge.ulog_topics import StateTopics
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

SIZES = {"uint64_t": 8, "int64_t": 8, "double": 8, "uint32_t": 4, "int32_t": 4, "float": 4, "uint16_t": 2, "int16_t": 2}


def messages(data: bytes) -> list[tuple[str, bytes]]:
    """Letter and payload of every message; fails on anything left over."""
    out, at = [], 0
    while at < len(data):
        size, kind = struct.unpack_from("<HB", data, at)
        out.append((chr(kind), data[at + 3 : at + 3 + size]))
        at += 3 + size
    assert at == len(data)
    return out


def declared(layout: Layout) -> list[tuple[str, int, str]]:
    """(type, elements, name) as a reader takes them from the format message."""
    ((kind, payload),) = messages(layout.definition())
    assert kind == "F"
    topic, fields = payload.decode().split(":")
    assert topic == layout.topic
    assert fields.endswith(";")
    out = []
    for field in fields[:-1].split(";"):
        type_, name = field.split(" ")
        base, _, count = type_.rstrip("]").partition("[")
        out.append((base, int(count or 1), name))
    return out


def all_layouts() -> list[Layout]:
    vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"))
    slow = StateTopics(vehicle, system_id=1, profile=1).topics  # type: ignore[arg-type]
    return [topic.layout for topic in FAST_TOPICS] + [topic.layout for topic in slow]


@pytest.mark.parametrize("layout", all_layouts(), ids=lambda layout: layout.topic)
def test_topics_stand_as_px4_keeps_them_in_memory(layout):
    fields = declared(layout)
    assert fields[0] == ("uint64_t", 1, "timestamp")
    names = [name for _, _, name in fields]
    assert len(set(names)) == len(names)
    widths = [SIZES.get(type_, 1) for type_, _, _ in fields]
    assert widths == sorted(widths, reverse=True), "wider fields after narrower ones would need a gap"
    total = sum(width * count for width, (_, count, _) in zip(widths, fields, strict=True))
    assert total % 8 == 0, "the format is padded to eight bytes"
    padding = sum(count for _, count, name in fields if name.startswith("_padding"))
    assert layout.size == total - padding, "what is written leaves the padding at the end out"
    assert padding < 8
    assert names[-1] == "_padding0" or not padding


def test_a_sample_read_back_by_its_format():
    layout = Layout("thing", "uint64_t timestamp;float[2] pair;int16_t small;bool flag")
    ((kind, payload),) = messages(layout.pack(513, (77, 1.5, -2.0, -3, True)))
    assert kind == "D"
    assert struct.unpack("<HQ2fh?", payload) == (513, 77, 1.5, -2.0, -3, True)
    assert declared(layout)[-1] == ("uint8_t", 5, "_padding0")
    rows = layout.rows(513, 2)
    rows["timestamp"], rows["pair"], rows["small"], rows["flag"] = (77, 78), (1.5, -2.0), -3, True
    first, second = messages(rows.tobytes())
    assert first == ("D", payload)
    assert second[1][2:10] == (78).to_bytes(8, "little")


@given(st.lists(st.floats(width=64), min_size=2, max_size=2))
def test_no_number_is_too_big_for_a_sample(pair):
    layout = Layout("thing", "uint64_t timestamp;float[2] pair")
    ((_, payload),) = messages(layout.pack(0, (1, *pair)))
    for wanted, got in zip(pair, struct.unpack("<2f", payload[10:]), strict=True):
        assert math.isnan(got) == math.isnan(wanted)
        if math.isfinite(wanted):
            assert got == pytest.approx(min(max(wanted, -3.4028235e38), 3.4028235e38), rel=1e-6, abs=1e-44)


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ("uint64_t timestamp;bool flag;float x", "widest first"),
        ("uint64_t timestamp;string text", "no type string"),
        ("uint64_t time", "want timestamp"),
    ],
)
def test_a_layout_that_no_reader_could_use_is_refused(fields, complaint):
    with pytest.raises(ValueError, match=complaint):
        Layout("thing", fields)


@given(st.integers(-5, 20), st.integers(0, 2**63), st.text(max_size=700))
def test_texts_are_cut_to_whole_characters(severity, time_us, text):
    ((kind, payload),) = messages(ulog.logged_text(severity, time_us, text))
    assert kind == "L"
    assert ord("0") <= payload[0] <= ord("7")
    assert int.from_bytes(payload[1:9], "little") == time_us
    logged = payload[9:].decode()
    assert len(payload) - 9 <= ulog.MAX_TEXT
    assert text.encode(errors="replace").decode().startswith(logged)


def test_the_beginning_of_a_file():
    data = ulog.header(12345)
    assert data[:8] == b"ULog\x01\x12\x35\x01"
    assert int.from_bytes(data[8:], "little") == 12345
    ((kind, payload),) = messages(ulog.flag_bits())
    assert (kind, len(payload)) == ("B", 40)
    assert payload[0] == 1  # defaults are there
    assert not any(payload[1:])  # nothing that a reader must refuse, nothing appended


def test_information_parameters_and_marks():
    ((_, text), (_, number), (_, part)) = messages(
        ulog.info("sys_name", "PX4") + ulog.info("ver", 7) + ulog.info_multiple("page", "ab", continued=True)
    )
    assert text == b"\x10char[3] sys_namePX4"
    assert number == b"\x0cuint32_t ver" + bytes((7, 0, 0, 0))
    assert part == b"\x01\x0cchar[2] pageab"
    ((_, value), (_, default)) = messages(
        ulog.parameter("float", "A_B", b"\1\2\3\4") + ulog.parameter_default("float", "A_B", b"\5\6\7\x08", 3)
    )
    assert value == b"\x09float A_B\1\2\3\4"
    assert default == b"\x03\x09float A_B\5\6\7\x08"
    assert messages(ulog.dropout(70_000)) == [("O", b"\xff\xff")]
    assert messages(ulog.sync()) == [("S", ulog.SYNC_MAGIC)]
    assert messages(ulog.subscription(5, "thing", 1)) == [("A", b"\x01\x05\x00thing")]
    with pytest.raises(ValueError, match="too long"):
        ulog.info("x" * 300, 1)
