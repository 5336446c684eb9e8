"""Pareto front: candidates that no other one beats in everything at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios.sweep.ranking import Ranking

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Front:
    """The front of a ranking.

    Attributes:
        candidates: on it, the best of the first objective first. among: candidates that were compared.
        passing: they are those that pass everywhere; else, because none does, all that are complete.
    """

    candidates: npt.NDArray[np.intp]
    among: int
    passing: bool


def front_of(ranking: Ranking) -> Front:
    """The candidates that are not dominated in the objectives, each in its worst case.

    Args:
        ranking: of a sweep.
    """
    passing = ranking.passing > 0
    which = np.flatnonzero(ranking.everywhere if passing else ranking.complete)
    costs = ranking.costs[which]
    measured = ~np.isnan(costs).any(axis=1)
    which, costs = which[measured], costs[measured]
    best = which[non_dominated(costs)]
    return Front(best[np.lexsort(ranking.costs[best].T[::-1])], len(which), passing)


def non_dominated(costs: FloatArray) -> npt.NDArray[np.bool_]:
    """Which rows no other row dominates: is nowhere larger and somewhere smaller. Rows that are alike all stay.

    Args:
        costs: (n, K), small is good; no NaN.

    Returns:
        (n,). O(n log n) for one and two columns; for more, n times the length of the front.
    """
    keep = np.zeros(len(costs), dtype=bool)
    if not len(costs):
        return keep
    rows, inverse = np.unique(costs, axis=0, return_inverse=True)
    # sorted by the first column, then the next: nothing dominates what stands before it
    if rows.shape[1] == 1:
        on = np.arange(len(rows)) == 0
    elif rows.shape[1] == 2:
        before = np.minimum.accumulate(np.concatenate([[np.inf], rows[:-1, 1]]))
        on = rows[:, 1] < before
        on[0] = True
    else:
        on = _of_many(rows)
    return np.asarray(on[inverse.reshape(-1)])


def _of_many(rows: FloatArray) -> npt.NDArray[np.bool_]:
    on = np.ones(len(rows), dtype=bool)
    for k in range(len(rows)):
        if on[k]:
            behind = np.flatnonzero(on[k + 1 :]) + k + 1
            on[behind[(rows[behind] >= rows[k]).all(axis=1)]] = False
    return on
