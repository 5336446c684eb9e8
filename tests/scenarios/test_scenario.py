"""Scenarios: the library, every key, and what a mistake says."""

from __future__ import annotations

from pathlib import Path

import pytest

from scenarios.gain_set import load_all
from scenarios.limits import LIMIT_SETS, Limit
from scenarios.scenario import Gate, limit_set, list_scenarios, load_scenario
from sitl.errors import FileError, UsageError

STEP = '[[manoeuvre]]\nkind = "step"\namplitude_deg = 10.0\n'


@pytest.fixture
def write(tmp_path: Path) -> object:
    def make(text: str) -> Path:
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return path

    return make


@pytest.mark.parametrize("name", list_scenarios())
def test_library_scenarios_can_be_flown(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.manoeuvres
    assert load_all(scenario.gain_sets)
    assert scenario.resolve_profile().rate_hz % scenario.setpoint_rate_hz == 0
    assert scenario.resolve_vehicle().airframe


def test_demo_is_what_the_readme_promises() -> None:
    demo = load_scenario("demo")
    assert demo.vehicle == "ant-x"
    assert demo.profile == "sitl"
    assert [g.name for g in load_all(demo.gain_sets)] == [
        *("7.2 ANT-R", "7.2 ANT-X", "7.2 CARRIER-1", "7.2 ADAM-0"),
        *("2.2 ANT-X", "PX4 defaults"),
    ]
    assert [m.kind for m in demo.manoeuvres] == ["step", "track"]
    assert demo.limits == LIMIT_SETS["practical"]
    assert Limit("overshoot_pct", maximum=10.0) in demo.limits
    assert Limit("delay_margin_s", minimum=0.010) in demo.limits


def test_defaults_of_a_minimal_file(write) -> None:
    scenario = load_scenario(write(STEP))
    assert (scenario.name, scenario.title) == ("mine", "mine")
    assert (scenario.vehicle, scenario.scaling, scenario.profile) == ("ant-x", ("derivatives",), "sitl")
    assert (scenario.axes, scenario.setpoint_rate_hz, scenario.seed) == ("roll", 50.0, 0)
    assert scenario.gain_sets == ()
    assert scenario.limits_name == "practical"
    assert scenario.gate == Gate()


def test_every_key(write) -> None:
    scenario = load_scenario(
        write(
            """
title = "All of it"
vehicle = "ant-r:ant-x"
scaling = ["derivatives", "gain"]
axes = "both"
takeoff_altitude_m = 20
setpoint_rate_hz = 125
seed = 7
gain_sets = ["table_7_2/ANT-R"]
[profile]
name = "board"
rate_hz = 1000
motor_lag_s = 0.010
[airframe]
hover_thrust = 0.4
[gate]
level_deg = 1.0
timeout_s = 5.0
[[limit]]
metric = "vaf_pct"
min = 60.0
"""
            + STEP
        )
    )
    profile = scenario.resolve_profile()
    assert (profile.name, profile.rate_hz, profile.motor_lag_s) == ("board", 1000, 0.010)
    vehicle = scenario.resolve_vehicle()
    assert vehicle.assumptions.hover_thrust == 0.4
    assert vehicle.scaling == {"derivatives", "gain"}
    assert scenario.limits == (Limit("vaf_pct", minimum=60.0),)
    assert scenario.limits_name == "custom"
    assert scenario.gate == Gate(level_deg=1.0, timeout_s=5.0)
    assert (scenario.axes, scenario.takeoff_altitude_m, scenario.seed) == ("both", 20.0, 7)


def test_files_are_looked_for_beside_the_scenario(write, tmp_path: Path) -> None:
    gains = '[[gain_set]]\nname = "a"\n[gain_set.parameters]\nMC_ROLL_P = 6.5\n'
    (tmp_path / "gains.toml").write_text(gains)
    scenario = load_scenario(write('gain_sets = ["gains.toml", "gains.toml/a", "px4_defaults"]\n' + STEP))
    assert scenario.gain_sets == (f"{tmp_path}/gains.toml", f"{tmp_path}/gains.toml/a", "px4_defaults")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "holds no [[manoeuvre]]"),
        ("titel = 'x'\n" + STEP, 'titel: unknown key (did you mean "title"?)'),
        ("setpoint_rate_hz = 60\n" + STEP, "does not divide the 250 Hz of profile"),
        ("setpoint_rate_hz = 1\n" + STEP, "setpoint_rate_hz: 1 is out of range"),
        ('profile = "stil"\n' + STEP, 'did you mean "sitl"?'),
        ("profile = 3\n" + STEP, "is not a text"),
        ("[profile]\nmotor_lag = 0.01\n" + STEP, 'did you mean "motor_lag_s"?'),
        ("[profile]\nmotor_lag_s = -1\n" + STEP, "motor_lag_s = -1"),
        ("[profile]\nname = 3\n" + STEP, "is not a text"),
        ("[airframe]\nhover_thrst = 0.4\n" + STEP, 'did you mean "hover_thrust"?'),
        ("[airframe]\nhover_thrust = 2.0\n" + STEP, "airframe.hover_thrust: 2 is out of range"),
        ("[gate]\nlevel_deg = 0\n" + STEP, "gate.level_deg: 0 is out of range"),
        ("[gate]\nhold_s = 30\ntimeout_s = 3\n" + STEP, "is shorter than hold_s"),
        ('axes = "pitch"\n' + STEP, "Known: roll, both"),
        ("seed = 1.5\n" + STEP, "not a whole number"),
        ("seed = -1\n" + STEP, "seed: -1 is out of range"),
        ('limits = "studdy"\n' + STEP, 'did you mean "study"?'),
        ('limits = "study"\n[[limit]]\nmetric = "vaf_pct"\nmin = 1\n' + STEP, "not both"),
        ("limit = 3\n" + STEP, "not a list of tables"),
        ('gain_sets = "table_7_2"\n' + STEP, "gain_sets: 'table_7_2' is not a list of texts"),
        (STEP.replace("10.0", "400.0"), "amplitude_deg: 400 is out of range. It must be <= 45"),
        (STEP.replace("step", "stp"), 'did you mean "step"?'),
        ("x = \n", "not a TOML file"),
        ("x = '\udcff'\n", "not a TOML file"),
    ],
)
def test_a_mistake_names_file_key_and_remedy(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(FileError) as error:
        load_scenario(path)
    assert str(error.value).startswith(f"{path}: ")
    assert problem in str(error.value)


def test_unknown_scenario_and_limit_set() -> None:
    with pytest.raises(FileError, match=r'did you mean "demo"'):
        load_scenario("dmeo")
    with pytest.raises(UsageError, match="practical"):
        limit_set("practicall")
    assert limit_set("none") == ()
