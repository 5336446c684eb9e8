"""Links and those who mean no good: readers that do not read, pages in a browser, other computers."""

from __future__ import annotations

import os
import socket
import time

import pytest

from bridge.connection import Connection
from bridge.errors import PeerLost
from bridge.link import Link
from bridge.tcp_link import TcpLink
from bridge.udp_link import UdpLink

LOCAL = "127.0.0.1"
SOON_S = 5.0


def exactly(link: Link, size: int) -> bytes:
    """So many bytes, however they come."""
    data = b""
    while len(data) < size:
        data += link.recv(SOON_S) or b""
    return data


def test_a_peer_that_does_not_read_is_not_waited_for() -> None:
    """Frames it has no room for are dropped whole; what it reads at last are whole frames."""
    frame = bytes(range(250))
    with TcpLink.listen(LOCAL, 0) as server, TcpLink.connect(LOCAL, server.port) as peer:
        peer.send(b"here")
        assert exactly(server, 4) == b"here"
        began = time.monotonic()
        sent = 0
        while not server.dropped:
            server.send(frame)
            sent += 1
        server.send(frame)
        assert server.dropped == 2
        assert time.monotonic() - began < 5.0
        longest = 0.0
        for _ in range(100):
            began = time.monotonic()
            server.send(frame)
            longest = max(longest, time.monotonic() - began)
        assert longest < 0.5
        data = b""
        while (more := peer.recv(0.2)) is not None:
            data += more
            server.recv()  # hands the rest over
        assert data == frame * (len(data) // len(frame))
        assert len(data) // len(frame) == sent - 1
        server.send(b"again")
        assert exactly(peer, 5) == b"again"


def test_a_peer_that_never_reads_is_lost_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bridge.tcp_link._STUCK_S", 0.05)
    with TcpLink.listen(LOCAL, 0) as server, TcpLink.connect(LOCAL, server.port) as peer:
        peer.send(b"here")
        assert exactly(server, 4) == b"here"

        def send_until_lost() -> None:
            while True:
                server.send(bytes(300))
                if server.dropped:
                    time.sleep(0.01)

        with pytest.raises(PeerLost, match="read nothing for"):
            send_until_lost()
        with TcpLink.connect(LOCAL, server.port) as other:
            other.send(b"next")
            assert exactly(server, 4) == b"next"
            server.send(b"whole")
            assert exactly(other, 5) == b"whole"


@pytest.mark.parametrize("first", [b"POST /x HTTP/1.1\r\n", b"GET / HTTP/1.1\r\n", b"OPTIONS / ", b"\x16\x03\x01\x02"])
def test_a_page_in_a_browser_flies_nothing(first: bytes) -> None:
    """Behind a request's head a page may put any bytes, frames too."""
    with TcpLink.listen(LOCAL, 0) as server:
        with TcpLink.connect(LOCAL, server.port) as browser:
            browser.send(first + b"\r\n" + Connection(255, 190).encode("COMMAND_LONG", command=400, param1=1.0))
            with pytest.raises(PeerLost, match="spoke HTTP, as a browser does"):
                server.recv(SOON_S)
        with TcpLink.connect(LOCAL, server.port) as station:
            station.send(b"\xfdmore")
            assert exactly(server, 5) == b"\xfdmore"
            station.send(b"POST")  # a stream may go on with anything
            assert exactly(server, 4) == b"POST"


def test_who_speaks_to_this_computer_has_no_port_on_other_addresses() -> None:
    with UdpLink.listen(LOCAL, 0) as ground, UdpLink.to(LOCAL, ground.port) as vehicle:
        vehicle.send(b"hello")
        with socket.socket(fileno=os.dup(vehicle.fileno())) as same:
            assert same.getsockname()[0] == LOCAL
