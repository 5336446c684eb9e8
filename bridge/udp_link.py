"""UDP: one datagram is one message in the air; nobody ever says goodbye."""

from __future__ import annotations

import errno
import ipaddress
import socket
from typing import Any

from bridge.errors import LinkClosed, LinkUrlError, PortBusy
from bridge.link import Link
from bridge.socket_wait import wait_for

_LARGEST = 4_096
"""Longest datagram that is read whole, bytes; nobody packs so many messages into one."""

_STRANGERS_AT_ONCE = 64

# (host, port) or, for IPv6, (host, port, flow, scope): the socket module's own shape.
Address = tuple[Any, ...]


class UdpLink(Link):
    """A UDP socket that is either listening or speaking to a fixed address.

    - `listen`: answers the peer that spoke last. A ground station that comes back from another port is
      answered there at once; two of them at the same time would take turns, so give each a link.
    - `to`: speaks to one address from the first moment. With a local port it does as PX4 does: others may
      talk to that port and the latest of them is answered too, in addition to the fixed address, so neither a
      ground station that listens on the remote port nor a script that calls the local one waits in vain.
      Where other computers can reach that port, the first of them to speak is the one that is heard and
      answered from then on, as on a PX4; datagrams from any other computer are ignored and counted in
      `strangers`.

    A peer that does not exist costs nothing but `dropped` (on loopback the system reports it, elsewhere it
    cannot).
    """

    def __init__(self, name: str, sock: socket.socket, remote: Address | None, *, open_port: bool) -> None:
        super().__init__(name)
        sock.setblocking(False)
        self._socket: socket.socket | None = sock
        self._remote = remote
        self._open_port = open_port
        self._own_host: str = sock.getsockname()[0]
        if open_port and not _is_loopback(self._own_host):
            self.exposed = self._own_host, int(sock.getsockname()[1])
        self._guest: Address | None = None
        self._outsider: Address | None = None
        self._peers: tuple[Address, ...] = () if remote is None else (remote,)

    @classmethod
    def listen(cls, host: str, port: int) -> UdpLink:
        """Bind `host:port` and wait to be spoken to; port 0 takes a free one (see `port`).

        Raises:
            PortBusy: another program holds the port.
            LinkUrlError: the host is not one of this computer's.
        """
        sock, _ = _bound("udpin", host, port)
        return cls(f"udpin://{host}:{sock.getsockname()[1]}", sock, None, open_port=True)

    @classmethod
    def to(cls, host: str, port: int, *, local_port: int | None = None, bind_host: str | None = None) -> UdpLink:
        """Speak to `host:port`, from `local_port` if given.

        Args:
            host: the remote address or name.
            port: the remote port.
            local_port: ours; None for any.
            bind_host: the address of this computer that `local_port` is opened on. None is the loopback for a
                remote address on the loopback, every address for others.

        Raises:
            PortBusy: another program holds the local port.
            LinkUrlError: the host cannot be found, or `bind_host` is not an address of this computer.
        """
        url = f"udpout://{host}:{port}"
        family, remote = resolve(url, host, port, socket.SOCK_DGRAM)
        if local_port is None:
            sock = socket.socket(family, socket.SOCK_DGRAM)
            if _is_loopback(remote[0]):
                # else the first datagram would open a port of every address, though only answers are read there
                bind(url, sock, (remote[0], 0))
            return cls(url, sock, remote, open_port=False)
        url = f"{url}?local={local_port}"
        if bind_host is not None:
            own = bind_host
            url = f"{url}&bind={bind_host}"
            if (ipaddress.ip_address(own).version == 6) != (family == socket.AF_INET6):
                raise LinkUrlError(url, f"{own} cannot speak to {remote[0]}", "Give both as IPv4 or both as IPv6")
        elif _is_loopback(remote[0]):
            # A vehicle that speaks to this computer only is reachable from this computer only.
            own = remote[0]
        else:
            own = "::" if family == socket.AF_INET6 else "0.0.0.0"
        sock, _ = _bound("udpout", own, local_port)
        return cls(url, sock, remote, open_port=True)

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._open().getsockname()[1])

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._open().fileno()

    def send(self, data: bytes) -> None:
        """Send one datagram to the remote address and to the guests, if there are any."""
        sock = self._open()
        if not self._peers:
            self.dropped += 1
        for peer in self._peers:
            try:
                sock.sendto(data, peer)
            except OSError as error:
                self._count(error)

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        """Return the next datagram from anybody who may speak here."""
        sock = self._open()
        if timeout_s > 0.0:
            wait_for(sock, timeout_s)
        for _ in range(_STRANGERS_AT_ONCE):
            try:
                data, sender = sock.recvfrom(_LARGEST)
            except BlockingIOError:
                return None
            except OSError as error:
                self._count(error)
                return None
            # nobody can answer port 0: it is forged
            if sender[1] and (sender in self._peers or (self._open_port and self._admits(sender))):
                return data
            self.strangers += 1
        return None

    def close(self) -> None:
        """Release the port."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _open(self) -> socket.socket:
        if self._socket is None:
            raise LinkClosed(self.name)
        return self._socket

    def _admits(self, sender: Address) -> bool:
        """Return whether somebody new may speak here, and answer there from now on."""
        if self.exposed is None or self._remote is None or _is_loopback(sender[0]):
            self._guest = sender
        elif sender[0] == self._own_host and sender[1] == self._remote[1] and _is_loopback(self._remote[0]):
            # A ground station on this computer, called at its loopback address, answers our other address.
            return True
        elif self._outsider is None or self._outsider[0] == sender[0]:
            self._outsider = sender
        else:
            return False
        everybody = (self._remote, self._guest, self._outsider)
        self._peers = tuple(peer for peer in everybody if peer is not None)
        return True

    def _count(self, error: OSError) -> None:
        """Count what UDP reports about a datagram that went nowhere; anything else is a bug and goes up."""
        if error.errno not in _NOBODY_THERE:
            raise error
        self.dropped += 1


_NOBODY_THERE = {
    errno.ECONNREFUSED,
    errno.ECONNRESET,
    errno.EHOSTUNREACH,
    errno.ENETUNREACH,
    errno.EHOSTDOWN,
    errno.ENETDOWN,
    errno.EAGAIN,
    errno.ENOBUFS,
    errno.EPERM,  # a firewall's answer to sendto
    errno.EACCES,
    errno.EINVAL,  # an address that nobody can have
    errno.EADDRNOTAVAIL,  # an interface that has gone, or one from which the loopback cannot be reached
}


def _is_loopback(host: str) -> bool:
    return ipaddress.ip_address(host.partition("%")[0]).is_loopback


def resolve(url: str, host: str, port: int, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Address]:
    """Return the address a host name stands for, IPv4 if it has both: ground stations listen there.

    Raises:
        LinkUrlError: no such host.
    """
    try:
        found = socket.getaddrinfo(host, port, type=kind)
    except (OSError, UnicodeError) as error:
        raise LinkUrlError(url, f"host {host!r} cannot be found ({error})", "Check its spelling") from None
    family, _, _, _, address = min(found, key=lambda one: one[0] != socket.AF_INET)
    return family, address


def bind(url: str, sock: socket.socket, address: Address) -> None:
    """Bind a socket, or close it and say why that is not possible.

    Raises:
        PortBusy: another program holds the port.
        LinkUrlError: not an address of this computer, or not allowed.
    """
    try:
        sock.bind(address)
    except OSError as error:
        sock.close()
        host, port = str(address[0]), int(address[1])
        if error.errno == errno.EADDRINUSE:
            raise PortBusy(host, port) from None
        if error.errno in (errno.EACCES, errno.EPERM):
            remedy = "Choose a port from 1024 up"
        else:
            remedy = f"Listen on an address of this computer, 127.0.0.1 or 0.0.0.0 ({error.strerror})"
        raise LinkUrlError(url, f"cannot listen on {host}:{port}", remedy) from None


def _bound(scheme: str, host: str, port: int) -> tuple[socket.socket, Address]:
    url = f"{scheme}://{host}:{port}"
    family, address = resolve(url, host, port, socket.SOCK_DGRAM)
    sock = socket.socket(family, socket.SOCK_DGRAM)
    bind(url, sock, address)
    return sock, address
