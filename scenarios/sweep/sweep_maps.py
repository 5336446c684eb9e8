"""Maps: what two parameters do together, every other one at its best; and how much each parameter matters."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios.sweep.axes import ParameterAxis
from scenarios.sweep.ranking import NOT_JUDGED, Ranking

FloatArray = npt.NDArray[np.float64]

MOST_MAPS = 6
MOST_VALUES = 24
"""Cells along an axis; of more values some share one."""
LEAST_BINS = 4
PER_CELL = 6
"""Candidates of a sampled design that a cell should hold, about."""
_BINS_OF_INFLUENCE = 12


@dataclass(frozen=True)
class Side:
    """An axis of a map, cut into cells.

    Attributes:
        axis: the parameter. edges: (n + 1,) of the cells. names: of each cell where it is one value; empty for ranges.
        of: (N,) cell of each candidate.
    """

    axis: ParameterAxis
    edges: FloatArray
    names: tuple[str, ...]
    of: npt.NDArray[np.intp]

    @property
    def cells(self) -> int:
        """How many."""
        return len(self.edges) - 1


@dataclass(frozen=True)
class HeatMap:
    """Two parameters.

    Attributes:
        x, y: sides. share_pct: (y, x) share of the samples that pass in the worst case, of the cell's best candidate;
            NaN: none was judged. passed: (y, x) cases that the cell's best candidate passes; NaN: no candidate.
        cost: (y, x) of the first objective, the best among those that pass everywhere; NaN: none does.
        counts: (y, x) candidates.
    """

    x: Side
    y: Side
    share_pct: FloatArray
    passed: FloatArray
    cost: FloatArray
    counts: npt.NDArray[np.intp]


SHARE, PASSED, COST = "share", "passed", "cost"


def kinds_of(heat: HeatMap) -> tuple[str, ...]:
    """What of a map is worth a picture.

    The share that passes, or where that is none anywhere, the cases passed; and the first objective, where something
    passes everywhere.

    Args:
        heat: two parameters.
    """
    none = not np.nan_to_num(heat.share_pct).any()
    return (PASSED if none else SHARE, *([COST] if np.isfinite(heat.cost).any() else []))


def influences(ranking: Ranking) -> dict[str, float]:
    """How much of the candidates' spread each parameter explains by itself, 0 to 1, the most influential first.

    Of the share of samples that pass in the worst case; where that is the same for all, of the first objective. It is
    the correlation ratio: the spread between the means of the parameter's stretches over the whole spread.

    Args:
        ranking: of a sweep.
    """
    which = ranking.complete & (ranking.worst_passes != NOT_JUDGED)
    effect = ranking.worst_passes[which].astype(np.float64)
    if not len(effect) or np.ptp(effect) == 0.0:
        which = ranking.complete & np.isfinite(ranking.costs[:, 0])
        effect = ranking.costs[which, 0]
    found = {axis.name: _ratio(ranking.values[axis.name][which], effect) for axis in ranking.sweep.axes}
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _ratio(values: npt.NDArray[np.generic], effect: FloatArray) -> float:
    total = float(np.var(effect)) if len(effect) else 0.0
    if total == 0.0:
        return 0.0
    unique, of = np.unique(values, return_inverse=True)
    if len(unique) > _BINS_OF_INFLUENCE:
        of = of * _BINS_OF_INFLUENCE // len(unique)
    counts = np.bincount(of)
    means = np.bincount(of, effect) / np.maximum(counts, 1)
    return float(np.sum(counts * (means - effect.mean()) ** 2) / len(effect) / total)


def heat_maps(ranking: Ranking) -> tuple[HeatMap, ...]:
    """A map for each pair of parameters, the most influential pair first; none if one parameter is varied.

    Args:
        ranking: of a sweep.
    """
    varied = [name for name in influences(ranking) if len(np.unique(ranking.values[name][ranking.complete])) > 1]
    pairs = sorted(itertools.combinations(range(len(varied)), 2), key=lambda pair: (sum(pair), pair))
    axes = {axis.name: axis for axis in ranking.sweep.axes}
    used = sorted({number for pair in pairs[:MOST_MAPS] for number in pair})
    sides = {number: _side(ranking, axes[varied[number]]) for number in used}
    return tuple(_map(ranking, sides[x], sides[y]) for x, y in pairs[:MOST_MAPS])


def _side(ranking: Ranking, axis: ParameterAxis) -> Side:
    values = ranking.values[axis.name].astype(np.float64)
    known = np.unique(values[ranking.complete])
    if len(known) <= MOST_VALUES:
        names = tuple(f"{value:.3g}" for value in known.tolist())
        if len(set(names)) < len(names):
            names = tuple(f"{value:.6g}" for value in known.tolist())
        of = np.clip(np.searchsorted(known, values), 0, len(known) - 1)
        return Side(axis, np.arange(len(known) + 1.0) - 0.5, names, of)
    low, high = float(known[0]), float(known[-1])
    count = len(ranking.order)
    bins = int(np.clip(np.sqrt(count / PER_CELL), LEAST_BINS, MOST_VALUES))
    log = axis.log and low > 0.0
    edges = np.geomspace(low, high, bins + 1) if log else np.linspace(low, high, bins + 1)
    return Side(axis, edges, (), np.clip(np.searchsorted(edges, values, side="right") - 1, 0, bins - 1))


def _map(ranking: Ranking, x: Side, y: Side) -> HeatMap:
    shape = (y.cells, x.cells)
    cell = y.of * x.cells + x.of
    best = np.full(shape, float(NOT_JUDGED))
    complete = ranking.complete
    np.maximum.at(best.reshape(-1), cell[complete], ranking.worst_passes[complete].astype(np.float64))
    share = np.where(best == NOT_JUDGED, np.nan, 100.0 * best / ranking.sweep.of)
    passed = np.full(shape, -1.0)
    np.maximum.at(passed.reshape(-1), cell[complete], ranking.passed[complete].astype(np.float64))
    cost = np.full(shape, np.inf)
    good = ranking.everywhere & ~np.isnan(ranking.costs[:, 0])
    np.minimum.at(cost.reshape(-1), cell[good], ranking.costs[good, 0])
    counts = np.bincount(cell[complete], minlength=x.cells * y.cells).reshape(shape)
    passed[counts == 0] = np.nan
    return HeatMap(x, y, share, passed, np.where(np.isposinf(cost), np.nan, cost), counts)
