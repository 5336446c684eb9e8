"""The pytest plugin, in pytest processes of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
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

Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Runs pytest in a folder of a user's with files beside their test."""

    def run(text: str, *options: str) -> subprocess.CompletedProcess[str]:
        folder = tmp_path / "user"
        folder.mkdir(exist_ok=True)
        (folder / "test_gains.py").write_text(text, encoding="utf-8")
        (folder / "gains.toml").write_text(GOOD, encoding="utf-8")
        (folder / "wild.toml").write_text(BAD, encoding="utf-8")
        (folder / "quick.toml").write_text(SCENARIO, encoding="utf-8")
        installed = any(one.value == "scenarios.pytest_plugin" for one in entry_points(group="pytest11"))
        plugin = () if installed else ("-p", "scenarios.pytest_plugin")
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error", *plugin, *options]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)

    return run


def test_gains_that_fly_pass_and_the_run_is_kept_where_asked(run: Run, tmp_path: Path) -> None:
    done = run(
        "def test_mine(froude):\n"
        "    flown = froude.fly('quick.toml', gains='gains.toml', seed=3)\n"
        "    assert flown.passes()\n"
        "    assert flown.flight('good').metric('rise_time_s').value < 0.4\n"
        "    assert flown.run.scenario.seed == 3\n",
        "--froude-out",
        "runs",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (folder,) = (tmp_path / "user" / "runs").iterdir()
    assert (folder / "run.json").is_file()


def test_a_failure_shows_table_reasons_and_folder(run: Run) -> None:
    done = run(
        "def test_mine(froude):\n    assert froude.fly('quick.toml', gains=['gains.toml', 'wild.toml']).passes()\n"
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "assert 1 of 2 gain sets pass (wild FAIL: limit cycle" in done.stdout
    assert "gain set" in done.stdout
    assert "Run folder: " in done.stdout
    assert "limit cycle" in done.stdout.partition("- froude -")[2]


def test_analyse_and_mistakes(run: Run) -> None:
    done = run(
        "import pytest\n"
        "def test_margins(froude):\n"
        "    assert not froude.analyse(gains='wild.toml', samples=8).passes()\n"
        "    assert froude.analyse(gains='gains.toml', samples=8).passes()\n"
        "def test_mistake(froude):\n"
        "    with pytest.raises(Exception, match='no such scenario'):\n"
        "        froude.fly('demmo')\n"
        "    with pytest.raises(Exception, match='no limit set'):\n"
        "        froude.fly(limits='practicle')\n"
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_px4_that_is_none_is_told(run: Run) -> None:
    done = run(
        "def test_mine(froude):\n    assert froude.fly('quick.toml', gains='gains.toml').passes()\n",
        "--froude-px4",
        "px4",
    )
    assert done.returncode == 1
    assert "holds no bin/px4 and etc" in done.stdout


def test_it_costs_nothing_while_it_is_not_used(run: Run) -> None:
    heavy = ("numpy", "numba", "pyarrow", "rerun", "scipy", "control", "pymavlink", "pyulog", "matplotlib", "rich")
    done = run(
        "import sys\n"
        "def test_mine():\n"
        f"    assert not {{name.partition('.')[0] for name in sys.modules}} & set({heavy!r})\n"
        "    assert 'scenarios.flight_checks' not in sys.modules\n"
    )
    assert done.returncode == 0, done.stdout + done.stderr
