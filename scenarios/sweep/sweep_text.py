"""A sweep's result as text: verdict, ranking, cases, why points fail, what was flown."""

from __future__ import annotations

import io
import shlex
import textwrap
from collections.abc import Sequence
from typing import Any

from scenarios.sweep.flown_beside import FlownBeside
from scenarios.sweep.pareto import Front
from scenarios.sweep.ranking import CaseSummary, Ranking, Reason
from scenarios.sweep.sweep_maps import influences
from scenarios.sweep.sweep_words import limit_title, many, objective_heading, objective_title, shown_objective
from scenarios.sweep.winner import worst_case_name
from scenarios.table import MINIMUM_WIDTH, PIPED_WIDTH, UNSET, number, text_console, viewer_command

ROWS = 10
"""Candidates of the table for people."""
RECORDING = "sweep.rrd"
MOST_CASES = 40
REASONS = 5
_FIXED_WIDTH = 4 + 6 + 6 + 21 + 5 + 5 * 2
"""Columns of a terminal that rank, number, cases passed, share and worst case take."""
_END_SHARE = 0.02
"""Of a range, what counts as its end."""
_NARROW, _INTERVAL_WIDTH = 100, 14
"""Of a terminal that has no room for intervals, and what they take."""
_NAME_WIDTH, _VALUE_WIDTH = 8, 9
_GAP = 2


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


def doubts(ranking: Ranking, flown: FlownBeside | None) -> list[str]:
    """What one should know before one trusts the result, a sentence each.

    Args:
        ranking: of a sweep. flown: what was flown of it; None: nothing.
    """
    lines = unfinished(ranking)
    edges = at_the_end(ranking)
    if edges:
        lines.append(f"The best candidate lies at the end of {', '.join(edges)}: a better one may lie beyond.")
    errors = sum(case.errors for case in ranking.cases)
    if errors:
        lines.append(f"{many(errors, 'point')} could not be judged, most often because: {ranking.failures[0].text}")
    if flown is not None and flown.disagreements:
        lines.append(
            f"Batch and flight disagree about {len(flown.disagreements)} of {many(len(flown.flights), 'flight')}."
        )
    return lines


def at_the_end(ranking: Ranking) -> list[str]:
    """Axes at whose end the best candidate lies, with its value; the parameter's own least value is no end.

    Args:
        ranking: of a sweep.
    """
    best = ranking.best
    if best is None:
        return []
    found = []
    for axis in ranking.sweep.axes:
        value = ranking.values_of(best)[axis.name]
        # of a sampled range nothing lies on its very end
        room = 0.0 if axis.values else _END_SHARE * (axis.high - axis.low)
        zero = value - room <= 0.0 <= axis.low
        if axis.low < axis.high and ((value <= axis.low + room and not zero) or value >= axis.high - room):
            found.append(f"{axis.name} ({value:.5g})")
    return found


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
    flown: FlownBeside | None = None,
    files: Sequence[str] = (),
    *,
    width: int | None = None,
    colour: bool = False,
) -> str:
    """The whole result for people.

    Args:
        ranking, front: of the sweep. flown: what was flown of it; None: nothing. files: that were written.
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
        table, left_out = _candidates(ranking, columns)
        console.print(table)
        if len(ranking.order) > ROWS:
            tell(f"{len(ranking.order) - ROWS:,} more candidates. Objectives are those of the worst case.")
        if left_out:
            tell(f"Varied, too, with less effect: {', '.join(left_out)}; the report has them.")
        tell(_front_line(ranking, front))
    if ranking.points_done:
        console.print()
        console.print(_cases(ranking))
        if len(ranking.cases) > MOST_CASES:
            tell(f"{len(ranking.cases) - MOST_CASES:,} more cases; --json has them all.")
    for title, found in (("Why points fail", ranking.reasons), ("Points that could not be judged", ranking.failures)):
        if found:
            console.print(f"\n{title}:")
            for line in reason_lines(ranking, found):
                tell(f"  {line}", "      ")
    if flown is not None:
        console.print()
        tell(flown.headline)
        for line in flown.lines():
            tell(f"  {line}", "      ")
    doubtful = doubts(ranking, flown)
    if doubtful:
        console.print("\nBefore you trust this:")
        for line in doubtful:
            tell(f"  {line}", "    ")
    console.print()
    console.print(f"Sweep folder: {ranking.sweep.path}", soft_wrap=True)
    if files:
        drawn = sum(name.endswith(".png") for name in files)
        named = [name for name in files if not name.endswith((".svg", ".png"))]
        tell(f"Written there: {', '.join(named)}; {many(drawn, 'picture')} (.svg and .png)")
    if RECORDING in files:
        recording = shlex.quote(str(ranking.sweep.path / RECORDING))
        console.print(f"Look at it: {viewer_command()} {recording}", soft_wrap=True)
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


def _front_line(ranking: Ranking, front: Front) -> str:
    names = " and ".join(objective_heading(one) for one in ranking.sweep.objectives)
    who = "those that pass everywhere" if front.passing else "all, for none passes everywhere"
    shown_ = ", ".join(str(one) for one in front.candidates[:12].tolist())
    more = f" and {len(front.candidates) - 12:,} more" if len(front.candidates) > 12 else ""
    return f"Pareto front of {names} among {who}: {many(len(front.candidates), 'candidate')} ({shown_}{more})."


def _candidates(ranking: Ranking, columns: int) -> tuple[Any, tuple[str, ...]]:
    """The table, and axes that it has no room for."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    sweep, cases = ranking.sweep, len(ranking.sweep.cases)
    names = tuple(influences(ranking))
    room = columns - _FIXED_WIDTH - sum(_width(objective_title(one)) + _GAP for one in sweep.objectives)
    narrow = columns < _NARROW
    room += _INTERVAL_WIDTH if narrow else 0
    fitting = [k for k in range(1, len(names) + 1) if sum(_width(_broken(name)) + _GAP for name in names[:k]) <= room]
    fits = max(fitting, default=1)
    names, left_out = names[:fits], names[fits:]
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    titles = ["rank", "candi-\ndate", *(_broken(axis.name) for axis in sweep.axes if axis.name in names)]
    titles += ["cases\npassed", "worst\ncase %" if narrow else "worst case passes\n% (95 % interval)"]
    titles += [objective_title(one).replace(" ", "\n") for one in sweep.objectives]
    for title in (*titles, "worst\ncase"):
        table.add_column(title, justify="right", no_wrap=True)
    for place, candidate in enumerate(ranking.order[:ROWS].tolist(), 1):
        style = "green" if ranking.everywhere[candidate] else "red"
        row = [Text(str(place)), Text(str(candidate))]
        row += [Text(f"{value:.4g}") for name, value in ranking.values_of(candidate).items() if name in names]
        row += [Text(f"{ranking.passed[candidate]}/{cases}", style=style)]
        worst = worst_text(ranking, candidate).replace(" %", "")
        row += [Text(worst.partition(" (")[0] if narrow else worst)]
        for k, one in enumerate(sweep.objectives):
            row.append(Text(shown_objective(one, ranking.objective(candidate, k), unit=False)))
        table.add_row(*row, Text(str(ranking.worst_case[candidate])))
    return table, left_out


def _broken(name: str) -> str:
    """A parameter's name on several lines, none of them long."""
    lines = [""]
    for word in name.split("_"):
        whole = f"{lines[-1]}_{word}" if lines[-1] else word
        lines = [*lines[:-1], whole] if len(whole) <= _NAME_WIDTH or not lines[-1] else [*lines, f"_{word}"]
    return "\n".join(lines)


def _width(title: str) -> int:
    return max(_VALUE_WIDTH, *(len(line) for line in title.replace(" ", "\n").splitlines()))


def _cases(ranking: Ranking) -> Any:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 2, 0, 0), show_edge=False, pad_edge=False)
    table.add_column("no.", justify="right")
    table.add_column("case", overflow="fold")
    for title in ("passing", "of", "share %", "errors"):
        table.add_column(title, justify="right")
    table.add_column("fails most often by")
    for place, case in enumerate(ranking.cases[:MOST_CASES]):
        share = UNSET if not case.points else f"{100.0 * case.passing / case.points:.1f}"
        row = (
            str(place),
            case.name,
            f"{case.passing:,}",
            f"{case.points:,}",
            share,
            f"{case.errors:,}",
            most_failing(case),
        )
        table.add_row(*(Text(cell) for cell in row))
    return table
