"""Sections of a sweep's page: candidates, pictures, cases, flights, and what was swept."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from scenarios.limits import Limit
from scenarios.report.elements import UNSET, Cell, Figure, Line, Section, Table
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.evaluation import ERROR
from scenarios.sweep.flown_beside import FlownBeside, autopilot
from scenarios.sweep.heat_figures import heat_drawing
from scenarios.sweep.pareto import Front
from scenarios.sweep.ranking import Ranking
from scenarios.sweep.stored_sweep import StoredSweep
from scenarios.sweep.sweep_figures import pareto_drawing
from scenarios.sweep.sweep_maps import HeatMap, influences, kinds_of
from scenarios.sweep.sweep_text import most_failing, reason_lines, worst_text
from scenarios.sweep.sweep_words import limit_title, many, objective_heading, objective_title, shown, shown_objective
from scenarios.sweep.sweep_words import unit_of as unit
from scenarios.table import number

ROWS = 20
"""Candidates of a table."""
MOST_CASES = 200


def front_section(ranking: Ranking, front: Front) -> Section:
    """The Pareto front.

    Args:
        ranking, front: of the sweep.
    """
    drawing = pareto_drawing(ranking, front, "pareto")
    names = " against ".join(objective_heading(one) for one in ranking.sweep.objectives[:2])
    figure = Figure("pareto", f"Candidates: {names}", drawing.svg, drawing.label, caption=drawing.caption)
    who = "those that pass everywhere" if front.passing else "all that are complete, for none passes everywhere"
    lead = [
        f"No other candidate is better than one on the front in {_listed(ranking)} at once. It was looked for among "
        f"{who}; an objective counts as it is in the candidate's worst case."
    ]
    table = _candidates(ranking, front.candidates[:ROWS].tolist(), _more("On the front", len(front.candidates)))
    return Section("front", "Pareto front", lead, wide=[figure], tables=[table])


def maps_section(ranking: Ranking, maps: Sequence[HeatMap]) -> Section | None:
    """What the parameters do.

    Args:
        ranking: of the sweep. maps: of pairs of parameters.
    """
    matters = influences(ranking)
    figures = []
    for place, heat in enumerate(maps):
        for kind in kinds_of(heat):
            name = f"map-{place}-{kind}"
            drawing = heat_drawing(ranking, heat, kind, name)
            title = f"{heat.x.axis.name} and {heat.y.axis.name}"
            figures.append(Figure(name, title, drawing.svg, drawing.label, caption=drawing.caption))
    lead = [
        "Each cell shows the best of the candidates in it: all other parameters are at their best. Bright is good; the "
        "ring is around the candidate named above. A parameter's share of the spread is what the means over its "
        "stretches explain by themselves of how candidates differ."
    ]
    rows = [Line(name, [Cell(f"{100.0 * share:.0f}")]) for name, share in matters.items()]
    effect = Table("Influence of each parameter", "parameter", ["share of the spread [%]"], rows)
    return Section("parameters", "What the parameters do", lead if figures else (), grid=figures, tables=[effect])


def candidates_section(ranking: Ranking) -> Section:
    """The best of them.

    Args:
        ranking: of the sweep.
    """
    best = ranking.order[:ROWS].tolist()
    lead = [
        "In order: what passes everywhere, the share of the models that passes in the worst case, the number of cases "
        f"passed, {objective_heading(ranking.sweep.objectives[0])}."
    ]
    tables = [_candidates(ranking, best, _more("Best candidates", len(ranking.order)))]
    return Section("candidates", "Best candidates", lead, tables=tables)


def _more(caption: str, count: int) -> str:
    return f"{caption}, the first {ROWS} of {count:,}" if count > ROWS else caption


def _listed(ranking: Ranking) -> str:
    return " and ".join(objective_heading(one) for one in ranking.sweep.objectives)


def _candidates(ranking: Ranking, which: Sequence[int], caption: str) -> Table:
    sweep = ranking.sweep
    columns = [*(axis.name for axis in sweep.axes), "cases passed", "models that pass in the worst case"]
    columns += [*(objective_title(one) for one in sweep.objectives), "worst case, its number"]
    rows = []
    for candidate in which:
        passed = f"{ranking.passed[candidate]} of {len(sweep.cases)}"
        cells = [Cell(f"{value:.5g}") for value in ranking.values_of(candidate).values()]
        cells += [
            Cell(passed, "PASS" if ranking.everywhere[candidate] else "FAIL"),
            Cell(worst_text(ranking, candidate)),
        ]
        for k, one in enumerate(sweep.objectives):
            cells.append(Cell(shown_objective(one, ranking.objective(candidate, k), unit=False)))
        rows.append(Line(str(candidate), [*cells, Cell(str(ranking.worst_case[candidate]))]))
    return Table(caption, "candidate", columns, rows)


def cases_section(ranking: Ranking) -> Section:
    """Every case: how many candidates pass, and how the best one does.

    Args:
        ranking: of the sweep.
    """
    rows = []
    for place, case in enumerate(ranking.cases[:MOST_CASES]):
        share = UNSET if not case.points else f"{100.0 * case.passing / case.points:.1f}"
        cells = [Cell(f"{case.passing:,} of {case.points:,}"), Cell(share), Cell(f"{case.errors:,}")]
        rows.append(Line(_case(ranking, place), [*cells, Cell(most_failing(case) or UNSET, words=True)]))
    columns = ["candidates that pass", "share [%]", "errors", "fails most often by"]
    tables = [Table("All candidates, case by case", "case", columns, rows)]
    best = ranking.best
    if best is not None:
        tables.insert(0, _best_in_cases(ranking, best))
    notes = [f"Fails: {line}" for line in reason_lines(ranking, ranking.reasons)]
    notes += [f"Could not be judged: {line}" for line in reason_lines(ranking, ranking.failures)]
    left = len(ranking.cases) - MOST_CASES
    notes += [f"{left:,} more cases; froude sweep --show --json has them all."] if left > 0 else []
    return Section("cases", "Cases", tables=tables, notes=notes)


def _case(ranking: Ranking, case: int) -> str:
    return f"{case}: {ranking.sweep.cases[case]}"


def _best_in_cases(ranking: Ranking, best: int) -> Table:
    sweep = ranking.sweep
    limits = {limit.metric: limit for limit in sweep.limits}
    metrics = list(dict.fromkeys([*(one.metric for one in sweep.objectives), *limits]))
    table = Dataset(sweep.path).read(chunks=_chunks(sweep, best))
    table = table.filter((table["candidate"].to_numpy() == best).tolist())
    metrics = [metric for metric in metrics if f"{metric}_worst" in table.column_names]
    rows = []
    for row in table.to_pylist():
        outcome = "UNSET" if row["outcome"] == ERROR else row["outcome"]
        share = UNSET if row["pass_pct"] is None else number(row["pass_pct"], 1)
        cells = [Cell(row["outcome"], outcome), Cell(share)]
        cells += [_limited(metric, row[f"{metric}_worst"], limits.get(metric)) for metric in metrics]
        rows.append(Line(_case(ranking, row["case"]), [*cells, Cell(row["reason"] or UNSET, words=True)]))
    heads = [limit_title(metric) + (f" [{unit(metric)[0]}]" if unit(metric)[0] else "") for metric in metrics]
    caption = (
        f"Candidate {best}, case by case: share of the models that pass, and the worst model's value of each metric"
    )
    return Table(caption, "case", ["outcome", "models that pass [%]", *heads, "reason"], rows)


def _chunks(sweep: StoredSweep, candidate: int) -> list[int]:
    cases = min(len(sweep.cases), MOST_CASES)
    return [candidate // int(sweep.plan["block"]) * len(sweep.cases) + case for case in range(cases)]


def _limited(metric: str, value: float | None, limit: Limit | None) -> Cell:
    if value is None:
        return Cell(UNSET, "UNSET" if limit is not None else "")
    outcome = "" if limit is None else "PASS" if limit.holds(value) else "FAIL"
    return Cell(shown(value * unit(metric)[1]), outcome)


def flown_section(flown: FlownBeside | None) -> Section | None:
    """Flights of the best beside the batch.

    Args:
        flown: what was flown; None: nothing.
    """
    if flown is None:
        return None
    rows = []
    for one in flown.flights:
        batch = "PASS" if one["batch_passes"] else "FAIL"
        cells = [Cell(one["case_name"], words=True), Cell(autopilot(one), words=True), Cell(batch, batch)]
        cells.append(Cell(one["outcome"], one["outcome"] if one["outcome"] in ("PASS", "FAIL", "UNSET") else ""))
        told = "agrees" if one["agrees"] else flown.difference(one)
        rows.append(Line(f"candidate {one['candidate']}", [*cells, Cell(told, words=True)]))
    columns = ["case", "autopilot", "batch", "flight", "flight beside the batch's nominal model"]
    notes = [line for line in flown.lines() if line.startswith("not flown")]
    lead = [flown.headline.rstrip(":") + ("." if flown.headline.endswith(":") else "")]
    return Section("flown", "Flown", lead, tables=[Table("Flights", "candidate", columns, rows)], notes=notes)


def swept_section(sweep: StoredSweep) -> Section:
    """What was swept, as it was understood.

    Args:
        sweep: of the folder.
    """
    plan = sweep.plan
    axes = [Line(axis.name, [Cell(_span(axis), words=True)]) for axis in sweep.axes]
    names = dict.fromkeys(name for case in plan["cases"] for name in case["conditions"])
    for name in names:
        values = list(dict.fromkeys(_text(case["conditions"].get(name)) for case in plan["cases"]))
        axes.append(Line(name, [Cell(", ".join(values), words=True)]))
    design = plan["design"]
    facts: list[tuple[str, Any]] = [
        ("design", design["kind"] + ("" if design["kind"] == "grid" else f", seed {design['seed']}")),
        ("candidates", f"{sweep.candidates:,}"),
        ("cases", f"{len(sweep.cases):,}"),
        ("points", f"{sweep.facts['points']:,}"),
        ("uncertain models of a case", plan["samples"]),
        ("drawn", f"{plan['distribution']}, within {plan['spread_sigma']:g} sigma, seed {plan['seed']}"),
        ("share that must pass", f"{plan['required_pass_pct']:g} %"),
        ("margins of the loop", plan["margins"]),
        ("set-points", f"{plan['setpoint_rate_hz']:g} Hz"),
        ("manoeuvres", ", ".join(one["name"] for one in plan["manoeuvres"])),
        ("objectives", ", ".join(_wanted(one) for one in sweep.objectives)),
    ]
    limits = [Line(limit_title(limit.metric), [Cell(limit.for_people(), words=True)]) for limit in sweep.limits]
    fixed = [Line(name, [Cell(f"{value:.6g}")]) for name, value in plan["fixed"].items()]
    vehicles = {_text(case["conditions"].get("vehicle", case["vehicle"])): case for case in plan["cases"]}
    lags = [
        Line(name, [Cell(_text(value), words=True) for value in case["derivatives"].values()])
        for name, case in vehicles.items()
    ]
    derivatives = list(plan["cases"][0]["derivatives"])
    tables = [
        Table("Axes", "axis", ["values"], axes),
        _facts("The sweep", facts),
        Table("Limits of every sample", "metric", ["limit"], limits),
        Table("Parameters that every candidate has", "parameter", ["value"], fixed),
        Table("Derivatives of the nominal models, SI units", "vehicle", derivatives, lags),
    ]
    return Section("swept", "What was swept", tables=[table for table in tables if table.rows])


def repeat_section(sweep: StoredSweep) -> Section:
    """What it takes to do it again; the template adds command and file.

    Args:
        sweep: of the folder.
    """
    facts = sweep.facts
    rows: list[tuple[str, Any]] = [("program", facts.get("program")), *facts.get("versions", {}).items()]
    rows += [("fingerprint of the plan", facts["fingerprint"]), ("folder", sweep.path.name)]
    lead = ["The same file gives the same rows, bit for bit, with the same versions, whatever the number of workers."]
    return Section("repeat", "To repeat this sweep", lead, tables=[_facts("Versions", rows)])


def _wanted(one: Any) -> str:
    return f"{'large' if one.maximise else 'small'} {objective_heading(one)}"


def _span(axis: Any) -> str:
    if axis.values:
        few = [f"{value:.5g}" for value in axis.values]
        return ", ".join(few) if len(few) <= 12 else f"{many(len(few), 'value')} from {few[0]} to {few[-1]}"
    return f"{axis.low:.5g} to {axis.high:.5g}" + (", logarithmic" if axis.log else "")


def _facts(caption: str, facts: Iterable[tuple[str, Any]]) -> Table:
    rows = [Line(name, [Cell(_text(value), words=True)]) for name, value in facts if value not in (None, "")]
    return Table(caption, "what", ["value"], rows)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(one)}" for name, one in value.items())
    return f"{value:.5g}" if isinstance(value, float) else str(value)
