import dataclasses
import errno
import json
import math
from pathlib import Path

import numpy as np
import pytest

from scenarios.limits import Outcome, measured
from scenarios.run_folder import (
    RunFolder,
    load_run,
    plain,
    run_object,
    vehicle_description,
    write_atomically,
)
from scenarios.run_schema import SCHEMA_VERSION
from sitl.errors import FileError
from sitl.vehicle_spec import resolve_vehicle

STAMP = "20261122T200000Z"


def strict(text: str):
    """JSON as the standard has it: NaN and Infinity are not JSON."""

    def refuse(word: str):
        raise AssertionError(f"{word} in JSON")

    return json.loads(text, parse_constant=refuse)


def test_the_name_says_when_what_and_which(tmp_path):
    folder = RunFolder.create(tmp_path / "logs", STAMP, "demo", "ant-r:ant-x")
    assert folder.path == tmp_path / "logs" / f"{STAMP}_demo_ant-r_ant-x"
    assert folder.flights.is_dir()


def test_a_folder_that_exists_is_left_alone(tmp_path):
    names = [RunFolder.create(tmp_path, STAMP, "demo", "ant-x").path.name for _ in range(3)]
    assert names == [f"{STAMP}_demo_ant-x", f"{STAMP}_demo_ant-x_2", f"{STAMP}_demo_ant-x_3"]


@pytest.mark.parametrize("vehicle", ["/home/me/my frame.toml", "../../etc/passwd", "a:b/c.toml", "..."])
def test_a_vehicle_given_by_path_cannot_leave_the_folder(tmp_path, vehicle):
    folder = RunFolder.create(tmp_path, STAMP, "demo", vehicle)
    assert folder.path.parent == tmp_path


def test_a_base_that_is_a_file_is_an_error_that_names_it(tmp_path):
    (tmp_path / "logs").write_text("")
    with pytest.raises(FileError, match=r"logs.*cannot be made.*--out"):
        RunFolder.create(tmp_path / "logs", STAMP, "demo", "ant-x")


def test_run_json_holds_what_was_flown(flown_run, tmp_path):
    folder = RunFolder.create(tmp_path, STAMP, "demo", "ant-x")
    folder.flight_file("own_gains", ".parquet").write_bytes(b"x")
    folder.flight_file("own_gains", ".rrd").write_bytes(b"x")
    path = folder.write_run_json(flown_run, ["froude", "fly", "my scenario.toml"])
    run = strict(path.read_text())
    assert run["schema_version"] == SCHEMA_VERSION
    assert run["command"] == ["froude", "fly", "my scenario.toml"]
    assert run["seed"] == 7
    assert run["versions"] == {"froude": "0.1.0"}
    assert (run["flown"], run["passed"], run["complete"]) == (3, 1, True)
    assert run["scenario"]["limits"][1] == {"metric": "overshoot_pct", "minimum": None, "maximum": 10.0}
    assert run["vehicle"]["derivatives"]["Ld"] == 450.71
    assert {"item": "motor_lag_s", "value": 0.01, "unit": "s"} in run["profile"]
    assert run["own_gains"] == {"gain_set": "own gains", "fly": True, "outcome": "PASS", "reason": ""}
    flight = run["flights"][0]
    assert flight["gain_set"]["parameters"]["MC_ROLL_P"] == 6.5
    assert flight["uploaded"]["MC_PITCH_P"] == 6.5
    assert flight["telemetry_sha256"] == flown_run.flights[0].telemetry_sha256
    assert flight["files"] == {"rrd": "flights/own_gains.rrd", "parquet": "flights/own_gains.parquet"}
    assert flight["segments"][1]["name"] == "step/2"
    assert flight["segments"][1]["phi_from_rad"] == pytest.approx(math.radians(10))
    assert run["flights"][2]["rows"] == 0
    assert not list(folder.path.glob(".*")), "no temporary file is left"


def test_every_metric_has_value_unit_limit_outcome_and_reason(flown_run):
    metrics = run_object(flown_run)["flights"][1]["metrics"]
    by_name = {metric["name"]: metric for metric in metrics}
    assert by_name["oscillation_rad_s"] | {"meaning": ""} == {
        "name": "oscillation_rad_s",
        "segment": "",
        "value": 2.1,
        "unit": "rad/s",
        "meaning": "",
        "limit": "<= 0.3 rad/s",
        "outcome": "FAIL",
        "reason": "limit cycle on roll: 2.1 rad/s at 9.0 Hz",
    }
    assert by_name["rise_time_s"]["value"] is None
    assert by_name["rise_time_s"]["outcome"] == "UNSET"
    assert by_name["rise_time_s"]["reason"] == "limit cycle"


def test_infinite_values_are_null_with_the_reason(flown_run):
    flight = flown_run.flights[0]
    nan = dataclasses.replace(measured("lag_s", 1.0, "why"), value=math.nan)
    run = dataclasses.replace(flown_run, flights=(dataclasses.replace(flight, metrics=(*flight.metrics, nan)),))
    shown = strict(json.dumps(run_object(run), allow_nan=False))["flights"][0]
    by_name = {metric["name"]: metric for metric in shown["metrics"]}
    assert (by_name["gain_margin_high_db"]["value"], by_name["gain_margin_high_db"]["reason"]) == (None, "infinite")
    assert (by_name["lag_s"]["value"], by_name["lag_s"]["reason"]) == (None, "not a number; why")
    assert shown["margins"] == {"delay_margin_s": 0.03, "gain_margin_high_db": None}


def test_what_load_run_reads_is_what_was_written(flown_run, tmp_path):
    folder = RunFolder.create(tmp_path, STAMP, "demo", "ant-x")
    folder.write_run_json(flown_run)
    assert load_run(folder.path) == load_run(folder.run_json) == run_object(flown_run, folder)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (None, "cannot be read"),
        ("{", "is not JSON"),
        ("[]", "schema_version is None"),
        ('{"schema_version": 99}', "schema_version is 99, this program reads 1 to 2: written by a newer froude"),
    ],
)
def test_a_run_that_cannot_be_read_is_named(tmp_path, text, complaint):
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    with pytest.raises(FileError, match=complaint) as error:
        load_run(tmp_path)
    assert str(tmp_path / "run.json") in str(error.value)


def test_a_full_disk_keeps_the_file_that_was_there(flown_run, tmp_path, monkeypatch):
    folder = RunFolder.create(tmp_path, STAMP, "demo", "ant-x")
    folder.write_run_json(flown_run)
    before = folder.run_json.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(FileError, match=r"run\.json.*No space left"):
        folder.write_run_json(dataclasses.replace(flown_run, flights=()))
    assert folder.run_json.read_bytes() == before
    assert [file.name for file in folder.path.iterdir() if file.name != "flights"] == ["run.json"]


def test_a_folder_that_went_away_is_an_error_not_a_traceback(tmp_path):
    with pytest.raises(FileError, match="cannot be written"):
        write_atomically(tmp_path / "gone" / "run.json", b"{}")


def test_plain_knows_what_json_does_not():
    value = {
        1: (np.float32(0.5), np.int64(3), np.array([1.0, math.nan])),
        "set": {"b", "a"},
        "path": Path("x/y"),
        "outcome": Outcome.PASS,
        "flag": np.bool_(True),
    }
    assert plain(value) == {
        "1": [0.5, 3, [1.0, None]],
        "set": ["a", "b"],
        "path": "x/y",
        "outcome": "PASS",
        "flag": True,
    }


def test_a_scaled_vehicle_is_described_with_reference_and_number():
    vehicle = vehicle_description(resolve_vehicle("ant-r:ant-x"))
    assert vehicle["reference"] == "ANT-R"
    assert vehicle["froude_number"] == pytest.approx(0.26 / 0.16)
    assert vehicle["scaling"] == ["derivatives"]
    assert vehicle["derivatives"]["Ld"] == pytest.approx(1150.6 * 0.26 / 0.16, rel=1e-6)
    assert set(vehicle["derivative_units"]) == set(vehicle["derivatives"])
    assert len(vehicle["rotors"]) == 4
    strict(json.dumps(plain(vehicle), allow_nan=False))
