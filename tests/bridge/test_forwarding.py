from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.connection import Connection, Message
from bridge.forwarding import ADDRESSES_KEPT, BURST_BYTES, BYTES_PER_S, FRAMES_KEPT, REPEAT_US, Forwarder
from bridge.link import MemoryLink

OWN = (1, 1)
GCS, SDK, CAMERA = (255, 190), (245, 191), (1, 100)


class Port:
    """One link of a vehicle, and what a peer reads at its other end."""

    def __init__(self, link_id: int, limit: int = 10_000) -> None:
        self.link, self.far = MemoryLink.pair(limit)
        self.link_id = link_id
        self.resting_until_us = 0

    def take(self) -> list[bytes]:
        return list(iter(self.far.recv, None))


class Vehicle:
    """A forwarder between links, in its own vehicle time."""

    def __init__(self, links: int = 2) -> None:
        self.ports = [Port(number) for number in range(links)]
        self.lost: list[int] = []
        self.forwarder = Forwarder(
            self.ports, system_id=OWN[0], component_id=OWN[1], lost=lambda port: self.lost.append(port.link_id)
        )
        self.senders: dict[tuple[int, int], Connection] = {}
        self.now_us = 0

    def hear(self, link: int, sender: tuple[int, int], name: str, **fields: Any) -> bytes:
        """Let a message come in on a link; returns its bytes."""
        connection = self.senders.setdefault(sender, Connection(*sender, datagram=True))
        frame = connection.encode(name, **fields)
        self.hear_frame(link, frame)
        return frame

    def hear_frame(self, link: int, frame: bytes) -> None:
        (message,) = Connection(9, 9, datagram=True).receive(frame)
        self.forwarder.route(self.ports[link], message, self.now_us)

    def meet(self) -> None:
        """Let everybody be heard: a ground station on link 0, a program on 1, a camera on 2 if there is one."""
        for link, sender in enumerate((GCS, SDK, CAMERA)[: len(self.ports)]):
            self.hear(link, sender, "HEARTBEAT", type=6)
        self.taken()

    def taken(self) -> list[list[bytes]]:
        return [port.take() for port in self.ports]


def test_what_is_for_everybody_goes_to_every_other_link_byte_for_byte() -> None:
    vehicle = Vehicle(3)
    frame = vehicle.hear(1, SDK, "HEARTBEAT", type=6, autopilot=8)
    assert vehicle.taken() == [[frame], [], [frame]]
    assert vehicle.forwarder.forwarded == 2


def test_a_ground_station_and_a_program_reach_each_other() -> None:
    vehicle = Vehicle(3)
    vehicle.meet()
    frame = vehicle.hear(0, GCS, "COMMAND_LONG", target_system=245, target_component=191, command=512)
    assert vehicle.taken() == [[], [frame], []]
    frame = vehicle.hear(1, SDK, "COMMAND_ACK", command=512, target_system=255, target_component=190)
    assert vehicle.taken() == [[frame], [], []]
    # component 0 is any of the system's
    frame = vehicle.hear(1, SDK, "PARAM_REQUEST_LIST", target_system=255, target_component=0)
    assert vehicle.taken() == [[frame], [], []]


@pytest.mark.parametrize(
    ("target", "goes_to"),
    [
        (OWN, []),  # for us alone
        ((1, 0), [2]),  # for every component of our system: the camera is one
        (CAMERA, [2]),
        ((1, 7), []),  # never heard
        ((77, 1), []),
        (GCS, []),  # back to where it came from
        ((0, 0), [1, 2]),
        ((0, 55), [1, 2]),
    ],
)
def test_targets(target: tuple[int, int], goes_to: list[int]) -> None:
    vehicle = Vehicle(3)
    vehicle.meet()
    vehicle.hear(0, GCS, "COMMAND_LONG", target_system=target[0], target_component=target[1], command=400)
    assert [link for link, frames in enumerate(vehicle.taken()) if frames] == goes_to
    assert vehicle.forwarder.refused == 0


def test_the_signature_goes_with_the_frame() -> None:
    vehicle = Vehicle()
    frame = signed(Connection(*SDK).encode("HEARTBEAT", type=6))
    vehicle.hear_frame(1, frame)
    assert vehicle.taken() == [[frame], []]


def signed(frame: bytes) -> bytes:
    """The frame as a signed one, with any old signature."""
    from bridge.framing import crc16
    from bridge.messages import BY_ID

    kind = BY_ID[frame[7] | frame[8] << 8 | frame[9] << 16]
    body = bytes([frame[1], 1]) + frame[3:-2]
    return frame[:1] + body + crc16(body + kind.crc_extra).to_bytes(2, "little") + bytes(range(13))


def test_keys_are_never_passed_on() -> None:
    vehicle = Vehicle(3)
    vehicle.meet()
    for target in (SDK, (0, 0), CAMERA):
        vehicle.hear(0, GCS, "SETUP_SIGNING", target_system=target[0], target_component=target[1], secret_key=b"k" * 32)
    assert vehicle.taken() == [[], [], []]


def test_our_own_messages_that_came_round_stop_here() -> None:
    vehicle = Vehicle()
    vehicle.meet()
    vehicle.hear(0, OWN, "HEARTBEAT", type=2)
    vehicle.hear(0, OWN, "COMMAND_LONG", target_system=245, target_component=191, command=400)
    assert vehicle.taken() == [[], []]
    assert vehicle.forwarder.refused == 2


def test_a_frame_that_comes_round_is_passed_on_once() -> None:
    vehicle = Vehicle()
    frame = vehicle.hear(0, GCS, "HEARTBEAT", type=6)
    for link in (1, 0, 1):
        vehicle.hear_frame(link, frame)
    assert vehicle.taken() == [[], [frame]]
    assert vehicle.forwarder.refused == 3
    vehicle.now_us += REPEAT_US
    vehicle.hear_frame(0, frame)
    assert vehicle.taken() == [[], [frame]]


def test_a_loop_of_two_vehicles_and_two_wires_dies_out() -> None:
    first, second = Vehicle(3), Vehicle(3)
    second.forwarder = Forwarder(second.ports, system_id=2, component_id=1, lost=second.lost.append)
    # Links 1 and 2 of both are joined; link 0 has a ground station each.
    frame = first.hear(0, GCS, "HEARTBEAT", type=6)
    passed = 0
    for _ in range(50):
        for one, other in ((first, second), (second, first)):
            for link in (1, 2):
                for data in one.ports[link].take():
                    passed += 1
                    other.hear_frame(link, data)
    assert passed <= 4
    assert second.ports[0].take() == [frame]
    assert first.ports[0].take() == []


def test_a_link_that_rests_or_has_lost_its_peer_does_not_hold_up_the_others() -> None:
    vehicle = Vehicle(4)
    vehicle.ports[1].resting_until_us = 5
    vehicle.ports[2].far.close()
    frame = vehicle.hear(0, GCS, "HEARTBEAT", type=6)
    assert [vehicle.ports[link].take() for link in (0, 1, 3)] == [[], [], [frame]]
    assert vehicle.lost == [2]


def test_who_is_forgotten_is_no_longer_sent_to() -> None:
    vehicle = Vehicle()
    vehicle.meet()
    vehicle.forwarder.forget(1)
    vehicle.hear(0, GCS, "COMMAND_LONG", target_system=245, target_component=191, command=512)
    assert vehicle.taken() == [[], []]


def test_a_flood_is_cut_to_the_budget_of_the_link() -> None:
    vehicle = Vehicle()
    size = 0
    for number in range(3000):
        size += len(vehicle.hear(0, GCS, "FILE_TRANSFER_PROTOCOL", payload=number.to_bytes(2, "little") + b"x" * 240))
    assert size > 10 * BURST_BYTES
    passed = sum(map(len, vehicle.ports[1].take()))
    assert BURST_BYTES - 300 < passed <= BURST_BYTES
    assert vehicle.forwarder.refused == 3000 - vehicle.forwarder.forwarded
    vehicle.now_us = 4000
    for number in range(100):
        vehicle.hear(0, GCS, "FILE_TRANSFER_PROTOCOL", payload=number.to_bytes(2, "little") + b"y" * 240)
    later = sum(map(len, vehicle.ports[1].take()))
    assert BYTES_PER_S * 4 // 1000 - 300 < later <= BYTES_PER_S * 4 // 1000 + 300


def test_a_peer_of_many_names_makes_no_memory_grow() -> None:
    vehicle = Vehicle()
    for sysid in range(2, 256):
        for compid in (1, 100, 200):
            vehicle.hear(0, (sysid, compid), "HEARTBEAT", type=6)
            vehicle.now_us += 4000
    kept = sum(len(way.addresses) for way in vehicle.forwarder._ways.values())
    assert kept <= 2 * ADDRESSES_KEPT
    assert len(vehicle.forwarder._recent) <= FRAMES_KEPT
    # who spoke last is still known
    vehicle.taken()
    vehicle.hear(1, SDK, "COMMAND_LONG", target_system=255, target_component=200, command=512)
    assert len(vehicle.ports[0].take()) == 1


ADDRESS = st.tuples(st.sampled_from([1, 2, 255, 245]), st.sampled_from([1, 100, 190]))
TARGET = st.tuples(st.sampled_from([0, 1, 2, 255, 245]), st.sampled_from([0, 1, 100, 190]))
EVENT = st.tuples(st.integers(0, 2), ADDRESS, TARGET, st.sampled_from(["COMMAND_LONG", "SETUP_SIGNING", "HEARTBEAT"]))


@given(st.lists(EVENT, max_size=40))
def test_the_rules_hold_whatever_comes(events: list[tuple[int, tuple[int, int], tuple[int, int], str]]) -> None:
    vehicle = Vehicle(3)
    seen: list[set[tuple[int, int]]] = [set(), set(), set()]
    for link, sender, target, name in events:
        fields = {} if name == "HEARTBEAT" else {"target_system": target[0], "target_component": target[1]}
        frame = vehicle.hear(link, sender, name, **fields)
        if sender != OWN:
            seen[link].add(sender)
        wanted = target if fields else (0, 0)

        def concerns(other: int, wanted: tuple[int, int] = wanted) -> bool:
            systems = {sysid for sysid, _ in seen[other]}
            return wanted[0] == 0 or wanted in seen[other] or (wanted[1] == 0 and wanted[0] in systems)

        passes = sender != OWN and wanted != OWN and name != "SETUP_SIGNING"
        for other, frames in enumerate(vehicle.taken()):
            assert frames == ([frame] if passes and other != link and concerns(other) else [])


def test_a_message_is_what_connection_gives() -> None:
    # The forwarder passes on raw_frame: whole, whatever else was in the datagram.
    one = Connection(*SDK).encode("HEARTBEAT", type=6)
    two = Connection(*SDK).encode("PING", time_usec=1)
    messages: list[Message] = Connection(1, 1, datagram=True).receive(b"noise" + one + two)
    assert [message.raw_frame for message in messages] == [one, two]
