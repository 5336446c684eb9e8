"""The page: everything `froude study` found, in one file that needs nothing else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scenarios.study.result import Figure, Row, Study, Table
from scenarios.study.summary import line_of
from scenarios.table import UNSET, number

TEMPLATE = "page.html.j2"


def study_page(study: Study, figures: Sequence[Figure]) -> str:
    """The page as HTML, without scripts and without requests to anywhere.

    Args:
        study: everything. figures: drawn; their SVG goes into the page.
    """
    import jinja2

    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    rows = [row for table in study.tables for row in table.rows if row.agrees is not None]
    page: str = environment.get_template(TEMPLATE).render(
        agree=sum(row.agrees is True for row in rows),
        compared=len(rows),
        errata=study.errata,
        verdicts=Counter(str(c.verdict) for c in study.conclusions if c.section != "ours"),
        conclusions=study.conclusions,
        kinds=_kinds(study),
        extra=[_extra(table) for table in study.extra],
        figures=figures,
        tables=[_table(table) for table in study.tables],
        settings=study.settings,
    )
    return page


def _kinds(study: Study) -> list[dict[str, Any]]:
    kinds: dict[str, list[list[str]]] = {}
    for pair in study.pairs:
        n, g = line_of(pair), pair.gains
        title = f"{'Gains tuned here' if pair.source.startswith('tuned') else 'Printed gains'}, profile {pair.profile}"
        cells = [pair.target, "itself" if pair.based_on == pair.target else pair.based_on]
        cells.append(number(100.0 * n.meets, 1))
        cells += [f"{value:.4g}" for value in (g.k_phi, g.kp, g.ki, g.kd)]
        cells += [number(n.settling_s[0], 3), number(n.settling_s[1], 3), number(n.overshoot_pct)]
        cells += [number(n.vaf_pct, 1), number(n.peak_delta_lat), number(n.phase_margin_deg, 1)]
        cells += [number(1e3 * n.delay_margin_s, 1), number(n.gain_margin_high_db, 1), number(n.oscillation_rad_s)]
        kinds.setdefault(title, []).append(cells)
    return [{"title": title, "rows": rows} for title, rows in kinds.items()]


def _table(table: Table) -> dict[str, Any]:
    rows = [
        {
            "item": row.item,
            "column": row.column,
            "unit": row.unit,
            "printed": _told(row.printed, row),
            "ours": _told(row.ours, row),
            "difference": UNSET if row.difference is None else f"{row.difference:.2g}",
            "agrees": row.agrees,
        }
        for row in table.rows
    ]
    return {"number": table.number, "title": table.title, "note": table.note, "rows": rows}


def _told(value: float | None, row: Row) -> str:
    """As finely as the study prints it, and a digit more."""
    if value is None:
        return UNSET
    small = abs(value) < 1e-3 and value != 0.0
    return f"{value:.3g}" if row.digits is None or small else f"{value:.{max(row.digits, 0) + 1}f}"


def _extra(table: Table) -> dict[str, Any]:
    columns = list(dict.fromkeys(row.column for row in table.rows))
    cells = {(row.item, row.column): row.ours for row in table.rows}
    rows = []
    for item in dict.fromkeys(row.item for row in table.rows):
        values = [cells.get((item, column)) for column in columns]
        rows.append((item, [UNSET if value is None else f"{value:.4g}" for value in values]))
    return {"number": table.number, "title": table.title, "note": table.note, "columns": columns, "rows": rows}
