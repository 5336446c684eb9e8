"""Serving the plant: the loop of `froude hil`, in lockstep or in real time, until somebody stops it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any

from bridge.client import Client
from bridge.clock import Clock, ScaledClock, WallClock
from bridge.errors import BoardStopped, PeerLost
from bridge.fleet import stop_on_signals
from bridge.ground_router import GroundRouter
from bridge.hil_drive import HilDrive
from bridge.link import Link, open_link
from bridge.lockstep import Lockstep
from bridge.realtime import RealTime, RealTimeReport, be_prompt
from bridge.simulator import Simulator
from scenarios.board_process import open_grounds
from scenarios.board_session import GROUNDS
from scenarios.hil_session import geometry_parameters
from scenarios.status_line import StatusLine
from sitl.body import Body
from sitl.errors import FroudeError, UsageError
from sitl.profile import Profile
from sitl.rotation import to_euler
from sitl.sensors import ORIGIN
from sitl.vehicle_spec import VehicleModel

_STATUS_US = 1_000_000
_CONNECT_S = 10.0
_LOOK_AGAIN_US = 500_000
_LOOK_STEPS = 25

Tell = Callable[[str], object]


@dataclass(frozen=True)
class Serving:
    """What is served.

    Attributes:
        link: URL of the autopilot. model, profile, seed: the plant.
        speed: vehicle seconds per second at most, None for as fast as the autopilot; a board's is 1.
        seconds: of vehicle time after which it stops; None: never.
        home: latitude and longitude in deg, height above mean sea level in m.
        setup: MAVLink link on which the airframe's rotors are written into a PX4 SITL first; empty: they are not.
        grounds: URLs that a board's MAVLink goes to; None: where a PX4's goes. may_arm: they may arm it.
        status: a status line every second even where there is no terminal.
    """

    link: str
    model: VehicleModel
    profile: Profile
    seed: int
    speed: float | None = None
    seconds: float | None = None
    home: tuple[float, float, float] = ORIGIN
    setup: str = ""
    grounds: tuple[str, ...] | None = None
    may_arm: bool = False
    status: bool = False


def serve(what: Serving, tell: Tell) -> dict[str, Any]:
    """Step the plant until stopped.

    Args:
        what: to serve. tell: prints a line for people.

    Returns:
        the report: how it went, `faults`, and `stopped`: why it ended by itself, empty if it did not.

    Raises:
        UsageError: a link that no autopilot can be on. LinkError: a port that is taken.
    """
    screen = StatusLine(always=what.status, tell=tell)
    if what.link.startswith("serial"):
        return _serve_board(what, screen)
    if what.link.startswith("tcpin"):
        return _serve_lockstep(what, screen)
    if what.link.startswith("json"):
        from scenarios.hil_json import serve_json

        return serve_json(what, screen)
    raise UsageError(
        f"--link {what.link}: PX4 SITL connects over TCP (tcpin://127.0.0.1:4560), a board is on a serial port "
        "(serial:///dev/ttyACM0:921600), ArduPilot speaks JSON over UDP (json://127.0.0.1:9002)"
    )


# -- lockstep --------------------------------------------------------------------------------------------------


def _serve_lockstep(what: Serving, screen: StatusLine) -> dict[str, Any]:
    body = Body(what.model, what.profile, seed=what.seed, home=what.home)
    with open_link(what.link) as link, stop_on_signals() as stop:
        if link.exposed is not None:
            screen.tell(f"open to other computers at {link.exposed[0]}:{link.exposed[1]}: whoever connects first flies")
        lockstep = Lockstep(link, Simulator(body, truth=True), say=screen.tell)
        screen.tell(
            f"{what.model.name} waits for a PX4 at {link.name} (start it with PX4_SIM_MODEL=none_iris); "
            + ("" if what.setup else "its rotors are not PX4's default: --setup or froude fly writes them. ")
            + "Ctrl-C stops."
        )
        pace, setup = _Pace(body, what.speed), what.setup
        began_us, clock = body.time_us, WallClock()
        wall_us, status = clock.now_us(), _Every(_STATUS_US, clock)
        while not stop() and not _over(what, body.time_us - began_us):
            lockstep.step()
            if setup and lockstep.locked:
                _set_up(what, lockstep, screen)
                setup = ""
            if lockstep.locked:
                pace.keep()
            else:
                pace.anew()
            if screen.shows and lockstep.report.steps % _LOOK_STEPS == 0 and status.due():
                screen.show(_lockstep_line(lockstep))
        report = lockstep.report
        vehicle_s, wall_s = (body.time_us - began_us) * 1e-6, (clock.now_us() - wall_us) * 1e-6
    screen.tell(
        f"{vehicle_s:.1f} s of vehicle time: {report.answered} of {report.steps} ticks answered, {report.late} late, "
        f"longest wait {1e3 * report.longest_wait_s:.0f} ms"
        + (f"; INVALID: {report.faults[0]}" if report.faults else "")
    )
    return {
        "mode": "lockstep",
        "vehicle": what.model.spec,
        "vehicle_time_s": vehicle_s,
        "wall_time_s": wall_s,
        "ticks": report.steps,
        "answered": report.answered,
        "late": report.late,
        "out_of_step": report.out_of_step,
        "longest_wait_s": report.longest_wait_s,
        "restarts": report.restarts,
        "faults": list(report.faults or ()),
        "stopped": "",
    }


def _set_up(what: Serving, lockstep: Lockstep, screen: StatusLine) -> None:
    """Write the airframe's rotors while the plant goes on: a PX4 whose simulator leaves does not come back.

    Raises:
        LinkError: they are not in the autopilot.
    """
    with open_link(what.setup) as link:
        client = Client(link, HilDrive(lockstep))
        client.connect(_CONNECT_S)
        values = geometry_parameters(what.model)
        client.upload(values)
    screen.tell(f"{len(values)} parameters of {what.model.airframe.name}'s rotors written and read back")


def _lockstep_line(lockstep: Lockstep) -> str:
    peer = "locked" if lockstep.locked else "free running" if lockstep.connected else "nobody there"
    return f"{_where(lockstep.body)}  {peer}  {'ARMED' if lockstep.armed else 'disarmed'}  late {lockstep.report.late}"


class _Pace:
    """Holds a lockstep back to a speed.

    Args:
        body: whose time. speed: None lets it run.
    """

    def __init__(self, body: Body, speed: float | None) -> None:
        self._body = body
        self._speed = speed
        self._clock: Clock = WallClock() if speed is None else ScaledClock(speed)
        self.anew()

    def anew(self) -> None:
        """Time has passed at a pace of its own: count from here."""
        self._offset_us = self._clock.now_us() - self._body.time_us

    def keep(self) -> None:
        """Wait until this tick is due; what was late is not caught up."""
        if self._speed is not None and self._clock.sleep_until_us(self._body.time_us + self._offset_us) > 0:
            self.anew()


# -- boards ----------------------------------------------------------------------------------------------------


def _serve_board(what: Serving, screen: StatusLine) -> dict[str, Any]:
    if what.speed not in (None, 1.0):
        raise UsageError(f"--speed {what.speed:g}: a board flies in real time; leave it out")
    grounds = open_grounds(GROUNDS if what.grounds is None else what.grounds)
    with ExitStack() as stack, stop_on_signals() as stop:
        for ground in grounds:
            stack.enter_context(ground)
        return _Board(what, screen, grounds, stop).run()


class _Board:
    """A board's plant, through every restart of the board."""

    def __init__(self, what: Serving, screen: StatusLine, grounds: Sequence[Link], stop: Callable[[], bool]) -> None:
        self._what = what
        self._screen = screen
        self._stop = stop
        self._grounds = grounds
        self._clock = WallClock()
        self._body = Body(what.model, what.profile, seed=what.seed, home=what.home)
        self._began_us = self._body.time_us
        self._router = GroundRouter(grounds, may_arm=what.may_arm, say=screen.tell)
        self._status = _Every(_STATUS_US, self._clock)
        self._report = RealTimeReport()
        self._preferred = be_prompt()
        self._stopped = ""

    def run(self) -> dict[str, Any]:
        """Serve until told to stop; the report."""
        link: Link | None = open_link(self._what.link)
        while not self._over():
            if link is not None:
                with link:
                    self._serve(link)
            if self._stopped:
                break
            link = None if self._over() else self._opened_again()
        self._screen.tell(self._report.summary())
        return self._as_dict()

    def _over(self) -> bool:
        return self._stop() or _over(self._what, self._body.time_us - self._began_us)

    def _serve(self, link: Link) -> None:
        """While the board is there."""
        screen, names = self._screen, ", ".join(ground.name for ground in self._grounds)
        screen.tell(
            f"{self._what.model.name} for the board at {link.name}; MAVLink for {names or 'nobody'}. Ctrl-C stops."
        )
        simulator = Simulator(self._body, truth=False)
        real_time = RealTime(
            link, simulator, router=self._router, clock=self._clock, say=screen.tell, preferred=self._preferred
        )
        real_time.report.faults += self._report.faults
        real_time.report.restarts = self._report.restarts
        self._report = report = real_time.report
        try:
            while not self._over():
                real_time.step()
                if screen.shows and report.ticks % _LOOK_STEPS == 0 and self._status.due():
                    screen.show(_board_line(real_time))
        except PeerLost as lost:
            report.restarts += 1
            if real_time.armed:
                report.fault(f"the board went away in flight: {lost.why}")
            screen.tell(f"the board went away: {lost.why}; waiting for it to come back")
            self._body.reset()
        except BoardStopped as late:
            self._stopped = str(late)
            screen.tell(self._stopped)
        finally:
            with suppress(FroudeError):
                real_time.stop()

    def _opened_again(self) -> Link | None:
        """The port, once the board is back; a board that restarts takes its port away."""
        self._clock.sleep_until_us(self._clock.now_us() + _LOOK_AGAIN_US)
        with suppress(FroudeError):
            return open_link(self._what.link)
        return None

    def _as_dict(self) -> dict[str, Any]:
        report = self._report
        return {
            "mode": "real time",
            "vehicle": self._what.model.spec,
            "vehicle_time_s": (self._body.time_us - self._began_us) * 1e-6,
            "samples": report.sent,
            "achieved_rate_hz": report.achieved_rate_hz,
            "worst_gap_s": report.worst_gap_s,
            "answers": report.answers,
            "answer_rate_hz": report.answer_rate_hz,
            "worst_answer_gap_s": report.worst_answer_gap_s,
            "round_trip_s": report.round_trip_s,
            "worst_round_trip_s": report.worst_round_trip_s,
            "restarts": report.restarts,
            "arming_refused": self._router.refused_arming,
            "ground_bytes_dropped": self._router.dropped_bytes,
            "faults": list(report.faults),
            "stopped": self._stopped,
        }


def _board_line(real_time: RealTime) -> str:
    report = real_time.report
    trip = f"{1e3 * report.round_trip_s:.1f} ms" if report.round_trip_s is not None else "-"
    return (
        f"{_where(real_time.body)}  {report.achieved_rate_hz:.1f} Hz, worst gap {1e3 * report.worst_gap_s:.0f} ms, "
        f"motors {report.answer_rate_hz:.0f} Hz, round trip {trip}  {'ARMED' if real_time.armed else 'disarmed'}"
    )


# -- for people ------------------------------------------------------------------------------------------------


def _over(what: Serving, served_us: int) -> bool:
    return what.seconds is not None and served_us >= what.seconds * 1e6


def _where(body: Body) -> str:
    phi, theta, _ = to_euler(body.truth.quat())
    height = -body.truth.position_ned()[2]
    return (
        f"{body.time_us * 1e-6:8.1f} s  {height:6.1f} m  roll {math.degrees(phi):6.1f} pitch {math.degrees(theta):6.1f}"
    )


class _Every:
    """Says once a while that something is due.

    Args:
        period_us: of the clock.
    """

    def __init__(self, period_us: int, clock: Clock) -> None:
        self._period_us = period_us
        self._clock = clock
        self._due_us = clock.now_us()

    def due(self) -> bool:
        """Whether it is."""
        now_us = self._clock.now_us()
        if now_us < self._due_us:
            return False
        self._due_us = now_us + self._period_us
        return True
