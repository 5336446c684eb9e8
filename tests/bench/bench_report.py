"""What recording and report add to a run, and how large and how quick the report of many gain sets is.

Run: make bench. A run without files, one with recordings and one with the report, too, take turns in one process; the
best of each counts, because another program can only slow a run down. The report is opened in a headless Chromium.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import sys
import time
from pathlib import Path

import pytest

from scenarios.report import write_report
from scenarios.runner import RunOptions, run_scenario
from scenarios.scenario import load_scenario

sys.path.insert(0, str(Path(__file__).parents[1]))

from chromium import BROWSER, MISSING, Chromium

pytestmark = pytest.mark.bench

REPEATS = 3
MOST_ADDED = 0.20
SIXTEEN = 16
MOST_MB = 5.0
MOST_OPEN_S = 2.0


@pytest.mark.timeout(1800)
def test_what_recording_and_report_add(tmp_path, capsys):
    scenario = load_scenario("demo")
    kinds = {
        "no files": RunOptions(out=None),
        "recording": RunOptions(out=tmp_path, report=False),
        "recording and report": RunOptions(out=tmp_path),
    }
    # what is compiled and imported once is no part of it
    warm = dataclasses.replace(scenario, gain_sets=("table_2_2/ANT-X",))
    for options in kinds.values():
        run_scenario(warm, options)
    wall: dict[str, list[float]] = {name: [] for name in kinds}
    own: dict[str, list[float]] = {name: [] for name in kinds}
    for _ in range(REPEATS):
        for name, options in kinds.items():
            start, used = time.perf_counter(), time.process_time()
            run_scenario(scenario, options)
            wall[name].append(time.perf_counter() - start)
            own[name].append(time.process_time() - used)
            for folder in tmp_path.iterdir():
                shutil.rmtree(folder)
    best, cpu = ({name: min(times) for name, times in kind.items()} for kind in (wall, own))
    with capsys.disabled():
        print(f"\nthe demo, {len(os.sched_getaffinity(0))} cores, load {os.getloadavg()[0]:.1f}")
        for name in kinds:
            more, busier = (100.0 * (one[name] / one["no files"] - 1.0) for one in (best, cpu))
            busy = f"this process busy {cpu[name]:6.2f} s ({busier:+.0f} %)"
            print(f"  {name:22} {best[name]:6.2f} s ({more:+.0f} %), {busy}")
    # on a machine that others keep busy too, wall time says nothing of the share
    if os.getloadavg()[0] < 1.5 * len(os.sched_getaffinity(0)):
        assert best["recording and report"] / best["no files"] < 1.0 + MOST_ADDED


def many(folder: Path) -> Path:
    """A run of sixteen gain sets: four are flown, and each is told four times with other gains."""
    scenario = dataclasses.replace(load_scenario("demo"), gain_sets=("table_7_2",))
    run = run_scenario(scenario, RunOptions(out=folder, report=False)).folder
    assert run is not None
    data = json.loads((run / "run.json").read_text())
    flown, data["flights"] = data["flights"], []
    for number in range(SIXTEEN):
        flight = json.loads(json.dumps(flown[number % len(flown)]))
        flight["gain_set"]["name"] += f" {number}"
        for values in (flight["uploaded"], flight["gain_set"]["parameters"]):
            values["MC_ROLL_P"] *= 1.0 - 0.01 * number
        for kind in ("parquet", "backup.params"):
            copied = f"flights/set_{number}.{kind}"
            shutil.copy(run / flight["files"][kind], run / copied)
            flight["files"][kind] = copied
        flight["files"] = {kind: name for kind, name in flight["files"].items() if "set_" in name}
        data["flights"].append(flight)
    for file in (run / "flights").iterdir():
        if not file.name.startswith("set_"):
            file.unlink()
    (run / "run.json").write_text(json.dumps(data))
    return run


@pytest.mark.skipif(not BROWSER, reason=MISSING)
def test_a_report_of_sixteen_gain_sets(tmp_path, capsys):
    folder = many(tmp_path)
    start = time.perf_counter()
    page = write_report(folder)
    written_s, size_mb = time.perf_counter() - start, page.stat().st_size / 1e6
    opened_s = []
    with Chromium(tmp_path / "profile") as browser:
        browser.width(1280)
        for _ in range(REPEATS):
            browser.open(page)  # nothing of the page before it is in the way
            opened_s.append(browser.open(page))
            figures = browser.evaluate("document.querySelectorAll('figure').length")
        complaints = browser.complaints
    with capsys.disabled():
        print(f"\nreport of {SIXTEEN} gain sets, 500 samples each: {size_mb:.2f} MB, {figures} figures")
        print(f"  written in {written_s:.1f} s (loops, samples and figures), opened in {min(opened_s):.2f} s")
    assert not complaints
    assert figures > 3 * SIXTEEN
    assert size_mb < MOST_MB
    assert min(opened_s) < MOST_OPEN_S
