"""Frames that pass through a vehicle from one of its links to the others.

    forwarder = Forwarder(links, system_id=1, component_id=1, lost=server.peer_lost)
    forwarder.route(link, message, now_us)          # for every message received

So a program on one link and a ground station on another see and reach each other, as behind a PX4 with `-f` on both
links (`Mavlink::forward_message`, and the routing rules of the MAVLink guide):

- what is for this component alone goes no further;
- what is for everybody goes to all other links, what is for one system or component to those where it was heard;
- nothing goes back to the link it came from, and a frame goes on byte for byte, its signature included;
- SETUP_SIGNING is never passed on: the key in it is meant for one link.

A loop of links dies out: frames that carry our own address as their sender have been round already, and a frame that
was passed on a moment ago is not passed on again. What one link is given is bounded; the rest is dropped and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from bridge.errors import LinkClosed, PeerLost
from bridge.link import Link
from bridge.messages import Message

ADDRESSES_KEPT = 128
"""Senders remembered for each link; the one silent for longest is forgotten first."""

BYTES_PER_S = 4_000_000
"""Most that is passed on to one link, per second of vehicle time: the budget of a PX4 simulator's links (-r)."""

BURST_BYTES = 65_536
"""Most that is passed on to one link at once."""

REPEAT_US = 1_000_000
"""The same bytes again within this long, in vehicle time, have come round in a loop."""

FRAMES_KEPT = 512

_NEVER_FORWARDED = "SETUP_SIGNING"


class Port(Protocol):
    """What is needed of a link; `bridge.vehicle_server.ServerLink` is one."""

    link: Link
    link_id: int
    resting_until_us: int


class Forwarder:
    """Passes frames on between the links of one vehicle.

    Args:
        links: the vehicle's links.
        system_id: the vehicle's.
        component_id: the vehicle's.
        lost: called with a link whose peer turns out to be gone while something is passed on to it.

    Attributes:
        forwarded: frames passed on, once for each link they went to.
        refused: frames that were not: they came round in a loop, or a link had its fill.
    """

    def __init__(
        self, links: Sequence[Port], *, system_id: int, component_id: int, lost: Callable[[Port], object]
    ) -> None:
        self.forwarded = 0
        self.refused = 0
        self._sysid, self._compid = system_id, component_id
        self._lost = lost
        self._ways = {link.link_id: _Way(link) for link in links}
        self._others = {
            link_id: tuple(way for other, way in self._ways.items() if other != link_id) for link_id in self._ways
        }
        self._recent: dict[bytes, int] = {}

    def route(self, link: Port, msg: Message, now_us: int) -> None:
        """Pass a message on to whom it concerns, and remember that its sender is to be found on this link.

        Args:
            link: where it came in.
            msg: the message.
            now_us: vehicle time.
        """
        sysid, compid = msg.sysid, msg.compid
        if sysid == self._sysid and compid == self._compid:
            self.refused += 1
            return
        self._ways[link.link_id].heard(sysid, compid)
        system = msg.get("target_system", 0)
        component = msg.get("target_component", 0)
        if (system == self._sysid and component == self._compid) or msg.name == _NEVER_FORWARDED:
            return
        ways = [way for way in self._others[link.link_id] if way.concerns(system, component)]
        if not ways:
            return
        frame = msg.raw_frame
        if self._came_round(frame, now_us):
            self.refused += 1
            return
        for way in ways:
            if now_us < way.link.resting_until_us:
                continue
            if not way.has_room(len(frame), now_us):
                self.refused += 1
                continue
            try:
                way.link.link.send(frame)
            except (PeerLost, LinkClosed):
                self._lost(way.link)
            else:
                self.forwarded += 1

    def forget(self, link_id: int) -> None:
        """Forget who was heard on a link: its peer is gone."""
        self._ways[link_id].addresses.clear()

    def _came_round(self, frame: bytes, now_us: int) -> bool:
        """Return whether these bytes were passed on a moment ago; they count as passed on now."""
        recent = self._recent
        if now_us - recent.get(frame, -REPEAT_US) < REPEAT_US:
            return True
        recent.pop(frame, None)
        if len(recent) >= FRAMES_KEPT:
            del recent[next(iter(recent))]
        recent[frame] = now_us
        return False


class _Way:
    """What is known about one link: who is there, and how much it may still be given."""

    def __init__(self, link: Port) -> None:
        self.link = link
        self.addresses: dict[int, None] = {}
        self._room = BURST_BYTES
        self._filled_us = 0

    def heard(self, sysid: int, compid: int) -> None:
        """Note a sender: as itself, and as its system."""
        addresses = self.addresses
        for address in (sysid << 8 | compid, sysid << 8):
            if address in addresses:
                del addresses[address]  # to the end: heard last
            elif len(addresses) >= 2 * ADDRESSES_KEPT:
                del addresses[next(iter(addresses))]
            addresses[address] = None

    def concerns(self, sysid: int, compid: int) -> bool:
        """Return whether a message for this target is to be given to this link; 0 is everybody."""
        return sysid == 0 or (sysid << 8 | compid) in self.addresses

    def has_room(self, size: int, now_us: int) -> bool:
        """Return whether the link takes `size` more bytes now, and take them off its budget."""
        room = self._room + (now_us - self._filled_us) * BYTES_PER_S // 1_000_000
        self._filled_us = now_us
        self._room = min(BURST_BYTES, room)
        if self._room < size:
            return False
        self._room -= size
        return True
