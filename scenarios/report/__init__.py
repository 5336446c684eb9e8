"""The report of a run: `report.html` in its folder, one file that needs nothing else.

    write_report(Path("logs/20261122T200000Z_demo_ANT-X"))

`page.py` puts it together, `verdict.py` says what it comes to, `flown_sections.py` and `computed_sections.py` fill it
with tables and with the drawings of the `*_figures.py`; `computed.py` computes the loop and the uncertain models.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scenarios.report.computed import Done

__all__ = ["write_report"]


def write_report(folder: Path, done: Done | None = None, *, threads: int | None = None) -> Path:
    """Write a run's report from what is on disk.

    Args:
        folder: of the run. done: what has been computed already. threads: for the uncertain models; None takes all
            cores.

    Returns:
        the page's path.

    Raises:
        FileError: there is no run, or the page cannot be written; an earlier page is kept.
    """
    from scenarios.report.page import report_page
    from scenarios.run_folder import write_atomically
    from scenarios.run_reader import read_run

    run = read_run(folder)
    write_atomically(run.report, report_page(run, done, threads=threads).encode("utf-8", "replace"))
    return run.report
