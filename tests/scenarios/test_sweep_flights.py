"""The best of a sweep, flown over MAVLink and compared with the batch."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scenarios import hil_flights, one_flight, runner
from scenarios.cli import main
from scenarios.flown import Flown
from scenarios.limits import Limit
from scenarios.one_flight import MEMORY, FlightStoppedError, fly
from scenarios.run_reader import read_run
from scenarios.sweep import flying
from scenarios.sweep.as_flown import as_flown, lateness_s
from scenarios.sweep.best_flights import BestFlights, FlownPoint, gain_set_of, px4_reason, row_of, scenario_of
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.disagreements import sentence
from scenarios.sweep.engines import InProcess
from scenarios.sweep.explanations import explained
from scenarios.sweep.flight_comparison import CYCLES, Comparison, compare
from scenarios.sweep.plan import Plan, make_plan
from scenarios.sweep.program import program_facts
from scenarios.sweep.resuming import plan_of
from scenarios.sweep.sweep_file import load_sweep
from scenarios.sweep.sweeping import sweep_points
from sitl.errors import UsageError
from sitl.profile import get_profile

SWEEP = """
title = "Short"
samples = 3
setpoint_rate_hz = 50.0

[parameters]
MC_ROLLRATE_P = 0.05
MC_ROLLRATE_I = 0.05
MC_ROLLRATE_D = 0.001
IMU_GYRO_NF0_FRQ = 60.0

[axes]
vehicle = ["ant-x", "ant-r:ant-x"]
hover_thrust = [0.45]
gyro_noise_rad_s = [0.002]
MC_ROLL_P = [6.5, 60.0, 3.0, 5.0]
MC_AIRMODE = [0]

[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = 2.0
return_s = 0.6
"""


class _NoReport:
    """In the place of a report, which takes longer than a short flight."""

    def __enter__(self) -> _NoReport:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def landed(self, number: int, flight: object, telemetry: Path) -> None:
        pass

    def begin(self, folder: Path) -> None:
        pass

    def finish(self) -> None:
        pass


@pytest.fixture(scope="module", autouse=True)
def _reports() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "report_draft", lambda *_: _NoReport())
        yield


def swept(folder: Path, text: str = SWEEP) -> Path:
    """The folder of a sweep that is done, and of which nothing was flown."""
    file = folder / "short.toml"
    file.write_text(text)
    plan, dataset = make_plan(load_sweep(file)), Dataset(folder / "swept")
    dataset.create(plan, {"command": [], **program_facts()})
    with InProcess(plan, 1) as engine:
        sweep_points(plan, dataset, engine)
    return dataset.path


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Swept, and its best two flown."""
    path = swept(tmp_path_factory.mktemp("sweep"))
    assert "4 of 4 flights agree" in flying.fly_best(path, 2, jobs=1)
    return path


def plan_and_data(path: Path) -> tuple[Plan, Dataset]:
    dataset = Dataset(path)
    return plan_of(dataset, same_program=False), dataset


def best(plan: Plan, dataset: Dataset) -> list[int]:
    return [int(one) for one in flying.rank(flying.stored_sweep(dataset.path)).order]


def disagreements(path: Path) -> dict[str, Any]:
    return dict(json.loads((path / "flights" / "disagreements.json").read_text()))


class TestFlown:
    def test_one_run_a_case_with_the_sweep_s_own_conditions(self, sweep: Path) -> None:
        plan, dataset = plan_and_data(sweep)
        wanted = best(plan, dataset)[:2]
        flown = BestFlights(plan, dataset).flown()
        assert {(one.candidate, one.case, one.autopilot) for one in flown} == {
            (one, case, "own") for one in wanted for case in (0, 1)
        }
        assert len({one.run for one in flown}) == 2
        for point in flown:
            run = read_run(sweep / "flights" / point.run)
            assert run.complete
            flight = run.flight(f"candidate {point.candidate}")
            row = row_of(plan, dataset, point.candidate, point.case)
            uploaded = flight.data["uploaded"]
            assert uploaded["MC_ROLL_P"] == row["MC_ROLL_P"]
            assert uploaded["MC_AIRMODE"] == 0
            assert {uploaded[name] for name in ("MC_ROLLRATE_P", "MC_ROLLRATE_I")} == {0.05}
            assert uploaded["IMU_GYRO_NF0_FRQ"] == 60.0
            scenario = run.data["scenario"]
            assert scenario["vehicle"] == ("ant-x", "ant-r:ant-x")[point.case]
            assert scenario["assumptions"] == {"hover_thrust": 0.45}
            assert scenario["overrides"] == {"gyro_noise_rad_s": 0.002}
            assert scenario["title"] == f"Short: {plan.cases[point.case].name}"
            assert flight.files["parquet"].is_file()

    def test_a_second_time_only_what_is_missing(self, sweep: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        plan, dataset = plan_and_data(sweep)
        asked: list[tuple[str, list[str]]] = []

        def note(scenario: Any, options: Any, progress: Any, gain_sets: Any) -> Any:
            asked.append((scenario.vehicle, [one.name for one in gain_sets]))
            raise UsageError("flown by nobody")

        monkeypatch.setattr(runner, "run_scenario", note)
        order = best(plan, dataset)
        assert BestFlights(plan, dataset).fly(order[:2]).stopped is None
        assert asked == []
        stopped = BestFlights(plan, dataset).fly(order[:3]).stopped
        assert str(stopped) == "flown by nobody"
        assert asked == [("ant-x", [f"candidate {order[2]}"])]

    def test_another_plan_s_flights_do_not_count(self, sweep: Path) -> None:
        plan, dataset = plan_and_data(sweep)
        other = dataclasses.replace(plan, sweep=dataclasses.replace(plan.sweep, seed=2))
        assert BestFlights(plan, dataset).flown()
        assert BestFlights(other, dataset).flown() == []

    def test_a_run_that_was_removed_is_flown_again(self, sweep: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        plan, dataset = plan_and_data(sweep)
        gone = BestFlights(plan, dataset).flown()[0].run
        moved = sweep / "elsewhere"
        (sweep / "flights" / gone).rename(moved)
        assert gone not in {one.run for one in BestFlights(plan, dataset).flown()}
        moved.rename(sweep / "flights" / gone)

    def test_nobody_else_may_write_meanwhile(self, sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with Dataset(sweep).locked():
            assert main(["sweep", "--show", str(sweep), "--fly", "2"]) == 2
        assert "another froude sweep is writing here" in capsys.readouterr().err

    def test_what_was_flown_before_an_interrupt_stays(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = swept(tmp_path)
        begun: list[str] = []

        def fly_or_stop(job: Any, *args: Any, **keys: Any) -> Any:
            begun.append(job.gain_set.name)
            if len(begun) == 2:
                record = dataclasses.replace(
                    record_of[0],
                    gain_set=job.gain_set,
                    events=(one_flight.Event(1.0, 2, "flight stopped: interrupted"),),
                )
                raise FlightStoppedError(record, KeyboardInterrupt())
            record_of.append(fly(job, *args, **keys))
            return record_of[-1]

        record_of: list[Any] = []
        monkeypatch.setattr(runner, "fly", fly_or_stop)
        plan, dataset = plan_and_data(path)
        order = best(plan, dataset)
        assert main(["sweep", "--show", str(path), "--fly", "2", "--jobs", "1"]) == 130
        assert [(one.candidate, one.case) for one in BestFlights(plan, dataset).flown()] == [(order[0], 0)]
        assert not disagreements(path)["complete"]
        assert [one["candidate"] for one in disagreements(path)["flights"]] == [order[0]]
        monkeypatch.setattr(runner, "fly", lambda job, *_, **__: begun.append(job.gain_set.name) or record_of[0])
        begun.clear()
        BestFlights(plan, dataset).fly(order[:1])
        # of the second case alone; it is the airframe's own gain set, so that no baseline is flown
        assert begun == [f"candidate {order[0]}"]

    def test_bad_arguments(self, sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for arguments, told in (
            (["--fly", "-1"], "--fly -1: give 0 or more"),
            (["--px4", str(tmp_path)], "say how many with --fly K"),
            (["--fly", "1", "--px4", str(tmp_path)], "holds no bin/px4"),
        ):
            assert main(["sweep", "--show", str(sweep), *arguments]) == 2
            assert told in capsys.readouterr().err

    def test_nothing_complete_yet(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        file = tmp_path / "short.toml"
        file.write_text(SWEEP)
        plan = make_plan(load_sweep(file))
        Dataset(tmp_path / "empty").create(plan, {"command": []})
        assert main(["sweep", "--show", str(tmp_path / "empty"), "--fly", "1"]) == 2
        assert "no candidate is complete yet" in capsys.readouterr().err

    def test_an_index_that_is_damaged(self, sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
        index = sweep / "flights" / "flown.json"
        whole = index.read_text()
        index.write_text(whole[:50])
        assert main(["sweep", "--show", str(sweep), "--fly", "1"]) == 2
        assert "flown.json: cannot be read" in capsys.readouterr().err
        index.write_text(whole)


class TestScenario:
    @pytest.mark.parametrize(
        "axes",
        [
            'vehicle = ["ant-r:ant-x"]\nscaling = ["", "derivatives, uncertainty", "gain"]',
            'profile = ["study", "sitl", "board"]\nmotor_lag_s = [0.0, 0.02]\ndgyro_cutoff_hz = [25.0]',
            "transport_delay_ticks = { from = 0, to = 2, count = 3 }\nlimits = [true, false]\nyaw_damping_1_s = [0.3]",
        ],
    )
    def test_is_what_the_batch_flies(self, tmp_path: Path, axes: str) -> None:
        file = tmp_path / "s.toml"
        file.write_text(f"samples = 0\n[axes]\nMC_ROLL_P = [3.0]\n{axes}\n")
        plan = make_plan(load_sweep(file))
        assert len(plan.cases) > 2
        for number, case in enumerate(plan.cases):
            scenario = scenario_of(plan, number)
            assert scenario.resolve_profile() == case.profile
            assert scenario.resolve_vehicle() == case.model
            assert scenario.manoeuvres == plan.sweep.manoeuvres
            assert scenario.limits == plan.sweep.limits

    def test_a_real_autopilot_is_told_what_ours_has_from_the_case(self, sweep: Path) -> None:
        plan, dataset = plan_and_data(sweep)
        row = row_of(plan, dataset, 1, 0)
        own, real = (gain_set_of(plan, 0, row, real=real).parameters for real in (False, True))
        assert dict(real) == {"IMU_GYRO_CUTOFF": 40.0, "IMU_DGYRO_CUTOFF": 20.0, "MPC_THR_HOVER": 0.45, **own}
        assert isinstance(own["MC_AIRMODE"], int)
        assert isinstance(own["MC_ROLL_P"], float)

    @pytest.mark.parametrize(
        ("profile", "items", "told"),
        [
            ("sitl", {"motor_lag_s": 0.01, "transport_delay_ticks": 2, "gyro_cutoff_hz": 60.0}, ""),
            ("board", {}, "rate_hz = 800, and with a simulator it runs at 250 Hz"),
            ("study", {}, "not the linear model of the roll axis alone"),
            ("sitl", {"limits": False}, "its limits cannot be switched off"),
            ("sitl", {"attitude_late_ticks": 2.0}, "attitude_late_ticks = 2, and in a PX4 it is 0.5"),
            ("sitl", {"rate_sp_late_ticks": 0}, "rate_sp_late_ticks = 0, and in a PX4 it is 1"),
        ],
    )
    def test_what_a_px4_cannot_have(self, sweep: Path, profile: str, items: dict[str, Any], told: str) -> None:
        case = plan_and_data(sweep)[0].cases[0]
        reason = px4_reason(dataclasses.replace(case, profile=get_profile(profile, **items)))
        assert (told in reason) if told else reason == ""


def test_with_a_px4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Another autopilot flies in its place; ours flies beside it, and alone where it cannot fly."""
    jobs_of: list[Any] = []

    def fly_with_another(jobs: Any, *, hil: str, px4: Path | None, say: Any, progress: Any) -> Flown:
        jobs_of.extend(jobs)
        return Flown({k: fly(dataclasses.replace(job, connect=MEMORY)) for k, job in enumerate(jobs)})

    monkeypatch.setattr(hil_flights, "fly_with_autopilot", fly_with_another)
    path = swept(tmp_path, SWEEP.replace('["ant-x", "ant-r:ant-x"]', '["ant-x"]\nlimits = [true, false]'))
    made = tmp_path / "build"
    (made / "etc").mkdir(parents=True)
    (made / "bin").mkdir()
    (made / "bin" / "px4").write_text("#!/bin/sh\n")
    (made / "bin" / "px4").chmod(0o755)
    capsys.readouterr()
    assert main(["sweep", "--show", str(path), "--fly", "1", "--px4", str(made)]) == 0
    plan, dataset = plan_and_data(path)
    flown = {(one.case, one.autopilot): one.run for one in BestFlights(plan, dataset).flown()}
    assert set(flown) == {(0, "px4"), (0, "own"), (1, "own")}
    assert flown[0, "px4"] == flown[0, "own"] != flown[1, "own"]
    assert [job.parameters["IMU_DGYRO_CUTOFF"][0] for job in jobs_of if "candidate" in job.gain_set.name] == [20.0]
    told = disagreements(path)
    (left,) = told["left_out"]
    assert (left["case"], left["candidate"], left["autopilot"]) == (1, None, "px4")
    assert "limits = false" in left["reason"]
    assert {one["autopilot"] for one in told["flights"] if one["case"] == 0} == {"px4", "own"}
    output = capsys.readouterr()
    assert "not flown by the PX4: limits = false" in output.err
    assert "limits = false" in output.out
    # both are there: nobody flies again
    monkeypatch.setattr(runner, "run_scenario", None)
    flying.fly_best(path, 1, px4=made)


class TestCompared:
    def test_batch_and_flight_agree(self, sweep: Path) -> None:
        told = disagreements(sweep)
        assert told["complete"]
        assert len(told["flights"]) == 4
        for one in told["flights"]:
            assert one["agrees"], one
            assert one["verdicts_agree"]
            assert one["roll_rms_deg"] < 0.1
            metrics = {each["metric"]: each for each in one["metrics"]}
            assert metrics["delay_margin_s"]["difference"] == pytest.approx(0.0, abs=1e-12)
            assert metrics["peak_delta_lat"]["within"] is None
            assert metrics["overshoot_pct"]["unit"] == "%"
        assert told["agreeing"] == 4
        assert told["disagreements"] == []
        assert told["tolerances"]["droop_deg"] == {"unit": "deg", "absolute": 0.2, "share": 0.0, "judged": True}

    def compared(
        self, sweep: Path, *, flight: dict[str, Any] | None = None, limits: tuple[Limit, ...] = (), **changes: Any
    ) -> Comparison:
        """The best one's comparison with a row, or a flight, that is not what it was."""
        plan, dataset = plan_and_data(sweep)
        point = FlownPoint(best(plan, dataset)[0], 0, "own", "", plan.fingerprint)
        run = read_run(sweep / "flights" / next(one.run for one in BestFlights(plan, dataset).flown() if not one.case))
        if limits:
            plan = dataclasses.replace(plan, sweep=dataclasses.replace(plan.sweep, limits=limits))
        stored = run.flight(f"candidate {point.candidate}")
        values = {one["name"]: one for one in stored.data["metrics"] if not one["segment"]}
        for name, value in (flight or {}).items():
            if name in values:
                values[name] = {**values[name], **(value if isinstance(value, dict) else {"value": value})}
        data = {**stored.data, "metrics": list(values.values())}
        data |= {name: value for name, value in (flight or {}).items() if name in data and name != "metrics"}
        stored = dataclasses.replace(stored, data=data)
        row = row_of(plan, dataset, point.candidate, 0) | changes
        seen = as_flown(plan, 0, row)
        return explained(plan, compare(plan, point, row, seen.metrics, stored), seen, run, stored)

    def test_an_overshoot_that_is_not_the_batch_s(self, sweep: Path) -> None:
        before = self.compared(sweep)
        assert before.agrees
        overshoot = next(one for one in before.compared if one.metric == "overshoot_pct").flight
        assert overshoot is not None
        made = self.compared(sweep, flight={"overshoot_pct": overshoot + 1.6})
        (one,) = made.outside
        assert one.metric == "overshoot_pct"
        assert made.verdicts_agree
        assert not made.agrees
        assert "overshoot +1" in sentence(made)

    def test_a_verdict_that_is_not_the_batch_s(self, sweep: Path) -> None:
        made = self.compared(sweep, nominal_passes=False, flight={"outcome": "INFO"})
        assert not made.verdicts_agree
        assert "INFO in flight, FAIL in the batch" in sentence(made)
        assert "no reason is known" in sentence(made)
        assert self.compared(sweep, nominal_passes=True, flight={"outcome": "UNSET"}).verdicts_agree is False
        assert self.compared(sweep, nominal_passes=False, flight={"outcome": "FAIL"}).agrees

    def test_a_value_on_either_side_of_a_limit(self, sweep: Path) -> None:
        rise = next(one for one in self.compared(sweep).compared if one.metric == "rise_time_s")
        assert rise.batch is not None
        assert rise.flight is not None
        between = Limit("rise_time_s", maximum=0.5 * (rise.batch + rise.flight))
        passes = rise.batch < rise.flight
        made = self.compared(
            sweep, limits=(between,), nominal_passes=passes, flight={"outcome": "FAIL" if passes else "PASS"}
        )
        (reason,) = made.reasons
        assert "within the tolerance, and on either side of the limit" in reason

    def test_what_only_one_of_them_could_measure(self, sweep: Path) -> None:
        made = self.compared(sweep, flight={"rise_time_s": {"value": None, "reason": "never reaches 90 %"}})
        (one,) = made.outside
        assert one.difference is None
        assert one.reason == "never reaches 90 %"
        assert "never reaches 90 %" in sentence(made)
        other = self.compared(sweep, rise_time_s_nominal=None)
        assert [one.reason for one in other.outside] == ["the batch could not measure it"]
        assert self.compared(sweep, rise_time_s_nominal=None, flight={"rise_time_s": None}).agrees

    def test_infinite_margins(self, sweep: Path) -> None:
        infinite = {"gain_margin_high_db": {"value": None, "reason": "infinite"}}
        assert self.compared(sweep, gain_margin_high_db_nominal=float("inf"), flight=infinite).agrees
        made = self.compared(sweep, flight=infinite)
        assert [one.reason for one in made.outside] == ["only one of the two is infinite"]

    def test_known_reasons(self, sweep: Path) -> None:
        note = "step: not level, still and at height within 20 s (shaking: rates up to 2 rad/s); flown all the same"
        made = self.compared(
            sweep,
            flight={"overshoot_pct": 50.0, "q_std_rad_s": 1.5, "oscillation_rad_s": 1.5, "warnings": [note]},
        )
        text = " ".join(made.reasons)
        assert "not still when these began, and the batch begins from rest: step (shaking" in text
        assert "it shakes in pitch, 1.5 rad/s: the batch flies the roll axis alone" in text
        assert "gyro noise of 0.002 rad/s" in text
        nowhere = self.compared(sweep, flight={"segments": [], "reason": "arming refused", "overshoot_pct": 50.0})
        assert nowhere.reasons == ("the flight came to no manoeuvre: arming refused",)

    def test_in_a_limit_cycle_the_phase_is_not_judged(self, sweep: Path) -> None:
        made = self.compared(
            sweep,
            oscillation_rad_s_nominal=2.0,
            droop_deg_nominal=4.0,
            flight={"oscillation_rad_s": 1.5, "droop_deg": -4.0},
        )
        values = {one.metric: one for one in made.compared}
        assert values["oscillation_rad_s"].within
        assert values["droop_deg"].within is None
        assert values["droop_deg"].reason == CYCLES
        alone = self.compared(sweep, flight={"oscillation_rad_s": 1.5})
        assert "oscillation_rad_s" in {one.metric for one in alone.outside}

    @pytest.mark.parametrize(
        ("profile", "items", "late_ms"),
        # measured on flights beside the batch, by the lag of the tracking input
        [("study", {}, 2.5), ("board", {}, 3.1), ("sitl", {}, 5.9), ("sitl", {"attitude_late_ticks": 3.0}, 15.9)],
    )
    def test_lateness_is_what_flights_show(self, profile: str, items: dict[str, Any], late_ms: float) -> None:
        assert 1e3 * lateness_s(get_profile(profile, **items)) == pytest.approx(late_ms, abs=0.2)
