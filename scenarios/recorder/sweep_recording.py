"""A sweep in Rerun: candidates by their objectives, heat maps, the share that passes in each case, and the table.

The viewer has no plot over anything but time, so the scatter is drawn into a plane with axes of its own; a candidate
under the pointer tells its values.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenarios.markdown import markdown_table
from scenarios.recorder.blueprints import PALETTE
from scenarios.recorder.stream import Colour, FileRecording, Recording
from scenarios.report.canvas import ticks
from scenarios.sweep.pareto import Front
from scenarios.sweep.ranking import Ranking
from scenarios.sweep.sweep_figures import Ends, axis_label, axis_values, candidate_ends, drawable_of
from scenarios.sweep.sweep_text import choice, doubts, headline, most_failing, reason_lines, worst_text
from scenarios.sweep.sweep_words import objective_title, shown_objective

APPLICATION_ID = "froude-sweep"
"""The viewer keeps one layout per application id."""

WIDTH, HEIGHT = 1000.0, 620.0
"""Of the plane that candidates are drawn in."""
"""Negative radii are points of the screen instead, whatever the zoom."""
MOST_POINTS = 20_000
ROWS = 20
MARGIN: Colour = (150, 150, 150)
GRID: Colour = (70, 70, 70)
FAILS: Colour = (140, 140, 140)
BEST: Colour = (255, 255, 255)


def record_sweep(ranking: Ranking, front: Front, heats: Mapping[str, bytes], path: Path) -> Path:
    """Write a sweep's recording.

    Args:
        ranking, front: of the sweep, at least one candidate complete. heats: name of a heat map -> its PNG.
        path: `sweep.rrd`; replaced if it is there.

    Raises:
        FileError: it cannot be written.
    """
    sweep = ranking.sweep
    recording = FileRecording(
        path,
        application_id=APPLICATION_ID,
        recording_id=f"{sweep.path.name}-{sweep.facts['fingerprint'][:12]}",
        name=f"{sweep.name}: {headline(ranking)}",
    )
    _scatter(recording, ranking, front)
    _images(recording, heats)
    _bars(recording, ranking)
    recording.document("/summary", _summary(ranking))
    recording.document("/cases_page", _cases(ranking))
    recording.document("/swept", f"# {sweep.title}\n\n```toml\n{sweep.facts['text']}\n```\n")
    recording.properties({"sweep": _facts(ranking)})
    recording.layout(_blueprint(ranking, heats))
    return recording.finish()


def _scatter(recording: Recording, ranking: Ranking, front: Front) -> None:
    import rerun as rr

    x, y = axis_values(ranking, 0), axis_values(ranking, 1)
    ends = candidate_ends(ranking, front)
    inside = drawable_of(ranking) & ends[0].within(x) & ends[1].within(y)
    _axes(recording, ranking, ends)

    def points(name: str, numbers: NDArray[Any], colour: Colour, radius: float, labels: bool = False) -> None:
        if len(numbers) > MOST_POINTS:
            numbers = numbers[np.linspace(0, len(numbers) - 1, MOST_POINTS).astype(int)]
        where = np.column_stack([_place(x[numbers], ends[0], WIDTH), HEIGHT - _place(y[numbers], ends[1], HEIGHT)])
        told = [f"{candidate}" if labels else _told(ranking, candidate) for candidate in numbers.tolist()]
        look = {"colors": [colour], "radii": [-radius], "labels": told, "show_labels": labels}
        recording.log(f"/front/{name}", rr.Points2D(where, **look, draw_order=10.0 + radius))

    points("fails_somewhere", np.flatnonzero(inside & ~ranking.everywhere), FAILS, 2.0)
    points("passes_everywhere", np.flatnonzero(inside & ranking.everywhere), PALETTE[0], 3.0)
    points("pareto_front", front.candidates[inside[front.candidates]], PALETTE[1], 4.5)
    best = ranking.best
    if best is not None and inside[best]:
        points("winner" if ranking.everywhere[best] else "best", np.array([best]), BEST, 6.5, labels=True)


def _told(ranking: Ranking, candidate: int) -> str:
    values = ", ".join(f"{name} {value:.4g}" for name, value in ranking.values_of(candidate).items())
    return f"candidate {candidate}: {values}; {ranking.passed[candidate]} of {len(ranking.sweep.cases)} cases"


def _place(values: NDArray[np.float64], ends: Ends, length: float) -> NDArray[np.float64]:
    if ends.log:
        return np.asarray(np.log(values / ends.low) / np.log(ends.high / ends.low) * length)
    return np.asarray((values - ends.low) / (ends.high - ends.low) * length)


def _ticks(ends: Ends) -> list[float]:
    made = ticks(ends.low, ends.high, 6)
    if ends.log:
        decades = range(int(np.floor(np.log10(ends.low))), int(np.ceil(np.log10(ends.high))) + 1)
        made = [step * 10.0**decade for decade in decades for step in (1.0, 2.0, 5.0)]
    return [tick for tick in made if ends.low <= tick <= ends.high]


def _axes(recording: Recording, ranking: Ranking, ends: tuple[Ends, Ends]) -> None:
    import rerun as rr

    frame = [[0.0, 0.0], [0.0, HEIGHT], [WIDTH, HEIGHT]]
    lines, places, texts = [], [], []
    for tick in _ticks(ends[0]):
        at = float(_place(np.array(tick), ends[0], WIDTH))
        lines.append([[at, 0.0], [at, HEIGHT]])
        places.append([at, HEIGHT + 16.0])
        texts.append(f"{tick:g}")
    for tick in _ticks(ends[1]):
        at = HEIGHT - float(_place(np.array(tick), ends[1], HEIGHT))
        lines.append([[0.0, at], [WIDTH, at]])
        places.append([-26.0, at])
        texts.append(f"{tick:g}")
    places += [[0.5 * WIDTH, HEIGHT + 52.0], [0.5 * WIDTH, -26.0]]
    texts += [f"across: {axis_label(ranking, 0)}", f"up: {axis_label(ranking, 1)}"]
    recording.log("/front/axes/grid", rr.LineStrips2D(lines, colors=[GRID], radii=[-0.5]))
    recording.log("/front/axes/frame", rr.LineStrips2D([frame], colors=[MARGIN], radii=[-1.0]))
    names = rr.Points2D(places, labels=texts, colors=[MARGIN], radii=[-0.1], show_labels=True)
    recording.log("/front/axes/names", names)


def _images(recording: Recording, heats: Mapping[str, bytes]) -> None:
    import rerun as rr

    for name, png in heats.items():
        recording.log(f"/maps/{name}", rr.EncodedImage(contents=png, media_type="image/png"))


def _bars(recording: Recording, ranking: Ranking) -> None:
    import rerun as rr

    shares = [100.0 * case.passing / case.points if case.points else 0.0 for case in ranking.cases]
    # a bar begins at its abscissa
    left, width = np.arange(len(shares)) - 0.4, np.full(len(shares), 0.8)
    recording.log("/cases", rr.BarChart(np.array(shares), abscissa=left, widths=width, color=PALETTE[0]))


def _summary(ranking: Ranking) -> str:
    sweep = ranking.sweep
    head = ["rank", "candidate", "cases passed", "worst case", *(objective_title(one) for one in sweep.objectives)]
    head += [axis.name for axis in sweep.axes]
    rows = []
    for place, candidate in enumerate(ranking.order[:ROWS].tolist(), 1):
        row = [str(place), str(candidate)]
        row += [f"{ranking.passed[candidate]}/{len(sweep.cases)}", worst_text(ranking, candidate)]
        for k, one in enumerate(sweep.objectives):
            row.append(shown_objective(one, ranking.objective(candidate, k), unit=False))
        rows.append(row + [f"{value:.4g}" for value in ranking.values_of(candidate).values()])
    said = [f"## {headline(ranking)}", choice(ranking) + "."]
    said += [f"- {line}" for line in doubts(ranking, None)]
    said.append(markdown_table(head, rows, ()))
    said.append(
        "Orange: Pareto front. Blue: passes everywhere. Grey: fails somewhere. White: the candidate named above."
    )
    return "\n\n".join(said) + "\n"


def _cases(ranking: Ranking) -> str:
    rows = []
    for number, case in enumerate(ranking.cases):
        share = f"{100.0 * case.passing / case.points:.1f}" if case.points else "–"
        rows.append([str(number), case.name, f"{case.passing} of {case.points}", share, most_failing(case)])
    said = [
        "## Cases",
        markdown_table(("no.", "case", "candidates that pass", "%", "fails most often by"), rows, (1, 4)),
    ]
    for title, found in (("Why points fail", ranking.reasons), ("Could not be judged", ranking.failures)):
        if found:
            said.append(f"### {title}\n\n" + "\n".join(f"- {line}" for line in reason_lines(ranking, found)))
    return "\n\n".join(said) + "\n"


def _facts(ranking: Ranking) -> dict[str, Any]:
    best = ranking.best
    return {
        "name": ranking.sweep.name,
        "candidates": ranking.sweep.candidates,
        "cases": len(ranking.sweep.cases),
        "points_done": ranking.points_done,
        "passing_everywhere": ranking.passing,
        "best_candidate": best,
        **({} if best is None else ranking.values_of(best)),
    }


def _blueprint(ranking: Ranking, heats: Mapping[str, bytes]) -> Any:
    import rerun.blueprint as rrb

    scatter = rrb.Spatial2DView(
        name=f"Candidates: {axis_label(ranking, 1)}, over {axis_label(ranking, 0)}",
        origin="/front",
        visual_bounds=rrb.VisualBounds2D(x_range=[-70.0, WIDTH + 30.0], y_range=[-60.0, HEIGHT + 80.0]),
    )
    table = rrb.TextDocumentView(name="Verdict", origin="/summary")
    tabs: list[Any] = [rrb.Horizontal(scatter, table, column_shares=[1.4, 1.0], name="Pareto front")]
    if heats:
        views = [rrb.Spatial2DView(name=name, origin=f"/maps/{name}") for name in heats]
        tabs.append(rrb.Grid(*views, grid_columns=1 if len(views) == 1 else 2, name="Heat maps"))
    bars = rrb.BarChartView(name="Candidates that pass [%], by number of the case", origin="/cases")
    page = rrb.TextDocumentView(name="Cases", origin="/cases_page")
    tabs.append(rrb.Vertical(bars, page, row_shares=[1.0, 1.2], name="Cases"))
    tabs.append(rrb.TextDocumentView(name="What was swept", origin="/swept"))
    panels = (rrb.BlueprintPanel, rrb.SelectionPanel, rrb.TimePanel)
    collapsed = [panel(state="collapsed") for panel in panels]
    return rrb.Blueprint(rrb.Tabs(*tabs, active_tab=0), *collapsed, auto_views=False, auto_layout=False)
