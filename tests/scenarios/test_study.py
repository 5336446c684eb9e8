"""`froude study`: tables against independent arithmetic, verdicts against altered numbers, its page and figures."""

from __future__ import annotations

import json
import re
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenarios.cli import main
from scenarios.study import beyond as beyond_module
from scenarios.study import cloud_figures, model_figures
from scenarios.study.beyond import beyond
from scenarios.study.conclusions import conclusions
from scenarios.study.cross_validation import fly_live, tune_pair
from scenarios.study.errata import errata
from scenarios.study.figures import draw_all
from scenarios.study.page import study_page
from scenarios.study.pairs import fly_pairs, printed_gains
from scenarios.study.printed import digits, printed
from scenarios.study.recompute import recompute
from scenarios.study.result import Figure, Row, Study, Verdict
from scenarios.study.summary import line_of
from scenarios.study.tables import tables
from scenarios.study.text import study_object, study_text
from sitl.airframe import DERIVATIVE_NAMES, load_airframe
from sitl.profile import get_profile

ORACLE = tomllib.loads((Path(__file__).parents[1] / "data" / "study.toml").read_text(encoding="utf-8"))
NUMBERS = ("2.1", "2.2", "3.1", "4.1", "5.1", "5.2", "5.3", "5.4", "5.5", "5.6", "5.7", "5.8", "7.1", "7.2", "7.3")
FRAMES = ("ANT-R", "ANT-X", "CARRIER-1", "ADAM-0")
# of the dimension: [L^a T^b], times N^(a + b/2) with lengths as 1/N... taken as printed in table 4.1
EXPONENTS = {"Yv": 0.5, "Yp": -0.5, "Yd": 0.0, "Lv": 1.5, "Lp": 0.5, "Ld": 1.0}
SAMPLES = 40


@pytest.fixture(scope="module")
def study() -> Study:
    return recompute(samples=SAMPLES, seed=3)


@pytest.fixture(scope="module")
def figures(study: Study) -> tuple[Figure, ...]:
    return tuple(draw_all(study.pairs, samples=SAMPLES, seed=3))


@pytest.fixture(scope="module")
def page(study: Study, figures: tuple[Figure, ...]) -> str:
    return study_page(study, figures)


def rows(study: Study, number: str) -> dict[tuple[str, str], Row]:
    (table,) = (table for table in study.tables if table.number == number)
    return {(row.item, row.column): row for row in table.rows}


class TestTables:
    def test_the_print_is_the_oracles(self) -> None:
        """What the program takes for printed is, number by number, what was transcribed for the tests."""

        def plain(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: plain(one) for key, one in value.items()}
            if isinstance(value, list):
                return [plain(one) for one in value]
            return value if isinstance(value, str | bool) else float(value)

        assert plain(dict(printed())) == plain(ORACLE)

    def test_every_table_is_there(self, study: Study) -> None:
        assert tuple(table.number for table in study.tables) == NUMBERS
        assert all(table.rows for table in study.tables)

    def test_differences_are_ours_minus_printed(self, study: Study) -> None:
        pairs = [
            row for table in study.tables for row in table.rows if row.printed is not None and row.ours is not None
        ]
        assert len(pairs) > 150
        for row in pairs:
            assert row.difference == pytest.approx(row.ours - row.printed, abs=1e-15)  # type: ignore[operator]

    @pytest.mark.parametrize("name", FRAMES)
    def test_modes_are_eigenvalues_of_the_written_out_matrix(self, study: Study, name: str) -> None:
        d = ORACLE["derivatives"][name]["value"]
        matrix = np.array([[d["Yv"], d["Yp"], 9.81], [d["Lv"], d["Lp"], 0.0], [0.0, 1.0, 0.0]])
        values = np.linalg.eigvals(matrix)
        pair = values[np.abs(values.imag) > 1e-9][0]
        (real,) = values[np.abs(values.imag) <= 1e-9].real
        shown = [row.ours for (_, column), row in rows(study, "3.1").items() if column == name]
        for wanted in (-real, abs(pair), -pair.real / abs(pair)):
            assert any(value is not None and abs(value - wanted) < 1e-9 for value in shown), (wanted, shown)

    @pytest.mark.parametrize(
        ("number", "target"), [("5.2", "ANT-R"), ("5.4", "ANT-X"), ("5.6", "CARRIER-1"), ("5.8", "ADAM-0")]
    )
    def test_scaled_derivatives_are_powers_of_n(self, study: Study, number: str, target: str) -> None:
        table = rows(study, number)
        for reference in FRAMES:
            n = ORACLE["airframe"][reference]["diagonal_m"] / ORACLE["airframe"][target]["diagonal_m"]
            for name, exponent in EXPONENTS.items():
                value = ORACLE["derivatives"][reference]["value"][name] * n**exponent
                assert table[name, reference].ours == pytest.approx(value, rel=1e-12), (reference, name)

    def test_exponents_are_the_printed_ones(self, study: Study) -> None:
        for (name, _), row in rows(study, "4.1").items():
            if name in EXPONENTS:
                assert row.ours == EXPONENTS[name]
                assert row.agrees

    def test_a_printed_zero_at_the_end_is_padding(self) -> None:
        from decimal import Decimal

        assert digits(Decimal("-10.1650")) == 3
        assert digits(Decimal("0.0296")) == 4
        assert digits(Decimal("1150.6")) == 1
        assert digits(6) == 0


class TestErrata:
    def test_exactly_the_rows_that_differ(self, study: Study) -> None:
        shown = [one for one in study.errata if one.where.startswith("table ")]
        wrong = [
            (table.number, row.column, row.item) for table in study.tables for row in table.rows if row.agrees is False
        ]
        assert {one.where for one in shown} == {f"table {t}, {c}, {i}" for t, c, i in wrong}
        assert {t for t, _, _ in wrong} == {"5.6", "5.8"}
        assert len(wrong) == 6
        assert all(one.found_by_us for one in shown)

    def test_a_misprint_is_found_and_a_rounding_is_not(self) -> None:
        found = tables()
        before = errata(found)
        (table,) = (one for one in found if one.number == "5.2")
        row = next(one for one in table.rows if one.item == "Ld" and one.column == "ANT-X")
        assert row.printed is not None
        for change, more in ((0.004 * 10.0 ** -(row.digits or 0), 0), (7.0, 1)):
            altered = replace(
                table, rows=tuple(replace(r, printed=row.printed + change) if r is row else r for r in table.rows)
            )
            assert len(errata([altered if one is table else one for one in found])) == len(before) + more


class TestConclusions:
    def test_the_verdicts_follow_the_flights(self, study: Study) -> None:
        """Shake every flight: what claims that the gains fly is no longer confirmed."""
        usual = {one.statement: one.verdict for one in conclusions(study.pairs)}
        worse = [
            replace(pair, metrics={name: self._worse(name, np.asarray(value)) for name, value in pair.metrics.items()})
            for pair in study.pairs
        ]
        after = {one.statement: one.verdict for one in conclusions(worse)}
        changed = [text for text, verdict in usual.items() if after[text] is not verdict]
        assert changed
        assert all(after[text] is not Verdict.CONFIRMED for text in changed)

    @staticmethod
    def _worse(name: str, value: np.ndarray) -> np.ndarray:
        if name.startswith("settling"):
            return value * 0.0 + 3.0
        if name == "vaf_pct":
            return value * 0.0 - 50.0
        return value

    def test_every_one_has_its_numbers(self, study: Study) -> None:
        for one in study.conclusions:
            assert re.search(r"\d", one.evidence), one.statement
        told = [one.verdict for one in study.conclusions if one.section != "ours"]
        assert told.count(Verdict.CONFIRMED) >= 8
        assert Verdict.REFUTED in told


class TestOwnStatements:
    def test_which_models_no_gains_can_hold(self, study: Study) -> None:
        """By the corners of the box for whether, by draws of another generator for how many."""
        (one,) = [c for c in study.conclusions if "can be held at a roll angle" in c.statement]
        assert one.verdict is Verdict.REFUTED
        rng = np.random.default_rng(99)
        for name in FRAMES:
            said = ORACLE["derivatives"][name]
            centre = np.array([said["value"][d] for d in ("Yv", "Yd", "Lv", "Ld")])
            sigma = np.abs(centre) * [said["sigma_pct"][d] / 100.0 for d in ("Yv", "Yd", "Lv", "Ld")]
            Yv, Yd, Lv, Ld = (centre + sigma * rng.uniform(-3.0, 3.0, (200_000, 4))).T
            share = 100.0 * float(np.mean(Lv * Yd <= Ld * Yv))
            told = re.search(rf"{name} \([\d.e-]+ % of gaussian draws, ([\d.]+) % of uniform draws\)", one.evidence)
            assert (share > 0.0) == (told is not None)
            if told is not None:
                assert float(told[1]) == pytest.approx(share, rel=0.1)

    def test_a_settling_time_at_the_limit_is_said_to_be(self, study: Study) -> None:
        (one,) = [c for c in study.conclusions if c.statement.startswith("Every controller settles within")]
        slowest = {
            (p.target, p.based_on): float(np.nanmax(p.metrics["settling_time_5pct_s"]))
            for p in study.pairs
            if p.profile == "study"
        }
        close = {pair for pair, value in slowest.items() if 0.495 < value <= 0.5}
        assert close
        for target, based_on in close:
            assert f"{target} on {based_on}" in one.evidence.partition("At the limit")[2]

    def test_what_was_not_measured_is_said_in_words(self, study: Study) -> None:
        """The printed sets of profile sitl, most of which shake, given out for tuned ones."""
        tuned = [replace(p, source="tuned for sitl") for p in study.pairs if p.profile == "sitl"]
        told = [c for c in conclusions([*study.pairs, *tuned]) if c.statement.startswith("Gains tuned here")]
        assert len(told) == 2
        for one in told:
            assert one.verdict is Verdict.REFUTED
            assert "settling not measurable on all, overshoot not measurable on all, delay margin -" in one.evidence
            assert "nan" not in one.evidence

    def test_overshoot_is_no_matter_of_what_it_is_measured_against(self, study: Study) -> None:
        told = [c for c in study.conclusions if "overshoots by" in c.statement]
        assert len(told) == 4
        for one in told:
            assert "of the angle at its end instead of the set-point, nominal 0.00 %" in one.evidence


class TestPairs:
    def test_sixteen_in_each_profile(self, study: Study) -> None:
        for profile in ("study", "sitl"):
            names = {(p.target, p.based_on) for p in study.pairs if p.profile == profile}
            assert names == {(target, reference) for target in FRAMES for reference in FRAMES}

    def test_on_the_studys_loop_every_printed_set_settles_in_time(self, study: Study) -> None:
        for pair in study.pairs:
            if pair.profile == "study":
                line = line_of(pair)
                assert line.settling_s[1] <= 0.505
                assert line.overshoot_pct <= 0.15

    def test_the_same_seed_flies_the_same(self) -> None:
        gains = {key: value for key, value in printed_gains().items() if key == ("ANT-X", "ADAM-0")}
        first, second = (next(fly_pairs(gains, get_profile("sitl"), samples=10, seed=4)) for _ in range(2))
        for name in first.metrics:
            assert np.array_equal(first.metrics[name], second.metrics[name], equal_nan=True)

    def test_a_pair_flown_over_mavlink(self) -> None:
        """Tuned on the scaled model, flown on the true one, as chapter 7 does: within its requirements."""
        gains = tune_pair("ANT-X", "ADAM-0", "study", 30, 1)
        flown = fly_live("ANT-X", "ADAM-0", gains, "study", 1)
        settling = next(value for name, value in flown.items() if "settl" in name)
        assert settling is not None
        assert settling <= 0.5


class TestBeyond:
    def test_the_target_is_left_out_of_the_fit(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Whatever ADAM-0 is, the law that predicts ADAM-0 was fitted without it."""
        law = next(one for one in beyond_module.LAWS if one.fitted)
        frames = {name: load_airframe(name) for name in FRAMES}
        others = [frame for name, frame in frames.items() if name != "ADAM-0"]
        usual = beyond_module.fit(law, others)
        assert usual == beyond_module.fit(law, others)
        strange = replace(frames["ADAM-0"], derivatives=replace(frames["ADAM-0"].derivatives, Ld=1e4))
        assert beyond_module.fit(law, [*others, strange]) != usual

    def test_froude_is_its_own_prediction(self) -> None:
        law = next(one for one in beyond_module.LAWS if "Froude (table 4.1)" in one.name)
        reference, target = load_airframe("ANT-R"), load_airframe("ANT-X")
        n = reference.diagonal_m / target.diagonal_m
        predicted = beyond_module.predict(law, {}, reference, target).as_dict()
        for name in DERIVATIVE_NAMES:
            wanted = reference.derivatives.as_dict()[name] * n ** EXPONENTS[name]
            assert predicted[name] == pytest.approx(wanted, rel=1e-9)

    def test_it_says_that_it_does_not_help(self) -> None:
        _, said = beyond()
        (one,) = said
        assert one.verdict is Verdict.REFUTED
        assert "does not help" in one.evidence


class TestShown:
    def test_json_has_no_number_that_is_none(self, study: Study) -> None:
        text = json.dumps(study_object(study), allow_nan=False)
        again = json.loads(text)
        assert [table["number"] for table in again["tables"]] == list(NUMBERS)
        assert len(again["errata"]) == len(study.errata)

    def test_the_text_fits_a_terminal_and_says_what_is_not_met(self, study: Study) -> None:
        text = study_text(study)
        for number in NUMBERS:
            assert number in text
        assert "REFUTED" in text
        assert "CONFIRMED" in text

    def test_the_page_needs_nothing_else(self, page: str) -> None:
        assert not re.search(r"<(?:script|link|iframe|object)\b", page)
        assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", page)
        assert "@import" not in page
        assert "url(" not in page.replace("url(#", "")

    def test_the_page_is_whole(self, page: str, study: Study, figures: tuple[Figure, ...]) -> None:
        class Reader(HTMLParser):
            def __init__(self) -> None:
                super().__init__()
                self.ids: list[str] = []
                self.links: list[str] = []
                self.tags: list[str] = []

            def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
                self.tags.append(tag)
                for name, value in attrs:
                    if name == "id":
                        self.ids.append(value or "")
                    if name == "href" and value and value.startswith("#"):
                        self.links.append(value[1:])

        reader = Reader()
        reader.feed(page)
        assert len(reader.ids) == len(set(reader.ids))
        assert set(reader.links) <= set(reader.ids)
        assert page.startswith("<!doctype html>") or page.startswith("<!DOCTYPE html>")
        assert '<html lang="en' in page
        assert 'name="viewport"' in page
        assert reader.tags.count("svg") == len(figures)
        for number in NUMBERS:
            assert f"table-{number}" in reader.ids

    def test_what_comes_from_data_is_escaped(self, study: Study) -> None:
        odd = '<b onclick="x()">&'
        table = replace(study.tables[0], title=odd, note=odd)
        page = study_page(replace(study, tables=(table,)), ())
        assert odd not in page
        assert "&lt;b onclick=" in page

    def test_figures_of_everything_the_data_allow(self, figures: tuple[Figure, ...]) -> None:
        sections = " ".join(figure.section for figure in figures)
        for section in ("6.3", "6.4", "6.5", "6.13", "8.2", "8.4", "5", "7"):
            assert section in sections, section
        names = [figure.name for figure in figures]
        assert len(names) == len(set(names))
        assert len(names) >= 29

    def test_figures_of_the_print_are_not_called_sections(self, figures: tuple[Figure, ...]) -> None:
        places = {figure.place for figure in figures}
        assert places == {
            "chapter 4", "chapter 5", "section 6.3", "section 6.4", "section 6.5", "figure 6.13", "chapter 7",
            "figure 8.2", "figure 8.4",
        }  # fmt: skip

    def test_every_figure_is_a_picture(self, figures: tuple[Figure, ...]) -> None:
        for figure in figures:
            root = ET.fromstring(figure.svg)
            drawn = [one for one in root.iter() if one.tag.endswith(("path", "use"))]
            assert len(drawn) > 20, figure.name
            assert figure.png.startswith(b"\x89PNG\r\n\x1a\n")
            assert len(figure.png) > 5000
            assert figure.title
            assert figure.caption

    def test_figures_are_the_same_every_time(self, figures: tuple[Figure, ...]) -> None:
        before = {figure.name: figure for figure in figures}
        for again in (*islice(model_figures.draw(), 2), *islice(cloud_figures.draw(SAMPLES, 3), 1)):
            assert again.svg == before[again.name].svg
            assert again.png == before[again.name].png


Froude = Callable[..., tuple[int, str, str]]


@pytest.fixture
def froude(capsys: pytest.CaptureFixture[str]) -> Froude:
    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(word) for word in words])
        out, err = capsys.readouterr()
        return status, out, err

    return run


class TestCommand:
    def test_numbers_alone(self, froude: Froude, tmp_path: Path) -> None:
        status, out, _ = froude("study", "--samples", 5, "--no-figures", "--json", "--out", tmp_path / "none")
        assert status == 0
        assert json.loads(out)["settings"]["command"] == "froude study --samples 5 --seed 1"
        assert not (tmp_path / "none").exists()

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            (["--samples", 0], "--samples 0: give 1 to 20000"),
            (["--samples", 10**6], "--samples 1000000"),
            (["--seed", -1], "--seed -1"),
        ],
    )
    def test_what_cannot_be_recomputed(self, froude: Froude, words: list[object], said: str) -> None:
        status, out, err = froude("study", *words)
        assert (status, out) == (2, "")
        assert said in err

    def test_a_place_that_cannot_be_written_to(self, froude: Froude, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        status, _, err = froude("study", "--samples", 2, "--out", tmp_path / "file" / "study")
        assert status == 2
        assert err.count("\n") == 1
        assert "Traceback" not in err
