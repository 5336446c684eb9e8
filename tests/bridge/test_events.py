"""The events service: nothing the vehicle reports is lost, whatever a link does to it."""

from __future__ import annotations

import ast
import json
import lzma
import random
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.component_metadata import ComponentMetadata
from bridge.connection import Connection, Message
from bridge.event_list import events_json, find_event
from bridge.events import KEPT, EventServer
from sitl.modes import MODE_NAMES, Severity
from sitl.parameters import ParameterTable

ROOT = Path(__file__).parents[2]
FIRST = 0xFFF6
"""A PX4 begins to count shortly before the count wraps around."""


class Wire:
    """An event server whose messages go through real frames."""

    def __init__(self) -> None:
        self.server = EventServer(system_id=1, component_id=1)
        self.now_us = 0
        self._vehicle, self._ground = Connection(1, 1, datagram=True), Connection(255, 190, datagram=True)

    def report(self, *texts: str) -> None:
        for text in texts:
            assert self.server.report(Severity.INFO, text, self.now_us)

    def poll(self, link: int = 0, seconds: float = 0.004) -> list[Message]:
        self.now_us += round(seconds * 1e6)
        return self._down(self.server.poll(link, self.now_us))

    def request(self, first: int, last: int, *, system: int = 1, component: int = 1) -> list[Message]:
        fields = {"target_system": system, "target_component": component}
        frame = self._ground.encode("REQUEST_EVENT", first_sequence=first, last_sequence=last, **fields)
        (message,) = self._vehicle.receive(frame)
        return self._down(self.server.handle(message, 0, self.now_us))

    def _down(self, replies: list[tuple[str, dict[str, Any]]]) -> list[Message]:
        return [one for name, fields in replies for one in self._ground.receive(self._vehicle.encode(name, **fields))]


class Listener:
    """A ground station's part: what it has not heard it asks for, as MAVLink's page on events says."""

    def __init__(self, latest: int) -> None:
        self.latest = latest
        self.events: list[Message] = []
        self.lost = 0
        self.wanted: int | None = None

    def hear(self, message: Message) -> None:
        if message.name == "CURRENT_EVENT_SEQUENCE":
            self._wait_for(message.sequence)
        elif message.name == "RESPONSE_EVENT_ERROR" and message.sequence == self.latest + 1 & 0xFFFF:
            self.lost += message.sequence_oldest_available - message.sequence & 0xFFFF
            self.latest = message.sequence_oldest_available - 1 & 0xFFFF
        elif message.name == "EVENT":
            if message.sequence == self.latest + 1 & 0xFFFF:
                self.latest = message.sequence
                self.events.append(message)
            else:
                self._wait_for(message.sequence)

    def _wait_for(self, sequence: int) -> None:
        if 0 < sequence - self.latest & 0xFFFF < 0x8000:
            self.wanted = sequence

    @property
    def gap(self) -> tuple[int, int] | None:
        """What it has to ask for."""
        if self.wanted is None or not 0 < self.wanted - self.latest & 0xFFFF < 0x8000:
            return None
        return self.latest + 1 & 0xFFFF, self.wanted


def takeoff_height(event: Message) -> float:
    value: float = struct.unpack_from("<f", event.arguments)[0]
    return value


class TestSequence:
    def test_a_link_is_told_first_that_a_new_count_begins(self) -> None:
        wire = Wire()
        (current,) = wire.poll()
        assert (current.name, current.sequence, current.flags) == ("CURRENT_EVENT_SEQUENCE", FIRST - 1, 1)
        assert wire.poll() == []

    def test_every_event_goes_out_once_on_every_link_in_order(self) -> None:
        wire = Wire()
        for link in (0, 1):
            wire.poll(link)
        wire.report("Takeoff detected", "Landing detected", "Disarmed by landing")
        for link in (0, 1):
            events = wire.poll(link)
            assert [one.name for one in events] == ["EVENT"] * 3
            assert [one.sequence for one in events] == [FIRST, FIRST + 1, FIRST + 2]
            assert len({one["id"] for one in events}) == 3
            assert wire.poll(link) == []

    def test_the_count_wraps_around(self) -> None:
        wire = Wire()
        wire.poll()
        wire.report(*["Takeoff detected"] * 12)
        assert [one.sequence for one in wire.poll()] == [*range(FIRST, 0x10000), 0, 1]

    def test_an_event_carries_its_time_and_severity_twice(self) -> None:
        wire = Wire()
        wire.poll(seconds=12.345)
        wire.server.report(Severity.CRITICAL, "Failsafe activated", wire.now_us)
        (event,) = wire.poll()
        assert event.event_time_boot_ms == 12_345
        assert event.log_levels == 0x22
        assert (event.destination_component, event.destination_system) == (0, 0)

    def test_the_number_of_the_last_is_repeated_every_three_seconds(self) -> None:
        wire = Wire()
        wire.poll()
        wire.report("Takeoff detected")
        wire.poll()
        heard = [one for _ in range(2500) for one in wire.poll()]
        assert [(one.name, one.sequence, one.flags) for one in heard] == [("CURRENT_EVENT_SEQUENCE", FIRST, 0)] * 3

    def test_the_next_peer_is_told_where_the_count_is(self) -> None:
        wire = Wire()
        wire.poll()
        wire.report("Takeoff detected")
        wire.poll()
        wire.server.forget(0)
        wire.report("Landing detected")
        (current,) = wire.poll()
        assert (current.name, current.sequence, current.flags) == ("CURRENT_EVENT_SEQUENCE", FIRST, 1)
        (event,) = wire.poll()  # newer than what it was told, or it would be taken for a repeat
        assert (event.name, event.sequence) == ("EVENT", FIRST + 1)

    def test_what_no_event_says_takes_no_number(self) -> None:
        wire = Wire()
        wire.poll()
        assert not wire.server.report(Severity.INFO, "Good morning", 0)
        wire.report("Takeoff detected")
        assert [one.sequence for one in wire.poll()] == [FIRST]

    def test_a_flight_is_told_in_texts_and_events_alike(self, flight: Any) -> None:
        one = flight().hover()
        one.result(21)
        one.run(12.0)
        tabbed = [text[:-1] for text in one.ground.texts() if text.endswith("\t")]
        found = [find_event(text) for text in tabbed]
        assert "Disarmed by landing" in tabbed
        assert [event["id"] for event in one.ground.named("EVENT")] == [known[0].number for known in found if known]
        assert None not in found


class TestRequests:
    @pytest.fixture
    def wire(self) -> Wire:
        wire = Wire()
        wire.poll()
        wire.report(*["Takeoff detected"] * 20)
        wire.poll()
        return wire

    @pytest.mark.parametrize(
        ("first", "last", "sequences"),
        [
            (FIRST, FIRST, [FIRST]),
            (FIRST + 3, FIRST + 5, [FIRST + 3, FIRST + 4, FIRST + 5]),
            (0xFFFE, 2, [0xFFFE, 0xFFFF, 0, 1, 2]),
            (9, 9, [9]),
        ],
    )
    def test_events_are_sent_again(self, wire: Wire, first: int, last: int, sequences: list[int]) -> None:
        events = wire.request(first, last)
        assert [one.name for one in events] == ["EVENT"] * len(sequences)
        assert [one.sequence for one in events] == sequences

    def test_what_is_gone_or_not_there_yet_is_said(self, wire: Wire) -> None:
        before, event = wire.request(FIRST - 1, FIRST)
        assert (before.name, before.sequence, before.sequence_oldest_available) == (
            "RESPONSE_EVENT_ERROR",
            FIRST - 1,
            FIRST,
        )
        assert (before.target_system, before.target_component, before.reason) == (255, 190, 0)
        assert event.sequence == FIRST
        assert [one.name for one in wire.request(10, 10)] == ["RESPONSE_EVENT_ERROR"]

    def test_only_so_many_are_kept(self, wire: Wire) -> None:
        wire.report(*["Landing detected"] * KEPT)
        newest = FIRST + 20 + KEPT - 1 & 0xFFFF
        (error,) = wire.request(newest - KEPT & 0xFFFF, newest - KEPT & 0xFFFF)
        assert (error.name, error.sequence_oldest_available) == ("RESPONSE_EVENT_ERROR", newest - KEPT + 1)
        assert [one.name for one in wire.request(newest - KEPT + 1, newest - KEPT + 1)] == ["EVENT"]

    def test_an_answer_is_bounded_and_begins_at_the_first(self, wire: Wire) -> None:
        answers = wire.request(0x7000, 0xEFFF)
        assert len(answers) == 32
        assert [one.sequence for one in answers] == list(range(0x7000, 0x7020))

    def test_a_range_that_runs_backwards_is_refused(self, wire: Wire) -> None:
        assert wire.request(5, 4) == []
        assert wire.request(FIRST + 9, FIRST) == []
        assert wire.server.refused == 2

    @pytest.mark.parametrize(("system", "component"), [(0, 1), (9, 1), (1, 99)])
    def test_of_others_are_silence(self, wire: Wire, system: int, component: int) -> None:
        assert wire.request(FIRST, FIRST, system=system, component=component) == []
        assert wire.server.refused == 0
        assert [one.sequence for one in wire.request(FIRST, FIRST, component=0)] == [FIRST]

    @given(first=st.integers(0, 65535), last=st.integers(0, 65535), reported=st.integers(0, 100))
    @settings(max_examples=100, deadline=None)
    def test_no_range_upsets_it(self, first: int, last: int, reported: int) -> None:
        wire = Wire()
        wire.report(*["Takeoff detected"] * reported)
        answers = wire.request(first, last)
        assert len(answers) <= 32
        assert [one.sequence for one in answers] == [first + k & 0xFFFF for k in range(len(answers))]


@pytest.mark.parametrize("seed", range(6))
def test_a_listener_recovers_what_its_link_loses(seed: int) -> None:
    """Half of everything is lost both ways; what is reported arrives whole, once and in order."""
    rng, wire, listener = random.Random(seed), Wire(), Listener(FIRST - 1)
    wire.poll()
    for step in range(4000):
        if step < 2000 and step % 50 == 0:
            wire.report(f"Takeoff to {step / 10:.1f} meters above home")
        heard = wire.poll()
        if listener.gap is not None and step % 10 == 0 and rng.random() < 0.5:
            heard += wire.request(*listener.gap)
        for message in heard:
            if rng.random() < 0.5:
                listener.hear(message)
    assert [takeoff_height(event) for event in listener.events] == [5.0 * k for k in range(40)]
    assert listener.lost == 0


def test_a_listener_that_was_away_for_long_learns_what_is_gone() -> None:
    wire, listener = Wire(), Listener(FIRST - 1)
    wire.poll()
    wire.report(*["Takeoff detected"] * 100)
    wire.poll()
    (current,) = wire.poll(seconds=3.0)
    listener.hear(current)
    for _ in range(10):
        for message in wire.request(*listener.gap) if listener.gap else []:
            listener.hear(message)
    assert (listener.lost, len(listener.events)) == (100 - KEPT, KEPT)


class TestList:
    """What libevents asks of an events file: version 1, numbers below 2**24 a component, placeholders that exist."""

    def test_is_what_ground_stations_can_read(self) -> None:
        tree = json.loads(events_json())
        assert tree["version"] == 1
        assert list(tree["components"]) == ["1"]
        component = tree["components"]["1"]
        assert component["namespace"] == "px4"
        events = component["event_groups"]["default"]["events"]
        assert len(events) > 60
        for key, event in events.items():
            assert key == str(int(key))
            assert 0 <= int(key) < 1 << 24
            assert re.fullmatch(r"[a-z][a-z0-9_]*", event["name"])
            assert {argument["type"] for argument in event["arguments"]} <= {"float"}
            assert len({argument["name"] for argument in event["arguments"]}) == len(event["arguments"])
            holes = [int(hole) for hole in re.findall(r"\{(\d+)", event["message"])]
            assert sorted(holes) == list(range(1, len(event["arguments"]) + 1))
            assert not set(event["message"]) & set("<>\\\t")
        assert len({event["name"] for event in events.values()}) == len(events)

    def test_numbers_are_the_hashes_of_the_names(self) -> None:
        for key, event in json.loads(events_json())["components"]["1"]["event_groups"]["default"]["events"].items():
            value = 0x811C9DC5
            for byte in event["name"].encode():
                value = (value ^ byte) * 0x01000193 % 2**32
            assert int(key) == value % 2**24

    def test_what_is_sent_is_in_it(self) -> None:
        events = json.loads(events_json())["components"]["1"]["event_groups"]["default"]["events"]
        known = find_event("RTL: start return at 31.5 m (-7 m above destination)")
        assert known is not None
        event, arguments = known
        assert event.number >> 24 == 1
        assert events[str(event.number & 0xFFFFFF)]["message"] == event.message
        assert struct.unpack("<2f", arguments) == (31.5, -7.0)

    def test_is_the_vehicle_s_metadata(self) -> None:
        table = ParameterTable()
        files = ComponentMetadata(table, more={4: ("all_events.json", events_json())}).files()
        assert lzma.decompress(files["etc/extras/all_events.json.xz"]) == events_json()

    @pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1" + "0" * 60, "-" + "9" * 60, "-0.000", "3."])
    def test_any_number_fits(self, number: str) -> None:
        known = find_event(f"Using default takeoff altitude: {number} m")
        assert known is not None
        assert len(known[1]) == 4

    @pytest.mark.parametrize("text", ["", "...", "Takeoff to ... meters above home", "Takeoff detected ", "takeoff"])
    def test_anything_else_is_none(self, text: str) -> None:
        assert find_event(text) is None


def said_in(tree: ast.AST) -> Iterator[list[str | None]]:
    """Texts of a program that end with a TAB, in pieces; None stands for a value."""
    inside = {part for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)} - {tree}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            pieces = [part.value if isinstance(part, ast.Constant) else None for part in node.values]
            if isinstance(pieces[-1], str) and pieces[-1].endswith("\t"):
                yield [piece if isinstance(piece, str) else None for piece in pieces]
        elif isinstance(node, ast.Constant) and node not in inside:
            text = node.value
            if isinstance(text, str) and text.endswith("\t") and text.strip():
                yield [text]


# What a text that is put together says where its program has a value that is no number.
WORDS = {
    "commander.py": {
        "Arming denied: ": ["throttle above center", "throttle not in safe position"],
        "Switching to ": list(MODE_NAMES.values()),
    },
    "flight_commands.py": {"": ["Unsupported main mode", "Unsupported auto mode", "Unsupported base mode"]},
    "mission.py": {
        "No valid mission available, ": ["refusing takeoff", "loitering"],
        "Mission finished, ": ["landed", "loitering"],
    },
    "mission_protocol.py": {"IGN MISSION_ITEM: ": ["No transfer", "Busy"]},
}
PASSED_ON = {"mission.py", "return_home.py", "offboard.py"}
"""Here a text comes from elsewhere in the file before it gets its TAB; below are tests of their own."""


def texts_of(path: Path, pieces: list[str | None]) -> list[str]:
    """Whole texts with sample values."""
    words = WORDS.get(path.name, {}).get(pieces[0] or "", ["12.5"]) if None in pieces else [""]
    return ["".join(word if piece is None else piece for piece in pieces) for word in words]


def test_every_text_with_a_tab_is_an_event() -> None:
    seen: dict[str, int] = {}
    for path in sorted([*(ROOT / "sitl").glob("*.py"), *(ROOT / "bridge").glob("*.py")]):
        for pieces in said_in(ast.parse(path.read_text(encoding="utf-8"))):
            if path.name in PASSED_ON:
                continue
            for text in texts_of(path, pieces):
                assert find_event(text[:-1]) is not None, f"{path.name} says {text!r}, which is no event"
                seen[path.name] = seen.get(path.name, 0) + 1
    assert sum(seen.values()) > 60
    assert min(seen[name] for name in ("commander.py", "landing_watch.py", "mission_protocol.py")) >= 3


def said_with(path: Path, function: str) -> Iterator[list[str | None]]:
    """What a file's own function for texts is called with, in pieces as above."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == function:
            text = node.args[-1]
            if isinstance(text, ast.JoinedStr):
                yield [str(part.value) if isinstance(part, ast.Constant) else None for part in text.values]
            else:
                assert isinstance(text, ast.Constant), ast.unparse(node)
                yield [str(text.value)]


@pytest.mark.parametrize("name", ["mission.py", "return_home.py"])
def test_texts_that_get_their_tab_later_are_events_too(name: str) -> None:
    path = ROOT / "sitl" / name
    texts = [text for pieces in said_with(path, "_say") for text in texts_of(path, pieces)]
    assert len(texts) >= 3
    for text in texts:
        assert find_event(text) is not None, f"{name} says {text!r}, which is no event"


@pytest.mark.parametrize("name", ["SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"])
@pytest.mark.parametrize("problem", ["invalid", "coordinate frame 0 unsupported", "coordinate frame 255 unsupported"])
def test_refused_set_points_are_events(name: str, problem: str) -> None:
    assert find_event(f"{name} {problem}") is not None
