"""What a recording says of its flight besides the curves: name, verdict, metrics, gains, texts.

For runs whose `run.json` was never written. A recording that was not finished has what was logged until then.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scenarios.recorder.recording_end import whole_recording
from sitl.errors import FileError

PROPERTIES = "/__properties"
EVENTS = "/events"


@dataclass(frozen=True)
class RecordedFacts:
    """Facts of one recording.

    Attributes:
        name: as the viewer lists it; empty if not known.
        properties: group (`verdict`, `metrics`, `gains`) -> name -> number or text.
        events: (vehicle time in s, level, text), in order of time; the level is one of Rerun's words.
    """

    name: str = ""
    properties: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    events: tuple[tuple[float, str, str], ...] = ()


def recorded_facts(rrd: Path) -> RecordedFacts:
    """Read a recording's facts, a tenth of a second for a minute of flight.

    Args:
        rrd: a flight's recording, perhaps one that was not finished.

    Raises:
        FileError: it cannot be read.
    """
    try:
        with whole_recording(rrd) as whole, silence():
            return _read(whole)
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise _unreadable(rrd, error) from error
    except BaseException as error:
        # a panic of Rerun's reader is no Exception
        if type(error).__name__ != "PanicException":
            raise
        raise _unreadable(rrd, error) from error


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """What Rerun's reader writes to the error output itself, a screen of it for a damaged file, goes nowhere."""
    try:
        kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:  # there is no error output
        yield
        return
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _unreadable(rrd: Path, error: BaseException) -> FileError:
    # Rerun's text begins with a file's name, which stands in front already
    problem = (str(error).splitlines() or [type(error).__name__])[0].rpartition(f"{rrd.name}: ")[2]
    return FileError(rrd, f"cannot be read as a Rerun recording: {problem}", "Its .tlog has the same flight")


def _read(rrd: Path) -> RecordedFacts:
    import rerun as rr

    name = ""
    properties: dict[str, dict[str, Any]] = {}
    events: list[tuple[float, str, str]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the file has no end is no news to whoever reads a killed flight
        chunks = rr.chunk.RrdReader(str(rrd)).stream()
    for chunk in chunks:
        path = str(chunk.entity_path)
        if path != EVENTS and not path.startswith(PROPERTIES):
            continue
        batch = chunk.to_record_batch()
        columns = {column: batch.column(column).to_pylist() for column in batch.schema.names}
        if path == EVENTS:
            # the time index is in nanoseconds, whatever Arrow makes of it
            times = [0.0 if time is None else time.total_seconds() for time in columns.get("flight_time", ())]
            told = zip(times, columns["TextLog:level"], columns["TextLog:text"], strict=False)
            events += [(time, level[0] if level else "", text[0]) for time, level, text in told if text]
        elif path == PROPERTIES:
            name = _single(columns.get("RecordingInfo:name")) or name
        else:
            known = {key: _single(values) for key, values in columns.items() if not key.startswith("rerun.")}
            properties.setdefault(path.rpartition("/")[2], {}).update(known)
    return RecordedFacts(name, properties, tuple(sorted(events)))


def _single(values: list[Any] | None) -> Any:
    return values[0][0] if values and values[0] else None
