"""A sweep's result for machines, `froude sweep --json`; units are in the keys."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from scenarios.run_folder import plain
from scenarios.sweep.flown_beside import FlownBeside
from scenarios.sweep.pareto import Front
from scenarios.sweep.ranking import Ranking, Reason
from scenarios.sweep.winner import worst_case_name

SCHEMA_VERSION = 1
ROWS = 100
"""Candidates of the ranking and of the front, and reasons."""


def sweep_object(ranking: Ranking, front: Front, flown: FlownBeside | None, files: Mapping[str, str]) -> dict[str, Any]:
    """The whole result as plain data.

    Args:
        ranking, front: of the sweep. flown: what was flown of it; None: nothing. files: what -> path.
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
            "ranking": [candidate_object(ranking, c, k) for k, c in enumerate(ranking.order[:ROWS].tolist(), 1)],
            "pareto": {
                "among": "passing_everywhere" if front.passing else "all",
                "count": len(front.candidates),
                "candidates": front.candidates[:ROWS].tolist(),
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
            "reasons": [_reason_object(one) for one in ranking.reasons[:ROWS]],
            "error_reasons": [_reason_object(one) for one in ranking.failures[:ROWS]],
            "flown": None if flown is None else flown.data,
            "disagreements": [] if flown is None else flown.disagreements,
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
