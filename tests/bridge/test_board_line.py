"""A board that flies our plant on a serial line: whole, worn, silent, rebooted, unplugged, and set up wrongly.

The line is a real pseudo-terminal; time is the test's, so that a busy computer changes nothing.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

pytest.importorskip("serial")
pytest.importorskip("pty")

from hil_board import Bench, BenchClock, Board, Wear

from bridge.connection import Message
from bridge.errors import PeerLost
from bridge.link import open_link
from bridge.realtime import RealTime
from bridge.simulator import Simulator
from sitl.body import Body
from sitl.profile import get_profile
from sitl.sensors import ORIGIN
from sitl.vehicle_spec import resolve_vehicle

NAN = math.nan
HEIGHT_M = 3.0


class Line:
    """Both ends and what flies between them."""

    def __init__(self, stack: ExitStack, **board: Any) -> None:
        clock = BenchClock()
        self.board = Board(now_us=clock.now_us, **board)
        stack.callback(self.board.stop)
        self.clock = clock
        link = stack.enter_context(open_link(self.board.url))
        self.said: list[str] = []
        self.body = Body(resolve_vehicle("ant-x"), get_profile("sitl"))
        self.heard: list[Message] = []
        simulator = Simulator(self.body, truth=False)
        take = simulator.take

        def listen(message: Message) -> Any:
            self.heard.append(message)
            return take(message)

        simulator.take = listen  # type: ignore[method-assign]
        self.real_time = RealTime(Bench(self.board, link, clock), simulator, clock=clock, say=self.said.append)
        self.worst_deg = 0.0

    def run(self, seconds: float) -> None:
        self.until(lambda: False, seconds, must=False)

    def until(self, reached: Callable[[], object], seconds: float, *, must: bool = True) -> None:
        end_us = self.clock.now_us() + round(seconds * 1e6)
        while not reached():
            if self.clock.now_us() >= end_us:
                assert not must, f"not within {seconds} s; said {self.said}"
                return
            self.real_time.step()
            if self.board.vehicle.estimator.ready:
                self.worst_deg = max(self.worst_deg, self.board.tilt_error_deg(self.body.truth))

    def named(self, name: str) -> list[Message]:
        return [message for message in self.heard if message.name == name]

    def send(self, name: str, **fields: Any) -> None:
        self.real_time.link.send(
            self.real_time.simulator.connection.encode(name, target_system=1, target_component=1, **fields)
        )

    def arm(self) -> None:
        self.until(lambda: self.board.vehicle.autopilot.ready, 6.0)
        for _ in range(5):  # on a bad line it may take more than one
            self.send("COMMAND_LONG", command=400, param1=1.0)
            self.until(lambda: self.board.armed, 0.5, must=False)

    def take_off(self) -> None:
        self.arm()
        for _ in range(3):
            self.send("COMMAND_LONG", command=22, param1=NAN, param4=NAN, param5=NAN, param6=NAN,
                      param7=ORIGIN[2] + HEIGHT_M)  # fmt: skip
            self.run(0.1)
        self.until(lambda: self.height_m > HEIGHT_M - 0.5, 12.0)

    @property
    def height_m(self) -> float:
        return -self.body.truth.position_ned()[2]


@pytest.fixture
def line() -> Iterator[Callable[..., Line]]:
    with ExitStack() as stack:
        yield lambda **board: Line(stack, **board)


class TestFlight:
    def test_it_hovers_on_sensors_alone(self, line: Callable[..., Line]) -> None:
        one = line()
        one.take_off()
        one.run(2.0)
        north, east, down = one.body.truth.position_ned()
        assert math.hypot(north, east, down + HEIGHT_M) < 0.6
        assert one.worst_deg < 0.5
        assert one.board.rules.problems == []  # no truth among what it was sent, either
        report = one.real_time.report
        assert report.valid
        assert report.achieved_rate_hz == pytest.approx(250.0, rel=0.01)
        assert report.answer_rate_hz == pytest.approx(200.0, rel=0.05)
        assert report.worst_gap_s <= 0.005
        assert report.round_trip_s is not None
        assert report.round_trip_s < 0.01
        assert one.real_time.hil_enabled

    def test_it_hovers_on_a_worn_line(self, line: Callable[..., Line]) -> None:
        wear = Wear(loss=0.01, cut=0.3, delay_s=0.004)
        one = line(wear=wear)
        one.take_off()
        one.run(2.0)
        north, east, down = one.body.truth.position_ned()
        assert math.hypot(north, east, down + HEIGHT_M) < 1.5
        assert wear.lost > 1000
        assert one.real_time.simulator.connection.counters.bad_bytes > 0
        assert one.real_time.report.valid
        assert one.real_time.report.round_trip_s is not None
        assert one.real_time.report.round_trip_s >= 0.004
        assert one.board.samples < one.real_time.report.sent

    def test_what_comes_is_a_boards(self, line: Callable[..., Line]) -> None:
        one = line()
        one.arm()
        one.run(1.2)
        controls = one.named("HIL_ACTUATOR_CONTROLS")
        assert {(m.mode, m.flags) for m in controls} == {(53, 0), (181, 0)}
        assert all(not any(m.controls) for m in controls if m.mode == 53)
        assert all(m.base_mode & 32 for m in one.named("HEARTBEAT"))


class TestTrouble:
    def test_one_that_falls_silent_in_flight(self, line: Callable[..., Line]) -> None:
        one = line()
        one.arm()
        one.run(0.5)
        assert any(one.real_time.motors)
        one.board.silent = True
        one.run(1.0)
        assert not any(one.real_time.motors)
        assert not one.real_time.report.valid

    def test_one_that_reboots_on_the_ground(self, line: Callable[..., Line]) -> None:
        one = line()
        one.run(1.2)
        one.board.reboot()
        one.run(1.2)
        assert one.real_time.report.restarts == 1
        assert one.real_time.report.valid

    def test_unplugged(self, line: Callable[..., Line]) -> None:
        one = line()
        one.run(1.0)
        one.board.silent = True
        one.board.link.close()
        one.board.turn = lambda: None  # type: ignore[method-assign]
        with pytest.raises(PeerLost):
            one.run(1.0)


class TestSetUp:
    def test_not_in_hil_mode(self, line: Callable[..., Line]) -> None:
        one = line(hil=False)
        one.run(2.5)
        assert one.real_time.hil_enabled is False
        assert one.real_time.report.answers == 0
        assert one.board.samples == 0

    def test_firmware_without_outputs(self, line: Callable[..., Line]) -> None:
        one = line(outputs=False)
        one.arm()
        assert one.real_time.hil_enabled
        assert one.real_time.report.answers == 0
        assert "HIL_ACT_FUNC1" not in one.board.table

    def test_outputs_that_are_not_assigned(self, line: Callable[..., Line]) -> None:
        one = line(functions=0)
        one.arm()
        one.run(0.5)
        assert one.real_time.report.answers > 0
        assert one.real_time.armed
        assert not any(one.real_time.motors)

    def test_calibration_of_other_sensors_keeps_it_from_arming(self, line: Callable[..., Line]) -> None:
        one = line(calibrated=False)
        one.run(3.0)
        one.send("COMMAND_LONG", command=400, param1=1.0)
        one.run(0.5)
        assert not one.board.armed

    def test_its_parameters_can_be_read(self, line: Callable[..., Line]) -> None:
        one = line()
        one.run(1.5)
        wanted = {"SYS_HITL": 1, "HIL_ACT_FUNC1": 101, "HIL_ACT_FUNC4": 104, "HIL_ACT_FUNC5": 0,
                  "CAL_ACC0_ID": 1310988, "CAL_GYRO0_ID": 1310988, "CAL_MAG0_ID": 197388}  # fmt: skip
        for name in wanted:
            self._ask(one, name)
        found = {m.param_id: int.from_bytes(m.raw("param_value"), "little") for m in one.named("PARAM_VALUE")}
        assert {name: found[name] for name in wanted} == wanted

    @staticmethod
    def _ask(one: Line, name: str) -> None:
        one.send("PARAM_REQUEST_READ", param_id=name, param_index=-1)
        one.run(0.1)
