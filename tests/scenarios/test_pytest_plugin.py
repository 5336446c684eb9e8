"""The pytest plugin, in pytest processes of its own."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

GOOD = (
    "[[gain_set]]\nname = 'good'\n[gain_set.parameters]\nMC_ROLL_P = 6.5\nMC_ROLLRATE_P = 0.05\nMC_ROLLRATE_I = 0.05\n"
)
BAD = GOOD.replace("good", "wild").replace("0.05\nMC_ROLLRATE_I", "0.5\nMC_ROLLRATE_I")
SCENARIO = """
vehicle = "ant-x"
takeoff_altitude_m = 3.0
limits = "practical"
[gate]
hold_s = 0.5
timeout_s = 4.0
[[manoeuvre]]
kind = "step"
amplitude_deg = 10.0
hold_s = 2.0
return_s = 2.0
"""
FLOWN = """
import pytest

def test_good(froude):
    flown = froude.fly("quick.toml", gains="gains.toml", seed=3, limits="practical", vehicle="ant-x", profile="sitl")
    assert flown.passes()
    assert flown.passes("good")
    assert flown.flight("good").metric("rise_time_s").value < 0.4
    assert flown.run.scenario.seed == 3
    with pytest.raises(KeyError, match="no gain set 'bad'; there is good"):
        flown.passes("bad")

def test_wild(froude):
    assert froude.fly("quick.toml", gains=["gains.toml", "wild.toml"]).passes()

def test_analysed(froude):
    assert froude.analyse(gains="gains.toml", samples=8).passes()
    assert froude.analyse(gains="wild.toml", samples=8).passes()

def test_mistakes(froude):
    for keys, said in (
        ({"scenario": "demmo"}, "no such scenario"),
        ({"limits": "practicle"}, "no limit set"),
        ({"px4": "px4"}, "holds no bin/px4 and etc"),
    ):
        with pytest.raises(Exception, match=said):
            froude.fly(**keys)
"""
HEAVY = ("numpy", "numba", "pyarrow", "rerun", "scipy", "control", "pymavlink", "pyulog", "matplotlib", "rich")
LIGHT = f"""
import sys

def test_nothing_is_loaded_for_a_test_that_does_not_fly():
    assert not {{name.partition(".")[0] for name in sys.modules}} & set({HEAVY!r})
    assert "scenarios.flight_checks" not in sys.modules

def test_options(froude, request):
    here = request.config.invocation_params.dir
    assert froude.px4 == here / "px4"
    assert froude.out == here / "runs"
    assert froude.folder == request.path.parent
"""


def run(folder: Path, text: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run pytest in a folder of a user's, with files beside their tests."""
    for name, content in (
        ("test_gains.py", text),
        ("gains.toml", GOOD),
        ("wild.toml", BAD),
        ("quick.toml", SCENARIO),
    ):
        (folder / name).write_text(content, encoding="utf-8")
    installed = any(one.value == "scenarios.pytest_plugin" for one in entry_points(group="pytest11"))
    plugin = () if installed else ("-p", "scenarios.pytest_plugin")
    command = [sys.executable, "-m", "pytest", "-rA", "-p", "no:cacheprovider", "-W", "error", *plugin, *options]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder and the output of a user's tests that fly."""
    folder = tmp_path_factory.mktemp("user")
    done = run(folder, FLOWN, "--froude-out", "runs")
    assert done.returncode == 1, done.stdout + done.stderr
    return folder, done.stdout


def test_gains_that_fly_pass_and_what_is_asked_for_is_flown(flown: tuple[Path, str]) -> None:
    assert "PASSED test_gains.py::test_good" in flown[1]
    assert "PASSED test_gains.py::test_mistakes" in flown[1]


def test_runs_are_kept_where_asked(flown: tuple[Path, str]) -> None:
    folders = list((flown[0] / "runs").iterdir())
    assert len(folders) >= 2
    assert all((folder / "run.json").is_file() for folder in folders)


def test_a_failure_shows_table_reasons_and_folder(flown: tuple[Path, str]) -> None:
    folder, printed = flown
    assert "assert 1 of 2 gain sets pass (wild FAIL: limit cycle" in printed
    wild = printed.partition("_ test_wild _")[2].partition("_ test_analysed _")[0]
    (table,) = re.findall(r"-+ froude -+\n(.*)", wild, re.DOTALL)
    assert re.search(r"^good .* PASS$", table, re.MULTILINE)
    assert re.search(r"^wild .* FAIL$", table, re.MULTILINE)
    assert "wild: limit cycle" in table
    assert f"Run folder: {folder / 'runs'}" in table


def test_an_analysis_that_fails_shows_its_text(flown: tuple[Path, str]) -> None:
    analysed = flown[1].partition("_ test_analysed _")[2]
    assert "assert 0 of 1 gain sets pass (wild: nominal fails, 0 of 8 samples)" in analysed
    assert analysed.count("- froude -") == 2


def test_options_are_heeded_and_it_costs_nothing_while_it_is_not_used(tmp_path: Path) -> None:
    done = run(tmp_path, LIGHT, "--froude-out", "runs", "--froude-px4", "px4")
    assert done.returncode == 0, done.stdout + done.stderr
