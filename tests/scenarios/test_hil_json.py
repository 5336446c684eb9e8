"""`froude hil --link json://...` against a strict stand-in for ArduPilot, over a UDP port in lockstep."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from ardupilot_stand_in import OCTA_X, QUAD_X, Pilot, StandIn, servo_frame

from bridge.errors import LinkUrlError, PortBusy
from scenarios import cli, hil_json
from scenarios.hil_json import json_address
from scenarios.hil_serve import Serving, serve
from sitl.errors import UsageError
from sitl.profile import get_profile
from sitl.vehicle_spec import resolve_vehicle

IDLE = [1000] * 4
CUSTOM = """
name = "MIXED-UP"
mass_kg = 0.307
frame_m = [0.20, 0.20, 0.04]
diagonal_m = 0.16
lateral_m = 0.12
layout = "custom"
[derivatives]
Yv_1_s = -0.1068
Yp_m_s_rad = 0.1192
Yd_m_s2 = -10.1647
Lv_rad_m_s = -5.9755
Lp_1_s = -2.6478
Ld_rad_s2 = 450.71
"""
"""ANT-X with its rotors in an order that is neither PX4's nor ArduPilot's."""


@pytest.fixture(autouse=True)
def sigint() -> Iterator[None]:
    """The stand-in stops the plant as Ctrl-C does; where nothing is served any more that must not stop the tests."""
    before = signal.signal(signal.SIGINT, lambda *_: None)
    yield
    signal.signal(signal.SIGINT, before)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def beside(run: Callable[[], None], serving: Callable[[], Any]) -> Any:
    """Serve in this thread, as signals need it, with an ArduPilot in another one; its Ctrl-C ends the serving."""
    failed: list[BaseException] = []
    served = threading.Event()

    def body() -> None:
        try:
            run()
        except BaseException as error:
            failed.append(error)
        # again and again: the first may come before anything is served
        while not served.wait(0.05):
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=body)
    thread.start()
    try:
        result = serving()
    finally:
        served.set()
        thread.join(30)
    if failed:
        raise failed[0]
    return result


class Served:
    """What came of serving one ArduPilot."""

    def __init__(self, run: Callable[[int], None], spec: str = "ant-x", **options: Any) -> None:
        port = free_port()
        what = Serving(
            link=f"json://127.0.0.1:{port}",
            model=resolve_vehicle(spec),
            profile=get_profile("sitl"),
            seed=0,
            **options,
        )
        self.said: list[str] = []
        self.report = beside(lambda: run(port), lambda: serve(what, self.said.append))

    def said_with(self, *words: str) -> list[str]:
        return [line for line in self.said if all(word in line for word in words)]


# -- at rest ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate_hz", "outputs"), [(400, 16), (1200, 32), (333, 16)])
def test_at_rest_the_state_is_exact_and_time_passes_by_the_rate(rate_hz: int, outputs: int) -> None:
    def run(port: int) -> None:
        copter = StandIn(port, rate_hz=rate_hz, outputs=outputs)
        for _ in range(200):
            state = copter.step(IDLE)
            assert state["imu"] == {"gyro": [0.0, 0.0, 0.0], "accel_body": [0.0, 0.0, -9.81]}
            assert state["position"] == state["velocity"] == [0.0, 0.0, 0.0]
            assert state["quaternion"] == [1.0, 0.0, 0.0, 0.0]
        assert math.isclose(copter.time_s, 200 / rate_hz, abs_tol=1e-12)
        copter.close()

    report = Served(run).report
    assert (report["mode"], report["frames"], report["rate_hz"]) == ("ardupilot json", 200, rate_hz)
    assert math.isclose(report["vehicle_time_s"], 200 / rate_hz, abs_tol=1e-9)
    assert (report["lost"], report["restarts"], report["refused"], report["faults"]) == (0, 0, 0, [])


# -- in the air ------------------------------------------------------------------------------------------------


def fly(port: int, pilot: Pilot, rate_hz: int) -> None:
    """Lift off, roll right, left and level; each held."""
    copter = StandIn(port, rate_hz=rate_hz)
    state = copter.step(IDLE)
    for seconds, set_point_deg in ((3.0, 0.0), (1.5, 10.0), (1.5, -10.0), (1.5, 0.0)):
        for _ in range(round(seconds * rate_hz)):
            state = copter.step(pilot.pulses(state, math.radians(set_point_deg), 3.0))
        w, x, y, z = state["quaternion"]
        roll_deg = math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
        assert abs(roll_deg - set_point_deg) < 2.0, f"rolled {roll_deg} deg, asked for {set_point_deg}"
        assert math.hypot(*state["imu"]["gyro"]) < 0.2
        assert abs(-state["position"][2] - 3.0) < 0.8
    assert abs(z) < 0.02
    copter.close()


@pytest.mark.parametrize(
    ("spec", "motors", "p", "d"), [("ant-x", QUAD_X, 0.07, 0.0014), ("carrier-1", OCTA_X, 0.2, 0.003)]
)
def test_a_pilot_with_ardupilots_motor_order_lifts_off_and_holds_roll(
    spec: str, motors: tuple[tuple[float, int], ...], p: float, d: float
) -> None:
    served = Served(lambda port: fly(port, Pilot(motors, 400, p=p, d=d, hover=0.5), 400), spec)
    assert served.report["faults"] == []
    assert served.report["vehicle_time_s"] > 7.0


def test_rotors_in_another_order_are_found_by_their_place(tmp_path: Path) -> None:
    rotors = [(-0.06, 0.06, -0.05), (0.06, 0.06, 0.05), (0.06, -0.06, -0.05), (-0.06, -0.06, 0.05)]
    text = CUSTOM + "".join(f"[[rotors]]\npx_m = {x}\npy_m = {y}\nkm = {km}\n" for x, y, km in rotors)
    path = tmp_path / "mixed-up.toml"
    path.write_text(text, encoding="utf-8")
    served = Served(lambda port: fly(port, Pilot(QUAD_X, 400, p=0.07, d=0.0014, hover=0.5), 400), str(path))
    assert served.report["output_rotors"] == [2, 4, 3, 1]
    assert (served.report["frame"], served.report["faults"]) == ("quad X", [])


# -- what goes wrong -------------------------------------------------------------------------------------------


def test_a_frame_sent_again_gets_the_same_answer_and_no_time_passes() -> None:
    def run(port: int) -> None:
        copter = StandIn(port)
        for _ in range(20):
            copter.step([1800] * 4)
            copter.count -= 1
            first = copter.line
            copter.ask([1800] * 4)
            assert copter.line == first
            copter.count += 1
        copter.close()

    report = Served(run).report
    assert report["repeated"] == 20
    assert (report["frames"], report["faults"]) == (20, [])


def test_ardupilot_may_be_there_before_the_plant() -> None:
    port = free_port()
    copter = StandIn(port)
    with pytest.raises(AssertionError, match="does not answer"):
        copter.ask(IDLE, tries=2)
    what = Serving(f"json://127.0.0.1:{port}", resolve_vehicle("ant-x"), get_profile("sitl"), 0)

    def run() -> None:
        assert copter.step(IDLE)["timestamp"] == 1 / 400

    report = beside(run, lambda: serve(what, lambda _: None))
    copter.close()
    assert report["frames"] == 1


def test_an_ardupilot_that_starts_anew_finds_the_plant_on_the_ground() -> None:
    def run(port: int) -> None:
        copter = StandIn(port)
        for _ in range(400):
            state = copter.step([1700] * 4)
        assert state["position"][2] < -0.5
        copter.count, copter.time_s = 0, 0.0
        assert copter.step(IDLE)["position"] == [0.0, 0.0, 0.0]
        copter.close()

    served = Served(run)
    assert served.report["restarts"] == 1
    assert "restarted in flight" in served.report["faults"][0]
    assert served.said_with("back on the ground")
    assert served.said_with("INVALID")


def test_a_second_ardupilot_is_refused_while_the_first_one_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    # a busy computer is no silence
    monkeypatch.setattr(hil_json, "SILENT_US", 60_000_000)

    def run(port: int) -> None:
        first, second = StandIn(port), StandIn(port)
        first.step(IDLE)
        for _ in range(3):
            second.socket.send(servo_frame(0, IDLE))
            first.step(IDLE)
        assert not second.answered(0.1)
        first.step(IDLE)
        assert not first.answered(0.05), "answers that nobody asked for"
        first.close()
        second.close()

    served = Served(run)
    assert (served.report["refused"], served.report["frames"], served.report["faults"]) == (3, 5, [])
    assert len(served.said_with("a second ArduPilot", "is not answered")) == 1


def test_after_a_silence_the_next_ardupilot_takes_the_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hil_json, "SILENT_US", 100_000)

    def run(port: int) -> None:
        first = StandIn(port)
        for _ in range(5):
            first.step(IDLE)
        first.close()
        second = StandIn(port)
        second.socket.settimeout(0.05)
        assert second.step(IDLE)["timestamp"] == 1 / 400
        second.close()

    served = Served(run)
    assert (served.report["restarts"], served.report["faults"]) == (1, [])
    assert served.said_with("was silent", "back on the ground")


def test_what_is_no_ardupilot_is_not_answered_and_takes_nobodys_place() -> None:
    def run(port: int) -> None:
        stranger, copter = StandIn(port), StandIn(port)
        stranger.find(b"GET / HTTP/1.1")
        for data in (servo_frame(0, IDLE)[:-1], servo_frame(0, IDLE, rate_hz=3), b""):
            stranger.socket.send(data)
        assert not stranger.answered(0.1)
        copter.step(IDLE)
        stranger.close()
        copter.close()

    served = Served(run)
    assert (served.report["rejected"], served.report["frames"], served.report["refused"]) == (4, 1, 0)
    assert served.said_with("14 bytes", "not answered")
    assert served.said_with("39 bytes with magic number 18458")
    assert served.said_with("frame_rate 3 Hz", "SIM_RATE_HZ")


def test_it_stops_by_itself_after_the_seconds_asked_for() -> None:
    def run(port: int) -> None:
        copter = StandIn(port, rate_hz=1200)
        for _ in range(720):
            copter.step(IDLE)
        with pytest.raises(AssertionError, match="does not answer"):
            copter.ask(IDLE, tries=2)
        copter.close()

    report = Served(run, seconds=0.6).report
    assert (report["frames"], report["vehicle_time_s"]) == (720, pytest.approx(0.6))


def test_vehicle_time_adds_up_over_restarts() -> None:
    def run(port: int) -> None:
        copter = StandIn(port)
        for count in (0, 1, 2, 0, 1):
            copter.count = count
            copter.ask(IDLE)
        copter.close()

    report = Served(run).report
    assert (report["frames"], report["restarts"], report["vehicle_time_s"]) == (5, 1, pytest.approx(5 / 400))


# -- the command -----------------------------------------------------------------------------------------------


def test_the_command_says_what_to_set_and_reports_after_ctrl_c(capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()

    def run() -> None:
        copter = StandIn(port)
        for _ in range(50):
            copter.step([1200] * 4)
        copter.close()

    args = ["hil", "carrier-1", "--link", f"json://127.0.0.1:{port}", "--json", "--status"]
    assert beside(run, lambda: cli.main(args)) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert report["frames"] == 50
    assert report["parameters"]["FRAME_CLASS"] == 3
    assert report["delta_lat_per_roll"] == pytest.approx(0.5412, abs=1e-4)
    assert "--model JSON:127.0.0.1" in err
    assert "MOT_THST_EXPO 0" in err


def test_an_airframe_that_is_none_of_ardupilots_is_said_so(tmp_path: Path) -> None:
    rotors = [(0.06, 0.0, 0.05), (-0.03, 0.05, -0.05), (-0.03, -0.05, 0.05)]
    text = CUSTOM + "".join(f"[[rotors]]\npx_m = {x}\npy_m = {y}\nkm = {km}\n" for x, y, km in rotors)
    path = tmp_path / "three.toml"
    path.write_text(text, encoding="utf-8")
    what = Serving(f"json://127.0.0.1:{free_port()}", resolve_vehicle(str(path)), get_profile("sitl"), 0)
    with pytest.raises(UsageError, match="ArduPilot has no frame"):
        serve(what, lambda _: None)


def test_the_study_profile_is_refused() -> None:
    what = Serving(f"json://127.0.0.1:{free_port()}", resolve_vehicle("ant-x"), get_profile("study"), 0)
    with pytest.raises(UsageError, match='use profile "sitl"'):
        serve(what, lambda _: None)


def test_a_port_that_is_taken_is_said_so() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        link = f"json://127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(PortBusy):
            serve(Serving(link, resolve_vehicle("ant-x"), get_profile("sitl"), 0), lambda _: None)


def test_addresses() -> None:
    assert json_address("json://127.0.0.1:9012") == ("127.0.0.1", 9012)
    assert json_address("json://") == ("127.0.0.1", 9002)
    assert json_address("json://[::1]:9002") == ("::1", 9002)
    for url in ("json://127.0.0.1:x", "json://127.0.0.1:9002/a", "json:127.0.0.1", "jsonx://127.0.0.1:9002"):
        with pytest.raises(LinkUrlError, match=r"json://127\.0\.0\.1:9002"):
            json_address(url)
