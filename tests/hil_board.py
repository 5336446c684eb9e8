"""A board on a serial line: our autopilot in wall-clock time, on a pseudo-terminal, as a PX4 in HITL behaves.

One line carries everything: HIL_SENSOR and HIL_GPS in, HIL_ACTUATOR_CONTROLS at 200 Hz and the MAVLink of programs out.
What does not fit into the terminal's 4 kB is lost, as on a real one; `Wear` loses, cuts and delays more.

As a program it prints the name of its terminal and runs until it is stopped:
`python tests/hil_board.py [--no-hil] [--no-outputs] [--functions 0] [--loss 0.01] ...`.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import pty
import random
import select
import sys
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))

from hil_autopilot import WiredVehicle, warm
from px4_rules import Rules, taken

from bridge.connection import Connection, Message
from bridge.errors import PeerLost
from bridge.link import Link
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.parameters import ParameterSpec, ParameterTable, to_raw
from sitl.profile import get_profile
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import VehicleModel, resolve_vehicle

OUTPUT_US = 5_000
HIL, ARMED = 32, 128
_DISARMED_MODE = 53
_LONGEST_DT_S = 0.1
_OUTPUTS = 16


Now = Callable[[], int]
"""A clock, us."""


def wall_us() -> int:
    return time.monotonic_ns() // 1000


@dataclass
class Wear:
    """What a bad line does, each way.

    Attributes:
        loss: share of pieces of which some bytes are missing. cut: share that come in two, the rest with the next.
        delay_s: how late everything from the board is, s. rng: the only chance.
    """

    loss: float = 0.0
    cut: float = 0.0
    delay_s: float = 0.0
    rng: random.Random = field(default_factory=lambda: random.Random(1))
    lost: int = 0

    def worn(self, data: bytes) -> list[bytes]:
        if data and self.rng.random() < self.loss:
            start = self.rng.randrange(len(data))
            end = min(len(data), start + self.rng.randint(1, 40))
            self.lost += end - start
            data = data[:start] + data[end:]
        if len(data) > 1 and self.rng.random() < self.cut:
            at = self.rng.randrange(1, len(data))
            return [data[:at], data[at:]]
        return [data] if data else []


class PtyLink(Link):
    """The board's end of a pseudo-terminal; `path` is the other."""

    datagram = False

    def __init__(self, wear: Wear | None = None, now_us: Now = wall_us) -> None:
        super().__init__("pty")
        self.wear = wear or Wear()
        self._now_us = now_us
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._in: deque[bytes] = deque()
        self._out: deque[tuple[int, bytes]] = deque()

    def send(self, data: bytes) -> None:
        due = self._now_us() + round(self.wear.delay_s * 1e6)
        self._out.extend((due, piece) for piece in self.wear.worn(data))
        self.flush()

    def flush(self) -> None:
        """Write what is due."""
        now = self._now_us()
        while self._out and self._out[0][0] <= now:
            piece = self._out.popleft()[1]
            try:
                written = os.write(self._master, piece)
            except BlockingIOError:
                written = 0
            except OSError as error:
                raise PeerLost(self.name, str(error)) from None
            if written < len(piece):
                self.dropped += 1

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        self.flush()
        if select.select([self._master], [], [], timeout_s)[0]:
            with contextlib.suppress(OSError):
                self._in.extend(self.wear.worn(os.read(self._master, 4096)))
        return self._in.popleft() if self._in else None

    def wait(self, timeout_s: float) -> None:
        """Until there is something to read."""
        if not self._in:
            select.select([self._master], [], [], max(0.0, timeout_s))

    def close(self) -> None:
        """Also what happens when the cable is pulled."""
        if self._master >= 0:
            os.close(self._slave)
            os.close(self._master)
            self._master = -1


class BoardTable(ParameterTable):
    """The parameters of a board: it has HIL_ACT_FUNCn, if its firmware can put out anything."""

    def __init__(self, model: VehicleModel, *, outputs: bool) -> None:
        super().__init__(airframe_parameters(model, get_profile("sitl")))
        added = [ParameterSpec(f"HIL_ACT_FUNC{n}", "INT32", 0) for n in range(1, 1 + _OUTPUTS * outputs)]
        self._specs = {spec.name: spec for spec in sorted([*self._specs.values(), *added], key=lambda one: one.name)}
        self.names = tuple(self._specs)
        self._index = {name: index for index, name in enumerate(self.names)}
        for spec in added:
            self._values[spec.name] = 0
            self._raws[spec.name] = self._initial[spec.name] = to_raw(spec.name, "INT32", 0)


class BoardLine(ServerLink):
    """Its line: HEARTBEAT says that it flies a simulation."""

    hil = True

    def send(self, name: str, fields: Any) -> None:
        if name == "HEARTBEAT" and self.hil:
            fields = {**fields, "base_mode": fields["base_mode"] | HIL}
        super().send(name, fields)


class Board:
    """In a thread of its own; a context manager.

    Args:
        vehicle: whose rotors. hil: SYS_HITL is 1. outputs: the firmware has pwm_out_sim. functions: outputs assigned
            to motors. calibrated: its calibration belongs to the simulated sensors. sysid: MAVLink system.
        wear: of the line. now_us: its clock.

    Attributes:
        path: the terminal's other end. vehicle, server, table, link: the moving parts. rules: what it was sent against
            them. samples: HIL_SENSORs taken. worst_gap_s: between two of them. silent: says no more, as one that hangs.
    """

    def __init__(
        self,
        *,
        vehicle: str = "ant-x",
        hil: bool = True,
        outputs: bool = True,
        functions: int = _OUTPUTS,
        calibrated: bool = True,
        sysid: int = 1,
        wear: Wear | None = None,
        now_us: Now = wall_us,
    ) -> None:
        warm()
        model = resolve_vehicle(vehicle)
        self.table = BoardTable(model, outputs=outputs)
        self.table.set("SYS_HITL", int(hil))
        motors = len(model.airframe.rotors)
        for n in range(1, 1 + min(functions, motors) * outputs):
            self.table.set(f"HIL_ACT_FUNC{n}", 100 + n)
        if not calibrated:
            for name in ("CAL_ACC0_ID", "CAL_GYRO0_ID", "CAL_MAG0_ID"):
                self.table.set(name, 0)
        gains = model.airframe.flight_gains
        if gains is not None:
            # PX4's own leave no room for what a serial line adds to the loop
            for axis in ("ROLL", "PITCH"):
                self.table.set(f"MC_{axis}_P", gains.k_phi)
                for suffix, value in (("P", gains.kp), ("I", gains.ki), ("D", gains.kd)):
                    self.table.set(f"MC_{axis}RATE_{suffix}", value)
        self.calibrated = calibrated
        self.hil, self.outputs = hil, outputs
        self.link = PtyLink(wear, now_us)
        self.path = self.link.path
        self.vehicle = WiredVehicle(model, get_profile("sitl"), parameters=self.table)
        self._line = BoardLine(self.link, Connection(sysid, 1), 0, "gcs")
        self._line.hil = hil
        self.server = VehicleServer(self.vehicle, [self._line], strict=True)
        handlers = {"HIL_SENSOR": self._sensor, "HIL_GPS": self._gps, "HIL_STATE_QUATERNION": self._truth}
        self.server._handlers.update(handlers)
        self.rules = Rules()
        self.samples = 0
        self.worst_gap_s = 0.0
        self.silent = False
        self.error: BaseException | None = None
        self._fresh = 0
        self._arrived_us = 0
        self._clock_us = now_us
        self._boot_us = now_us() - 100_000
        self._next_us = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="board", daemon=True)

    @property
    def armed(self) -> bool:
        return self.vehicle.autopilot.armed

    @property
    def url(self) -> str:
        return f"serial://{self.path}:921600"

    def reboot(self) -> None:
        """Its clock begins anew, nothing else."""
        self._boot_us = self._clock_us()
        self._arrived_us = self._next_us = 0

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(10.0)
        assert not self._thread.is_alive()
        self.server.close()
        self.link.close()
        if self.error is not None:
            raise self.error

    # -- its thread --------------------------------------------------------------------------------------------

    def _now_us(self) -> int:
        return self._clock_us() - self._boot_us

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                due_s = (self._next_us - self._now_us()) * 1e-6 if self.samples else 0.004
                self.link.wait(min(0.004, due_s))
                if self.silent:
                    time.sleep(0.002)
                self.turn()
        except PeerLost:
            pass
        except BaseException as error:
            self.error = error

    def turn(self) -> None:
        """Take what has come, fly on it, say what is due; for a test that has no threads."""
        if self.silent:
            self.link.recv()
            return
        self.vehicle.now_us = self._now_us()
        self._fresh = 0
        self.server.listen()
        for _ in range(self._fresh):
            self.server.advance()
        if not self._fresh:
            self.server.speak()
        if not self.calibrated:
            self.vehicle.autopilot.healthy = False
        now_us = self.vehicle.now_us
        if self.hil and self.outputs and self.samples and now_us >= self._next_us:
            self._next_us = max(self._next_us + OUTPUT_US, now_us)
            self._put_out(now_us)

    def _put_out(self, now_us: int) -> None:
        controls = [0.0] * _OUTPUTS
        for n, motor in enumerate(self.vehicle.outputs):
            function = self.table.get(f"HIL_ACT_FUNC{n + 1}")
            if self.armed and function == 101 + n:
                controls[n] = motor
        mode = _DISARMED_MODE | ARMED * self.armed
        self._line.send("HIL_ACTUATOR_CONTROLS", {"time_usec": now_us, "controls": controls, "mode": mode, "flags": 0})

    def _sensor(self, link: ServerLink, message: Message) -> None:
        if not self.hil:
            return
        sample = taken(message)
        # a board stamps a sample when it comes
        arrived_us = self._now_us()
        dt_s = (arrived_us - self._arrived_us) * 1e-6 if self._arrived_us else 0.004
        self._arrived_us = arrived_us
        self.worst_gap_s = max(self.worst_gap_s, dt_s)
        self.rules.sensor(message, sample)
        self.samples += 1
        self._fresh += 1
        self.vehicle.take(sample, min(dt_s, _LONGEST_DT_S))

    def _gps(self, link: ServerLink, message: Message) -> None:
        if self.hil:
            self.rules.gps(message)
            self.vehicle.take_fix(message)

    def _truth(self, link: ServerLink, message: Message) -> None:
        self.rules.problem("HIL_STATE_QUATERNION to a board: every later acceleration is spoilt")

    def tilt_error_deg(self, truth: Any) -> float:
        """Between what it believes and the truth, deg."""
        ours, true = self.vehicle.estimate.euler(), truth.euler()
        return math.degrees(math.hypot(ours[0] - true[0], ours[1] - true[1]))


class Bench(Link):
    """Our end of a board's line, where board and wall clock advance when somebody listens: no threads, no waiting.

    Args:
        board: made with `now_us=bench_clock.now_us`. inner: the link to its terminal. clock: of both.
    """

    datagram = False

    def __init__(self, board: Board, inner: Link, clock: BenchClock) -> None:
        super().__init__(inner.name)
        self.board, self.inner, self.clock = board, inner, clock

    def send(self, data: bytes) -> None:
        self.inner.send(data)

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        end_us = self.clock.now_us() + round(timeout_s * 1e6)
        while True:
            self.board.turn()
            data = self.inner.recv()
            left_us = end_us - self.clock.now_us()
            if data is not None or left_us <= 0:
                return data
            self.clock.pass_us(min(left_us, 1000))

    def close(self) -> None:
        self.inner.close()


class BenchClock:
    """A wall clock that stands until it is told to go on."""

    def __init__(self) -> None:
        self._us = 10_000_000

    def now_us(self) -> int:
        return self._us

    def pass_us(self, us: int) -> None:
        self._us += us

    def sleep_until_us(self, time_us: int) -> int:
        self._us = max(self._us, time_us)
        return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run one until it is stopped."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--vehicle", default="ant-x")
    parser.add_argument("--no-hil", action="store_true", help="SYS_HITL is 0")
    parser.add_argument("--no-outputs", action="store_true", help="firmware without pwm_out_sim")
    parser.add_argument("--functions", type=int, default=_OUTPUTS, help="outputs that are assigned to motors")
    parser.add_argument("--not-calibrated", action="store_true")
    parser.add_argument("--sysid", type=int, default=1)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--cut", type=float, default=0.0)
    parser.add_argument("--delay", type=float, default=0.0, help="s")
    args = parser.parse_args(words)
    board = Board(
        vehicle=args.vehicle,
        hil=not args.no_hil,
        outputs=not args.no_outputs,
        functions=args.functions,
        calibrated=not args.not_calibrated,
        sysid=args.sysid,
        wear=Wear(args.loss, args.cut, args.delay),
    )
    with board:
        sys.stdout.write(board.path + "\n")
        sys.stdout.flush()
        with contextlib.suppress(KeyboardInterrupt):
            while board.error is None:
                time.sleep(0.1)
    return 1 if board.rules.problems else 0


if __name__ == "__main__":
    raise SystemExit(main())
