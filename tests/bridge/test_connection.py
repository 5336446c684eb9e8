"""Two connections back to back: what one encodes the other receives, and what is counted on the way."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v10 import common as v1
from pymavlink.dialects.v20 import common as v2

from bridge.connection import Connection
from bridge.signing import Signer, SigningKey
from sitl.errors import UsageError

PARAM = {"param_id": "MC_ROLL_P", "param_value": 6.5, "param_type": 9, "param_count": 300, "param_index": 120}


def test_a_frame_of_ours_is_a_frame_of_pymavlinks() -> None:
    mav = v2.MAVLink(None, 255, 190)
    frame = Connection(42, 1).encode("PARAM_VALUE", **PARAM)
    decoded = mav.parse_buffer(frame)[0]
    assert decoded.get_type() == "PARAM_VALUE"
    assert (decoded.get_srcSystem(), decoded.get_srcComponent(), decoded.get_seq()) == (42, 1, 0)
    assert decoded.to_dict() == {"mavpackettype": "PARAM_VALUE", **PARAM}


def test_packet_numbers_run_through_all_messages_and_wrap() -> None:
    sender, receiver = Connection(1, 1), Connection(255, 190)
    for number in range(600):
        name = ("HEARTBEAT", "ATTITUDE", "EVENT")[number % 3]
        (message,) = receiver.receive(sender.encode(name))
        assert message.seq == number % 256
    assert sender.sent == receiver.counters.received == 600
    assert receiver.counters.lost == 0


def test_lost_frames_are_counted_for_each_sender() -> None:
    autopilot, camera, receiver = Connection(1, 1), Connection(1, 100), Connection(255, 190)
    for number in range(20):
        frame = autopilot.encode("HEARTBEAT")
        other = camera.encode("HEARTBEAT")
        if number not in (3, 7, 8):
            receiver.receive(frame)
        if number != 5:
            receiver.receive(other)
    assert receiver.counters.lost == 4
    assert receiver.counters.received == 36


def test_a_repeated_or_overtaken_frame_is_late_and_loses_nothing_more() -> None:
    sender, receiver = Connection(1, 1), Connection(255, 190)
    frames = [sender.encode("HEARTBEAT") for _ in range(6)]
    for frame in (frames[0], frames[0], frames[2], frames[1], frames[3], frames[4]):
        assert len(receiver.receive(frame)) == 1
    assert (receiver.counters.late, receiver.counters.lost) == (2, 1)


def test_a_sender_that_starts_again_is_followed_at_once() -> None:
    receiver = Connection(255, 190)
    first, again = Connection(1, 1), Connection(1, 1)
    for _ in range(100):
        receiver.receive(first.encode("HEARTBEAT"))
    receiver.receive(again.encode("HEARTBEAT"))
    jump = receiver.counters.lost
    for _ in range(50):
        receiver.receive(again.encode("HEARTBEAT"))
    assert receiver.counters.lost == jump


def test_mavlink_1_is_understood() -> None:
    mav = v1.MAVLink(None, 7, 8)
    mav.seq = 200
    frame = v1.MAVLink_attitude_message(40, 0.5, -0.25, 0, 0, 0, 0).pack(mav, force_mavlink1=True)
    assert frame[0] == 0xFE
    (message,) = Connection(1, 1).receive(bytes(frame))
    assert (message.name, message.sysid, message.compid, message.seq) == ("ATTITUDE", 7, 8, 200)
    assert (message.time_boot_ms, message.roll, message.pitch) == (40, 0.5, -0.25)
    assert message.raw_frame == bytes(frame)


def signed_frame() -> bytes:
    mav = v2.MAVLink(None, 7, 8)
    mav.signing.secret_key = bytes(range(32))
    mav.signing.sign_outgoing = True
    mav.signing.link_id = 3
    mav.signing.timestamp = 1
    return bytes(v2.MAVLink_attitude_message(40, 0.5, 0, 0, 0, 0, 0).pack(mav))


@pytest.mark.parametrize("datagram", [True, False])
def test_signed_frames_are_read_and_marked(datagram: bool) -> None:
    frame = signed_frame()
    connection = Connection(1, 1, datagram=datagram)
    plain = Connection(7, 8).encode("ATTITUDE", roll=1.0)
    messages = connection.receive(frame + plain)
    assert [(m.signed, m.roll) for m in messages] == [(True, 0.5), (False, 1.0)]
    assert len(messages[0].raw_frame) == len(frame)
    assert connection.counters.bad_bytes == 0


def test_a_frame_with_flags_we_do_not_know_is_not_read() -> None:
    frame = bytearray(Connection(7, 8).encode("HEARTBEAT", type=2))
    frame[2] = 0x02
    checksum = v2.x25crc(bytes(frame[1:-2]) + bytes([50])).crc
    frame[-2:] = checksum.to_bytes(2, "little")
    good = Connection(7, 8).encode("ATTITUDE", roll=1.0)
    connection = Connection(1, 1, datagram=True)
    assert [m.name for m in connection.receive(bytes(frame) + good)] == ["ATTITUDE"]
    assert connection.counters.bad_bytes == len(frame)


def test_both_directions_reach_the_log() -> None:
    ours, other = Connection(1, 1), Connection(255, 190)
    log: list[bytes] = []
    ours.on_frame = log.append
    sent = ours.encode("HEARTBEAT")
    heard = other.encode("ATTITUDE")
    ours.receive(b"noise" + heard)
    assert log == [sent, heard]


KEY = SigningKey(bytes(range(32)), 1000)


def test_a_signer_may_come_and_go_between_two_messages() -> None:
    ours, other = Connection(1, 1, datagram=True), Connection(255, 190, datagram=True)
    seen = []
    for signer in (None, Signer(KEY, 0), None):
        ours.signer = signer
        assert ours.signer is signer
        (message,) = other.receive(ours.encode("HEARTBEAT"))
        seen.append((message.seq, message.signed, len(message.raw_frame)))
        assert len(ours.receive(Connection(255, 190).encode("HEARTBEAT"))) == (signer is None)
    (first, _, plain), *_ = seen
    assert seen == [(first, False, plain), (first + 1, True, plain + 13), (first + 2, False, plain)]
    assert ours.counters.unsigned_refused == 1


def test_refused_frames_tell_nothing_of_the_packet_counter() -> None:
    ours = Connection(1, 1, datagram=True, signer=Signer(KEY, 0))
    theirs, forger = Connection(7, 8, signer=Signer(KEY, 1)), Connection(7, 8)
    forger.sent = 100
    for _ in range(10):
        assert len(ours.receive(theirs.encode("HEARTBEAT"))) == 1
        assert ours.receive(forger.encode("HEARTBEAT")) == []
    assert (ours.counters.lost, ours.counters.late) == (0, 0)
    assert not ours.counters.knows(9, 9)


def test_the_log_holds_neither_signatures_nor_keys() -> None:
    """As MAVLink's page on message signing asks: a log must not help anybody to sign."""
    ours, other = Connection(1, 1, signer=Signer(KEY, 0)), Connection(255, 190, signer=Signer(KEY, 1))
    log: list[bytes] = []
    ours.on_frame = log.append
    ours.encode("ATTITUDE", roll=0.5)
    ours.receive(other.encode("HEARTBEAT", type=6))
    ours.receive(other.encode("SETUP_SIGNING", secret_key=KEY.secret))
    ours.receive(Connection(9, 9).encode("HEARTBEAT"))
    plain = Connection(1, 1).encode("ATTITUDE", roll=0.5), Connection(255, 190).encode("HEARTBEAT", type=6)
    assert log == list(plain)


def test_an_unknown_message_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(UsageError, match="no MAVLink message 'ATITUDE'; did you mean ATTITUDE"):
        Connection(1, 1).encode("ATITUDE")


@pytest.mark.parametrize(("sysid", "compid", "text"), [(0, 1, "system id 0"), (1, 256, "component id 256")])
def test_ids_are_checked(sysid: int, compid: int, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        Connection(sysid, compid)


def test_fields_called_like_the_envelope_can_be_sent() -> None:
    (message,) = Connection(1, 1).receive(Connection(1, 1).encode("NAMED_VALUE_FLOAT", name="vaf", value=0.9))
    assert (message.name, message["name"]) == ("NAMED_VALUE_FLOAT", "vaf")
