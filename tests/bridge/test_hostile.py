"""Whatever comes in on a link, the vehicle neither falls over nor grows nor does what nobody validly asked for."""

from __future__ import annotations

import math
import random
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1]))

from hostile import KEY, Forge, capture_frames, captures, cut_up, damaged, frame_of, mutate
from hostile_vehicle import COMPONENT, US, Watched

from bridge.connection import Connection
from bridge.fleet_status import FleetStatus, vehicle_status
from bridge.messages import BY_ID, BY_NAME, MAGIC_2
from bridge.signing import Signer

KINDS = tuple(BY_ID.values())
TARGETED = tuple(kind for kind in KINDS if any(field.name in ("target_system", "target") for field in kind.fields))
TARGET = {"target_system": US, "target_component": COMPONENT}
HOLD = 4
ANSWER_TICKS = 2


def test_the_captures_are_of_every_kind() -> None:
    names = {name for name, _ in captures()}
    assert len(capture_frames()) > 400
    assert names >= {
        "PARAM_SET", "PARAM_REQUEST_LIST", "COMMAND_LONG", "COMMAND_INT", "MISSION_ITEM_INT", "MISSION_COUNT",
        "FILE_TRANSFER_PROTOCOL", "LOG_REQUEST_DATA", "SET_ATTITUDE_TARGET", "SET_MODE", "PING",
    }  # fmt: skip


@pytest.mark.parametrize("seed", range(12))
def test_a_storm_of_everything(seed: int) -> None:
    """Captures, frames of every message and their wreckage on both links, in the air and on the ground."""
    rng = random.Random(seed)
    forge = Forge(seed, signer=Signer(KEY, 3))
    watched = Watched()
    if seed % 2:
        watched.hover()
    pool = capture_frames()
    for _ in range(500):
        dice = rng.random()
        if dice < 0.4:
            data = forge.frame()
        elif dice < 0.6:
            data = forge.frame(BY_NAME[rng.choice(captures())[0]])
        else:
            data = rng.choice(pool)
            if dice < 0.85:
                data = mutate(rng, data, pool)
        watched.put(data, rng.randrange(2))
        if rng.random() < 0.3:
            watched.tick(rng.randint(1, 3))
    watched.tick(30)
    for link in (0, 1):
        assert watched.adds_up(link), watched.links[link].connection.counters
        assert watched.answers(link, ANSWER_TICKS)
    assert watched.finite()


@pytest.mark.parametrize("seed", range(6))
def test_a_stream_cut_anywhere(seed: int) -> None:
    """Frames and damage in pieces of any size; what is kept of them stays small."""
    rng = random.Random(100 + seed)
    forge = Forge(seed, signer=Signer(KEY, 3))
    watched = Watched(datagram=False)
    pool = capture_frames()
    for _ in range(40):
        frames = [forge.frame() if rng.random() < 0.5 else rng.choice(pool) for _ in range(10)]
        frames = [mutate(rng, frame, pool) if rng.random() < 0.4 else frame for frame in frames]
        for piece in cut_up(rng, b"".join(frames)):
            watched.put(piece)
            watched.tick()
            assert watched.links[0].connection.pending <= 560
    assert watched.adds_up()
    # What looks like the beginning of a frame can hold back no more than a frame's length of what follows.
    for _ in range(20):
        watched.send("HEARTBEAT", type=6)
    assert watched.answers(0, ANSWER_TICKS)


@pytest.mark.parametrize("seed", range(20))
def test_a_stream_finds_itself_within_one_good_frame(seed: int) -> None:
    rng = random.Random(200 + seed)
    watched = Watched(datagram=False)
    wreck = mutate(rng, rng.choice(capture_frames()), capture_frames())
    counters = watched.links[0].connection.counters
    # Longer than any frame that the wreck may seem to begin; none of it is a magic byte.
    watched.put(wreck + bytes(280))
    watched.tick()
    before = counters.received
    watched.send("HEARTBEAT", type=6)
    watched.tick()
    assert counters.received == before + 1
    assert watched.links[0].connection.pending == 0


def test_a_request_behind_a_frame_that_never_ends_is_answered_when_the_line_is_quiet() -> None:
    """The beginning of a frame of 254 bytes, then a whole request and nothing more: half a second is waiting enough."""
    watched = Watched(datagram=False)
    watched.run(1.0)
    watched.put(frame_of(BY_NAME["FILE_TRANSFER_PROTOCOL"], b"\1" * 254)[:30])
    watched.tick()
    watched.send("PARAM_REQUEST_READ", param_id="MC_ROLL_P", param_index=-1, **TARGET)
    heard = []
    for _ in range(125):
        watched.server.step()
        while (data := watched.ends[0].recv()) is not None:
            heard += [m for m in watched.stations[0].receive(data) if m.name == "PARAM_VALUE"]
    assert [message.param_id for message in heard] == ["MC_ROLL_P"]
    assert watched.links[0].connection.pending == 0


def test_every_message_with_senseless_fields() -> None:
    """Each message of the dialect, its checksum right, to us: a handler that trusts a field fails here."""
    forge = Forge(5)
    for flying in (False, True):
        watched = Watched()
        if flying:
            watched.hover()
        for kind in KINDS:
            for _ in range(6):
                watched.put(forge.frame(kind, whole=True))
            watched.tick()
        watched.tick(100)
        assert watched.adds_up()
        assert watched.links[0].connection.counters.received >= 6 * len(KINDS)
        assert watched.answers(0, ANSWER_TICKS)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    kind=st.sampled_from(KINDS),
    payload=st.binary(max_size=255),
    sysid=st.integers(0, 255),
    compid=st.integers(0, 255),
    version=st.sampled_from((1, 2, 2)),
    incompat=st.sampled_from((0, 0, 0, 1, 2, 128)),
    target=st.booleans(),
    copies=st.integers(1, 3),
)
def test_any_payload_of_any_message(
    kind, payload: bytes, sysid: int, compid: int, version: int, incompat: int, target: bool, copies: int
) -> None:
    """Any length from nothing to more than we know, any sender, both versions, any flags."""
    if target:
        whole = bytearray(payload.ljust(kind.size, b"\0"))
        for field in kind.fields:
            if field.name in ("target_system", "target_component", "target"):
                whole[field.offset] = 1
        payload = bytes(whole[: max(len(payload), 1)])
    watched = Watched()
    frame = frame_of(kind, payload, sysid=sysid, compid=compid, version=version, incompat=incompat)
    for _ in range(copies):
        watched.put(frame)
        watched.tick()
    watched.tick(30)
    assert watched.adds_up()
    assert watched.answers(0, ANSWER_TICKS)


@pytest.mark.parametrize("hovering", [False, True], ids=["on the ground", "in Hold"])
def test_damaged_frames_change_nothing(hovering: bool) -> None:
    rng = random.Random(1)
    watched = Watched()
    if hovering:
        watched.hover()
    else:
        watched.run(4.0)
    before, place = watched.state(), watched.vehicle.truth.position_ned()
    counters = watched.links[0].connection.counters
    received, bad_crc, bad_bytes = counters.received, counters.bad_crc, counters.bad_bytes
    frames = [damaged(rng, rng.choice(capture_frames())) for _ in range(3000)]
    for k, frame in enumerate(frames):
        watched.put(frame)
        if k % 5 == 0:
            watched.tick()
    watched.tick(5)
    assert counters.received == received
    assert counters.bad_bytes - bad_bytes + 255 * counters.unknown >= sum(map(len, frames)) - 280
    assert counters.bad_crc - bad_crc > 1000
    assert watched.state() == before
    if hovering:
        assert math.dist(place, watched.vehicle.truth.position_ned()) < 1.0


def test_what_is_for_another_vehicle_changes_nothing_and_is_not_answered() -> None:
    """Whole messages with our captures' own contents, another system or component in their target."""
    watched = Watched().hover()
    before, place = watched.state(), watched.vehicle.truth.position_ned()
    forge = Forge(7)
    streamed = {BY_NAME[name].id for name in watched.links[0].schedule.intervals()}
    strange = [BY_NAME[name].id for name in ("COMMAND_ACK", "PARAM_VALUE", "MISSION_ACK", "FILE_TRANSFER_PROTOCOL")]
    assert not streamed & set(strange)
    answers = 0
    for kind in TARGETED:
        for fields in [fields for name, fields in captures() if name == kind.name] or [{}]:
            target = {"target": 2} if any(field.name == "target" for field in kind.fields) else {"target_system": 2}
            senseless = forge.frame(kind, whole=True, **target)
            watched.put(senseless)
            watched.put(Connection(255, 190).encode_fields(kind.name, {**fields, **target}))
        watched.server.step()
        while (data := watched.ends[0].recv()) is not None:
            answers += sum(message.id in strange for message in watched.stations[0].receive(data))
    watched.run(1.0)
    assert answers == 0
    assert watched.state() == before
    assert math.dist(place, watched.vehicle.truth.position_ned()) < 1.0


def test_telemetry_of_others_changes_nothing() -> None:
    """Messages that are meant for nobody, HEARTBEAT aside, which says that a ground station is there."""
    watched = Watched().hover()
    before, place = watched.state(), watched.vehicle.truth.position_ned()
    forge = Forge(8)
    for kind in KINDS:
        if kind in TARGETED or kind.name == "HEARTBEAT":
            continue
        for _ in range(10):
            watched.put(forge.frame(kind, whole=True))
        watched.tick()
    watched.run(1.0)
    assert watched.state() == before
    assert math.dist(place, watched.vehicle.truth.position_ned()) < 1.0


def test_our_own_address_as_the_sender_commands_nothing() -> None:
    """What a loop of links brings back must not be obeyed."""
    watched = Watched().hover()
    before = watched.state()
    echo = Connection(US, COMPONENT)
    for number in (20, 21, 176, 179, 185, 246, 400):
        for first in (0.0, 1.0):
            watched.put(echo.encode("COMMAND_LONG", command=number, param1=first, param2=4.0, param3=6.0, **TARGET))
            watched.put(echo.encode("COMMAND_INT", command=number, param1=first, param2=4.0, param3=6.0, **TARGET))
            watched.tick(2)
    watched.put(echo.encode("SET_MODE", target_system=US, base_mode=1, custom_mode=4 << 16 | 6 << 24))
    watched.tick(2)
    assert watched.state() == before


def test_every_refusal_can_be_seen() -> None:
    """The status line names each kind of refusal and how many there were."""
    watched = Watched()
    good = watched.stations[0].encode("PARAM_REQUEST_READ", param_id="MC_ROLL_P", param_index=-1, **TARGET)
    unknown = bytes([MAGIC_2, 3, 0, 0, 0, 255, 190, 0xEE, 0xEE, 0x7E, 1, 2, 3, 4, 5])
    watched.put(good[:-1] + bytes([good[-1] ^ 1]))
    watched.put(good[:-4])
    watched.put(unknown)
    watched.send("COMMAND_LONG", command=400, param1=math.nan, target_system=9)
    quat = (math.nan, 0.0, 0.0, 0.0)
    watched.send("SET_ATTITUDE_TARGET", q=quat, type_mask=7, thrust=0.5, **TARGET)
    watched.tick(3)
    status = vehicle_status(watched.server)
    assert status.refusals["bad crc"] == 1
    assert status.refusals["unknown"] == 1
    assert status.refusals["bad bytes"] == len(good) + len(good) - 4
    assert status.refusals["refused"] == 1
    line = FleetStatus(1.0, 1.0, None, (status,)).line()
    for words in ("bad crc 1", "unknown 1", f"bad bytes {2 * len(good) - 4}", "refused 1"):
        assert words in line


def test_a_link_that_wants_signatures_obeys_nothing_else() -> None:
    watched = Watched()
    watched.run(4.0)
    for link in watched.links:
        link.connection.signer = Signer(KEY, link.link_id, require=True)
    station = Connection(255, 190, datagram=True, signer=Signer(KEY, 7))
    other = Connection(255, 190, datagram=True, signer=Signer(type(KEY)(bytes(32 * [9]), 1), 7))
    before = watched.state()
    counters = watched.links[0].connection.counters
    asked = [(name, fields) for name, fields in captures() if name != "HEARTBEAT"][::3]
    received = counters.received
    for name, fields in asked:
        watched.put(Connection(255, 190).encode_fields(name, fields))
        watched.put(other.encode_fields(name, fields))
        watched.tick()
    assert counters.received == received
    assert (counters.unsigned_refused, counters.bad_signature) == (len(asked), len(asked))
    genuine = station.encode("PARAM_SET", param_id="MC_ROLL_P", param_value=7.5, param_type=9, **TARGET)
    watched.put(genuine[:-1] + bytes([genuine[-1] ^ 1]))
    watched.put(genuine[:2] + b"\0" + genuine[3:-13])  # the signature torn off, its flag cleared
    watched.tick(2)
    assert watched.state() == before
    watched.put(genuine)
    watched.tick(2)
    assert watched.vehicle.parameters.get("MC_ROLL_P") == 7.5
    watched.vehicle.parameters.set("MC_ROLL_P", 6.5)
    for _ in range(50):
        watched.put(genuine)
        watched.tick()
    assert counters.replayed == 50
    assert watched.vehicle.parameters.get("MC_ROLL_P") == 6.5
    assert watched.adds_up()


def test_hold_outlives_a_quiet_storm() -> None:
    """Everything that commands nothing, for ten seconds in the air: the vehicle stays where it is and answers."""
    watched = Watched().hover()
    before, place = watched.state(), watched.vehicle.truth.position_ned()
    rng, forge = random.Random(13), Forge(13)
    pool = capture_frames()
    quiet = [kind for kind in KINDS if kind not in TARGETED and kind.name != "HEARTBEAT"]
    asking = [frame for name, fields in captures() if (frame := _question(name, fields)) is not None]
    for k in range(2500):
        if k % 125 == 0:
            for link in (0, 1):
                watched.send("HEARTBEAT", link, type=6, autopilot=8)
        for _ in range(3):
            dice = rng.random()
            if dice < 0.4:
                data = damaged(rng, rng.choice(pool))
            elif dice < 0.7:
                data = forge.frame(rng.choice(quiet), whole=True)
            else:
                data = rng.choice(asking)
            watched.put(data, rng.randrange(2))
        watched.tick()
    assert watched.state() == before
    assert watched.vehicle.autopilot.mode == HOLD
    assert watched.finite()
    assert math.dist(place, watched.vehicle.truth.position_ned()) < 1.0
    assert watched.answers(0, ANSWER_TICKS)
    assert watched.answers(1, ANSWER_TICKS)


def _question(name: str, fields: dict[str, object]) -> bytes | None:
    """A capture that only asks, as bytes; None for one that commands."""
    asks = ("PARAM_REQUEST_READ", "MISSION_REQUEST_LIST", "LOG_REQUEST_LIST", "TIMESYNC", "PING", "REQUEST_EVENT")
    if name in asks or (name == "COMMAND_LONG" and fields.get("command") in (410, 512, 519, 520, 528)):
        return Connection(255, 190).encode_fields(name, fields)
    return None
