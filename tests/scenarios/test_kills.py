"""A few kills of the kill loop, so that it goes on working: SIGKILL at random moments, and nothing broken is left."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import pytest

from tests.bench.kill_loop import Kill


@pytest.mark.parametrize(("command", "seed"), [("fly", 7), ("sitl", 2), ("hil", 3)])
def test_killed(command: str, seed: int, tmp_path: Path) -> None:
    """`sweep` is killed in its own tests, a flight over a link in those of `restore`."""
    counts: Counter[str] = Counter()
    kill = Kill(tmp_path, random.Random(seed), counts)
    try:
        getattr(kill, command)()
    finally:
        kill.close()
    assert counts["killed"] + counts["had ended"] == 1


def test_a_sentence_of_what_is_left(tmp_path: Path) -> None:
    """It finds what it looks for: a run whose run.json is half written."""
    folder = tmp_path / "runs" / "20261122T200000Z_quick_ANT-X"
    (folder / "flights").mkdir(parents=True)
    (folder / "run.json").write_text('{"schema_version": 1, ')
    from tests.bench.kill_loop import look_at_runs

    with pytest.raises(ValueError, match="Expecting"):
        look_at_runs(tmp_path, tmp_path / "runs", Counter())
