"""What a PX4 is on a simulator's port: strict about what it is sent, and as awkward as it can be.

`StandIn` connects as PX4's simulator link does and notes in `problems` whatever a PX4 would choke on: time that does
not increase, groups that are not complete, sensors that repeat themselves, truth that nobody asked for. Who flies is
its brain: `Still` turns no propeller, `tests/hil_autopilot.py` has one that flies. `Faults` makes it misbehave.

As a program: `python tests/px4_stand_in.py --port 4560 [--connect udpout://127.0.0.1:14540] [--fault hang] ...`.
"""

from __future__ import annotations

import argparse
import random
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))

from px4_rules import Rules, Sample, taken

from bridge.connection import Connection, Message

_TRAP_US = 3000
"""Below this time between samples every second one alone is answered."""


_MOTORS = 16


class Brain(Protocol):
    """Who flies."""

    armed: bool

    def sample(self, sample: Sample) -> Sequence[float]:
        """Motor signals 0..1 on this sample."""
        ...

    def gps(self, message: Message) -> None:
        """A HIL_GPS came."""
        ...

    def truth(self, message: Message) -> None:
        """A HIL_STATE_QUATERNION came."""
        ...

    def close(self) -> None:
        """The end."""
        ...


class Still:
    """Flies nothing: the same motor signals for ever, while armed."""

    def __init__(self, motors: Sequence[float] = (0.1, 0.1, 0.1, 0.1), *, armed: bool = False) -> None:
        self.armed = armed
        self.motors = motors

    def sample(self, sample: Sample) -> Sequence[float]:
        return self.motors

    def gps(self, message: Message) -> None:
        pass

    def truth(self, message: Message) -> None:
        pass

    def close(self) -> None:
        pass


@dataclass
class Faults:
    """What it does wrong; may be changed while it runs.

    Attributes:
        hang: takes nothing and says nothing. mute_armed, mute_disarmed: takes, and does not answer while so.
        late_us: answers another tick than the last, by so much. skip: every so many-th answer is left out.
        value: instead of the first motor's. sysid: another one in its answers. flags: of its answers.
        zeros: motors stand still though armed. octo: motors five to eight do. autopilot: as its HEARTBEAT says.
        truth_us: interval of truth that it asks for, None for not asking.
    """

    hang: bool = False
    mute_armed: bool = False
    mute_disarmed: bool = False
    late_us: int = 0
    skip: int = 0
    value: float | None = None
    sysid: int = 0
    flags: int = 1
    zeros: bool = False
    octo: bool = False
    autopilot: int = 12
    truth_us: int | None = 5000


class StandIn:
    """A PX4 on the simulator's port, in a thread of its own; a context manager.

    Args:
        port: of 127.0.0.1, where it connects, trying again and again.
        brain: who flies. sysid: MAVLink system. seed: of when it answers first. faults: what it does wrong.
        again: connects again when the simulator goes, which a PX4 does not.

    Attributes:
        rules: what it was sent against them. first_after: samples that it takes before its first answer.
        taken, answered: samples with id 0, answers. counts: of every message.
        samples: the last ones. connections: made so far. error: what ended its thread, if anything did.
    """

    def __init__(
        self,
        port: int,
        brain: Brain | None = None,
        *,
        sysid: int = 1,
        seed: int = 0,
        faults: Faults | None = None,
        again: bool = False,
    ) -> None:
        self.port = port
        self.brain: Brain = brain or Still()
        self.faults = faults or Faults()
        self.rules = Rules()
        self.first_after = random.Random(seed).randint(17, 92)
        self.taken = self.answered = self.connections = 0
        self.counts: dict[str, int] = {}
        self.samples: list[Sample] = []
        self.error: BaseException | None = None
        self._sysid = sysid
        self._again = again
        self._stop = threading.Event()
        self._drop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="px4-stand-in", daemon=True)
        self._each: list[Callable[[StandIn], object]] = []

    @property
    def problems(self) -> list[str]:
        return self.rules.problems

    def each_sample(self, run: Callable[[StandIn], object]) -> None:
        """Call this after every sample, in the thread of this: so that a fault begins at a known tick."""
        self._each.append(run)

    def start(self) -> Self:
        self._thread.start()
        return self

    def drop(self) -> None:
        """Close the connection; with `again` it comes back as one that has just booted."""
        self._drop.set()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(10.0)
        assert not self._thread.is_alive()
        if self.error is not None:
            raise self.error

    def wait(self, timeout_s: float | None = None) -> None:
        """Until it has ended by itself."""
        self._thread.join(timeout_s)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    # -- its thread --------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                peer = self._connect()
                if peer is None:
                    break
                with peer:
                    self._serve(peer)
                if not self._again:
                    break
        except BaseException as error:
            self.error = error
        finally:
            self.brain.close()

    def _connect(self) -> socket.socket | None:
        while not self._stop.is_set():
            peer = socket.socket()
            try:
                peer.connect(("127.0.0.1", self.port))
            except OSError:
                peer.close()
                time.sleep(0.002)
                continue
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.connections += 1
            return peer
        return None

    def _serve(self, peer: socket.socket) -> None:
        self._drop.clear()
        connection = Connection(self._sysid, 1)
        self.rules = Rules(self.rules.problems)
        fresh = 0  # samples since boot
        ask = self.faults.truth_us
        self.rules.asked_for_truth = ask is not None
        peer.sendall(connection.encode("HEARTBEAT", type=0, autopilot=self.faults.autopilot, mavlink_version=3))
        if ask is not None:
            request = {"target_system": 0, "command": 511, "param1": 115.0, "param2": float(ask)}
            peer.sendall(connection.encode_fields("COMMAND_LONG", request))
        try:
            while not (self._stop.is_set() or self._drop.is_set()):
                if self.faults.hang:
                    time.sleep(0.01)
                    continue
                if not select.select([peer], [], [], 0.05)[0]:
                    continue
                data = peer.recv(65536)
                if not data:
                    return
                for message in connection.receive(data):
                    if self._drop.is_set():
                        return
                    fresh += self._take(message, peer, connection, fresh)
        except (ConnectionError, BrokenPipeError):
            return

    def _take(self, message: Message, peer: socket.socket, connection: Connection, fresh: int) -> int:
        """One message; 1 if it was a sample that sets the clock."""
        self.counts[message.name] = self.counts.get(message.name, 0) + 1
        if message.name == "HIL_GPS":
            self.rules.gps(message)
            self.brain.gps(message)
        elif message.name == "HIL_STATE_QUATERNION":
            self.rules.truth()
            self.brain.truth(message)
        if message.name != "HIL_SENSOR":
            return 0
        sample = taken(message)
        before_us = self.rules.last_us
        self.rules.sensor(message, sample)
        self.taken += 1
        self.samples = [*self.samples[-9:], sample]
        motors = self.brain.sample(sample)
        for run in self._each:
            run(self)
        fast = before_us and sample.time_us - before_us < _TRAP_US
        if fresh + 1 >= self.first_after and not (fast and fresh % 2):
            self._answer(sample, motors, peer, connection)
        return 1

    def _answer(self, sample: Sample, motors: Sequence[float], peer: socket.socket, connection: Connection) -> None:
        faults, armed = self.faults, self.brain.armed
        if faults.hang or (faults.mute_armed if armed else faults.mute_disarmed):
            return
        if faults.skip and self.taken % faults.skip == 0:
            return
        controls = [0.0] * _MOTORS
        if armed and not faults.zeros:
            controls[: len(motors)] = motors
            if faults.octo:
                controls[4:8] = [0.0] * 4
        if faults.value is not None:
            controls[0] = faults.value
        connection.sysid = faults.sysid or self._sysid
        frame = connection.encode(
            "HIL_ACTUATOR_CONTROLS",
            time_usec=sample.time_us - faults.late_us,
            controls=controls,
            mode=129 if armed else 1,
            flags=faults.flags,
        )
        self.answered += 1
        peer.sendall(frame)


class Impostor:
    """A program that connects to the simulator's port and is no PX4: it says its words and stays."""

    def __init__(self, port: int, words: bytes) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), 5.0)
        self._socket.sendall(words)

    def turned_away(self, timeout_s: float = 5.0) -> bool:
        """Whether the other side closes within that time, having said what it wants."""
        self._socket.settimeout(timeout_s)
        try:
            while self._socket.recv(65536):
                pass
        except ConnectionError:
            return True
        except TimeoutError:
            return False
        return True

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


HTTP = b"GET / HTTP/1.1\r\nHost: 127.0.0.1:4560\r\nUser-Agent: curl/8.5.0\r\nAccept: */*\r\n\r\n"
GARBAGE = struct.pack("<512H", *random.Random(3).sample(range(0, 0xFC00), 512))


def main(words: Sequence[str] | None = None) -> int:
    """Run one until the simulator goes, or for ever if there is none."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--connect", help="fly, and speak MAVLink to programs on this link")
    parser.add_argument("--vehicle", default="ant-x")
    parser.add_argument("--sysid", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--armed", action="store_true", help="without --connect: motors turn")
    parser.add_argument("--again", action="store_true", help="connect again when the simulator goes")
    parser.add_argument("--fault", action="append", default=[], metavar="NAME[=VALUE]", help="see Faults")
    args = parser.parse_args(words)
    faults = Faults()
    for text in args.fault:
        name, _, value = text.partition("=")
        kind = type(getattr(faults, name))
        setattr(faults, name, True if kind is bool else float(value) if name == "value" else int(value))
    brain: Brain = Still(armed=args.armed)
    if args.connect:
        from hil_autopilot import AutopilotOnWire

        brain = AutopilotOnWire(args.connect, vehicle=args.vehicle, sysid=args.sysid)
        faults.truth_us = AutopilotOnWire.TRUTH_US
    stand_in = StandIn(args.port, brain, sysid=args.sysid, seed=args.seed, faults=faults, again=args.again)
    with stand_in:
        stand_in.wait()
    for problem in stand_in.problems:
        sys.stderr.write(f"problem: {problem}\n")
    return 1 if stand_in.problems else 0


if __name__ == "__main__":
    raise SystemExit(main())
