"""Every figure of the study that its data allow, drawn and written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from scenarios import interrupts
from scenarios.run_folder import write_atomically
from scenarios.study import cloud_figures, model_figures, pair_figures
from scenarios.study.result import Figure, Pair
from sitl.errors import FileError


def draw_all(
    pairs: Sequence[Pair], *, samples: int = 500, seed: int = 1, progress: Callable[[str], object] = lambda _: None
) -> tuple[Figure, ...]:
    """All figures, in the study's order; the same bytes for the same pairs and seed.

    Args:
        pairs: of chapter 7. samples, seed: of the clouds of chapter 6. progress: called with a short text.
    """
    kinds: dict[tuple[str, str], list[Pair]] = {}
    for pair in pairs:
        kinds.setdefault((pair.source.partition(" ")[0], pair.profile), []).append(pair)
    drawn: list[Figure] = []
    # two processes: drawing is one thread, and most of what a study takes
    with ProcessPoolExecutor(2, get_context("spawn"), interrupts.end_with_parent) as pool:
        jobs = [pool.submit(_models), pool.submit(_clouds, samples, seed)]
        jobs += [pool.submit(_pairs, some) for some in kinds.values()]
        for job in jobs:
            drawn += job.result()
            progress(f"{len(drawn)} figures drawn")
    return tuple(sorted(drawn, key=lambda figure: [int(part) for part in figure.section.split(".")]))


def _models() -> list[Figure]:
    return list(model_figures.draw())


def _clouds(samples: int, seed: int) -> list[Figure]:
    return list(cloud_figures.draw(samples, seed))


def _pairs(pairs: Sequence[Pair]) -> list[Figure]:
    return list(pair_figures.draw(pairs))


def write_figures(figures: Sequence[Figure], folder: Path) -> None:
    """Write each figure as SVG and as PNG.

    Args:
        figures: drawn. folder: made if it is not there.

    Raises:
        FileError: the folder or a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(folder, f"cannot be made: {error.strerror}", "Choose another place with --out") from error
    for figure in figures:
        write_atomically(folder / f"{figure.name}.svg", figure.svg.encode())
        write_atomically(folder / f"{figure.name}.png", figure.png)
