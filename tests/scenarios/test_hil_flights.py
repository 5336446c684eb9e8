"""Flights with an autopilot that is not in this program: our own, fed by nothing but the simulator protocol on TCP."""

from __future__ import annotations

import contextlib
import io
import json
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from hil_autopilot import AutopilotOnWire, facts, warm
from px4_stand_in import Faults, StandIn

from bridge.errors import HilUnfit
from scenarios import hil_session
from scenarios.cli import main
from scenarios.faults import parse_faults
from scenarios.flight import FlightRecord
from scenarios.limits import Outcome
from scenarios.manoeuvres import make_manoeuvre
from scenarios.runner import RunOptions, RunResult, run_scenario
from scenarios.scenario import Scenario, load_scenario

SETTLES = "table_7_2/ADAM-0"
BASELINE = "table_2_2/ANT-X"
STEP = {"amplitude_deg": 10.0, "hold_s": 2.0, "return_s": 0.6}


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Ports:
    """Where simulator and MAVLink meet."""

    def __init__(self) -> None:
        self.simulator, self.programs = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM)
        self.hil = f"tcpin://127.0.0.1:{self.simulator}"
        self.connect = f"udpin://127.0.0.1:{self.programs}"


@pytest.fixture(autouse=True)
def _own_journals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FROUDE_STATE_DIR", str(tmp_path / "state"))
    # a busy computer is no silent autopilot
    monkeypatch.setattr(hil_session, "Lockstep", partial(hil_session.Lockstep, answer_s=30.0))


class Wired:
    """The autopilot in its thread, and where it is to be met."""

    def __init__(self, stack: ExitStack, *, vehicle: str = "ant-x", sysid: int = 1) -> None:
        warm()
        self.ports = Ports()
        self.brain = AutopilotOnWire(f"udpout://127.0.0.1:{self.ports.programs}", vehicle=vehicle, sysid=sysid)
        self.faults = Faults(truth_us=AutopilotOnWire.TRUTH_US)
        self.stand_in = StandIn(self.ports.simulator, self.brain, sysid=sysid, faults=self.faults)
        self.before = self.values()
        stack.enter_context(self.stand_in)

    def values(self) -> dict[str, bytes]:
        table = self.brain.vehicle.parameters
        return {name: table.raw(name) for name in table.names}

    @property
    def height_m(self) -> float:
        return -self.brain.vehicle.estimate.position_ned()[2]

    def in_flight(self, run: Callable[[], object], height_m: float = 1.0) -> None:
        """Do this once, when it is up there."""
        done: list[bool] = []

        def look(_: StandIn) -> None:
            if not done and self.brain.armed and self.height_m > height_m:
                done.append(True)
                run()

        self.stand_in.each_sample(look)

    def options(self, **keys: Any) -> RunOptions:
        return RunOptions(hil=self.ports.hil, connect=self.ports.connect, **keys)


@pytest.fixture
def wired() -> Iterator[Callable[..., Wired]]:
    with ExitStack() as stack:
        yield lambda **keys: Wired(stack, **keys)


def scenario(*gain_sets: str, **changes: Any) -> Scenario:
    step = make_manoeuvre("step", **STEP)
    asked = {"gain_sets": gain_sets, "takeoff_altitude_m": 3.0, "manoeuvres": (step,), **changes}
    return replace(load_scenario("roll_step"), **asked)


@dataclass
class Both:
    """The same sets flown in memory and over the wire."""

    memory: RunResult
    wire: RunResult
    wired: Wired
    said: list[str]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Both]:
    flown = scenario(SETTLES)
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        patch.setenv("FROUDE_STATE_DIR", str(tmp_path_factory.mktemp("state")))
        patch.setattr(hil_session, "Lockstep", partial(hil_session.Lockstep, answer_s=30.0))
        wired = Wired(stack)
        said: list[str] = []
        wire = run_scenario(flown, wired.options(out=None, say=said.append))
        yield Both(run_scenario(flown, RunOptions(out=None)), wire, wired, said)


def flights(result: RunResult) -> list[FlightRecord]:
    assert result.stopped is None
    baseline = result.run.baseline
    return [*result.run.flights, *([baseline] if baseline else [])]


def pairs(both: Both) -> list[tuple[FlightRecord, FlightRecord]]:
    return list(zip(flights(both.memory), flights(both.wire), strict=True))


class TestTheSameFlight:
    def test_every_verdict_is_the_same(self, both: Both) -> None:
        assert len(pairs(both)) == 2
        for ours, theirs in pairs(both):
            assert theirs.outcome is ours.outcome, (theirs.reason, facts(both.wired.brain))

    @pytest.mark.parametrize(
        ("metric", "near"),
        [("overshoot_pct", 1.5), ("settling_time_5pct_s", 0.05), ("rise_time_s", 0.02), ("droop_deg", 0.15)],
    )
    def test_so_is_what_was_measured(self, both: Both, metric: str, near: float) -> None:
        for ours, theirs in pairs(both):
            one, other = ours.metric(metric), theirs.metric(metric)
            assert one is not None
            assert other is not None
            if one.value is None:
                assert other.value is None
            else:
                assert other.value == pytest.approx(one.value, abs=near)

    def test_something_settled_and_something_did_not(self, both: Both) -> None:
        settled = [ours.metric("settling_time_5pct_s").value is not None for ours, _ in pairs(both)]  # type: ignore[union-attr]
        assert settled == [True, False]

    def test_truth_stands_beside_the_estimate(self, both: Both) -> None:
        for record in flights(both.wire):
            rows = record.telemetry
            true, believed = np.array(rows["phi_true_rad"]), np.array(rows["phi_rad"])
            known = np.isfinite(true)
            assert known.mean() > 0.95
            assert np.degrees(np.abs(true - believed)[known].max()) < 0.5

    def test_it_was_in_step_all_the_time_and_says_so(self, both: Both) -> None:
        for record in flights(both.wire):
            assert record.timing.startswith("lockstep:")
        assert both.wired.stand_in.problems == []
        assert both.wired.stand_in.rules.asked_for_truth

    def test_the_autopilot_has_its_own_parameters_back(self, both: Both) -> None:
        assert both.wired.values() == both.wired.before
        assert not both.wired.brain.armed


def test_faults_of_plant_sensors_and_link_do_the_same_to_both(wired: Callable[..., Wired]) -> None:
    step = make_manoeuvre("step", amplitude_deg=10.0, hold_s=3.0, return_s=0.6)
    at = {"manoeuvre": "step", "at_s": 1.2}
    faults = (
        {"kind": "gust", "side_force_n": 1.0, "roll_accel_deg_s2": 300.0, "duration_s": 0.5, **at},
        {"kind": "motor_efficiency", "motor": 1, "efficiency_pct": 90.0, "duration_s": 0.5, **at},
        {"kind": "loop_delay", "delay_ticks": 2, **at},
        {"kind": "link_loss", "loss_pct": 20.0, **at},
        {"kind": "parameter", "parameter": "MC_ROLL_P", "value": 6.0, **at},
    )
    planned = parse_faults(list(faults), Path("test.toml"), (step,))
    flown = scenario(BASELINE, manoeuvres=(step,), faults=planned)
    one = wired()
    result = run_scenario(flown, one.options(out=None))
    assert result.stopped is None
    (twin,) = result.run.twins
    assert [fault.text for fault in twin.flight.faults] == [fault.text for fault in planned]
    for theirs, ours in zip(twin.flight.faults, twin.own.faults, strict=True):
        begin_s, own_begin_s = (record.segments[0].start_s for record in (twin.flight, twin.own))
        assert theirs.start_s is not None
        assert ours.start_s is not None
        assert theirs.start_s - begin_s == pytest.approx(ours.start_s - own_begin_s, abs=0.0041)
    deviations = [record.metric("fault_roll_deviation_deg") for record in (twin.flight, twin.own)]
    values = [metric.value for metric in deviations if metric is not None and metric.value is not None]
    assert values[0] > 3.0
    assert values[0] == pytest.approx(values[1], abs=0.3)
    assert one.values() == one.before


def run_cli(*words: str) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(words)
    return status, out.getvalue(), err.getvalue()


def short_file(folder: Path) -> Path:
    path = folder / "short.toml"
    path.write_text(
        'vehicle = "ant-x"\ngain_sets = ["table_2_2/ANT-X"]\ntakeoff_altitude_m = 2.5\n\n'
        '[[manoeuvre]]\nkind = "step"\namplitude_deg = 10.0\nhold_s = 1.0\nreturn_s = 0.4\n'
    )
    return path


class TestFromTheCommandLine:
    def test_a_whole_flight(self, wired: Callable[..., Wired], tmp_path: Path) -> None:
        one = wired(sysid=2)
        out = tmp_path / "logs"
        status, _, said = run_cli(
            "fly", str(short_file(tmp_path)), "--hil", one.ports.hil, "--connect", one.ports.connect, "--out", str(out)
        )
        assert status == 0, said
        (run_file,) = out.glob("*/run.json")
        run = json.loads(run_file.read_text())
        assert run["complete"] is True
        assert one.stand_in.problems == []
        assert one.values() == one.before

    def test_killed_in_flight_what_was_flown_is_kept(self, wired: Callable[..., Wired], tmp_path: Path) -> None:
        one = wired()
        one.in_flight(one.stand_in.drop)
        out = tmp_path / "logs"
        status, _, said = run_cli(
            "fly", str(short_file(tmp_path)), "--hil", one.ports.hil, "--connect", one.ports.connect, "--out", str(out)
        )
        assert status == 3
        assert "simulator's port" in said
        assert str(out) in said
        (run_file,) = out.glob("*/run.json")
        assert json.loads(run_file.read_text())["complete"] is False
        assert list((run_file.parent / "flights").glob("*"))

    @pytest.mark.parametrize(
        ("words", "says"),
        [
            (("--hil", "udpin://127.0.0.1:4560", "--connect", "udpin://127.0.0.1:14540"), "needs TCP"),
            (("--hil", "tcpin://127.0.0.1:4560"), "--connect"),
            (("--hil", "tcpin://127.0.0.1:4560", "--px4", "/nowhere"), "--px4"),
        ],
    )
    def test_what_cannot_be_meant_is_refused(self, words: tuple[str, ...], says: str, tmp_path: Path) -> None:
        status, _, said = run_cli("fly", str(short_file(tmp_path)), *words, "--out", str(tmp_path / "logs"))
        assert status == 2
        assert says in said
        assert not list(tmp_path.glob("logs/*"))

    def test_a_busy_port_is_named(self, tmp_path: Path) -> None:
        with socket.socket() as holder:
            holder.bind(("127.0.0.1", 0))
            holder.listen()
            port = holder.getsockname()[1]
            status, _, said = run_cli(
                "fly", str(short_file(tmp_path)), "--hil", f"tcpin://127.0.0.1:{port}",
                "--connect", Ports().connect, "--out", str(tmp_path / "logs"),
            )  # fmt: skip
        assert status == 3
        assert str(port) in said

    def test_nobody_comes(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        drive = hil_session.HilDrive
        monkeypatch.setattr(hil_session, "HilDrive", lambda lockstep: drive(lockstep, patience_s=0.2))
        ports = Ports()
        status, _, said = run_cli(
            "fly", str(short_file(tmp_path)), "--hil", ports.hil, "--connect", ports.connect,
            "--out", str(tmp_path / "logs"),
        )  # fmt: skip
        assert status == 3
        assert "PX4_SIM_MODEL" in said
        assert not list(tmp_path.glob("logs/*"))


class TestAwkwardAutopilots:
    def test_one_answer_left_out_in_flight_makes_it_worthless(
        self, wired: Callable[..., Wired], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(hil_session, "Lockstep", partial(hil_session.Lockstep, answer_s=0.2))
        one = wired()

        def begin() -> None:
            one.faults.mute_armed = True
            until = one.stand_in.taken + 3
            one.stand_in.each_sample(lambda it: setattr(it.faults, "mute_armed", it.taken <= until))

        one.in_flight(begin)
        said: list[str] = []
        result = run_scenario(scenario("table_2_2/ANT-X"), one.options(out=None, say=said.append))
        (record,) = result.run.flights
        assert record.outcome is Outcome.UNSET
        assert "invalid" in record.reason
        assert "has not answered since" in record.reason
        assert any("answers again" in line for line in said)
        assert not one.brain.armed

    def test_outputs_that_were_never_assigned_are_found_in_seconds(self, wired: Callable[..., Wired]) -> None:
        """An octocopter whose outputs five to eight nobody set: it would tip over, and did, over and over."""
        one = wired(vehicle="carrier-1")
        one.faults.octo = True
        flown = scenario("table_2_2/CARRIER-1", vehicle="carrier-1")
        result = run_scenario(flown, one.options(out=None))
        assert isinstance(result.stopped, HilUnfit)
        assert "motors 5, 6, 7, 8 are 0" in str(result.stopped)
        assert result.run.flights[0].outcome is Outcome.UNSET
        assert not one.brain.armed
