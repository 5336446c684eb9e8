"""A sweep shown: ranked, written into its folder as files that one can look at and fly, and told."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from scenarios.sweep.flown_beside import flown_beside
from scenarios.sweep.pareto import front_of
from scenarios.sweep.ranking import rank
from scenarios.sweep.stored_sweep import stored_sweep
from scenarios.sweep.sweep_object import sweep_object
from scenarios.sweep.sweep_text import sweep_text
from scenarios.sweep.winner import write_winner


def show_sweep(
    path: Path, *, as_json: bool, width: int | None, colour: bool, tell: Callable[[str], object]
) -> tuple[int, str]:
    """Rank a sweep and write everything that is made of it.

    Args:
        path: of the folder. as_json: the text is for machines. width, colour: of the text.
        tell: prints a line for people on standard error.

    Returns:
        how many candidates pass everywhere, and the text.

    Raises:
        FileError: it is no sweep, or something cannot be written.
    """
    ranking = rank(stored_sweep(path))
    front, flown = front_of(ranking), flown_beside(path)
    files = {file.name: str(file) for file in write_winner(ranking, path)}
    if as_json:
        return ranking.passing, json.dumps(sweep_object(ranking, front, flown, files), indent=2) + "\n"
    return ranking.passing, sweep_text(ranking, front, flown, list(files), width=width, colour=colour)
