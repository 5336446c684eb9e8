"""What a vehicle is asked too often, or to be what it cannot be: bounded work, bounded memory, and it flies on."""

from __future__ import annotations

import math
import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from hostile import Forge, capture_frames, captures, frame_of, mutate
from hostile_vehicle import COMPONENT, US, Watched, weight

from bridge.connection import Connection
from bridge.messages import BY_NAME, MAGIC_2
from sitl.parameters import parameter_specs

TARGET = {"target_system": US, "target_component": COMPONENT}
ANSWER_TICKS = 2


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


def test_one_who_is_refused_all_the_time_does_not_fill_the_other_link_with_texts() -> None:
    """What a vehicle has to say about nonsense is news once, not thousands of times a second."""
    watched = Watched()
    watched.run(1.0)
    nonsense = [fields for name, fields in captures() if name == "MISSION_ITEM_INT"][:1] or [{}]
    texts = 0
    for k in range(250):
        if k % 125 == 0:
            watched.send("HEARTBEAT", 1, type=6, autopilot=8)
        for fields in nonsense * 50:
            watched.put(watched.stations[0].encode_fields("MISSION_ITEM_INT", {**fields, **TARGET, "seq": 7}))
        watched.server.step()
        while (data := watched.ends[1].recv()) is not None:
            texts += sum(message.name == "STATUSTEXT" for message in watched.stations[1].receive(data))
        while watched.ends[0].recv() is not None:
            pass
    assert texts <= 100


@pytest.mark.parametrize("number", [400, 511, 512, 2510, 2511, 245, 246, 241, 310, 420, 209, 300, 192, 22, 176])
def test_a_command_again_and_again_leaves_nothing_behind(number: int) -> None:
    """Whatever is answered later must not be a queue that anybody can fill."""
    watched = Watched()
    watched.run(3.0)
    before = weight(watched.server)
    for k in range(60):
        for compid in range(60):
            watched.put(Connection(255, 1 + compid).encode("COMMAND_LONG", command=number, param1=k % 3, **TARGET))
        watched.tick(3)
    assert weight(watched.server) - before < 150_000
    watched.run(1.5)
    assert watched.answers(0, ANSWER_TICKS)


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
            watched.tick(3)
        return weight(watched.server)

    first = from_everybody()
    assert from_everybody() - first < 20_000
    assert watched.answers(0, ANSWER_TICKS)
