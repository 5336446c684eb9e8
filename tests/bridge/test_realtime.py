"""The steady sender for boards, on a clock of the test's own."""

from __future__ import annotations

import itertools

import pytest

from bridge.connection import Connection
from bridge.errors import BoardStopped, PeerLost
from bridge.ground_router import GroundRouter
from bridge.link import Link, MemoryLink
from bridge.realtime import RESTART_US, SILENT_S, STOP_GAP_S, RealTime
from bridge.simulator import Simulator
from sitl.body import Body
from sitl.profile import get_profile
from sitl.vehicle_spec import resolve_vehicle

TICK_US = 4_000


class Wall:
    """Wall-clock time that passes where somebody waits, and where the test says so."""

    def __init__(self) -> None:
        self.time_us = 50_000_000

    def now_us(self) -> int:
        return self.time_us

    def sleep_until_us(self, time_us: int) -> int:
        self.time_us = max(self.time_us, time_us)
        return 0


class Line(Link):
    """A serial line to a board that the test plays: what it answers has an arrival time."""

    datagram = False

    def __init__(self, wall: Wall) -> None:
        super().__init__("serial://test:921600")
        self.wall = wall
        self.sent: list[tuple[int, bytes]] = []
        self.coming: list[tuple[int, bytes]] = []
        self.dead = False

    def send(self, data: bytes) -> None:
        if self.dead:
            raise PeerLost(self.name, "unplugged")
        self.sent.append((self.wall.time_us, data))

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        if self.dead:
            raise PeerLost(self.name, "unplugged")
        limit = self.wall.time_us + round(timeout_s * 1e6)
        if self.coming and self.coming[0][0] <= limit:
            at, data = self.coming.pop(0)
            self.wall.time_us = max(self.wall.time_us, at)
            return data
        self.wall.time_us = limit
        return None

    def close(self) -> None:
        return


class Rig:
    """A plant in real time and a board's voice."""

    def __init__(self, router: GroundRouter | None = None) -> None:
        self.wall = Wall()
        self.line = Line(self.wall)
        self.board = Connection(1, 1)
        self.said: list[str] = []
        body = Body(resolve_vehicle("ant-x", ()), get_profile("sitl"), seed=3)
        self.simulator = Simulator(body, truth=False)
        self.real_time = RealTime(self.line, self.simulator, router=router, clock=self.wall, say=self.said.append)

    def says(self, name: str, after_us: int = 0, **fields: object) -> None:
        self.line.coming.append((self.wall.time_us + after_us, self.board.encode(name, **fields)))

    def motors(self, value: float, *, armed: bool = True, after_us: int = 0) -> None:
        controls = [value] * 4 + [0.0] * 12
        self.says("HIL_ACTUATOR_CONTROLS", after_us, time_usec=1, controls=controls, mode=181 if armed else 53, flags=0)

    def heartbeat(self, base_mode: int = 181) -> None:
        self.says("HEARTBEAT", type=2, autopilot=12, base_mode=base_mode, system_status=4, mavlink_version=3)

    def steps(self, count: int, *, motors: float | None = None) -> None:
        for _ in range(count):
            if motors is not None:
                self.motors(motors)
            self.real_time.step()

    def messages(self) -> list[tuple[int, str]]:
        reader = Connection(9, 9)
        return [(at, one.name) for at, data in self.line.sent for one in reader.receive(data)]


def test_a_sample_goes_out_every_four_milliseconds() -> None:
    rig = Rig()
    rig.steps(1000)
    at = [time for time, name in rig.messages() if name == "HIL_SENSOR"]
    assert len(at) == 1000
    assert {b - a for a, b in itertools.pairwise(at)} == {TICK_US}
    assert rig.real_time.report.achieved_rate_hz == pytest.approx(250.0)
    assert rig.real_time.report.worst_gap_s == pytest.approx(0.004)
    assert rig.real_time.body.tick == 1000


def test_a_board_is_never_sent_the_truth() -> None:
    rig = Rig()
    rig.heartbeat()
    rig.says("COMMAND_LONG", command=511, param1=115.0, param2=5000.0)
    rig.steps(300)
    assert {name for _, name in rig.messages()} == {"HIL_SENSOR", "HIL_GPS", "HEARTBEAT", "TIMESYNC"}


def test_motors_move_the_plant_and_their_rate_is_measured() -> None:
    rig = Rig()
    rig.heartbeat()
    rig.steps(500, motors=0.8)
    assert rig.real_time.armed
    assert rig.real_time.hil_enabled
    assert rig.real_time.body.truth.position_ned()[2] < -1.0
    report = rig.real_time.report
    assert report.answers == 500
    assert report.worst_answer_gap_s == pytest.approx(0.004, abs=1e-3)
    assert report.valid


def test_a_short_pause_is_made_up_for_by_the_plant_not_by_samples() -> None:
    rig = Rig()
    began_us = rig.wall.time_us
    rig.steps(10)
    rig.wall.time_us += 50_000
    rig.steps(10)
    report = rig.real_time.report
    assert report.sent == 20
    assert report.worst_gap_s == pytest.approx(0.050, abs=0.006)
    # vehicle time has kept up with the wall's
    assert rig.real_time.body.tick == (rig.wall.time_us - began_us) // TICK_US == 31
    assert report.valid


def test_a_long_pause_stops_an_armed_flight_and_names_the_gap() -> None:
    rig = Rig()
    rig.steps(10, motors=0.5)
    rig.wall.time_us += round(STOP_GAP_S * 1e6) + 100_000
    with pytest.raises(BoardStopped, match=r"no sample for 30. ms"):
        rig.steps(1)
    assert "no sample for" in rig.real_time.report.faults[0]
    rig.real_time.stop()
    last = Connection(9, 9).receive(rig.line.sent[-1][1])[0]
    assert (last.name, last.command, last.param1, last.param2) == ("COMMAND_LONG", 400, 0.0, 21196.0)


def test_a_long_pause_before_take_off_is_only_said() -> None:
    rig = Rig()
    rig.steps(10)
    rig.wall.time_us += 3_000_000
    rig.steps(10)
    assert rig.real_time.report.valid
    assert "disarmed, going on" in rig.said[0]
    assert rig.real_time.body.tick == 20


def test_a_silent_armed_board_moves_no_motor_any_more() -> None:
    rig = Rig()
    rig.steps(50, motors=0.6)
    rig.steps(round(SILENT_S * 250) + 5)
    assert rig.real_time.motors == ()
    assert "no motor command" in rig.real_time.report.faults[0]


def test_round_trips_and_the_clock_of_the_board() -> None:
    rig = Rig()
    rig.heartbeat()
    offset_us = -41_000_000
    for _ in range(2000):
        rig.real_time.step()
        for _, data in rig.line.sent:
            for message in Connection(9, 9).receive(data):
                if message.name == "TIMESYNC":
                    at_us = rig.wall.time_us + 1_000 + offset_us
                    rig.says("TIMESYNC", 2_000, tc1=at_us * 1000, ts1=message.ts1)
        rig.line.sent.clear()
    report = rig.real_time.report
    assert len(report.round_trips_s) == pytest.approx(16, abs=1)
    assert report.round_trip_s == pytest.approx(0.002, abs=1e-4)
    assert rig.real_time.offset_us == pytest.approx(offset_us, abs=200)


def test_a_clock_that_begins_anew_is_a_restart() -> None:
    rig = Rig()
    rig.heartbeat()
    rig.steps(5, motors=0.7)
    for board_us in (900_000_000, 900_000_000 - 2 * RESTART_US):
        rig.says("TIMESYNC", tc1=board_us * 1000, ts1=rig.wall.time_us * 1000)
        rig.steps(1)
    report = rig.real_time.report
    assert report.restarts == 1
    assert "started anew in flight" in report.faults[0]
    assert rig.real_time.offset_us is not None


def test_numbers_that_are_none_are_a_fault_and_move_nothing() -> None:
    rig = Rig()
    rig.motors(float("nan"))
    rig.steps(2)
    assert rig.real_time.motors[:4] == (0.0,) * 4
    assert "no number" in rig.real_time.report.faults[0]

    rig.real_time.begin()
    rig.steps(2, motors=0.5)
    assert rig.real_time.report.valid
    rig.motors(float("inf"))
    rig.steps(1)
    assert "no number" in rig.real_time.report.faults[0]


def test_an_unplugged_line_is_told_at_once() -> None:
    rig = Rig()
    rig.steps(3)
    rig.line.dead = True
    with pytest.raises(PeerLost, match="unplugged"):
        rig.steps(1)


def test_what_the_board_says_goes_to_ground_stations_and_back() -> None:
    near, far = MemoryLink.pair()
    rig = Rig(GroundRouter([near]))
    rig.heartbeat()
    rig.says("ATTITUDE", time_boot_ms=7)
    far.send(Connection(255, 190).encode("PARAM_REQUEST_LIST", target_system=1, target_component=1))
    rig.steps(3)
    reader, heard = Connection(9, 9, datagram=True), []
    while (data := far.recv()) is not None:
        heard += [one.name for one in reader.receive(data)]
    assert heard == ["HEARTBEAT", "ATTITUDE"]
    assert "PARAM_REQUEST_LIST" in {name for _, name in rig.messages()}
