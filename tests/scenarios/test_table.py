import dataclasses
import io
import re
from pathlib import Path

import pytest

from scenarios.limits import Outcome, measured
from scenarios.markdown import circumstances, flight_page, gains_table, markdown_table, verdicts
from scenarios.table import (
    COLUMNS,
    PIPED_WIDTH,
    blank_cells,
    cells,
    number,
    own_flight,
    own_gains_fly,
    own_gains_line,
    run_text,
    terminal_width,
    viewer_command,
)

FOLDER = Path("logs/20261122T200000Z_demo_ant-x")


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (float("nan"), "–"), (float("inf"), "∞"), (float("-inf"), "-∞"), (-0.001, "0.00"), (-1.234, "-1.23")],
)
def test_numbers_read_well(value, text):
    assert number(value) == text


def row(text: str, name: str) -> list[str]:
    line = next(line for line in text.splitlines() if line.startswith(name))
    return re.split(r"\s{1,}", line[len(name) :].replace(" @ ", "@").strip())


@pytest.mark.parametrize("width", [100, 120, 160])
def test_a_row_holds_every_metric_and_fits(flown_run, width):
    text = run_text(flown_run, FOLDER, width=width)
    assert row(text, "own gains") == [
        "0.0",
        "0.50",
        "–",
        "0.366",
        "0.00",
        "92.8",
        "1.30",
        "0.00",
        "0.06",
        "31.2",
        "PASS",
    ]
    assert row(text, "7.2 cycles") == ["–", "–", "–", "–", "–", "–", "–", "2.10@9.0", "–", "2.1", "FAIL"]
    assert row(text, "refused")[-1] == "FAIL"
    assert max(map(len, text.splitlines())) <= width
    assert "\x1b" not in text


def test_reasons_warnings_and_blanks_stand_below(flown_run):
    text = run_text(flown_run, FOLDER, width=160)
    assert "7.2 cycles: limit cycle on roll: 2.1 rad/s at 9.0 Hz" in text
    assert "warning: MC_ROLLRATE_I 35.8 exceeds PX4's maximum 10" in text
    assert "– overshoot" not in text  # its reason is the verdict's
    assert "– settle 2 % (own gains): never inside the band" in text
    assert "arming refused" in text


def test_the_assumptions_in_force_are_said_once(flown_run):
    text = " ".join(run_text(flown_run, width=100).split())
    assert "Profile sitl: rate_hz 250, motor_lag_s 0.01, limits yes, hover_thrust 0.5 (assumed)." in text
    assert "0.025" not in text  # the airframe's motor lag, which the profile replaces


def test_it_says_where_the_run_is_and_how_to_look_at_it(flown_run):
    lines = run_text(flown_run, FOLDER, viewer="rerun").splitlines()
    assert f"Run folder: {FOLDER}" in lines
    assert f"Look at it: rerun {FOLDER}/compare.rrd" in lines
    assert "rerun" not in run_text(flown_run, None)


def test_the_viewer_is_called_so_that_it_is_found(monkeypatch, tmp_path):
    monkeypatch.setattr("shutil.which", lambda _: "/usr/bin/rerun")
    assert viewer_command() == "rerun"
    monkeypatch.setattr("shutil.which", lambda _: None)
    monkeypatch.setattr("sys.executable", str(tmp_path / "bin" / "python"))
    assert viewer_command() == "rerun"  # not beside us either: nothing better to say
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "rerun").write_text("")
    assert viewer_command() == str(tmp_path / "bin" / "rerun")
    monkeypatch.chdir(tmp_path)
    assert viewer_command() == "bin/rerun"


def test_long_paths_are_never_wrapped_and_are_quoted(flown_run):
    folder = Path("/tmp/" + "long folder " * 20)
    assert (
        f"Look at it: rerun '{folder}/compare.rrd'"
        in run_text(flown_run, folder, width=80, viewer="rerun").splitlines()
    )


def test_colour_only_when_asked(flown_run):
    assert "\x1b[" in run_text(flown_run, colour=True)
    plain = re.sub(r"\x1b\[[0-9;]*m", "", run_text(flown_run, colour=True))
    assert plain.split() == run_text(flown_run).split()


def test_an_interrupted_run_says_so_even_without_flights(flown_run):
    empty = dataclasses.replace(flown_run, flights=(), complete=False)
    assert "interrupted" in run_text(empty)


def test_not_a_terminal_means_no_colour_and_a_fixed_width(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert terminal_width(io.StringIO()) == (PIPED_WIDTH, False)
    monkeypatch.setenv("COLUMNS", "97")
    assert terminal_width(io.StringIO()) == (97, False)


def test_no_color_is_obeyed(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert terminal_width(Terminal()) == (100, True)
    monkeypatch.setenv("NO_COLOR", "1")
    assert terminal_width(Terminal()) == (100, False)


def test_cells_carry_the_outcome_of_the_limit(flown_run):
    outcomes = {column.name: outcome for column, (_, outcome) in zip(COLUMNS, cells(flown_run.flights[1]), strict=True)}
    assert outcomes["oscillation"] is Outcome.FAIL
    assert outcomes["delay margin"] is Outcome.FAIL
    assert outcomes["overshoot"] is Outcome.UNSET
    assert outcomes["VAF"] is Outcome.INFO


def test_the_airframes_own_gains_are_found_among_the_candidates(flown_run):
    assert own_flight(flown_run) is flown_run.flights[0]
    assert own_gains_line(flown_run) == "The airframe's own flight gains (own gains) fly under these assumptions."
    others = dataclasses.replace(flown_run, flights=flown_run.flights[1:])
    assert own_flight(others) is None
    assert own_gains_line(others) == ""


def test_own_gains_that_oscillate_put_the_assumptions_in_doubt(flown_run):
    run = dataclasses.replace(flown_run, baseline=flown_run.flights[1])
    line = own_gains_line(run)
    assert "do NOT fly" in line
    assert "doubt the assumptions" in line


def test_own_gains_that_are_only_slow_do_fly(flown_run):
    slow = dataclasses.replace(flown_run.flights[0], outcome=Outcome.FAIL, reason="rise_time_s 0.5 s")
    metric = dataclasses.replace(measured("rise_time_s", 0.5), limit="<= 0.4 s", outcome=Outcome.FAIL)
    assert own_gains_fly(dataclasses.replace(slow, metrics=(*slow.metrics, metric)))
    assert not own_gains_fly(dataclasses.replace(slow, reason="failsafe: attitude"))  # failed without any metric's help


def test_blank_cells_are_grouped_by_reason(flown_run):
    flight = dataclasses.replace(flown_run.flights[1], reason="")
    assert blank_cells((flight, flight)) == ["– overshoot, rise (7.2 cycles, 7.2 cycles): limit cycle"]


def test_markdown_tables_have_one_cell_per_column_whatever_is_in_them():
    table = markdown_table(("a", "b"), [["x|y", "line\nbreak"]]).splitlines()
    assert table == ["| a | b |", "| :--- | ---: |", "| x\\|y | line break |"]


def test_verdict_page_counts_and_marks_what_is_out_of_limit(flown_run):
    page = verdicts(flown_run)
    assert page.startswith("### 1 of 3 gain sets pass on ANT-X, profile sitl")
    assert "**2.10 @ 9.0**" in page
    assert "own flight gains (own gains) fly" in page


def test_circumstances_name_what_the_verdicts_rest_on(flown_run):
    page = circumstances(flown_run)
    for text in ("450.71", "delay_margin_s >= 0.01 s", "motor_lag_s 0.01", "hover_thrust 0.5 (assumed)", "seed 7"):
        assert text in page


def test_flight_page_shows_verdict_limits_gains_and_infinite_margins(flown_run):
    page = flight_page(flown_run.flights[0])
    assert page.startswith("# PASS: own gains")
    assert "| rise_time_s | 0.366 s | <= 0.4 s | PASS |" in page
    assert "| gain_margin_high_db | ∞ dB |" in page
    assert "99" not in page  # a segment's metric is not the flight's


def test_gains_stand_in_one_order_and_missing_ones_are_dashes(flown_run):
    lines = gains_table(flown_run.flights).splitlines()
    assert [line.split()[1] for line in lines[2:]] == ["MC_ROLL_P", "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D"]
    assert lines[3] == "| MC_ROLLRATE_P | 0.05 | 0.6 | – |"
