"""Runs read back: whole, of an older program, killed, damaged; and what is no run."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios import run_list
from scenarios.run_folder import load_run
from scenarios.run_list import list_runs, newest, run_folders, summary
from scenarios.run_reader import StoredRun, read_run
from scenarios.run_shape import RUN
from scenarios.runner import RunOptions, run_scenario
from scenarios.stored_flight import log_span_s
from scenarios.telemetry import COLUMNS, METADATA_KEY, Telemetry
from sitl.errors import FileError, UsageError

FLOWN = "2_2_ant-x"
SHAKES = "7_2_ant-r"


@pytest.fixture(scope="module")
def run(quick_scenario: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of two gain sets, one that passes and one that shakes."""
    out = tmp_path_factory.mktemp("runs")
    scenario = quick_scenario(gain_sets=("table_2_2/ANT-X", "table_7_2/ANT-R"))
    folder = run_scenario(scenario, RunOptions(out=out, command=("froude", "fly"), report=False)).folder
    assert folder is not None
    return folder


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return Path(shutil.copytree(run, tmp_path / run.name))


@pytest.fixture
def killed(copy: Path) -> Path:
    """As kill -9 leaves it: the first flight whole, the second in flight, its files cut anywhere."""
    for name in ("run.json", "compare.rrd", "junit.xml", f"flights/{SHAKES}.parquet"):
        (copy / name).unlink()
    for kind in ("rrd", "tlog"):
        whole = copy / "flights" / f"{SHAKES}.{kind}"
        (copy / "flights" / f"{SHAKES}.partial.{kind}").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
        whole.unlink()
    return copy


def edit(folder: Path, **changes: Any) -> None:
    """Change keys of a run.json."""
    data = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(data | changes))


def is_whole(run: StoredRun) -> bool:
    """Can others go through it without looking at every step?"""
    assert set(RUN) <= set(run.data)
    for flight in run.everything:
        assert flight.outcome in ("PASS", "FAIL", "UNSET", "INFO")
        assert all(path.is_file() for path in flight.files.values())
        assert all(isinstance(value, int | float) for value in flight.data["uploaded"].values())
    return all(isinstance(problem, str) and "\n" not in problem for problem in run.problems)


# -- whole -----------------------------------------------------------------------------------------------------------


def test_a_run_is_read_as_it_was_written(run: Path) -> None:
    stored = read_run(run)
    assert (stored.problems, stored.complete, stored.known) == ((), True, True)
    assert stored.data == load_run(run)
    assert [flight.slug for flight in stored.flights] == [FLOWN, SHAKES]
    assert [flight.outcome for flight in stored.flights] == ["PASS", "FAIL"]
    assert stored.baseline is None
    for flight in stored.everything:
        assert flight.finished
        assert flight.recording == run / "flights" / f"{flight.slug}.rrd"
        assert flight.log == run / "flights" / f"{flight.slug}.tlog"
        telemetry = stored.telemetry(flight)
        assert telemetry is not None
        assert telemetry.sha256() == flight.data["telemetry_sha256"]
    assert stored.compare == run / "compare.rrd"
    assert stored.report == run / "report.html"
    assert stored.problems == ()


@pytest.mark.parametrize("name", ["", "run.json", "compare.rrd", "flights", f"flights/{FLOWN}.rrd"])
def test_any_file_of_a_run_stands_for_it(run: Path, name: str) -> None:
    assert read_run(run / name).folder == run


def test_the_log_tells_from_when_to_when_it_was_flown(run: Path) -> None:
    stored = read_run(run)
    telemetry = stored.telemetry(stored.flights[0])
    span = stored.flights[0].log_span_s()
    assert telemetry is not None
    assert span is not None
    assert span[0] < 0.1
    assert span[1] == pytest.approx(telemetry["t_s"][-1], abs=0.1)


def test_flights_answer_to_name_slug_and_part(run: Path) -> None:
    stored = read_run(run)
    assert [stored.flight(word).slug for word in ("2.2 ANT-X", SHAKES, "ant-r", "2_2")] == [
        FLOWN,
        SHAKES,
        SHAKES,
        FLOWN,
    ]
    with pytest.raises(UsageError, match=r"several flights\. It has 2\.2 ANT-X, 7\.2 ANT-R"):
        stored.flight("ant")
    with pytest.raises(UsageError, match="no flight 'carrier'"):
        stored.flight("carrier")


# -- of an older program -----------------------------------------------------------------------------------------------


def test_a_run_of_the_first_version(copy: Path) -> None:
    """It had no twins, and its telemetry no true angles: its fingerprint is of the columns that it has."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = copy / "flights" / f"{FLOWN}.parquet"
    table = pq.read_table(path)
    then = [name for name in COLUMNS if not name.endswith("_true_rad")]
    print_ = Telemetry.from_parquet(path)[0].sha256(then)
    about = {METADATA_KEY: json.dumps({"telemetry_sha256": print_}).encode()}
    pq.write_table(pa.table({name: table[name] for name in then}).replace_schema_metadata(about), path)
    data = json.loads((copy / "run.json").read_text())
    del data["twins"]
    data["flights"][0]["telemetry_sha256"] = print_
    (copy / "run.json").write_text(json.dumps(data | {"schema_version": 1}))
    stored = read_run(copy)
    telemetry = stored.telemetry(stored.flights[0])
    assert telemetry is not None
    assert np.isnan(telemetry["phi_true_rad"]).all()
    assert (stored.problems, stored.data["twins"], stored.data["schema_version"]) == ((), [], 2)


def test_a_newer_run_is_refused_and_its_telemetry_too(copy: Path) -> None:
    import pyarrow.parquet as pq

    path = copy / "flights" / f"{FLOWN}.parquet"
    table = pq.read_table(path)
    pq.write_table(table.append_column("wind_m_s", table["t_s"]), path)
    stored = read_run(copy)
    assert stored.telemetry(stored.flights[0]) is None
    assert "which this froude does not know: a newer one wrote it" in stored.problems[0]
    edit(copy, schema_version=3)
    with pytest.raises(FileError, match="written by a newer froude"):
        read_run(copy)
    assert "newer froude" in summary(copy).problem


# -- half-written ------------------------------------------------------------------------------------------------------


def test_a_killed_run_opens_with_what_it_has(killed: Path, run: Path) -> None:
    stored, whole = read_run(killed), read_run(run)
    assert is_whole(stored)
    assert not stored.complete
    assert not stored.known
    flown, shook = stored.flights
    assert (flown.name, flown.outcome, flown.finished) == ("2.2 ANT-X", "PASS", True)
    assert (shook.name, shook.outcome, shook.finished) == ("7.2 ANT-R", "UNSET", False)
    for one, other in zip(stored.flights, whole.flights, strict=True):
        assert one.data["uploaded"] == pytest.approx(other.data["uploaded"])
    measured = {m["name"]: m["value"] for m in whole.flights[0].data["metrics"] if not m["segment"]}
    told = {m["name"]: m["value"] for m in flown.data["metrics"]}
    assert told == {name: value for name, value in measured.items() if value is not None}
    for one, other in zip(stored.flights, whole.flights, strict=True):
        texts = [event["text"] for event in other.data["events"]]
        # how much of a recording had left the program by then depends on how fast it flew
        assert [event["text"] for event in one.data["events"]] == texts[: len(one.data["events"])]
        for known, event in zip(one.data["events"], other.data["events"], strict=False):
            assert known["t_s"] == pytest.approx(event["t_s"])
    assert flown.data["events"]
    telemetry = stored.telemetry(flown)
    assert telemetry is not None
    assert telemetry.sha256() == whole.flights[0].data["telemetry_sha256"]
    assert stored.telemetry(shook) is None
    span = shook.log_span_s()
    assert span is not None
    assert stored.data["started_utc"] == whole.data["started_utc"]
    assert (stored.data["scenario"]["name"], stored.data["vehicle"]["spec"]) == ("roll_step", "ant-x")
    assert stored.problems[0].startswith("run.json is missing: the run was killed, or is still being flown")
    assert stored.problems[1].startswith(f"flight 7.2 ANT-R was not finished: flights/{SHAKES}.partial.rrd and")
    assert stored.problems[1].endswith(f"open up to {span[1]:.1f} s of vehicle time")
    assert len(stored.problems) == 2


def test_killed_with_all_of_a_recording_written(killed: Path, run: Path) -> None:
    partial = killed / "flights" / f"{SHAKES}.partial.rrd"
    partial.write_bytes((run / "flights" / f"{SHAKES}.rrd").read_bytes())
    (_, shook), (_, whole) = read_run(killed).flights, read_run(run).flights
    assert not shook.finished
    assert shook.data["events"]
    assert [event["text"] for event in shook.data["events"]] == [event["text"] for event in whole.data["events"]]
    assert shook.data["events"][0]["t_s"] == pytest.approx(whole.data["events"][0]["t_s"])


def test_killed_before_anything_was_flown(tmp_path: Path) -> None:
    folder = tmp_path / "20261122T200000Z_demo_ANT-X"
    (folder / "flights").mkdir(parents=True)
    stored = read_run(folder)
    assert is_whole(stored)
    assert stored.flights == ()
    assert stored.problems[-1] == "no flight was recorded"
    assert stored.data["started_utc"] == "2026-11-22T20:00:00Z"


def test_flights_that_run_json_does_not_know_are_found(copy: Path) -> None:
    data = json.loads((copy / "run.json").read_text())
    edit(copy, flights=data["flights"][:1], complete=False)
    stored = read_run(copy)
    assert [(flight.slug, flight.known, flight.outcome) for flight in stored.flights] == [
        (FLOWN, True, "PASS"),
        (SHAKES, False, "FAIL"),
    ]
    assert stored.problems[0].startswith("the run was interrupted")
    assert stored.problems[1].startswith(f"run.json does not tell of the flight {SHAKES}")


def test_what_is_missing_is_named(copy: Path) -> None:
    for name in ("compare.rrd", f"flights/{FLOWN}.parquet", f"flights/{FLOWN}.params"):
        (copy / name).unlink()
    (copy / "flights" / f"{SHAKES}.tlog").write_bytes(b"")
    stored = read_run(copy)
    assert stored.problems == (
        "compare.rrd is missing",
        f"flights/{FLOWN}.parquet is missing",
        f"flights/{FLOWN}.params is missing",
        f"flights/{SHAKES}.tlog is empty",
    )
    assert stored.compare is None
    assert stored.telemetry(stored.flights[0]) is None
    assert stored.flights[1].log_span_s() is None


def test_files_elsewhere_are_not_those_of_a_flight(copy: Path, tmp_path: Path) -> None:
    """A run.json that names a file outside of the folder does not lead there."""
    (tmp_path / "secret.parquet").write_text("secret")
    data = json.loads((copy / "run.json").read_text())
    data["flights"][0]["files"] = {"parquet": "../secret.parquet", "rrd": "/etc/passwd"}
    edit(copy, flights=data["flights"])
    stored = read_run(copy)
    assert "flights/secret.parquet is missing" in stored.problems
    assert all(path.is_relative_to(copy) for flight in stored.everything for path in flight.files.values())


# -- damaged -----------------------------------------------------------------------------------------------------------


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """The bytes cut off somewhere, with some changed, or both."""
    bad = bytearray(data[: draw(st.integers(0, len(data)))] if draw(st.booleans()) else data)
    for at in draw(st.lists(st.integers(0, max(0, len(bad) - 1)), max_size=8)) if bad else ():
        bad[at] ^= draw(st.integers(1, 255))
    return bytes(bad)


@pytest.fixture(scope="module")
def victim(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A copy that is damaged again and again; recordings are not, for they are not read as long as run.json is."""
    folder = Path(shutil.copytree(run, tmp_path_factory.mktemp("victim") / run.name))
    for path in (folder / "flights").glob("*.rrd"):
        path.unlink()
    return folder


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_a_damaged_run_json(run: Path, victim: Path, data: st.DataObject) -> None:
    whole = (run / "run.json").read_bytes()
    (victim / "run.json").write_bytes(data.draw(damaged(whole)))
    (victim / "flights" / f"{FLOWN}.parquet").write_bytes((run / "flights" / f"{FLOWN}.parquet").read_bytes())
    assert summary(victim).folder == victim
    try:
        stored = read_run(victim)
    except FileError as error:
        assert "newer froude" in str(error)  # noqa: PT017 a digit of the version was hit: nothing else is refused
        return
    assert is_whole(stored)
    assert {FLOWN, SHAKES} <= {flight.slug for flight in stored.everything}
    if not stored.known:
        assert stored.problems[0].startswith(("run.json is ", "run.json schema_version is "))


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_damaged_telemetry(run: Path, victim: Path, data: st.DataObject) -> None:
    whole = (run / "flights" / f"{FLOWN}.parquet").read_bytes()
    (victim / "run.json").write_bytes((run / "run.json").read_bytes())
    (victim / "flights" / f"{FLOWN}.parquet").write_bytes(data.draw(damaged(whole)))
    stored = read_run(victim)
    flight = stored.flights[0]
    telemetry = stored.telemetry(flight)
    told = [problem for problem in stored.problems if f"{FLOWN}.parquet" in problem]
    if telemetry is None:
        assert told
    elif telemetry.sha256() != flight.data["telemetry_sha256"]:
        assert any("its fingerprint" in problem for problem in told)
    assert is_whole(stored)


@pytest.mark.parametrize(
    "text",
    [b"", b"{", b"[" * 100_000, b'{"schema_version": 2', b"\xff\xfe", b"null", b'{"schema_version": NaN}', b"9" * 5000],
    ids=lambda text: repr(text[:12]),
)
def test_a_run_json_that_is_none(copy: Path, text: bytes) -> None:
    (copy / "run.json").write_bytes(text)
    stored = read_run(copy)
    assert is_whole(stored)
    assert [flight.outcome for flight in stored.flights] == ["PASS", "FAIL"]
    assert stored.problems[0].startswith("run.json ")
    assert "killed" not in stored.problems[0]
    assert summary(copy).problem


def test_texts_that_no_output_takes_are_damage_too(copy: Path) -> None:
    text = (copy / "run.json").read_text()
    (copy / "run.json").write_text(text.replace("2.2 ANT-X", "\\ud800", 1))
    stored = read_run(copy)
    assert is_whole(stored)
    json.dumps(stored.data, ensure_ascii=False).encode()


# -- no run at all -----------------------------------------------------------------------------------------------------


def test_what_is_no_run_is_refused_with_a_remedy(run: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").write_bytes(b"x")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "run.json").write_text('{"laps": 3}')
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name, complaint in (
        ("empty", "is no run"),
        ("photos", "is no run"),
        ("photos/a.png", "is no run"),
        ("other", "no run of froude"),
        ("nowhere", "there is no such file or folder"),
        ("loop", "no such file|cannot be read"),
        ("x" * 5000, "no such file|cannot be read"),
    ):
        with pytest.raises(FileError, match=complaint) as error:
            read_run(tmp_path / name)
        assert "Give the folder of a run" in str(error.value), name
    with pytest.raises(FileError, match=r"It holds 1 of them: froude review --out .* --list"):
        read_run(run.parent)


def test_a_run_json_that_is_a_folder_or_a_pipe(copy: Path) -> None:
    (copy / "run.json").unlink()
    (copy / "run.json").mkdir()
    assert "run.json is no file" in read_run(copy).problems[0]
    (copy / "run.json").rmdir()
    os.mkfifo(copy / "run.json")
    assert "run.json is no file" in read_run(copy).problems[0]


def test_a_link_to_a_run_is_read(run: Path, tmp_path: Path) -> None:
    (tmp_path / "latest").symlink_to(run)
    stored = read_run(tmp_path / "latest")
    assert (stored.problems, len(stored.flights)) == ((), 2)


# -- many --------------------------------------------------------------------------------------------------------------


def test_runs_are_listed_newest_first(run: Path, tmp_path: Path) -> None:
    for stamp in ("20261122T200000Z_a_X", "20261122T200000Z_a_X_2", "20261122T200000Z_a_X_10", "20261123T000000Z_a_X"):
        (tmp_path / stamp).mkdir()
    shutil.copytree(run, tmp_path / "my best run")
    os.utime(tmp_path / "my best run" / "run.json", (1_795_392_000, 1_795_392_000))  # 23 November 2026, 00:00 UTC
    (tmp_path / "latest").symlink_to(tmp_path / "my best run")
    (tmp_path / "gone").symlink_to(tmp_path / "nowhere")
    (tmp_path / ".hidden_Z_a").mkdir()
    (tmp_path / "notes").mkdir()
    (tmp_path / "README.md").write_text("x")
    names = [folder.name for folder in run_folders(tmp_path)]
    assert names == [
        "my best run",
        "20261123T000000Z_a_X",
        "20261122T200000Z_a_X_10",
        "20261122T200000Z_a_X_2",
        "20261122T200000Z_a_X",
    ]
    assert newest(tmp_path) == tmp_path / "my best run"
    (first, *others) = list_runs(tmp_path)
    assert (first.verdicts, first.best, first.complete) == ({"PASS": 1, "FAIL": 1}, "2.2 ANT-X", True)
    assert (first.scenario, first.vehicle, first.autopilot) == ("roll_step", "ant-x", "own")
    assert all(one.problem == "run.json is missing" for one in others)
    assert [one.folder.name for one in list_runs(tmp_path, part="x_1")] == ["20261122T200000Z_a_X_10"]


def test_of_ten_thousand_runs_only_those_shown_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(10_000):
        (tmp_path / f"20261122T{number:06d}Z_demo_ANT-X").mkdir()
    read: list[Path] = []
    monkeypatch.setattr(run_list, "summary", lambda folder: read.append(folder) or run_list.RunSummary(folder))
    assert newest(tmp_path) == tmp_path / "20261122T009999Z_demo_ANT-X"
    assert read == []
    list_runs(tmp_path, last=3)
    assert [folder.name[9:15] for folder in read] == ["009999", "009998", "009997"]


def test_there_may_be_no_runs(tmp_path: Path) -> None:
    assert newest(tmp_path) is newest(tmp_path / "nowhere") is None
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileError, match="--out"):
        run_folders(tmp_path / "file")


@pytest.mark.parametrize(
    ("command", "who"),
    [
        ("froude fly demo", "own"),
        ("froude fly --connect memory://", "own"),
        ("froude fly --px4 build", "PX4"),
        ("froude fly --hil tcpin://:4560 --connect udpin://:14540", "PX4"),
        ("froude fly --hil=serial:///dev/ttyACM0 --arm-hardware", "board"),
        ("froude fly --connect udpin://:14540", "other"),
        ("froude review a/flight.ulg --vehicle ant-x", "recorded"),
    ],
)
def test_who_flew_is_told_by_the_command(command: str, who: str) -> None:
    assert run_list.autopilot(command.split()) == who


def test_a_log_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "x.tlog").write_bytes(bytes(100))
    assert log_span_s(tmp_path / "x.tlog") is log_span_s(tmp_path / "none.tlog") is None
