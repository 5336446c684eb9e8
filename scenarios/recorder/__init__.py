"""Recordings for the Rerun viewer.

Only this package imports rerun, and only when a recording is made or looked at.

Read `stream` (one file being written), then `flight_recorder` and `flight_drawing` (one flight, while it flies), then
`comparison` (all candidates of a run over each other, with their `spread`); `blueprints` and `compare_layout` lay
them out, `body` draws the vehicle, `live` shows a flight meanwhile, `screenshot` looks at recordings.
"""

from scenarios.recorder.flight_recorder import FlightRecorder

__all__ = ["FlightRecorder"]
