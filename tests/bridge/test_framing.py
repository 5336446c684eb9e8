"""Damage costs the damaged frame, nothing else; and nothing on the wire raises or makes the buffer grow."""

from __future__ import annotations

import struct
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from bridge.connection import Connection
from bridge.framing import BUFFER_LIMIT, crc16
from bridge.signing import Signer, SigningKey

KINDS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("HEARTBEAT", {"type": 2, "autopilot": 12}),
    ("ATTITUDE", {"time_boot_ms": 123, "roll": 0.1, "yawspeed": -2.0}),
    ("PARAM_VALUE", {"param_id": "MC_ROLLRATE_P", "param_value": 0.15}),
    ("FILE_TRANSFER_PROTOCOL", {"payload": bytes(range(5, 256))}),
    ("STATUSTEXT", {"text": "\u00fe\u00fd" * 12}),
    ("EVENT", {"arguments": b"\xfd\xfe" * 20, "id": 0xFDFDFEFE}),
)


def frames(count: int, start: int = 0) -> list[bytes]:
    """Frames of one sender, of six kinds in turn."""
    sender = Connection(1, 1)
    made = []
    for index in range(start, start + count):
        name, fields = KINDS[index % len(KINDS)]
        made.append(sender.encode(name, **fields))
    return made


def fed(stream: bytes, cuts: list[int], *, check: bool = True) -> tuple[Connection, list[bytes]]:
    """Feed a stream cut at these places, then say that it has ended."""
    connection = Connection(255, 190)
    found = []
    edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    for begin, end in pairwise(edges):
        found += connection.receive(stream[begin:end])
        assert connection.pending <= BUFFER_LIMIT
    found += connection.flush()
    assert connection.pending == 0
    return connection, [message.raw_frame for message in found]


# Bytes that look like beginnings: magics, lengths, known ids, cut frames.
beginnings = st.one_of(
    st.binary(max_size=40),
    st.lists(st.sampled_from([0xFD, 0xFE, 0x00, 0x01, 0x1C, 0xFF]), max_size=40).map(bytes),
    st.builds(lambda index, cut: frames(1, index)[0][:cut], st.integers(0, 5), st.integers(0, 11)),
    st.builds(
        lambda length, known: bytes([0xFD, length, 0, 0, 9, 1, 1, *known, 0, 0]),
        st.integers(0, 255),
        st.sampled_from([b"\x1e", b"\x6e", b"\xfd", b"\xee"]),
    ),
)
cut_places = st.lists(st.integers(0, 100_000), max_size=12)


@given(garbage=st.lists(beginnings, min_size=1, max_size=8), cuts=cut_places)
@example(garbage=[b"\xfd"] * 6, cuts=[])
@example(garbage=[bytes([0xFE, 0xFF, 0, 0, 0, 110])] * 3, cuts=list(range(0, 900, 7)))
def test_every_good_frame_between_garbage_is_found(garbage: list[bytes], cuts: list[int]) -> None:
    good = frames(len(garbage) + 1)
    stream = b"".join(noise + frame for noise, frame in zip(garbage, good, strict=False)) + good[-1]
    connection, found = fed(stream, cuts)
    assert found == good
    assert connection.counters.received == len(good)
    assert connection.counters.lost == 0


@given(
    damaged=st.integers(0, 7),
    place=st.integers(0, 10_000),
    change=st.integers(1, 255),
    cuts=cut_places,
)
def test_one_changed_byte_costs_at_most_its_own_frame(damaged: int, place: int, change: int, cuts: list[int]) -> None:
    good = frames(8)
    broken = bytearray(good[damaged])
    broken[place % len(broken)] ^= change
    stream = b"".join([*good[:damaged], bytes(broken), *good[damaged + 1 :]])
    connection, found = fed(stream, cuts)
    assert found == good[:damaged] + good[damaged + 1 :]
    counters = connection.counters
    assert counters.bad_bytes + counters.unknown > 0
    assert counters.lost == (1 if 0 < damaged < 7 and not counters.unknown else counters.lost)


@pytest.mark.parametrize("place", range(12))
def test_a_corrupted_header_never_takes_the_frames_behind_it(place: int) -> None:
    good = frames(12)
    for change in range(1, 256):
        broken = bytearray(good[0])
        broken[place] ^= change
        _, found = fed(bytes(broken) + b"".join(good[1:]), [])
        assert found == good[1:]


@given(stream=st.binary(max_size=2000), cuts=cut_places)
def test_noise_never_raises_and_never_piles_up(stream: bytes, cuts: list[int]) -> None:
    connection, found = fed(stream, cuts)
    assert connection.counters.received == len(found)
    for chunk in (stream, stream[::-1]):
        Connection(1, 1, datagram=True).receive(chunk)


@given(seed=st.integers(0, 2**32 - 1))
def test_a_stream_that_always_ends_inside_a_frame_does_not_grow(seed: int) -> None:
    connection = Connection(255, 190)
    stream = b"".join(frames(60))
    step = 17 + seed % 200
    for at in range(0, len(stream), step):
        connection.receive(stream[at : at + step])
        assert connection.pending < 281
    assert connection.counters.received == 60
    assert connection.counters.bad_bytes == 0


@given(cuts=st.lists(st.integers(0, 100_000), max_size=60))
def test_where_a_stream_is_cut_makes_no_difference(cuts: list[int]) -> None:
    good = frames(12)
    connection, found = fed(b"".join(good), cuts)
    assert found == good
    assert connection.counters.bad_bytes == connection.counters.bad_crc == 0


def test_a_damaged_datagram_never_reaches_into_the_next() -> None:
    connection = Connection(255, 190, datagram=True)
    good = frames(4)
    for cut in range(len(good[1])):
        assert connection.receive(good[1][:cut]) == []
        assert connection.pending == 0
        (message,) = connection.receive(good[2])
        assert message.raw_frame == good[2]


def test_many_frames_in_one_datagram() -> None:
    good = frames(30)
    assert [m.raw_frame for m in Connection(1, 1, datagram=True).receive(b"".join(good))] == good


@pytest.mark.parametrize(
    "broken",
    [b"\xfd\xff" + frames(1)[0][2:], bytes([0xFE, 0xFF, 0, 1, 1, 0]) + bytes(11)],
    ids=["mavlink2", "mavlink1"],
)
def test_a_length_longer_than_the_message_delays_nothing(broken: bytes) -> None:
    """The case pymavlink loses a dozen frames to: here they come out as they come in."""
    good = frames(6)
    connection = Connection(255, 190)
    assert connection.receive(broken) == []
    for frame in good[1:]:
        (message,) = connection.receive(frame)
        assert message.raw_frame == frame
    assert connection.counters.resyncs == 1
    assert connection.counters.bad_bytes == len(broken)


def test_a_shorter_length_is_waited_for_no_longer_than_it_says() -> None:
    sender = Connection(1, 1)
    cut = sender.encode("ATTITUDE", yawspeed=1.0)[:20]  # the rest got lost on the line
    whole = [sender.encode("HEARTBEAT", type=2) for _ in range(4)]
    connection = Connection(255, 190)
    connection.receive(cut)
    waiting = connection.receive(whole[0])
    assert waiting == []  # it may still be the rest of the ATTITUDE
    assert [m.raw_frame for m in connection.receive(whole[1])] == whole[:2]
    assert connection.counters.bad_crc == 1
    connection.receive(cut)
    connection.receive(whole[2])
    assert [m.raw_frame for m in connection.flush()] == [whole[2]]  # ... or the line is quiet


def unknown_frame(payload: bytes, seq: int, number: int = 60_123) -> bytes:
    body = struct.pack("<BBBBBB", len(payload), 0, 0, seq, 1, 1) + number.to_bytes(3, "little") + payload
    return b"\xfd" + body + crc16(body + b"\x2a").to_bytes(2, "little")


@pytest.mark.parametrize("datagram", [True, False])
def test_unknown_messages_are_counted_and_leave_no_hole(datagram: bool) -> None:
    sender = Connection(1, 1)
    connection = Connection(255, 190, datagram=datagram)
    connection.receive(sender.encode("HEARTBEAT"))
    for _ in range(5):
        strange = unknown_frame(b"\x11\x22" * 9, sender.sent & 0xFF)
        sender.sent += 1
        connection.receive(strange + sender.encode("HEARTBEAT"))
    counters = connection.counters
    assert (counters.received, counters.unknown, counters.lost) == (6, 5, 0)
    assert (counters.bad_bytes, counters.resyncs) == (0, 0)


def test_an_unknown_message_in_pieces_is_one_unknown_message() -> None:
    connection = Connection(255, 190)
    strange = unknown_frame(bytes(range(60)), 0)
    for at in range(0, len(strange), 7):
        connection.receive(strange[at : at + 7])
    assert (connection.counters.unknown, connection.counters.bad_bytes) == (1, 0)


def test_a_damaged_id_cannot_hide_a_good_frame() -> None:
    good = frames(3)
    header = bytes([0xFD, len(good[0]) + len(good[1]) - 2, 0, 0, 1, 1, 1, 0xDB, 0xEA, 0])
    connection = Connection(255, 190, datagram=True)
    found = connection.receive(header + b"".join(good))
    assert [m.raw_frame for m in found] == good
    assert connection.counters.unknown == 0


def test_a_frame_carried_inside_a_good_one_is_payload() -> None:
    inner = frames(1)[0]
    outer = Connection(1, 1).encode("FILE_TRANSFER_PROTOCOL", payload=inner * 3)
    connection = Connection(255, 190)
    found = [m for at in range(0, len(outer), 5) for m in connection.receive(outer[at : at + 5])]
    assert [m.name for m in found] == ["FILE_TRANSFER_PROTOCOL"]


def test_an_unknown_message_that_ends_like_a_beginning_is_still_one() -> None:
    beginning = frames(1)[0][:10]
    strange = unknown_frame(bytes(20) + beginning, 1)
    connection = Connection(255, 190)
    connection.receive(frames(1)[0])
    connection.receive(strange)
    assert connection.pending <= BUFFER_LIMIT
    (message,) = connection.receive(frames(2)[1]) or connection.flush()
    assert message.name == "ATTITUDE"
    assert (connection.counters.unknown, connection.counters.bad_bytes) == (1, 0)


def test_noise_that_looks_like_an_unknown_message_is_noise() -> None:
    noise = bytes([0xFD, 5, 0, 0, 0, 1, 1, 0xDB, 0xEA, 0]) + b"x" * 30
    connection = Connection(255, 190, datagram=True)
    connection.receive(noise)
    assert (connection.counters.unknown, connection.counters.bad_bytes) == (0, len(noise))


KEY, OTHER = SigningKey(bytes(range(32)), 1000), SigningKey(bytes(range(1, 33)), 1000)


def signed_frames(count: int, key: SigningKey = KEY) -> list[bytes]:
    sender = Connection(1, 1, signer=Signer(key, 0))
    return [sender.encode(name, **fields) for name, fields in (KINDS[index % len(KINDS)] for index in range(count))]


def guarded(*, datagram: bool = False) -> Connection:
    return Connection(255, 190, datagram=datagram, signer=Signer(KEY, 1))


@given(cuts=st.lists(st.integers(0, 100_000), max_size=40), garbage=st.lists(beginnings, min_size=6, max_size=6))
def test_signed_frames_between_garbage_are_found(cuts: list[int], garbage: list[bytes]) -> None:
    good = signed_frames(6)
    stream = b"".join(noise + frame for noise, frame in zip(garbage, good, strict=True))
    connection = guarded()
    found = []
    for begin, end in pairwise([0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]):
        found += connection.receive(stream[begin:end])
        assert connection.pending <= BUFFER_LIMIT
    found += connection.flush()
    assert [m.raw_frame for m in found] == good
    assert connection.counters.refused == 0


@pytest.mark.parametrize("datagram", [True, False])
def test_a_forged_frame_costs_itself_and_is_no_damage(datagram: bool) -> None:
    connection = guarded(datagram=datagram)
    good, forged = signed_frames(6), signed_frames(6, OTHER)
    stream = b"".join(bad + frame for bad, frame in zip(forged, good, strict=True))
    assert [m.raw_frame for m in connection.receive(stream)] == good
    counters = connection.counters
    assert (counters.received, counters.bad_signature, counters.lost) == (6, 6, 0)
    assert (counters.bad_bytes, counters.resyncs, counters.bad_crc) == (0, 0, 0)


@pytest.mark.parametrize("missing", range(1, 14))
def test_a_byte_lost_from_a_signature_does_not_cost_the_next_frame(missing: int) -> None:
    good = signed_frames(3)
    short = good[0][:-missing] + good[0][len(good[0]) - missing + 1 :]
    connection = guarded()
    assert [m.raw_frame for m in connection.receive(short + good[1] + good[2])] == good[1:]
    assert connection.counters.bad_signature == 1


def test_a_refused_frame_does_not_bring_in_what_it_carries() -> None:
    inner = b"".join(frames(3))
    for outer in (Connection(1, 1), Connection(1, 1, signer=Signer(OTHER, 0))):
        for datagram in (True, False):
            connection = Connection(255, 190, datagram=datagram, signer=Signer(KEY, 1))
            frame = outer.encode("FILE_TRANSFER_PROTOCOL", payload=inner)
            assert [m for part in (frame[:50], frame[50:]) for m in connection.receive(part)] == [] or datagram
            assert connection.receive(frame) == []
            assert connection.counters.received == 0
