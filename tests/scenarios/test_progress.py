"""The bar on a terminal, and what a run says when it begins."""

from __future__ import annotations

import pytest

from scenarios.progress import RunWatch, progress_bar
from scenarios.runner import Progress


def test_a_watch_says_once_that_flights_begin_and_when_a_vehicle_is_touched() -> None:
    said: list[str] = []
    shown: list[Progress] = []
    watch = RunWatch(lambda: said.append("begin"))
    watch.show = shown.append
    phases = ("connect", "upload", "take off", "connect")
    touched = []
    for index, phase in enumerate(phases):
        watch(Progress(index, 4, "a", phase))
        touched.append(watch.touched)
    assert said == ["begin"]
    assert touched == [False, True, True, True]
    assert [now.phase for now in shown] == list(phases)


def test_the_bar_goes_to_standard_error_and_names_the_flight(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    with progress_bar() as show:
        show(Progress(2, 6, "7.2 ANT-R", "take off"))
    out, err = capsys.readouterr()
    assert out == ""
    assert "7.2 ANT-R" in err
    assert "2/6" in err
    assert "take off" in err
