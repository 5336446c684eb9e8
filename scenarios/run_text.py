"""A list of runs, and what is wrong with one, as text for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scenarios.run_list import RunSummary

SCHEMA_VERSION = 1
_DASH = "–"


def printable(text: str) -> str:
    """A text of a file without what a terminal would obey: control characters become `?`."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)


def list_object(out: Path, runs: Sequence[RunSummary]) -> dict[str, Any]:
    """As plain data.

    Args:
        out: where the runs are kept. runs: as listed.
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "out": str(out),
        "runs": [
            {
                "run": run.folder.name,
                "folder": str(run.folder),
                "started_utc": run.started_utc or None,
                "scenario": run.scenario,
                "vehicle": run.vehicle,
                "autopilot": run.autopilot,
                "flown": run.flown,
                "verdicts": dict(run.verdicts),
                "best": run.best or None,
                "complete": run.complete,
                "problem": run.problem,
            }
            for run in runs
        ],
    }


def list_text(out: Path, runs: Sequence[RunSummary], left: int) -> str:
    """One line a run, the newest first.

    Args:
        out: where the runs are kept. runs: as listed. left: how many are not.
    """
    rows = [["started (UTC)", "scenario", "vehicle", "autopilot", "verdicts", "best", "state", f"run, in {out}"]]
    for run in runs:
        verdicts = " ".join(f"{number} {verdict}" for verdict, number in run.verdicts.items())
        state = "complete" if run.complete else run.problem or "interrupted"
        rows.append(
            [
                run.started_utc.replace("T", " ").removesuffix("Z") or _DASH,
                run.scenario or _DASH,
                run.vehicle or _DASH,
                run.autopilot or _DASH,
                verdicts or _DASH,
                run.best or _DASH,
                state,
                run.folder.name,
            ]
        )
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(widths[n]) for n, cell in enumerate(row)).rstrip() for row in rows]
    if left:
        lines.append(f"{left} older ones are not shown: --last {len(runs) + left} shows all.")
    return "\n".join(lines)
