"""A UDP port that answers each sender at its own address: what a simulator for several comers and goers needs.

A `UdpLink` is a wire to one peer and answers who spoke last; here the caller decides whom to answer.
"""

from __future__ import annotations

import ipaddress
import socket
from types import TracebackType
from typing import Any, Self

from bridge.socket_wait import wait_for
from bridge.udp_link import bind, resolve

_LARGEST = 16_384
_AT_ONCE = 256

Address = tuple[Any, ...]


class DatagramPort:
    """One bound UDP socket.

    Args:
        url: the address as given, for messages. host, port: to listen on; port 0 takes a free one.

    Attributes:
        name: the address, for messages. port: the local port.
        exposed: other computers can speak to it.
        dropped: answers that reached nobody.

    Raises:
        PortBusy: another program holds the port. LinkUrlError: the host is not one of this computer's.
    """

    def __init__(self, url: str, host: str, port: int) -> None:
        family, address = resolve(url, host, port, socket.SOCK_DGRAM)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        bind(url, self._socket, address)
        self._socket.setblocking(False)
        own_host, self.port = self._socket.getsockname()[:2]
        self.name = f"{url.partition('://')[0]}://{host}:{self.port}"
        self.exposed = not ipaddress.ip_address(own_host.partition("%")[0]).is_loopback
        self.dropped = 0

    def receive(self, timeout_s: float) -> list[tuple[bytes, Address]]:
        """Everything that waits to be read, oldest first, with its senders; nothing after `timeout_s` at the latest.

        Args:
            timeout_s: s; 0 never waits.
        """
        came: list[tuple[bytes, Address]] = []
        if timeout_s > 0.0:
            wait_for(self._socket, timeout_s)
        while len(came) < _AT_ONCE:
            try:
                data, sender = self._socket.recvfrom(_LARGEST)
            except BlockingIOError:
                break
            except OSError:
                # the system reports an answer that reached nobody at the next call
                self.dropped += 1
                continue
            # nobody can answer port 0: it is forged
            if sender[1]:
                came.append((data, sender))
        return came

    def send(self, data: bytes, to: Address) -> None:
        """Send one datagram; what reaches nobody is counted.

        Args:
            data: at most a datagram's. to: an address that `receive` gave.
        """
        try:
            self._socket.sendto(data, to)
        except OSError:
            self.dropped += 1

    def close(self) -> None:
        """Release the port; may be repeated."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
