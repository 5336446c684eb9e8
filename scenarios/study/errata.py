"""Where the print contradicts its own inputs, found by recomputing it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from scenarios.study.printed import printed
from scenarios.study.result import Erratum, Row, Table
from sitl.airframe import load_airframe

INPUT_TABLES = ("2.1", "2.2", "7.1", "7.2", "7.3")
"""Nothing recomputes these: a difference there is one of our files."""


def errata(tables: Sequence[Table]) -> tuple[Erratum, ...]:
    """Every erratum, those that numbers show first.

    Args:
        tables: from `scenarios.study.tables.tables`.
    """
    shown = [
        _wrong(table, row, tables)
        for table in tables
        if table.number not in INPUT_TABLES
        for row in table.rows
        if row.agrees is False
    ]
    return (*shown, *_told())


def _wrong(table: Table, row: Row, tables: Sequence[Table]) -> Erratum:
    assert row.printed is not None
    assert row.ours is not None
    where = [
        f"{other.column} in table {found.number}"
        for found in tables
        if found.number in ("2.1", "5.2", "5.4")
        for other in found.rows
        if other.item == row.item
        and other.printed is not None
        and math.isclose(other.printed, row.printed, rel_tol=1e-9)
        and other.agrees
    ]
    why = "it does not follow from tables 2.1 and 4.1"
    if where:
        why += f"; the number printed is that of {' and of '.join(where)}"
    return Erratum(
        where=f"table {table.number}, {row.column}, {row.item}",
        printed=f"{row.printed:g}",
        follows=f"{row.ours:.5g}",
        why=why,
        found_by_us=True,
    )


def _told() -> list[Erratum]:
    """Those of the text: numbers decide where they can."""
    overshoot = 100.0 * math.exp(-math.pi * 0.9 / math.sqrt(1.0 - 0.9**2))
    adam, ant_r = load_airframe("ADAM-0"), load_airframe("ANT-R")
    with_56 = 0.56 / ant_r.diagonal_m
    # the larger the damping the smaller the overshoot: "below 0.9" would allow any
    evidence: dict[str, tuple[str, bool]] = {
        "section 7.1, requirement 2": (
            f"a second-order system of damping 0.9 overshoots by {overshoot:.2f} %, the limit that goes with it; "
            "less damping overshoots more",
            True,
        ),
        "section 1.4, running text": (
            f"every Froude number of chapter 5 uses 0.55 m: {adam.diagonal_m / ant_r.diagonal_m:.4f} for the target "
            f"ANT-R; 0.56 m would give {with_56:.4f}",
            True,
        ),
    }
    said: list[dict[str, Any]] = [
        one for one in printed()["erratum"] if not str(one["where"]).startswith("tables 5.6 and 5.8")
    ]
    made = []
    for one in said:
        why, by_us = evidence.get(one["where"], (str(one["why"]), False))
        made.append(Erratum(str(one["where"]), str(one["printed"]), str(one["follows"]), why, by_us))
    return made
