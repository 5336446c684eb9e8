"""The codec against pymavlink's own, for every message there is, and the values it must refuse."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from bridge.connection import Connection
from bridge.dialect import froude_messages, message_classes
from bridge.errors import FieldError
from bridge.messages import BY_ID, BY_NAME, Field, MessageType

WIDTHS = {"int8_t": 8, "int16_t": 16, "int32_t": 32, "int64_t": 64}


def random_value(field: Field, rng: np.random.Generator) -> Any:
    """A value the field can carry, the extremes among them."""
    if field.type == "char":
        return "".join(chr(c) for c in rng.integers(32, 127, rng.integers(0, field.size + 1)))
    if field.count:
        one = Field(field.name, field.type, 0, 0, field.size // field.count)
        return [random_value(one, rng) for _ in range(field.count)]
    if field.type in ("float", "double"):
        raw = rng.bytes(field.size)
        value = struct.unpack("<f" if field.type == "float" else "<d", raw)[0]
        return 0.0 if math.isnan(value) else value
    bits = WIDTHS[field.type.removeprefix("u")]
    low, high = (0, 2**bits - 1) if field.type[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    choice = rng.integers(5)
    if choice < 3:
        return (low, high, 0)[choice]
    return low + int.from_bytes(rng.bytes(8), "little") % (high - low + 1)


def zero(field: Field) -> Any:
    """What a field holds that nobody set."""
    if field.type == "char":
        return ""
    if field.type == "uint8_t" and field.count:
        return bytes(field.count)
    return (0,) * field.count if field.count else 0


def oracle(kind: MessageType) -> tuple[Any, Any]:
    """pymavlink's class of this message, and a fresh pymavlink connection that knows it."""
    module = froude_messages if kind.id in froude_messages.mavlink_map else common
    return message_classes()[kind.id], module.MAVLink(None, 7, 9)


def theirs(kind: MessageType, values: dict[str, Any]) -> bytes:
    """The frame pymavlink makes of these values."""
    definition, mav = oracle(kind)
    arguments = {name: value.encode() if isinstance(value, str) else value for name, value in values.items()}
    return bytes(definition(**arguments).pack(mav))


@pytest.mark.parametrize("kind", BY_ID.values(), ids=lambda kind: kind.name)
def test_every_message_agrees_with_pymavlink_both_ways(kind: MessageType) -> None:
    rng = np.random.default_rng(kind.id)
    for _ in range(4):
        values = {field.name: random_value(field, rng) for field in kind.fields}
        frame = Connection(7, 9).encode(kind.name, **values)
        assert frame == theirs(kind, values)

        _, mav = oracle(kind)
        decoded = mav.parse_buffer(frame)[0]
        (message,) = Connection(1, 1).receive(frame)
        for field in kind.fields:
            expected = getattr(decoded, field.name)
            seen = message[field.name]
            assert (list(seen) if field.count and field.type != "char" else seen) == expected, field.name


@given(data=st.data())
def test_any_values_round_trip(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(sorted(BY_ID.values(), key=lambda one: one.id)))
    values = {}
    for field in kind.fields:
        if data.draw(st.booleans()):
            rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
            values[field.name] = random_value(field, rng)
    (message,) = Connection(1, 1).receive(Connection(7, 9).encode(kind.name, **values))
    for field in kind.fields:
        expected = values.get(field.name, zero(field))
        seen = message[field.name]
        assert (tuple(seen) if isinstance(expected, list) else seen) == (
            tuple(expected) if isinstance(expected, list) else expected
        )


def test_missing_fields_are_zero_and_trailing_zeros_are_not_sent() -> None:
    frame = Connection(1, 1).encode("ATTITUDE")
    assert frame[1] == 1  # one byte of payload is always sent
    (message,) = Connection(1, 1).receive(frame)
    assert message.raw_payload == b"\0"
    assert message.fields() == dict.fromkeys(
        ["time_boot_ms", "roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"], 0
    )


@given(bits=st.integers(0, 2**32 - 1))
def test_the_four_bytes_of_a_parameter_survive_whatever_they_are(bits: int) -> None:
    raw = bits.to_bytes(4, "little")
    frame = Connection(1, 1).encode("PARAM_VALUE", param_id="CAL_GYRO0_ID", param_value=raw, param_type=6)
    (message,) = Connection(1, 1).receive(frame)
    assert message.raw("param_value") == raw
    assert message.param_id == "CAL_GYRO0_ID"


def test_a_signalling_nan_pattern_is_what_a_python_float_would_lose() -> None:
    raw = struct.pack("<i", -8388607)
    quiet = struct.pack("<f", struct.unpack("<f", raw)[0])
    frame = Connection(1, 1).encode("PARAM_SET", param_id="X", param_value=raw, param_type=6)
    assert Connection(1, 1).receive(frame)[0].raw("param_value") == raw
    if quiet == raw:
        pytest.skip("this Python keeps signalling NaNs")
    assert quiet != raw


def test_raw_bytes_put_back_zeros_that_were_cut() -> None:
    (message,) = Connection(1, 1).receive(Connection(1, 1).encode("PARAM_SET", param_value=1.0, param_id="A"))
    assert message.raw("param_id") == b"A" + bytes(15)
    assert message.raw("param_type") == b"\0"
    with pytest.raises(KeyError, match="PARAM_SET has no field 'gain'"):
        message.raw("gain")


def test_a_name_of_sixteen_characters_needs_no_nul() -> None:
    frame = Connection(1, 1).encode("PARAM_REQUEST_READ", param_id="SIXTEEN_LETTERS_", param_index=-1)
    (message,) = Connection(1, 1).receive(frame)
    assert (message.param_id, message.param_index) == ("SIXTEEN_LETTERS_", -1)


def test_text_is_utf8_and_cut_at_the_first_nul() -> None:
    kind = BY_NAME["STATUSTEXT"]
    frame = Connection(1, 1).encode("STATUSTEXT", text="Überschwinger 12 %")
    assert Connection(1, 1).receive(frame)[0].text == "Überschwinger 12 %"
    frame = Connection(1, 1).encode("STATUSTEXT", text=b"ready\0left over")
    assert Connection(1, 1).receive(frame)[0].text == "ready"
    frame = Connection(1, 1).encode("STATUSTEXT", text=b"bad \xff byte")
    assert Connection(1, 1).receive(frame)[0].text == "bad \ufffd byte"
    assert kind.pack({"text": "x" * 50})[1:51] == b"x" * 50


def test_byte_arrays_are_bytes_and_may_be_short() -> None:
    frame = Connection(1, 1).encode("FILE_TRANSFER_PROTOCOL", payload=b"\1\2\3")
    assert Connection(1, 1).receive(frame)[0].payload == b"\1\2\3" + bytes(248)
    frame = Connection(1, 1).encode("EVENT", arguments=[5, 6])
    assert Connection(1, 1).receive(frame)[0].arguments == b"\5\6" + bytes(38)


def test_other_arrays_are_tuples_and_take_any_sequence() -> None:
    q = np.array([0.5, -0.5, 0.5, 0.5])
    frame = Connection(1, 1).encode("SET_ATTITUDE_TARGET", q=q)
    assert Connection(1, 1).receive(frame)[0].q == (0.5, -0.5, 0.5, 0.5)


def test_numpy_scalars_and_infinities_are_numbers() -> None:
    fields = {"time_boot_ms": np.uint32(7), "roll": np.float64(0.25), "yaw": math.inf}
    frame = Connection(1, 1).encode("ATTITUDE", **fields)
    (message,) = Connection(1, 1).receive(frame)
    assert (message.time_boot_ms, message.roll, message.yaw) == (7, 0.25, math.inf)
    frame = Connection(1, 1).encode("VFR_HUD", airspeed=math.nan)
    assert math.isnan(Connection(1, 1).receive(frame)[0].airspeed)


@pytest.mark.parametrize(
    ("name", "fields", "text"),
    [
        ("PARAM_VALUE", {"param_count": 70_000}, r"PARAM_VALUE\.param_count = 70000: .*uint16_t"),
        ("PARAM_VALUE", {"param_index": -1}, r"PARAM_VALUE\.param_index = -1"),
        ("ATTITUDE", {"roll": 1e39}, r"ATTITUDE\.roll = 1e\+39: it does not fit float"),
        ("ATTITUDE", {"roll": None}, r"ATTITUDE\.roll = None"),
        ("ATTITUDE", {"roll": "0.1"}, r"ATTITUDE\.roll = '0\.1'"),
        ("ATTITUDE", {"roll": b"123"}, r"ATTITUDE\.roll = b'123'"),
        ("HEARTBEAT", {"type": 2.5}, r"HEARTBEAT\.type = 2\.5"),
        ("PARAM_SET", {"param_id": "A" * 17}, r"PARAM_SET\.param_id = 'A+': .*17 bytes, the field holds 16"),
        ("PARAM_SET", {"param_id": "\ud800"}, r"PARAM_SET\.param_id"),
        ("SET_ATTITUDE_TARGET", {"q": (1, 0, 0)}, r"q = \(1, 0, 0\): .*3 elements, the field has 4"),
        ("SET_ATTITUDE_TARGET", {"q": 1.0}, r"SET_ATTITUDE_TARGET\.q = 1\.0"),
        ("FILE_TRANSFER_PROTOCOL", {"payload": bytes(252)}, r"252 bytes, the field holds 251"),
        ("EVENT", {"arguments": [256]}, r"EVENT\.arguments = \[256\]"),
    ],
)
def test_a_value_that_does_not_fit_is_refused_by_name(name: str, fields: dict[str, Any], text: str) -> None:
    connection = Connection(1, 1)
    with pytest.raises(FieldError, match=text) as caught:
        connection.encode(name, **fields)
    assert isinstance(caught.value, ValueError)
    assert connection.encode("HEARTBEAT")[4] == 0  # a refused message takes no packet number


def test_a_misspelt_field_is_named_with_the_nearest() -> None:
    with pytest.raises(TypeError, match="ATTITUDE has no field 'roll_speed'; did you mean 'rollspeed'"):
        Connection(1, 1).encode("ATTITUDE", roll_speed=1.0)
    complete = dict.fromkeys(["time_boot_ms", "roll", "pitch", "yaw", "rollspeed", "pitchspeed"], 0)
    with pytest.raises(TypeError, match="no field 'x'"):
        Connection(1, 1).encode("ATTITUDE", **complete, x=0)


def test_envelope_names_win_over_fields_of_the_same_name() -> None:
    (message,) = Connection(1, 1).receive(Connection(3, 4).encode("STATUSTEXT", id=77, text="hello"))
    assert (message.id, message["id"], message.get("id")) == (253, 77, 77)
    (ping,) = Connection(1, 1).receive(Connection(3, 4).encode("PING", seq=123_456))
    assert (ping.seq, ping["seq"], ping.fields()["seq"]) == (0, 123_456, 123_456)


def test_message_says_what_it_has() -> None:
    (message,) = Connection(1, 1).receive(Connection(3, 4).encode("HEARTBEAT", type=2, autopilot=12))
    assert (message.name, message.id, message.sysid, message.compid, message.signed) == (
        "HEARTBEAT",
        0,
        3,
        4,
        False,
    )
    assert message.get("nothing") is None
    assert message.get("nothing", 5) == 5
    assert "type=2" in repr(message)
    with pytest.raises(AttributeError, match="nothing"):
        _ = message.nothing
    with pytest.raises(KeyError):
        _ = message["nothing"]
    assert not hasattr(message, "crc")


def test_bytes_of_a_newer_extension_are_ignored() -> None:
    kind = BY_NAME["HEARTBEAT"]
    assert kind.unpack(b"\1\0\0\0\2\3\4\5\6" + b"later", 0, 14) == kind.unpack(b"\1\0\0\0\2\3\4\5\6", 0, 9)
