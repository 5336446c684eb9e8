"""The process that prepares a run's report while the run is flown, and writes it at the end.

It reads JSON lines: first what is known before the flights, then each flight that has landed, as in `run.json`, and at
last, if the run comes to an end, where its folder is:

    {"data": {...}, "sets": [{"name": "...", "baseline": false, "uploaded": {...}}, ...]}
    {"number": 0, "flight": {...}, "telemetry": "logs/.../flights/....parquet"}
    {"write": "logs/..."}

and answers with one line: `{"wrote": "..."}` or `{"failed": "..."}`. At the end of its input it ends, at once if it
was not asked to write.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sitl.errors import FroudeError

BEHIND = "--behind"
"""Word of the command line: where something flies in real time, the cores are its own first."""

if TYPE_CHECKING:
    from scenarios.report.computed import Computed
    from scenarios.report.windows import TrackTrace


def main() -> None:
    """Serve one run; told to, behind everything that flies."""
    if BEHIND in sys.argv[1:]:
        os.nice(10)
    told: queue.SimpleQueue[str] = queue.SimpleQueue()
    # read at once, so that who flies never waits for a pipe that is full
    threading.Thread(target=_listen, args=(told,), daemon=True).start()
    first = told.get()
    if not first.strip():
        return
    known = json.loads(first)
    done = prepare(known)
    flown = Flown(known["sets"])
    while (line := told.get()).strip():
        message = json.loads(line)
        if "write" in message:
            sys.stdout.write(json.dumps(_write(Path(message["write"]), done)) + "\n")
            return
        with suppress(FroudeError):  # telemetry that cannot be read: the page will say so
            flown.draw(message["number"], message["flight"], Path(message["telemetry"]))


def _listen(told: queue.SimpleQueue[str]) -> None:
    asked = False
    for line in sys.stdin:
        asked = asked or '"write"' in line[:10]
        told.put(line)
    if not asked:
        # the run was killed, or has nothing to show: what is being worked out, for many seconds yet, is for nobody
        os._exit(1)
    told.put("")


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
    # what only the writing needs is loaded by then
    import_module("scenarios.report.page").page_template()
    import_module("scenarios.run_reader")
    return done


class Flown:
    """Draws the steps and tracks of flights as they land; the figures keep what is drawn.

    Args:
        sets: of the first line.
    """

    def __init__(self, sets: Sequence[Mapping[str, Any]]) -> None:
        self._sets = sets
        self._flights: list[Mapping[str, Any]] = []
        self._tracks: dict[str, list[TrackTrace]] = {}

    def draw(self, number: int, flight: Mapping[str, Any], file: Path) -> None:
        """One flight.

        Args:
            number: in the order of the run. flight: as in run.json. file: its telemetry.

        Raises:
            FileError: it cannot be read.
        """
        from scenarios.report.elements import look_of
        from scenarios.report.flight_figures import step_figure, step_id, track_end_deg, track_figure, track_id
        from scenarios.report.flown_sections import MOST_SEGMENTS
        from scenarios.report.windows import segments_of, step_trace, track_trace
        from scenarios.telemetry import Telemetry

        name, style = look_of(number, self._sets[number]["name"], baseline=self._sets[number]["baseline"])
        telemetry, _ = Telemetry.from_parquet(file)
        self._flights.append(flight)
        for place, segment in enumerate(segments_of(self._flights, "step")[:MOST_SEGMENTS]):
            step = step_trace(flight, telemetry, segment)
            if step is not None:
                step_figure(step, style, name, step_id(place, number), None)
        for place, segment in enumerate(segments_of(self._flights, "track")[:MOST_SEGMENTS]):
            track = track_trace(flight, telemetry, segment)
            if track is not None:
                tracks = self._tracks.setdefault(segment, [])
                tracks.append(track)
                track_figure(track, style, name, track_id(place, number), track_end_deg(tracks))


def _write(folder: Path, done: Mapping[str, Computed]) -> dict[str, str]:
    from scenarios.report import write_report

    try:
        return {"wrote": str(write_report(folder, done, threads=None))}
    except FroudeError as error:
        return {"failed": str(error)}


if __name__ == "__main__":
    main()
