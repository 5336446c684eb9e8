"""The plant of a board, in a process of its own: nothing that a flight's bookkeeping does can delay a sample.

The process and the flight share a block of memory: the plant's latest ticks and a few numbers, written by one side and
read by the other, so that neither ever waits for the other. A pipe carries what is rare: lines for people, the report.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection as Pipe
from typing import Any

import numpy as np
import numpy.typing as npt

from bridge.clock import WallClock
from bridge.errors import BoardStopped, LinkUrlError, PeerLost
from bridge.ground_router import GroundRouter
from bridge.link import Link, open_link
from bridge.realtime import RealTime, be_prompt
from bridge.simulator import Simulator
from sitl.body import Body
from sitl.errors import FroudeError
from sitl.profile import Profile
from sitl.vehicle_spec import VehicleModel

RING_TICKS = 4096
MOTORS = 16
ROW = 1 + 4 + 3 + MOTORS
"""One tick: wall-clock time us, quaternion, rates, motors."""

TICKS, OFFSET_US, ANSWERS, ARMED, HIL, HEARD = range(6)
"""Places of the block's first row; OFFSET_US is NaN while it is not known, HIL -1 before a HEARTBEAT."""

BLOCK = (1 + RING_TICKS) * ROW
LOOK_TICKS = 5


@dataclass(frozen=True)
class BoardPlant:
    """Everything the process needs; plain data.

    Attributes:
        url: the board's serial port. model, profile, seed: the plant. client_port: where the flight's client listens.
        grounds: links of ground stations. may_arm: they may.
    """

    url: str
    model: VehicleModel
    profile: Profile
    seed: int
    client_port: int
    grounds: tuple[str, ...] = ()
    may_arm: bool = False


def block_array(raw: Any) -> npt.NDArray[np.float64]:
    """(1 + RING_TICKS, ROW) view of the shared block."""
    return np.frombuffer(raw, dtype=np.float64).reshape(1 + RING_TICKS, ROW)


def serve(plant: BoardPlant, raw: Any, pipe: Pipe) -> None:
    """The process: open the port, step until told to stop or until the other side is gone.

    Args:
        plant: what to fly. raw: the shared block. pipe: to the flight; ("failed", status, text) and ("ready",) come
            first, then ("say", text), ("report", report) and ("ended", text).
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the flight lands first, and says when
    with ExitStack() as stack, suppress(BrokenPipeError, EOFError):
        try:
            real_time = _open(plant, stack, pipe)
        except FroudeError as error:
            pipe.send(("failed", error.exit_status, str(error)))
            return
        pipe.send(("ready",))
        try:
            _run(real_time, block_array(raw), pipe)
        except (BoardStopped, PeerLost) as stop:
            pipe.send(("ended", stop.why))
        finally:
            with suppress(FroudeError):
                real_time.stop()
            pipe.send(("report", real_time.report))


def _open(plant: BoardPlant, stack: ExitStack, pipe: Pipe) -> RealTime:
    def say(text: str) -> None:
        pipe.send(("say", text))

    body = Body(plant.model, plant.profile, seed=plant.seed)
    link = stack.enter_context(open_link(plant.url))
    grounds: list[Link] = [stack.enter_context(open_link(f"udpout://127.0.0.1:{plant.client_port}"))]
    grounds += [stack.enter_context(ground) for ground in open_grounds(plant.grounds)]
    # the flight's own client asked the user already
    router = GroundRouter(grounds, may_arm=plant.may_arm, say=say)
    return RealTime(link, Simulator(body, truth=False), router=router, say=say, preferred=be_prompt())


def open_grounds(urls: Sequence[str]) -> list[Link]:
    """Links to ground stations; PX4's local ports where they are free, any otherwise.

    Args:
        urls: of `bridge.link`.

    Raises:
        LinkUrlError: one that cannot be read.
    """
    links = []
    for url in urls:
        try:
            links.append(open_link(url))
        except LinkUrlError:
            raise
        except FroudeError:
            links.append(open_link(url.partition("?")[0]))
    return links


def _run(real_time: RealTime, block: npt.NDArray[np.float64], pipe: Pipe) -> None:
    clock = WallClock()
    body, state = real_time.body, block[0]
    state[OFFSET_US], state[HIL] = math.nan, -1.0
    while True:
        real_time.step()
        row = block[1 + body.tick % RING_TICKS]
        row[0] = clock.now_us()
        row[1:5] = body.truth.quat()
        row[5:8] = body.truth.rates()
        count = len(real_time.motors)
        row[8 : 8 + count] = real_time.motors
        row[8 + count :] = 0.0
        state[ANSWERS] = real_time.report.answers
        state[ARMED] = real_time.armed
        state[HIL] = -1.0 if real_time.hil_enabled is None else real_time.hil_enabled
        state[HEARD] = -1.0 if real_time.heard_us is None else real_time.heard_us
        state[OFFSET_US] = math.nan if real_time.offset_us is None else real_time.offset_us
        state[TICKS] = body.tick  # last: what it points to is complete
        if body.tick % LOOK_TICKS == 0 and pipe.poll() and not _asked(real_time, pipe):
            return


def _asked(real_time: RealTime, pipe: Pipe) -> bool:
    """Do what the flight asks; False when it is over."""
    what = pipe.recv()
    if what == "begin":
        real_time.begin()
    elif what == "report":
        pipe.send(("report", real_time.report))
    return bool(what != "stop")
