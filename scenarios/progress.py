"""A progress bar for a run, on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scenarios.runner import Progress


class RunWatch:
    """Hands progress on and knows how far a run is.

    Args:
        begin: called once, when everything was found in order and the first flight begins.

    Attributes:
        show: where progress goes.
        touched: a vehicle has been asked to change something.
    """

    def __init__(self, begin: Callable[[], object]) -> None:
        self.show: Callable[[Progress], object] = lambda _: None
        self.touched = False
        self._begin: Callable[[], object] | None = begin

    def __call__(self, now: Progress) -> None:
        """Take the callback of `run_scenario`."""
        if self._begin is not None:
            begin, self._begin = self._begin, None
            begin()
        self.touched = self.touched or now.phase != "connect"
        self.show(now)


@contextmanager
def progress_bar() -> Iterator[Callable[[Progress], object]]:
    """Yields the callback of `run_scenario`; the bar vanishes when the run is over."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    bar = Bar(
        TextColumn("{task.description:<24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[phase]}"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    with bar:
        task = bar.add_task("getting ready", total=None, phase="the first time compiles the laws: half a minute")

        def show(progress: Progress) -> None:
            bar.update(
                task,
                description=progress.name,
                completed=progress.index,
                total=progress.count,
                phase=progress.phase,
            )

        yield show


@contextmanager
def spinner() -> Iterator[Callable[[str], object]]:
    """Yields a callback for what is being done: a line that moves on a terminal, nothing elsewhere."""
    import sys

    from rich.console import Console

    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda _: None
        return
    with Console(stderr=True).status("getting ready") as status:
        yield lambda text: status.update(text)
