"""Gain sets: the study's tables, files both ways, and what is refused before it is uploaded."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.gain_set import (
    GainSet,
    check,
    list_gain_sets,
    load_all,
    load_gain_sets,
    save_params,
)
from sitl.errors import FileError
from sitl.parameters import ParameterTable

TABLE = ParameterTable()
NAMES = ("MC_ROLL_P", "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D")

# K_phi, K_P, K_I, K_D as the study prints them.
STUDY = {
    "table_2_2/ANT-X": (6.5, 0.05, 0.05, 0.001),
    "table_2_2/ANT-R": (10.0, 0.08, 0.05, 0.0015),
    "table_2_2/CARRIER-1": (6.5, 0.15, 0.2, 0.002),
    "table_2_2/ADAM-0": (6.5, 0.15, 0.05, 0.003),
    "table_7_1/ANT-R": (11.98, 0.201, 9.17, 2.09e-7),
    "table_7_1/ANT-X": (11.93, 0.583, 19.5, 6.85e-6),
    "table_7_1/CARRIER-1": (9.409, 0.507, 9.45, 4.39e-7),
    "table_7_1/ADAM-0": (13.69, 0.386, 3.76, 4.64e-5),
    "table_7_2/ANT-R": (11.81, 0.123, 3.2, 4.99e-7),
    "table_7_2/ANT-X": (12.04, 0.6, 35.8, 3.57e-6),
    "table_7_2/CARRIER-1": (12.49, 0.341, 2.21, 1.64e-5),
    "table_7_2/ADAM-0": (6.258, 0.225, 0.987, 3.89e-4),
    "table_7_3/ANT-R": (11.54, 0.213, 5.13, 1.39e-6),
    "table_7_3/ANT-X": (13.88, 0.604, 3.09, 1.44e-5),
    "table_7_3/CARRIER-1": (11.37, 0.645, 6.97, 8.17e-6),
    "table_7_3/ADAM-0": (10.68, 1.07, 47.1, 4.43e-5),
    "px4_defaults/PX4 defaults": (4.0, 0.15, 0.2, 0.003),
}


@pytest.mark.parametrize(("ref", "gains"), STUDY.items())
def test_study_tables(ref: str, gains: tuple[float, ...]) -> None:
    (gain_set,) = load_gain_sets(ref)
    assert tuple(gain_set.parameters[name] for name in NAMES) == gains
    assert gain_set.parameters["MC_ROLLRATE_K"] == 1.0
    assert gain_set.parameters["MC_ROLLRATE_FF"] == 0.0
    assert gain_set.source
    assert re.fullmatch(r"[A-Za-z0-9_-]+", gain_set.slug)


@pytest.mark.parametrize("name", list_gain_sets())
def test_every_built_in_set_passes_the_check(name: str) -> None:
    for gain_set in load_gain_sets(name):
        for warning in check(gain_set, TABLE):
            assert warning.endswith("flown anyway")


def test_built_in_sets_load_together() -> None:
    sets = load_all(list_gain_sets())
    assert len(sets) == len(STUDY)
    assert len({gain_set.name for gain_set in sets}) == len(sets)


def test_px4_defaults_are_the_vehicles() -> None:
    for name, value in load_gain_sets("px4_defaults")[0].parameters.items():
        assert np.float32(value) == np.float32(TABLE.default(name))


@pytest.mark.parametrize("ref", ["table_7_2/ant-r", "table_7_2/7.2 ANT-R", "table_7_2/7_2_ant-r"])
def test_a_set_answers_to_name_slug_or_short_name(ref: str) -> None:
    assert [gain_set.name for gain_set in load_gain_sets(ref)] == ["7.2 ANT-R"]


@pytest.mark.parametrize(
    ("ref", "text"),
    [
        ("table_7_4", 'no such gain set file (did you mean "table_7_'),
        ("table_7_2/ANT-Q", "It has 7.2 ANT-R, 7.2 ANT-X"),
        ("absent.params", "no such gain set file"),
        ("absent/mine.toml", "no such gain set file"),
        ("", "no such gain set file"),
        ("/", "no such gain set file"),
    ],
)
def test_unknown_references(ref: str, text: str) -> None:
    with pytest.raises(FileError) as error:
        load_gain_sets(ref)
    assert text in str(error.value)


def test_the_same_set_twice_is_refused() -> None:
    with pytest.raises(FileError, match=r"7\.2 ANT-R"):
        load_all(["table_7_2", "table_7_2/ANT-R"])


TOML = '[[gain_set]]\nname = "mine"\n[gain_set.parameters]\nMC_ROLL_P = 6.5\n'


def test_user_toml_by_path_and_name(tmp_path: Path) -> None:
    path = tmp_path / "gains.toml"
    path.write_text(TOML + TOML.replace("mine", "my other one").replace("6.5", "7"))
    assert [gain_set.name for gain_set in load_gain_sets(path)] == ["mine", "my other one"]
    assert load_gain_sets(f"{path}/my_other_one")[0].parameters == {"MC_ROLL_P": 7}
    assert load_gain_sets(path)[0].path == path


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("gain_set = 1\n", "holds no [[gain_set]]"),
        ("", "holds no [[gain_set]]"),
        ("[[gain_sets]]\n", "unknown key 'gain_sets'"),
        (TOML.replace("name", "nmae"), 'unknown key "nmae" (did you mean "name"?)'),
        (TOML.replace('"mine"', '""'), "has no name"),
        (TOML.replace('"mine"', "3"), "is not a text"),
        (TOML.replace("MC_ROLL_P = 6.5", ""), "has no parameters"),
        (TOML.replace("6.5", '"6.5"'), "MC_ROLL_P = '6.5' is not a number"),
        (TOML.replace("6.5", "true"), "is not a number"),
        (TOML.replace("6.5", "nan"), "not a finite number"),
        (TOML.replace("6.5", "-inf"), "not a finite number"),
        (TOML + TOML, "two gain sets are named 'mine'"),
        (TOML + "MC_ROLL_P = 7\n", "not a TOML file"),
    ],
)
def test_bad_toml_names_file_and_mistake(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "gains.toml"
    path.write_text(text)
    with pytest.raises(FileError) as error:
        load_gain_sets(path)
    assert str(error.value).startswith(f"{path}: ")
    assert problem in str(error.value)


def test_params_as_qgroundcontrol_writes_them(tmp_path: Path) -> None:
    path = tmp_path / "flown.params"
    path.write_text(
        "# Onboard parameters for Vehicle 1\n#\n# Vehicle-Id Component-Id Name Value Type\n"
        "1\t1\tMC_AIRMODE\t0\t6\n1\t1\tMC_ROLLRATE_P\t0.150000005960464478\t9\n"
    )
    (gain_set,) = load_gain_sets(path)
    assert gain_set.name == "flown"
    assert gain_set.parameters["MC_AIRMODE"] == 0
    assert isinstance(gain_set.parameters["MC_AIRMODE"], int)
    assert np.float32(gain_set.parameters["MC_ROLLRATE_P"]) == np.float32(0.15)


finite = st.floats(width=32, allow_nan=False, allow_infinity=False)


@given(reals=st.lists(finite, min_size=1, max_size=5), integer=st.integers(-(2**31), 2**31 - 1))
def test_params_round_trip_is_exact_in_float32(
    tmp_path_factory: pytest.TempPathFactory, reals: list[float], integer: int
) -> None:
    path = tmp_path_factory.mktemp("params") / "x.params"
    parameters: dict[str, float | int] = {f"REAL_{n}": value for n, value in enumerate(reals)}
    save_params(path, parameters | {"WHOLE": integer})
    back = load_gain_sets(path)[0].parameters
    assert back["WHOLE"] == integer
    for name, value in parameters.items():
        assert struct.pack("<f", back[name]) == struct.pack("<f", value)


def test_params_types_follow_the_vehicles_table(tmp_path: Path) -> None:
    save_params(tmp_path / "x.params", {"MC_ROLL_P": 7, "MC_AIRMODE": 1}, TABLE)
    lines = (tmp_path / "x.params").read_text().splitlines()
    assert lines[-2:] == ["1\t1\tMC_ROLL_P\t7.0\t9", "1\t1\tMC_AIRMODE\t1\t6"]


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("MC_ROLL_P 6.5", "2 columns instead of 5"),
        ("1\t1\tMC_ROLL_P\t6,5\t9", "MC_ROLL_P = '6,5' is not a number"),
        ("1\t1\tMC_AIRMODE\t0.5\t6", "is not an integer"),
        ("1\t1\tMC_ROLL_P\t6.5\t10", "has type '10'"),
        ("1\t1\tMC_ROLL_P\tnan\t9", "not a finite number"),
        ("1\t1\tMC_ROLL_P\t1\t9\n1\t1\tMC_ROLL_P\t2\t9", "line 2: MC_ROLL_P is given twice"),
        ("# nothing", "holds no parameter"),
    ],
)
def test_bad_params_name_the_line(tmp_path: Path, line: str, problem: str) -> None:
    path = tmp_path / "x.params"
    path.write_text(line)
    with pytest.raises(FileError) as error:
        load_gain_sets(path)
    assert problem in str(error.value)


@given(st.binary(max_size=80))
def test_any_bytes_are_a_set_or_a_file_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    for suffix in ("toml", "params"):
        path = tmp_path_factory.mktemp("any") / f"x.{suffix}"
        path.write_bytes(data)
        try:
            sets = load_gain_sets(path)
        except FileError:
            continue
        assert sets


def test_out_of_range_is_a_warning_that_says_by_how_much() -> None:
    (warning,) = check(GainSet("x", {"MC_ROLLRATE_P": 0.6}), TABLE)
    assert "MC_ROLLRATE_P" in warning
    assert "0.5" in warning
    assert "1.2 times" in warning
    assert check(GainSet("x", {"MC_ROLLRATE_P": 0.5, "MC_AIRMODE": 1}), TABLE) == []


@pytest.mark.parametrize(
    ("parameters", "problem"),
    [
        ({"MC_ROLRATE_P": 0.1}, 'unknown parameter MC_ROLRATE_P (did you mean "MC_ROLLRATE_P"?)'),
        ({"MC_ROLLRATE_P": float("nan")}, "not a finite number"),
        ({"MC_ROLLRATE_P": float("inf")}, "not a finite number"),
        ({"MC_ROLLRATE_D": -0.001}, "MC_ROLLRATE_D = -0.001 is negative"),
        ({"MC_ROLL_P": 6500}, "absurd (PX4's maximum is 12)"),
        ({"MC_ROLLRATE_P": 51}, "Nothing above 50 is flown"),
        ({"MC_ROLLRATE_I": 1001}, "Nothing above 1000 is flown"),
        ({"IMU_GYRO_CUTOFF": 1e39}, "does not fit"),
        ({"MC_AIRMODE": 0.5}, "whole number"),
        ({"MC_AIRMODE": 2**31}, "does not fit"),
    ],
)
def test_check_refuses_what_can_only_be_a_slip(parameters: dict[str, Any], problem: str) -> None:
    with pytest.raises(FileError) as error:
        check(GainSet("mine", parameters, path=Path("my.toml")), TABLE)
    assert str(error.value).startswith("my.toml: gain set 'mine': ")
    assert problem in str(error.value)


def test_mirrored_gives_pitch_the_same_gains_but_for_its_own() -> None:
    candidate = GainSet("x", {"MC_ROLL_P": 12.0, "MC_RR_INT_LIM": 0.2, "MC_ROLLRATE_P": 0.6, "MC_PITCH_P": 4.0})
    both = candidate.mirrored().parameters
    assert both["MC_PITCHRATE_P"] == 0.6
    assert both["MC_PR_INT_LIM"] == 0.2
    assert both["MC_PITCH_P"] == 4.0
    assert all(name in TABLE for name in both)


@given(st.text(max_size=200))
def test_slug_is_a_file_name(name: str) -> None:
    assert re.fullmatch(r"[a-z0-9_-]{1,80}", GainSet(name, {}).slug)
