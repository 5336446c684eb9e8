"""Only what was signed with the key, and only once: against pymavlink, against hashlib, and against mutation."""

from __future__ import annotations

import hashlib
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pymavlink.dialects.v10 import common as v1
from pymavlink.dialects.v20 import common as v2

from bridge.connection import Connection
from bridge.framing import BUFFER_LIMIT
from bridge.signing import (
    ALWAYS_UNSIGNED,
    EPOCH_US,
    LATEST,
    MOST_STREAMS,
    NEW_STREAM_AGE,
    NO_KEY,
    Signer,
    SigningKey,
    Timestamps,
    Verdict,
    to_timestamp,
)
from sitl.errors import UsageError

SECRET = bytes(range(100, 132))
OTHER = bytes(range(32))
MINUTE = 6_000_000
NOW = 350_000_000_000_00


def signer(timestamp: int = NOW, link_id: int = 0, *, secret: bytes = SECRET, **options: Any) -> Signer:
    return Signer(SigningKey(secret, timestamp), link_id, **options)


def sender(timestamp: int = NOW, link_id: int = 0, sysid: int = 1, compid: int = 1, **options: Any) -> Connection:
    return Connection(sysid, compid, signer=signer(timestamp, link_id, **options))


def receiver(timestamp: int = NOW, *, datagram: bool = True, **options: Any) -> Connection:
    return Connection(255, 190, datagram=datagram, signer=signer(timestamp, 7, **options))


def pymavlink(timestamp: int = NOW, secret: bytes = SECRET, link_id: int = 3) -> Any:
    mav = v2.MAVLink(None, 42, 17)
    mav.robust_parsing = True
    mav.signing.secret_key = secret
    mav.signing.sign_outgoing = True
    mav.signing.link_id = link_id
    mav.signing.timestamp = timestamp
    return mav


def refusals(connection: Connection) -> tuple[int, int, int]:
    counters = connection.counters
    return counters.bad_signature, counters.replayed, counters.unsigned_refused


class TestTheSignature:
    def test_is_the_first_48_bits_of_a_sha256_over_key_and_frame(self) -> None:
        frame = sender(timestamp=0x0102030405, link_id=9).encode("ATTITUDE", time_boot_ms=40, roll=0.1, yawspeed=2.0)
        signed, tail = frame[:-13], frame[-13:]
        assert signed[:3] == bytes([0xFD, len(signed) - 12, 0x01])
        assert tail[:7] == bytes([9, 0x06, 0x04, 0x03, 0x02, 0x01, 0x00])
        assert tail[7:] == hashlib.sha256(SECRET + signed + tail[:7]).digest()[:6]

    def test_a_known_answer(self) -> None:
        """Every byte spelt out: a HEARTBEAT of 1/1, packet 0, key 0..31, link 2, timestamp 1."""
        frame = Connection(1, 1, signer=Signer(SigningKey(OTHER), 2)).encode("HEARTBEAT", type=2, mavlink_version=3)
        head = bytes.fromhex("fd 09 01 00 00 01 01 000000") + bytes.fromhex("00000000 02 00 00 00 03")
        checksum = v2.x25crc(head[1:] + bytes([50])).crc.to_bytes(2, "little")
        tail = bytes.fromhex("02 010000000000")
        assert frame == head + checksum + tail + hashlib.sha256(OTHER + head + checksum + tail).digest()[:6]

    def test_without_a_signer_nothing_changes(self) -> None:
        plain, blank = Connection(1, 1), Connection(1, 1, signer=Signer(NO_KEY, 0))
        frame = plain.encode("ATTITUDE", roll=1.0)
        assert frame == blank.encode("ATTITUDE", roll=1.0)
        assert frame[2] == 0
        (message,) = plain.receive(sender().encode("ATTITUDE", roll=0.5))
        assert message.signed
        assert refusals(plain) == (0, 0, 0)

    @pytest.mark.parametrize("secret", [b"", bytes(31), bytes(33)])
    def test_needs_a_key_of_32_bytes(self, secret: bytes) -> None:
        with pytest.raises(UsageError, match=f"of {len(secret)} bytes"):
            SigningKey(secret)

    @pytest.mark.parametrize("timestamp", [-1, 2**48])
    def test_needs_a_timestamp_of_48_bits(self, timestamp: int) -> None:
        with pytest.raises(UsageError, match="48 bits"):
            SigningKey(SECRET, timestamp)

    @pytest.mark.parametrize("link_id", [-1, 256])
    def test_needs_a_link_id_of_a_byte(self, link_id: int) -> None:
        with pytest.raises(UsageError, match=f"link id {link_id}"):
            Signer(SigningKey(SECRET), link_id)

    def test_never_shows_the_secret(self) -> None:
        assert repr(SigningKey(SECRET, 5)) == "SigningKey(timestamp=5)"


class TestWithPymavlink:
    def test_it_believes_us(self) -> None:
        ours, theirs = sender(), pymavlink()
        for _ in range(300):
            (message,) = theirs.parse_buffer(ours.encode("ATTITUDE", roll=0.25))
            assert (message.get_type(), message.roll) == ("ATTITUDE", 0.25)
        assert (theirs.signing.goodsig_count, theirs.signing.badsig_count) == (300, 0)

    def test_we_believe_it(self) -> None:
        theirs, ours = pymavlink(), receiver()
        for _ in range(300):
            (message,) = ours.receive(bytes(v2.MAVLink_param_set_message(1, 1, b"MC_ROLL_P", 6.5, 9).pack(theirs)))
            assert (message.name, message.sysid, message.param_value) == ("PARAM_SET", 42, 6.5)
        assert (ours.counters.received, refusals(ours)) == (300, (0, 0, 0))

    def test_neither_believes_another_key(self) -> None:
        theirs = pymavlink(secret=OTHER)
        assert theirs.parse_buffer(sender().encode("HEARTBEAT"))[0].get_type() == "BAD_DATA"
        ours = receiver()
        assert ours.receive(bytes(v2.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0).pack(theirs))) == []
        assert refusals(ours) == (1, 0, 0)

    def test_a_conversation_whose_clocks_disagree(self) -> None:
        """Each follows the later of the two, so what was a wrong clock is none after the first word."""
        theirs, ours = pymavlink(NOW + 100 * MINUTE), sender()
        for _ in range(20):
            (heard,) = ours.receive(bytes(v2.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3).pack(theirs)))
            (answer,) = theirs.parse_buffer(ours.encode("HEARTBEAT"))
            assert (heard.name, answer.get_type()) == ("HEARTBEAT", "HEARTBEAT")
        assert ours.signer is not None
        assert ours.signer.timestamp > NOW + 100 * MINUTE


class TestTimestamps:
    def test_count_10_us_since_2015(self) -> None:
        assert to_timestamp(EPOCH_US) == 0
        assert to_timestamp(EPOCH_US + 1_000_000) == 100_000
        assert to_timestamp(EPOCH_US - 1) == to_timestamp(0) == 0
        assert to_timestamp(2**63) == LATEST

    def test_follow_the_clock_and_never_repeat(self) -> None:
        now_us = EPOCH_US + 5_000_000
        times = Timestamps(0, lambda: now_us)
        assert [times.next(), times.next()] == [500_000, 500_001]
        now_us += 100
        assert times.next() == 500_010
        now_us -= 3_000_000
        assert times.next() == 500_011

    def test_go_on_from_the_file_where_the_time_is_unknown(self) -> None:
        times = Timestamps(NOW, lambda: 0)
        assert [times.next(), times.next()] == [NOW + 1, NOW + 2]

    def test_stand_still_at_the_end_of_time(self) -> None:
        times = Timestamps(LATEST - 1)
        assert [times.next(), times.next()] == [LATEST, LATEST]
        connection = Connection(1, 1, signer=signer(LATEST))
        assert len(connection.encode("HEARTBEAT")) > 13

    def test_an_accepted_one_pushes_ours_forward(self) -> None:
        ours = receiver()
        ours.receive(sender(NOW + 5000).encode("HEARTBEAT"))
        assert ours.signer is not None
        assert ours.signer.timestamp == NOW + 5001
        assert int.from_bytes(ours.encode("HEARTBEAT")[-12:-6], "little") == NOW + 5002
        assert ours.signer.key == SigningKey(SECRET, NOW + 5002)

    def test_a_forged_one_does_not(self) -> None:
        ours = receiver()
        ours.receive(sender(NOW + 5000, secret=OTHER).encode("HEARTBEAT"))
        assert ours.signer is not None
        assert ours.signer.timestamp == NOW

    @given(start=st.integers(0, LATEST), clock=st.lists(st.integers(0, 2**62), max_size=40))
    def test_rise_whatever_the_clock_does(self, start: int, clock: list[int]) -> None:
        ticks = iter(clock)
        times = Timestamps(start, lambda: next(ticks))
        last = start
        for _ in clock:
            following = times.next()
            assert following > last or following == last == LATEST
            last = following


class TestReplay:
    def test_a_frame_is_believed_once(self) -> None:
        ours, frame = receiver(), sender().encode("HEARTBEAT")
        assert [len(ours.receive(frame)) for _ in range(5)] == [1, 0, 0, 0, 0]
        assert refusals(ours) == (0, 4, 0)
        assert ours.counters.late == 0

    def test_an_overtaken_frame_is_not_believed(self) -> None:
        ours, theirs = receiver(), sender()
        first, second = theirs.encode("HEARTBEAT"), theirs.encode("HEARTBEAT")
        assert [len(ours.receive(frame)) for frame in (second, first)] == [1, 0]
        assert refusals(ours) == (0, 1, 0)

    def test_streams_are_told_apart_by_system_component_and_link(self) -> None:
        ours = receiver()
        for many, who in enumerate([(1, 1, 0), (2, 1, 0), (1, 2, 0), (1, 1, 1)]):
            sysid, compid, link_id = who
            frame = sender(NOW - many, link_id, sysid, compid).encode("HEARTBEAT")
            assert len(ours.receive(frame)) == 1
        assert ours.signer is not None
        assert ours.signer.timestamps.streams == 4

    @pytest.mark.parametrize(("age", "accepted"), [(0, 1), (MINUTE, 1), (MINUTE + 1, 0), (NOW - 1, 0)])
    def test_a_new_stream_is_at_most_a_minute_old(self, age: int, accepted: int) -> None:
        assert NEW_STREAM_AGE == MINUTE
        ours = receiver(NOW)
        assert len(ours.receive(sender(NOW - age - 1).encode("HEARTBEAT"))) == accepted
        assert refusals(ours) == (0, 1 - accepted, 0)

    def test_a_known_stream_may_lag_as_far_as_it_likes(self) -> None:
        ours, slow = receiver(), sender()
        assert len(ours.receive(slow.encode("HEARTBEAT"))) == 1
        assert len(ours.receive(sender(NOW + 50 * MINUTE, 1).encode("HEARTBEAT"))) == 1
        assert len(ours.receive(slow.encode("HEARTBEAT"))) == 1

    def test_the_minute_counts_from_our_clock_too(self) -> None:
        late_us = EPOCH_US + (NOW + 2 * MINUTE) * 10
        ours = receiver(NOW, utc_us=lambda: late_us)
        assert ours.receive(sender(NOW).encode("HEARTBEAT")) == []
        assert refusals(ours) == (0, 1, 0)

    def test_what_was_said_before_a_restart_is_old(self) -> None:
        before, theirs = receiver(), sender()
        recorded = [theirs.encode("HEARTBEAT") for _ in range(3)]
        for frame in [*recorded, sender(NOW + 2 * MINUTE, 1).encode("HEARTBEAT")]:
            before.receive(frame)
        assert before.signer is not None
        after = Connection(255, 190, datagram=True, signer=Signer(before.signer.key, 7))
        assert [after.receive(frame) for frame in recorded] == [[], [], []]

    def test_a_frame_of_one_link_is_not_believed_on_another(self) -> None:
        shared = Timestamps(NOW)
        links = [Connection(1, 1, datagram=True, signer=signer(link_id=i, timestamps=shared)) for i in range(2)]
        frame = sender(sysid=255).encode("HEARTBEAT")
        assert [len(link.receive(frame)) for link in links] == [1, 0]
        assert len({links[i % 2].encode("HEARTBEAT")[-12:-6] for i in range(10)}) == 10

    def test_the_table_of_streams_is_bounded_and_nobody_is_pushed_out(self) -> None:
        ours, first = receiver(), sender()
        old = first.encode("HEARTBEAT")
        ours.receive(old)
        for number in range(1000):
            ours.receive(sender(link_id=number % 256, sysid=2 + number // 256).encode("HEARTBEAT"))
        assert ours.signer is not None
        assert ours.signer.timestamps.streams == MOST_STREAMS
        assert refusals(ours) == (0, 1001 - MOST_STREAMS, 0)
        assert ours.receive(old) == []
        assert len(ours.receive(first.encode("HEARTBEAT"))) == 1

    def test_nobody_without_the_key_takes_a_place_in_it(self) -> None:
        ours = receiver()
        for number in range(300):
            ours.receive(sender(sysid=1 + number % 255, secret=OTHER).encode("HEARTBEAT"))
        assert ours.signer is not None
        assert ours.signer.timestamps.streams == 0
        assert refusals(ours) == (300, 0, 0)


class TestUnsigned:
    @pytest.mark.parametrize("datagram", [True, False])
    def test_is_refused_where_a_signature_is_required(self, datagram: bool) -> None:
        ours, plain = receiver(datagram=datagram), Connection(1, 1)
        for _ in range(3):
            assert ours.receive(plain.encode("COMMAND_LONG", command=400)) == []
        assert refusals(ours) == (0, 0, 3)
        assert ours.counters.received == ours.counters.bad_bytes == ours.counters.resyncs == 0

    def test_is_accepted_where_none_is_required_but_a_wrong_one_is_not(self) -> None:
        ours = receiver(require=False)
        assert len(ours.receive(Connection(1, 1).encode("HEARTBEAT"))) == 1
        assert ours.receive(sender(secret=OTHER).encode("HEARTBEAT")) == []
        assert len(ours.receive(sender().encode("HEARTBEAT"))) == 1
        assert refusals(ours) == (1, 0, 0)

    def test_mavlink_1_has_no_signatures(self) -> None:
        mav = v1.MAVLink(None, 7, 8)
        frame = bytes(v1.MAVLink_attitude_message(40, 0.5, 0, 0, 0, 0, 0).pack(mav, force_mavlink1=True))
        ours = receiver()
        assert ours.receive(frame) == []
        assert refusals(ours) == (0, 0, 1)
        assert len(receiver(require=False).receive(frame)) == 1

    @pytest.mark.parametrize("name", ["RADIO_STATUS", "ADSB_VEHICLE", "COLLISION"])
    def test_some_messages_come_from_devices_that_cannot_sign(self, name: str) -> None:
        ours = receiver()
        (message,) = ours.receive(Connection(51, 68).encode(name))
        assert message.id in ALWAYS_UNSIGNED
        assert ours.receive(sender(secret=OTHER).encode(name)) == []

    def test_everything_is_accepted_while_there_is_no_key(self) -> None:
        blank = Connection(255, 190, datagram=True, signer=Signer(NO_KEY, 0, require=True))
        for frame in (Connection(1, 1).encode("HEARTBEAT"), *[sender(secret=OTHER).encode("HEARTBEAT")] * 2):
            assert len(blank.receive(frame)) == 1
        assert refusals(blank) == (0, 0, 0)

    def test_zeros_with_a_timestamp_are_a_key(self) -> None:
        assert not NO_KEY.initialised
        assert SigningKey(bytes(32), 1).initialised
        assert SigningKey(bytes(31) + b"\1").initialised


@pytest.mark.parametrize("datagram", [True, False])
def test_no_bit_of_a_frame_can_be_changed(datagram: bool) -> None:
    frame = sender().encode("COMMAND_LONG", command=400, param1=1.0, target_system=1)
    for bit in range(len(frame) * 8):
        broken = bytearray(frame)
        broken[bit // 8] ^= 1 << bit % 8
        ours = receiver(datagram=datagram)
        assert ours.receive(bytes(broken)) + ours.flush() == []
        assert ours.counters.received == 0
        assert ours.signer is not None
        assert ours.signer.timestamp == NOW


MESSAGES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("HEARTBEAT", {"type": 6}),
    ("COMMAND_LONG", {"command": 400, "param1": 1.0}),
    ("PARAM_SET", {"param_id": "MC_ROLL_P", "param_value": 6.5}),
    ("FILE_TRANSFER_PROTOCOL", {"payload": bytes(range(5, 256))}),
    ("STATUSTEXT", {"text": "\u00fe\u00fd" * 12}),
)
mutations = st.lists(
    st.tuples(
        st.sampled_from(["flip", "cut", "insert", "swap tail", "unsign", "repeat", "leave"]),
        st.integers(0, 10_000),
        st.integers(1, 255),
    ),
    min_size=1,
    max_size=12,
)


def mutated(frame: bytes, other: bytes, how: str, place: int, value: int) -> bytes:
    """One frame as an attacker who hears everything and has no key would send it on."""
    at = place % len(frame)
    if how == "flip":
        return frame[:at] + bytes([frame[at] ^ value]) + frame[at + 1 :]
    if how == "cut":
        return frame[:at] + frame[at + 1 + value % 5 :]
    if how == "insert":
        return frame[:at] + bytes([value]) * (1 + value % 3) + frame[at:]
    if how == "swap tail":
        return frame[:-13] + other[-13:]
    if how == "unsign":
        body = frame[1:2] + b"\0" + frame[3:-15]
        kind = v2.mavlink_map[int.from_bytes(frame[7:10], "little")]
        crc: int = v2.x25crc(body + bytes([kind.crc_extra])).crc
        return frame[:1] + body + crc.to_bytes(2, "little")
    return frame * 2 if how == "repeat" else frame


@given(steps=mutations, cuts=st.lists(st.integers(0, 10_000), max_size=6))
@example(steps=[("leave", 0, 1), ("cut", 10_000 // 34 * 34 - 1, 1), ("leave", 0, 1)], cuts=[])
def test_nothing_is_believed_that_was_not_signed(steps: list[tuple[str, int, int]], cuts: list[int]) -> None:
    theirs = sender()
    kinds = [MESSAGES[index % len(MESSAGES)] for index in range(len(steps))]
    genuine = [theirs.encode(name, **fields) for name, fields in kinds]
    sent = [
        mutated(frame, genuine[index - 1], *step)
        for index, (frame, step) in enumerate(zip(genuine, steps, strict=True))
    ]
    for datagram in (True, False):
        ours = receiver(datagram=datagram)
        heard = []
        if datagram:
            for frame in sent:
                heard += ours.receive(frame)
        else:
            stream = b"".join(sent)
            edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
            for begin, end in pairwise(edges):
                heard += ours.receive(stream[begin:end])
                assert ours.pending <= BUFFER_LIMIT
            heard += ours.flush()
        frames = [message.raw_frame for message in heard]
        assert len(frames) == len(set(frames)) == ours.counters.received
        assert set(frames) <= set(genuine)
        assert frames == sorted(frames, key=genuine.index)
        if datagram:
            left = [frame for frame, (how, _, _) in zip(genuine, steps, strict=True) if how in ("leave", "repeat")]
            assert set(left) <= set(frames)


@given(
    kinds=st.lists(st.sampled_from(["good", "forged", "replay", "unsigned", "radio", "crc", "unknown"]), max_size=60)
)
@pytest.mark.parametrize("datagram", [True, False])
def test_every_frame_offered_is_counted_once(datagram: bool, kinds: list[str]) -> None:
    ours, theirs, forger, plain = receiver(datagram=datagram), sender(), sender(secret=OTHER), Connection(9, 9)
    last = theirs.encode("HEARTBEAT")
    ours.receive(last)
    for kind in kinds:
        if kind == "good":
            last = theirs.encode("HEARTBEAT")
            frame = last
        elif kind == "forged":
            frame = forger.encode("ATTITUDE", roll=1.0)
        elif kind == "replay":
            frame = last
        elif kind == "crc":
            frame = plain.encode("ATTITUDE", roll=1.0)
            frame = frame[:-1] + bytes([frame[-1] ^ 0x55])
        elif kind == "unknown":
            frame = b"\xfd\x01\x00\x00\x00\x09\x09\xdb\xea\x00\x01\x02\x03"
        else:
            frame = plain.encode("RADIO_STATUS" if kind == "radio" else "ATTITUDE")
        ours.receive(frame)
    ours.flush()
    counters = ours.counters
    assert counters.received == 1 + kinds.count("good") + kinds.count("radio")
    assert refusals(ours) == (kinds.count("forged"), kinds.count("replay"), kinds.count("unsigned"))
    assert counters.refused == sum(refusals(ours))
    assert counters.bad_crc == kinds.count("crc")
    assert counters.unknown == kinds.count("unknown")
    assert counters.received + counters.refused + counters.bad_crc + counters.unknown == 1 + len(kinds)


def test_a_verdict_is_given_for_each_frame() -> None:
    ours, frame = signer(), sender().encode("HEARTBEAT")
    assert [ours.verify(frame), ours.verify(frame)] == [Verdict.GENUINE, Verdict.REPLAYED]
    assert signer(secret=OTHER).verify(frame) is Verdict.FORGED
    assert SigningKey(SECRET).made(frame)
    assert not SigningKey(OTHER).made(frame)
