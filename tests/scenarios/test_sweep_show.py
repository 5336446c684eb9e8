"""`froude sweep --show`: table, JSON, pictures, page, recording and gain set say what the dataset holds."""

from __future__ import annotations

import ctypes.util
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1]))

from chromium import BROWSER, MISSING, Chromium
from sweeps import Inline, Quick, plan_of, swept
from sweeps import sweep_text as sweep_file
from test_report import Page
from test_sweep_ranking import Made, NonePasses

from scenarios import cli
from scenarios.gain_set import load_gain_sets
from scenarios.recorder.screenshot import screenshot
from scenarios.sweep import shown_sweep
from scenarios.sweep.pareto import front_of
from scenarios.sweep.ranking import rank
from scenarios.sweep.stored_sweep import stored_sweep
from scenarios.sweep.sweep_file import find_sweep, list_sweeps, load_sweep
from scenarios.sweep.sweep_maps import heat_maps, influences
from scenarios.sweep.sweep_text import sweep_text
from sitl.errors import FileError

HOSTILE = '<script>alert(1)</script> $x_1$ & [red]"7"[/red]'
AXES = "MC_ROLLRATE_D = { from = 0.0, to = 0.003 }\nmotor_lag_s = [0.01, 0.02]\n"


def made(folder: Path, rows: type[Quick] = Made, text: str = "") -> Path:
    """A folder of a sweep that nobody flew; its sweep file is gone."""
    file = folder / "made.toml"
    plan = plan_of(file, text or sweep_file(120, axes='vehicle = ["ant-x", "ant-r"]\n' + AXES), 32)
    swept(plan, Inline(plan, rows), folder / "made")
    file.unlink()
    return folder / "made"


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep that was looked at; its title would like to be markup."""
    text = sweep_file(120, axes='vehicle = ["ant-x", "ant-r"]\n' + AXES).replace('"small"', f"'{HOSTILE}'")
    folder = made(tmp_path_factory.mktemp("shown"), text=text)
    assert cli.main(["sweep", "--show", str(folder)]) == 0
    return folder


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look that draws nothing, for who only reads."""
    monkeypatch.setattr(shown_sweep, "write_pictures", lambda *_: [])


def told(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, Any]:
    status = cli.main(["sweep", "--show", *(str(word) for word in words), "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_the_table_says_what_the_ranking_says(
    shown: Path, undrawn: None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    ranking = rank(stored_sweep(shown))
    assert cli.main(["sweep", "--show", str(shown)]) == 0
    text = capsys.readouterr().out
    assert HOSTILE in text.replace("\n  ", " ")
    assert f"{ranking.passing} candidates pass everywhere, of 120 candidates in 4 cases" in text.replace("\n  ", " ")
    rows = [line.split() for line in text.splitlines() if re.match(r" +\d+ +\d+ .*\d/4", line)]
    assert [int(row[1]) for row in rows] == ranking.order[:10].tolist()
    for row, candidate in zip(rows, ranking.order.tolist(), strict=False):
        assert row[2:5] == [f"{value:.4g}" for value in ranking.values_of(candidate).values()]
        assert row[5] == f"{ranking.passed[candidate]}/4"
        assert float(row[6]) == ranking.worst_pct(candidate)
    assert "  0   ant-x, motor_lag_s 0.01 " in text
    assert "x no such mixer (first candidate" in text
    assert "110 more candidates" in text


@pytest.mark.parametrize("columns", [40, 80, 100, 120, 200])
def test_no_line_is_wider_than_the_terminal(shown: Path, columns: int) -> None:
    ranking = rank(stored_sweep(shown))
    text = sweep_text(ranking, front_of(ranking), width=columns)
    lines = [line for line in text.splitlines() if not line.startswith("Sweep folder")]  # there to be copied
    assert max(map(len, lines)) <= max(columns, 80)
    assert not [line for line in lines if "…" in line]


def test_json_says_the_same_with_units_in_its_keys(shown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ranking = rank(stored_sweep(shown))
    status, found = told(capsys, shown)
    assert status == 0
    assert found["passing_everywhere"] == ranking.passing
    assert found["points"] == found["points_done"] == 480
    assert found["complete"]
    assert [one["candidate"] for one in found["ranking"]] == ranking.order[:100].tolist()
    first = found["ranking"][0]
    assert found["winner"] == found["best"] == first
    assert first["worst_pass_pct"] == 100.0
    assert first["objectives"].keys() == {"rise_time_s_worst", "overshoot_pct_worst"}
    assert sum(case["errors"] for case in found["cases"]) == found["errors"] > 0
    assert set(found["files"]) == {path.name for path in shown.iterdir()} - {"points", ".lock", "sweep.json"}
    assert found["flown"] is None


def test_the_gate_is_whether_anything_passes_everywhere(
    shown: Path, undrawn: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told(capsys, shown, "--gate")[0] == 0
    none = made(tmp_path, NonePasses)
    status, found = told(capsys, none, "--gate")
    assert status == 1
    assert found["winner"] is None
    assert found["best"]["passes_everywhere"] is False
    assert (none / "best.toml").is_file()
    assert not (none / "winner.toml").exists()
    assert found["pareto"]["among"] == "all"
    assert cli.main(["sweep", "--show", str(none)]) == 0
    assert "No candidate passes everywhere" in capsys.readouterr().out
    assert load_gain_sets(none / "best.params")


def test_every_picture_is_there_and_loads_nothing(shown: Path) -> None:
    pictures = {path.name for path in shown.glob("*.svg")}
    pairs = {f"heat_{heat.x.axis.name}_{heat.y.axis.name}.svg" for heat in heat_maps(rank(stored_sweep(shown)))}
    assert len(pairs) == 3
    assert pictures == {"pareto.svg", *pairs}
    for name in pictures:
        text = (shown / name).read_text()
        assert text.startswith("<svg")
        assert not re.search(r"<image|<script|href=\"(?!#)", text)
        png = (shown / name).with_suffix(".png").read_bytes()
        assert png.startswith(b"\x89PNG")
        assert len(png) > 10_000


def test_a_second_look_writes_the_same_bytes_and_takes_old_pictures_away(shown: Path) -> None:
    names = [path for path in shown.iterdir() if path.suffix in (".svg", ".png", ".html", ".toml", ".params")]
    before = {path: path.read_bytes() for path in names}
    old = [shown / "heat_MC_YAW_P_MC_ROLL_P.svg", shown / "heat_MC_YAW_P_MC_ROLL_P.png"]
    for path in old:
        path.write_text("old")
    assert cli.main(["sweep", "--show", str(shown)]) == 0
    assert {path: path.read_bytes() for path in names} == before
    assert not any(path.exists() for path in old)
    assert not list(shown.glob("*.part*"))


def test_the_page_says_what_the_ranking_says(shown: Path) -> None:
    ranking = rank(stored_sweep(shown))
    page = Page(shown / "report.html")
    assert not [tag for tag, _ in page.elements if tag in ("script", "img", "link", "iframe", "image")]
    assert HOSTILE in page.text
    heads, rows = page.table("Best candidates")
    assert [int(name) for name in rows] == ranking.order[:20].tolist()
    rise = heads.index("rise time [s]")
    for name, cells in rows.items():
        assert cells[rise] in (f"{ranking.objective(int(name), 0):.4g}", "–")
        assert cells[heads.index("cases passed")].endswith(f"{ranking.passed[int(name)]} of 4")
    _, cases = page.table(f"Candidate {ranking.best}, case by case")
    assert [name.partition(": ")[2] for name in cases] == list(ranking.sweep.cases)
    assert all("PASS" in cells[0] for cells in cases.values())
    assert stored_sweep(shown).facts["text"] in page.text
    assert "100 % of the 4 uncertain models" in page.text


@pytest.mark.skipif(not BROWSER, reason=MISSING)
def test_the_page_in_a_browser(shown: Path, tmp_path: Path) -> None:
    with Chromium(tmp_path / "profile") as browser:
        for width in (1280, 390):
            browser.width(width)
            browser.open(shown / "report.html")
            assert browser.evaluate("document.documentElement.scrollWidth") <= width
        names = {node["name"] for node in browser.tree() if node["role"] in ("image", "img")}
        assert not browser.complaints
        assert browser.requests == [(shown / "report.html").resolve().as_uri()] * 2
    assert any(name.startswith("Candidates by rise time") for name in names)
    assert any(name.startswith("Heat map over") for name in names)


def test_the_recording_holds_candidates_maps_cases_and_table(shown: Path) -> None:
    import rerun as rr

    reader = rr.chunk.RrdReader(shown / "sweep.rrd")
    (recording,) = reader.recordings()
    assert recording.application_id == "froude-sweep"
    entities = {chunk.entity_path for chunk in reader.stream()}
    assert {"/front/fails_somewhere", "/front/passes_everywhere", "/front/pareto_front", "/front/winner"} <= entities
    assert {"/summary", "/cases", "/cases_page", "/swept"} <= entities
    assert sum(entity.startswith("/maps/") for entity in entities) == 3


@pytest.mark.skipif(ctypes.util.find_library("vulkan") is None, reason="no Vulkan driver: the viewer cannot draw")
def test_the_viewer_shows_the_recording_without_complaint(shown: Path, tmp_path: Path) -> None:
    assert screenshot(shown / "sweep.rrd", tmp_path / "front.png") == []
    assert (tmp_path / "front.png").stat().st_size > 20_000


def test_a_stopped_sweep_is_shown_as_far_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = made(tmp_path)
    (folder / "points" / "chunk-00000001.parquet").unlink()
    status, found = told(capsys, folder)
    assert status == 0
    assert (found["complete"], found["candidates_incomplete"], found["candidates_ranked"]) == (False, 32, 88)
    assert cli.main(["sweep", "--show", str(folder)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "not complete: 448 of 480 points are done, 32 candidates in some cases only, and not ranked" in text
    for path in (folder / "points").glob("chunk-*[05].parquet"):
        path.unlink()
    for path in (folder / "points").iterdir():
        path.unlink()
    status, found = told(capsys, folder, "--gate")
    assert (status, found["best"]) == (1, None)
    assert not (folder / "sweep.rrd").exists()
    assert not list(folder.glob("*.png"))
    assert "No candidate is complete yet" in (folder / "report.html").read_text()


FLIGHT = {
    "candidate": 7, "case": 1, "case_name": "ant-x, motor_lag_s 0.02", "autopilot": "own", "run": "20261129T_x",
    "gain_set": "candidate 7", "batch_passes": True, "outcome": "FAIL", "reason": "overshoot 21 %, limit <= 20 %",
    "verdicts_agree": False, "agrees": False, "reasons": ["gyro noise keeps it moving"],
    "metrics": [
        {"metric": "delay_margin_s", "batch": 0.02, "flight": 0.01, "difference": -0.01, "within": False,
         "tolerance": 1e-3, "reason": "", "unit": "s"},
        {"metric": "rise_time_s", "batch": 0.2, "flight": 0.2, "difference": 0.0, "within": True, "tolerance": 1e-3,
         "reason": "", "unit": "s"},
    ],
}  # fmt: skip
LEFT_OUT = {
    "candidate": None,
    "case": 2,
    "case_name": "ant-r, motor_lag_s 0.01",
    "autopilot": "own",
    "reason": "no mixer",
}


def test_disagreements_with_flights_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = made(tmp_path)
    (folder / "flights").mkdir()
    agreeing = {**FLIGHT, "agrees": True, "verdicts_agree": True, "metrics": []}
    path = folder / "flights" / "disagreements.json"
    path.write_text(json.dumps({"flights": [FLIGHT, agreeing], "left_out": [LEFT_OUT]}))
    _, found = told(capsys, folder)
    assert found["disagreements"] == [FLIGHT]
    cli.main(["sweep", "--show", str(folder)])
    text = " ".join(capsys.readouterr().out.split())
    assert "Flown over MAVLink: 1 of 2 flights agrees with the batch:" in text
    assert "the batch passes, the flight is FAIL (overshoot 21 %, limit <= 20 %)" in text
    assert "delay margin 20 ms by the batch, 10 ms in flight; gyro noise keeps it moving" in text
    assert "rise time 0.2" not in text
    assert "not flown: every candidate, ant-r, motor_lag_s 0.01: no mixer" in text
    page = Page(folder / "report.html")
    assert "delay margin 20 ms by the batch" in page.text
    path.write_text('{"flights": [{}]}')
    assert cli.main(["sweep", "--show", str(folder)]) == 2
    assert "disagreements.json: cannot be read: KeyError('agrees')" in capsys.readouterr().err


@pytest.mark.parametrize("objectives", ['["rise_time_s"]', '["rise_time_s", "overshoot_pct", "peak_delta_lat"]'])
def test_one_objective_and_three(tmp_path: Path, objectives: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = sweep_file(60, axes="").replace('["rise_time_s", "overshoot_pct"]', objectives)
    folder = made(tmp_path, text=text.replace("MC_ROLLRATE_P = {", "# {"))
    status, found = told(capsys, folder)
    assert status == 0
    assert len(found["best"]["objectives"]) == len(json.loads(objectives))
    assert {path.name for path in folder.glob("*.svg")} == {"pareto.svg"}  # one parameter makes no map


def test_the_parameter_that_decides_is_found(tmp_path: Path) -> None:
    class Decided(Made):
        def rows(self, task: Any) -> Any:
            columns = super().rows(task)
            good = task.values[:, 1] < 0.06
            columns["passes"] = np.where(good, 4, 1).astype(np.int32)
            columns["outcome"] = np.where(good, "PASS", "FAIL").astype(object)
            return columns

    ranking = rank(stored_sweep(made(tmp_path, Decided)))
    found = influences(ranking)
    assert next(iter(found)) == "MC_ROLLRATE_P"
    assert found["MC_ROLLRATE_P"] > 0.6
    assert max(found["MC_ROLL_P"], found["MC_ROLLRATE_D"]) < 0.2
    heat = heat_maps(ranking)[0]
    assert heat.counts.sum() == 120
    assert "MC_ROLLRATE_P" in (heat.x.axis.name, heat.y.axis.name)
    table = pq.read_table(ranking.sweep.path / "points").to_pydict()
    assert np.nanmax(heat.share_pct) == max(100.0 * n / 4 for n in table["passes"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--show", "nowhere"], "nowhere: is no sweep: it has no sweep.json"),
        (["--show", "--out", "nowhere"], "nowhere: holds no sweep"),
        (["roll_gain"], 'roll_gain: no such sweep (did you mean "roll_gains"?). In the library: '),
    ],
)
def test_what_is_not_there_is_named(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["sweep", *words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("name", list_sweeps())
def test_a_sweep_of_the_library_is_found_by_its_name(name: str) -> None:
    sweep = load_sweep(name)
    assert sweep.name == name
    assert sweep.path == find_sweep(name)
    with pytest.raises(FileError):
        find_sweep(f"no/{name}")
