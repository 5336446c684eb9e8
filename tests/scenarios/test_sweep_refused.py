"""Sweeps that must not begin, or not go on: one clear line before any work, and no folder left behind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from scenarios.cli import main
from scenarios.sweep import cluster_check, sweeping
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.plan import make_plan
from scenarios.sweep.program import program_facts
from scenarios.sweep.sweep_file import load_sweep
from tests.scenarios.sweeps import Inline, Quick, sweep_text, swept


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """The file of a small sweep."""
    path = tmp_path / "small.toml"
    path.write_text(sweep_text(48), encoding="utf-8")
    return path


def froude(*words: object) -> int:
    return main(["sweep", *map(str, words)])


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """All that was said."""
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == 1, err
    return lines[0]


@pytest.fixture
def begun(small: Path, tmp_path: Path) -> Path:
    """The folder of that sweep."""
    plan = make_plan(load_sweep(small))
    swept(plan, Inline(plan, Quick), tmp_path / "begun", program_facts())
    return tmp_path / "begun"


MANY = """title = "many"
[axes]
MC_ROLL_P = { from = 2.0, to = 12.0, count = 10000 }
MC_ROLLRATE_P = { from = 0.02, to = 0.12, count = 10000 }
MC_ROLLRATE_I = { from = 0.02, to = 0.12, count = 10000 }
"""


class TestNothingBegins:
    """One clear line, exit status 2 or 3, and no folder."""

    @pytest.fixture(autouse=True)
    def _no_work(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def work(*_: object) -> None:
            pytest.fail("work has begun")

        monkeypatch.setattr(sweeping, "sweep_points", work)

    @pytest.mark.parametrize(
        ("text", "line"),
        [
            (MANY, "1,000,000,000,000 candidates x 1 conditions are 1e+12 points; at most 100,000,000 are swept"),
            (sweep_text(10**12), "design.points: 1e+12 is out of range. It must be <= 1e+08"),
            (sweep_text(10, axes="MC_ROLLRATE_I = []"), "MC_ROLLRATE_I: the axis has no values. Give at least one"),
            (sweep_text(10, axes="MC_ROLLRATE_PP = [1.0]"), "MC_ROLLRATE_PP"),
            (sweep_text(10, axes='vehicle = ["ant-q"]'), "ant-q"),
            ("[axes\n", "small.toml: "),
        ],
        ids=["1e12", "1e12 sobol", "no values", "unknown", "no vehicle", "no TOML"],
    )
    def test_bad_file(
        self, text: str, line: str, small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        small.write_text(text, encoding="utf-8")
        assert froude(small, "--out", tmp_path / "out") == 2
        assert line in one_line(capsys)
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize(
        ("words", "status", "line"),
        [
            (("--dask", "tcp://127.0.0.1:9"), 3, "tcp://127.0.0.1:9: no Dask scheduler answers there"),
            (("--dask", "nowhere"), 2, '--dask "nowhere" is no scheduler: write tcp://HOST:8786, or local'),
            (("--dask", "local", "--engine", "processes"), 2, "--dask and --engine processes are two engines"),
            (("--jobs", "-1"), 2, "--jobs -1: give 1 or more"),
        ],
    )
    def test_bad_engine(
        self,
        words: tuple[str, ...],
        status: int,
        line: str,
        small: Path,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr(cluster_check, "CONNECT_S", 0.3)
        assert froude(small, "--out", tmp_path / "out", *words) == status
        assert line in one_line(capsys)
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize("out", ["/proc/nowhere", "small.toml", "small.toml/below"])
    def test_bad_folder(self, out: str, small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert froude(small, "--out", tmp_path / out) == 2
        assert "Choose another folder with --out" in one_line(capsys)

    def test_two_sweeps_in_one_folder(self, begun: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with Dataset(begun).locked():
            assert froude("--resume", begun) == 2
        assert f"{begun}: another froude sweep is writing here. Let it end, or stop it" in one_line(capsys)

    @pytest.mark.parametrize(
        ("change", "line"),
        [
            (("samples = 4", "samples = 5"), "samples was 4, is 5"),
            (("max = 20.0", "max = 25.0"), "limits[0].maximum was 20.0, is 25.0"),
            (("to = 12.0", "to = 11.0"), "parameters[0].high was 12.0, is 11.0"),
            (('"ant-r"', '"ant-r:ant-x"'), "cases[1].conditions.vehicle was"),
            (("points = 48", "points = 64"), "design.points was 48, is 64"),
        ],
    )
    def test_the_file_has_changed(
        self, change: tuple[str, str], line: str, begun: Path, small: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = small.read_text(encoding="utf-8")
        assert change[0] in text
        small.write_text(text.replace(*change), encoding="utf-8")
        assert froude("--resume", begun) == 2
        said = one_line(capsys)
        assert f"was begun with another sweep than {small} is now" in said
        assert line in said

    def test_the_file_has_gone(self, begun: Path, small: Path, capsys: pytest.CaptureFixture[str]) -> None:
        small.unlink()
        assert froude("--resume", begun) == 2
        assert "the sweep file is not there any more. Name it: froude sweep SWEEP.toml --resume DIR" in one_line(capsys)

    @pytest.mark.parametrize(
        ("facts", "line"),
        [
            ({"schema_version": 99}, "schema_version = 99, this program writes 1. Read it with the version of froude"),
            ({"program": "0123456789abcdef"}, "was begun with another version of the program: program was"),
            ({"fingerprint": None}, "is damaged: fingerprint is missing"),
        ],
    )
    def test_another_dataset(
        self, facts: dict[str, Any], line: str, begun: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = begun / "sweep.json"
        known = json.loads(path.read_text()) | facts
        path.write_text(json.dumps({key: value for key, value in known.items() if value is not None}))
        assert froude("--resume", begun) == 2
        assert line in one_line(capsys)

    def test_no_sweep_at_all(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert froude("--resume", tmp_path) == 2
        assert "is no sweep: it has no sweep.json" in one_line(capsys)
        assert froude("--resume", "--out", tmp_path) == 2
        assert "holds no sweep. Start one: froude sweep SWEEP.toml" in one_line(capsys)
