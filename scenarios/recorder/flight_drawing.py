"""One flight drawn into a recording, row by row: plots, lanes, events, the vehicle in space, the link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scenarios.recorder import blueprints
from scenarios.recorder.blueprints import BEFORE_S, LIMIT, MEASURED, PALETTE, Page
from scenarios.recorder.body import BodyView, RotorPlace
from scenarios.recorder.flight_plots import (
    DEG,
    PLOTS,
    TERM_LINES,
    Columns,
    mode_name,
    roll_extremes,
    roll_room,
    saturation,
)
from scenarios.recorder.link_lines import LINK_COLOURS, LINK_NAMES, LinkCounts
from scenarios.recorder.stream import Recording

if TYPE_CHECKING:
    from scenarios.flight import Segment
    from sitl.rate_terms import RateTerms, TermRows

MOTORS = 8
"""As many as the telemetry has columns for; further ones are not drawn."""
IDLE = 0.05
"""Collective thrust of a vehicle that stands on the ground."""
_NOTHING_YET = -2

_LEVELS = ("CRITICAL", "CRITICAL", "CRITICAL", "ERROR", "WARN", "INFO", "INFO", "DEBUG")
"""Rerun's level of each MAV_SEVERITY."""


@dataclass(frozen=True)
class FlownVehicle:
    """What a drawing needs to know of the vehicle; plain data.

    Attributes:
        rotors: of the airframe, at least one, in motor order.
        frame_m: length, width and height of the body, m; zeros if not known.
        settings: (1,) of CONTROL_SETTINGS as flown, at the telemetry's rate: for the terms of the roll rate loop. None
            leaves them out.
    """

    rotors: Sequence[RotorPlace]
    frame_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    settings: NDArray[np.void] | None = field(default=None, compare=False)


class FlightDrawing:
    """Draws one flight.

    Args:
        recording: where to. vehicle: what flies. live: somebody looks on while it flies.
    """

    def __init__(self, recording: Recording, vehicle: FlownVehicle, *, live: bool = False) -> None:
        self.recording = recording
        rotors = vehicle.rotors
        self._extremes = roll_extremes(rotors)
        rotors = rotors[:MOTORS]
        self._motors = len(rotors)
        self._motor_colours = [PALETTE[n % len(PALETTE)] for n in range(self._motors)]
        self._terms: RateTerms | None = None
        if vehicle.settings is not None:
            from sitl.rate_terms import RateTerms

            self._terms = RateTerms(vehicle.settings)
        self._last_mode = _NOTHING_YET
        self._last_saturation = ""
        self._last_s = np.nan
        self._segments: list[Segment] = []
        self._shown: list[NDArray[np.float64]] = []
        self._counted: list[tuple[float, LinkCounts]] = []
        # A first layout: the final one, which a file gets at its end, takes as long as seconds of flying.
        recording.layout(blueprints.flight_blueprint((), None) if live else blueprints.unfinished_blueprint())
        self._style()
        self._body = BodyView(recording, rotors, self._motor_colours, vehicle.frame_m)

    def rows(self, rows: Columns) -> None:
        """Draw telemetry rows.

        Args:
            rows: columns of `scenarios.telemetry.COLUMNS`, of equal length above 0, later than everything before;
                `segment` is not used.
        """
        recording = self.recording
        self._write_counted()
        time = np.asarray(rows["t_s"], dtype=np.float64)
        for plot in PLOTS:
            values = np.column_stack([rows[line.column] for line in plot.lines]).astype(np.float64)
            recording.lines(plot.entity, time, values * plot.factor)
        most, least = roll_room(np.asarray(rows["thrust_sp"], dtype=np.float64), self._extremes)
        recording.lines("/delta_lat", time, np.column_stack([most, least, rows["delta_lat"]]))
        enu = np.column_stack([rows["east_m"], rows["north_m"], -rows["down_m"]]).astype(np.float64)
        recording.lines("/position", time, enu[:, (1, 0, 2)])
        motors = np.column_stack([rows[f"motor{n + 1}"] for n in range(self._motors)]).astype(np.float64)
        recording.lines("/motors", time, motors)
        recording.lines("/link/interval", time, 1e3 * np.diff(time, prepend=self._last_s))
        self._last_s = float(time[-1])
        self._body.rows(time, rows, enu, motors)
        self._lanes(time, rows, motors)
        if self._terms is not None:
            self._write_terms(self._terms.push(rows, np.isfinite(rows["phi_true_rad"])))
        self._shown.append(
            np.column_stack(
                [time, rows["phi_sp_rad"] * DEG, rows["phi_rad"] * DEG, np.abs(rows["delta_lat"]), most]
            ).astype(np.float64)
        )

    def event(self, t_s: float, severity: int, text: str) -> None:
        """Add a line to the event log; severity as MAV_SEVERITY (0 emergency to 7 debug)."""
        self.recording.text("/events", t_s, _LEVELS[min(max(severity, 0), 7)], text)

    def segment(self, segment: Segment) -> None:
        """Mark a measured part of the flight."""
        self._segments.append(segment)

    def faults(self, t_s: float, text: str) -> None:
        """Mark which faults are in force from a vehicle time on; empty for none."""
        self.recording.lane("/state/fault", t_s, text)

    def link(self, t_s: float, counts: LinkCounts) -> None:
        """What the link's counters say at a vehicle time, s; written with the next rows."""
        self._counted.append((t_s, counts))

    def end_rows(self) -> None:
        """Write what waits for further rows, and the segments."""
        self._write_counted()
        if self._terms is not None:
            self._write_terms(self._terms.finish())
        # A segment that begins where another ends takes its place.
        starts = {segment.start_s for segment in self._segments}
        states = [(segment.start_s, segment.name) for segment in self._segments]
        states += [(segment.end_s, "") for segment in self._segments if segment.end_s not in starts]
        if states:
            states.sort()
            self.recording.lanes("/state/manoeuvre", np.array([t for t, _ in states]), [state for _, state in states])

    def end(self, summary: str, link: str, properties: Mapping[str, Mapping[str, Any]]) -> None:
        """Write what belongs to the whole flight, and the final layout.

        Args:
            summary: markdown beside the plots: verdict, gains, metrics. link: markdown on the link.
            properties: group -> name -> number or text; None is left out.
        """
        self.end_rows()
        for entity, page in (("/summary", summary), ("/link_page", link)):
            if page:
                self.recording.document(entity, page)
        self.recording.properties(properties)
        self.recording.layout(blueprints.flight_blueprint(*self._pages()))

    def _style(self) -> None:
        recording = self.recording
        for plot in PLOTS:
            names, colours, widths = zip(*((line.name, line.colour, line.width) for line in plot.lines), strict=True)
            recording.style(plot.entity, names, colours, widths=widths)
        recording.style(
            "/delta_lat",
            ("most the motors can give [-]", "least [-]", "delta_lat [-]"),
            (LIMIT, LIMIT, MEASURED),
            widths=(1.0, 1.0, 1.5),
        )
        recording.style("/position", ("north [m]", "east [m]", "up [m]"), PALETTE[:3])
        recording.style("/motors", [f"motor {n + 1} [0..1]" for n in range(self._motors)], self._motor_colours)
        recording.style("/link/interval", ("between two rows of telemetry [ms]",), (MEASURED,))
        recording.style("/link/messages", LINK_NAMES, LINK_COLOURS, step=True)
        if self._terms is not None:
            recording.style(
                "/roll_rate_terms",
                [name for name, _, _ in TERM_LINES],
                [colour for _, colour, _ in TERM_LINES],
                widths=[width for _, _, width in TERM_LINES],
            )

    def _write_counted(self) -> None:
        if self._counted:
            times, counts = zip(*self._counted, strict=True)
            self._counted = []
            values = np.array([one.lines() for one in counts], dtype=np.float64)
            self.recording.lines("/link/messages", np.array(times), values)

    def _write_terms(self, done: TermRows) -> None:
        if len(done.t_s):
            values = np.column_stack([done.terms, done.terms.sum(axis=1)])
            self.recording.lines("/roll_rate_terms", done.t_s, values)

    def _lanes(self, time: NDArray[np.float64], rows: Columns, motors: NDArray[np.float64]) -> None:
        # -1 for every disarmed row: on the ground the mode says little, that it is disarmed says all.
        armed = np.asarray(rows["armed"], dtype=bool)
        modes = np.where(armed, rows["nav_state"], -1).astype(np.int64)
        changes = np.flatnonzero(modes != np.concatenate([[self._last_mode], modes[:-1]]))
        if len(changes):
            self.recording.lanes("/state/mode", time[changes], [mode_name(int(modes[row])) for row in changes])
        self._last_mode = int(modes[-1])
        # motors that stand still on the ground are no limit to anything
        flying = armed & ~(np.asarray(rows["thrust_sp"]) <= IDLE)
        states = saturation(time, np.where(flying[:, None], motors, np.nan))
        if states and states[0][1] == self._last_saturation:
            states = states[1:]
        if states:
            self.recording.lanes("/state/saturation", np.array([t for t, _ in states]), [state for _, state in states])
            self._last_saturation = states[-1][1]

    def _pages(self) -> tuple[list[Page], Page | None]:
        """A page for each manoeuvre, and one for the whole flight."""
        if not self._shown:
            return [], None
        rows = np.concatenate(self._shown)
        pages = []
        for manoeuvre in dict.fromkeys(segment.manoeuvre for segment in self._segments):
            parts = [segment for segment in self._segments if segment.manoeuvre == manoeuvre]
            start, end = parts[0].start_s, parts[-1].end_s
            within = rows[(rows[:, 0] >= start) & (rows[:, 0] < end)]
            if not len(within):
                continue
            peak, room = float(np.max(np.nan_to_num(within[:, 3]))), float(np.median(within[:, 4]))
            pages.append(
                Page(
                    manoeuvre,
                    start - BEFORE_S,
                    end,
                    # always given: at the right edge the next flight mode's set-point looks in
                    roll_deg=blueprints.roll_range_deg(within[:, 1], within[:, 2], spans=2.0)
                    or blueprints.wide_range(within[:, 1], within[:, 2]),
                    # A gentle set uses a fraction of what there is; its limits would leave a flat line to
                    # look at.
                    delta_lat=(-1.3 * peak, 1.3 * peak) if 0.0 < peak < 0.4 * room else None,
                    delta_lat_room=room,
                )
            )
        return pages, Page("Whole flight", float(rows[0, 0]), float(rows[-1, 0]))
