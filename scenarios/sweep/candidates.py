"""Candidates of a design: which values the parameter axes take, any stretch of them at a time.

Grids and Sobol points are worked out from their numbers, so a sweep of millions needs no list of them. A Latin
hypercube is made as a whole, once.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from scenarios.sweep.axes import ParameterAxis
from scenarios.sweep.plan import Plan
from scenarios.sweep.sweep_file import GRID, LATIN, SOBOL

FloatArray = npt.NDArray[np.float64]


class Candidates:
    """The candidates of a plan that is no search.

    Args:
        plan: with its design.
    """

    def __init__(self, plan: Plan) -> None:
        self._axes = plan.sweep.parameters
        self._design = plan.sweep.design
        self._count = plan.candidates
        self._engine: Any = None
        self._at = 0

    def values(self, start: int, stop: int) -> FloatArray:
        """(n, D) values of candidates `start` to `stop`, a column an axis, as PX4 stores them.

        Args:
            start, stop: numbers of candidates.
        """
        if self._design.kind == GRID:
            sizes = [len(axis.values) for axis in self._axes]
            places = np.unravel_index(np.arange(start, stop), sizes)
            return np.column_stack([np.array(axis.values)[at] for axis, at in zip(self._axes, places, strict=True)])
        if self._design.kind == SOBOL:
            return on_axes(self._axes, self._sobol(start, stop))
        return on_axes(self._axes, self._latin[start:stop])

    def _sobol(self, start: int, stop: int) -> FloatArray:
        from scipy.stats import qmc

        # one stretch is mostly asked for after the other: to wind on from the beginning each time would take longer
        # and longer
        if self._engine is None or start < self._at:
            rng = np.random.default_rng(self._design.seed)
            self._engine, self._at = qmc.Sobol(len(self._axes), scramble=True, rng=rng), 0
        if start > self._at:
            self._engine.fast_forward(start - self._at)
        self._at = stop
        with warnings.catch_warnings():
            # the balance of a power of two is lost, the points are as good as any other beginning of the sequence
            warnings.simplefilter("ignore", UserWarning)
            return np.asarray(self._engine.random(stop - start))

    @cached_property
    def _latin(self) -> FloatArray:
        from scipy.stats import qmc

        assert self._design.kind == LATIN
        engine = qmc.LatinHypercube(len(self._axes), rng=np.random.default_rng(self._design.seed))
        return np.asarray(engine.random(self._count))


def on_axes(axes: Sequence[ParameterAxis], unit: FloatArray) -> FloatArray:
    """Points of the unit cube, (n, D), as values of the axes.

    Args:
        axes: D of them. unit: (n, D) from 0 to 1.
    """
    return np.column_stack([axis.at(unit[:, column]) for column, axis in enumerate(axes)])
