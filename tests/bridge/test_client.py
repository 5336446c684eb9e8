"""The ground's client against a vehicle in the same thread, and against peers that misbehave on purpose."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bridge.client import ACK_TRIES, Client
from bridge.clock import SimClock
from bridge.connection import Connection, Message
from bridge.drive import NetworkDrive, SharedDrive
from bridge.errors import CommandRefused, NotReady, PeerLost, PeerSilent, UploadFailed
from bridge.link import Link, LossyLink, MemoryLink
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.modes import Mode
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

GAINS: dict[str, tuple[Any, Any]] = {
    "MC_ROLL_P": (6.5, "REAL32"),
    "MC_ROLLRATE_P": (0.0537, "REAL32"),
    "MC_ROLLRATE_I": (0.1, "REAL32"),
    "MC_ROLLRATE_D": (0.0013, "REAL32"),
    "MC_PITCH_P": (7.25, "REAL32"),
    "MC_AIRMODE": (1, "INT32"),
}


class World:
    """A vehicle, its server and a client, one clock."""

    def __init__(self, wire: Callable[[Link], Link] = lambda link: link, **client: Any) -> None:
        self.vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"), seed=3)
        self.clock = SimClock(self.vehicle.tick_us)
        near, far = MemoryLink.pair()
        self.server_link = ServerLink(far, Connection(1, 1, datagram=True), 0, "memory")
        self.server = VehicleServer(self.vehicle, [self.server_link], strict=True)
        self.clock.every_tick(self.server.step)
        self.client = Client(wire(near), SharedDrive(self.clock), **client)

    def connected(self) -> World:
        self.client.connect()
        return self

    def ready(self) -> World:
        self.connected().client.wait_ready()
        return self

    def values(self) -> dict[str, Any]:
        return {name: self.vehicle.parameters.get(name) for name in GAINS}


class Peer:
    """The far end of a wire, scripted: `answer` gets every message and says what is sent back."""

    def __init__(self, answer: Callable[[Message], list[tuple[str, dict[str, Any]]]], sysid: int = 1) -> None:
        self.clock = SimClock(4000)
        self.near, self._far = MemoryLink.pair()
        self._connection = Connection(sysid, 1, datagram=True)
        self._answer = answer
        self.heard: list[Message] = []
        self.clock.every_tick(self._tick)
        self.client = Client(self.near, SharedDrive(self.clock))

    def send(self, name: str, /, **fields: Any) -> None:
        self._far.send(self._connection.encode(name, **fields))

    def _tick(self) -> None:
        if self.clock.tick % 25 == 0:
            self.send("HEARTBEAT", type=2, autopilot=12, mavlink_version=3)
        while (data := self._far.recv()) is not None:
            for message in self._connection.receive(data):
                self.heard.append(message)
                for name, fields in self._answer(message):
                    self.send(name, **fields)


def acks(*results: int) -> Callable[[Message], list[tuple[str, dict[str, Any]]]]:
    """Answers every command with these results, one after the other, in the same tick."""

    def answer(message: Message) -> list[tuple[str, dict[str, Any]]]:
        if message.name != "COMMAND_LONG":
            return []
        return [("COMMAND_ACK", {"command": message.command, "result": result}) for result in results]

    return answer


class TestConnect:
    def test_it_learns_whom_it_talks_to(self) -> None:
        world = World().connected()
        assert world.client.target_system == 1
        assert not world.client.state.armed
        assert world.client.state.nav_state == Mode.LOITER

    def test_silence_names_the_link_and_what_was_awaited(self) -> None:
        near, _far = MemoryLink.pair()
        client = Client(near, SharedDrive(SimClock(4000)))
        with pytest.raises(PeerSilent, match=r"memory://1: no sign of a HEARTBEAT of an autopilot .* within 10 s"):
            client.connect()

    def test_ground_stations_and_cameras_are_no_autopilots(self) -> None:
        peer = Peer(lambda _: [], sysid=9)
        peer._connection.compid = 190
        with pytest.raises(PeerSilent):
            peer.client.connect()

    def test_a_vehicle_that_has_been_up_for_long_is_not_late(self) -> None:
        """Its time jumps from nothing to 10 000 s with its first message: no reason to lose patience."""
        near, far = MemoryLink.pair()
        connection = Connection(1, 1, datagram=True)
        ticks = iter(range(1_000_000))

        class Live(NetworkDrive):
            def wait(self, link: Link, until_us: int) -> bytes | None:
                tick = next(ticks)
                if tick % 10 == 0:
                    far.send(connection.encode("ATTITUDE", time_boot_ms=10_000_000 + 4 * tick))
                if tick % 100 == 35:
                    far.send(connection.encode("HEARTBEAT", type=2, autopilot=12))
                return super().wait(link, until_us)

        client = Client(near, Live(clock=SimClock(20_000)))
        client.connect()
        assert client.now_us() >= 10_000_000_000
        start = client.now_us()
        client.wait(1.0)
        assert 1_000_000 <= client.now_us() - start < 1_100_000

    def test_another_vehicle_on_the_wire_is_not_listened_to(self) -> None:
        world = World().ready()
        other = Connection(2, 1, datagram=True)
        link = world.server_link.link
        world.clock.every_tick(lambda: link.send(other.encode("HEARTBEAT", type=2, autopilot=12, base_mode=128)))
        world.clock.every_tick(lambda: link.send(other.encode("ATTITUDE", time_boot_ms=1, roll=3.0)))
        world.client.wait(1.0)
        assert world.client.target_system == 1
        assert not world.client.state.armed
        assert world.client.state.euler is not None
        assert abs(world.client.state.euler[0]) < 0.1

    def test_what_keeps_a_vehicle_from_being_ready_is_listed(self) -> None:
        peer = Peer(lambda _: [])
        peer.client.connect()
        peer.send("ATTITUDE")
        with pytest.raises(NotReady, match=r"still missing: pre-arm checks, home position, local position$"):
            peer.client.wait_ready(5.0)

    def test_the_log_has_both_directions(self) -> None:
        frames: list[tuple[int, bytes]] = []
        world = World(log=lambda time_us, frame: frames.append((time_us, frame))).connected()
        world.client.set_interval(30, 4000)
        seen = Connection(250, 250)
        senders = {message.sysid for _, frame in frames for message in seen.receive(frame)}
        assert senders == {1, 255}
        times = [time_us for time_us, _ in frames]
        assert times == sorted(times)


class TestCommands:
    def test_a_refusal_carries_the_vehicles_words(self) -> None:
        world = World().connected()
        with pytest.raises(CommandRefused, match=r"arm: temporarily rejected by the vehicle: .*Arming denied"):
            world.client.arm()

    def test_a_command_gets_through_a_bad_link(self) -> None:
        for seed in range(5):
            world = World(lambda link, seed=seed: LossyLink(link, np.random.default_rng(seed), loss=0.3))
            world.ready().client.set_interval(30, 4000)
            assert world.server_link.schedule.interval_us(30) == 4000
            world.client.arm()
            assert world.vehicle.autopilot.armed

    def test_it_is_asked_again_and_then_given_up(self) -> None:
        peer = Peer(lambda _: [])
        peer.client.connect()
        with pytest.raises(PeerSilent, match=r"no sign of an answer to land within 10 s"):
            peer.client.land()
        commands = [message for message in peer.heard if message.name == "COMMAND_LONG"]
        assert [message.confirmation for message in commands] == list(range(ACK_TRIES))

    def test_in_progress_is_waited_for_if_asked(self) -> None:
        peer = Peer(acks(5, 0))
        peer.client.connect()
        peer.client.command("calibration", 241, timeout_s=5.0)
        with pytest.raises(CommandRefused, match="still in progress"):
            peer.client.command("calibration", 241)

    def test_an_answer_to_something_else_is_none(self) -> None:
        def answer(message: Message) -> list[tuple[str, dict[str, Any]]]:
            return [("COMMAND_ACK", {"command": 21, "result": 0})] if message.name == "COMMAND_LONG" else []

        peer = Peer(answer)
        peer.client.connect()
        with pytest.raises(PeerSilent, match="an answer to arm"):
            peer.client.arm()

    def test_a_message_the_vehicle_lacks_is_no_error_where_it_is_only_nice_to_have(self) -> None:
        world = World().connected()
        assert world.client.try_interval(30, 4000)
        assert not world.client.try_interval(9999, 4000)


class TestBackground:
    def test_it_is_called_before_every_wait_and_its_next_time_is_kept(self) -> None:
        world = World().connected()
        called: list[int] = []

        def background(now_us: int) -> int:
            called.append(now_us)
            return now_us + 8000

        world.client.background = background
        world.client.wait(1.0)
        assert max(np.diff(called)) <= 8000


class Torrent(Link):
    """More comes than anybody can read: there is always another datagram."""

    def __init__(self, next_one: Callable[[], bytes]) -> None:
        super().__init__("torrent")
        self.next_one = next_one
        self.sent: list[bytes] = []

    def recv(self, timeout_s: float = 0.0) -> bytes:
        return self.next_one()

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def close(self) -> None:
        pass


class TestTorrent:
    def test_a_vehicle_that_is_faster_than_we_read_gets_its_set_points_all_the_same(self) -> None:
        """It left Offboard otherwise, as long as we were behind."""
        vehicle, time_ms = Connection(1, 1), itertools.count(4, 4)
        client = Client(Torrent(lambda: vehicle.encode("ATTITUDE", time_boot_ms=next(time_ms))), NetworkDrive())
        called: list[int] = []
        client.background = lambda now_us: called.append(now_us) or now_us + 20_000  # type: ignore[func-returns-value]
        for _ in range(50):
            client.pump()
        assert len(called) == 50
        assert max(np.diff(called)) <= 24_000

    def test_one_that_says_nothing_of_use_does_not_hold_us(self) -> None:
        torrent = Torrent(lambda: bytes(40))
        client = Client(torrent, NetworkDrive())
        for _ in range(3):
            client.pump()
        assert len(torrent.sent) >= 1  # our heartbeat


class TestTexts:
    def test_chunks_are_put_together_and_handed_over_once(self) -> None:
        peer = Peer(lambda _: [])
        said: list[tuple[int, str]] = []
        peer.client.on_text = lambda _t, severity, text: said.append((severity, text))
        peer.client.connect()
        long = "a long text " * 9
        for start in range(0, len(long) + 1, 50):
            chunk = long[start : start + 50].encode()
            peer.send("STATUSTEXT", severity=4, text=chunk, id=7, chunk_seq=start // 50)
        peer.send("STATUSTEXT", severity=6, text=b"short\t")
        peer.client.wait(0.1)
        assert said == [(4, long), (6, "short")]
        assert [text for _, _, text in peer.client.state.texts] == [long, "short"]


class TestParameters:
    def test_an_upload_is_there_bit_by_bit_and_can_be_taken_back(self) -> None:
        world = World().connected()
        before = world.values()
        backup = world.client.read_parameters(GAINS)
        assert {name: value.value for name, value in backup.items()} == before
        world.client.upload(GAINS)
        for name, (value, type_) in GAINS.items():
            assert world.vehicle.parameters.get(name) == (np.float32(value) if type_ == "REAL32" else value)
        world.client.upload({name: (value.raw, value.type) for name, value in backup.items()})
        assert world.values() == before

    def test_a_value_that_is_no_number_is_restored_too(self) -> None:
        world = World().connected()
        world.vehicle.parameters.set("MC_ROLLRATE_FF", math.nan)
        backup = world.client.read_parameters(["MC_ROLLRATE_FF"])
        raw = world.vehicle.parameters.raw("MC_ROLLRATE_FF")
        world.client.upload({"MC_ROLLRATE_FF": (0.5, "REAL32")})
        world.client.upload({name: (value.raw, value.type) for name, value in backup.items()})
        assert world.vehicle.parameters.raw("MC_ROLLRATE_FF") == raw

    def test_an_unknown_parameter_is_named(self) -> None:
        world = World().connected()
        with pytest.raises(UploadFailed, match=r"MC_ROLL_Q.*does not exist"):
            world.client.read_parameters(["MC_ROLL_P", "MC_ROLL_Q"])
        with pytest.raises(UploadFailed, match=r"MC_ROLL_Q = 1\.0 was not taken.*nothing came back"):
            world.client.upload({"MC_ROLL_P": (5.0, "REAL32"), "MC_ROLL_Q": (1.0, "REAL32")})

    def test_a_parameter_of_another_type_is_named(self) -> None:
        world = World().connected()
        before = world.values()
        with pytest.raises(UploadFailed, match=r"MC_ROLL_P = 6 was not taken"):
            world.client.upload({"MC_ROLL_P": (6, "INT32")})
        assert world.values() == before

    @pytest.mark.parametrize("seed", range(6))
    def test_over_a_bad_link_what_counts_as_uploaded_is_on_the_vehicle(self, seed: int) -> None:
        """Three packets in ten are lost each way, others doubled, late or damaged."""
        rng = np.random.default_rng(seed)
        bad_link = World(lambda link: LossyLink(link, rng, loss=0.3, duplicate=0.05, reorder=0.05, corrupt=0.02))
        bad_link.connected()
        backup = bad_link.client.read_parameters(GAINS)
        before = bad_link.values()
        bad_link.client.upload(GAINS)
        for name, (value, type_) in GAINS.items():
            assert bad_link.vehicle.parameters.get(name) == (np.float32(value) if type_ == "REAL32" else value)
        bad_link.client.upload({name: (value.raw, value.type) for name, value in backup.items()})
        assert bad_link.values() == before

    def test_over_a_dead_link_it_is_refused(self) -> None:
        rng = np.random.default_rng(1)
        world = World().connected()
        world.client.link = LossyLink(world.client.link, rng, loss=1.0)
        with pytest.raises(UploadFailed, match=r"MC_ROLL_P = 6\.5 was not taken: no answer, asked 5 times"):
            world.client.upload(GAINS)


def test_a_peer_that_hangs_up_is_lost() -> None:
    world = World().connected()
    world.server_link.link.close()
    with pytest.raises(PeerLost):
        world.client.wait(1.0)
