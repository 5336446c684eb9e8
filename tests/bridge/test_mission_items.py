"""What is kept of an item, how it is given back, and the plans that hold items."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.connection import Connection
from bridge.messages import Message
from bridge.mission_items import (
    PLACED_COMMANDS,
    UNPLACED_COMMANDS,
    ItemRefused,
    fields_of,
    item_crc,
    item_from,
)
from bridge.plan_store import EMPTY, PlanKind, PlanStore
from sitl.plan import MissionItem

NAN = math.nan
FLOATS = st.floats(width=32)
ITEM = MissionItem(6, 16, True, (0.0, 0.0, 0.0, NAN), 47.0, 8.0, 10.0)


def message(name: str = "MISSION_ITEM_INT", **fields: Any) -> Message:
    fields = {"frame": 6, "command": 16, "autocontinue": 1, **fields}
    [msg] = Connection(1, 1).receive(Connection(255, 190).encode(name, **fields))
    return msg


def back(msg: Message, kind: PlanKind = PlanKind.MISSION, *, integers: bool = True) -> dict[str, Any]:
    return fields_of(item_from(msg, kind), integers=integers)


def params(fields: dict[str, Any]) -> tuple[float, ...]:
    return tuple(fields[f"param{number}"] for number in range(1, 5))


def test_the_crc_is_px4s() -> None:
    crc = 0
    for command, x, z in ((22, 473977420, 10.0), (16, 473979420, 10.0), (21, 473977420, 0.0)):
        crc = item_crc(message(command=command, param4=NAN, x=x, y=85455940, z=z, current=int(command == 22)), crc)
    assert crc == 3131962481


@pytest.mark.parametrize(
    ("command", "sent", "kept"),
    [
        (16, (1.5, 2.5, 9.0, -90.0), (1.5, 2.5, 0.0, 270.0)),
        (17, (1.0, 2.0, -3.0, 720.0), (0.0, 0.0, -3.0, 0.0)),
        (19, (8.0, 5.0, 3.0, 2.0), (8.0, 1.0, 3.0, 1.0)),
        (19, (8.0, -5.0, 3.0, NAN), (8.0, 0.0, 3.0, 0.0)),
        (21, (4.0, 2.9, 3.0, 45.0), (0.0, 2.0, 0.0, 45.0)),
        (22, (15.0, 2.0, 3.0, 359.5), (0.0, 0.0, 0.0, 359.5)),
        (31, (1.0, 20.0, 3.0, 1.0), (1.0, 20.0, 0.0, 1.0)),
        (5000, (1.0, 2.0, 3.0, 4.0), (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_a_placed_command_keeps_its_parameters(command: int, sent: Any, kept: Any) -> None:
    msg = message(command=command, **{f"param{number}": value for number, value in enumerate(sent, start=1)})
    assert params(back(msg)) == kept


def test_a_heading_that_is_none_stays_none() -> None:
    for nothing in (NAN, math.inf, -math.inf):
        assert math.isnan(back(message(param4=nothing))["param4"])
    assert back(message(param4=-1e-30))["param4"] == 0.0


@pytest.mark.parametrize(("sent", "integers", "floats"), [(0, 5, 0), (3, 6, 3), (5, 5, 0), (6, 6, 3)])
def test_frames_come_back_as_the_form_has_them(sent: int, integers: int, floats: int) -> None:
    kept = item_from(message(frame=sent, x=473977420, y=-85455941), PlanKind.MISSION)
    as_integers, as_floats = fields_of(kept, integers=True), fields_of(kept, integers=False)
    assert (as_integers["frame"], as_floats["frame"]) == (integers, floats)
    assert (as_integers["x"], as_integers["y"]) == (473977420, -85455941)
    assert (as_floats["x"], as_floats["y"]) == pytest.approx((47.397742, -8.5455941))


def test_floats_take_no_integer_frames() -> None:
    assert item_from(message("MISSION_ITEM", frame=3, x=47.5, y=8.25), PlanKind.MISSION).lat_deg == 47.5
    for frame in (5, 6):
        with pytest.raises(ItemRefused) as refused:
            item_from(message("MISSION_ITEM", frame=frame), PlanKind.MISSION)
        assert refused.value.result == 2


@pytest.mark.parametrize(
    ("fields", "result"),
    [
        ({"command": 31010}, 3),
        ({"command": 18}, 3),
        ({"command": 20}, 3),
        ({"frame": 2, "command": 16}, 3),
        ({"frame": 2, "command": 115}, 3),
        ({"frame": 1}, 2),
        ({"frame": 11}, 2),
        ({"command": 201, "param1": 1.0}, 6),
        ({"command": 80, "param1": NAN}, 6),
        ({"frame": 2, "command": 201, "param1": 3.0}, 6),
        ({"command": 5001, "param1": 4.0}, 1),
        ({"command": 5100}, 1),
    ],
)
def test_what_px4_does_not_take_is_refused_as_by_px4(fields: dict[str, Any], result: int) -> None:
    with pytest.raises(ItemRefused) as refused:
        item_from(message(**fields), PlanKind.MISSION)
    assert refused.value.result == result
    assert str(fields.get("command", fields.get("frame"))) in str(refused.value) or result == 6


def test_unplaced_commands_keep_seven_parameters() -> None:
    sent = {"frame": 2, "command": 178, "param1": 1.0, "param2": 7.5, "param3": -1.0, "param4": NAN, "x": 3, "y": -4}
    fields = back(message(**sent, z=5.0))
    assert {key: repr(fields[key]) for key in sent} == {key: repr(value) for key, value in sent.items()}
    jump = back(message(frame=2, command=177, param1=2.7, param2=3.0))
    assert params(jump) == (2.0, 3.0, 0.0, 0.0)
    assert back(message(frame=2, command=80, param1=1.0))["command"] == 201


@pytest.mark.parametrize("command", sorted(PLACED_COMMANDS - {5001, 5002, 5003, 5004, 5100}))
def test_every_placed_command_is_taken(command: int) -> None:
    assert back(message(command=command))["command"] == (201 if command == 80 else command)


@pytest.mark.parametrize("command", sorted(UNPLACED_COMMANDS))
def test_every_unplaced_command_is_taken(command: int) -> None:
    assert back(message(frame=2, command=command))["frame"] == 2


def test_a_fence_keeps_place_height_and_one_parameter() -> None:
    corner = back(message(frame=3, command=5001, param1=4.0, param2=1.0, x=10, y=20, z=30.0), PlanKind.FENCE)
    assert params(corner) == (4.0, 0.0, 0.0, 0.0)
    assert (corner["frame"], corner["autocontinue"]) == (5, 0)
    assert (corner["x"], corner["y"], corner["z"]) == (10, 20, 30.0)
    assert params(back(message(command=5004, param1=12.5), PlanKind.FENCE)) == (12.5, 0.0, 0.0, 0.0)
    assert params(back(message(param1=1.0, param4=90.0), PlanKind.FENCE)) == (1.0, 0.0, 0.0, 0.0)
    for few in (2.0, NAN):
        with pytest.raises(ItemRefused) as refused:
            item_from(message(command=5002, param1=few), PlanKind.FENCE)
        assert (refused.value.result, refused.value.silent) == (1, True)


@given(
    name=st.sampled_from(("MISSION_ITEM", "MISSION_ITEM_INT")),
    frame=st.sampled_from((0, 2, 3, 5, 6)),
    command=st.sampled_from(sorted(PLACED_COMMANDS | UNPLACED_COMMANDS)),
    values=st.tuples(FLOATS, FLOATS, FLOATS, FLOATS, FLOATS),
    place=st.tuples(FLOATS, FLOATS),
    number=st.integers(-(2**31), 2**31 - 1),
    kind=st.sampled_from(tuple(PlanKind)),
)
def test_whatever_is_taken_can_be_given_back(
    name: str, frame: int, command: int, values: Any, place: Any, number: int, kind: PlanKind
) -> None:
    x, y = place if name == "MISSION_ITEM" else (number, -number - 1)
    fields = {f"param{index}": value for index, value in enumerate(values[:4], start=1)}
    msg = message(name, frame=frame, command=command, x=x, y=y, z=values[4], **fields)
    try:
        kept = item_from(msg, kind)
    except ItemRefused:
        return
    for integers in (True, False):
        given_back = message("MISSION_ITEM_INT" if integers else "MISSION_ITEM", **fields_of(kept, integers=integers))
        assert repr(item_from(given_back, kind).params) == repr(kept.params)


def test_a_store_tells_of_new_missions_only() -> None:
    told: list[tuple[int, int]] = []
    store = PlanStore(lambda items, opaque_id: told.append((len(items), opaque_id)))
    store.put(PlanKind.FENCE, [ITEM], 5)
    store.put(PlanKind.MISSION, [ITEM, ITEM], 7, first=1)
    assert store.current == 1
    store.put(PlanKind.MISSION, [ITEM, ITEM], 7)
    assert store.current == 1
    store.put(PlanKind.MISSION, [ITEM], 7)  # another plan with the same CRC
    store.clear(PlanKind.FENCE)
    store.clear(255)
    assert told == [(2, 7), (1, 7), (0, 0)]
    assert store.plan(0) is store.plan(1) is store.plan(99) is EMPTY
    assert not store.set_current(0)
