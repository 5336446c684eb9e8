"""The sweep file: what it says is read as it is meant, and what cannot be swept is refused in one line."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from scenarios.cli import main
from scenarios.sweep.plan import Plan, make_plan, plain
from scenarios.sweep.resuming import difference
from scenarios.sweep.sweep_file import Sweep, load_sweep
from sitl.errors import FileError, UsageError

AXES = "[axes]\nMC_ROLL_P = [4.0, 6.5]\n"
SHORT = '[[manoeuvre]]\nkind = "step"\namplitude_deg = 10.0\nhold_s = 1.0\nreturn_s = 1.0\n'
TRACK = '[[manoeuvre]]\nkind = "track"\nreturn_s = 1.0\n'
LIMIT = '[[limit]]\nmetric = "{}"\nmax = 1.0\n'


def load(tmp_path: Path, text: str) -> Sweep:
    file = tmp_path / "some.toml"
    file.write_text(text)
    return load_sweep(file)


def plan(tmp_path: Path, text: str) -> Plan:
    return make_plan(load(tmp_path, text))


REFUSED = [
    # text of the file; what the line names: key, value, remedy
    ("samples = 5\n", ["axes", "missing key", "Add it"]),
    ("[axes]\n", ["axes: no PX4 parameter is varied", "MC_ROLLRATE_P"]),
    ('axes = "all"\n', ["axes", "'all' is not a table"]),
    ('[axes]\nvehicle = ["ant-x"]\n', ["no PX4 parameter is varied"]),
    ("[axes]\nMC_ROLL_P = []\n", ["axes.MC_ROLL_P", "the axis has no values", "leave the axis out"]),
    ("[axes]\nMC_ROLL_P = 6.5\n", ["axes.MC_ROLL_P", "6.5 is not a list of values", "[a, b, c]"]),
    ('[axes]\nMC_ROLL_P = ["6.5"]\n', ["axes.MC_ROLL_P", "'6.5' is not a finite number", "without quotes"]),
    ("[axes]\nMC_ROLL_P = [true]\n", ["axes.MC_ROLL_P", "True is not a finite number"]),
    ("[axes]\nMC_ROLL_P = [nan]\n", ["axes.MC_ROLL_P", "nan is not a finite number"]),
    ("[axes]\nMC_ROLL_P = [1e300]\n", ["axes.MC_ROLL_P", "1e+300 is more than PX4 can keep"]),
    ("[axes]\nMC_ROL_P = [6.5]\n", ["axes.MC_ROL_P", "no such parameter or condition", 'did you mean "MC_ROLL_P"?']),
    ("[axes]\nmotor_lag = [0.01]\n", ["axes.motor_lag", 'did you mean "motor_lag_s"?']),
    ("[axes]\nMC_AIRMODE = [0.5]\n", ["axes.MC_AIRMODE", "0.5: PX4 keeps it as a whole number"]),
    ("[axes]\nMC_AIRMODE = [1e12]\n", ["axes.MC_AIRMODE", "whole numbers of 32 bits"]),
    ("[axes]\nMC_AIRMODE = {from = 0.5, to = 2, count = 2}\n", ["axes.MC_AIRMODE.from", "0.5: PX4 keeps it"]),
    ("[axes]\nMC_ROLL_P = [-0.1, 6.0]\n", ["MC_ROLL_P = -0.1 is negative", "zero or more"]),
    ("[axes]\nMC_ROLL_P = [6.0, 5000.0]\n", ["MC_ROLL_P = 5000 is absurd", "decimal point"]),
    ("[axes]\nMC_ROLL_P = {from = 8.0, to = 3.0, count = 2}\n", ["MC_ROLL_P.from", "8 is not below to = 3", "Swap"]),
    ("[axes]\nMC_ROLL_P = {from = 3.0, to = 3.0, count = 2}\n", ["3 is not below to = 3"]),
    ("[axes]\nMC_ROLL_P = {from = 3.0, count = 2}\n", ["axes.MC_ROLL_P.to", "missing key"]),
    ("[axes]\nMC_ROLL_P = {from = 3.0, to = 8.0}\n", ["axes.MC_ROLL_P.count", "how many values", "count = 10"]),
    ("[axes]\nMC_ROLL_P = {from = 3.0, to = 8.0, count = 2.5}\n", ["count", "2.5 is not a whole number"]),
    ("[axes]\nMC_ROLL_P = {from = 3.0, to = 8.0, count = 0}\n", ["count", "out of range"]),
    ("[axes]\nMC_ROLL_P = {from = 3.0, to = 8.0, count = 200_000}\n", ["count", "<= 100000"]),
    ("[axes]\nMC_ROLL_P = {from = 3.0, to = 8.0, step = 2}\n", ["unknown key"]),
    ('[axes]\nMC_ROLLRATE_I = {from = 0.0, to = 1.0, count = 3, scale = "log"}\n', ["0 has no logarithm", "above 0"]),
    ('[axes]\nMC_ROLL_P = {from = 1.0, to = 9.0, count = 3, scale = "cube"}\n', ['"cube" is not known', '"log"']),
    (AXES + "vehicle = []\n", ["axes.vehicle", "the axis has no values"]),
    (AXES + "vehicle = [3]\n", ["axes.vehicle", "3 is not a text", "Quote it"]),
    (AXES + 'vehicle = ["ant-y"]\n', ["axes", "ant-y"]),
    (AXES + 'vehicle = ["a:b:c"]\n', ["a:b:c", "ant-r:ant-x"]),
    (AXES + 'vehicle = ["ant-r:ant-x"]\nscaling = ["mass"]\n', ['unknown scaling "mass"', "derivatives"]),
    (AXES + 'profile = ["stil"]\n', ['unknown profile "stil"', 'did you mean "sitl"?', "Known: study"]),
    (AXES + "hover_thrust = [0.5, 1.5]\n", ["axes.hover_thrust", "1.5 is out of range", "0.05 to 0.9"]),
    (AXES + "hover_thrust = {from = 0.01, to = 0.5, count = 3}\n", ["axes.hover_thrust", "0.01 is out of range"]),
    (AXES + "hover_thrust = [true]\n", ["axes.hover_thrust", "True is out of range"]),
    (AXES + 'motor_lag_s = ["fast"]\n', ["axes.motor_lag_s", "'fast' is not a number"]),
    (AXES + "motor_lag_s = [2.0]\n", ["motor_lag_s = 2", "0 to 0.5 s"]),
    (AXES + "motor_lag_s = [nan]\n", ["motor_lag_s = nan"]),
    (AXES + "motor_lag_s = {from = 0.1, to = 0.0, count = 3}\n", ["axes.motor_lag_s.from", "Swap them"]),
    (AXES + "motor_lag_s = {from = 0.0, to = 0.1}\n", ["count", "every candidate is judged under each"]),
    (AXES + "transport_delay_ticks = [0.5]\n", ["transport_delay_ticks = 0.5", "a whole number"]),
    (AXES + "rate_hz = [300]\n", ["rate_hz = 300", "whole number of microseconds"]),
    (AXES + "limits = [1]\n", ["limits = 1", "true or false"]),
    (AXES + "limits = [true, 1]\n", ["axes.limits", "both true or false and numbers"]),
    (AXES + "rate_hz = [250, 320]\n", ["setpoint_rate_hz = 50 does not divide the 320 Hz", "Try 50"]),
    ("samples = -1\n" + AXES, ["samples", "-1 is out of range", ">= 0"]),
    ("samples = 2.5\n" + AXES, ["samples", "2.5 is not a whole number"]),
    ('samples = "many"\n' + AXES, ["samples", "'many' is not a number"]),
    ("samples = 10_000_000\n" + AXES, ["samples", "<= 1e+06"]),
    ("seed = -3\n" + AXES, ["seed", "-3 is out of range"]),
    ('distribution = "normal"\n' + AXES, ["distribution", '"normal" is not known', "gaussian"]),
    ("spread_sigma = 0.1\n" + AXES, ["spread_sigma", "0.1 is out of range"]),
    ("required_pass_pct = 120\n" + AXES, ["required_pass_pct", "120 is out of range"]),
    ("setpoint_rate_hz = 1\n" + AXES, ["setpoint_rate_hz", "1 is out of range"]),
    ('margins = "all"\n' + AXES, ["margins", '"all" is not known', "samples, nominal, none"]),
    ('margins = "none"\nlimits = "practical"\n' + AXES, ["margins", "delay_margin_s is limited", '"nominal"']),
    ('limits = "practcal"\n' + AXES, ["practcal", "practical"]),
    ('limits = "none"\n' + AXES + LIMIT.format("overshoot_pct"), ["limit", "not both"]),
    (AXES + LIMIT.format("q_std_rad_s"), ["limit: q_std_rad_s is not measured", "overshoot_pct"]),
    (AXES + LIMIT.format("vaf_pct"), ["limit: vaf_pct is not measured by these manoeuvres"]),
    (AXES + LIMIT.format("overshoot"), ["unknown metric 'overshoot'", "overshoot_pct"]),
    ('limits = "none"\n' + AXES + SHORT, ["manoeuvre", "none holds a step for 2 s", "hold_s = 2"]),
    ('limits = "none"\n' + AXES + TRACK, ["manoeuvre", "none holds a step for 2 s", '"step"']),
    (AXES + TRACK.replace("1.0", "3.0"), ["limits: overshoot_pct is not measured", "or limit one of vaf_pct"]),
    (AXES + '[[manoeuvre]]\nkind = "jump"\n', ['unknown kind "jump"']),
    ('objectives = ["rise_time"]\n' + AXES, ["objectives", '"rise_time" is no metric', "rise_time_s"]),
    ('objectives = ["vaf_pct"]\n' + AXES, ["objectives", '"vaf_pct" is not measured by these manoeuvres']),
    ('objectives = ["rise_time_s", "rise_time_s_worst"]\n' + AXES, ['"rise_time_s_worst" is named twice']),
    ("objectives = [3]\n" + AXES, ["objectives", "not a list of texts"]),
    (
        'margins = "none"\nlimits = "none"\nobjectives = ["delay_margin_s"]\n' + AXES,
        ["objectives", '"delay_margin_s" is not measured'],
    ),
    ('design = "sobol"\n' + AXES, ["design", "'sobol' is not a table"]),
    ('[design]\nkind = "random"\n' + AXES, ["design.kind", '"random" is not known', "grid, sobol"]),
    ('[design]\nkind = "sobol"\n' + AXES, ["design.points", "missing key"]),
    ('[design]\nkind = "sobol"\npoints = 0\n' + AXES, ["design.points", "0 is out of range"]),
    ('[design]\nkind = "sobol"\npoints = 1_000_000_000_000\n' + AXES, ["design.points", "<= 1e+08"]),
    ('[design]\nkind = "latin-hypercube"\npoints = 5_000_000\n' + AXES, ["design.points", "<= 1e+06"]),
    ('[design]\nkind = "grid"\npoints = 7\n' + AXES, ["design", "as many points as its axes say", "Leave points out"]),
    ('[design]\nkind = "sobol"\npoints = 8\ngeneration = 4\n' + AXES, ["design.generation", "unknown key"]),
    ('[design]\nkind = "search"\npoints = 8\ngeneration = 1\n' + AXES, ["design.generation", "1 is out of range"]),
    (AXES + "[parameters]\nMC_ROLRATE_P = 0.1\n", ["parameters.MC_ROLRATE_P", 'did you mean "MC_ROLLRATE_P"?']),
    (AXES + "[parameters]\nMC_ROLL_P = 3.0\n", ["parameters.MC_ROLL_P", "it is an axis, too", "Leave it out"]),
    (AXES + '[parameters]\nMC_ROLLRATE_P = "x"\n', ["parameters.MC_ROLLRATE_P", "'x' is not a number"]),
    (AXES + "[parameters]\nMC_ROLLRATE_P = -0.1\n", ["MC_ROLLRATE_P = -0.1 is negative"]),
    (AXES + "[parameters]\nMC_AIRMODE = 0.5\n", ["parameters.MC_AIRMODE", "0.5: PX4 keeps it as a whole number"]),
    ('gains = "table_7_2"\n' + AXES, ["gains", "gain sets", "Name one of them"]),
    ('gains = "table_9_9"\n' + AXES, ["table_9_9", "no such gain set file"]),
    ("sample = 5\n" + AXES, ["sample", "unknown key", 'did you mean "samples"?']),
    ("title = 3\n" + AXES, ["title", "3 is not a text"]),
    ("[axes\n", ["not a TOML file"]),
]


@pytest.mark.parametrize(("text", "named"), REFUSED, ids=[text.replace("\n", " ")[:60] for text, _ in REFUSED])
def test_refused_in_one_line(tmp_path: Path, text: str, named: list[str]) -> None:
    with pytest.raises((FileError, UsageError)) as refused:
        plan(tmp_path, text)
    told = str(refused.value)
    assert "some.toml" in told or "table_9_9" in told
    assert "\n" not in told
    for part in named:
        assert part in told


def test_far_too_many_points_before_anything_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "huge.toml"
    names = ("MC_ROLL_P", "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D")
    file.write_text("[axes]\n" + "".join(f"{n} = {{ from = 0.001, to = 0.5, count = 1000 }}\n" for n in names))
    assert main(["sweep", str(file), "--out", str(tmp_path / "logs")]) == 2
    told = capsys.readouterr().err
    assert "1,000,000,000,000 candidates x 1 conditions are 1e+12 points; at most 100,000,000" in told
    assert 'kind = "sobol"' in told
    assert not (tmp_path / "logs").exists()


def test_too_many_conditions(tmp_path: Path) -> None:
    text = AXES + "".join(
        f"{name} = {{ from = 0.001, to = 0.01, count = 30 }}\n"
        for name in ("motor_lag_s", "gyro_noise_rad_s", "gps_noise_m")
    )
    with pytest.raises(UsageError, match="27,000 combinations of conditions; at most 10,000"):
        plan(tmp_path, text)


class TestRead:
    def test_defaults(self, tmp_path: Path) -> None:
        sweep = load(tmp_path, AXES)
        assert (sweep.name, sweep.title, sweep.samples, sweep.seed) == ("some", "some", 100, 1)
        assert (sweep.margins, sweep.limits_name, sweep.required_pass_pct) == ("samples", "practical", 100.0)
        assert [one.column for one in sweep.objectives] == ["rise_time_s_worst", "delay_margin_s_worst"]
        assert [one.maximise for one in sweep.objectives] == [False, True]
        assert [one.kind for one in sweep.manoeuvres] == ["step"]
        assert load(tmp_path, 'limits = "study"\n' + AXES).margins == "nominal"

    def test_values_are_kept_as_px4_keeps_them(self, tmp_path: Path) -> None:
        text = "[axes]\nMC_ROLLRATE_P = [0.1, 0.2, 0.1]\nMC_AIRMODE = [1, 0, 1]\n"
        rate, mode = load(tmp_path, text).parameters
        assert rate.values == tuple(float(np.float32(x)) for x in (0.1, 0.2))  # a repeated value counts once
        assert mode.values == (1.0, 0.0)
        assert (rate.integer, mode.integer) == (False, True)

    def test_ranges(self, tmp_path: Path) -> None:
        text = (
            "[axes]\nMC_ROLL_P = {from = 2.0, to = 10.0, count = 5}\n"
            'MC_ROLLRATE_P = {from = 0.01, to = 1.0, count = 3, scale = "log"}\n'
            "MC_AIRMODE = {from = 0, to = 2, count = 9}\nMC_ROLLRATE_K = {from = 1.0, to = 3.0, count = 1}\n"
        )
        even, log, whole, one = load(tmp_path, text).parameters
        assert even.values == (2.0, 4.0, 6.0, 8.0, 10.0)
        assert log.values == pytest.approx((0.01, 0.1, 1.0), rel=1e-7)
        assert whole.values == (0.0, 1.0, 2.0)
        assert one.values == (2.0,)

    def test_whole_numbers_stay_whole(self, tmp_path: Path) -> None:
        made = plan(tmp_path, AXES + "MC_AIRMODE = [0, 1]\n[parameters]\nCA_METHOD = 1\nMC_ROLLRATE_P = 1\n")
        assert made.sweep.fixed == {"CA_METHOD": 1, "MC_ROLLRATE_P": 1.0}
        assert {type(value) for value in made.sweep.fixed.values()} == {int, float}

    def test_a_gain_set_below_the_axes(self, tmp_path: Path) -> None:
        (tmp_path / "own.toml").write_text(
            '[[gain_set]]\nname = "own"\n[gain_set.parameters]\nMC_ROLL_P = 9.0\nMC_ROLLRATE_P = 0.07\nMC_AIRMODE = 1\n'
        )
        sweep = load(tmp_path, 'gains = "own.toml"\n' + AXES + "[parameters]\nMC_ROLLRATE_I = 0.2\n")
        assert sweep.fixed == {"MC_ROLL_P": 9.0, "MC_ROLLRATE_P": 0.07, "MC_AIRMODE": 1, "MC_ROLLRATE_I": 0.2}

    def test_vehicles_beside_the_sweep_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        from sitl.airframe import load_airframe

        mine = tmp_path / "mine.toml"
        assert load_airframe("ant-x").path is not None
        mine.write_text(Path(str(load_airframe("ant-x").path)).read_text().replace('"ANT-X"', '"MINE"'))
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        monkeypatch.chdir(elsewhere)
        made = plan(tmp_path, AXES + 'vehicle = ["mine.toml", "ant-r:mine.toml"]\n')
        assert [case.model.name for case in made.cases] == ["MINE", "ANT-R:MINE"]
        assert [case.name for case in made.cases] == ["mine.toml", "ant-r:mine.toml"]


class TestCases:
    def test_an_identified_airframe_is_one_case_however_it_is_scaled(self, tmp_path: Path) -> None:
        made = plan(tmp_path, AXES + 'vehicle = ["ant-x", "ant-r:ant-x"]\nscaling = ["derivatives", "gain", ""]\n')
        assert [case.model.scaling for case in made.cases] == [
            frozenset(), frozenset({"derivatives"}), frozenset({"gain"}), frozenset(),
        ]  # fmt: skip
        assert [case.model.reference is None for case in made.cases] == [True, False, False, False]

    def test_the_last_condition_varies_quickest(self, tmp_path: Path) -> None:
        made = plan(tmp_path, AXES + "motor_lag_s = [0.01, 0.02]\nlimits = [true, false]\nhover_thrust = [0.4]\n")
        assert [(c.profile.motor_lag_s, c.profile.limits) for c in made.cases] == [
            (0.01, True), (0.01, False), (0.02, True), (0.02, False),
        ]  # fmt: skip
        assert {case.model.assumptions.hover_thrust for case in made.cases} == {0.4}
        assert made.cases[1].name == "motor_lag_s 0.01, limits 0, hover_thrust 0.4"

    def test_whole_items_given_as_fractions(self, tmp_path: Path) -> None:
        made = plan(tmp_path, AXES + "transport_delay_ticks = {from = 0, to = 2, count = 3}\nrate_hz = [250.0]\n")
        ticks = [case.profile.transport_delay_ticks for case in made.cases]
        assert ticks == [0, 1, 2]
        assert {type(one) for one in ticks} == {int}

    def test_warnings(self, tmp_path: Path) -> None:
        text = "[axes]\nMC_ROLL_P = [4.0, 20.0]\nMC_PITCH_P = [3.0, 4.0]\nMC_ROLLRATE_MAX = [60.0, 90.0]\n"
        text += "limits = [false, true]\n[parameters]\nMC_ROLLRATE_P = 0.9\n"
        told = plan(tmp_path, text).warnings
        assert len(told) == 3
        assert any("MC_ROLL_P = 20 is above PX4's maximum" in one for one in told)
        assert any("MC_ROLLRATE_P = 0.9 is above" in one for one in told)
        # the rate limit acts in one of the cases
        assert any(one.startswith("MC_PITCH_P does not act on the roll axis") for one in told)


class TestFingerprint:
    def test_the_same_file_the_same_plan(self, tmp_path: Path) -> None:
        assert plan(tmp_path, AXES).fingerprint == plan(tmp_path, "# a comment\n" + AXES).fingerprint

    @pytest.mark.parametrize(
        ("change", "named"),
        [
            ("samples = 7\n" + AXES, "samples was 100, is 7"),
            (AXES.replace("6.5", "6.6"), "parameters[0].values[1] was 6.5, is 6.59"),
            (AXES + 'vehicle = ["ant-r"]\n', "cases[0]"),
            (AXES + "[parameters]\nMC_ROLLRATE_P = 0.1\n", "fixed.MC_ROLLRATE_P was null, is 0.1"),
            ('limits = "study"\n' + AXES, "limits"),
            ('[design]\nkind = "sobol"\npoints = 8\n' + AXES, 'design.kind was "grid", is "sobol"'),
            (AXES + "MC_AIRMODE = [0]\n", "parameters"),
        ],
    )
    def test_what_differs_is_named(self, tmp_path: Path, change: str, named: str) -> None:
        before, now = plan(tmp_path, AXES), plan(tmp_path, change)
        assert before.fingerprint != now.fingerprint
        described = [json.loads(json.dumps(one.description(), default=plain)) for one in (before, now)]
        assert named in difference(*described)

    def test_long_values_are_cut(self) -> None:
        told = difference({"a": {"b": list(range(100))}}, {"a": {"b": []}})
        assert told.startswith("a.b was [0, 1")
        assert told.endswith("is []")
        assert len(told) < 200


def test_a_range_that_a_design_samples_needs_no_count(tmp_path: Path) -> None:
    text = '[design]\nkind = "latin-hypercube"\npoints = 4\n[axes]\nMC_ROLL_P = {from = 3.0, to = 8.0}\n'
    (axis,) = load(tmp_path, text).parameters
    assert axis.values == ()
    assert axis.at(np.array([0.0, 0.5, 1.0])).tolist() == [3.0, 5.5, 8.0]
    log = load(tmp_path, text.replace("8.0}", '8.0, scale = "log"}')).parameters[0]
    assert log.at(np.array([0.5]))[0] == pytest.approx(math.sqrt(24.0))
