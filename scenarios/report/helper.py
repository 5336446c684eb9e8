"""The process that prepares a run's report while the run is flown, and writes it at the end.

It reads JSON lines: first what is known before the flights, then, if the run comes to an end, where its folder is:

    {"data": {...}, "sets": [{"name": "...", "baseline": false, "uploaded": {...}}, ...]}
    {"write": "logs/..."}

and answers with one line: `{"wrote": "..."}` or `{"failed": "..."}`. At the end of its input it ends.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.report.computed import Computed


def main() -> None:
    """Serve one run, behind everything that flies: a real autopilot and a board's plant need the cores first."""
    os.nice(10)
    first = sys.stdin.readline()
    if not first.strip():
        return
    done = prepare(json.loads(first))
    last = sys.stdin.readline()
    if not last.strip():
        return
    sys.stdout.write(json.dumps(_write(Path(json.loads(last)["write"]), done)) + "\n")


def prepare(known: Mapping[str, Any]) -> dict[str, Computed]:
    """Compute and draw what does not depend on the flights; the figures keep what is drawn.

    Args:
        known: the first line.
    """
    from scenarios.report.computed import compute, key_of
    from scenarios.report.computed_sections import draw_samples
    from scenarios.report.elements import look_of
    from scenarios.report.loop_figures import bode_figure
    from scenarios.report.sample_figures import Entry

    data, sets = known["data"], known["sets"]
    # one core is the flights'
    done = compute(data, [one["uploaded"] for one in sets], threads=1)
    entries = []
    for number, one in enumerate(sets):
        computed = done[key_of(data, one["uploaded"])]
        name, style = look_of(number, one["name"], baseline=one["baseline"])
        if computed.curves is not None:
            bode_figure(computed.curves, style, name, f"bode-{number}")
        if computed.samples is not None and not one["baseline"]:
            entries.append(Entry(name, style, computed.samples))
    if entries:
        draw_samples(tuple(entries), data)
    return done


def _write(folder: Path, done: Mapping[str, Computed]) -> dict[str, str]:
    from scenarios.report import write_report
    from sitl.errors import FroudeError

    try:
        return {"wrote": str(write_report(folder, done, threads=None))}
    except FroudeError as error:
        return {"failed": str(error)}


if __name__ == "__main__":
    main()
