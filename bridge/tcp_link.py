"""TCP: a stream of bytes to one peer, and word when it goes."""

from __future__ import annotations

import ipaddress
import socket
import struct

from bridge.clock import WallClock
from bridge.errors import LinkClosed, PeerLost, PeerSilent
from bridge.link import Link
from bridge.socket_wait import wait_for
from bridge.udp_link import bind, resolve

_CHUNK = 8_192
_STUCK_S = 1.0
_RETRY_US = 50_000

_HELD_BYTES = 65_536
"""What a peer has not read is held back up to this; a larger piece is waited for."""

_NO_MAVLINK = (b"GET ", b"POST", b"PUT ", b"HEAD", b"OPTI", b"PATC", b"DELE", b"CONN", b"TRAC", b"\x16\x03")
"""How a browser begins, in the open and encrypted: any page may make it call a port of this computer, with bytes of the
page's choice behind such a beginning."""

_KERNEL_WAITS_S = 0.02
"""Time limits from here on are left to the kernel, whose clock is too coarse for shorter ones: one call less for every
answer of an autopilot in lockstep."""


class TcpLink(Link):
    """A TCP connection, made by us or by the peer.

    - `listen`: takes one peer at a time, the next one when that one has gone. PeerLost is raised once for
      each; the link itself lives on and a further `recv` waits for the next peer. Without a peer, sends are
      dropped.
    - `connect`: PeerLost is final; every further use repeats it.

    A peer that does not read holds nobody up: the rest of a frame waits for it, further ones are dropped.
    """

    datagram = False

    def __init__(self, name: str, *, listener: socket.socket | None, peer: socket.socket | None) -> None:
        super().__init__(name)
        self._listener = listener
        self._peer = peer
        self._closed = False
        self._lost: str | None = None
        self._clock = WallClock()
        self._limit_s = 0.0
        self._unsent = b""
        self._stuck_us: int | None = None  # wall clock since when it takes nothing
        self._unheard = listener is not None
        if listener is not None:
            listener.setblocking(False)
        if peer is not None:
            _at_once(peer)

    @classmethod
    def listen(cls, host: str, port: int) -> TcpLink:
        """Wait for peers on `host:port`; port 0 takes a free one (see `port`).

        Raises:
            PortBusy: another program holds the port.
            LinkUrlError: the host is not one of this computer's.
        """
        url = f"tcpin://{host}:{port}"
        family, address = resolve(url, host, port, socket.SOCK_STREAM)
        sock = socket.socket(family, socket.SOCK_STREAM)
        # Else the port stays busy for a minute after each run.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bind(url, sock, address)
        sock.listen(1)
        link = cls(f"tcpin://{host}:{sock.getsockname()[1]}", listener=sock, peer=None)
        own = sock.getsockname()
        if not ipaddress.ip_address(own[0].partition("%")[0]).is_loopback:
            link.exposed = own[0], int(own[1])
        return link

    @classmethod
    def connect(cls, host: str, port: int, *, limit_s: float = 3.0) -> TcpLink:
        """Connect to `host:port`, trying again until `limit_s` has passed: the peer may still be starting.

        Raises:
            PeerSilent: nobody accepted in time.
            LinkUrlError: the host cannot be found.
        """
        url = f"tcpout://{host}:{port}"
        family, address = resolve(url, host, port, socket.SOCK_STREAM)
        clock = WallClock()
        deadline_us = clock.now_us() + int(limit_s * 1e6)
        while True:
            sock = socket.socket(family, socket.SOCK_STREAM)
            sock.settimeout(max(0.001, (deadline_us - clock.now_us()) * 1e-6))
            try:
                sock.connect(address)
            except OSError as error:
                sock.close()
                if clock.now_us() + _RETRY_US >= deadline_us:
                    raise PeerSilent(
                        url, limit_s, "a listening program", f"Is it running, on that port? ({error})"
                    ) from None
                clock.sleep_until_us(clock.now_us() + _RETRY_US)
            else:
                return cls(url, listener=None, peer=sock)

    @property
    def port(self) -> int:
        """The local port."""
        sock = self._listener or self._peer
        if self._closed or sock is None:
            raise LinkClosed(self.name)
        return int(sock.getsockname()[1])

    @property
    def connected(self) -> bool:
        """Whether there is a peer right now, as far as is known."""
        return self._peer is not None

    def send(self, data: bytes) -> None:
        """Send all the bytes, or none and count them; a peer that takes none for a second is taken for lost."""
        peer = self._present(0.0)
        if peer is None or (self._unsent and not self._push(peer)):
            self.dropped += 1
            return
        self._unsent = data
        self._push(peer)

    def _push(self, peer: socket.socket) -> bool:
        """Hand over what is held back; whether that was all."""
        view = memoryview(self._unsent)
        while view:
            try:
                view = view[peer.send(view, socket.MSG_DONTWAIT) :]
                self._stuck_us = None
            except BlockingIOError:
                if len(view) <= _HELD_BYTES:
                    break
                if not wait_for(peer, _STUCK_S, to_write=True):
                    raise self._parted(f"it read nothing for {_STUCK_S:g} s") from None
            except OSError as error:
                raise self._parted(error.strerror or str(error)) from None
        self._unsent = bytes(view)
        if not view:
            return True
        now_us = self._clock.now_us()
        if self._stuck_us is None:
            self._stuck_us = now_us
        elif now_us - self._stuck_us > _STUCK_S * 1e6:
            raise self._parted(f"it read nothing for {_STUCK_S:g} s")
        return False

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        """Return what has arrived, taking the next peer if there is none."""
        peer = self._present(timeout_s)
        if peer is None:
            return None
        if self._unsent:
            self._push(peer)
        try:
            if timeout_s >= _KERNEL_WAITS_S:
                if timeout_s != self._limit_s:
                    self._limit(peer, timeout_s)
                data = peer.recv(_CHUNK)
            elif timeout_s > 0.0 and not wait_for(peer, timeout_s):
                return None
            else:
                data = peer.recv(_CHUNK, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None
        except OSError as error:
            raise self._parted(error.strerror or str(error)) from None
        if not data:
            raise self._parted("it closed the connection")
        if self._unheard:
            self._unheard = False
            if data.startswith(_NO_MAVLINK):
                raise self._parted("it spoke HTTP, as a browser does, and no MAVLink")
        return data

    def _limit(self, peer: socket.socket, timeout_s: float) -> None:
        """Let the kernel end a reception that takes longer."""
        self._limit_s = timeout_s
        whole_s = int(timeout_s)
        peer.setsockopt(
            socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", whole_s, round((timeout_s - whole_s) * 1e6))
        )

    def close(self) -> None:
        """Release the port and the peer."""
        for sock in (self._peer, self._listener):
            if sock is not None:
                sock.close()
        self._peer = self._listener = None
        self._closed = True

    def _present(self, timeout_s: float) -> socket.socket | None:
        """Return the peer, waiting for one to connect; None if there is none yet."""
        if self._peer is not None:
            return self._peer
        if self._closed:
            raise LinkClosed(self.name)
        if self._listener is None:
            raise PeerLost(self.name, self._lost or "it closed the connection")
        if timeout_s > 0.0:
            wait_for(self._listener, timeout_s)
        try:
            peer, _ = self._listener.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return None
        _at_once(peer)
        self._peer, self._limit_s = peer, 0.0
        self._unsent, self._stuck_us, self._unheard = b"", None, True
        return peer

    def turn_away(self) -> bool:
        """Close the connections of those who came while there is a peer; whether there were any."""
        if self._listener is None or self._peer is None:
            return False
        anybody = False
        while True:
            try:
                other, _ = self._listener.accept()
            except OSError:
                return anybody
            other.close()
            anybody = True

    def turn_out(self) -> bool:
        """Close the connection of the peer, if there is another to come after it; whether it was closed."""
        if self._listener is None or self._peer is None:
            return False
        self._peer.close()
        self._peer = None
        return True

    def _parted(self, why: str) -> PeerLost:
        if self._peer is not None:
            self._peer.close()
            self._peer = None
        self._lost = why
        return PeerLost(self.name, why)


def refuse_others(link: Link) -> bool:
    """Turn away whoever else has connected to a listening link that has its peer; whether anybody had.

    Args:
        link: of any kind.
    """
    return isinstance(link, TcpLink) and link.turn_away()


def turn_out(link: Link) -> bool:
    """Turn the peer of a listening link away, so that another may come; whether it was.

    Args:
        link: of any kind.
    """
    return isinstance(link, TcpLink) and link.turn_out()


def _at_once(sock: socket.socket) -> None:
    sock.setblocking(True)
    # A control loop's frames must not wait in the kernel to be joined with later ones.
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
