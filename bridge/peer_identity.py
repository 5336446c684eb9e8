"""PeerIdentity: which vehicle is at the other end, so that two can be told from one another.

A board tells its silicon's number in AUTOPILOT_VERSION. Simulators, and a few boards without a number of their own,
tell the same text whichever of them it is; then link and system id are all there is to go by.
"""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from bridge.errors import CommandRefused, PeerSilent
from sitl.errors import LinkError

if TYPE_CHECKING:
    from bridge.client import Client

AUTOPILOT_VERSION: Final = 148
_TRIES: Final = 6
_ANSWER_S: Final = 0.5
_SMALLEST_UID: Final = 256  # a smaller one is a system id in disguise
_WRITTEN_BY_HAND: Final = re.compile(rb"froude|[A-Za-z0-9 ]{12}")
_LOCAL: Final = (None, "", "0.0.0.0", "127.0.0.1", "localhost", "::", "::1")


class Match(enum.Enum):
    """How sure it is that two identities are of one vehicle."""

    SAME = "same"
    POSSIBLE = "possible"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class PeerIdentity:
    """What a vehicle can be known by.

    Attributes:
        url: link it was met on. sysid: its MAVLink system.
        uid: AUTOPILOT_VERSION.uid, 0 if it does not tell. uid2: 18 bytes, empty if it does not tell.
    """

    url: str
    sysid: int
    uid: int = 0
    uid2: bytes = b""

    @property
    def unique(self) -> bytes:
        """The number that no other vehicle has; empty if none is known."""
        if any(self.uid2):
            return b"" if _WRITTEN_BY_HAND.search(self.uid2) else self.uid2
        return self.uid.to_bytes(8, "little") if self.uid >= _SMALLEST_UID else b""

    def match(self, other: PeerIdentity) -> Match:
        """How sure it is that another identity is of the same vehicle; a unique number decides, where both have one."""
        if self.unique and other.unique:
            return Match.SAME if self.unique == other.unique else Match.OTHER
        if self.sysid != other.sysid or (any(self.uid2) and any(other.uid2) and self.uid2 != other.uid2):
            return Match.OTHER
        return Match.SAME if _place(self.url) == _place(other.url) else Match.POSSIBLE

    def __str__(self) -> str:
        number = f", number {self.unique.hex()}" if self.unique else ""
        return f"system {self.sysid}{number} at {self.url}"


class OtherVehicle(LinkError):
    """Another vehicle than the one that was meant.

    Args:
        seen: who answers. wanted: who was meant. remedy: what to do next.
    """

    def __init__(self, seen: PeerIdentity, wanted: PeerIdentity, remedy: str) -> None:
        self.seen = seen
        self.wanted = wanted
        super().__init__(f"another vehicle answers: {seen}, and not {wanted}. {remedy}")


def ask_identity(client: Client, url: str) -> PeerIdentity:
    """Ask a connected vehicle who it is; one that does not say is known by link and system id.

    Args:
        client: connected. url: of its link.
    """
    known = [PeerIdentity(url, client.target_system)]

    def note(m: object) -> None:
        uid2 = bytes(m.uid2)  # type: ignore[attr-defined]
        known.append(replace(known[0], uid=m.uid, uid2=uid2 if any(uid2) else b""))  # type: ignore[attr-defined]

    client.subscribe("AUTOPILOT_VERSION", note)
    try:
        client.request(AUTOPILOT_VERSION, tries=_TRIES)
    except (CommandRefused, PeerSilent):
        return known[-1]
    client.wait_until(lambda: len(known) > 1, _ANSWER_S)
    return known[-1]


def _place(url: str) -> tuple[str, str, int | None]:
    """What of an address says where the vehicle is: `udpin://0.0.0.0:14540` and `udpin://:14540` are one place."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return url, "", None
    if parts.scheme == "serial":
        return "serial", parts.path.rpartition(":")[0] or parts.path, None
    host = parts.hostname
    return parts.scheme, "" if host in _LOCAL else str(host), port
