"""A simulated body and an autopilot that advance in turns: one HIL_SENSOR, one HIL_ACTUATOR_CONTROLS, one tick.

Until the autopilot's first answer there is no lockstep: it is still starting, and samples are sent at the pace of real
time. Afterwards no tick passes without its answer, so a slow computer makes the flight slow and not wrong. Where the
answer does not come, because the autopilot hangs or has stopped its control loop, a limit in wall-clock time ends the
wait: the tick passes without it, which is said, and what was flown then does not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bridge.clock import Clock, WallClock
from bridge.errors import PeerLost
from bridge.link import Link
from bridge.simulator import Actuators, Simulator
from bridge.tcp_link import refuse_others

ANSWER_S = 1.0
"""Wall-clock silence after which a tick passes without its answer."""

NO_MAVLINK_BYTES = 4096
"""Bytes without one frame in them after which the peer is taken for no autopilot."""

_LOOK_STEPS = 50

STALE_US = 2_000_000
"""Vehicle time without an answer after which motors stand still: nobody is flying any more."""


@dataclass
class LockstepReport:
    """How the two kept step.

    Attributes:
        steps: ticks sent. answered: ticks with their own answer.
        late: times the autopilot did not answer within ANSWER_S.
        out_of_step: answers to another tick than the last sent, dropped.
        longest_wait_s: for an answer that came, wall clock.
        restarts: times the autopilot went away.
        faults: what makes the flight worthless, in order, each with its vehicle time.
    """

    steps: int = 0
    answered: int = 0
    late: int = 0
    out_of_step: int = 0
    longest_wait_s: float = 0.0
    restarts: int = 0
    faults: list[str] | None = None

    @property
    def valid(self) -> bool:
        """Every tick since the first answer was answered by a whole autopilot."""
        return not self.faults

    def fault(self, text: str) -> None:
        """Note once what makes the flight worthless."""
        self.faults = self.faults or []
        if text not in self.faults:
            self.faults.append(text)


class Lockstep:
    """Steps a body with an autopilot over a stream link.

    Args:
        link: the autopilot connects to it (`tcpin://`).
        simulator: messages of the body.
        clock: of this computer.
        say: called with a line for people when something happens.
        answer_s: see ANSWER_S.

    Attributes:
        report: how it went.
        locked: the autopilot answers tick by tick.
        armed: as its last answer says.
        motors: of the last answer.
    """

    def __init__(
        self,
        link: Link,
        simulator: Simulator,
        *,
        clock: Clock | None = None,
        say: Callable[[str], object] = lambda _: None,
        answer_s: float = ANSWER_S,
    ) -> None:
        self.link = link
        self.simulator = simulator
        self.body = simulator.body
        self.report = LockstepReport()
        self.locked = False
        self.armed = False
        self.motors: tuple[float, ...] = ()
        self._clock: Clock = clock or WallClock()
        self._say = say
        self._answer_us = round(answer_s * 1e6)
        self._next_us = self._clock.now_us()
        self._answered_us = self.body.time_us
        self._silent_since_us: int | None = None
        self._said: set[str] = set()

    @property
    def connected(self) -> bool:
        """An autopilot is on the link."""
        return bool(getattr(self.link, "connected", True))

    def step(self) -> None:
        """One tick: send what was sensed, wait for the answer, move."""
        if not self.connected:
            self._wait_for_peer()
            return
        try:
            self.link.send(self.simulator.frames())
            self.report.steps += 1
            answer = self._answer() if self.locked else self._first_answer()
        except PeerLost as lost:
            self._lost(lost)
            return
        if answer is not None:
            self.motors, self.armed = answer.motors, answer.armed
            self._answered_us = self.body.time_us
            self.report.answered += 1
        elif self.body.time_us - self._answered_us > STALE_US and any(self.motors):
            self.motors = ()
            self._fault("its last motor commands are 2 s old: motors stopped")
        self._look_at_values()
        if self.report.steps % _LOOK_STEPS == 0 and refuse_others(self.link):
            self._say("a second program connected to the simulator's port: refused, there is one autopilot already")
        self.body.step(self.motors)

    # -- waiting -----------------------------------------------------------------------------------------------

    def _wait_for_peer(self) -> None:
        """Nobody there: no time passes, the link takes whoever comes."""
        self.link.recv(0.05)
        self._next_us = self._clock.now_us()

    def _first_answer(self) -> Actuators | None:
        """Free run: samples at the pace of real time until the control loop runs."""
        self._next_us += self.body.tick_us
        while True:
            left_us = self._next_us - self._clock.now_us()
            answers = self._heard(max(0.0, left_us * 1e-6))
            if answers:
                self.locked = True
                if self._silent_since_us is not None:
                    self._say(f"the autopilot answers again at {self._t()}")
                    self._silent_since_us = None
                return answers[-1]
            if left_us <= 0:
                # a pause of this computer is not caught up: the autopilot has not seen that time either
                self._next_us = max(self._next_us, self._clock.now_us() - self.body.tick_us)
                return None

    def _answer(self) -> Actuators | None:
        """The answer to the sample just sent."""
        began_us = self._clock.now_us()
        limit_us = began_us + self._answer_us
        while True:
            for answer in self._heard(max(0.0, (limit_us - self._clock.now_us()) * 1e-6)):
                if answer.time_us == self.body.time_us or not answer.lockstep:
                    waited_s = (self._clock.now_us() - began_us) * 1e-6
                    self.report.longest_wait_s = max(self.report.longest_wait_s, waited_s)
                    return answer
                self.report.out_of_step += 1
            if self._clock.now_us() >= limit_us:
                self._late()
                return None

    def _heard(self, timeout_s: float) -> list[Actuators]:
        data = self.link.recv(timeout_s)
        if data is None:
            return []
        answers = self.simulator.receive(data)
        self._look_at_peer()
        return answers

    # -- what goes wrong ---------------------------------------------------------------------------------------

    def _late(self) -> None:
        self.report.late += 1
        self.locked = False
        self._silent_since_us = self.body.time_us
        self._next_us = self._clock.now_us()
        what = f"the autopilot has not answered since {self._t()}, for {self._answer_us * 1e-6:g} s of wall clock"
        if self.armed:
            self._fault(f"{what}; ticks pass without it")
        else:
            self._say(f"{what} (disarmed: a mode without set-points does that); ticks pass without it")

    def _lost(self, lost: PeerLost) -> None:
        flying = self.armed
        self.report.restarts += 1
        if flying:
            self._fault(f"the autopilot went away in flight: {lost.why}")
        else:
            self._say(f"the autopilot went away at {self._t()}: {lost.why}; waiting for the next")
        self.locked = self.armed = False
        self.motors = ()
        self._silent_since_us = None
        self.simulator.new_peer()
        self.body.reset()

    def _look_at_peer(self) -> None:
        simulator = self.simulator
        counters = simulator.connection.counters
        if simulator.is_px4 is False:
            self._once("the peer's HEARTBEAT is not PX4's: this is PX4's simulator protocol (ArduPilot: --link json)")
        if counters.bad_bytes > NO_MAVLINK_BYTES and not counters.received:
            self._once("the peer sends no MAVLink: is it PX4's simulator_mavlink that connects here?")

    def _look_at_values(self) -> None:
        if self.simulator.not_numbers:
            self._fault("a motor command was no number (NaN or infinite), taken for 0")
        if self.simulator.outside:
            self._fault("a motor command lay outside -1 to 1, cut")
        if self.simulator.strangers:
            self._once(f"messages of other systems than {self.simulator.system} on the simulator's link are ignored")

    def _fault(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            line = f"{text} (vehicle time {self._t()})"
            self.report.fault(line)
            self._say(line)

    def _once(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(text)

    def _t(self) -> str:
        return f"{self.body.time_us * 1e-6:.3f} s"
