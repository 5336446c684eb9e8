"""`froude review`: what it opens, serves, prints, compares and refuses."""

from __future__ import annotations

import http.client
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import threading
import types
import urllib.parse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from scenarios import cli
from scenarios.limits import METRICS
from scenarios.recorder import cursor, viewer
from scenarios.recorder.recorded_facts import recorded_facts
from scenarios.recorder.recording_end import whole_bytes, whole_recording
from scenarios.recorder.web_viewer import PAGE, WebViewer
from scenarios.run_comparison import SENSES, compare
from scenarios.run_reader import read_run
from scenarios.runner import RunOptions, run_scenario
from sitl.errors import FileError, UsageError

ROOT = Path(__file__).parents[2]
PATIENCE_S = 150.0
OLD, NEW = "20261122T200000Z_roll_step_ANT-X", "20261123T080000Z_roll_step_ANT-X"


@pytest.fixture(scope="module")
def runs(quick_scenario: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the same run twice, of one gain set that passes and one too slow to have a rise time."""
    out = tmp_path_factory.mktemp("runs")
    gains = out / "gains.toml"
    gains.write_text(
        '[[gain_set]]\nname = "slow"\n[gain_set.parameters]\nMC_ROLL_P = 3.0\nMC_ROLLRATE_P = 0.05\n'
        "MC_ROLLRATE_I = 0.05\nMC_ROLLRATE_D = 0.001\n"
    )
    scenario = quick_scenario(gain_sets=("table_2_2/ANT-X", str(gains)))
    folder = run_scenario(scenario, RunOptions(out=out / "flown", report=False)).folder
    assert folder is not None
    for name in (OLD, NEW):
        shutil.copytree(folder, out / "logs" / name)
    return out / "logs"


@pytest.fixture
def review(runs: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, list[str]]]:
    """Runs the command; exit status, standard output, lines of standard error."""

    def run(*words: object, out: Path = runs) -> tuple[int, str, list[str]]:
        status = cli.main(["review", *map(str, words), "--out", str(out)])
        told = capsys.readouterr()
        assert "Traceback" not in told.err
        return status, told.out, told.err.splitlines()

    return run


@pytest.fixture
def changed(runs: Path, tmp_path: Path) -> Callable[..., Path]:
    """Makes copies of the run in which things are different."""

    def make(name: str = NEW, **metrics: Any) -> Path:
        folder = tmp_path / "runs" / name
        shutil.copytree(runs / OLD, folder, ignore=shutil.ignore_patterns("flights", "*.rrd"), dirs_exist_ok=True)
        data = json.loads((folder / "run.json").read_text())
        for metric in data["flights"][0]["metrics"]:
            if metric["name"] in metrics and not metric["segment"]:
                metric |= metrics[metric["name"]]
        (folder / "run.json").write_text(json.dumps(data))
        return folder

    return make


def edit(folder: Path, change: Callable[[Any], object]) -> None:
    """Change a run.json."""
    data = json.loads((folder / "run.json").read_text())
    change(data)
    (folder / "run.json").write_text(json.dumps(data))


def fake(tmp_path: Path, script: str) -> str:
    """An executable in the viewer's place; what it is called with goes to a file beside it."""
    path = tmp_path / "viewer"
    path.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > "{tmp_path}/words"\n{script}\n')
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")


# -- the viewer --------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("display")
class TestViewer:
    @pytest.fixture(autouse=True)
    def _install(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.words = tmp_path / "words"
        monkeypatch.setattr(viewer, "viewer_path", lambda: fake(tmp_path, "exit 0"))
        # somebody's own viewer may be there
        self.told: list[Path] = []
        monkeypatch.setattr(cursor, "put_when_loaded", self.told.append)

    def opened(self) -> list[str]:
        return self.words.read_text().splitlines()

    def test_the_newest_run_is_opened_and_nothing_listens_beyond_the_loopback(self, review: Any, runs: Path) -> None:
        status, out, err = review()
        compare_rrd = runs / NEW / "compare.rrd"
        assert (status, out, err) == (0, f"Opened {compare_rrd}\n", [])
        assert self.opened() == ["--bind", "127.0.0.1", str(compare_rrd)]
        assert self.told == [compare_rrd]

    @pytest.mark.parametrize(
        ("words", "recording"),
        [
            ([OLD], f"{OLD}/compare.rrd"),
            (["20261122T20"], f"{OLD}/compare.rrd"),
            (["1122", "--flight", "slow"], f"{OLD}/flights/slow.rrd"),
            ([f"LOGS/{OLD}/run.json"], f"{OLD}/compare.rrd"),
            ([f"LOGS/{OLD}/flights/2_2_ant-x.rrd"], f"{OLD}/flights/2_2_ant-x.rrd"),
            ([f"LOGS/{OLD}/flights/slow.parquet"], f"{OLD}/flights/slow.rrd"),
        ],
    )
    def test_a_run_is_named_by_folder_name_part_or_file(
        self, review: Any, runs: Path, words: list[str], recording: str
    ) -> None:
        status, _, err = review(*(word.replace("LOGS", str(runs)) for word in words))
        assert (status, err) == (0, [])
        assert self.opened()[-1] == str(runs / recording)

    def test_a_viewer_that_lives_on_is_left_alone(
        self, review: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(viewer, "_MOMENT_S", 0.3)
        path = fake(tmp_path, f'echo $$ > "{tmp_path}/pid"\nexec sleep 60')
        monkeypatch.setattr(viewer, "viewer_path", lambda: path)
        assert review()[0] == 0
        pid = int((tmp_path / "pid").read_text())
        assert os.getsid(pid) == pid  # of a session of its own: Ctrl-C here does not reach it
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)

    def test_a_viewer_that_cannot_start_says_why(
        self, review: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = fake(tmp_path, "echo noise >&2; echo 'No graphics adapter was found' >&2; exit 101")
        monkeypatch.setattr(viewer, "viewer_path", lambda: path)
        status, _, (line,) = review()
        assert status == 2
        assert "the viewer ended at once: No graphics adapter was found. --web shows the same" in line

    def test_a_viewer_that_is_no_program(self, review: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "viewer").write_text("?")
        monkeypatch.setattr(viewer, "viewer_path", lambda: str(tmp_path / "viewer"))
        status, _, (line,) = review()
        assert (status, "the viewer does not start: Permission denied" in line) == (2, True)


def test_no_viewer_installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match=r"not installed beside this Python.*pip install rerun-sdk"):
        viewer.viewer_path()


def test_no_display(review: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    status, _, (line,) = review()
    assert status == 2
    assert all(word in line for word in ("no display", "--web", "--screenshot FILE", "--html"))


# -- a picture, a page -------------------------------------------------------------------------------------------------


def test_a_page_is_drawn(review: Any, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []

    def draw(rrd: Path, png: Path, tab: str | None = None) -> list[str]:
        drawn.append((rrd, png, tab))
        return ["a view: it is empty"]

    monkeypatch.setattr("scenarios.recorder.screenshot.screenshot", draw)
    status, out, err = review("--screenshot", tmp_path / "a.png", "--page", "step")
    assert drawn == [(runs / NEW / "compare.rrd", tmp_path / "a.png", "step")]
    assert (status, out, err) == (0, f"{tmp_path}/a.png\n", ["froude: the viewer says: a view: it is empty"])


def test_the_report_is_written_only_if_it_is_missing(
    review: Any, runs: Path, changed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Path] = []
    report = types.ModuleType("scenarios.report")

    def write_report(folder: Path) -> Path:
        written.append(folder)
        (folder / "report.html").write_text("<!doctype html>")
        return folder / "report.html"

    report.write_report = write_report  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "scenarios.report", report)
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    folder = changed()
    (folder / "report.html").unlink(missing_ok=True)
    for _ in range(2):
        assert review(folder, "--html")[:2] == (0, f"{folder}/report.html\n")
    assert written == [folder]
    assert opened == []  # nobody looks at a terminal
    assert review(folder, "--html", "--open")[0] == 0
    assert opened == [(folder / "report.html").as_uri()]
    monkeypatch.setattr("webbrowser.open", lambda _: False)
    status, _, err = review(folder, "--html", "--open")
    assert (status, "no browser is found" in err[-1]) == (2, True)


def test_recorded_flights_are_imported(review: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def imported(args: Any, *, tell: Any) -> int:
        asked.append(args.runs)
        return 0

    monkeypatch.setattr("scenarios.flight_import.import_command", imported)
    assert review(tmp_path / "a.ulg")[0] == 0
    assert review(OLD, tmp_path / "b.TLOG", "--json")[0] == 0
    assert asked == [[str(tmp_path / "a.ulg")], [OLD, str(tmp_path / "b.TLOG")]]


# -- a browser ---------------------------------------------------------------------------------------------------------


def listening(pid: int) -> set[tuple[str, int]]:
    """Addresses that a process listens on."""
    inodes = set()
    for fd in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = str(fd.readlink())
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and words[9] in inodes:
                host, _, port = words[1].rpartition(":")
                address = ".".join(str(part) for part in reversed(bytes.fromhex(host))) if table == "tcp" else host
                found.add((address, int(port, 16)))
    return found


def processes(group: int) -> list[int]:
    """Processes of a group."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            if os.getpgid(int(place.name)) == group:
                found.append(int(place.name))
        except ProcessLookupError:
            continue
    return found


def line_of(process: subprocess.Popen[str]) -> str:
    """The next line of its output; nothing if none comes."""
    assert process.stdout is not None
    return process.stdout.readline() if select.select([process.stdout], [], [], PATIENCE_S)[0] else ""


def ask(
    port: int, path: str, method: str = "GET", host: str | None = None
) -> tuple[int, bytes, http.client.HTTPMessage]:
    """Status, body and headers of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    try:
        connection.request(method, path, headers={} if host is None else {"Host": host})
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.headers
    finally:
        connection.close()


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="sockets are looked up in /proc")
def test_web_serves_the_page_and_the_recording_on_the_loopback_and_nothing_else(runs: Path) -> None:
    command = [sys.executable, "-m", "scenarios.cli", "review", NEW, "--web", "--port", "0", "--out", str(runs)]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        url = urllib.parse.urlsplit(line_of(process).strip())
        assert url.hostname == "127.0.0.1", process.communicate(timeout=PATIENCE_S)
        assert url.port is not None
        # the installed viewer, from which the page came, has ended
        assert processes(process.pid) == [process.pid]
        assert listening(process.pid) == {("127.0.0.1", url.port)}
        status, page, headers = ask(url.port, f"{url.path}?{url.query}")
        assert status == 200
        assert b"re_viewer.js" in page
        assert b"googleapis" not in page
        assert "connect-src 'self'" in headers["Content-Security-Policy"]
        assert ask(url.port, "/re_viewer_bg.wasm")[1].startswith(b"\0asm")
        (recording,) = urllib.parse.parse_qs(url.query)["url"]
        assert recording.startswith(f"http://127.0.0.1:{url.port}/")
        assert ask(url.port, urllib.parse.urlsplit(recording).path)[1] == (runs / NEW / "compare.rrd").read_bytes()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, out) == (0, "")
        assert err == "froude: open this address in a browser of this machine; Ctrl-C stops it\n"
    finally:
        process.kill()
        process.communicate()


class TestWebServer:
    @pytest.fixture
    def served(self, runs: Path) -> Iterator[WebViewer]:
        with WebViewer([runs / NEW / "compare.rrd", runs / OLD / "flights" / "slow.rrd"], 0) as web:
            web.page = {path: path.encode() for path in PAGE}
            thread = threading.Thread(target=web.serve)
            thread.start()
            yield web
            web.stop()
            thread.join(PATIENCE_S)

    def test_what_is_there(self, served: WebViewer, runs: Path) -> None:
        for path, kind in PAGE.items():
            status, body, headers = ask(served.port, path)
            assert (status, body, headers["Content-Type"]) == (200, path.encode(), kind)
        names = urllib.parse.parse_qs(urllib.parse.urlsplit(served.url).query)["url"]
        slow = (runs / OLD / "flights" / "slow.rrd").read_bytes()
        assert ask(served.port, urllib.parse.urlsplit(names[1]).path)[1] == slow
        status, body, headers = ask(served.port, urllib.parse.urlsplit(names[1]).path, "HEAD")
        assert (status, body, headers["Content-Length"]) == (200, b"", str(len(slow)))

    @pytest.mark.parametrize(
        ("path", "method", "host", "status"),
        [
            ("/recordings/0/../../run.json", "GET", None, 404),
            ("/recordings/0/%2e%2e/run.json", "GET", None, 404),
            ("//etc/passwd", "GET", None, 404),
            ("/recordings/2/compare.rrd", "GET", None, 404),
            ("/", "POST", None, 501),
            ("/", "GET", "evil.example", 403),
            ("/", "GET", "evil.example:9090", 403),
        ],
    )
    def test_what_is_not(self, served: WebViewer, path: str, method: str, host: str | None, status: int) -> None:
        assert ask(served.port, path, method, host)[0] == status

    def test_a_recording_that_went_away(self, tmp_path: Path) -> None:
        (tmp_path / "a.rrd").write_bytes(b"x")
        with WebViewer([tmp_path / "a.rrd"], 0) as web:
            (tmp_path / "a.rrd").unlink()
            thread = threading.Thread(target=web.serve)
            thread.start()
            assert ask(web.port, "/recordings/0/a.rrd")[0] == 404
            web.stop()
            thread.join(PATIENCE_S)

    def test_a_port_in_use(self, served: WebViewer, review: Any) -> None:
        status, _, (line,) = review("--web", "--port", served.port)
        assert status == 2
        assert f"port {served.port} of 127.0.0.1 cannot be used: Address already in use. Give another one" in line


# -- the list ----------------------------------------------------------------------------------------------------------


def test_the_list(review: Any, runs: Path) -> None:
    status, out, err = review("--list")
    head, *lines = out.splitlines()
    assert (status, err) == (0, [])
    assert head.split("  ")[0] == "started (UTC)"
    assert [line.split()[-1] for line in lines] == [NEW, OLD]
    for word in ("roll_step", "ant-x", "own", "1 PASS 1 UNSET", "2.2 ANT-X", "complete"):
        assert word in lines[0]
    assert review("--list", "--last", 1)[1].splitlines()[-1] == "1 older ones are not shown: --last 2 shows all."
    assert review("--list", "1122")[1].splitlines()[-1].endswith(OLD)
    data = json.loads(review("--list", "--json")[1])
    assert [one["run"] for one in data["runs"]] == [NEW, OLD]
    assert data["runs"][0]["verdicts"] == {"PASS": 1, "UNSET": 1}
    assert data["runs"][0] == data["runs"][1] | {"run": NEW, "folder": str(runs / NEW)}


def test_a_name_that_a_terminal_would_obey_is_shown_harmless(review: Any, changed: Any) -> None:
    folder = changed()
    edit(folder, lambda data: data["scenario"].update(name="red \x1b[31m alert"))
    assert "red ?[31m alert" in review("--list", out=folder.parent)[1]


def test_no_runs_at_all(review: Any, tmp_path: Path) -> None:
    for words in ((), ("--list",), ("--web",), ("x",)):
        status, out, (line,) = review(*words, out=tmp_path / "none")
        assert (status, out) == (2, "")
        assert "`froude fly` makes one" in line
    assert json.loads(review("--list", "--json", out=tmp_path / "none")[1])["runs"] == []


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["2026"], f"'2026' is in the names of 2 runs: {NEW}, {OLD}. Give a longer part"),
        (["carrier"], "no run in"),
        (["--port", "3"], "--port: goes with --web"),
        (["--web", "--port", "70000"], "give 0 to 65535"),
        (["--page", "x"], "--page: goes with --screenshot FILE"),
        (["--open"], "--open: goes with --html"),
        (["--last", "3"], "--last: goes with --list"),
        (["--list", "--last", "0"], "--last 0: give 1 or more"),
        (["--gate"], "--gate: compares: give two runs or more"),
        (["--json"], "--json: goes with --list, or two runs or more"),
        (["--html", "--flight", "slow"], "--flight: shows a recording"),
        ([OLD, NEW, "--web"], "2 runs are compared as a table"),
        (["--flight", "fast"], "no flight 'fast'"),
    ],
)
def test_what_does_not_fit_is_refused(review: Any, words: list[str], complaint: str) -> None:
    status, out, err = review(*words)
    assert (status, out) == (2, "")
    assert complaint in err[-1]


# -- comparison --------------------------------------------------------------------------------------------------------


def test_every_metric_has_a_sense_and_a_tolerance() -> None:
    assert list(SENSES) == list(METRICS)
    assert all(tolerance > 0 for _, tolerance in SENSES.values())


def test_the_same_run_twice_is_no_regression(review: Any) -> None:
    status, out, err = review(OLD, NEW, "--gate")
    assert (status, err) == (0, [])
    assert out.splitlines()[-1] == "2 gain sets compared, no regression"
    assert out.count("the same telemetry, bit for bit") == 2
    assert "REGRESSION" not in out


def test_known_differences(review: Any, runs: Path, changed: Any) -> None:
    change = compare(read_run(runs / OLD), read_run(runs / OLD))
    was = {metric.name: metric for metric in change.flights[0].metrics}
    assert {metric.change for metric in was.values()} <= {"same", "none"}
    delay, rise = was["delay_margin_s"].old, was["rise_time_s"].old
    droop = was["droop_deg"].old
    assert delay is not None
    assert rise is not None
    assert droop is not None
    new = changed(
        overshoot_pct={"value": 11.0, "outcome": "FAIL"},  # beyond its limit of 10
        rise_time_s={"value": rise + 0.05},  # limited, and worse by more than 0.02
        delay_margin_s={"value": delay * 1.2},  # better
        droop_deg={"value": droop + 0.1},  # within 0.2
        peak_delta_lat={"value": 0.9},  # worse, but nobody limits it
        oscillation_hz={"value": 3.0},  # has no better
        gain_margin_high_db={"value": None, "reason": "infinite"},
    )
    change = compare(read_run(runs / OLD), read_run(new))
    found = {metric.name: metric for metric in change.flights[0].metrics}
    assert {name: found[name].change for name in ("rise_time_s", "delay_margin_s", "droop_deg", "peak_delta_lat")} == {
        "rise_time_s": "worse",
        "delay_margin_s": "better",
        "droop_deg": "same",
        "peak_delta_lat": "worse",
    }
    assert [name for name, metric in found.items() if metric.regression] == ["overshoot_pct", "rise_time_s"]
    assert found["rise_time_s"].difference == pytest.approx(0.05)
    assert found["gain_margin_high_db"].change == "better"
    assert found["gain_margin_high_db"].difference is None
    assert found["oscillation_hz"].change == "found"
    assert [flight.name for flight in change.regressions] == ["2.2 ANT-X"]
    assert change.circumstances == ()
    status, out, _ = review(OLD, new, "--gate")
    assert status == 1
    assert out.splitlines()[-1] == "2 gain sets compared, 1 with a regression: 2.2 ANT-X"
    assert out.count("REGRESSION") == 2
    assert ">= 10 ms" in out  # the limit in the unit of the values beside it
    assert review(OLD, new)[0] == 0  # only with --gate
    data = json.loads(review(OLD, new, "--json")[1])
    (comparison,) = data["comparisons"]
    assert (data["regressions"], comparison["regressions"]) == (1, ["2.2 ANT-X"])
    rows = {metric["name"]: metric for metric in comparison["gain_sets"][0]["metrics"]}
    assert rows["gain_margin_high_db"]["new"] is None
    assert rows["rise_time_s"]["regression"]


@pytest.mark.parametrize(
    ("old", "new", "verdict", "regression"),
    [
        ("PASS", "FAIL", "worse", True),
        ("PASS", "UNSET", "worse", True),
        ("UNSET", "FAIL", "worse", True),
        ("INFO", "FAIL", "worse", True),
        ("FAIL", "PASS", "better", False),
        ("FAIL", "UNSET", "other", False),
        ("PASS", "INFO", "same", False),
        ("FAIL", "FAIL", "same", False),
    ],
)
def test_verdicts(changed: Any, old: str, new: str, verdict: str, regression: bool) -> None:
    folders = [changed("old"), changed("new")]
    for folder, outcome in zip(folders, (old, new), strict=True):
        edit(folder, lambda data, outcome=outcome: data["flights"][0].update(outcome=outcome))
    flight = compare(*map(read_run, folders)).flights[0]
    assert (flight.verdict, flight.regression) == (verdict, regression)


def test_a_limited_metric_that_is_not_measured_any_more_is_a_regression(runs: Path, changed: Any) -> None:
    new = changed(rise_time_s={"value": None, "outcome": "UNSET"}, droop_deg={"value": None})
    found = {m.name: m for m in compare(read_run(runs / OLD), read_run(new)).flights[0].metrics}
    assert (found["rise_time_s"].change, found["rise_time_s"].regression) == ("lost", True)
    assert (found["droop_deg"].change, found["droop_deg"].regression) == ("lost", False)


def test_gain_sets_are_paired_by_name_or_parameters_and_what_differs_is_told(
    review: Any, runs: Path, changed: Any
) -> None:
    new = changed()

    def change(data: Any) -> None:
        data["flights"][0]["gain_set"]["name"] = "renamed"
        data["flights"][0]["files"] = {}
        data["flights"][1]["gain_set"]["parameters"]["MC_ROLL_P"] = 4.0
        data["vehicle"]["assumptions"]["motor_lag_s"] = 0.03
        data["seed"] = 5

    edit(new, change)
    found = compare(read_run(runs / OLD), read_run(new))
    assert [(f.old.name, f.new.name) for f in found.flights if f.old and f.new] == [
        ("2.2 ANT-X", "renamed"),
        ("slow", "slow"),
    ]
    assert found.flights[1].parameters == {"MC_ROLL_P": (3.0, 4.0)}
    assert found.circumstances == ("assumptions: motor_lag_s 0.025 → 0.03", "seed: 0 → 5")
    out = review(OLD, new)[1]
    assert "renamed (was called 2.2 ANT-X): PASS" in out
    assert "  MC_ROLL_P 3 → 4" in out
    assert "  differs besides: assumptions: motor_lag_s 0.025 → 0.03" in out


def test_a_gain_set_that_is_not_flown_any_more_is_a_regression(review: Any, changed: Any) -> None:
    new = changed()
    edit(new, lambda data: data["flights"].pop())
    status, out, _ = review(OLD, new, "--gate")
    assert status == 1
    assert "slow: was UNSET, not flown in the new run   REGRESSION" in out
    assert "slow: UNSET, not flown in the old run" in review(new, OLD, "--gate")[1]
    edit(new, lambda data: data["flights"].clear())
    status, _, err = review(OLD, new, "--gate")
    assert status == 2
    assert "have no gain set in common: 2.2 ANT-X, slow; none" in err[-1]


def test_several_runs_are_each_compared_with_the_first(review: Any, changed: Any) -> None:
    bad = changed(overshoot_pct={"value": 30.0, "outcome": "FAIL"})
    status, out, _ = review(OLD, NEW, bad, "--gate")
    assert status == 1
    heads = [Path(line[5:]).name for line in out.splitlines() if line.startswith(("old  ", "new  "))]
    assert heads == [OLD, NEW, OLD, bad.name]
    assert "compared, no regression" in out


# -- killed in flight --------------------------------------------------------------------------------------------------


def test_a_run_that_was_killed_in_flight(
    review: Any, tmp_path: Path, display: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """kill -9, no time to tidy up: the run is listed, opened, and compared with as far as it came."""
    out = tmp_path / "runs"
    command = [sys.executable, "-m", "scenarios.cli", "fly", "demo", "--out", str(out)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        partial: list[Path] = []
        pause = threading.Event()
        for _ in range(round(PATIENCE_S / 0.02)):
            grown = [path for path in out.glob("*/flights/*.partial.tlog") if path.stat().st_size > 400_000]
            if grown:
                process.send_signal(signal.SIGSTOP)
                partial = [path for path in grown if path.exists()]  # finished meanwhile? then the next one
                if partial:
                    break
                process.send_signal(signal.SIGCONT)
            pause.wait(0.02)
        assert partial, "never saw a flight"
    finally:
        process.kill()
        process.communicate()
    slug = partial[0].name.removesuffix(".partial.tlog")
    stored = read_run(partial[0])
    flight = stored.flight(slug)
    assert not stored.known
    assert (flight.outcome, flight.finished) == ("UNSET", False)
    assert {"MC_ROLL_P", "MC_ROLLRATE_D"} <= set(flight.data["uploaded"])
    span = flight.log_span_s()
    assert span is not None
    assert span[1] > 5.0
    assert review("--list", out=out)[1].splitlines()[-1].split("  ")[-2].strip() == "run.json is missing"
    monkeypatch.setattr(viewer, "viewer_path", lambda: fake(tmp_path, "exit 0"))
    status, told, err = review(out=out)
    assert status == 0
    assert told == f"Opened {stored.folder}/flights/{slug}.partial.rrd\n"
    assert "run.json is missing: the run was killed, or is still being flown" in err[0]
    assert any(f"flight {flight.name} was not finished" in line for line in err)
    assert review(stored.folder, stored.folder, "--gate", out=out)[0] == 0


class TestCutRecordings:
    """Cut off anywhere, a recording opens up to its last whole message."""

    @pytest.fixture
    def recording(self, runs: Path) -> bytes:
        return (runs / OLD / "flights" / "2_2_ant-x.rrd").read_bytes()

    @pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
    def test_what_is_whole_is_read(self, recording: bytes, tmp_path: Path, share: float) -> None:
        path = tmp_path / "x.partial.rrd"
        path.write_bytes(recording[: round(share * len(recording))])
        assert recorded_facts(path).name == "2.2 ANT-X"
        with whole_recording(path) as copy:
            assert copy.stat().st_size == whole_bytes(path) < path.stat().st_size
            assert recording.startswith(copy.read_bytes())
        assert not copy.exists()
        with whole_recording(path, keep=True) as copy:
            pass
        assert copy.exists()
        shutil.rmtree(copy.parent)

    def test_what_is_whole_is_not_copied(self, recording: bytes, tmp_path: Path) -> None:
        path = tmp_path / "x.rrd"
        for data in (recording, b"", b"something else"):
            path.write_bytes(data)
            with whole_recording(path) as same:
                assert same == path
        with pytest.raises(FileError, match="cannot be read"), whole_recording(tmp_path / "none.rrd"):
            pass

    @pytest.mark.parametrize("damage", [b"", b"?" * 400, b"RRF2" + bytes(500), b"RRF2" + b"\xff" * 500])
    def test_what_is_no_recording_is_a_clear_line(
        self, tmp_path: Path, damage: bytes, capfd: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "x.rrd").write_bytes(damage)
        with pytest.raises(FileError, match="cannot be read as a Rerun recording") as error:
            recorded_facts(tmp_path / "x.rrd")
        assert "\n" not in str(error.value)
        assert capfd.readouterr().err == ""  # the reader's own words about it
