"""How a recording is laid out in the Rerun viewer: one page per manoeuvre, then everything, then 3D.

The viewer knows no units, axis titles or reference lines: units stand in the names, limits are lines of their
own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenarios.recorder.body import PLACE
from scenarios.recorder.stream import TIMELINE, Colour

BEFORE_S = 1.0
"""Time shown before a manoeuvre; none after it, where another flight mode has other set-points."""

# Okabe and Ito's palette without black: eight hues that stay apart for colour-blind eyes, on dark and light
# ground.
PALETTE: tuple[Colour, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (240, 228, 66),
    (213, 94, 0),
    (0, 114, 178),
    (170, 170, 255),
)
RANKS: Mapping[str, float] = {"oscillates": 1.0, "failed": 1.5, "passed": 2.0, "best": 3.0}
"""Line width of each rank of a candidate, from the least to the first; later ones are drawn on top."""

SETPOINT: Colour = (235, 235, 235)
LIMIT: Colour = (150, 150, 150)
TRUTH: Colour = (90, 110, 60)
TWIN_WIDTH = 1.0
"""Line width of our own autopilot's response, drawn on top of a real one's."""
MEASURED: Colour = PALETTE[0]


@dataclass(frozen=True)
class Page:
    """One manoeuvre's page.

    Attributes:
        name: the tab's title.
        start_s: left edge of its time axes on the recording's timeline, s.
        end_s: right edge, s.
        roll_deg: lowest and highest roll angle to show, deg; here and below None leaves it to the viewer.
        rate_rad_s: the same for roll rates.
        error_deg: the same for errors.
        delta_lat: the same for the roll torque.
        delta_lat_room: the most that the motors can give, for the title.
        tracking: show errors instead of rates.
    """

    name: str
    start_s: float
    end_s: float
    roll_deg: tuple[float, float] | None = None
    rate_rad_s: tuple[float, float] | None = None
    error_deg: tuple[float, float] | None = None
    delta_lat: tuple[float, float] | None = None
    delta_lat_room: float | None = None
    tracking: bool = False


def candidate_colour(index: int, rank: str) -> tuple[int, int, int, int]:
    """Colour and opacity of candidate `index`.

    Args:
        index: its place in the run.
        rank: one of `RANKS`; what failed is greyer, and what oscillates is see-through as well, since it
            would paint the plots full.
    """
    grey, opacity = {"oscillates": (0.5, 150), "failed": (0.3, 255)}.get(rank, (0.0, 255))
    red, green, blue = (round((1.0 - grey) * channel + grey * 110) for channel in PALETTE[index % len(PALETTE)])
    return red, green, blue, opacity


def twin_colour(index: int, rank: str) -> tuple[int, int, int, int]:
    """The same hue, lighter: candidate `index` flown by our own autopilot beside a real one.

    Args:
        index: its place in the run. rank: as for `candidate_colour`, of the real one's flight.
    """
    red, green, blue, opacity = candidate_colour(index, rank)
    red, green, blue = (round(channel + 0.55 * (255 - channel)) for channel in (red, green, blue))
    return red, green, blue, opacity


def roll_range_deg(
    phi_sp_deg: NDArray[np.float64], phi_deg: NDArray[np.float64], spans: float
) -> tuple[float, float] | None:
    """Roll axis on which a response that runs far away does not make the set-point invisible.

    Args:
        phi_sp_deg: roll set-point over the page, deg.
        phi_deg: roll over the page, deg; NaN where unknown.
        spans: how far beyond the set-point's lowest and highest value to show, in spans of the set-point.

    Returns:
        The axis; None when the response stays inside it or nothing was asked of it.
    """
    known = phi_deg[np.isfinite(phi_deg)]
    asked = phi_sp_deg[np.isfinite(phi_sp_deg)]
    if not asked.size or not known.size:
        return None
    low, high = float(np.min(asked)), float(np.max(asked))
    margin = spans * (high - low)
    if margin <= 0.0 or (np.min(known) >= low - margin and np.max(known) <= high + margin):
        return None
    return low - margin, high + margin


def wide_range(*values: NDArray[np.float64]) -> tuple[float, float] | None:
    """An axis with some room for all of them; None if nothing is known or all is the same.

    Args:
        values: of the lines; NaN where unknown.
    """
    known = np.concatenate([one[np.isfinite(one)] for one in values])
    if not known.size or known.max() <= known.min():
        return None
    room = 0.08 * float(known.max() - known.min())
    return float(known.min()) - room, float(known.max()) + room


def series(
    name: str,
    entity: str | Sequence[str],
    page: Page | None = None,
    y: tuple[float, float] | None = None,
    legend: bool = True,
    right: bool = True,
) -> Any:
    """A plot of one or several entities over the page's time; the left, where a step begins, is no place for names."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        name=name,
        origin="/",
        contents=[entity] if isinstance(entity, str) else list(entity),
        axis_x=_time_axis(page),
        axis_y=None if y is None else rrb.ScalarAxis(range=y),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop if right else rrb.Corner2D.LeftTop, visible=legend),
    )


@lru_cache(maxsize=32)
def _time_axis(page: Page | None) -> Any:
    """Kept, because many plots of a page have the same, and it takes long to make."""
    import rerun as rr
    import rerun.blueprint as rrb

    if page is None:
        return rrb.TimeAxis(link="LinkToGlobal")
    return rrb.TimeAxis(
        view_range=rr.TimeRange(
            start=rrb.TimeRangeBoundary.absolute(seconds=page.start_s),
            end=rrb.TimeRangeBoundary.absolute(seconds=page.end_s),
        )
    )


def _lanes(page: Page | None = None) -> Any:
    import rerun.blueprint as rrb

    return rrb.StateTimelineView(
        name="Manoeuvre, flight mode, motors at a limit, faults", origin="/state", time_view=_time_axis(page)
    )


def _events() -> Any:
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import TextLogColumn

    columns = [TextLogColumn("EntityPath", visible=False), TextLogColumn("LogLevel"), TextLogColumn("Body")]
    return rrb.TextLogView(name="Events", origin="/events", columns=rrb.TextLogColumns(text_log_columns=columns))


def tabbed(tabs: Sequence[Any], first: Page | None) -> Any:
    """Tabs with every panel out of the way, and the time cursor at the first page."""
    import rerun.blueprint as rrb
    from rerun.encodings import AbsoluteTimeRange

    selection = None
    if first is not None:
        # The viewer has no setting for the cursor itself; it stays within a looped selection.
        selection = AbsoluteTimeRange(round(first.start_s * 1e9), round(first.end_s * 1e9))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline=TIMELINE,
            play_state="paused",
            time_selection=selection,
            loop_mode=None if selection is None else "selection",
        ),
        auto_views=False,
        auto_layout=False,
    )


def flight_blueprint(pages: Sequence[Page], whole: Page | None) -> Any:
    """Layout of one flight: a tab per manoeuvre, then the whole flight, then 3D.

    Args:
        pages: the manoeuvres flown, in order; may be empty.
        whole: the whole flight; None while it is not known how long it is.
    """
    tabs = [_manoeuvre(page) for page in pages]
    first = pages[0] if pages else None
    return tabbed([*tabs, _whole_flight(whole), _space(first or whole), _link(whole)], first)


def unfinished_blueprint() -> Any:
    """Layout of a flight whose recording was never finished: little, but enough to look at."""
    import rerun.blueprint as rrb

    plots = rrb.Vertical(series("Roll angle [deg]", "/roll"), series("Motor commands [0..1]", "/motors"), _lanes())
    return tabbed([rrb.Horizontal(plots, _events(), column_shares=[2.4, 1.0], name="Unfinished flight")], None)


def _manoeuvre(page: Page) -> Any:
    import rerun.blueprint as rrb

    plots = rrb.Vertical(
        series("Roll angle [deg]", "/roll", page, page.roll_deg),
        series("Roll rate p [rad/s]", "/roll_rate", page),
        series("Terms of the roll rate loop [-], reconstructed", "/roll_rate_terms", page),
        rrb.Horizontal(
            series(
                f"Roll torque delta_lat [-]; the motors can give {page.delta_lat_room or 1.0:.2f}",
                "/delta_lat",
                page,
                page.delta_lat,
            ),
            series("Motor commands [0..1]", "/motors", page, (-0.03, 1.03)),
        ),
        _lanes(page),
        row_shares=[3.5, 2.3, 3.0, 2.4, 2.9],
    )
    return rrb.Horizontal(plots, _verdict_and_events(), column_shares=[2.4, 1.0], name=page.name)


def _whole_flight(page: Page | None) -> Any:
    import rerun.blueprint as rrb

    plots = rrb.Vertical(
        series("Roll angle [deg]", "/roll", page),
        rrb.Horizontal(series("Pitch angle [deg]", "/pitch", page), series("Heading [deg]", "/heading", page)),
        rrb.Horizontal(
            series("Roll rate p [rad/s]", "/roll_rate", page, legend=False),
            series("Pitch rate q [rad/s]", "/pitch_rate", page, legend=False),
            series("Yaw rate r [rad/s]", "/yaw_rate", page, legend=False),
        ),
        series("Motor commands [0..1]", "/motors", page, (-0.03, 1.03)),
        rrb.Horizontal(series("Position [m]", "/position", page), series("Velocity [m/s]", "/velocity", page)),
        _lanes(page),
        row_shares=[2.5, 2.0, 2.5, 2.0, 2.5, 2.0],
    )
    return rrb.Horizontal(plots, _verdict_and_events(), column_shares=[2.4, 1.0], name="Whole flight")


def _verdict_and_events() -> Any:
    import rerun.blueprint as rrb

    return rrb.Vertical(rrb.TextDocumentView(name="Verdict", origin="/summary"), _events(), row_shares=[2.5, 1.0])


def _space(page: Page | None) -> Any:
    import rerun.blueprint as rrb

    view = rrb.Spatial3DView(
        name="East, north, up [m]; arrows: motor commands; squares on the ground: 1 m",
        origin=PLACE,
        contents="/world/**",
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            position=(-0.35, -0.6, 0.3), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
        ),
    )
    plots = rrb.Vertical(
        series("Roll angle [deg]", "/roll", page),
        series("Motor commands [0..1]", "/motors", page, (-0.03, 1.03)),
        _lanes(page),
        row_shares=[3.0, 3.0, 1.5],
    )
    return rrb.Horizontal(view, plots, column_shares=[1.6, 1.0], name="3D")


def _link(page: Page | None) -> Any:
    import rerun.blueprint as rrb

    plots = rrb.Vertical(
        series("Time between two rows of telemetry [ms]", "/link/interval", page),
        series("Messages lost, late, damaged since the link was opened", "/link/messages", page, right=False),
        _lanes(page),
        row_shares=[2.0, 2.0, 1.5],
    )
    page_ = rrb.TextDocumentView(name="Link", origin="/link_page")
    return rrb.Horizontal(plots, page_, column_shares=[2.0, 1.0], name="Link")
