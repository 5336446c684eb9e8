"""A sweep's result as text: verdict, ranking, cases, why points fail; and the same for machines."""

from __future__ import annotations

import io
import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scenarios.run_folder import plain
from scenarios.sweep.pareto import Front
from scenarios.sweep.ranking import CaseSummary, Ranking, Reason
from scenarios.sweep.sweep_words import limit_title, many, objective_heading, objective_title, shown_objective
from scenarios.sweep.winner import worst_case_name
from scenarios.table import MINIMUM_WIDTH, PIPED_WIDTH, UNSET, number, text_console
from sitl.errors import FileError

SCHEMA_VERSION = 1
ROWS = 10
"""Candidates of the table for people."""
JSON_ROWS = 100
"""Candidates of the ranking and of the front for machines."""
REASONS = 5
DISAGREEMENTS = Path("flights") / "disagreements.json"


def disagreements_of(folder: Path) -> list[dict[str, Any]]:
    """What batch and flight do not agree about; empty if nothing was flown, or they do.

    Args:
        folder: of the sweep.

    Raises:
        FileError: the file is damaged.
    """
    path = folder / DISAGREEMENTS
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read: {error}", "Fly the best again: --resume with --fly K") from error
    rows = found.get("disagreements", []) if isinstance(found, dict) else found
    return [dict(one) for one in rows]


def headline(ranking: Ranking) -> str:
    """The answer in one line.

    Args:
        ranking: of a sweep.
    """
    sweep, judged = ranking.sweep, len(ranking.order)
    among = f"{judged:,} candidates in {many(len(sweep.cases), 'case')}"
    if not judged:
        return f"No candidate is complete yet: {ranking.points_done:,} of {sweep.facts['points']:,} points are done"
    if ranking.passing:
        what = "candidate passes" if ranking.passing == 1 else "candidates pass"
        return f"{ranking.passing:,} {what} everywhere, of {among}"
    return f"No candidate passes everywhere, of {among}"


def choice(ranking: Ranking) -> str:
    """The winner, or the best, in one sentence; empty if none is complete.

    Args:
        ranking: of a sweep.
    """
    best = ranking.best
    if best is None:
        return ""
    cases = len(ranking.sweep.cases)
    named = ", ".join(f"{name} {value:.5g}" for name, value in ranking.values_of(best).items())
    told = ", ".join(
        f"{objective_heading(one)} {shown_objective(one, ranking.objective(best, k))}"
        for k, one in enumerate(ranking.sweep.objectives)
    )
    if ranking.everywhere[best]:
        return f"The winner is candidate {best}: {named}; in its worst case {told}"
    worst = f"{worst_text(ranking, best)} of the models in {worst_case_name(ranking, best)}"
    passed = f"{ranking.passed[best]} of {many(cases, 'case')}"
    return f"The best is candidate {best}: {named}; it passes in {passed}, with {worst}"


def worst_text(ranking: Ranking, candidate: int) -> str:
    """`98.0 % (93.0 to 99.4)`, or that it could not be judged.

    Args:
        ranking: of a sweep. candidate: its number.
    """
    share, interval = ranking.worst_pct(candidate), ranking.interval_pct(candidate)
    if share is None or interval is None:
        return "not judged"
    return f"{number(share, 1)} % ({number(interval[0], 1)} to {number(interval[1], 1)})"


def unfinished(ranking: Ranking) -> list[str]:
    """What is missing of a sweep that was stopped, and files that could not be read.

    Args:
        ranking: of a sweep.
    """
    lines = []
    points = int(ranking.sweep.facts["points"])
    if ranking.points_done < points:
        lines.append(
            f"The sweep is not complete: {ranking.points_done:,} of {points:,} points are done, "
            f"{many(ranking.incomplete, 'candidate')} in some cases only, and not ranked. "
            f"Go on with: froude sweep --resume {ranking.sweep.path}"
        )
    return lines + [f"{problem}." for problem in ranking.problems]


def most_failing(case: CaseSummary) -> str:
    """What breaks most samples of the points that fail; empty if none fails.

    Args:
        case: of a ranking.
    """
    if not case.samples:
        return ""
    # a sample that diverged breaks every limit, so of equal counts the first is the cause
    metric, count = max(case.failing.items(), key=lambda item: item[1])
    if case.failing["diverged"] == count:
        metric = "diverged"
    return f"{limit_title(metric)} ({100.0 * count / case.samples:.0f} % of their samples)" if count else ""


def sweep_text(
    ranking: Ranking,
    front: Front,
    disagreements: Sequence[Mapping[str, Any]] = (),
    files: Sequence[str] = (),
    *,
    width: int | None = None,
    colour: bool = False,
) -> str:
    """The whole result for people.

    Args:
        ranking, front: of the sweep. disagreements: between batch and flight. files: that were written.
        width: columns; None for `PIPED_WIDTH`. colour: with ANSI colours.
    """
    columns = max(width or PIPED_WIDTH, MINIMUM_WIDTH)
    sink = io.StringIO()
    console = text_console(sink, columns, colour=colour)

    def tell(text: str, indent: str = "  ") -> None:
        console.print(textwrap.fill(text, columns, subsequent_indent=indent, break_on_hyphens=False), soft_wrap=True)

    tell(f"{ranking.sweep.title}: {headline(ranking)}.")
    if len(ranking.order):
        tell(f"{choice(ranking)}.")
        console.print()
        console.print(_candidates(ranking, columns))
        if len(ranking.order) > ROWS:
            tell(f"{len(ranking.order) - ROWS:,} more.")
        tell(_front_line(ranking, front))
    if ranking.points_done:
        console.print()
        console.print(_cases(ranking))
    for title, found in (("Why points fail", ranking.reasons), ("Points that could not be judged", ranking.failures)):
        if found:
            console.print(f"\n{title}:")
            for line in reason_lines(ranking, found):
                tell(f"  {line}", "      ")
    if disagreements:
        console.print("\nBatch and flight disagree:")
        for one in disagreements:
            tell(f"  {disagreement_text(one)}", "      ")
    for line in unfinished(ranking):
        console.print()
        tell(line)
    console.print()
    console.print(f"Sweep folder: {ranking.sweep.path}", soft_wrap=True)
    if files:
        tell(f"Written there: {', '.join(files)}")
    return "\n".join(line.rstrip() for line in sink.getvalue().splitlines()) + "\n"


def reason_lines(ranking: Ranking, found: Sequence[Reason]) -> list[str]:
    """The most common of them.

    Args:
        ranking: of a sweep. found: its reasons or its failures.
    """
    lines = []
    for one in found[:REASONS]:
        first = f"first candidate {one.candidate}, {ranking.sweep.cases[one.case]}"
        lines.append(f"{one.points:,} x {one.text} ({first})")
    left = sum(one.points for one in found[REASONS:])
    return [*lines, f"{left:,} x otherwise"] if left else lines


def disagreement_text(one: Mapping[str, Any]) -> str:
    """A disagreement between batch and flight in one line.

    Args:
        one: of `disagreements.json`.
    """
    if isinstance(one.get("text"), str):
        return str(one["text"])
    return ", ".join(f"{key} {value}" for key, value in one.items())


def _front_line(ranking: Ranking, front: Front) -> str:
    names = " and ".join(objective_heading(one) for one in ranking.sweep.objectives)
    who = "those that pass everywhere" if front.passing else "all, for none passes everywhere"
    shown_ = ", ".join(str(one) for one in front.candidates[:12].tolist())
    more = f" and {len(front.candidates) - 12:,} more" if len(front.candidates) > 12 else ""
    return f"Pareto front of {names} among {who}: {many(len(front.candidates), 'candidate')} ({shown_}{more})."


def _candidates(ranking: Ranking, columns: int) -> Any:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    sweep, cases = ranking.sweep, len(ranking.sweep.cases)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    table.add_column("rank", justify="right")
    table.add_column("candi-\ndate", justify="right")
    for axis in sweep.axes:
        table.add_column(axis.name.replace("RATE_", "RATE\n_"), justify="right", no_wrap=True)
    table.add_column("cases\npassed", justify="right", no_wrap=True)
    table.add_column("worst case passes\n% (95 % interval)", justify="right", no_wrap=True)
    for one in sweep.objectives:
        table.add_column(objective_title(one).replace(" ", "\n", 1), justify="right")
    if cases > 1:
        table.add_column("worst case", overflow="fold")
    for place, candidate in enumerate(ranking.order[:ROWS].tolist(), 1):
        style = "green" if ranking.everywhere[candidate] else "red"
        row = [Text(str(place)), Text(str(candidate))]
        row += [Text(f"{value:.5g}") for value in ranking.values_of(candidate).values()]
        row += [Text(f"{ranking.passed[candidate]}/{cases}", style=style)]
        row += [Text(worst_text(ranking, candidate).replace(" %", ""))]
        for k, one in enumerate(sweep.objectives):
            row.append(Text(shown_objective(one, ranking.objective(candidate, k), unit=False)))
        table.add_row(*row, *([Text(worst_case_name(ranking, candidate))] if cases > 1 else []))
    return table


def _cases(ranking: Ranking) -> Any:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 2, 0, 0), show_edge=False, pad_edge=False)
    table.add_column("case", overflow="fold")
    for title in ("passing", "of", "share %", "errors"):
        table.add_column(title, justify="right")
    table.add_column("fails most often by")
    for case in ranking.cases:
        share = UNSET if not case.points else f"{100.0 * case.passing / case.points:.1f}"
        row = (case.name, f"{case.passing:,}", f"{case.points:,}", share, f"{case.errors:,}", most_failing(case))
        table.add_row(*(Text(cell) for cell in row))
    return table


def sweep_object(
    ranking: Ranking, front: Front, disagreements: Sequence[Mapping[str, Any]], files: Mapping[str, str]
) -> dict[str, Any]:
    """The result for machines; units are in the keys.

    Args:
        ranking, front: of the sweep. disagreements: between batch and flight. files: what -> path.
    """
    sweep = ranking.sweep
    best = ranking.best
    everything: dict[str, Any] = plain(
        {
            "schema_version": SCHEMA_VERSION,
            "folder": str(sweep.path),
            "name": sweep.name,
            "title": sweep.title,
            "points": sweep.facts["points"],
            "points_done": ranking.points_done,
            "complete": ranking.points_done == sweep.facts["points"],
            "candidates": sweep.candidates,
            "candidates_ranked": len(ranking.order),
            "candidates_incomplete": ranking.incomplete,
            "passing_everywhere": ranking.passing,
            "errors": sum(case.errors for case in ranking.cases),
            "winner": candidate_object(ranking, best, 1) if best is not None and ranking.passing else None,
            "best": None if best is None else candidate_object(ranking, best, 1),
            "objectives": [one.column for one in sweep.objectives],
            "ranking": [candidate_object(ranking, c, k) for k, c in enumerate(ranking.order[:JSON_ROWS].tolist(), 1)],
            "pareto": {
                "among": "passing_everywhere" if front.passing else "all",
                "count": len(front.candidates),
                "candidates": front.candidates[:JSON_ROWS].tolist(),
            },
            "cases": [
                {
                    "name": case.name,
                    "points": case.points,
                    "passing": case.passing,
                    "passing_pct": 100.0 * case.passing / case.points if case.points else None,
                    "errors": case.errors,
                    "samples_of_failing": case.samples,
                    "samples_breaking": dict(case.failing),
                }
                for case in ranking.cases
            ],
            "reasons": [_reason_object(one) for one in ranking.reasons[:JSON_ROWS]],
            "error_reasons": [_reason_object(one) for one in ranking.failures[:JSON_ROWS]],
            "disagreements": list(disagreements),
            "problems": list(ranking.problems),
            "files": dict(files),
        }
    )
    return everything


def candidate_object(ranking: Ranking, candidate: int, place: int) -> dict[str, Any]:
    """A candidate for machines.

    Args:
        ranking: of a sweep. candidate: its number. place: in the order, from 1.
    """
    interval = ranking.interval_pct(candidate) or (None, None)
    return {
        "rank": place,
        "candidate": candidate,
        "parameters": ranking.values_of(candidate),
        "passes_everywhere": bool(ranking.everywhere[candidate]),
        "cases_passed": int(ranking.passed[candidate]),
        "cases": len(ranking.sweep.cases),
        "errors": int(ranking.errors[candidate]),
        "worst_case": worst_case_name(ranking, candidate),
        "worst_pass_pct": ranking.worst_pct(candidate),
        "worst_pass_low_pct": interval[0],
        "worst_pass_high_pct": interval[1],
        "objectives": {
            one.column: _finite(ranking.objective(candidate, k)) for k, one in enumerate(ranking.sweep.objectives)
        },
    }


def _finite(value: float) -> float | str | None:
    """An infinite margin is no missing one."""
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return None if math.isnan(value) else value


def _reason_object(one: Reason) -> dict[str, Any]:
    return {"reason": one.text, "points": one.points, "first_candidate": one.candidate, "first_case": one.case}
