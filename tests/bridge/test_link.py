"""One contract, every kind of link; then what is particular to each."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import numpy as np
import pytest

from bridge.errors import LinkClosed, LinkUrlError, PeerLost, PeerSilent, PortBusy
from bridge.faulty_link import FaultyLink, LinkFault
from bridge.link import Link, LossyLink, MemoryLink, open_link
from bridge.serial_link import SerialLink
from bridge.tcp_link import TcpLink, refuse_others, turn_out
from bridge.udp_link import UdpLink
from sitl.errors import UsageError

LOCAL = "127.0.0.1"
SOON_S = 5.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])


def memory_ends() -> tuple[Link, Link]:
    return MemoryLink.pair()


def udp_ends() -> tuple[Link, Link]:
    ground = UdpLink.listen(LOCAL, 0)
    return UdpLink.to(LOCAL, ground.port), ground


def px4_udp_ends() -> tuple[Link, Link]:
    ground = UdpLink.listen(LOCAL, 0)
    return open_link(f"udpout://{LOCAL}:{ground.port}?local={free_port()}"), ground


def udp6_ends() -> tuple[Link, Link]:
    try:
        ground = UdpLink.listen("::1", 0)
    except LinkUrlError:
        pytest.skip("this computer has no IPv6")
    return open_link(f"udpout://[::1]:{ground.port}"), ground


def tcp_ends() -> tuple[Link, Link]:
    server = TcpLink.listen(LOCAL, 0)
    return TcpLink.connect(LOCAL, server.port), server


def lossless_ends() -> tuple[Link, Link]:
    first, second = MemoryLink.pair()
    return LossyLink(first, np.random.default_rng(1)), second


def faulty_ends() -> tuple[Link, Link]:
    first, second = MemoryLink.pair()
    faulty = FaultyLink(first, lambda: 0, 1)
    faulty.begin(0, LinkFault())  # in force, and harmless
    return faulty, second


ENDS = {
    "memory": memory_ends,
    "udp": udp_ends,
    "px4 udp": px4_udp_ends,
    "udp over IPv6": udp6_ends,
    "tcp": tcp_ends,
    "lossy, without loss": lossless_ends,
    "faulty, with a harmless fault": faulty_ends,
}


def exactly(link: Link, count: int) -> bytes:
    """Read until `count` bytes are there: streams may deliver them in pieces."""
    data = b""
    while len(data) < count:
        more = link.recv(SOON_S)
        assert more is not None, "nothing came"
        data += more
    return data


@pytest.fixture(params=ENDS.values(), ids=ENDS.keys())
def ends(request: pytest.FixtureRequest) -> Iterator[tuple[Link, Link]]:
    """Two ends of a wire; the first one speaks first."""
    make: Callable[[], tuple[Link, Link]] = request.param
    first, second = make()
    yield first, second
    first.close()
    second.close()


class TestContract:
    def test_both_ways(self, ends: tuple[Link, Link]) -> None:
        first, second = ends
        first.send(b"hello")
        assert exactly(second, 5) == b"hello"
        second.send(b"good day")
        assert exactly(first, 8) == b"good day"

    def test_nothing_there_is_none_at_once_and_after_a_wait(self, ends: tuple[Link, Link]) -> None:
        for link in ends:
            assert link.recv() is None
            assert link.recv(0.01) is None

    def test_order_is_kept(self, ends: tuple[Link, Link]) -> None:
        first, second = ends
        sent = [bytes([number]) * (number + 1) for number in range(100)]
        for data in sent:
            first.send(data)
        assert exactly(second, sum(map(len, sent))) == b"".join(sent)

    def test_datagrams_stay_whole(self, ends: tuple[Link, Link]) -> None:
        first, second = ends
        if not first.datagram:
            pytest.skip("a stream")
        for size in (1, 280, 1400):
            first.send(b"x" * size)
        assert [len(second.recv(SOON_S) or b"") for _ in range(3)] == [1, 280, 1400]

    def test_a_vanished_peer(self, ends: tuple[Link, Link]) -> None:
        first, second = ends
        first.send(b"last words")
        assert exactly(second, 10) == b"last words"
        second.send(b"yours too")
        second.close()
        assert exactly(first, 9) == b"yours too"
        if isinstance(first, UdpLink):
            for _ in range(20):
                first.send(b"anybody?")
                assert first.recv() is None
        else:
            with pytest.raises(PeerLost, match="went away"):
                first.recv(SOON_S)
            with pytest.raises(PeerLost):
                first.send(b"anybody?")

    def test_closed_is_closed(self, ends: tuple[Link, Link]) -> None:
        for link in ends:
            link.close()
            link.close()
            with pytest.raises(LinkClosed, match="is closed"):
                link.send(b"x")
            with pytest.raises(LinkClosed):
                link.recv()

    def test_a_link_is_a_context(self, ends: tuple[Link, Link]) -> None:
        with ends[0] as link:
            assert link.name in repr(link)
        with pytest.raises(LinkClosed):
            link.send(b"x")


class TestMemory:
    def test_a_full_inbox_drops_and_counts(self) -> None:
        first, second = MemoryLink.pair(limit=3)
        for number in range(5):
            first.send(bytes([number]))
        assert first.dropped == 2
        assert [second.recv() for _ in range(4)] == [b"\0", b"\1", b"\2", None]

    def test_nothing_is_copied(self) -> None:
        first, second = MemoryLink.pair()
        data = bytes(1000)
        first.send(data)
        assert second.recv() is data


class TestUdp:
    def test_a_listener_answers_whoever_spoke_last(self) -> None:
        with UdpLink.listen(LOCAL, 0) as ground, ExitStack() as open_ends:
            ground.send(b"is anybody there")
            assert ground.dropped == 1
            peers = [open_ends.enter_context(UdpLink.to(LOCAL, ground.port)) for _ in range(2)]
            for peer in peers:
                peer.send(b"me")
                assert ground.recv(SOON_S) == b"me"
                ground.send(b"you")
                assert peer.recv(SOON_S) == b"you"
            assert peers[0].recv() is None

    def test_speaking_to_one_address_hears_nobody_else(self) -> None:
        with UdpLink.listen(LOCAL, 0) as ground, UdpLink.to(LOCAL, ground.port) as vehicle:
            vehicle.send(b"hello")
            with UdpLink.to(LOCAL, vehicle.port) as stranger:
                stranger.send(b"obey")
            assert ground.recv(SOON_S) == b"hello"
            ground.send(b"hi")
            assert vehicle.recv(SOON_S) == b"hi"

    def test_as_px4_a_local_port_answers_callers_and_the_ground_station(self) -> None:
        port = free_port()
        with UdpLink.listen(LOCAL, 0) as ground, UdpLink.to(LOCAL, ground.port, local_port=port) as vehicle:
            assert vehicle.port == port
            with UdpLink.to(LOCAL, port) as script:
                script.send(b"arm")
                assert vehicle.recv(SOON_S) == b"arm"
                vehicle.send(b"ack")
                assert script.recv(SOON_S) == b"ack"
                assert ground.recv(SOON_S) == b"ack"
            ground.send(b"disarm")
            assert vehicle.recv(SOON_S) == b"disarm"

    def test_a_vehicle_that_speaks_to_loopback_is_reachable_from_loopback_only(self) -> None:
        port = free_port()
        with UdpLink.to(LOCAL, 14550, local_port=port), socket.socket(type=socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.2", port))  # would fail had the vehicle taken every address

    @pytest.mark.parametrize("url", ["udpin://127.0.0.1:{}", "udpout://127.0.0.1:1?local={}"])
    def test_a_busy_port_is_named(self, url: str) -> None:
        with UdpLink.listen(LOCAL, 0) as ground, pytest.raises(PortBusy, match=rf":{ground.port} is in use"):
            open_link(url.format(ground.port))


class TestTcp:
    def test_the_next_peer_is_taken_when_one_has_gone(self) -> None:
        with TcpLink.listen(LOCAL, 0) as server:
            server.send(b"nobody listens")
            assert (server.dropped, server.connected) == (1, False)
            for greeting in (b"first", b"second"):
                with TcpLink.connect(LOCAL, server.port) as peer:
                    peer.send(greeting)
                    assert exactly(server, len(greeting)) == greeting
                with pytest.raises(PeerLost, match="closed the connection"):
                    server.recv(SOON_S)
                assert not server.connected

    def test_a_large_message_arrives_whole(self) -> None:
        data = bytes(range(256)) * 400
        with TcpLink.listen(LOCAL, 0) as server, TcpLink.connect(LOCAL, server.port) as peer:
            peer.send(data)
            assert exactly(server, len(data)) == data

    def test_a_peer_that_reads_nothing_is_lost_and_holds_nobody_up(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("bridge.tcp_link._STUCK_S", 0.01)
        with TcpLink.listen(LOCAL, 0) as server, TcpLink.connect(LOCAL, server.port) as peer:
            with pytest.raises(PeerLost, match="read nothing for"):
                peer.send(bytes(64_000_000))
            with pytest.raises(PeerLost, match="read nothing for"):
                peer.recv()

    def test_nobody_to_connect_to(self) -> None:
        port = free_port()
        with pytest.raises(PeerSilent, match=rf"{port}: no sign of a listening program within 0.12 s"):
            open_link(f"tcpout://{LOCAL}:{port}", connect_s=0.12)

    def test_a_busy_port_is_named(self) -> None:
        with TcpLink.listen(LOCAL, 0) as server, pytest.raises(PortBusy, match=str(server.port)):
            open_link(f"tcpin://{LOCAL}:{server.port}")


class TestSerial:
    @pytest.fixture
    def board(self) -> Iterator[tuple[int, SerialLink]]:
        """A terminal pair: our end is a serial port, the board's a file descriptor."""
        pytest.importorskip("serial")
        ours, theirs = os.openpty()
        device = os.ttyname(theirs)
        link = open_link(f"serial://{device}:57600")
        assert isinstance(link, SerialLink)
        yield ours, link
        link.close()
        os.close(ours)
        os.close(theirs)

    def test_both_ways(self, board: tuple[int, SerialLink]) -> None:
        far, link = board
        assert link.recv() is None
        assert link.recv(0.01) is None
        os.write(far, b"\xfd\x00\xff")
        assert exactly(link, 3) == b"\xfd\x00\xff"
        link.send(b"\xfe\r\n")
        assert os.read(far, 10) == b"\xfe\r\n"

    def test_closed_is_closed(self, board: tuple[int, SerialLink]) -> None:
        _, link = board
        link.close()
        link.close()
        with pytest.raises(LinkClosed):
            link.recv()
        with pytest.raises(LinkClosed):
            link.send(b"x")

    def test_no_such_device(self) -> None:
        pytest.importorskip("serial")
        with pytest.raises(LinkUrlError, match=r"serial:///dev/nothing:921600.*Check the cable"):
            open_link("serial:///dev/nothing")


class TestLossy:
    COUNT = 4000

    def pass_through(self, seed: int, **shares: float) -> tuple[list[bytes], LossyLink]:
        near, far = MemoryLink.pair()
        lossy = LossyLink(near, np.random.default_rng(seed), **shares)
        for number in range(self.COUNT):
            lossy.send(number.to_bytes(2, "little"))
        return list(iter(far.recv, None)), lossy

    def test_one_seed_one_fate(self) -> None:
        shares = {"loss": 0.2, "duplicate": 0.1, "reorder": 0.1, "corrupt": 0.1}
        assert self.pass_through(5, **shares)[0] == self.pass_through(5, **shares)[0]
        assert self.pass_through(5, **shares)[0] != self.pass_through(6, **shares)[0]

    @pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
    def test_loss(self, share: float) -> None:
        arrived, lossy = self.pass_through(1, loss=share)
        lost = self.COUNT - len(arrived)
        assert abs(lost - share * self.COUNT) <= 5 * (self.COUNT * share * (1 - share)) ** 0.5
        assert lossy.damaged == lost
        assert arrived == sorted(arrived, key=lambda data: int.from_bytes(data, "little"))

    def test_duplicate(self) -> None:
        arrived, _ = self.pass_through(1, duplicate=1.0)
        assert arrived[::2] == arrived[1::2]
        assert len(arrived) == 2 * self.COUNT

    def test_reorder_swaps_neighbours_and_loses_none(self) -> None:
        arrived, lossy = self.pass_through(1, reorder=0.3)
        numbers = [int.from_bytes(data, "little") for data in arrived]
        assert numbers != sorted(numbers)
        assert max(abs(place - number) for place, number in enumerate(numbers)) == 1
        assert len(numbers) >= self.COUNT - 1  # the last one may still be held
        assert len(set(numbers)) == len(numbers)
        assert lossy.damaged > 0

    def test_corrupt_changes_one_byte(self) -> None:
        arrived, _ = self.pass_through(1, corrupt=1.0)
        for number, data in enumerate(arrived):
            changed = [a != b for a, b in zip(data, number.to_bytes(2, "little"), strict=True)]
            assert sum(changed) == 1

    def test_directions_do_not_share_their_luck(self) -> None:
        def outward(answers: int) -> list[bytes]:
            near, far = MemoryLink.pair()
            lossy = LossyLink(near, np.random.default_rng(3), loss=0.5)
            arrived = []
            for number in range(200):
                lossy.send(bytes([number]))
                for _ in range(answers):
                    far.send(b"answer")
                    lossy.recv()
                arrived += list(iter(far.recv, None))
            return arrived

        assert outward(0) == outward(3)

    def test_a_held_datagram_arrives_when_nothing_else_does(self) -> None:
        near, far = MemoryLink.pair()
        lossy = LossyLink(near, np.random.default_rng(3), reorder=1.0)
        far.send(b"one")
        assert lossy.recv() == b"one"
        for data in (b"two", b"three", b"four"):
            far.send(data)
        assert [lossy.recv() for _ in range(4)] == [b"three", b"two", b"four", None]

    def test_a_share_is_a_share(self) -> None:
        with pytest.raises(UsageError, match=r"loss = 30.*between 0 and 1"):
            LossyLink(MemoryLink.pair()[0], np.random.default_rng(1), loss=30)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("127.0.0.1:14550", "Write udpin://"),
        ("udp://127.0.0.1:14550", "unknown kind 'udp'"),
        ("udpin://127.0.0.1", "no port in it. Write udpin://host:port"),
        ("udpin://127.0.0.1:99999", "the port is not a number from 0 to 65535"),
        ("udpin://127.0.0.1:mavlink", "the port is not a number"),
        ("udpin://[::1:14550", "brackets"),
        ("tcpin://127.0.0.1:5760/x", "more in it than host and port"),
        ("udpin://127.0.0.1:14550?local=3", "unknown option 'local'"),
        ("udpout://127.0.0.1:14550?lokal=3", "unknown option 'lokal'"),
        ("udpout://127.0.0.1:14550?local=0", "local='0' is not a port"),
        ("udpout://127.0.0.1:14550?local=x", "local='x' is not a port"),
        ("udpout://no.such.host.invalid:14550", "host 'no.such.host.invalid' cannot be found"),
        (
            "udpin://192.0.2.1:14550",
            "cannot listen on 192.0.2.1:14550. Listen on an address of this computer",
        ),
        ("serial:///dev/ttyACM0:fast", "no device and baud rate"),
        ("serial://", "no device and baud rate"),
        ("memory://", "leave --connect out"),
    ],
)
def test_a_bad_address_says_how_to_write_it(url: str, text: str) -> None:
    with pytest.raises(LinkUrlError, match=r"^link ") as caught:
        open_link(url)
    assert text in str(caught.value)
    assert caught.value.exit_status == 2


def test_localhost_is_where_ground_stations_listen() -> None:
    with UdpLink.listen(LOCAL, 0) as ground, open_link(f"udpout://localhost:{ground.port}") as vehicle:
        vehicle.send(b"hello")
        assert ground.recv(SOON_S) == b"hello"


def test_every_kind_of_address_opens() -> None:
    with ExitStack() as links:
        opened = [
            links.enter_context(open_link(url))
            for url in ("udpin://127.0.0.1:0", "udpin://:0", "udpout://localhost:9", "tcpin://localhost:0")
        ]
        assert [link.datagram for link in opened] == [True, True, True, False]


class TestWhoMayStay:
    """A listening TCP link has one peer; the owner of the port decides who."""

    def test_others_are_turned_away_and_the_peer_stays(self) -> None:
        with TcpLink.listen(LOCAL, 0) as server, TcpLink.connect(LOCAL, server.port) as peer:
            assert server.recv(0.2) is None
            assert not refuse_others(server)
            with TcpLink.connect(LOCAL, server.port) as other:
                assert until(lambda: refuse_others(server))
                with pytest.raises(PeerLost):
                    other.recv(SOON_S)
            peer.send(b"still here")
            assert server.recv(SOON_S) == b"still here"

    def test_the_peer_is_turned_out_and_the_next_one_comes_in(self) -> None:
        with TcpLink.listen(LOCAL, 0) as server, TcpLink.connect(LOCAL, server.port) as peer:
            peer.send(b"first")
            assert server.recv(SOON_S) == b"first"
            with TcpLink.connect(LOCAL, server.port) as waiting:
                waiting.send(b"second")
                assert turn_out(server)
                with pytest.raises(PeerLost):
                    peer.recv(SOON_S)
                assert server.recv(SOON_S) == b"second"

    def test_where_nobody_else_can_come_nobody_is_turned_out(self) -> None:
        near, far = MemoryLink.pair()
        assert not turn_out(near)
        assert not refuse_others(near)
        with TcpLink.listen(LOCAL, 0) as server:
            assert not turn_out(server)
            with TcpLink.connect(LOCAL, server.port) as peer:
                assert not turn_out(peer)
        far.close()


def until(reached: Callable[[], bool]) -> bool:
    """Whether it is reached soon."""
    return any(reached() or wait_a_little() for _ in range(500))


def wait_a_little() -> None:
    time.sleep(0.01)
