"""Whole runs: what they leave behind, that it can be repeated and recomputed, and how they stop."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from bridge.errors import PeerSilent, UploadFailed
from scenarios import runner
from scenarios.gain_set import GainSet, load_gain_sets
from scenarios.limits import Outcome
from scenarios.manoeuvres import make_manoeuvre
from scenarios.one_flight import FlightStoppedError
from scenarios.runner import Progress, RunOptions, plan, run_scenario
from scenarios.table import own_gains_line, run_text
from sitl.errors import FileError, FroudeError, LinkError, UsageError

SETS = ("table_2_2/ANT-X", "table_7_2/ANT-R", "table_7_2/ADAM-0")
SIGNAL = {"peak_deg": 10.0, "duration_s": 4.0, "frequencies_hz": [0.5, 1.4], "phases_rad": [0.0, 2.1]}


@pytest.fixture(scope="module")
def scenario(quick_scenario: Any) -> Any:
    """A step and a signal to track, from a standing start, with three sets: quick, shaking, slow."""
    step = make_manoeuvre("step", amplitude_deg=10.0, hold_s=3.0, return_s=2.0)
    track = make_manoeuvre("multisine", "track", return_s=2.0, **SIGNAL)
    return quick_scenario(gain_sets=SETS, manoeuvres=(step, track))


@pytest.fixture(scope="module")
def folder(scenario: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    result = run_scenario(scenario, RunOptions(out=tmp_path_factory.mktemp("runs")))
    assert result.stopped is None
    assert result.folder is not None
    return result.folder


@pytest.fixture(scope="module")
def run(folder: Path) -> Any:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def columns(folder: Path, flight: Any) -> dict[str, Any]:
    table = pq.read_table(folder / flight["files"]["parquet"])
    return {name: table[name].to_numpy() for name in table.column_names}


def value(flight: Any, name: str, segment: str = "") -> float | None:
    (metric,) = [m for m in flight["metrics"] if m["name"] == name and m["segment"] == segment]
    found: float | None = metric["value"]
    return found


class TestRecomputed:
    """run.json out of the Parquet files alone, by code that shares nothing with the program."""

    def test_hash(self, folder: Path, run: Any) -> None:
        for flight in run["flights"]:
            digest = hashlib.sha256()
            table = pq.read_table(folder / flight["files"]["parquet"])
            for name in table.column_names:
                column = table[name].to_numpy()
                digest.update(column.astype(column.dtype.newbyteorder("<")).tobytes())
            assert digest.hexdigest() == flight["telemetry_sha256"]
            assert len(table) == flight["rows"]

    def test_segments_are_in_the_telemetry(self, folder: Path, run: Any) -> None:
        for flight in run["flights"]:
            rows = columns(folder, flight)
            assert [s["name"] for s in flight["segments"]] == ["step/1", "step/2", "track/1", "track/2"]
            for index, segment in enumerate(flight["segments"]):
                t = rows["t_s"][rows["segment"] == index]
                assert segment["start_s"] <= t[0] < segment["start_s"] + 0.005
                assert segment["end_s"] - 0.005 <= t[-1] < segment["end_s"]
            assert (rows["armed"][rows["segment"] >= 0]).all()
            assert (rows["nav_state"][rows["segment"] >= 0] == 14).all()

    def test_step(self, folder: Path, run: Any) -> None:
        for flight in run["flights"]:
            rows, segment = columns(folder, flight), flight["segments"][0]
            mine = rows["segment"] == 0
            t, phi = rows["t_s"][mine] - segment["start_s"], rows["phi_rad"][mine].astype(float)
            wanted = math.radians(10.0)
            assert np.median(rows["phi_sp_rad"][mine]) == pytest.approx(wanted, abs=1e-6)
            last = t >= 2.0 - 1e-6
            assert value(flight, "droop_deg") == pytest.approx(
                math.degrees(average(t[last], phi[last]) - wanted), abs=5e-3
            )
            if flight["gain_set"]["name"] == "7.2 ANT-R":
                for name in ("overshoot_pct", "rise_time_s", "settling_time_5pct_s", "settling_time_2pct_s"):
                    assert value(flight, name) is None  # in a limit cycle they mean nothing
                continue
            over = 100.0 * max(0.0, phi.max() / wanted - 1.0)
            assert value(flight, "overshoot_pct") == pytest.approx(over, abs=1e-3)
            assert value(flight, "rise_time_s") == pytest.approx(
                reaches(t, phi, 0.9 * wanted) - reaches(t, phi, 0.1 * wanted), abs=1e-4
            )
            for name, band in (("settling_time_5pct_s", 0.05), ("settling_time_2pct_s", 0.02)):
                assert value(flight, name) == pytest.approx(settled(t, phi, wanted, band * wanted), abs=1e-4)

    def test_tracking(self, folder: Path, run: Any) -> None:
        for flight in run["flights"]:
            rows = columns(folder, flight)
            mine = rows["segment"] == 2
            t = rows["t_s"][mine]
            phi, phi_sp = rows["phi_rad"][mine].astype(float), rows["phi_sp_rad"][mine].astype(float)
            left = 1.0 - deviation(t, phi_sp - phi) ** 2 / deviation(t, phi_sp) ** 2
            assert value(flight, "vaf_pct") == pytest.approx(100.0 * left, abs=0.02)
            rms = math.degrees(math.sqrt(average(t, (phi_sp - phi) ** 2)))
            assert value(flight, "rms_error_deg") == pytest.approx(rms, rel=1e-3)
            lag_s = value(flight, "lag_s")
            if flight["gain_set"]["name"] == "7.2 ANT-R":
                continue
            assert lag_s == pytest.approx(best_lag(t, phi, phi_sp), abs=3e-3)
            assert lag_s is not None
            inside = t + lag_s <= t[-1]
            error = phi_sp[inside] - np.interp(t[inside] + lag_s, t, phi)
            left = 1.0 - (deviation(t[inside], error) / deviation(t[inside], phi_sp[inside])) ** 2
            assert value(flight, "vaf_lag_removed_pct") == pytest.approx(100.0 * left, abs=0.02)

    def test_effort_and_oscillation(self, folder: Path, run: Any) -> None:
        for flight in run["flights"]:
            rows = columns(folder, flight)
            flown = rows["segment"] >= 0
            assert value(flight, "peak_delta_lat") == pytest.approx(np.abs(rows["delta_lat"][flown]).max(), rel=1e-6)
            ends = [s["end_s"] for s in flight["segments"] if s["kind"] in ("step", "hold")]
            worst: dict[str, float] = {}
            for name in ("p", "q", "r"):
                rate, t = rows[f"{name}_rad_s"].astype(float), rows["t_s"]
                spread = [deviation(t[k], rate[k]) for end in ends for k in [(t >= end - 1 - 1e-6) & (t < end - 1e-6)]]
                worst[name] = max(spread)
                assert value(flight, f"{name}_std_rad_s") == pytest.approx(worst[name], rel=1e-3, abs=1e-6)
            assert value(flight, "oscillation_rad_s") == pytest.approx(max(worst.values()), rel=1e-3)
            if flight["gain_set"]["name"] == "7.2 ANT-R":
                k = (t >= ends[0] - 1.0) & (t < ends[0])
                crossings = np.flatnonzero(np.diff(np.sign(rows["p_rad_s"][k])))
                hertz = (len(crossings) - 1) / 2 / (t[k][crossings[-1]] - t[k][crossings[0]])
                assert value(flight, "oscillation_hz") == pytest.approx(hertz, abs=0.3)

    def test_delta_is_what_the_motors_say(self, folder: Path, run: Any) -> None:
        """On a square X: a quarter of right motors down, left motors up, over the mix's half."""
        for flight in run["flights"]:
            rows = columns(folder, flight)
            flown = rows["segment"] >= 0
            one, two, three, four = (rows[f"motor{n}"][flown].astype(float) for n in range(1, 5))
            assert rows["delta_lat"][flown] == pytest.approx(
                (two + three - one - four) / (4 * math.sqrt(0.5)), abs=1e-6
            )

    def test_verdicts_follow_from_the_metrics(self, run: Any) -> None:
        for flight in run["flights"]:
            limited = [m["outcome"] for m in flight["metrics"] if m["limit"] is not None]
            wanted = "FAIL" if "FAIL" in limited else "UNSET" if "UNSET" in limited else "PASS"
            assert flight["outcome"] == wanted
        assert [flight["outcome"] for flight in run["flights"]] == ["PASS", "FAIL", "FAIL"]
        assert run["passed"] == 1


def average(t: Any, y: Any) -> float:
    fine = np.linspace(t[0], t[-1], 20 * len(t))
    return float(np.interp(fine, t, y).mean())


def deviation(t: Any, y: Any) -> float:
    return math.sqrt(max(0.0, average(t, (y - average(t, y)) ** 2)))


def reaches(t: Any, y: Any, level: float) -> float:
    fine = np.linspace(t[0], t[-1], 400 * len(t))
    return float(fine[np.argmax(np.interp(fine, t, y) >= level)])


def settled(t: Any, y: Any, wanted: float, band: float) -> float | None:
    if abs(y[-1] - wanted) > band:
        return None
    fine = np.linspace(t[0], t[-1], 400 * len(t))
    outside = np.abs(np.interp(fine, t, y) - wanted) > band
    return float(fine[np.flatnonzero(outside)[-1]])


def best_lag(t: Any, phi: Any, phi_sp: Any) -> float:
    """Of delays from 0 to 1 s in steps of 1 ms, the one with the largest product of set-point and later angle."""
    lags = np.arange(0.0, 1.0, 1e-3)
    fine = np.arange(t[0], t[-1] - 1e-9, 2e-3)
    held = phi_sp[np.searchsorted(t, fine + 1e-9, side="right") - 1] - phi_sp.mean()
    score = []
    for lag in lags:
        inside = fine + lag <= t[-1]
        score.append(held[inside] @ (np.interp(fine[inside] + lag, t, phi) - phi.mean()))
    return float(lags[int(np.argmax(score))])


class TestRepeatable:
    def test_side_by_side_or_one_after_the_other_is_the_same(
        self, scenario: Any, folder: Path, run: Any, tmp_path: Path
    ) -> None:
        result = run_scenario(scenario, RunOptions(out=tmp_path, jobs=2, report=False))
        assert result.folder is not None
        other = json.loads((result.folder / "run.json").read_text(encoding="utf-8"))
        for one, two in zip(run["flights"], other["flights"], strict=True):
            assert one == two
            for kind in ("parquet", "tlog", "params", "backup.params"):
                file = one["files"][kind]
                assert (folder / file).read_bytes() == (result.folder / file).read_bytes(), file

    def test_another_seed_is_another_flight_with_the_same_verdicts(self, scenario: Any, run: Any) -> None:
        result = run_scenario(dataclasses.replace(scenario, seed=99), RunOptions(out=None))
        hashes = {flight.telemetry_sha256 for flight in result.run.flights}
        assert not hashes & {flight["telemetry_sha256"] for flight in run["flights"]}
        assert [str(flight.outcome) for flight in result.run.flights] == [f["outcome"] for f in run["flights"]]
        assert result.folder is None


class TestFolder:
    def test_everything_is_there_and_nothing_else(self, folder: Path, run: Any) -> None:
        names = ["compare.rrd", "flights", "junit.xml", "report.html", "run.json"]
        assert sorted(path.name for path in folder.iterdir()) == names
        kinds = {"rrd", "parquet", "tlog", "params", "backup.params"}
        assert all(set(flight["files"]) == kinds for flight in run["flights"])
        named = {file for flight in run["flights"] for file in flight["files"].values()}
        assert {str(path.relative_to(folder)) for path in (folder / "flights").iterdir()} == named

    def test_the_log_holds_the_upload_and_the_restore(self, folder: Path, run: Any) -> None:
        from pymavlink import mavutil

        reader = mavutil.mavlink_connection(str(folder / run["flights"][0]["files"]["tlog"]), dialect="common")
        sets = []
        while (message := reader.recv_match(type="PARAM_SET")) is not None:
            sets.append((message.param_id, message.param_value))
        reader.close()
        uploaded = run["flights"][0]["uploaded"]
        assert {name for name, _ in sets} == set(uploaded)
        flown = {name: np.float32(number) for name, number in uploaded.items()}
        assert dict(sets[: len(flown)]) == pytest.approx(flown)
        lines = (folder / run["flights"][0]["files"]["backup.params"]).read_text().splitlines()
        before = {line.split("\t")[2]: np.float32(line.split("\t")[3]) for line in lines if line[0] != "#"}
        assert dict(sets[len(flown) :]) == pytest.approx(before)

    def test_when_it_began_is_told_the_way_the_folder_is_named(self, folder: Path, run: Any) -> None:
        assert run["started_utc"].replace("-", "").replace(":", "") == folder.name.partition("_")[0]


class TestPlan:
    def planned(self, scenario: Any, gains: dict[str, Any]) -> Any:
        return plan(GainSet("x", gains), scenario, scenario.resolve_vehicle(), scenario.resolve_profile())

    def test_roll_flies_the_set_and_pitch_the_airframes_own(self, quick_scenario: Any) -> None:
        job = self.planned(quick_scenario(), {"MC_ROLL_P": 9.0, "IMU_GYRO_CUTOFF": 30.0})
        assert job.parameters["MC_ROLL_P"] == (9.0, "REAL32")
        assert job.parameters["MC_PITCH_P"] == (6.5, "REAL32")
        assert job.parameters["IMU_GYRO_CUTOFF"] == (30.0, "REAL32")
        assert "MC_ROLLRATE_P" not in job.parameters

    def test_both_axes_fly_the_set_but_for_what_it_says_of_pitch(self, quick_scenario: Any) -> None:
        gains = {"MC_ROLL_P": 9.0, "MC_ROLLRATE_P": 0.1, "MC_PITCHRATE_P": 0.2}
        job = self.planned(quick_scenario(axes="both"), gains)
        assert job.parameters["MC_PITCH_P"] == (9.0, "REAL32")
        assert job.parameters["MC_PITCHRATE_P"] == (0.2, "REAL32")

    def test_warnings_are_for_what_is_out_of_range_as_it_is_stored(self, quick_scenario: Any) -> None:
        assert self.planned(quick_scenario(), {"MC_ROLLRATE_P": 0.01}).warnings == ()
        (warning,) = self.planned(quick_scenario(), {"MC_ROLLRATE_P": 0.6}).warnings
        assert warning == "MC_ROLLRATE_P = 0.6 is above PX4's maximum of 0.5 by 0.1, 1.2 times it; flown anyway"

    def test_own_gains_are_flown_along_unless_they_are_a_candidate(self, scenario: Any, run: Any) -> None:
        assert run["baseline"] is None
        assert run["own_gains"] == {"gain_set": "2.2 ANT-X", "fly": True, "outcome": "PASS", "reason": ""}
        others = dataclasses.replace(scenario, gain_sets=SETS[1:2], manoeuvres=scenario.manoeuvres[:1])
        result = run_scenario(others, RunOptions(out=None))
        assert result.run.baseline is not None
        assert result.run.baseline.gain_set.name == "own ANT-X"
        assert "(own ANT-X) fly under these" in own_gains_line(result.run)

    def test_a_candidate_of_that_name_keeps_its_files(self, quick_scenario: Any, tmp_path: Path) -> None:
        file = tmp_path / "mine.toml"
        file.write_text('[[gain_set]]\nname = "own ANT-X"\n[gain_set.parameters]\nMC_ROLL_P = 5.0\n')
        result = run_scenario(quick_scenario(gain_sets=(str(file),)), RunOptions(out=tmp_path, report=False))
        assert result.folder is not None
        assert (result.folder / "flights" / "own_ant-x.parquet").is_file()
        assert (result.folder / "flights" / "own_ant-x_baseline.parquet").is_file()

    def test_names_in_any_script_of_any_length_have_files_of_their_own(
        self, quick_scenario: Any, tmp_path: Path
    ) -> None:
        names = ["增益一", "增益二", "a/b\\c:d", "x" * 300, "x" * 301, "../../etc/passwd", "Zürich"]
        tables = [f"[[gain_set]]\nname = {json.dumps(name)}\nparameters.MC_ROLL_P = 5.0\n" for name in names]
        file = tmp_path / "mine.toml"
        file.write_text("\n".join(tables), encoding="utf-8")
        scenario = quick_scenario(gain_sets=(str(file),), manoeuvres=(), vehicle="ant-x")
        result = run_scenario(scenario, RunOptions(out=tmp_path / "runs", report=False))
        assert result.folder is not None
        run = json.loads((result.folder / "run.json").read_text(encoding="utf-8"))
        assert [flight["gain_set"]["name"] for flight in run["flights"]] == names
        files = {flight["files"]["parquet"] for flight in run["flights"]}
        assert len(files) == len(names)
        assert all((result.folder / file).resolve().parent == (result.folder / "flights").resolve() for file in files)


class TestOptions:
    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"jobs": 0}, "--jobs 0: give 1 or more"),
            ({"jobs": 2, "connect": "udpin://127.0.0.1:14540"}, "leave out --connect"),
            ({"jobs": 2, "live_port": 9876}, "--live shows one flight at a time"),
            ({"connect": "serial:///dev/ttyACM0:57600"}, "--arm-hardware"),
        ],
    )
    def test_options_that_exclude_each_other(self, options: dict[str, Any], says: str) -> None:
        with pytest.raises(UsageError, match=says):
            RunOptions(**options)

    def test_nothing_to_fly(self, quick_scenario: Any) -> None:
        with pytest.raises(UsageError, match="no gain sets to fly"):
            run_scenario(quick_scenario(gain_sets=()), RunOptions(out=None))

    def test_a_place_that_is_no_folder(self, quick_scenario: Any, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(FileError, match=r"the run's folder cannot be made.*--out"):
            run_scenario(quick_scenario(), RunOptions(out=tmp_path / "file"))


class TestStopped:
    def test_by_ctrl_c_in_the_second_flight(self, scenario: Any, tmp_path: Path) -> None:
        def progress(at: Progress) -> None:
            if (at.index, at.phase) == (1, "track"):
                raise KeyboardInterrupt

        result = run_scenario(scenario, RunOptions(out=tmp_path, report=False), progress)
        assert isinstance(result.stopped, KeyboardInterrupt)
        assert result.folder is not None
        run = json.loads((result.folder / "run.json").read_text(encoding="utf-8"))
        assert run["complete"] is False
        assert [flight["outcome"] for flight in run["flights"]] == ["PASS", "UNSET"]
        second = run["flights"][1]
        assert second["reason"].startswith("interrupted")
        assert [segment["name"] for segment in second["segments"]] == ["step/1", "step/2"]
        assert set(second["files"]) == {"rrd", "parquet", "tlog", "params", "backup.params"}
        text = run_text(result.run, result.folder)
        assert "flights that are not listed were not flown" in text

    def test_before_anything_was_flown_leaves_nothing(self, scenario: Any, tmp_path: Path) -> None:
        def progress(at: Progress) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            run_scenario(scenario, RunOptions(out=tmp_path), progress)
        assert list(tmp_path.iterdir()) == []

    def test_an_interrupted_baseline_is_no_verdict_on_the_assumptions(self, quick_scenario: Any) -> None:
        def progress(at: Progress) -> None:
            if (at.index, at.phase) == (1, "step"):
                raise KeyboardInterrupt

        result = run_scenario(quick_scenario(gain_sets=SETS[1:2]), RunOptions(out=None), progress)
        line = own_gains_line(result.run)
        assert line.startswith("Whether the airframe's own flight gains (own ANT-X) fly here is not known: interrupted")

    def test_by_a_file_that_cannot_be_written(
        self, scenario: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The flights are on disk and the table is printed all the same."""

        def full(*_: Any) -> None:
            raise FileError("compare.rrd", "cannot be written: No space left on device")

        monkeypatch.setattr("scenarios.recorder.comparison.record_compare", full)
        result = run_scenario(dataclasses.replace(scenario, gain_sets=SETS[:1]), RunOptions(out=tmp_path))
        assert isinstance(result.stopped, FileError)
        assert result.folder is not None
        assert (result.folder / "run.json").is_file()
        assert result.run.flights[0].outcome is Outcome.PASS

    def test_by_a_flights_process_that_was_killed(self, scenario: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(runner, "fly", _die)
        with pytest.raises(LinkError, match=r"a process that flew was killed.*without --jobs"):
            run_scenario(scenario, RunOptions(out=None, jobs=2))


def _die(*_: Any) -> None:
    import os

    os._exit(9)


@pytest.mark.parametrize(
    "error",
    [
        FileError("a.toml", "key x", "Correct it"),
        UploadFailed("MC_ROLL_P", 1.0, None, "no answer"),
        PeerSilent("udpin://127.0.0.1:1", 5.0, "a vehicle", "Start it"),
        UsageError("no"),
    ],
)
def test_errors_come_back_whole_from_another_process(error: FroudeError, flown_run: Any) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), again.exit_status) == (type(error), str(error), error.exit_status)
    assert again.__dict__ == error.__dict__
    stop = pickle.loads(pickle.dumps(FlightStoppedError(flown_run.flights[0], error, "land it")))
    assert (str(stop.cause), stop.owed) == (str(error), "land it")
    assert stop.record.telemetry_sha256 == flown_run.flights[0].telemetry_sha256


def test_the_studys_and_px4s_sets_can_be_planned_for_every_airframe(quick_scenario: Any) -> None:
    for vehicle in ("ant-r", "ant-x", "carrier-1", "adam-0", "ant-r:ant-x"):
        scenario = quick_scenario(vehicle=vehicle)
        model, profile = scenario.resolve_vehicle(), scenario.resolve_profile()
        for ref in ("table_2_2", "table_7_1", "table_7_2", "table_7_3", "px4_defaults"):
            for gain_set in load_gain_sets(ref):
                assert plan(gain_set, scenario, model, profile).parameters
