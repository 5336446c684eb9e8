"""A simulated body for an autopilot that flies in wall-clock time: a board on a serial line (PX4's HITL).

A board cannot wait for its simulator. So samples go out at a steady pace, motors are those of the latest
HIL_ACTUATOR_CONTROLS, and how steady it was, both ways, is measured and told with every result. A board whose sensors
pause loses its attitude, so a pause of this computer beyond STOP_GAP_S ends the run instead of spoiling it.

Only one program can hold the port: `bridge.ground_router` passes the board's MAVLink on to ground stations.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import median

from bridge.clock import Clock, WallClock
from bridge.connection import Message
from bridge.errors import BoardStopped
from bridge.ground_router import GroundRouter
from bridge.link import Link
from bridge.simulator import Actuators, Simulator

STOP_GAP_S = 0.2
"""Longest pause between two samples that a flight survives."""

SILENT_S = 0.5
"""Without motor commands for so long an armed board no longer flies: motors stand."""

RESTART_US = 1_000_000
"""A board's clock that jumps by more has begun anew."""

TIMESYNC_US = 500_000
HEARTBEAT_US = 1_000_000
_ROUND_TRIPS_KEPT = 256
_BASE_MODE_HIL, _BASE_MODE_ARMED = 32, 128
_FORCED_DISARM = 21196.0
_PX4 = 12


@dataclass
class RealTimeReport:
    """How steady the two sides were.

    Attributes:
        ticks: of the plant. sent: samples; fewer than ticks where this computer paused and the plant caught up.
        answers: HIL_ACTUATOR_CONTROLS that came.
        duration_s: wall-clock time from the first sample to the last, s.
        worst_gap_s: longest time between two samples, s. worst_answer_gap_s: between two motor commands, s.
        round_trips_s: TIMESYNC sent to answer heard, the latest few hundred, s.
        preferred: the operating system runs this process before others (`be_prompt`).
        restarts: times the board went away.
        faults: what makes the flight worthless, in order.
    """

    ticks: int = 0
    sent: int = 0
    answers: int = 0
    duration_s: float = 0.0
    worst_gap_s: float = 0.0
    worst_answer_gap_s: float = 0.0
    round_trips_s: deque[float] = field(default_factory=lambda: deque(maxlen=_ROUND_TRIPS_KEPT))
    preferred: bool = False
    restarts: int = 0
    faults: list[str] = field(default_factory=list)

    @property
    def valid(self) -> bool:
        """Nothing happened that makes the flight worthless."""
        return not self.faults

    @property
    def achieved_rate_hz(self) -> float:
        """Samples per second of wall-clock time; 0 before there are two."""
        return (self.sent - 1) / self.duration_s if self.sent > 1 and self.duration_s > 0.0 else 0.0

    @property
    def answer_rate_hz(self) -> float:
        """Motor commands per second of wall-clock time."""
        return self.answers / self.duration_s if self.duration_s > 0.0 else 0.0

    @property
    def round_trip_s(self) -> float | None:
        """Median of the round trips, s; None if the board answers no TIMESYNC."""
        return median(self.round_trips_s) if self.round_trips_s else None

    @property
    def worst_round_trip_s(self) -> float | None:
        """Longest round trip, s; None if there was none."""
        return max(self.round_trips_s, default=None)

    def fault(self, text: str) -> None:
        """Note once what makes the flight worthless."""
        if text not in self.faults:
            self.faults.append(text)

    def summary(self) -> str:
        """All of it in a line for people."""
        trip = (
            "no answer to TIMESYNC"
            if self.round_trip_s is None or self.worst_round_trip_s is None
            else f"round trip {1e3 * self.round_trip_s:.1f} ms (worst {1e3 * self.worst_round_trip_s:.1f})"
        )
        return (
            f"real time: {self.achieved_rate_hz:.1f} samples/s, worst gap {1e3 * self.worst_gap_s:.1f} ms; "
            f"{self.answer_rate_hz:.1f} motor commands/s, worst gap {1e3 * self.worst_answer_gap_s:.1f} ms; {trip}"
            + ("" if self.preferred else "; ordinary priority")
        )


def be_prompt() -> bool:
    """Ask the operating system to run this process, which mostly sleeps, before ordinary ones; whether it does.

    It takes the right to real-time priority (root, or `ulimit -r`); without it a busy computer shows in the gaps.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (OSError, AttributeError):
        return False
    return True


class RealTime:
    """Steps a body in wall-clock time.

    Args:
        link: the board's; opened by the caller.
        simulator: messages of the body; made without truth, which a board must never be sent.
        router: passes the rest on to ground stations; None: nobody else is served.
        clock: wall clock.
        say: called with a line for people when something happens.
        preferred: what `be_prompt` said, for the report.

    Attributes:
        report: how it went.
        motors: of the latest command.
        armed: as the board's latest HEARTBEAT or motor command says.
        hil_enabled: its HEARTBEAT carries the HIL flag; None before the first.
        heard_us: wall-clock time of the board's latest frame, None before the first.
        offset_us: board's clock minus this computer's, us; None before a TIMESYNC was answered.
    """

    def __init__(
        self,
        link: Link,
        simulator: Simulator,
        *,
        router: GroundRouter | None = None,
        clock: Clock | None = None,
        say: Callable[[str], object] = lambda _: None,
        preferred: bool = False,
    ) -> None:
        self.link = link
        self.simulator = simulator
        self.body = simulator.body
        self.router = router
        self.report = RealTimeReport()
        self.motors: tuple[float, ...] = ()
        self.armed = False
        self.hil_enabled: bool | None = None
        self.heard_us: int | None = None
        self.offset_us: int | None = None
        self._clock: Clock = clock or WallClock()
        self._say = say
        self._said: set[str] = set()
        self._faulted: set[str] = set()
        self._not_numbers = self._outside = 0
        self._preferred = preferred
        self.report.preferred = preferred
        self._began_us = self._next_us = self._sent_us = self._clock.now_us()
        self._answered_us: int | None = None
        self._timesync_us = self._heartbeat_us = 0
        self._least_trip_us: int | None = None

    def begin(self) -> None:
        """Start measuring anew: another flight."""
        self.report = RealTimeReport(preferred=self._preferred)
        self._began_us = self._sent_us = self._clock.now_us()
        self._answered_us = None
        self._faulted = set()
        self._not_numbers, self._outside = self.simulator.not_numbers, self.simulator.outside

    def step(self) -> None:
        """One tick: hear the board until it is due, move the plant, send what it senses.

        Raises:
            BoardStopped: this computer paused for longer than STOP_GAP_S with the board armed.
            PeerLost: the line is dead: unplugged.
        """
        self._next_us += self.body.tick_us
        while (left_us := self._next_us - self._clock.now_us()) > 0:
            self._hear(left_us * 1e-6)
        self._hear(0.0)
        now_us = self._clock.now_us()
        self._watch_gap(now_us)
        self._move(now_us)
        self._speak(now_us)

    def stop(self) -> None:
        """Leave the board in a safe state: without samples it must not stay armed. Errors are of no interest."""
        if not self.armed or not self.simulator.system:
            return
        frame = self.simulator.connection.encode(
            "COMMAND_LONG",
            target_system=self.simulator.system,
            target_component=1,
            command=400,
            param1=0.0,
            param2=_FORCED_DISARM,
        )
        self.link.send(frame)

    # -- one tick ----------------------------------------------------------------------------------------------

    def _hear(self, timeout_s: float) -> None:
        data = self.link.recv(timeout_s)
        if data is not None:
            self.heard_us = self._clock.now_us()
            for message in self.simulator.connection.receive(data):
                actuators = self.simulator.take(message)
                if actuators is not None:
                    self._obey(actuators)
                elif message.sysid == self.simulator.system:
                    self._take(message)
        if self.router is not None:
            for frame in self.router.from_grounds(self._clock.now_us()):
                self.link.send(frame)

    def _obey(self, actuators: Actuators) -> None:
        now_us = self._clock.now_us()
        if self._answered_us is not None:
            self.report.worst_answer_gap_s = max(self.report.worst_answer_gap_s, (now_us - self._answered_us) * 1e-6)
        self._answered_us = now_us
        self.report.answers += 1
        self.motors, self.armed = actuators.motors, actuators.armed
        if self.simulator.not_numbers > self._not_numbers:
            self._fault("a motor command was no number (NaN or infinite), taken for 0")
        if self.simulator.outside > self._outside:
            self._fault("a motor command lay outside -1 to 1, cut")

    def _take(self, message: Message) -> None:
        if message.name == "HEARTBEAT" and message.compid == 1:
            self.armed = bool(message.base_mode & _BASE_MODE_ARMED)
            self.hil_enabled = bool(message.base_mode & _BASE_MODE_HIL)
            if message.autopilot != _PX4:
                self._once(
                    f"the board's HEARTBEAT says autopilot {message.autopilot}, not PX4 (12): its HIL_SENSOR may differ"
                )
        elif message.name == "TIMESYNC" and message.tc1 != 0:
            self._synchronise(message.tc1 // 1000, message.ts1 // 1000)
            return
        if self.router is not None:
            self.router.from_board(message)

    def _synchronise(self, board_us: int, sent_us: int) -> None:
        now_us = self._clock.now_us()
        trip_us = now_us - sent_us
        if not 0 <= trip_us < 10 * TIMESYNC_US:
            return  # the answer to somebody else's question
        self.report.round_trips_s.append(trip_us * 1e-6)
        if self.offset_us is not None and abs(board_us - now_us - self.offset_us) > RESTART_US:
            self._restarted()
        # the quickest answer tells the offset best; it ages, because two quartz clocks drift apart
        aged_us = None if self._least_trip_us is None else self._least_trip_us + 20
        if aged_us is None or trip_us <= aged_us:
            self._least_trip_us = trip_us
            self.offset_us = board_us - (sent_us + trip_us // 2)
        else:
            self._least_trip_us = aged_us

    def _watch_gap(self, now_us: int) -> None:
        if not self.report.sent:
            self._began_us = self._sent_us = now_us
            return
        gap_s = (now_us - self._sent_us) * 1e-6
        self.report.worst_gap_s = max(self.report.worst_gap_s, gap_s)
        if gap_s <= STOP_GAP_S:
            return
        text = f"this computer sent no sample for {1e3 * gap_s:.0f} ms (limit {1e3 * STOP_GAP_S:.0f})"
        if self.armed:
            self._fault(text)
            raise BoardStopped(self.link.name, text)
        self._say(f"{text}; the board is disarmed, going on")
        # that time is not made up for: nobody was flying
        self._next_us = now_us

    def _move(self, now_us: int) -> None:
        silent_s = (now_us - self._answered_us) * 1e-6 if self._answered_us is not None else 0.0
        if self.armed and silent_s > SILENT_S and any(self.motors):
            self.motors = ()
            self._fault(f"the board has sent no motor command for {SILENT_S:g} s: motors stopped")
        while True:
            self.body.step(self.motors)
            self.report.ticks += 1
            if now_us - self._next_us < self.body.tick_us:
                return
            self._next_us += self.body.tick_us

    def _speak(self, now_us: int) -> None:
        self.link.send(self.simulator.frames())
        self.report.sent += 1
        self._sent_us = now_us
        self.report.duration_s = (now_us - self._began_us) * 1e-6
        if now_us >= self._heartbeat_us:
            self._heartbeat_us = now_us + HEARTBEAT_US
            self.link.send(self.simulator.heartbeat())
        if now_us >= self._timesync_us:
            self._timesync_us = now_us + TIMESYNC_US
            self.link.send(self.simulator.connection.encode("TIMESYNC", tc1=0, ts1=self._clock.now_us() * 1000))

    def _restarted(self) -> None:
        self._least_trip_us = self.offset_us = None
        self.report.restarts += 1
        if self.armed:
            self._fault("the board started anew in flight")
        else:
            self._say("the board started anew; the plant is back on the ground")
        self.motors, self.armed = (), False
        self.body.reset()

    # -- what goes wrong ---------------------------------------------------------------------------------------

    def _fault(self, text: str) -> None:
        if text not in self._faulted:
            self._faulted.add(text)
            line = f"{text} (vehicle time {self.body.time_us * 1e-6:.3f} s)"
            self.report.fault(line)
            self._say(line)

    def _once(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(text)
