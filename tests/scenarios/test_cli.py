"""The command line: what it prints where, how it ends, and what it says when something is wrong."""

from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scenarios import cli
from scenarios.cli import main
from scenarios.one_flight import fly

QUICK = """
title = "quick"
vehicle = "ant-x"
gain_sets = ["table_2_2/ANT-X"]
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
SET = '[[gain_set]]\nname = "mine"\n[gain_set.parameters]\n'

Froude = Callable[..., tuple[int, str, str]]


@pytest.fixture
def quick(tmp_path: Path) -> Path:
    path = tmp_path / "quick.toml"
    path.write_text(QUICK)
    return path


@pytest.fixture
def froude(capsys: pytest.CaptureFixture[str], without_report: None) -> Froude:
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


@pytest.fixture(scope="module", autouse=True)
def _compiled(quick_job: Any) -> None:
    """The first flight of a version says that it takes longer; these are about the ones after it."""
    fly(quick_job(manoeuvres=()))


def one_line(err: str) -> str:
    """The one line on standard error, which starts with the program's name."""
    assert err.endswith("\n")
    assert err.count("\n") == 1, err
    assert err.startswith("froude: ")
    return err.removeprefix("froude: ").strip()


class TestFly:
    def test_prints_the_table_and_where_to_look(self, froude: Froude, quick: Path, tmp_path: Path) -> None:
        status, out, err = froude("fly", quick, "--out", tmp_path / "runs")
        assert (status, err) == (0, "")
        (folder,) = (tmp_path / "runs").iterdir()
        assert f"Run folder: {folder}" in out
        assert "2.2 ANT-X" in out
        assert "PASS" in out
        assert str(folder / "compare.rrd") in out

    def test_json_is_run_json_and_nothing_else(self, froude: Froude, quick: Path, tmp_path: Path) -> None:
        status, out, err = froude("fly", quick, "--json", "--out", tmp_path / "runs")
        assert (status, err) == (0, "")
        (folder,) = (tmp_path / "runs").iterdir()
        assert json.loads(out) == json.loads((folder / "run.json").read_text(encoding="utf-8"))
        assert json.loads(out)["command"][:3] == ["froude", "fly", str(quick)]

    def test_options_take_the_scenarios_place(self, froude: Froude, quick: Path, tmp_path: Path) -> None:
        words = ("--vehicle", "ant-r:adam-0", "--scaling", "derivatives,gain", "--profile", "board", "--seed", "5")
        status, out, _ = froude("fly", quick, *words, "--gains", "px4_defaults", "--json", "--out", tmp_path)
        run = json.loads(out)
        assert status == 0
        assert run["vehicle"]["spec"] == "ant-r:adam-0"
        assert run["vehicle"]["scaling"] == ["derivatives", "gain"]
        assert run["scenario"]["profile"] == "board"
        assert run["seed"] == 5
        assert [flight["gain_set"]["name"] for flight in run["flights"]] == ["PX4 defaults"]
        assert run["baseline"]["gain_set"]["name"] == "own ADAM-0"

    def test_axes_both_of_a_scenario_fly_the_set_on_pitch(self, froude: Froude, quick: Path, tmp_path: Path) -> None:
        quick.write_text('axes = "both"\n' + QUICK)
        _, out, _ = froude("fly", quick, "--json", "--out", tmp_path / "runs", "--gains", "table_7_2/ADAM-0")
        (flight,) = json.loads(out)["flights"]
        for name in ("_P", "RATE_P", "RATE_I", "RATE_D"):
            assert flight["uploaded"][f"MC_PITCH{name}"] == flight["uploaded"][f"MC_ROLL{name}"]

    @pytest.mark.parametrize(
        ("gains", "limits", "status"),
        [
            ("table_2_2/ANT-X", "practical", 0),
            ("table_7_2/ANT-R", "practical", 1),  # FAIL
            ("table_2_2/ANT-X", "study", 1),  # UNSET: it never settles
            ("table_2_2/ANT-X", "none", 1),  # INFO: nothing was asked of it
        ],
    )
    def test_gate(self, froude: Froude, quick: Path, tmp_path: Path, gains: str, limits: str, status: int) -> None:
        quick.write_text(f'limits = "{limits}"\n' + QUICK)
        words = ("fly", quick, "--gains", gains, "--out", tmp_path / "runs")
        assert froude(*words, "--gate")[0] == status
        assert froude(*words)[0] == 0

    def test_junit_and_markdown(self, froude: Froude, quick: Path, tmp_path: Path) -> None:
        files = ("--junit", tmp_path / "out.xml", "--markdown", tmp_path / "out.md")
        status, _, _ = froude("fly", quick, *files, "--out", tmp_path / "runs")
        assert (tmp_path / "out.md").read_text().startswith("## Trust 2.2 ANT-X on ANT-X.\n")
        assert status == 0
        suite = ET.parse(tmp_path / "out.xml").getroot()
        assert suite.get("failures") == "0"

    def test_live_tells_how_to_look_on_standard_error(self, froude: Froude, quick: Path, tmp_path: Path) -> None:
        status, out, err = froude("fly", quick, "--live", "--json", "--out", tmp_path / "runs")
        assert status == 0
        assert one_line(err).startswith("live view: look on with: rerun --connect rerun+http://127.0.0.1:")
        json.loads(out)


class TestMistakes:
    """One line that names the thing and the remedy, nothing on standard output, exit status 2."""

    @pytest.mark.parametrize(
        ("words", "says"),
        [
            (["--vehicle", "ant-y"], 'unknown airframe "ant-y" (did you mean "ant-x"?)'),
            (["--vehicle", "ant-r:"], "ant-r:"),
            (["--gains", "table_9"], "table_9: no such gain set file (did you mean"),
            (["--gains", "table_7_2/ANT-Y"], 'has no gain set "ANT-Y"'),
            (["--gains", "table_2_2/ANT-X", "table_2_2"], "has the same name as '2.2 ANT-X'"),
            (["--scaling", "size"], 'unknown scaling "size"'),
            (["--seed", "-1"], "--seed -1: give 0 or more"),
            (["--jobs", "0"], "--jobs 0: give 1 or more"),
            (["--jobs", "2", "--live"], "--live shows one flight at a time"),
            (["--jobs", "2", "--connect", "udpin://127.0.0.1:14540"], "leave out --connect"),
            (["--connect", "udp://x"], "link 'udp://x': unknown kind 'udp'. Write udpin://"),
            (["--connect", "udpin://127.0.0.1:no"], "the port is not a number"),
            (["--connect", "serial:///dev/ttyACM0:57600"], "--arm-hardware"),
            (["--out", "{tmp}/quick.toml"], "the run's folder cannot be made"),
            (["--junit", "{tmp}/nowhere/out.xml"], "its folder does not exist. Make the folder"),
            (["--markdown", "{tmp}/nowhere/out.md"], "write --markdown to another place"),
        ],
    )
    def test_options(self, froude: Froude, quick: Path, tmp_path: Path, words: list[str], says: str) -> None:
        words = [word.format(tmp=tmp_path) for word in words]
        if "--out" not in words:
            words += ["--out", str(tmp_path / "runs")]
        status, out, err = froude("fly", quick, *words)
        assert (status, out) == (2, "")
        assert says in one_line(err)
        assert not (tmp_path / "runs").exists() or not list((tmp_path / "runs").iterdir())

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            (("vehicle =", "vehicel ="), 'vehicel: unknown key (did you mean "vehicle"?)'),
            (("amplitude_deg = 10.0", "amplitude_deg = 400.0"), "manoeuvre[0].amplitude_deg: 400 is out of range"),
            (("hold_s = 2.0", "hold_s = 601.0"), "manoeuvre[0].hold_s: 601 is out of range"),
            (("[[manoeuvre]]", "[manoeuvre]"), "holds no [[manoeuvre]]"),
            (('"step"', '"stepp"'), 'unknown kind "stepp" (did you mean "step"?)'),
            (("takeoff_altitude_m = 3.0", "takeoff_altitude_m = nan"), "takeoff_altitude_m"),
            (('title = "quick"', "title = quick"), "line 2"),
            (('title = "quick"', "setpoint_rate_hz = 60.0"), "does not divide the 250 Hz"),
        ],
    )
    def test_scenarios(self, froude: Froude, quick: Path, tmp_path: Path, change: tuple[str, str], says: str) -> None:
        assert change[0] in QUICK
        quick.write_text(QUICK.replace(*change))
        status, out, err = froude("fly", quick, "--out", tmp_path / "runs")
        assert (status, out) == (2, "")
        assert str(quick) in one_line(err)
        assert says in one_line(err)

    @pytest.mark.parametrize(
        ("line", "says"),
        [
            ("MC_ROLLRATE_Q = 0.1", "unknown parameter MC_ROLLRATE_Q"),
            ("MC_ROLLRATE_P = -0.1", "MC_ROLLRATE_P = -0.1 is negative"),
            ("MC_ROLLRATE_P = nan", "MC_ROLLRATE_P = nan is not a finite number"),
            ("MC_ROLLRATE_P = 1000.0", "MC_ROLLRATE_P = 1000 is absurd"),
            ("MC_AIRMODE = 0.5", "MC_AIRMODE"),
            ('MC_ROLLRATE_P = "0.1"', "MC_ROLLRATE_P = '0.1' is not a number"),
        ],
    )
    def test_gain_sets(self, froude: Froude, quick: Path, tmp_path: Path, line: str, says: str) -> None:
        gains = tmp_path / "mine.toml"
        gains.write_text(SET + line + "\n")
        status, out, err = froude("fly", quick, "--gains", gains, "--out", tmp_path / "runs")
        assert (status, out) == (2, "")
        assert says in one_line(err)
        assert "mine" in err

    def test_two_sets_of_the_same_name(self, froude: Froude, quick: Path, tmp_path: Path) -> None:
        gains = tmp_path / "mine.toml"
        gains.write_text(2 * (SET + "MC_ROLL_P = 5.0\n"))
        status, _, err = froude("fly", quick, "--gains", gains, "--out", tmp_path / "runs")
        assert status == 2
        assert "two gain sets are named 'mine'" in one_line(err)

    @pytest.mark.parametrize("words", [["fly", "--profile", "fast"], ["hover"], ["fly", "--jobs", "many"], ["model"]])
    def test_words(self, froude: Froude, words: list[str]) -> None:
        status, out, err = froude(*words)
        assert (status, out) == (2, "")
        assert "--help" in err
        assert "Traceback" not in err

    def test_no_command_shows_the_help(self, froude: Froude) -> None:
        status, out, _ = froude()
        assert status == 2
        assert "fly" in out


class TestStandardOutput:
    """A result that nobody reads, or nobody can, is on disk all the same."""

    def run(self, folder: Path, *words: object, **keys: Any) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "scenarios.cli", *map(str, words)]
        return subprocess.run(
            command, cwd=Path(cli.__file__).parents[1], text=True, stderr=subprocess.PIPE, check=False, **keys
        )

    def test_a_reader_that_went_away_does_not_change_the_exit_status(self, quick: Path, tmp_path: Path) -> None:
        out = tmp_path / "runs"
        fly = f"{sys.executable} -m scenarios.cli fly {quick} --out {out} --gains table_7_2/ANT-R --gate"
        done = self.run_shell(f"{fly} | true; exit ${{PIPESTATUS[0]}}")
        assert (done.returncode, done.stderr) == (1, "")
        (folder,) = out.iterdir()
        assert (folder / "run.json").is_file()

    def test_closed(self, quick: Path, tmp_path: Path) -> None:
        out = tmp_path / "runs"
        done = self.run_shell(f"{sys.executable} -m scenarios.cli fly {quick} --out {out} >&-")
        assert (done.returncode, done.stderr) == (0, "")
        assert (next(out.iterdir()) / "run.json").is_file()

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
    def test_full(self, quick: Path, tmp_path: Path) -> None:
        out = tmp_path / "runs"
        with Path("/dev/full").open("w") as full:
            done = self.run(tmp_path, "fly", quick, "--out", out, stdout=full)
        assert done.returncode == 2
        assert "standard output: cannot be written: No space left on device" in one_line(done.stderr)
        assert str(next(out.iterdir())) in done.stderr

    def run_shell(self, line: str) -> subprocess.CompletedProcess[str]:
        root = Path(cli.__file__).parents[1]
        return subprocess.run(["bash", "-c", line], cwd=root, text=True, capture_output=True, check=False)


def test_a_command_that_needs_no_flight_survives_a_reader_that_went_away(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m scenarios.cli model ant-x | true; exit ${{PIPESTATUS[0]}}"],
        cwd=Path(cli.__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


class TestAirframesAndModel:
    def test_airframes(self, froude: Froude) -> None:
        status, out, err = froude("airframes")
        assert (status, err) == (0, "")
        assert all(name in out for name in ("ANT-R", "ANT-X", "CARRIER-1", "ADAM-0"))
        status, out, _ = froude("airframes", "--json")
        assert {frame["name"] for frame in json.loads(out)} == {"ANT-R", "ANT-X", "CARRIER-1", "ADAM-0"}

    def test_model(self, froude: Froude) -> None:
        status, out, err = froude("model", "ant-r:ant-x", "--json")
        assert (status, err) == (0, "")
        assert json.loads(out)["reference"] == "ANT-R"
        assert froude("model", "ant-z")[0] == 2

    def test_version(self, froude: Froude) -> None:
        status, out, _ = froude("--version")
        assert status == 0
        assert out.startswith("froude ")
