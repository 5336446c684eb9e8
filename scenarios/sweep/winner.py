"""The best candidate as files: a gain set for `froude fly --gains`, a parameter file for QGroundControl."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scenarios.gain_set import GainSet, save_params
from scenarios.run_folder import write_atomically
from scenarios.sweep.ranking import Ranking
from scenarios.sweep.sweep_words import objective_heading, shown_objective
from scenarios.toml_file import quoted

WINNER, BEST = "winner", "best"
"""Names of the files: it passes everywhere; it does not, but nothing does."""


def winner_set(ranking: Ranking) -> GainSet | None:
    """The first of the ranking as a gain set; None if no candidate is complete.

    Args:
        ranking: of a sweep.
    """
    candidate = ranking.best
    if candidate is None:
        return None
    sweep = ranking.sweep
    share, cases = ranking.worst_pct(candidate), len(sweep.cases)
    worst = "its worst case could not be judged" if share is None else f"worst case {share:.1f} % of {sweep.of} models"
    said = [f"passes in {ranking.passed[candidate]} of {cases} cases, {worst} ({worst_case_name(ranking, candidate)})"]
    for number, one in enumerate(sweep.objectives):
        said.append(f"{objective_heading(one)} {shown_objective(one, ranking.objective(candidate, number))}")
    if not ranking.everywhere[candidate]:
        said.insert(0, "DOES NOT PASS everywhere")
    drawn = f"{sweep.plan['samples']} samples, seed {sweep.plan['seed']}"
    source = f"froude sweep {sweep.name}: candidate {candidate} of {sweep.candidates}, {drawn}"
    what = WINNER if ranking.everywhere[candidate] else BEST
    return GainSet(f"{sweep.name} {what}", sweep.parameters(ranking.values_of(candidate)), source, "; ".join(said))


def worst_case_name(ranking: Ranking, candidate: int) -> str:
    """For people.

    Args:
        ranking: of a sweep. candidate: its number.
    """
    return ranking.sweep.cases[int(ranking.worst_case[candidate])]


def write_winner(ranking: Ranking, folder: Path) -> tuple[Path, ...]:
    """Write `winner.toml` and `winner.params`, or `best.*` where nothing passes everywhere; the others go.

    Args:
        ranking: of a sweep. folder: of the sweep.

    Returns:
        the files; none if no candidate is complete.

    Raises:
        FileError: they cannot be written.
    """
    made = winner_set(ranking)
    passes = made is not None and ranking.passing > 0
    for name in (WINNER, BEST):
        if made is None or (name == WINNER) != passes:
            for suffix in (".toml", ".params"):
                (folder / f"{name}{suffix}").unlink(missing_ok=True)
    if made is None:
        return ()
    path = folder / f"{WINNER if passes else BEST}.toml"
    lines = ["# Written by froude sweep.", "", "[[gain_set]]"]
    lines += [f"{key} = {quoted(getattr(made, key))}" for key in ("name", "source", "note")]
    lines += ["[gain_set.parameters]", *(f"{name} = {_text(value)}" for name, value in made.parameters.items()), ""]
    write_atomically(path, "\n".join(lines).encode())
    params = path.with_suffix(".params")
    save_params(params, made.parameters)
    return path, params


def _text(value: float | int) -> str:
    """The shortest decimal that reads back as the same float32: what PX4 keeps."""
    return str(value) if isinstance(value, int) else str(np.float32(value))
