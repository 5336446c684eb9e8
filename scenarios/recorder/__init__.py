"""Recordings for the Rerun viewer.

Only this package imports rerun, and only when a recording is made or looked at.

Read `stream` (one file being written), then `flight_recorder` (one flight, while it flies), then `comparison`
(all candidates of a run over each other); `blueprints` lays them out, `body` draws the vehicle, `screenshot`
looks at them.
"""

from scenarios.recorder.flight_recorder import FlightRecorder

__all__ = ["FlightRecorder"]
