"""One flight as a Rerun recording, streamed while it flies."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scenarios.recorder import blueprints
from scenarios.recorder.blueprints import BEFORE_S, LIMIT, MEASURED, PALETTE, SETPOINT, Page
from scenarios.recorder.body import BodyView, RotorPlace
from scenarios.recorder.stream import Colour, Recording

if TYPE_CHECKING:
    from scenarios.flight import Segment

APPLICATION_ID = "froude"
ROWS_PER_CHUNK = 500
LIVE_ROWS_PER_CHUNK = 50
DEG = 180.0 / math.pi
MOTORS = 8
"""As many as the telemetry has columns for; further ones are not drawn."""
_NOTHING_YET = -2

Columns = Mapping[str, NDArray[Any]]

_LEVELS = ("CRITICAL", "CRITICAL", "CRITICAL", "ERROR", "WARN", "INFO", "INFO", "DEBUG")
"""Rerun's level of each MAV_SEVERITY."""


@dataclass(frozen=True)
class Plot:
    """Telemetry columns drawn as the lines of one entity.

    Attributes:
        entity: path in the recording.
        lines: telemetry column -> (name in the legend, with unit; colour).
        factor: telemetry's unit to the shown one.
    """

    entity: str
    lines: Mapping[str, tuple[str, Colour]]
    factor: float = 1.0


def _pair(entity: str, name: str, unit: str, setpoint: str, measured: str, factor: float = 1.0) -> Plot:
    lines = {setpoint: (f"{name} set-point [{unit}]", SETPOINT), measured: (f"{name} [{unit}]", MEASURED)}
    return Plot(entity, lines, factor)


PLOTS = (
    Plot(
        "/roll",
        {
            "phi_sp_rad": ("roll set-point [deg]", SETPOINT),
            "phi_rad": ("roll [deg]", MEASURED),
            "phi_true_rad": ("roll, true [deg]", PALETTE[2]),
        },
        DEG,
    ),
    _pair("/roll_rate", "p", "rad/s", "p_sp_rad_s", "p_rad_s"),
    _pair("/pitch", "pitch", "deg", "theta_sp_rad", "theta_rad", DEG),
    Plot("/pitch_rate", {"q_rad_s": ("q [rad/s]", PALETTE[1])}),
    Plot("/yaw_rate", {"r_rad_s": ("r [rad/s]", PALETTE[2])}),
    Plot(
        "/velocity",
        {
            "v_north_m_s": ("v north [m/s]", PALETTE[0]),
            "v_east_m_s": ("v east [m/s]", PALETTE[1]),
            "v_down_m_s": ("v down [m/s]", PALETTE[2]),
        },
    ),
)


class FlightRecorder:
    """Streams one flight into a `.rrd` file and, if asked, to viewers.

    The file grows under `<name>.partial.rrd` and gets its own name in `close`. A flight that dies leaves the
    partial file, which the viewer opens too, with all but the last chunk. As a context manager it abandons an
    unclosed file.

    Args:
        path: the finished file, `*.rrd`.
        name: of the recording, as the viewer lists it: the gain set.
        recording_id: unique among the recordings that are opened together.
        rotors: of the airframe, at least one, in motor order.
        application_id: the viewer keeps one layout per application id.
        live_port: also serve viewers: `rerun --connect rerun+http://127.0.0.1:<port>/proxy`.
        rows_per_chunk: telemetry rows written together; fewer are more live and slower. None: 500, or 50 when
            live.

    Raises:
        FileError: the file cannot be created, or the disk is nearly full.
        UsageError: the port is taken.
    """

    def __init__(
        self,
        path: Path,
        *,
        name: str,
        recording_id: str,
        rotors: Sequence[RotorPlace],
        application_id: str = APPLICATION_ID,
        live_port: int | None = None,
        rows_per_chunk: int | None = None,
    ) -> None:
        self._chunk = rows_per_chunk or (ROWS_PER_CHUNK if live_port is None else LIVE_ROWS_PER_CHUNK)
        self._extremes = roll_extremes(rotors)
        rotors = rotors[:MOTORS]
        self._motors = len(rotors)
        self._motor_colours = [PALETTE[n % len(PALETTE)] for n in range(self._motors)]
        self._waiting: list[Columns] = []
        self._waiting_rows = 0
        self._last_mode = _NOTHING_YET
        self._segments: list[Segment] = []
        self._shown: list[NDArray[np.float64]] = []
        self._recording: Recording | None = Recording(
            path, application_id=application_id, recording_id=recording_id, name=name, live_port=live_port
        )
        # A first layout, for live viewers and for a file that is never closed.
        self._recording.layout(blueprints.flight_blueprint((), None))
        self._style(self._recording)
        self._body = BodyView(self._recording, rotors, self._motor_colours)

    def __enter__(self) -> FlightRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.abandon()

    @property
    def recording(self) -> Recording:
        """The file; an error once it is closed."""
        if self._recording is None:
            raise ValueError("the recording is closed")
        return self._recording

    def append(self, batch: Columns) -> None:
        """Add telemetry rows.

        Args:
            batch: columns of `scenarios.telemetry.COLUMNS`, of equal length, later than everything before;
                `segment` is not used.
        """
        self._waiting.append(batch)
        self._waiting_rows += len(batch["t_s"])
        if self._waiting_rows >= self._chunk:
            self._write_waiting()

    def event(self, t_s: float, severity: int, text: str) -> None:
        """Add a line to the event log; severity as MAV_SEVERITY (0 emergency to 7 debug)."""
        self.recording.text("/events", t_s, _LEVELS[min(max(severity, 0), 7)], text)

    def segment(self, segment: Segment) -> None:
        """Mark a measured part of the flight; may be called as soon as its end is known."""
        self._segments.append(segment)

    def close(self, summary: str = "", properties: Mapping[str, Mapping[str, Any]] | None = None) -> Path:
        """Write what is left, the summary and the final layout, and give the file its name.

        Args:
            summary: markdown beside the plots: verdict, gains, metrics.
            properties: group -> name -> number or text, searchable in the viewer; None is left out.

        Returns:
            The finished file.

        Raises:
            FileError: not everything could be written; the partial file stays.
        """
        self._write_waiting()
        recording = self.recording
        self._write_segments(recording)
        if summary:
            recording.document("/summary", summary)
        recording.properties(properties or {})
        recording.layout(blueprints.flight_blueprint(*self._pages()))
        self._recording = None
        return recording.finish()

    def abandon(self) -> None:
        """Stop without finishing: the partial file keeps what was flown. Harmless after `close`."""
        if self._recording is None:
            return
        self._write_waiting()
        self._write_segments(self._recording)
        self._recording.abandon()
        self._recording = None

    def _style(self, recording: Recording) -> None:
        for plot in PLOTS:
            recording.style(plot.entity, *zip(*plot.lines.values(), strict=True))
        recording.style(
            "/delta_lat",
            ("most the motors can give [-]", "least [-]", "delta_lat [-]"),
            (LIMIT, LIMIT, MEASURED),
            widths=(1.0, 1.0, 1.5),
        )
        recording.style("/position", ("north [m]", "east [m]", "up [m]"), PALETTE[:3])
        recording.style("/motors", [f"motor {n + 1} [0..1]" for n in range(self._motors)], self._motor_colours)

    def _write_waiting(self) -> None:
        if not self._waiting_rows:
            return
        batches, self._waiting, self._waiting_rows = self._waiting, [], 0
        rows = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
        recording = self.recording
        time = np.asarray(rows["t_s"], dtype=np.float64)
        for plot in PLOTS:
            values = np.column_stack([rows[column] for column in plot.lines]).astype(np.float64)
            recording.lines(plot.entity, time, values * plot.factor)
        most, least = roll_room(np.asarray(rows["thrust_sp"], dtype=np.float64), self._extremes)
        recording.lines("/delta_lat", time, np.column_stack([most, least, rows["delta_lat"]]))
        enu = np.column_stack([rows["east_m"], rows["north_m"], -rows["down_m"]]).astype(np.float64)
        recording.lines("/position", time, enu[:, (1, 0, 2)])
        motors = np.column_stack([rows[f"motor{n + 1}"] for n in range(self._motors)]).astype(np.float64)
        recording.lines("/motors", time, motors)
        self._body.rows(time, rows, enu, motors)
        # -1 for every disarmed row: on the ground the mode says little, that it is disarmed says all.
        modes = np.where(np.asarray(rows["armed"], dtype=bool), rows["nav_state"], -1).astype(np.int64)
        before = np.concatenate([[self._last_mode], modes[:-1]])
        for row in np.flatnonzero(modes != before):
            recording.lane("/state/mode", float(time[row]), mode_name(int(modes[row])))
        self._last_mode = int(modes[-1])
        self._shown.append(
            np.column_stack(
                [time, rows["phi_sp_rad"] * DEG, rows["phi_rad"] * DEG, np.abs(rows["delta_lat"]), most]
            ).astype(np.float64)
        )

    def _write_segments(self, recording: Recording) -> None:
        """A lane of what is measured: a segment that begins where another ends takes its place."""
        starts = {segment.start_s for segment in self._segments}
        for segment in self._segments:
            recording.lane("/state/manoeuvre", segment.start_s, segment.name)
            if segment.end_s not in starts:
                recording.lane("/state/manoeuvre", segment.end_s, "")

    def _pages(self) -> tuple[list[Page], Page | None]:
        """A page for each manoeuvre, and one for the whole flight."""
        if not self._shown:
            return [], None
        rows = np.concatenate(self._shown)
        pages = []
        for manoeuvre in dict.fromkeys(segment.manoeuvre for segment in self._segments):
            parts = [segment for segment in self._segments if segment.manoeuvre == manoeuvre]
            start, end = parts[0].start_s, parts[-1].end_s
            within = rows[(rows[:, 0] >= start) & (rows[:, 0] <= end)]
            if not len(within):
                continue
            peak, room = float(np.max(np.nan_to_num(within[:, 3]))), float(np.median(within[:, 4]))
            pages.append(
                Page(
                    manoeuvre,
                    start - BEFORE_S,
                    end,
                    roll_deg=blueprints.roll_range_deg(within[:, 1], within[:, 2], spans=2.0),
                    # A gentle set uses a fraction of what there is; its limits would leave a flat line to
                    # look at.
                    delta_lat=(-1.3 * peak, 1.3 * peak) if 0.0 < peak < 0.4 * room else None,
                    delta_lat_room=room,
                )
            )
        return pages, Page("Whole flight", float(rows[0, 0]), float(rows[-1, 0]))


def mode_name(nav_state: int) -> str:
    """Name of PX4's flight mode, or its number if the vehicle here has no such mode; -1 is "Disarmed"."""
    from sitl.modes import MODE_NAMES, Mode

    if nav_state == -1:
        return "Disarmed"
    try:
        return MODE_NAMES[Mode(nav_state)]
    except ValueError:
        return f"nav_state {nav_state}"


def roll_extremes(rotors: Sequence[RotorPlace]) -> tuple[float, float]:
    """Largest positive and negative entry, as magnitudes, of the roll column of PX4's normalised mix."""
    from sitl.actuators import RotorEffect, normalised_mix

    effects = [RotorEffect((rotor.px_m, rotor.py_m, rotor.pz_m), km=rotor.km) for rotor in rotors]
    column = normalised_mix(effects).columns[:, 0]
    return float(column.max()), float(-column.min())


def roll_room(
    thrust: NDArray[np.float64], extremes: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How much delta_lat the motors can give at a collective thrust, the other axes quiet.

    Motors stay within 0 to 1, and PX4 without airmode may lower the collective thrust for roll but not raise
    it (sequential desaturation). With a and b the mix's extremes, delta_lat <= min(thrust / b, 1 / (a + b)),
    and the other way round with a and b exchanged.

    Args:
        thrust: (n,) collective thrust set-point, 0 to 1.
        extremes: of `roll_extremes`.

    Returns:
        The largest and the smallest delta_lat, (n,) each.
    """
    a, b = extremes
    both = 1.0 / (a + b)
    return np.minimum(thrust / b, both), -np.minimum(thrust / a, both)
