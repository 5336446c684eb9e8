"""Plans over a wire that loses, repeats and reorders, and under storms of nonsense."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.connection import Connection, Message
from bridge.mission_protocol import MissionServer
from bridge.plan_store import MOST_ITEMS, PlanKind, PlanStore
from sitl.plan import MissionItem

TICK_US = 4_000
LONGEST_US = 120_000_000
PATIENCE_US = 400_000
FLOATS = st.floats(width=32)
SMALL = st.integers(0, 4)


class Wire:
    """One direction of a bad wire."""

    def __init__(self, chance: random.Random, loss: float) -> None:
        self.chance = chance
        self.loss = loss
        self._under_way: list[tuple[int, bytes]] = []

    def send(self, data: bytes, now_us: int) -> None:
        for _ in range(2 if self.chance.random() < 0.1 else 1):
            if self.chance.random() >= self.loss:
                self._under_way.append((now_us + self.chance.randrange(0, 120_000), data))

    def receive(self, now_us: int) -> list[bytes]:
        come = [data for due_us, data in self._under_way if due_us <= now_us]
        self._under_way = [one for one in self._under_way if one[0] > now_us]
        return come


class Client:
    """A ground station that uploads or downloads one plan and tries again until it is done."""

    def __init__(self, kind: int, items: list[dict[str, Any]] | None) -> None:
        self.kind = kind
        self.items = items  # None: download
        self.got: dict[int, dict[str, Any]] = {}
        self.count: int | None = None
        self.done = False
        self._last: tuple[str, dict[str, Any]] | None = None
        self._sent_us = 0
        self._tries = 0

    def poll(self, now_us: int) -> list[tuple[str, dict[str, Any]]]:
        if self._last is None or self._tries > 20:  # begin, or begin again
            self._tries, self.count, self.got = 0, None, {}
            begin = (
                ("MISSION_REQUEST_LIST", {}) if self.items is None else ("MISSION_COUNT", {"count": len(self.items)})
            )
            return self._send(begin, now_us)
        if now_us - self._sent_us >= PATIENCE_US:
            self._tries += 1
            return self._send(self._last, now_us)
        return []

    def hear(self, msg: Message, now_us: int) -> list[tuple[str, dict[str, Any]]]:
        if self.items is not None and msg.name in ("MISSION_REQUEST_INT", "MISSION_REQUEST"):
            seq = msg["seq"]
            return self._send(("MISSION_ITEM_INT", {"seq": seq, **self.items[seq]}), now_us)
        if self.items is None and msg.name == "MISSION_COUNT" and self.count is None:
            self.count = msg.count
        elif self.items is None and msg.name == "MISSION_ITEM_INT" and self.count is not None:
            self.got.setdefault(msg["seq"], msg.fields())
        elif msg.name == "MISSION_ACK" and msg.type != 0:
            self._last = None
            return []
        elif msg.name == "MISSION_ACK" and self.items is not None:
            sent_all = self._last is not None and self._last[1].get("seq") == len(self.items) - 1
            self.done = sent_all or not self.items
            return []
        else:
            return []
        seq = next((one for one in range(self.count) if one not in self.got), None)
        if seq is not None:
            wanted = ("MISSION_REQUEST_INT", {"seq": seq})
            return [] if self._last == wanted else self._send(wanted, now_us)
        self.done = True
        return self._send(("MISSION_ACK", {}), now_us)

    def _send(self, message: tuple[str, dict[str, Any]], now_us: int) -> list[tuple[str, dict[str, Any]]]:
        self._last, self._sent_us = message, now_us
        return [(message[0], {**message[1], "mission_type": self.kind})]


def run(server: MissionServer, client: Client, chance: random.Random, loss: float, watch: Callable[[], None]) -> None:
    """Let a ground station and the vehicle talk until the ground station is done."""
    up, down = Wire(chance, loss), Wire(chance, loss)
    ground, ground_rx, vehicle, vehicle_rx = (Connection(*who) for who in ((255, 190), (255, 190), (1, 1), (1, 1)))
    for now_us in range(10_000_000, 10_000_000 + LONGEST_US, TICK_US):
        out = client.poll(now_us)
        for data in down.receive(now_us):
            for msg in ground_rx.receive(data):
                out += client.hear(msg, now_us)
        for name, fields in out:
            up.send(ground.encode(name, target_system=1, target_component=1, **fields), now_us)
        replies = server.poll(0, now_us)
        for data in up.receive(now_us):
            for msg in vehicle_rx.receive(data):
                replies += server.handle(msg, 0, now_us)
                watch()
        for name, fields in replies:
            down.send(vehicle.encode(name, **fields), now_us)
        if client.done:
            return
    pytest.fail("never done")


@st.composite
def waypoints(draw: st.DrawFn) -> dict[str, Any]:
    """A waypoint that PX4 gives back as it came."""
    return {
        "frame": draw(st.sampled_from((5, 6))),
        "command": 16,
        "autocontinue": draw(st.integers(0, 1)),
        "param1": draw(FLOATS),
        "param2": draw(FLOATS),
        "param4": draw(st.one_of(st.just(math.nan), st.integers(0, 359).map(float))),
        "x": draw(st.integers(-900_000_000, 900_000_000)),
        "y": draw(st.integers(-1_800_000_000, 1_800_000_000)),
        "z": draw(FLOATS),
    }


@settings(deadline=None)
@given(
    plan=st.lists(waypoints(), max_size=8),
    kind=st.sampled_from((PlanKind.MISSION, PlanKind.RALLY)),
    loss=st.sampled_from((0.0, 0.1, 0.3)),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_plan_comes_back_as_it_was_sent(plan: list[dict[str, Any]], kind: PlanKind, loss: float, seed: int) -> None:
    chance = random.Random(seed)
    store = PlanStore()
    store.put(kind, [MissionItem(2, 20, True, (0.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0)], 77)
    server = MissionServer(store, say=lambda *_: None)

    def whole() -> None:
        """Either the old plan or the whole new one."""
        assert store.plan(kind).opaque_id == 77 or len(store.plan(kind).items) == len(plan)

    run(server, Client(kind, plan), chance, loss, whole)
    server.forget(0)
    client = Client(kind, None)
    run(server, client, chance, loss, whole)
    assert client.count == len(plan)
    for seq, sent in enumerate(plan):
        back = client.got[seq]
        assert {key: repr(back[key]) for key in sent} == {key: repr(value) for key, value in sent.items()}


@st.composite
def nonsense(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    name = draw(st.sampled_from(MissionServer.HANDLES))
    fields: dict[str, Any] = {
        "target_system": draw(st.sampled_from((1, 1, 1, 0, 7))),
        "target_component": draw(st.sampled_from((1, 1, 0, 190, 3))),
    }
    if name != "MISSION_SET_CURRENT":
        fields["mission_type"] = draw(st.sampled_from((0, 0, 0, 1, 2, 3, 255)))
    if name in ("MISSION_SET_CURRENT", "MISSION_REQUEST", "MISSION_REQUEST_INT"):
        fields["seq"] = draw(st.one_of(SMALL, st.integers(0, 65535)))
    if name == "MISSION_COUNT":
        fields["count"] = draw(st.one_of(SMALL, st.integers(0, 65535)))
    if name == "MISSION_ACK":
        fields["type"] = draw(st.sampled_from((0, 1, 3, 15, 255)))
    if name.startswith("MISSION_ITEM"):
        place = FLOATS if name == "MISSION_ITEM" else st.integers(-(2**31), 2**31 - 1)
        fields |= {
            "seq": draw(SMALL),
            "frame": draw(st.sampled_from((0, 2, 3, 5, 6, 9, 255))),
            "command": draw(st.sampled_from((16, 19, 21, 22, 31, 80, 177, 201, 5001, 5003, 5100, 7))),
            "current": draw(st.integers(0, 255)),
            "autocontinue": draw(st.integers(0, 255)),
            **{f"param{number}": draw(FLOATS) for number in range(1, 5)},
            "x": draw(place),
            "y": draw(place),
            "z": draw(FLOATS),
        }
    return name, fields


@settings(deadline=None)
@given(
    storm=st.lists(
        st.tuples(nonsense(), st.integers(0, 1), st.sampled_from(((255, 190), (9, 9))), st.integers(0, 10_000_000)),
        min_size=1,
        max_size=60,
    )
)
def test_a_storm_changes_no_plan_unless_it_is_acknowledged(storm: list[Any]) -> None:
    store = PlanStore()
    server = MissionServer(store, say=lambda *_: None)
    vehicle = Connection(1, 1)
    now_us = 0
    for (name, fields), link, peer, pause_us in storm:
        now_us += pause_us
        before = [store.plan(kind) for kind in PlanKind]
        ground = Connection(*peer)
        [msg] = vehicle.receive(ground.encode(name, **fields))
        replies = server.handle(msg, link, now_us)
        changed = [kind for kind in PlanKind if store.plan(kind) is not before[kind]]
        if changed:
            [(answer, acknowledged)] = replies
            assert (answer, acknowledged["type"]) == ("MISSION_ACK", 0)
            assert acknowledged["mission_type"] in (*changed, 255)
        for answer, reply in [*replies, *server.poll(link, now_us)]:
            vehicle.encode(answer, **reply)
        for kind, most in MOST_ITEMS.items():
            assert len(store.plan(kind).items) <= most
        assert 0 <= store.current <= max(len(store.mission.items) - 1, 0)
    for link in (0, 1):
        server.forget(link)
    assert server.poll(0, now_us) == []


def test_the_largest_mission_fits() -> None:
    store = PlanStore()
    server = MissionServer(store, say=lambda *_: None)
    ground, vehicle = Connection(255, 190), Connection(1, 1)
    target = {"target_system": 1, "target_component": 1}
    most = MOST_ITEMS[PlanKind.MISSION]
    count = ground.encode("MISSION_COUNT", count=most, **target)
    replies = [reply for msg in vehicle.receive(count) for reply in server.handle(msg, 0, 0)]
    while replies[-1][0] == "MISSION_REQUEST_INT":
        wanted = {"seq": replies[-1][1]["seq"], "command": 16, "frame": 6}
        data = ground.encode("MISSION_ITEM_INT", **wanted, **target)
        replies = [reply for msg in vehicle.receive(data) for reply in server.handle(msg, 0, 0)]
    assert replies[-1][1]["type"] == 0
    assert len(store.mission.items) == most
