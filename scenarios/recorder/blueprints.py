"""How a recording is laid out in the Rerun viewer: one page per manoeuvre, then everything, then 3D.

The viewer knows no units, axis titles or reference lines: units stand in the names, limits are lines of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenarios.recorder.stream import TIMELINE, Colour

BEFORE_S, AFTER_S = 1.0, 0.5
"""Time shown before and after a manoeuvre."""

# Okabe and Ito's palette without black: eight hues that stay apart for colour-blind eyes, on dark and light ground.
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
SETPOINT: Colour = (235, 235, 235)
LIMIT: Colour = (150, 150, 150)
MEASURED: Colour = PALETTE[0]


@dataclass(frozen=True)
class Page:
    """One manoeuvre's page.

    Attributes:
        name: the tab's title.
        start_s: left edge of its time axes on the recording's timeline, s.
        end_s: right edge, s.
        roll_deg: lowest and highest roll angle to show, deg; this and the next two: None leaves it to the viewer.
        rate_rad_s: the same for roll rates.
        error_deg: the same for errors.
        tracking: show errors instead of rates.
    """

    name: str
    start_s: float
    end_s: float
    roll_deg: tuple[float, float] | None = None
    rate_rad_s: tuple[float, float] | None = None
    error_deg: tuple[float, float] | None = None
    tracking: bool = False


def candidate_colour(index: int, passed: bool) -> Colour:
    """Colour of candidate `index`: its hue, mixed half with grey unless it passed."""
    hue = PALETTE[index % len(PALETTE)]
    if passed:
        return hue
    red, green, blue = (round(0.5 * channel + 0.5 * 110) for channel in hue)
    return red, green, blue


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


def _series(
    name: str, entity: str | Sequence[str], page: Page | None = None, y: tuple[float, float] | None = None
) -> Any:
    """A plot of one or several entities over the page's time."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        name=name,
        origin="/",
        contents=[entity] if isinstance(entity, str) else list(entity),
        axis_x=_time_axis(page),
        axis_y=None if y is None else rrb.ScalarAxis(range=y),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )


def _time_axis(page: Page | None) -> Any:
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
        name="Flight mode and manoeuvre", origin="/state", time_view=_time_axis(page)
    )


def _events() -> Any:
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import TextLogColumn

    columns = [TextLogColumn("EntityPath", visible=False), TextLogColumn("LogLevel"), TextLogColumn("Body")]
    return rrb.TextLogView(
        name="Events", origin="/events", columns=rrb.TextLogColumns(text_log_columns=columns)
    )


def _blueprint(tabs: Sequence[Any], first: Page | None) -> Any:
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


def flight_blueprint(pages: Sequence[Page]) -> Any:
    """Layout of one flight: a tab per manoeuvre, then the whole flight, then 3D.

    Args:
        pages: the manoeuvres flown, in order; may be empty.
    """
    tabs = [_manoeuvre(page) for page in pages]
    first = pages[0] if pages else None
    return _blueprint([*tabs, _whole_flight(), _space()], first)


def _manoeuvre(page: Page) -> Any:
    import rerun.blueprint as rrb

    plots = rrb.Vertical(
        _series("Roll angle [deg]", "/roll", page, page.roll_deg),
        _series("Roll rate p [rad/s]", "/roll_rate", page),
        _series("Roll torque delta_lat [-]; grey: the most the motors can give", "/delta_lat", page),
        _series("Motor commands [0..1]", "/motors", page, (-0.03, 1.03)),
        _lanes(page),
        row_shares=[4.0, 3.0, 2.5, 2.5, 2.0],
    )
    return rrb.Horizontal(plots, _verdict_and_events(), column_shares=[2.4, 1.0], name=page.name)


def _whole_flight() -> Any:
    import rerun.blueprint as rrb

    plots = rrb.Vertical(
        _series("Roll angle [deg]", "/roll"),
        _series("Pitch angle [deg]", "/pitch"),
        _series("Body rates p, q, r [rad/s]", ("/roll_rate", "/pitch_rate", "/yaw_rate")),
        _series("Motor commands [0..1]", "/motors", None, (-0.03, 1.03)),
        _series("Position [m]", "/position"),
        _lanes(),
        row_shares=[2.5, 2.0, 2.5, 2.0, 2.5, 2.0],
    )
    return rrb.Horizontal(plots, _verdict_and_events(), column_shares=[2.4, 1.0], name="Whole flight")


def _verdict_and_events() -> Any:
    import rerun.blueprint as rrb

    return rrb.Vertical(
        rrb.TextDocumentView(name="Verdict", origin="/summary"), _events(), row_shares=[2.5, 1.0]
    )


def _space() -> Any:
    import rerun.blueprint as rrb

    view = rrb.Spatial3DView(
        name="East, north, up [m]; arrows: motor commands",
        origin="/world",
        eye_controls=rrb.EyeControls3D(
            position=(-0.5, -0.9, 0.5),
            look_target=(0.0, 0.0, 0.0),
            eye_up=(0.0, 0.0, 1.0),
            tracking_entity="/world/body",
        ),
    )
    plots = rrb.Vertical(
        _series("Roll angle [deg]", "/roll"),
        _series("Motor commands [0..1]", "/motors", None, (-0.03, 1.03)),
        _lanes(),
        row_shares=[3.0, 3.0, 1.5],
    )
    return rrb.Horizontal(view, plots, column_shares=[1.6, 1.0], name="3D")


def compare_blueprint(pages: Sequence[tuple[str, Page]]) -> Any:
    """Layout of a comparison: a tab per manoeuvre with every candidate above the table, then the circumstances.

    Args:
        pages: (entity prefix, page) of each manoeuvre; the page's time counts from the manoeuvre's start.
    """
    import rerun.blueprint as rrb

    tabs = [
        rrb.Vertical(
            _series(f"{page.name}: roll angle [deg]", f"{prefix}/roll/**", page, page.roll_deg),
            rrb.Horizontal(
                _series("Roll error: set-point minus roll [deg]", f"{prefix}/error/**", page, page.error_deg)
                if page.tracking
                else _series("Roll rate p [rad/s]", f"{prefix}/roll_rate/**", page, page.rate_rad_s),
                _series("Roll torque delta_lat [-]", f"{prefix}/delta_lat/**", page),
            ),
            rrb.TextDocumentView(name="Verdicts", origin="/summary"),
            row_shares=[3.2, 1.8, 2.2],
            name=page.name,
        )
        for prefix, page in pages
    ]
    tabs.append(rrb.TextDocumentView(name="Vehicle, assumptions, gains", origin="/circumstances"))
    return _blueprint(tabs, pages[0][1] if pages else None)
