"""A vehicle's port that other computers can reach: who is heard there, and who is answered."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from bridge import udp_link
from bridge.errors import LinkUrlError
from bridge.link import open_link
from bridge.tcp_link import TcpLink
from bridge.udp_link import UdpLink

LOCAL, ELSEWHERE, SOMEWHERE = "127.0.0.1", "127.0.0.2", "127.0.0.3"
SOON_S = 5.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])


class Peer:
    """A program on some computer."""

    def __init__(self, host: str, port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, port))
        self.socket.settimeout(SOON_S)

    def tell(self, port: int, data: bytes) -> None:
        self.socket.sendto(data, (LOCAL, port))

    def hears(self) -> bytes:
        return self.socket.recv(100)

    def hears_nothing(self) -> bool:
        self.socket.setblocking(False)
        try:
            self.socket.recv(100)
        except BlockingIOError:
            return True
        finally:
            self.socket.settimeout(SOON_S)
        return False

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def net(monkeypatch: pytest.MonkeyPatch) -> Iterator[ExitStack]:
    """The addresses 127.0.0.2 and 127.0.0.3 stand for other computers."""
    try:
        Peer(ELSEWHERE).close()
    except OSError:
        pytest.skip("this system has one loopback address only")
    monkeypatch.setattr(udp_link, "_is_loopback", lambda host: host == LOCAL)
    with ExitStack() as stack:
        yield stack


def peer(net: ExitStack, host: str, port: int = 0) -> Peer:
    one = Peer(host, port)
    net.callback(one.close)
    return one


def wide(net: ExitStack, ground: Peer) -> UdpLink:
    remote = ground.socket.getsockname()[1]
    link = open_link(f"udpout://{LOCAL}:{remote}?local={free_port()}&bind=0.0.0.0")
    assert isinstance(link, UdpLink)
    net.callback(link.close)
    return link


def test_the_local_ground_station_is_spoken_to_at_once(net: ExitStack) -> None:
    ground = peer(net, LOCAL)
    vehicle = wide(net, ground)
    vehicle.send(b"heartbeat")
    assert ground.hears() == b"heartbeat"


def test_the_first_computer_to_speak_is_answered_and_others_are_not_heard(net: ExitStack) -> None:
    ground, first, second = peer(net, LOCAL), peer(net, ELSEWHERE), peer(net, SOMEWHERE)
    vehicle = wide(net, ground)
    first.tell(vehicle.port, b"arm")
    assert vehicle.recv(SOON_S) == b"arm"
    second.tell(vehicle.port, b"kill")
    second.tell(vehicle.port, b"kill")
    first.tell(vehicle.port, b"take off")
    assert vehicle.recv(SOON_S) == b"take off"
    assert vehicle.strangers == 2
    vehicle.send(b"ack")
    assert (first.hears(), ground.hears()) == (b"ack", b"ack")
    assert second.hears_nothing()


def test_a_program_that_was_started_again_on_that_computer_is_answered_at_its_new_port(net: ExitStack) -> None:
    vehicle = wide(net, peer(net, LOCAL))
    before, after = peer(net, ELSEWHERE), peer(net, ELSEWHERE)
    for one in (before, after):
        one.tell(vehicle.port, b"hello")
        assert vehicle.recv(SOON_S) == b"hello"
    vehicle.send(b"ack")
    assert after.hears() == b"ack"
    assert before.hears_nothing()


def test_programs_on_this_computer_take_turns_beside_the_one_elsewhere(net: ExitStack) -> None:
    vehicle = wide(net, peer(net, LOCAL))
    far, script = peer(net, ELSEWHERE), peer(net, LOCAL)
    for one in (far, script):
        one.tell(vehicle.port, b"hello")
        assert vehicle.recv(SOON_S) == b"hello"
    vehicle.send(b"ack")
    assert (far.hears(), script.hears()) == (b"ack", b"ack")


def test_a_ground_station_that_answers_our_other_address_is_not_sent_everything_twice(net: ExitStack) -> None:
    remote = free_port()
    vehicle = UdpLink.to(LOCAL, remote, local_port=free_port(), bind_host=ELSEWHERE)
    net.callback(vehicle.close)
    ground = peer(net, ELSEWHERE, remote)
    ground.socket.sendto(b"hello", (ELSEWHERE, vehicle.port))
    assert vehicle.recv(SOON_S) == b"hello"
    vehicle.send(b"ack")
    assert ground.hears_nothing()  # it listens at 127.0.0.1 as well as here in life, and is called there


def test_a_flood_of_strangers_does_not_hold_the_vehicle(net: ExitStack) -> None:
    vehicle = wide(net, peer(net, LOCAL))
    first, second = peer(net, ELSEWHERE), peer(net, SOMEWHERE)
    first.tell(vehicle.port, b"hello")
    assert vehicle.recv(SOON_S) == b"hello"
    for _ in range(100):
        second.tell(vehicle.port, b"noise")
    assert vehicle.recv() is None
    assert vehicle.strangers < 100
    first.tell(vehicle.port, b"land")
    assert vehicle.recv() == b"land"


@pytest.mark.parametrize(
    ("url", "exposed"),
    [
        ("udpin://127.0.0.1:0", False),
        ("udpin://0.0.0.0:0", True),
        ("udpout://127.0.0.1:14550?local={}", False),
        ("udpout://127.0.0.1:14550?local={}&bind=127.0.0.1", False),
        ("udpout://127.0.0.1:14550?local={}&bind=0.0.0.0", True),
        ("udpout://192.0.2.1:14550?local={}", True),
        ("udpout://192.0.2.1:14550", False),
        ("tcpin://127.0.0.1:0", False),
        ("tcpin://0.0.0.0:0", True),
    ],
)
def test_a_link_knows_whether_others_can_reach_it(url: str, exposed: bool) -> None:
    with open_link(url.format(free_port())) as link:
        assert isinstance(link, (UdpLink, TcpLink))
        assert link.exposed == (("0.0.0.0", link.port) if exposed else None)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("udpout://127.0.0.1:14550?bind=0.0.0.0", "bind without local"),
        ("udpout://127.0.0.1:14550?local=1234&bind=here", "bind='here' is not an address"),
        ("udpout://127.0.0.1:14550?local=1234&bind=::", "Give both as IPv4 or both as IPv6"),
        ("udpout://127.0.0.1:14550?local=1234&bind=192.0.2.1", "cannot listen on 192.0.2.1:1234"),
        ("udpin://127.0.0.1:14550?bind=0.0.0.0", "unknown option 'bind'"),
    ],
)
def test_mistakes(url: str, text: str) -> None:
    with pytest.raises(LinkUrlError) as caught:
        open_link(url)
    assert text in str(caught.value)
