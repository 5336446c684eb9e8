"""`froude tune` from the command line: files, text, numbers for machines, and what it says of bad input."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from scenarios.cli import main
from scenarios.gain_set import load_gain_sets
from scenarios.toml_file import read_toml
from sitl.airframe import load_airframe

ROLL = {"MC_ROLL_P", "MC_ROLLRATE_K", "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D", "MC_ROLLRATE_FF"}
QUICK = """
title = "quick"
vehicle = "ant-x"
limits = "practical"
gain_sets = ["px4_defaults"]
takeoff_altitude_m = 3.0
[gate]
hold_s = 0.5
timeout_s = 4.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = 2.0
return_s = 2.0
"""

Froude = Callable[..., tuple[int, str, str]]


@pytest.fixture
def froude(capsys: pytest.CaptureFixture[str]) -> Froude:
    """Runs the command line in this process; (exit status, standard output, standard error)."""

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            status = main([str(word) for word in words])
        except SystemExit as end:
            status = int(end.code or 0)
        out, err = capsys.readouterr()
        return status, out, err

    return run


def strict(text: str) -> Any:
    def refuse(literal: str) -> NoReturn:
        raise AssertionError(f"{literal} is not JSON")

    return json.loads(text, parse_constant=refuse)


def own_airframe(path: Path, **changes: tuple[str, str]) -> Path:
    """ANT-X as a user's own file, some lines replaced."""
    source = load_airframe("ant-x").path
    assert source is not None
    text = Path(source).read_text(encoding="utf-8").replace('name = "ANT-X"', 'name = "MINE"')
    for before, after in changes.values():
        assert text.count(before) == 1
        text = text.replace(before, after)
    path.write_text(text, encoding="utf-8")
    return path


class TestFiles:
    @pytest.mark.usefixtures("without_report")
    def test_flies_what_it_wrote(self, froude: Froude, tmp_path: Path) -> None:
        """Tuned with motors and filters, flown over MAVLink with sensor noise: passes, and is quiet."""
        out = tmp_path / "new" / "folder" / "mine.toml"
        status, text, err = froude("tune", "ant-x", "--out", out, "--gate")
        assert (status, err) == (0, "")
        assert "tuned ANT-X sitl: all requirements met" in text
        assert f"Fly it: froude fly --vehicle ant-x --gains {out}\n" in text
        assert f"Written: {out} and, for QGroundControl, {out.with_suffix('.params')}" in text
        quick = tmp_path / "quick.toml"
        quick.write_text(QUICK)
        words = ("fly", quick, "--vehicle", "ant-x", "--gains", out, "--gate", "--json", "--out", tmp_path / "runs")
        status, text, _ = froude(*words)
        run = strict(text)
        (flight,) = run["flights"]
        assert (status, flight["outcome"]) == (0, "PASS")
        assert {name: flight["uploaded"][name] for name in ROLL} == read_toml(out)["gain_set"][0]["parameters"]
        metrics = {metric["name"]: metric for metric in flight["metrics"] if not metric["segment"]}
        assert metrics["oscillation_rad_s"]["value"] < 0.1  # 0.3 is a limit cycle
        assert metrics["settling_time_5pct_s"]["value"] <= 0.6
        assert metrics["overshoot_pct"]["value"] <= 5.0
        assert not [name for name, metric in metrics.items() if metric["outcome"] == "FAIL"]

    def test_both_load_and_hold_exactly_the_roll_gains(self, froude: Froude, tmp_path: Path) -> None:
        out = tmp_path / "set.toml"
        status, text, _ = froude("tune", "ant-x", "--profile", "study", "--samples", 20, "--out", out, "--json")
        assert status == 0
        said = strict(text)
        (gain_set,) = load_gain_sets(out)
        assert set(gain_set.parameters) == ROLL
        assert dict(gain_set.parameters) == said["parameters"]
        assert gain_set.name == "tuned ANT-X study"
        assert "profile study, 20 samples, seed 1" in gain_set.source
        assert "worst of 21 models" in gain_set.note
        (stored,) = load_gain_sets(out.with_suffix(".params"))
        assert set(stored.parameters) == ROLL
        for name, value in stored.parameters.items():
            assert float(np.float32(value)) == gain_set.parameters[name]
        comments = [line for line in out.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
        for word in (
            "W1 = (0.76923 s + 6) / (1 s + 0.18)",
            "W2",
            "W3",
            "settling_time_s = 0.5",
            "overshoot_pct = 0.15",
        ):
            assert any(word in line for line in comments)
        assert said["files"] == {"gain_set": str(out), "params": str(out.with_suffix(".params"))}

    def test_without_out_they_lie_in_the_folder_one_is_in(
        self, froude: Froude, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        words = ("--scaling", "uncertainty,gain", "--profile", "study", "--samples", 10)
        status, text, _ = froude("tune", "ant-r:ant-x", *words)
        assert status == 0
        assert sorted(path.name for path in tmp_path.iterdir()) == [
            "tuned_ant-r_ant-x_study.params",
            "tuned_ant-r_ant-x_study.toml",
        ]
        (gain_set,) = load_gain_sets("tuned_ant-r_ant-x_study.toml")
        assert gain_set.name == "tuned ANT-R:ANT-X study"
        assert "scaling gain, uncertainty" in gain_set.source
        # flown on the true model, in the fidelity it was made for
        assert "froude fly --vehicle ant-x --gains tuned_ant-r_ant-x_study.toml --profile study" in text

    def test_of_ones_own_airframe_the_command_to_fly_names_the_file(self, froude: Froude, tmp_path: Path) -> None:
        mine = own_airframe(tmp_path / "my craft.toml")
        status, text, _ = froude("tune", mine, "--samples", 5, "--profile", "study", "--out", tmp_path / "g.toml")
        assert status == 0
        assert f"--vehicle '{mine}'" in text


class TestForMachines:
    def test_everything_is_there_and_is_json(self, froude: Froude, tmp_path: Path) -> None:
        words = ("--samples", 30, "--seed", 3, "--profile", "study", "--distribution", "uniform")
        status, text, err = froude("tune", "carrier-1", *words, "--json", "--out", tmp_path / "g.toml")
        assert (status, err) == (0, "")
        said = strict(text)
        assert said["vehicles"] == ["CARRIER-1"]
        assert (said["samples"], said["seed"], said["distribution"], said["profile"]) == (30, 3, "uniform", "study")
        assert said["met"] is True
        assert said["requirements"]["peak_delta_lat"] is None  # infinite: no limit on control effort
        (found,) = said["found"]
        assert (found["samples"], found["meets"], found["cannot_hold"]) == (31, 1.0, 0)
        (certificate,) = said["certificates"]
        assert certificate["spectral_radius"] < 1.0
        assert all(math.isfinite(norm) for norm in certificate["norms"])
        for weight, channel in zip(said["weights"], ("S = 1 - F", "Q", "F"), strict=True):
            assert weight["channel"] == channel
            assert len(weight["numerator"]) == len(weight["denominator"]) == 2


@pytest.fixture
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """What cannot be met cannot be met by a long search either."""
    monkeypatch.setattr("scenarios.tuning.synthesis.GENERATIONS", 20)


@pytest.mark.usefixtures("short_search")
class TestNotMet:
    def test_a_delay_margin_that_nothing_bears(self, froude: Froude, tmp_path: Path) -> None:
        """Not an error: files are written and say it, what can be had is listed; with --gate the status is 1."""
        out = tmp_path / "g.toml"
        words = ("tune", "ant-x", "--samples", 10, "--delay-margin", 1e9, "--out", out)
        status, text, err = froude(*words, "--gate", "--json")
        assert (status, err) == (1, "")
        said = strict(text)
        assert said["met"] is False
        assert any("delay margin" in line and "required 1e+09 ms" in line for line in said["unmet"])
        assert said["limits"]
        points = [(point["delay_margin_s"], point["settling_s"]) for point in said["trade_off"]]
        assert len(points) >= 3
        assert points == sorted(points, reverse=True)
        assert [settling for _, settling in points] == sorted({settling for _, settling in points}, reverse=True)
        (gain_set,) = load_gain_sets(out)
        assert "NOT MET: ANT-X: delay margin" in gain_set.note

    def test_without_the_gate_the_status_is_0(self, froude: Froude, tmp_path: Path) -> None:
        words = ("--samples", 5, "--settling", 0.06, "--out", tmp_path / "g.toml")
        status, text, _ = froude("tune", "ant-x", *words)
        assert status == 0
        assert "tuned ANT-X sitl: NOT all requirements met" in text
        assert "not met: ANT-X: settling time" in text
        assert "what can be had (worst sample):" in text


class TestSamples:
    def test_none_is_the_nominal_model_alone(self, froude: Froude, tmp_path: Path) -> None:
        words = ("--samples", 0, "--profile", "study", "--json", "--out", tmp_path / "g.toml")
        status, text, _ = froude("tune", "ant-x", *words)
        assert status == 0
        assert strict(text)["found"][0]["samples"] == 1

    def test_an_airframe_without_sigma_says_that_nothing_is_known_of_its_spread(
        self, froude: Froude, tmp_path: Path
    ) -> None:
        text = load_airframe("ant-x").path.read_text(encoding="utf-8")  # type: ignore[union-attr]
        start = text.index("[sigma]")
        bare = tmp_path / "bare.toml"
        bare.write_text(text[:start] + text[text.index("# Table 2.2") :], encoding="utf-8")
        status, shown, _ = froude("tune", bare, "--profile", "study", "--out", tmp_path / "g.toml")
        assert status == 0
        assert "states no uncertainty: its nominal model alone was looked at" in shown
        assert "1 models" in shown

    def test_samples_that_cannot_hold_an_angle_fail_the_gate(self, froude: Froude, tmp_path: Path) -> None:
        words = ("--scaling", "uncertainty,gain", "--samples", 300, "--gate", "--out", tmp_path / "g.toml")
        status, shown, err = froude("tune", "adam-0:ant-r", *words)
        assert (status, err) == (1, "")
        assert "cannot hold a roll angle with any gains (Lv Yd < Ld Yv)" in shown
        assert "-inf" not in shown


class TestMistakes:
    """One line that names the thing, nothing on standard output, no file, exit status 2."""

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            (("ant-x", "--samples", "-1"), "samples = -1: give 0 to 1000000"),
            (("ant-x", "--samples", "1000001"), "samples = 1000001: give 0 to 1000000"),
            (("ant-x", "--samples", "many"), "--samples: invalid int value: 'many'"),
            (("ant-x", "--settling", "0"), "settling_time_s = 0: give a number above 0"),
            (("ant-x", "--settling", "-0.5"), "settling_time_s = -0.5: give a number above 0"),
            (("ant-x", "--settling", "nan"), "settling_time_s = nan"),
            (("ant-x", "--settling", "inf"), "settling_time_s = inf"),
            (("ant-x", "--settling", "0.01"), "no multirotor settles within 0.05 s"),
            (("ant-x", "--overshoot", "-1"), "overshoot_pct = -1: give 0 or a number above it"),
            (("ant-x", "--overshoot", "inf"), "overshoot_pct = inf"),
            (("ant-x", "--delay-margin", "-1"), "delay_margin_s = -0.001: give 0 or a number above it"),
            (("ant-x", "--delay-margin", "inf"), "delay_margin_s = inf"),
            (("ant-x", "--seed", "-1"), "--seed -1: give 0 or more"),
            (("ant-q",), 'unknown airframe "ant-q" (did you mean "ant-x"?)'),
            (("ant-x:",), "neither an airframe nor REFERENCE:TARGET"),
            (("ant-x", "ant-x"), "2 of the vehicles are ANT-X: give each once"),
            (("ant-r:ant-x", "--scaling", "size"), 'unknown scaling "size"'),
            (("ant-x", "--distribution", "normal"), "invalid choice: 'normal'"),
            ((), "the following arguments are required: spec"),
        ],
    )
    def test_of_words(self, froude: Froude, tmp_path: Path, words: tuple[str, ...], said: str) -> None:
        status, out, err = froude("tune", *words, "--out", tmp_path / "g.toml")
        assert (status, out) == (2, "")
        assert said in err
        assert err.startswith("froude")
        assert err.count("\n") <= (2 if "--help" in err else 1)
        assert "Traceback" not in err
        assert list(tmp_path.iterdir()) == []

    def test_of_places_are_told_before_the_search(
        self, froude: Froude, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def searched(*_: object, **__: object) -> NoReturn:
            raise AssertionError("searched for what cannot be written")

        monkeypatch.setattr("scenarios.tuning.tuning.tune", searched)
        (tmp_path / "file").write_text("")
        (tmp_path / "folder.toml").mkdir()
        for place, said in (
            (tmp_path / "g.txt", "the gain set is a .toml file; give it that ending"),
            (tmp_path / "g", "the gain set is a .toml file; give it that ending"),
            (tmp_path / "file" / "g.toml", f"{tmp_path / 'file'} is a file, not a folder"),
            (tmp_path / "file" / "deep" / "g.toml", f"{tmp_path / 'file'} is a file, not a folder"),
            (tmp_path / "folder.toml", "is a folder"),
        ):
            status, out, err = froude("tune", "ant-x", "--out", place)
            assert (status, out) == (2, "")
            assert said in err
            assert str(place) in err
            assert err.count("\n") == 1

    def test_of_an_uncertainty_that_leaves_no_torque(self, froude: Froude, tmp_path: Path) -> None:
        wide = own_airframe(tmp_path / "wide.toml", ld=("Ld_pct = 0.81", "Ld_pct = 150.0"))
        status, out, err = froude("tune", wide, "--out", tmp_path / "g.toml")
        assert (status, out) == (2, "")
        assert "MINE: a sample has no roll torque (Ld = -" in err
        assert "sigma of 150 %" in err
        assert err.count("\n") == 1
        assert not (tmp_path / "g.toml").exists()
