"""A simulated body and an autopilot that advance in turns: one HIL_SENSOR, one HIL_ACTUATOR_CONTROLS, one tick.

Until the autopilot's first answer there is no lockstep: it is still starting, and samples are sent at the pace of real
time. Afterwards no tick passes without its answer, so a slow computer makes the flight slow and not wrong. Where the
answer does not come, because the autopilot hangs or has stopped its control loop, a limit in wall-clock time ends the
wait: the tick passes without it, which is said, and what was flown then does not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from bridge.clock import Clock, WallClock
from bridge.errors import PeerLost
from bridge.link import Link
from bridge.simulator import Actuators, Simulator
from bridge.tcp_link import refuse_others, turn_out

ANSWER_S = 1.0
"""Wall-clock silence after which a tick passes without its answer."""

NO_MAVLINK_BYTES = 32
"""Bytes without one frame in them after which the peer is taken for no autopilot: nothing is lost on TCP."""

UNKNOWN_US = 5_000_000
"""Vehicle time that somebody may be on the port without saying that he is an autopilot: a PX4 says so at once."""

_LOOK_STEPS = 50
_SLICE_S, _SLICE_US = 0.05, 100_000
"""A wait is looked at so often; a look counts so much at most: a pause of this computer is no silence of the other."""

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
    faults: list[str] = field(default_factory=list)

    @property
    def valid(self) -> bool:
        """Every tick since the first answer was answered by a whole autopilot."""
        return not self.faults

    def fault(self, text: str, when: str) -> bool:
        """Note once what makes the flight worthless; whether it is new.

        Args:
            text: what. when: its vehicle time.
        """
        if any(fault.startswith(text) for fault in self.faults):
            return False
        self.faults.append(f"{text} ({when})")
        return True


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
        self._answered_us = self._came_us = self.body.time_us
        self._silent_since_us: int | None = None
        self._said: set[str] = set()
        self._odd_values = (0, 0)
        self._locked_us = 0

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
            # done while the autopilot works
            if self.report.steps % _LOOK_STEPS == 0:
                self._look_at_port()
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
        self.body.step(self.motors)

    # -- waiting -----------------------------------------------------------------------------------------------

    def _wait_for_peer(self) -> None:
        """Nobody there: no time passes, the link takes whoever comes."""
        try:
            # whoever comes may have spoken already, and says it once
            self._heard(_SLICE_S)
        except PeerLost as lost:
            self._lost(lost)
        self._next_us = self._clock.now_us()
        self._came_us = self.body.time_us

    def _first_answer(self) -> Actuators | None:
        """Free run: samples at the pace of real time until the control loop runs."""
        self._next_us += self.body.tick_us
        while True:
            left_us = self._next_us - self._clock.now_us()
            answers = self._heard(max(0.0, left_us * 1e-6))
            if answers:
                self.locked, self._locked_us = True, self.body.time_us
                if not answers[-1].lockstep:
                    self._fault("the autopilot is built without lockstep: its time is not the plant's")
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
        began_us = looked_us = self._clock.now_us()
        waited_us, other_us = 0, None
        while True:
            for answer in self._heard(min(_SLICE_S, max(0.0, (self._answer_us - waited_us) * 1e-6))):
                if answer.time_us == self.body.time_us or not answer.lockstep:
                    waited_s = (self._clock.now_us() - began_us) * 1e-6
                    self.report.longest_wait_s = max(self.report.longest_wait_s, waited_s)
                    return answer
                # what was sent in the free run is answered late, and no fault
                self.report.out_of_step += answer.time_us > self._locked_us
                other_us = answer.time_us
            now_us = self._clock.now_us()
            waited_us += min(now_us - looked_us, _SLICE_US)
            looked_us = now_us
            if waited_us >= self._answer_us:
                self._late(other_us)
                return None

    def _heard(self, timeout_s: float) -> list[Actuators]:
        data = self.link.recv(timeout_s)
        if data is None:
            return []
        answers = self.simulator.receive(data)
        return answers if self._look_at_peer() else []

    # -- what goes wrong ---------------------------------------------------------------------------------------

    def _late(self, other_us: int | None) -> None:
        self.report.late += 1
        self.locked = False
        self._silent_since_us = self.body.time_us
        self._next_us = self._clock.now_us()
        what = f"the autopilot has not answered since {self._t()}, for {self._answer_us * 1e-6:g} s of wall clock"
        if other_us is not None:
            what += f" (what came answers {other_us * 1e-6:.3f} s)"
        if self.armed:
            self._fault(f"{what}; ticks pass without it")
        else:
            self._say(f"{what} (disarmed: a mode without set-points does that); ticks pass without it")

    def _lost(self, lost: PeerLost) -> None:
        if not self.simulator.system:
            self._once(
                f"a program came to the simulator's port without a HEARTBEAT ({lost.why}): no PX4; waiting for one"
            )
            self.simulator.new_peer()
            return
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

    def _look_at_peer(self) -> bool:
        """Whether it may go on talking."""
        counters = self.simulator.connection.counters
        if self.simulator.is_px4 is False:
            self._turn_out("whose HEARTBEAT is not PX4's, and this is PX4's simulator protocol")
        elif counters.bad_bytes > NO_MAVLINK_BYTES and not counters.received:
            self._turn_out("that speaks no MAVLink; PX4's simulator_mavlink belongs here")
        else:
            return True
        return False

    def _look_at_port(self) -> None:
        if not self.simulator.system:
            # till it is known who this is, others may wait
            if self.body.time_us - self._came_us > UNKNOWN_US:
                self._turn_out(f"that has not said within {UNKNOWN_US * 1e-6:g} s that it is an autopilot")
        elif refuse_others(self.link):
            self._once("a second program connected to the simulator's port: refused, there is one autopilot already")

    def _turn_out(self, who: str) -> None:
        """Free the port of somebody who is no PX4: a PX4 that comes later connects once and never again."""
        if turn_out(self.link):
            self._say(f"turned away from the simulator's port: a program {who}")
            self.locked = self.armed = False
            self.motors = ()
            self._came_us = self.body.time_us
            self.simulator.new_peer()
        else:
            self._once(f"on the simulator's link is a program {who}")

    def _look_at_values(self) -> None:
        simulator = self.simulator
        (not_numbers, outside), self._odd_values = self._odd_values, (simulator.not_numbers, simulator.outside)
        if simulator.not_numbers > not_numbers:
            self._fault("a motor command was no number (NaN or infinite), taken for 0")
        if simulator.outside > outside:
            self._fault("a motor command lay outside -1 to 1, cut")
        if simulator.strangers:
            self._once(f"messages of other systems than {simulator.system} on the simulator's link are ignored")

    def _fault(self, text: str) -> None:
        if self.report.fault(text, f"vehicle time {self._t()}"):
            self._say(self.report.faults[-1])

    def _once(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(text)

    def _t(self) -> str:
        return f"{self.body.time_us * 1e-6:.3f} s"
