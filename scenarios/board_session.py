"""A board on our plant, for a whole run: the process that keeps its time, and what the flight sees of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Self

from bridge.clock import WallClock
from bridge.drive import NetworkDrive
from bridge.errors import PeerLost
from bridge.link import Link
from bridge.realtime import RealTimeReport
from bridge.udp_link import UdpLink
from scenarios.board_process import (
    ANSWERS,
    BLOCK,
    HEARD,
    HIL,
    MOTORS,
    OFFSET_US,
    RING_TICKS,
    TICKS,
    BoardPlant,
    block_array,
    serve,
)
from scenarios.sampler import Truth
from sitl.body import Body
from sitl.errors import LinkError, UsageError
from sitl.profile import Profile
from sitl.vehicle_spec import VehicleModel

GROUNDS = ("udpout://127.0.0.1:14550?local=18570", "udpout://127.0.0.1:14540?local=14580")
"""Where ground stations and programs look for a PX4."""

_READY_S = 60.0
_STOP_S = 2.0
_REPORT_S = 0.5
_NEAR_US = 6_000
"""A tick further than this from a time is not the tick of that time."""

_SEARCHED_TICKS = 500


class BoardSession:
    """Plant and links of a run with a board; a context manager.

    Args:
        url: the board's serial port. model, profile, seed: the plant.
        grounds: links of ground stations that its MAVLink is passed on to. may_arm: they, and the flight, may arm.
        say: called with a line for people.

    Attributes:
        link: the client's. drive: the client's time. body: none in this process.

    Raises:
        UsageError, LinkError: the port cannot be opened, or the profile not be flown.
    """

    board = True
    body: Body | None = None

    def __init__(
        self,
        url: str,
        model: VehicleModel,
        profile: Profile,
        *,
        seed: int = 0,
        grounds: tuple[str, ...] = GROUNDS,
        may_arm: bool = False,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        Body(model, profile, seed=seed)  # what cannot be flown is said here, and compiled here
        self._say = say
        self._clock = WallClock()
        self._report = RealTimeReport()
        self._ended = ""
        self._left = False
        own = UdpLink.listen("127.0.0.1", 0)
        self.link: Link = own
        self.drive = BoardDrive(self)
        context = get_context("spawn")
        raw = context.RawArray("d", BLOCK)
        self._block = block_array(raw)
        self._pipe, far = context.Pipe()
        plant = BoardPlant(url, model, profile, seed, own.port, grounds, may_arm)
        self._process = context.Process(target=serve, args=(plant, raw, far), daemon=True, name="froude plant")
        self._process.start()
        far.close()
        try:
            self._await_ready()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop the plant; a board that is armed is disarmed."""
        try:
            self._pipe.send("stop")
            self._process.join(_STOP_S)
        except OSError:
            pass
        if self._process.is_alive():
            self._process.kill()
            self._process.join(_STOP_S)
        self._pipe.close()
        self.link.close()

    # -- what a flight asks ------------------------------------------------------------------------------------

    @property
    def faults(self) -> tuple[str, ...]:
        """What makes this flight worthless."""
        self.drain()
        return tuple(self._fresh_report().faults)

    @property
    def answers(self) -> int:
        """Motor commands that came since `begin`."""
        return int(self._block[0, ANSWERS])

    @property
    def hil_enabled(self) -> bool | None:
        """The board's HEARTBEAT carries the HIL flag; None before the first."""
        flag = self._block[0, HIL]
        return None if flag < 0.0 else bool(flag)

    @property
    def heard(self) -> bool:
        """Anything has come from the board."""
        return bool(self._block[0, HEARD] > 0.0)

    @property
    def motors(self) -> tuple[float, ...]:
        """The latest motor commands."""
        if not self.answers:
            return ()
        latest = int(self._block[0, TICKS])
        return tuple(self._block[1 + latest % RING_TICKS, 8 : 8 + MOTORS].tolist())

    def begin(self) -> None:
        """Another flight begins."""
        self._send("begin")

    def summary(self) -> str:
        """How steady board and plant were."""
        return self._fresh_report().summary()

    def truth_at(self, time_ms: int) -> Truth | None:
        """What the plant did at a time of the board's clock; None if the two clocks could not be compared."""
        state = self._block[0]
        if math.isnan(state[OFFSET_US]):
            return None
        wall_us = time_ms * 1000 - state[OFFSET_US]
        latest = int(state[TICKS])
        for tick in range(latest, max(0, latest - _SEARCHED_TICKS), -1):
            row = self._block[1 + tick % RING_TICKS]
            if row[0] <= wall_us + _NEAR_US / 3:
                if abs(row[0] - wall_us) > _NEAR_US:
                    return None
                values = row.tolist()
                w, x, y, z = values[1:5]
                p, q, r = values[5:8]
                return Truth((w, x, y, z), (p, q, r), tuple(values[8:]))
        return None

    # -- the process -------------------------------------------------------------------------------------------

    def check(self) -> None:
        """Raise PeerLost if the plant has stopped, with its reason."""
        self.drain()
        if self._ended:
            raise PeerLost("the board", self._ended)

    def drain(self) -> None:
        """Take what the process has said."""
        try:
            while not self._left and self._pipe.poll():
                self._take(self._pipe.recv())
        except (EOFError, OSError):
            self._left = True
            self._ended = self._ended or "the process that simulates its sensors has ended"

    def _take(self, said: tuple[Any, ...]) -> None:
        kind, *rest = said
        if kind == "say":
            self._say(rest[0])
        elif kind == "report":
            self._report = rest[0]
        elif kind == "ended":
            self._ended = rest[0]
        elif kind == "failed":
            status, text = rest
            raise UsageError(text) if status == UsageError.exit_status else LinkError(text)

    def _await_ready(self) -> None:
        if not self._pipe.poll(_READY_S):
            raise LinkError("the process that simulates the board's sensors does not start")
        try:
            self._take(self._pipe.recv())
        except EOFError:
            raise LinkError("the process that simulates the board's sensors ended at once") from None

    def _send(self, what: str) -> None:
        try:
            self._pipe.send(what)
        except OSError:
            self._left = True

    def _fresh_report(self) -> RealTimeReport:
        self.drain()
        before = self._report
        if not (self._left or self._ended):
            self._send("report")
            limit_us = self._clock.now_us() + round(_REPORT_S * 1e6)
            while self._report is before and not self._left and self._clock.now_us() < limit_us:
                self._pipe.poll(0.02)
                self.drain()
        return self._report


class BoardDrive(NetworkDrive):
    """A client's time towards a board whose plant may stop.

    Args:
        session: whose plant.
    """

    def __init__(self, session: BoardSession) -> None:
        super().__init__()
        self._session = session

    def wait(self, link: Link, until_us: int) -> bytes | None:
        """Listen, and raise PeerLost when the plant has stopped."""
        self._session.check()
        return super().wait(link, until_us)
