"""Where the viewer's time cursor stands: a layout can select the first manoeuvre, but not put the cursor there.

So the viewer is told when it has the recording, by Rerun's `ViewerClient`. The page for browsers takes no such word.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import warnings
from pathlib import Path
from typing import Any, Final

from bridge.clock import WallClock
from scenarios.recorder.blueprints import BEFORE_S
from scenarios.recorder.recorded_facts import silence
from scenarios.recorder.stream import TIMELINE
from scenarios.recorder.viewer import HOST

INTO_S: Final = 0.1
"""Where a step is on its way."""

PORT: Final = 9876
"""Where a viewer with a window listens."""

PATIENCE_S = 20.0
"""A viewer that has not loaded a recording by then shows it from its beginning."""

_LOOK_S: Final = 0.2
_SELECTION: Final = "TimePanelBlueprint:time_selection"


def first_moment(rrd: Path) -> tuple[str, float] | None:
    """The recording's id and a moment into its first manoeuvre, s on its timeline; None if it has none.

    Args:
        rrd: a recording of ours.
    """
    import rerun as rr

    start_ns, ids = None, []
    try:
        with silence(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a killed flight's file has no end
            reader = rr.chunk.RrdReader(str(rrd))
            ids = [one.recording_id for one in reader.recordings()]
            for layout in reader.blueprints():
                for chunk in reader.stream(store=layout):
                    batch = chunk.to_record_batch()
                    if _SELECTION in batch.schema.names:
                        start_ns = batch.column(_SELECTION).to_pylist()[-1][0]["min"]
    except BaseException as error:
        # a panic of Rerun's reader is no Exception
        if not isinstance(error, RuntimeError | OSError | ValueError) and type(error).__name__ != "PanicException":
            raise
    return (ids[0], start_ns * 1e-9 + BEFORE_S + INTO_S) if ids and start_ns is not None else None


def put(viewer: Any, moment: tuple[str, float]) -> bool:
    """Put the cursor of a recording at a moment, if the viewer has loaded it.

    Args:
        viewer: Rerun's `ViewerClient`. moment: of `first_moment`.

    Returns:
        whether it has.
    """
    recording_id, at_s = moment
    state = viewer.get_state()
    store = next((one.store_id for one in state.recordings if one.store_id.endswith(f":{recording_id}")), None)
    if store is None or state.loading:
        return False
    viewer.set_time(TIMELINE, duration=at_s, play_state="paused", recording=store)
    return True


def put_when_loaded(rrd: Path, port: int = PORT) -> bool:
    """Put the cursor of a viewer's window at the first manoeuvre as soon as it has the recording.

    Args:
        rrd: what was opened in it. port: of the loopback, that it listens on.

    Returns:
        False if it cannot be told, or there is no manoeuvre.
    """
    moment = first_moment(rrd)
    if moment is None or not _listens(port):
        return False
    from rerun.experimental import ViewerClient

    pause, clock = threading.Event(), WallClock()
    until_us = clock.now_us() + round(1e6 * PATIENCE_S)
    viewer = ViewerClient(f"rerun+http://{HOST}:{port}/proxy")
    while clock.now_us() < until_us and _listens(port):
        # busy drawing, it may not answer in time
        with contextlib.suppress(RuntimeError, OSError, ValueError):
            if put(viewer, moment):
                return True
        pause.wait(_LOOK_S)
    return False


def _listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((HOST, port), 1.0):
        return True
    return False
