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

from hostile import (
    COMPONENT,
    KEY,
    US,
    Forge,
    Watched,
    capture_frames,
    captures,
    cut_up,
    damaged,
    frame_of,
    mutate,
    weight,
)

from bridge.connection import Connection
from bridge.fleet_status import FleetStatus, vehicle_status
from bridge.messages import BY_ID, BY_NAME, MAGIC_2
from bridge.signing import Signer
from sitl.parameters import parameter_specs

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
    assert watched.state() == before


@pytest.mark.parametrize("seed", range(3))
def test_parameters_of_any_bits_do_not_bring_the_process_down(seed: int) -> None:
    """A valid PARAM_SET may make the vehicle fly badly; it must still be there to be told better."""
    rng = random.Random(seed)
    watched = Watched().hover()
    bits = {
        9: [b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\0\0\x80\xff", b"\xff\xff\x7f\x7f", b"\0\0\0\0", b"\0\0\x80\xbf"],
        6: [b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\1\0\0\0"],
    }
    names = [(name, 6 if spec.type == "INT32" else 9) for name, spec in parameter_specs().items()]
    rng.shuffle(names)
    for name, kind in names:
        watched.send("PARAM_SET", param_id=name, param_value=rng.choice(bits[kind]), param_type=kind, **TARGET)
        watched.tick(2)
    watched.run(2.0)
    for command in (21, 20, 400):
        watched.command(command)
        watched.run(0.5)
    assert watched.answers(0, ANSWER_TICKS)


FLOATS = tuple(name for name, spec in parameter_specs().items() if spec.type == "REAL32" and spec.obeyed)
NO_NUMBERS = (b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\0\0\x80\xff", b"\xff\xff\x7f\x7f")
STICK_MODES = (7, 1, 2, 3)


@pytest.mark.parametrize("part", range(10))
def test_no_law_stumbles_over_a_parameter_that_is_no_number(part: int) -> None:
    """Each float the vehicle obeys as NaN, infinite or huge, a few at a time, in every way there is to fly."""
    rng = random.Random(part)
    watched = Watched().hover()
    watched.send("PARAM_SET", param_id="NAV_DLL_ACT", param_value=b"\2\0\0\0", param_type=6, **TARGET)
    for number in range(4):
        names = FLOATS[part::10][number::4]
        kept = {name: watched.vehicle.parameters.raw(name) for name in names}
        for name in names:
            value = rng.choice(NO_NUMBERS)
            watched.send("PARAM_SET", param_id=name, param_value=value, param_type=9, **TARGET)
        for mode in STICK_MODES:
            for k in range(7):
                watched.send("MANUAL_CONTROL", target=US, x=600, y=-500, z=700, r=300)
                watched.run(0.05)
                if k == 0:
                    watched.command(176, 1.0, float(mode))
        here = watched.vehicle.origin
        watched.command(192, -1.0, 1.0, 0.0, math.nan, here[0] + 1e-4, here[1], here[2] + 20.0)
        watched.run(0.3)
        target = {"x": 5.0, "y": 5.0, "z": -10.0, "type_mask": 0xDF8, "coordinate_frame": 1, **TARGET}
        for _ in range(4):
            watched.send("SET_POSITION_TARGET_LOCAL_NED", **target)
            watched.run(0.05)
            watched.command(176, 1.0, 6.0)
        watched.run(0.8)  # Offboard loses its set-points
        for command in (20, 21):
            watched.command(command)
            watched.run(0.3)
        watched.run(2.0, heartbeats=False)
        watched.command(22, 0.0, 0.0, 0.0, math.nan, math.nan, math.nan, here[2] + 10.0)
        for name, value in kept.items():
            watched.send("PARAM_SET", param_id=name, param_value=value, param_type=9, **TARGET)
        watched.run(1.0)
    assert watched.answers(0, ANSWER_TICKS)


def test_a_flood_on_one_link_does_not_keep_the_other_waiting() -> None:
    """Both are served within two ticks, and what is not read by then is left to the link, not stored by us."""
    watched = Watched()
    watched.run(1.0)
    forge, rng = Forge(11), random.Random(11)
    requests = [frame for frame in capture_frames() if frame[0] == MAGIC_2]
    before = weight(watched.server)
    for _ in range(30):
        for _ in range(300):
            watched.ends[0].send(rng.choice(requests) if rng.random() < 0.7 else forge.frame())
        assert watched.answers(1, ANSWER_TICKS)
        while watched.ends[0].recv() is not None:
            pass
    waiting = sum(map(len, watched.links[0].link._inbox))  # type: ignore[attr-defined]
    assert weight(watched.server) - before < waiting + 80 * 10_000 + 2_000_000


def test_a_tick_takes_a_bounded_number_of_bytes() -> None:
    """Datagrams as large as there are, full of requests: what one tick takes of them does not stop the vehicle."""
    watched = Watched()
    watched.run(1.0)
    request = watched.stations[0].encode("PARAM_REQUEST_READ", param_index=3, **TARGET)
    for _ in range(20):
        watched.put(request * (65_000 // len(request)))
    good = watched.good[0]
    watched.tick()
    assert 0 < watched.good[0] - good <= 2 * 65_535
    watched.tick(30)
    assert watched.answers(1, ANSWER_TICKS)


@pytest.mark.parametrize("kind", ["everything", "damaged", "requests"])
def test_memory_does_not_grow(kind: str) -> None:
    """After as many again it is what it was; the senders are a few, as on a real link."""
    watched = Watched()
    watched.run(1.0)
    rng, forge = random.Random(3), Forge(3)
    pool = capture_frames()

    def storm() -> int:
        for _ in range(2500):
            if kind == "everything":
                data = forge.frame()
            elif kind == "damaged":
                data = mutate(rng, rng.choice(pool), pool)
            else:
                data = rng.choice(pool)
            watched.put(data, rng.randrange(2))
            if rng.random() < 0.25:
                watched.tick()
        watched.tick(20)
        return weight(watched.server)

    storm()
    first, second = storm(), storm()
    assert second - first < 100_000


def test_any_number_of_senders_costs_a_bounded_amount() -> None:
    watched = Watched()
    kind = BY_NAME["HEARTBEAT"]
    payload = bytes([0, 0, 0, 0, 6, 8, 0, 0, 3])

    def from_everybody() -> int:
        for sysid in range(0, 256):
            frames = [frame_of(kind, payload, sysid=sysid, compid=compid) for compid in range(0, 256, 4)]
            watched.put(b"".join(frames))
            watched.tick()
        return weight(watched.server)

    first = from_everybody()
    assert from_everybody() - first < 20_000
    assert watched.answers(0, ANSWER_TICKS)


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
