"""How a comparison is laid out: every candidate above the table, then their spread, then the circumstances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from scenarios.recorder.blueprints import Page, series, tabbed


@dataclass(frozen=True)
class ComparePage:
    """One manoeuvre.

    Attributes:
        prefix: of its entities. page: axes; time counts from the manoeuvre's start.
        bands: entities of the spread of candidates that do not oscillate.
        spread: there are bands, of whichever.
    """

    prefix: str
    page: Page
    bands: tuple[str, ...] = ()
    spread: bool = False


def compare_blueprint(pages: Sequence[ComparePage], verdict: str = "", *, twins: bool = False) -> Any:
    """A tab per manoeuvre with every candidate above the table, one of their spread, then the circumstances.

    Args:
        pages: of the manoeuvres. verdict: in a few words, above the plots.
        twins: there is a document on two autopilots, `/twins`.
    """
    import rerun.blueprint as rrb

    def lower(name: str, quantity: str, prefix: str, page: Page, y: tuple[float, float] | None) -> Any:
        # The colours are those of the plot above, whose legend is enough.
        return series(name, f"{prefix}/{quantity}/**", page, y, legend=False)

    tabs = []
    for one in pages:
        prefix, page = one.prefix, one.page
        tabs.append(
            rrb.Vertical(
                series(
                    f"{page.name}: roll angle [deg]. {verdict}",
                    (*one.bands, f"{prefix}/roll/**"),
                    page,
                    page.roll_deg,
                    right=False,
                ),
                rrb.Horizontal(
                    lower("Roll error: set-point minus roll [deg]", "error", prefix, page, page.error_deg)
                    if page.tracking
                    else lower("Roll rate p [rad/s]", "roll_rate", prefix, page, page.rate_rad_s),
                    lower("Roll torque delta_lat [-]", "delta_lat", prefix, page, page.delta_lat),
                ),
                rrb.TextDocumentView(name="Verdicts", origin="/summary"),
                row_shares=[3.2, 1.5, 2.3],
                name=page.name,
            )
        )
    for one in pages:
        if one.spread:
            name = f"{one.page.name}: roll angle [deg], 5 to 95 % of uncertain models, of every gain set"
            view = series(name, (f"{one.prefix}/spread/**", f"{one.prefix}/roll/**"), one.page, right=False)
            tabs.append(rrb.Vertical(view, name=f"{one.page.name}: spread"))
    if twins:
        tabs.append(rrb.TextDocumentView(name="Real and own autopilot", origin="/twins"))
    tabs.append(rrb.TextDocumentView(name="Vehicle, assumptions, gains", origin="/circumstances"))
    return tabbed(tabs, pages[0].page if pages else None)
