"""Links of a program that has a thousand files open: `select` does not know their descriptors."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import time
from collections.abc import Iterator

import pytest

from bridge.link import Link
from bridge.socket_wait import FIRST_TOO_LARGE, wait_for
from bridge.tcp_link import TcpLink
from bridge.udp_link import UdpLink

LOCAL = "127.0.0.1"


@pytest.fixture
def many_files() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2 * FIRST_TOO_LARGE:
        pytest.skip(f"no more than {hard} files here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * FIRST_TOO_LARGE), hard))
    opened = [os.open(os.devnull, os.O_RDONLY)]
    while opened[-1] < FIRST_TOO_LARGE:
        opened.append(os.open(os.devnull, os.O_RDONLY))
    yield
    for number in opened:
        os.close(number)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def udp_ends() -> tuple[Link, Link]:
    ground = UdpLink.listen(LOCAL, 0)
    return UdpLink.to(LOCAL, ground.port), ground


def tcp_ends() -> tuple[Link, Link]:
    server = TcpLink.listen(LOCAL, 0)
    return TcpLink.connect(LOCAL, server.port), server


@pytest.mark.usefixtures("many_files")
@pytest.mark.parametrize("ends", [udp_ends, tcp_ends])
def test_links_carry_bytes(ends: object) -> None:
    one, other = ends()  # type: ignore[operator]
    try:
        assert other.recv(0.001) is None
        one.send(b"\xfdhello")
        assert other.recv(5.0) == b"\xfdhello"
        other.send(b"\xfdyes")
        came = (one.recv(0.001) for _ in range(5000))
        assert next(data for data in came if data is not None) == b"\xfdyes"
    finally:
        one.close()
        other.close()


@pytest.mark.parametrize("large", [False, True])
def test_waits_no_longer_than_it_may_and_no_longer_than_it_must(large: bool, request: pytest.FixtureRequest) -> None:
    if large:
        request.getfixturevalue("many_files")
    near, far = socket.socketpair()
    with near, far:
        assert (near.fileno() >= FIRST_TOO_LARGE) is large
        start = time.monotonic()
        assert not wait_for(near, 0.02)
        assert time.monotonic() - start >= 0.02
        assert wait_for(near, 0.0, to_write=True)
        far.send(b"x")
        assert wait_for(near, 60.0)
        near.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                near.send(bytes(65536))
        assert not wait_for(near, 0.0, to_write=True)
