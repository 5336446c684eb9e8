"""A sweep shown: ranked, written into its folder as files that one can look at and fly, and told."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scenarios.run_folder import write_atomically
from scenarios.sweep.flown_beside import FlownBeside, flown_beside
from scenarios.sweep.pareto import Front, front_of
from scenarios.sweep.ranking import Ranking, rank
from scenarios.sweep.stored_sweep import stored_sweep
from scenarios.sweep.sweep_object import sweep_object
from scenarios.sweep.sweep_text import RECORDING, sweep_text
from scenarios.sweep.winner import write_winner

if TYPE_CHECKING:
    from scenarios.sweep.sweep_figures import FigureFile

REPORT = "report.html"


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
    made = [*write_winner(ranking, path), *write_pictures(ranking, front, flown, path)]
    files = {file.name: str(file) for file in made}
    if as_json:
        return ranking.passing, json.dumps(sweep_object(ranking, front, flown, files), indent=2) + "\n"
    return ranking.passing, sweep_text(ranking, front, flown, list(files), width=width, colour=colour)


def write_pictures(ranking: Ranking, front: Front, flown: FlownBeside | None, folder: Path) -> Sequence[Path]:
    """Write figures, page and recording; pictures of an earlier look that are not drawn any more go.

    Args:
        ranking, front: of the sweep. flown: what was flown of it. folder: of the sweep.

    Returns:
        the files.

    Raises:
        FileError: something cannot be written.
    """
    from scenarios.sweep.heat_figures import heat_file
    from scenarios.sweep.sweep_figures import pareto_file
    from scenarios.sweep.sweep_maps import heat_maps
    from scenarios.sweep.sweep_report import sweep_page

    maps = heat_maps(ranking) if len(ranking.order) else ()
    written: list[Path] = []
    figures = [pareto_file(ranking, front), *(heat_file(ranking, heat) for heat in maps)] if len(ranking.order) else []
    for figure in figures:
        for suffix, data in (("svg", figure.svg), ("png", figure.png)):
            written.append(folder / f"{figure.name}.{suffix}")
            write_atomically(written[-1], data)
    for old in (*folder.glob("heat_*.???"), *folder.glob("pareto.???")):
        if old not in written and old.suffix in (".svg", ".png"):
            old.unlink(missing_ok=True)
    report = folder / REPORT
    pictures = [name for name in ("pareto.svg", "pareto.png") if folder / name in written]
    pictures += ["heat_*.svg", "heat_*.png"] if maps else []
    write_atomically(report, sweep_page(ranking, front, maps, flown, pictures).encode())
    return [report, *_recorded(ranking, front, figures, folder), *written]


def _recorded(ranking: Ranking, front: Front, figures: Sequence[FigureFile], folder: Path) -> Sequence[Path]:
    recording = folder / RECORDING
    if not figures:
        recording.unlink(missing_ok=True)
        return []
    from scenarios.recorder.sweep_recording import record_sweep

    heats = {figure.name.removeprefix("heat_"): figure.png for figure in figures[1:]}
    return [record_sweep(ranking, front, heats, recording)]
