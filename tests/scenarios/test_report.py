"""The report: what stands on the page is what is in run.json, drawn where it says, for whoever reads it however."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import signal
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scenarios.gain_set import save_params
from scenarios.job_summary import job_summary, write_job_summary
from scenarios.limits import Outcome
from scenarios.report import canvas, helper, write_report
from scenarios.report.computed import compute, key_of, loop_curves
from scenarios.report.drafting import ReportDraft
from scenarios.report.flown_model import flown_model
from scenarios.report.verdict import verdict_of
from scenarios.report.windows import step_trace
from scenarios.run_files import write_run
from scenarios.run_folder import RunFolder
from scenarios.run_reader import read_run
from scenarios.run_shape import RUN, nothing
from scenarios.runner import RunOptions, run_scenario
from sitl.errors import FileError
from sitl.parameters import ParameterTable

sys.path.insert(0, str(Path(__file__).parents[1]))

from chromium import BROWSER, MISSING, Chromium

SETS = ("table_2_2/ANT-X", "table_7_2/ANT-X", "px4_defaults")
HOSTILE = '<script>alert(1)</script> $x_1$ & "7.23456" \' `*_|'
SHOWN = {"overshoot": "overshoot_pct", "rise time": "rise_time_s", "delay margin": "delay_margin_s", "VAF": "vaf_pct"}


class Page(HTMLParser):
    """Tables by caption as (headings, {row: cells}), texts, attributes of every element."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tables: dict[str, tuple[list[str], dict[str, list[str]]]] = {}
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._in: list[str] = []
        self._cells: list[str] = []
        self._rows: list[list[str]] = []
        self._caption = ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._in.append("sr" if dict(attrs).get("class") == "sr" or dict(attrs).get("aria-hidden") else tag)
        if tag in ("th", "td"):
            self._cells.append("")
        if tag == "tr":
            self._cells = []
        if tag == "table":
            self._rows, self._caption = [], ""
        if tag in ("meta", "path", "use", "rect"):
            self._in.pop()

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if self._in:
            self._in.pop()
        if tag == "tr":
            self._rows.append(self._cells)
        if tag == "table":
            head, *body = self._rows
            self.tables[self._caption] = head[1:], {row[0]: row[1:] for row in body}

    def handle_data(self, data):
        if "sr" in self._in or "style" in self._in:
            return
        self.text += data
        if self._in and self._in[-1] == "caption":
            self._caption += data
        elif self._cells and {"th", "td"} & set(self._in):
            self._cells[-1] += data

    def table(self, beginning: str) -> tuple[list[str], dict[str, list[str]]]:
        return next(table for caption, table in self.tables.items() if caption.startswith(beginning))


@pytest.fixture(scope="module")
def folder(quick_scenario, tmp_path_factory) -> Path:
    said: list[str] = []
    out = tmp_path_factory.mktemp("runs")
    track = dataclasses.replace(
        quick_scenario(gain_sets=SETS), manoeuvres=(*quick_scenario().manoeuvres, _short_track())
    )
    result = run_scenario(track, RunOptions(out=out, command=("froude", "fly", "a b"), say=said.append))
    assert not said
    assert result.folder is not None
    return result.folder


def _short_track():
    from scenarios.manoeuvres import make_manoeuvre

    return make_manoeuvre("chirp", "sweep", amplitude_deg=5.0, duration_s=4.0, f0_hz=0.3, f1_hz=1.0)


@pytest.fixture(scope="module")
def page(folder) -> Page:
    return Page(folder / "report.html")


@pytest.fixture(scope="module")
def data(folder):
    return json.loads((folder / "run.json").read_text())


def metric(flight, name, segment=""):
    """None for one that the flight did not come to."""
    found = [m for m in flight["metrics"] if m["name"] == name and m["segment"] == segment]
    return found[0] if found else {"value": None, "reason": ""}


def written(run, folder: Path) -> Path:
    """A run of records as the runner would leave it, without recordings."""
    kept = RunFolder.create(folder, "20261122T200000Z", "demo", "ANT-X")
    for flight in run.flights:
        if len(flight.telemetry):
            flight.telemetry.to_parquet(kept.flight_file(flight.gain_set.slug, ".parquet"))
        save_params(kept.flight_file(flight.gain_set.slug, ".backup.params"), {"MC_ROLL_P": 6.5}, ParameterTable())
    kept.write_run_json(run, ("froude", "fly"))
    return kept.path


class TestPage:
    def test_the_same_bytes_from_the_helper_and_from_here(self, folder):
        before = (folder / "report.html").read_bytes()
        assert write_report(folder) == folder / "report.html"
        assert (folder / "report.html").read_bytes() == before

    def test_verdict_comes_first(self, page, data):
        first = next(attrs for tag, attrs in page.elements if tag == "section")
        assert first["id"] == "verdict"
        assert "Trust 1 of 3 gain sets on ANT-X: 2.2 ANT-X." in page.text
        for flight in data["flights"]:
            assert flight["gain_set"]["name"] in page.text

    def test_numbers_are_those_of_run_json(self, page, data):
        heads, rows = page.table("Measured on the flight")
        for flight in data["flights"]:
            cells = dict(zip(heads, rows[flight["gain_set"]["name"]], strict=True))
            assert cells["verdict"] == flight["outcome"]
            for title, name in SHOWN.items():
                cell = next((text for head, text in cells.items() if head.startswith(f"{title} [")), None)
                value = metric(flight, name)["value"]
                if value is None:
                    assert cell == "–"
                else:
                    digits = len(cell.partition(".")[2])
                    factor = 1000.0 if name == "delay_margin_s" else 1.0
                    assert float(cell) == pytest.approx(value * factor, abs=0.5001 * 10**-digits)

    def test_margins_are_those_of_run_json(self, page, data):
        _, rows = page.table("Margins, as in run.json")
        for flight in data["flights"]:
            cells = rows[flight["gain_set"]["name"]]
            margins = flight["margins"]
            assert float(cells[2]) == pytest.approx(margins["phase_margin_deg"], abs=0.051)
            assert float(cells[3]) == pytest.approx(1e3 * margins["delay_margin_s"], abs=0.051)
            assert cells[-1] == ("yes" if margins["closed_loop_stable"] else "NO")

    def test_why_something_is_missing_is_said(self, page, data):
        cycling = next(flight for flight in data["flights"] if flight["gain_set"]["name"] == "7.2 ANT-X")
        assert f"({cycling['gain_set']['name']}): {metric(cycling, 'rise_time_s')['reason']}" in page.text

    def test_what_it_takes_to_repeat_the_run(self, page, data):
        assert "froude fly 'a b'" in page.text
        assert page.table("Versions")[1]["froude"] == [data["versions"]["froude"]]
        assert page.table("Assumptions")[1]["motor_lag_s"] == ["0.025"]
        assert page.table("Profile sitl")[1]["rate_hz"] == ["250", "Hz"]
        assert page.table("Derivatives")[1]["Ld"][0] == "450.71"
        assert page.table("Flights:")[1]["2.2 ANT-X"][2] == data["flights"][0]["telemetry_sha256"][:16]

    def test_parameters_beside_the_backup(self, page):
        heads, rows = page.table("Parameters as flown")
        assert heads[0] == "vehicle had"
        assert rows["MC_ROLL_P"][:2] == ["4", "6.5 (× 1.62)"]

    def test_nothing_is_asked_of_anybody(self, page):
        for tag, attrs in page.elements:
            assert tag not in ("script", "link", "iframe", "img", "object", "embed"), tag
            for name in ("src", "href", "srcset", "data"):
                assert (attrs.get(name) or "#").startswith("#"), (tag, attrs)
        assert not re.search(r"url\((?!#)|@import|https?:(?!//www\.w3\.org/2000/svg)", page.source)

    def test_ids_are_unique_and_links_lead_somewhere(self, page):
        ids = [attrs["id"] for _, attrs in page.elements if attrs.get("id")]
        assert len(ids) == len(set(ids))
        for tag, attrs in page.elements:
            if attrs.get("href"):
                assert attrs["href"][1:] in ids, (tag, attrs)
            for name in re.findall(r"url\(#([^)]+)\)", " ".join(value or "" for value in attrs.values())):
                assert name in ids

    def test_for_who_does_not_see_it(self, page):
        pictures = [attrs for tag, attrs in page.elements if attrs.get("role") == "img"]
        assert len(pictures) >= 3 * len(SETS)
        assert all(len(attrs["aria-label"] or "") > 20 for attrs in pictures)
        assert all(attrs.get("scope") in ("row", "col") for tag, attrs in page.elements if tag == "th")
        assert all(page.tables)
        levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
        assert levels.count(1) == 1


class TestFigures:
    def test_marks_of_a_step_are_its_metrics(self, folder):
        run = read_run(folder)
        for flight in run.flights:
            telemetry = run.telemetry(flight)
            trace = step_trace(flight.data, telemetry, "step/1")
            stored = {name: flight.metric(name, "step/1")["value"] for name in trace.metrics}
            assert dict(trace.metrics) == stored
            if stored["rise_time_s"] is None:
                assert trace.rise is None
                continue
            first, last = trace.rise
            assert last - first == pytest.approx(stored["rise_time_s"], abs=1e-12)
            rolls = np.interp([first, last], trace.t_s, trace.roll_deg) / trace.amplitude_deg
            assert rolls == pytest.approx([0.1, 0.9], abs=1e-6)
            if trace.peak is not None:
                assert 100.0 * (trace.peak[1] / trace.amplitude_deg - 1.0) == pytest.approx(stored["overshoot_pct"])
            for name, band in (("settling_time_5pct_s", 0.05), ("settling_time_2pct_s", 0.02)):
                if stored[name] is not None:
                    after = trace.roll_deg[(trace.t_s > stored[name]) & (trace.t_s < trace.duration_s)]
                    assert np.abs(after / trace.amplitude_deg - 1.0).max() <= band + 1e-9

    def test_marks_of_the_loop_are_where_its_margins_are(self, data):
        flown = flown_model(data)
        for flight in data["flights"]:
            curves = loop_curves(flown, flown.roll_set(flight["uploaded"]))
            margins = flight["margins"]
            sizes = [m for m in (margins["gain_margin_low_db"], margins["gain_margin_high_db"]) if m is not None]
            assert [mark.size for mark in curves.gains] == sizes
            for mark in curves.gains:
                level = np.interp(math.log(mark.hz), np.log(curves.hz), 20 * np.log10(np.abs(curves.open_loop)))
                assert level == pytest.approx(mark.at, abs=0.1)
                assert mark.at == pytest.approx(-mark.size)
            assert curves.phase.size == margins["phase_margin_deg"]
            at = np.interp(math.log(curves.phase.hz), np.log(curves.hz), np.abs(curves.open_loop))
            assert at == pytest.approx(1.0, abs=0.01)

    def test_the_helper_computes_what_the_page_needs(self, data):
        uploads = [flight["uploaded"] for flight in data["flights"]]
        done = compute(data, uploads[:1], samples=20)
        again = compute(data, uploads, done, samples=20)
        assert again[key_of(data, uploads[0])] is done[key_of(data, uploads[0])]
        assert len(again) == len(uploads)
        good, cycling = (again[key_of(data, one)].samples for one in uploads[:2])
        assert (good.passes, good.of) == (20, 20)
        assert cycling.passes == 0
        assert cycling.unstable.all()


class TestTold:
    def test_hostile_names_are_only_names(self, flown_run, tmp_path):
        flights = list(flown_run.flights)
        flights[0] = dataclasses.replace(
            flights[0], gain_set=dataclasses.replace(flights[0].gain_set, name=HOSTILE), warnings=(HOSTILE,)
        )
        run = dataclasses.replace(
            flown_run, flights=tuple(flights), vehicle={**flown_run.vehicle, "name": HOSTILE, "title": HOSTILE}
        )
        page = Page(write_report(written(run, tmp_path)))
        assert "script" not in {tag for tag, _ in page.elements}
        assert page.text.count(HOSTILE) > 5
        assert '"7.23456"' in page.text

    def test_unset_and_broken_off(self, flown_run, tmp_path):
        page = Page(write_report(written(flown_run, tmp_path)))
        assert "Trust 1 of 3 gain sets on ANT-X: own gains." in page.text
        assert "arming refused: no gyro" in page.text
        assert "limit cycle on roll: 2.1 rad/s at 9.0 Hz" in page.text
        assert "does not say enough of vehicle, profile or manoeuvres" in page.text  # this run.json does not
        assert "∞" in page.table("Margins")[1]["own gains"]

    def test_nothing_known_at_all(self, tmp_path):
        folder = tmp_path / "20261122T200000Z_demo_ANT-X"
        (folder / "flights").mkdir(parents=True)
        page = Page(write_report(folder))
        assert "No gain set was flown" in page.text
        assert "run.json is missing" in page.text

    def test_every_value_missing(self, folder, tmp_path):
        data = json.loads((folder / "run.json").read_text())
        for flight in data["flights"]:
            flight["metrics"] = [{**m, "value": None, "outcome": "UNSET"} for m in flight["metrics"]]
            flight |= {"margins": {}, "uploaded": {}, "files": {}}
        for name in ("vehicle", "profile", "versions", "command"):
            data[name] = nothing(RUN)[name]
        bare = tmp_path / "20261122T200000Z_bare_ANT-X"
        bare.mkdir()
        (bare / "run.json").write_text(json.dumps(data))
        page = Page(write_report(bare))
        assert "Nothing of it can be drawn" in page.text
        assert "The command is not known" in page.text
        assert "Uncertain models" in page.text

    def test_a_folder_that_is_no_run(self, tmp_path):
        with pytest.raises(FileError, match="is no run"):
            write_report(tmp_path)


class TestVerdict:
    @pytest.fixture
    def run(self, data):
        return json.loads(json.dumps(data))

    def test_own_gains_that_do_not_fly_come_before_everything(self, run):
        run["own_gains"] |= {"fly": False, "reason": "diverged"}
        verdict = verdict_of(run)
        assert verdict.headline.startswith("Do not trust these verdicts yet")
        assert "doubt the assumptions" in verdict.doubts[0]

    def test_first_choice_among_several(self, run):
        for flight in run["flights"]:
            flight["outcome"] = "PASS"
        verdict = verdict_of(run, [(500, 500), (20, 500), (500, 500)])
        assert verdict.choice.startswith("First choice: 2.2 ANT-X (it passes on 500 of 500")
        assert [one.name for one in verdict.judged] == ["2.2 ANT-X", "PX4 defaults", "7.2 ANT-X"]
        assert "7.2 ANT-X passes as flown, but only 20 of 500" in verdict.doubts[0]

    @pytest.mark.parametrize(
        ("outcomes", "headline"),
        [
            (("FAIL", "FAIL", "UNSET"), "Trust none of the 3 gain sets on ANT-X; 1 not decided."),
            (("INFO", "INFO", "INFO"), "Nothing was limited, so nothing is judged: 3 gain sets flown on ANT-X."),
            ((), "No gain set was flown, so there is nothing to trust."),
            (("FAIL",), "Do not trust 2.2 ANT-X on ANT-X."),
            (("UNSET",), "2.2 ANT-X on ANT-X is not decided."),
        ],
    )
    def test_headline(self, run, outcomes, headline):
        run["flights"] = run["flights"][: len(outcomes)]
        for flight, outcome in zip(run["flights"], outcomes, strict=True):
            flight["outcome"] = outcome
        assert verdict_of(run).headline == headline

    def test_what_was_recorded_elsewhere_is_called_so(self, run):
        run["scenario"]["manoeuvres"] = [{"name": "step_1", "kind": "recorded", "duration_s": 6.0, "settings": {}}]
        run["twins"] = [{"gain_set": "2.2 ANT-X", "agree": False}]
        verdict = verdict_of(run)
        assert verdict.ground.endswith("on the model our own autopilot agrees with it in 0 of 1 flights.")
        assert verdict.doubts[0].startswith("What was recorded and our own autopilot on the model differ")
        (done,) = compute(run, [run["flights"][0]["uploaded"]]).values()
        assert done.curves is not None
        assert done.samples is None
        assert "recorded, not planned" in done.problem

    def test_interrupted_and_two_autopilots_apart(self, run):
        run["complete"] = False
        run["twins"] = [{"gain_set": "2.2 ANT-X", "agree": False}]
        doubts = " ".join(verdict_of(run).doubts)
        assert "interrupted" in doubts
        assert "differ by more than is tolerated with 2.2 ANT-X" in doubts


class TestDraft:
    def test_flights_are_drawn_as_they_land(self, folder, data, monkeypatch):
        run = read_run(folder)
        sets = [{"name": one.name, "baseline": False, "uploaded": one.data["uploaded"]} for one in run.flights]
        flown = helper.Flown(sets)
        for number, one in enumerate(run.flights):
            flown.draw(number, data["flights"][number], one.files["parquet"])
        drawn: list[str] = []
        svg = canvas.Panel.svg
        monkeypatch.setattr(canvas.Panel, "svg", lambda panel, name: drawn.append(name) or svg(panel, name))
        before = (folder / "report.html").read_bytes()
        write_report(folder)
        assert (folder / "report.html").read_bytes() == before
        assert not [name for name in drawn if re.fullmatch(r"(step|track)\d+-\d+", name)]
        assert "steps0" in drawn  # all gain sets over one another need all flights

    def test_behind_what_flies_in_real_time(self, data):
        for behind in (False, True):
            with ReportDraft(data, [], behind=behind) as draft:
                assert (helper.BEHIND in draft._process.args) == behind

    def test_who_flies_never_waits_for_the_helper(self, data, folder):
        with ReportDraft(data, []) as draft:
            draft._process.send_signal(signal.SIGSTOP)
            for number in range(40):  # more than any pipe holds
                draft.landed(number, data["flights"][0], folder / "none.parquet")

    def test_without_a_helper_the_page_is_written_all_the_same(self, folder, monkeypatch, data):
        monkeypatch.setattr(sys, "executable", "/nowhere/python")
        (folder / "report.html").unlink()
        with ReportDraft(data, []) as draft:
            draft.begin(folder)
            assert draft.finish() == folder / "report.html"
        assert (folder / "report.html").is_file()

    @pytest.mark.parametrize("compiled", [False, True])
    def test_the_first_run_ever_waits_for_what_the_helper_compiles(self, flown_run, tmp_path, monkeypatch, compiled):
        order: list[str] = []
        monkeypatch.setattr("sitl.compiled.is_compiled", lambda law: compiled)
        monkeypatch.setattr("scenarios.recorder.comparison.record_compare", lambda *_: order.append("comparison"))
        draft = SimpleNamespace(begin=lambda folder: order.append("begin"), finish=lambda: order.append("report"))
        write_run(flown_run, RunFolder.create(tmp_path, "20261122T200000Z", "demo", "ANT-X"), [], draft, print)
        assert order == ["begin", "comparison", "report"] if compiled else ["begin", "report", "comparison"]

    def test_a_report_that_fails_does_not_lose_the_run(self, quick_scenario, tmp_path, monkeypatch):
        def broken(self):
            raise RuntimeError("no ink")

        monkeypatch.setattr(ReportDraft, "finish", broken)
        said: list[str] = []
        result = run_scenario(quick_scenario(), RunOptions(out=tmp_path, say=said.append))
        assert result.stopped is None
        assert (result.folder / "compare.rrd").is_file()
        assert said == ["warning: no report: no ink"]


class TestSummary:
    def test_verdict_table_and_reasons(self, flown_run, tmp_path):
        text = write_job_summary(flown_run, tmp_path / "summary.md").read_text()
        assert text.startswith("## Trust 1 of 3 gain sets on ANT-X: own gains.\n")
        assert "| own gains | ✓ **PASS** |" in text
        assert "✗ **FAIL**" in text
        assert "limit cycle on roll: 2.1 rad/s at 9.0 Hz" in text
        assert "arming refused: no gyro" in text
        assert "profile sitl, seed 7" in text

    def test_markup_in_names_is_text(self, flown_run):
        flight = flown_run.flights[0]
        gain_set = dataclasses.replace(flight.gain_set, name="<b>|*x*[a](b)")
        run = dataclasses.replace(flown_run, flights=(dataclasses.replace(flight, gain_set=gain_set),))
        line = next(line for line in job_summary(run).splitlines() if "PASS**" in line)
        assert line.startswith("| &lt;b&gt;\\|\\*x\\*\\[a\\](b) |")

    def test_interrupted(self, flown_run):
        text = job_summary(dataclasses.replace(flown_run, flights=(), complete=False))
        assert "No gain set was flown" in text
        assert "interrupted" in text
        assert flown_run.flights[0].outcome is Outcome.PASS


def _luminance(colour: str) -> float:
    digits = colour.lstrip("#")
    digits = "".join(2 * c for c in digits) if len(digits) == 3 else digits
    parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("scheme", [0, 1, 2], ids=["light", "dark", "print"])
def test_contrast(scheme):
    css = (Path(sys.modules["scenarios.report"].__file__).parent / "page.css").read_text()
    blocks = re.findall(r":root \{([^}]*)\}", css)
    colours = dict(re.findall(r"--(\w+): (#\w+)", blocks[scheme]))

    def contrast(one: str, other: str) -> float:
        high, low = sorted((_luminance(colours[one]), _luminance(colours[other])), reverse=True)
        return (high + 0.05) / (low + 0.05)

    for ground in ("paper", "card", "soft"):
        for text in ("ink", "dim", "good", "bad", "open", "link"):
            assert contrast(text, ground) >= 4.5, (text, ground)
        for line in ("target", *(f"hue{k}" for k in range(8))):
            assert contrast(line, ground) >= (2.8 if line == "target" else 3.0), (line, ground)


@pytest.mark.skipif(not BROWSER, reason=MISSING)
def test_in_a_browser(folder, tmp_path):
    with Chromium(tmp_path) as browser:
        for width, dark in ((1280, False), (360, True)):
            browser.width(width, dark)
            browser.open(folder / "report.html")
            assert browser.evaluate("document.documentElement.scrollWidth") <= width
            # what scrolls can be reached by the keyboard
            assert not browser.evaluate(
                "[...document.querySelectorAll('div, pre')].filter(e => e.scrollWidth > e.clientWidth + 1 && "
                "getComputedStyle(e).overflowX == 'auto' && e.tabIndex < 0).map(e => e.outerHTML.slice(0, 80))"
            )
        ground = browser.evaluate("getComputedStyle(document.body).backgroundColor")
        assert ground == "rgb(20, 22, 26)"
        told = browser.tree()
        assert browser.complaints == []
        assert {request.partition("#")[0] for request in browser.requests} == {(folder / "report.html").as_uri()}
    for role in ("image", "table", "figure", "navigation", "region", "group"):
        names = [node["name"] for node in told if node["role"] == role]
        assert names
        assert all(names), role
    assert any(node["role"] == "main" for node in told)
