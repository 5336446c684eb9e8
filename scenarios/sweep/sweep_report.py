"""A sweep's page: the verdict first, pictures, tables, and all that it takes to repeat it, in one file."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import scenarios.report
from scenarios.report.verdict import SIGNS
from scenarios.sweep.flown_beside import FlownBeside
from scenarios.sweep.pareto import Front
from scenarios.sweep.ranking import Ranking
from scenarios.sweep.sweep_maps import HeatMap
from scenarios.sweep.sweep_sections import (
    candidates_section,
    cases_section,
    flown_section,
    front_section,
    maps_section,
    repeat_section,
    swept_section,
)
from scenarios.sweep.sweep_text import choice, doubts, headline
from scenarios.sweep.sweep_words import many

TEMPLATE = "sweep_page.html.j2"


def sweep_page(
    ranking: Ranking, front: Front, maps: Sequence[HeatMap], flown: FlownBeside | None, files: Sequence[str]
) -> str:
    """The page as HTML, without scripts and without requests to anywhere; the same bytes for the same dataset.

    Args:
        ranking, front, maps: of the sweep. flown: what was flown of it. files: beside the page, for people.
    """
    import jinja2

    sweep = ranking.sweep
    ranked = len(ranking.order) > 0
    sections = [
        *([candidates_section(ranking), front_section(ranking, front), maps_section(ranking, maps)] if ranked else []),
        cases_section(ranking),
        flown_section(flown),
        swept_section(sweep),
        repeat_section(sweep),
    ]
    command = sweep.facts.get("command", [])
    folders = [Path(__file__).parent, Path(scenarios.report.__file__).parent]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page: str = environment.get_template(TEMPLATE).render(
        title=sweep.title,
        headline=headline(ranking),
        choice=choice(ranking),
        doubts=doubts(ranking, flown),
        about=f"{many(sweep.candidates, 'candidate')} in {many(len(sweep.cases), 'case')}",
        required=f"{sweep.plan['required_pass_pct']:g}",
        models=sweep.of,
        started=_iso(sweep.facts.get("started_utc", "")),
        started_text=_iso(sweep.facts.get("started_utc", "")).replace("T", " ").replace("Z", " UTC"),
        files=files,
        sections=[section for section in sections if section is not None],
        signs=SIGNS,
        command=shlex.join(["froude", *command]) if command else "",
        file=sweep.facts["file"],
        text=sweep.facts["text"],
        version=sweep.facts.get("versions", {}).get("froude", ""),
        folder=sweep.path.name,
    )
    return page


def _iso(stamp: str) -> str:
    """`20261129T071545Z` as `2026-11-29T07:15:45Z`."""
    if len(stamp) != 16:
        return stamp
    return f"{stamp[:4]}-{stamp[4:6]}-{stamp[6:8]}T{stamp[9:11]}:{stamp[11:13]}:{stamp[13:]}"
