"""Links: bytes to one peer and back, nothing about their meaning.

`open_link` turns an address into a link, written as MAVSDK writes it:

    udpin://127.0.0.1:14550                 listen; answer whoever spoke last
    udpout://127.0.0.1:14550                speak to this address
    udpout://127.0.0.1:14550?local=18570    ... from this local port, as PX4 does
    udpout://127.0.0.1:14550?local=18570&bind=0.0.0.0   ... and other computers may speak to that port
    tcpin://127.0.0.1:4560                  listen; one peer at a time
    tcpout://127.0.0.1:4560                 connect
    serial:///dev/ttyACM0:921600            a serial port

An empty host is the loopback; IPv6 hosts stand in brackets. `memory://` has no open end: `MemoryLink.pair()`.
"""

from __future__ import annotations

import ipaddress
import math
from abc import ABC, abstractmethod
from collections import deque
from types import TracebackType
from typing import ClassVar, Self
from urllib.parse import SplitResult, parse_qsl, urlsplit

from numpy.random import Generator

from bridge.errors import LinkClosed, LinkUrlError, PeerLost
from sitl.errors import UsageError

LOOPBACK = "127.0.0.1"
BAUD = 921_600


class Link(ABC):
    """Bytes to one peer and back.

    Every link keeps to the same rules, and one contract test holds all of them to it:

    - `send` hands the bytes over or counts them in `dropped`; it never waits for a peer to appear.
    - `recv(timeout_s)` returns as soon as there is something, None after `timeout_s` at the latest; 0 never
      waits.
    - A peer that goes away raises PeerLost: from `recv` once all it had sent has been read, from `send` at
      once. UDP cannot see that and stays silent.
    - `close` may be repeated; using a closed link raises LinkClosed.

    Attributes:
        name: the address, for messages.
        datagram: True when one `recv` is one `send` of the peer, so that frames never straddle two of them.
        dropped: how many `send`s reached nobody.
        strangers: datagrams ignored because their sender may not speak here.
        exposed: the local (host, port) at which other computers can speak to it, None if none can.
    """

    datagram: ClassVar[bool] = True

    def __init__(self, name: str) -> None:
        self.name = name
        self.dropped = 0
        self.strangers = 0
        self.exposed: tuple[str, int] | None = None

    def fileno(self) -> int:
        """Return the one file descriptor that becomes readable when `recv` has something, -1 if there is none."""
        return -1

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send bytes to the peer.

        Raises:
            PeerLost: the peer has gone (never on UDP).
            LinkClosed: after `close`.
        """

    @abstractmethod
    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        """Return one datagram, or one chunk of a stream; None if nothing came within `timeout_s` seconds.

        Raises:
            PeerLost: the peer has gone and all it sent has been read (never on UDP).
            LinkClosed: after `close`.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the port; may be repeated."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}>"


class MemoryLink(Link):
    """One end of a wire inside this process; made in pairs.

    Nothing is copied and nothing waits: with both ends in one thread nobody could send while `recv` waited,
    so `timeout_s` is ignored. Let vehicle time pass (`SimClock.advance`) and ask again.
    """

    def __init__(self, name: str, limit: int) -> None:
        super().__init__(name)
        self._limit = limit
        self._inbox: deque[bytes] = deque()
        self._peer: MemoryLink | None = None
        self._closed = False

    @classmethod
    def pair(cls, limit: int = 10_000) -> tuple[MemoryLink, MemoryLink]:
        """Return the two ends of a wire.

        Args:
            limit: datagrams one end holds unread; further ones are dropped, as a full socket buffer does.
        """
        first, second = cls("memory://1", limit), cls("memory://2", limit)
        first._peer, second._peer = second, first
        return first, second

    def send(self, data: bytes) -> None:
        """Put the datagram into the other end's inbox."""
        peer = self._peer
        if peer is None:
            raise self._gone()
        if len(peer._inbox) >= peer._limit:
            self.dropped += 1
        else:
            peer._inbox.append(data)

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        """Return the oldest unread datagram; None at once if there is none."""
        if self._inbox:
            return self._inbox.popleft()
        if self._peer is None:
            raise self._gone()
        return None

    def close(self) -> None:
        """Take this end off the wire; what it sent before can still be read at the other."""
        if self._peer is not None:
            self._peer._peer = None
            self._peer = None
        self._inbox.clear()
        self._closed = True

    def _gone(self) -> LinkClosed | PeerLost:
        return LinkClosed(self.name) if self._closed else PeerLost(self.name, "the other end was closed")


class LossyLink(Link):
    """A link that damages what passes, by seed: the same seed and traffic give the same damage.

    The two directions draw from generators of their own, so traffic one way never changes the other way's
    fate.

    Args:
        link: the link underneath; it should keep datagrams whole.
        rng: the only source of chance.
        loss: share of datagrams that vanish, 0 to 1.
        duplicate: share that arrive twice.
        reorder: share held back until the next datagram has passed.
        corrupt: share with one byte changed.

    Raises:
        UsageError: a share outside 0 to 1.
    """

    def __init__(
        self,
        link: Link,
        rng: Generator,
        *,
        loss: float = 0.0,
        duplicate: float = 0.0,
        reorder: float = 0.0,
        corrupt: float = 0.0,
    ) -> None:
        shares = {"loss": loss, "duplicate": duplicate, "reorder": reorder, "corrupt": corrupt}
        for what, share in shares.items():
            if not 0.0 <= share <= 1.0:
                raise UsageError(f"{what} = {share!r}: a share of the datagrams is between 0 and 1")
        super().__init__(f"{link.name} (lossy)")
        self._link = link
        outward, inward = rng.spawn(2)
        self._out = Damage(outward, **shares)
        self._in = Damage(inward, **shares)
        self._arrived: deque[bytes] = deque()

    @property
    def damaged(self) -> int:
        """Datagrams lost, doubled, held back or changed so far, both directions together."""
        return self._out.count + self._in.count

    def send(self, data: bytes) -> None:
        """Send what the damage leaves of it, and what it had held back."""
        for datagram in self._out.passing(data):
            self._link.send(datagram)

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        """Return the next datagram that survives; a held one comes out when nothing else does."""
        while not self._arrived:
            data = self._link.recv(timeout_s)
            if data is None:
                return self._in.release()
            self._arrived.extend(self._in.passing(data))
            timeout_s = 0.0
        return self._arrived.popleft()

    def close(self) -> None:
        """Close the link underneath; what is held back is lost."""
        self._link.close()


class Damage:
    """What happens to datagrams in one direction.

    Args:
        rng: the only source of chance. loss, duplicate, reorder, corrupt: shares, as for `LossyLink`.

    Attributes:
        count: datagrams that something happened to.
    """

    def __init__(self, rng: Generator, *, loss: float, duplicate: float, reorder: float, corrupt: float) -> None:
        self._rng = rng
        self._loss, self._duplicate, self._reorder, self._corrupt = loss, duplicate, reorder, corrupt
        self._held: bytes | None = None
        self.count = 0

    def passing(self, data: bytes) -> list[bytes]:
        """What comes out of a datagram, and what had been held back."""
        # Four draws whatever happens, so that one share can be changed without reshuffling the others.
        lost, doubled, late, changed = self._rng.random(4) < (
            self._loss,
            self._duplicate,
            self._reorder,
            self._corrupt,
        )
        self.count += bool(lost or doubled or late or changed)
        if lost:
            return []
        if changed and data:
            data = self._change(data)
        if late and self._held is None:
            self._held = data
            return []
        passing = [data, data] if doubled else [data]
        held = self.release()
        return passing if held is None else [*passing, held]

    def release(self) -> bytes | None:
        """The datagram that is held back, if one is; it is not any more."""
        held, self._held = self._held, None
        return held

    def _change(self, data: bytes) -> bytes:
        at = int(self._rng.integers(len(data)))
        damaged = bytearray(data)
        damaged[at] ^= int(self._rng.integers(1, 256))
        return bytes(damaged)


def open_link(url: str, *, connect_s: float = 3.0) -> Link:
    """Open the link an address stands for.

    Args:
        url: see the top of this module.
        connect_s: how long a tcpout link keeps trying, in seconds.

    Raises:
        LinkUrlError: the address cannot be read, or names a host or device that does not exist.
        PortBusy: another program holds the local port.
        PeerSilent: nobody accepted a tcpout connection.
    """
    # The backends are imported here: a memory flight needs no socket, and only a board needs pyserial.
    parts = _split(url)
    if parts.scheme == "udpin":
        from bridge.udp_link import UdpLink

        return UdpLink.listen(*_address(url, parts))
    if parts.scheme == "udpout":
        from bridge.udp_link import UdpLink

        return UdpLink.to(*_address(url, parts), local_port=_local_port(url, parts), bind_host=_bind_host(url, parts))
    if parts.scheme == "tcpin":
        from bridge.tcp_link import TcpLink

        return TcpLink.listen(*_address(url, parts))
    if parts.scheme == "tcpout":
        from bridge.tcp_link import TcpLink

        return TcpLink.connect(*_address(url, parts), limit_s=connect_s)
    if parts.scheme == "serial":
        from bridge.serial_link import SerialLink

        return SerialLink(*_device(url, parts))
    if parts.scheme == "memory":
        raise LinkUrlError(url, "a memory link has no end to open", "froude fly makes its own; leave --connect out")
    raise LinkUrlError(
        url,
        f"unknown kind {parts.scheme!r}" if parts.scheme else "no kind of link in front of '://'",
        "Write udpin://, udpout://, tcpin://, tcpout:// with host:port, or serial:///dev/ttyX:baud",
    )


def _split(url: str) -> SplitResult:
    try:
        return urlsplit(url)
    except ValueError as error:
        raise LinkUrlError(url, str(error), "An IPv6 host stands in brackets: udpin://[::1]:14550") from None


def _address(url: str, parts: SplitResult) -> tuple[str, int]:
    remedy = f"Write {parts.scheme}://host:port, for example {parts.scheme}://{LOOPBACK}:14550"
    try:
        port = parts.port
    except ValueError:
        raise LinkUrlError(url, "the port is not a number from 0 to 65535", remedy) from None
    if port is None:
        raise LinkUrlError(url, "no port in it", remedy)
    if parts.path not in ("", "/") or parts.username is not None:
        raise LinkUrlError(url, "there is more in it than host and port", remedy)
    options = {key for key, _ in parse_qsl(parts.query, keep_blank_values=True)}
    for option in sorted(options - {"local", "bind"} if parts.scheme == "udpout" else options):
        raise LinkUrlError(url, f"unknown option {option!r}", "Only udpout takes any: ?local=port&bind=address")
    return parts.hostname or LOOPBACK, port


def _local_port(url: str, parts: SplitResult) -> int | None:
    text = dict(parse_qsl(parts.query, keep_blank_values=True)).get("local")
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and 0 < int(text) < 65536):
        raise LinkUrlError(url, f"local={text!r} is not a port", "Write ?local= and a number from 1 to 65535")
    return int(text)


def _bind_host(url: str, parts: SplitResult) -> str | None:
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    text = options.get("bind")
    if text is None:
        return None
    if "local" not in options:
        raise LinkUrlError(url, "bind without local", "Write ?local=port&bind=address")
    try:
        ipaddress.ip_address(text)
    except ValueError:
        raise LinkUrlError(url, f"bind={text!r} is not an address", "Write &bind=0.0.0.0, or an address") from None
    return text


def _device(url: str, parts: SplitResult) -> tuple[str, int]:
    device, colon, baud = (parts.netloc + parts.path).rpartition(":")
    if not colon:
        device, baud = baud, str(BAUD)
    if not device or not (baud.isascii() and baud.isdigit() and 0 < int(baud) < math.inf):
        raise LinkUrlError(url, "no device and baud rate in it", f"Write serial:///dev/ttyACM0:{BAUD}")
    return device, int(baud)
