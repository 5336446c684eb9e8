"""One sample, one answer, one tick; and what happens when the other side does not keep to it."""

from __future__ import annotations

import math
import os
import random
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from px4_stand_in import GARBAGE, HTTP, Faults, Impostor, StandIn, Still

from bridge.link import Link
from bridge.lockstep import Lockstep
from bridge.simulator import Actuators, Simulator
from bridge.tcp_link import TcpLink
from sitl.body import START_US, Body
from sitl.profile import get_profile
from sitl.vehicle_spec import resolve_vehicle

SOON_S = 20.0
ANSWER_S = 0.15


def new_simulator() -> Simulator:
    return Simulator(Body(resolve_vehicle("ant-x"), get_profile("sitl")), truth=True)


class Side:
    """Our side of the port, and what it said."""

    def __init__(self, answer_s: float) -> None:
        self.link = TcpLink.listen("127.0.0.1", 0)
        self.port = self.link.port
        self.said: list[str] = []
        self.lockstep = Lockstep(self.link, new_simulator(), say=self.said.append, answer_s=answer_s)
        self.report = self.lockstep.report

    @property
    def body(self) -> Body:
        return self.lockstep.body

    def until(self, reached: Callable[[], object], what: str = "") -> None:
        """Step till then, a while of wall clock at most."""
        end = time.monotonic() + SOON_S
        while not reached():
            assert time.monotonic() < end, f"not reached: {what}; said {self.said}"
            self.lockstep.step()

    def lock(self) -> None:
        self.until(lambda: self.lockstep.locked, "lockstep")

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.lockstep.step()

    def said_with(self, *words: str) -> list[str]:
        return [line for line in self.said if all(word in line for word in words)]


@pytest.fixture
def side() -> Iterator[Side]:
    made = Side(ANSWER_S)
    yield made
    made.link.close()


@pytest.fixture
def patient() -> Iterator[Side]:
    """Waits so long that no fault of the computer's is taken for one of the autopilot's."""
    made = Side(SOON_S)
    yield made
    made.link.close()


class TestKeepingStep:
    def test_nobody_there_no_time_passes(self, side: Side) -> None:
        side.steps(2)
        assert side.body.time_us == START_US
        assert side.report.steps == 0

    @pytest.mark.parametrize("seed", [0, 1, 5])
    def test_free_run_until_the_first_answer_then_one_for_one(self, patient: Side, seed: int) -> None:
        with StandIn(patient.port, seed=seed) as px4:
            patient.lock()
            assert px4.taken >= px4.first_after
            begun, before = patient.report.answered, px4.answered
            patient.steps(300)
            assert patient.report.answered - begun == 300
            # its answer to the last sample of the free run may have been on its way
            assert px4.answered - before in (300, 301)
            assert patient.report.steps == px4.taken
        assert px4.problems == []
        assert patient.report.valid
        assert (patient.report.late, patient.report.out_of_step) == (0, 0)

    def test_what_it_says_first_is_heard(self, patient: Side) -> None:
        """PX4 says its HEARTBEAT and what it wants once, as soon as it is connected."""
        for _ in range(5):
            with StandIn(patient.port, seed=3) as px4:
                time.sleep(0.02)  # both are in the socket before anybody looks
                patient.lock()
                patient.steps(10)
                assert patient.lockstep.simulator.is_px4 is True
                assert px4.counts["HIL_STATE_QUATERNION"] > 5
            patient.until(lambda: not patient.lockstep.connected, "gone")

    def test_motors_of_the_answer_move_the_tick(self, patient: Side) -> None:
        with StandIn(patient.port, Still((0.6, 0.5, 0.4, 0.3), armed=True)):
            patient.lock()
            patient.steps(250)
            assert patient.lockstep.motors[:5] == pytest.approx((0.6, 0.5, 0.4, 0.3, 0.0))
            assert patient.lockstep.armed
            assert patient.body.plant.state["motors"][0][:4] == pytest.approx((0.6, 0.5, 0.4, 0.3), abs=0.01)

    def test_time_is_exactly_the_count_of_ticks(self, patient: Side) -> None:
        with StandIn(patient.port) as px4:
            patient.lock()
            patient.steps(1000)
            assert patient.body.time_us - START_US == patient.report.steps * 4000
            assert px4.samples[-1].time_us == patient.body.time_us - 4000

    def test_a_pause_of_ours_is_harmless(self, patient: Side) -> None:
        with StandIn(patient.port, Still(armed=True)) as px4:
            patient.lock()
            patient.steps(20)
            time.sleep(0.3)
            patient.steps(20)
        assert patient.report.valid
        assert px4.problems == []

    def test_a_pause_in_the_middle_of_a_wait_is_no_silence_of_theirs(self, side: Side) -> None:
        """As when the whole computer sleeps: the clock has gone on, the autopilot has not."""
        clock = JumpingClock()
        lockstep = Lockstep(side.link, new_simulator(), say=side.said.append, answer_s=1.0, clock=clock)
        with StandIn(side.port, Still(armed=True)) as px4:
            end = time.monotonic() + SOON_S
            while not lockstep.locked and time.monotonic() < end:
                lockstep.step()
            px4.each_sample(lambda it: (clock.jump(5.0), time.sleep(0.07)) if it.taken == 150 else None)
            while px4.taken < 200 and time.monotonic() < end:
                lockstep.step()
        assert lockstep.report.late == 0
        assert lockstep.report.valid

    def test_a_hundred_thousand_ticks_do_not_drift(self) -> None:
        link, simulator = Echo(), new_simulator()
        body = simulator.body
        # only what keeps time: the rest is flown elsewhere, for less long
        body.plant.step = lambda _: None  # type: ignore[method-assign]
        simulator.frames = lambda: body.time_us.to_bytes(8, "little")  # type: ignore[method-assign]
        simulator.receive = lambda data: [  # type: ignore[method-assign]
            Actuators(int.from_bytes(data, "little"), (0.5,) * 16, armed=True, lockstep=True)
        ]
        lockstep = Lockstep(link, simulator, answer_s=SOON_S)
        while lockstep.report.steps < 100_000:
            lockstep.step()
        assert body.time_us == START_US + 100_000 * 4000
        assert link.last_us == body.time_us - 4000
        assert (lockstep.report.late, lockstep.report.out_of_step) == (0, 0)
        assert lockstep.report.answered == 100_000


class JumpingClock:
    """Wall clock that may jump ahead."""

    def __init__(self) -> None:
        self._ahead_us = 0

    def jump(self, seconds: float) -> None:
        self._ahead_us += round(seconds * 1e6)

    def now_us(self) -> int:
        return time.monotonic_ns() // 1000 + self._ahead_us

    def sleep_until_us(self, time_us: int) -> int:
        time.sleep(max(0, time_us - self.now_us()) * 1e-6)
        return 0


class Echo(Link):
    """Gives back at once what it is given."""

    def __init__(self) -> None:
        super().__init__("echo")
        self._answers: deque[bytes] = deque()
        self.last_us = 0

    def send(self, data: bytes) -> None:
        self.last_us = int.from_bytes(data, "little")
        self._answers.append(data)

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        return self._answers.popleft() if self._answers else None

    def close(self) -> None:
        pass


class TestWhoIsLate:
    def test_silent_in_flight_is_named_and_makes_the_flight_invalid(self, side: Side) -> None:
        faults = Faults()
        with StandIn(side.port, Still(armed=True), faults=faults) as px4:
            side.lock()
            px4.each_sample(lambda it: setattr(faults, "mute_armed", it.taken >= 150))
            side.until(lambda: side.report.late, "late")
            missed_us = side.body.time_us - 4000  # the tick that passed without its answer
            assert not side.report.valid
            (line,) = side.said_with("the autopilot has not answered since")
            assert f"{missed_us * 1e-6:.3f} s" in line
            assert px4.samples[-1].time_us >= missed_us
            assert side.report.faults == [line]

    def test_motors_stand_after_two_seconds_without_it(self, side: Side) -> None:
        faults = Faults()
        with StandIn(side.port, Still((0.6,) * 4, armed=True), faults=faults):
            side.lock()
            side.steps(5)
            faults.hang = True
            side.until(lambda: side.report.late, "late")
            since_us = side.body.time_us
            side.until(lambda: not any(side.lockstep.motors), "motors stopped")
            assert 1.9e6 < side.body.time_us - since_us < 2.2e6
            assert side.said_with("motors stopped")

    def test_silent_on_the_ground_is_said_and_forgiven(self, side: Side) -> None:
        """A mode without set-points stops the outputs altogether."""
        faults = Faults()
        with StandIn(side.port, faults=faults) as px4:
            side.lock()
            faults.mute_disarmed = True
            side.until(lambda: side.report.late, "late")
            taken = px4.taken
            side.until(lambda: px4.taken > taken + 20, "ticks pass without it")
            assert side.report.valid
            faults.mute_disarmed = False
            side.lock()
            assert side.said_with("answers again")
            side.steps(50)
        assert side.report.late == 1
        assert side.report.valid
        assert px4.problems == []

    def test_a_hung_one_that_goes_on_is_taken_back(self, side: Side) -> None:
        faults = Faults()
        with StandIn(side.port, faults=faults) as px4:
            side.lock()
            faults.hang = True
            side.until(lambda: side.report.late, "late")
            faults.hang = False
            side.lock()
            side.until(lambda: px4.taken == side.report.steps, "caught up")
            side.steps(100)
            assert side.lockstep.locked
        assert px4.problems == []

    def test_answers_to_another_tick_are_not_taken(self, side: Side) -> None:
        faults = Faults()
        with StandIn(side.port, Still(armed=True), faults=faults):
            side.lock()
            side.steps(10)
            faults.late_us = 8000
            side.until(lambda: side.report.late, "late")
            assert side.report.out_of_step >= 1
            assert not side.report.valid
            assert side.said_with("has not answered since", "what came answers")

    def test_left_out_answers_do_not_stop_it(self, side: Side) -> None:
        with StandIn(side.port, faults=Faults(skip=40)) as px4:
            side.lock()
            side.until(lambda: side.report.late >= 2, "two of forty left out")
        assert px4.problems == []

    def test_built_without_lockstep(self, patient: Side) -> None:
        with StandIn(patient.port, faults=Faults(flags=0)):
            patient.lock()
            patient.steps(20)
        assert not patient.report.valid
        assert patient.said_with("without lockstep")


class TestOddAnswers:
    @pytest.mark.parametrize(
        ("value", "says"), [(math.nan, "no number"), (math.inf, "no number"), (5.0, "outside"), (-3.0, "outside")]
    )
    def test_values_are_made_safe_said_and_make_it_invalid(self, patient: Side, value: float, says: str) -> None:
        faults = Faults()
        with StandIn(patient.port, Still((0.5,) * 4, armed=True), faults=faults):
            patient.lock()
            patient.steps(10)
            assert patient.report.valid
            faults.value = value
            patient.steps(50)
            assert 0.0 <= patient.lockstep.motors[0] <= 1.0
            assert patient.lockstep.motors[1] == 0.5
        assert len(patient.said_with(says)) == 1
        assert len(patient.report.faults) == 1

    def test_each_flight_has_its_own_faults(self, patient: Side) -> None:
        faults = Faults()
        with StandIn(patient.port, Still((0.5,) * 4, armed=True), faults=faults):
            patient.lock()
            for _ in range(2):
                faults.value = math.nan
                patient.steps(5)
                assert not patient.lockstep.report.valid
                faults.value = None
                patient.steps(5)
                patient.lockstep.report = type(patient.report)()
                patient.steps(5)
                assert patient.lockstep.report.valid

    def test_another_systems_answers_move_nothing(self, side: Side) -> None:
        faults = Faults()
        with StandIn(side.port, Still((0.5,) * 4, armed=True), faults=faults):
            side.lock()
            faults.sysid = 9
            side.until(lambda: side.report.late, "late")
            assert side.lockstep.simulator.system == 1
            assert side.said_with("other systems than 1")

    @pytest.mark.parametrize("fault", ["zeros", "octo"])
    def test_motors_that_stand_are_passed_on_as_they_are(self, patient: Side, fault: str) -> None:
        faults = Faults(**{fault: True})
        with StandIn(patient.port, Still((0.5,) * 8, armed=True), faults=faults):
            patient.lock()
            patient.steps(5)
            wanted = [0.0] * 8 if fault == "zeros" else [0.5] * 4 + [0.0] * 4
            assert list(patient.lockstep.motors[:8]) == wanted


class TestComingAndGoing:
    def test_one_that_starts_anew_is_taken_again(self, patient: Side) -> None:
        with StandIn(patient.port, again=True) as px4:
            patient.lock()
            patient.steps(50)
            before_us = patient.body.time_us
            px4.drop()
            patient.until(lambda: patient.report.restarts, "gone")
            patient.lock()
            patient.steps(50)
            assert patient.body.time_us > before_us
            assert px4.connections == 2
            assert px4.counts["HIL_GPS"] < px4.taken / 10
        assert patient.report.valid
        assert patient.said_with("went away")
        assert px4.problems == []

    def test_gone_in_flight(self, patient: Side) -> None:
        with StandIn(patient.port, Still((0.6,) * 4, armed=True)) as px4:
            patient.lock()
            patient.steps(100)
            px4.drop()
            patient.until(lambda: patient.report.restarts, "gone")
        assert not patient.report.valid
        assert "went away in flight" in patient.report.faults[0]
        assert patient.lockstep.motors == ()
        assert not patient.lockstep.armed
        assert patient.body.truth.position_ned() == (0.0, 0.0, 0.0)

    def test_a_second_client_is_refused_and_the_first_flies_on(self, patient: Side) -> None:
        with StandIn(patient.port) as px4:
            patient.lock()
            with Impostor(patient.port, b"") as second:
                patient.steps(120)
                assert second.turned_away()
            patient.steps(50)
            assert patient.lockstep.locked
        assert len(patient.said_with("second program")) == 1
        assert patient.report.valid
        assert px4.problems == []

    @pytest.mark.parametrize("words", [HTTP, GARBAGE], ids=["http", "garbage"])
    def test_no_mavlink_is_turned_away_and_the_next_one_flies(self, patient: Side, words: bytes) -> None:
        with Impostor(patient.port, words) as other:
            patient.until(lambda: patient.said_with("no MAVLink"), "said")
            assert other.turned_away()
        with StandIn(patient.port) as px4:
            patient.lock()
            patient.steps(20)
        assert patient.report.valid
        assert patient.report.restarts == 0
        assert px4.problems == []

    def test_an_ardupilot_is_turned_away(self, patient: Side) -> None:
        with StandIn(patient.port, faults=Faults(autopilot=3)):
            patient.until(lambda: patient.said_with("not PX4's"), "said")
        assert not patient.lockstep.locked
        assert patient.report.valid

    def test_one_that_only_knocks_does_no_harm(self, patient: Side) -> None:
        for _ in range(3):
            Impostor(patient.port, b"").close()
            patient.steps(2)
        with StandIn(patient.port) as px4:
            patient.lock()
            patient.steps(20)
        assert patient.report.restarts == 0
        assert px4.problems == []

    def test_a_silent_one_does_not_hold_the_port_for_ever(self, patient: Side) -> None:
        with Impostor(patient.port, b""):
            patient.until(lambda: patient.lockstep.connected, "taken")
            patient.lockstep._clock = clock = JumpingClock()
            px4 = StandIn(patient.port).start()
            try:
                while not patient.said_with("has not said"):
                    clock.jump(0.02)
                    patient.steps(1)
                patient.lockstep._next_us = clock.now_us()
                patient.lock()
            finally:
                px4.stop()
        assert px4.connections == 1
        assert px4.problems == []

    def test_a_storm_of_visitors(self, patient: Side) -> None:
        chance = random.Random(5)
        stop = threading.Event()

        def visit() -> None:
            while not stop.is_set():
                try:
                    with socket.create_connection(("127.0.0.1", patient.port), 1.0) as one:
                        one.sendall(chance.choice([b"", HTTP, GARBAGE[: chance.randrange(900)], os.urandom(50)]))
                        time.sleep(0.003)
                except OSError:
                    pass

        with StandIn(patient.port) as px4:
            patient.lock()
            visitor = threading.Thread(target=visit, daemon=True)
            visitor.start()
            try:
                patient.steps(400)
            finally:
                stop.set()
                visitor.join(5.0)
            assert patient.lockstep.locked
        assert patient.report.valid
        assert px4.problems == []
