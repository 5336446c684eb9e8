"""What `froude study` found, in a minute's reading and as plain data."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from dataclasses import asdict
from typing import Any

from scenarios.run_folder import plain
from scenarios.study.result import Study, Table
from scenarios.study.summary import line_of
from scenarios.table import number

SCHEMA_VERSION = 1
WIDTH = 118


def study_text(study: Study) -> str:
    """The findings for people.

    Args:
        study: everything.
    """
    lines = ["The study recomputed: ours beside the print", ""]
    for table in study.tables:
        lines.append(f"  table {table.number:<4} {_agreement(table):<26} {table.title}")
    lines += ["", f"Errata found: {len(study.errata)}"]
    lines += [f"  {e.where}: printed {e.printed}, follows {e.follows}" for e in study.errata]
    verdicts = Counter(str(c.verdict) for c in study.conclusions if c.section != "ours")
    lines += ["", "Conclusions: " + ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())]
    for c in study.conclusions:
        lines += _wrapped(f"  {str(c.verdict).upper():<10} {c.section:<4} {c.statement}", 18)
        lines += _wrapped(f"{'':<18}{c.evidence}", 18)
    lines += _pairs(study)
    for table in study.extra:
        lines += ["", f"{table.number}: {table.title}", *_extra(table)]
        lines += _wrapped(f"  {table.note}", 2) if table.note else []
    return "\n".join(lines)


def _agreement(table: Table) -> str:
    if not any(row.compared for row in table.rows):
        return "another design"
    compared = [row for row in table.rows if row.agrees is not None]
    good = sum(row.agrees is True for row in compared)
    return f"{good} of {len(compared)} numbers agree"


def _wrapped(text: str, indent: int) -> list[str]:
    return textwrap.wrap(text, WIDTH, subsequent_indent=" " * indent, drop_whitespace=True) or [text]


def _pairs(study: Study) -> list[str]:
    lines = []
    for source, profile in dict.fromkeys((p.source.split(" ")[0], p.profile) for p in study.pairs):
        kind = "printed gains" if source == "table" else "tuned here"
        lines += [
            "",
            f"Chapter 7, {kind}, profile {profile}: every sample of the target's identified model",
            "  target     gains on     settle s       overshoot  VAF    peak    phase  delay  gain up   shakes   meets",
            "                        median worst     worst %      %   delta     deg     ms      dB    rad/s       %",
        ]
        for pair in study.pairs:
            if (pair.source.split(" ")[0], pair.profile) != (source, profile):
                continue
            n = line_of(pair)
            lines.append(
                f"  {pair.target:<10} {pair.based_on:<10} {number(n.settling_s[0]):>7} {number(n.settling_s[1]):>5} "
                f"{number(n.overshoot_pct):>11} {number(n.vaf_pct, 1):>6} {number(n.peak_delta_lat):>7} "
                f"{number(n.phase_margin_deg, 1):>7} {number(1e3 * n.delay_margin_s, 1):>6} "
                f"{number(n.gain_margin_high_db, 1):>7} {number(n.oscillation_rad_s):>9} {100 * n.meets:>9.1f}"
            )
    return lines


def _extra(table: Table) -> list[str]:
    """A table of ours: one line per item, its columns side by side."""
    columns = list(dict.fromkeys(row.column for row in table.rows))
    items = list(dict.fromkeys(row.item for row in table.rows))
    cells = {(row.item, row.column): row for row in table.rows}
    wide = max([len(item) for item in items] + [4])
    widths = [max(len(column), 9) for column in columns]
    head = "  " + " " * wide + "  " + "  ".join(c.rjust(w) for c, w in zip(columns, widths, strict=True))
    lines = [head]
    for item in items:
        shown = []
        for column, width in zip(columns, widths, strict=True):
            row = cells.get((item, column))
            shown.append(("" if row is None or row.ours is None else f"{row.ours:.4g}").rjust(width))
        lines.append(f"  {item.ljust(wide)}  " + "  ".join(shown))
    return lines


def study_object(study: Study) -> dict[str, Any]:
    """The findings as plain data; infinite and missing numbers as in run.json.

    Args:
        study: everything.
    """
    shown = {
        "schema_version": SCHEMA_VERSION,
        "settings": study.settings,
        "tables": [_table(table) for table in study.tables],
        "errata": [asdict(one) for one in study.errata],
        "conclusions": [asdict(one) | {"verdict": str(one.verdict)} for one in study.conclusions],
        "pairs": [
            {
                "target": pair.target,
                "based_on": pair.based_on,
                "source": pair.source,
                "profile": pair.profile,
                "gains": asdict(pair.gains),
                "samples": len(pair.metrics["vaf_pct"]),
            }
            | {name: _endless(value) for name, value in asdict(line_of(pair)).items()}
            for pair in study.pairs
        ],
        "extra": [_table(table) for table in study.extra],
    }
    made: dict[str, Any] = plain(shown)
    return made


def _endless(value: Any) -> Any:
    """Infinite margins by name: null stands for what could not be measured."""
    return "inf" if value == math.inf else value


def _table(table: Table) -> dict[str, Any]:
    rows = [asdict(row) | {"difference": row.difference, "agrees": row.agrees} for row in table.rows]
    return {"number": table.number, "title": table.title, "note": table.note, "rows": rows}
