"""A search: candidates asked of an optimiser, generation by generation, towards what passes everywhere and is best.

The optimiser is optuna's: NSGA-II for two objectives or more, TPE for one, its constraint being how far the limits are
missed in the worst case. It is asked for a whole generation before it is told anything, in the order of the candidates,
so a search gives the same candidates whatever the engine; and a search that goes on after a stop asks all of it again
and takes the answers from the dataset.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from scenarios.limits import Limit
from scenarios.sweep.axes import ParameterAxis, as_stored
from scenarios.sweep.evaluation import PASS, limits_of, measured_names
from scenarios.sweep.plan import Plan
from scenarios.sweep.ranking import cost
from sitl.errors import FileError

if TYPE_CHECKING:
    from scenarios.sweep.dataset import Dataset

FloatArray = npt.NDArray[np.float64]

_SHORT = "froude:short"
"""Attribute of a trial: by how much it misses the limits in the worst case, 0 where it passes."""


class Search:
    """The optimiser's side of a search.

    Args:
        plan: of the sweep.
    """

    def __init__(self, plan: Plan) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._plan = plan
        self._axes = plan.sweep.parameters
        objectives = plan.sweep.objectives
        seed = plan.sweep.design.seed
        with warnings.catch_warnings():
            # constraints are marked experimental
            warnings.simplefilter("ignore")
            sampler: Any
            if len(objectives) > 1:
                sampler = optuna.samplers.NSGAIISampler(
                    population_size=plan.sweep.design.generation,
                    # children near their parents: the default only swaps values, and comes no nearer to a front
                    crossover=optuna.samplers.nsgaii.VSBXCrossover(),
                    seed=seed,
                    constraints_func=_constraint,
                )
            else:
                sampler = optuna.samplers.TPESampler(seed=seed, constraints_func=_constraint, constant_liar=True)
            directions = [optuna.study.StudyDirection.MINIMIZE for _ in objectives]
            self._study = optuna.create_study(sampler=sampler, directions=directions)
        self._asked: list[Any] = []
        self._suggestions = {axis.name: _suggestion(axis) for axis in self._axes}

    def generations(self) -> Iterator[tuple[FloatArray, int]]:
        """Values of the candidates of a generation, (n, D), and the number of the first; tell before the next."""
        plan = self._plan
        size = plan.sweep.design.generation
        for start in range(0, plan.candidates, size):
            count = min(size, plan.candidates - start)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._asked = [self._study.ask(self._suggestions) for _ in range(count)]
            rows = [[_value(axis, trial.params[axis.name]) for axis in self._axes] for trial in self._asked]
            yield np.array(rows, dtype=np.float64), start

    def tell(self, values: FloatArray, start: int, dataset: Dataset) -> None:
        """Tell the optimiser what became of the generation it was asked for.

        Args:
            values: of its candidates. start: number of the first. dataset: holds all of their points.

        Raises:
            FileError: the dataset holds other candidates than the optimiser asks for.
        """
        plan = self._plan
        cases = len(plan.cases)
        chunks = [
            block * cases + case
            for block in range(start // plan.block, math.ceil((start + len(values)) / plan.block))
            for case in range(cases)
        ]
        objectives = plan.sweep.objectives
        limits = limits_of(plan)
        measured = measured_names(plan)
        names = ["candidate", "outcome", "samples", *(axis.name for axis in self._axes)]
        names += [one.column for one in objectives]
        names += [f"failing_{limit.metric}" for limit in limits]
        names += [f"{limit.metric}_median" for limit in limits if limit.metric in measured]
        table = dataset.read(list(dict.fromkeys(names)), chunks).to_pydict()
        at = np.array(table["candidate"]) - start
        held = np.column_stack([np.array(table[axis.name], dtype=np.float64) for axis in self._axes])
        if not np.array_equal(held, values[at]):
            problem = "holds other candidates than this search asks for: another version of optuna made it"
            raise FileError(dataset.path, problem, "Start the sweep anew")
        passed = np.array([one == PASS for one in table["outcome"]])
        short = np.where(passed, 0.0, np.maximum(sum(_beyond(limit, table) for limit in limits), 1e-3))
        for k, trial in enumerate(self._asked):
            mine = at == k
            trial.set_user_attr(_SHORT, float(short[mine].max()))
            told = [_worst(cost(one, np.array(table[one.column], dtype=np.float64)[mine])) for one in objectives]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._study.tell(trial, told)


def _constraint(trial: Any) -> tuple[float]:
    return (float(trial.user_attrs.get(_SHORT, 100.0)),)


def _beyond(limit: Limit, table: dict[str, list[Any]]) -> FloatArray:
    """By how much points miss a limit: the share of their samples that do, and how far the median is from it.

    Where no sample passes, the second tells what is nearer to passing.
    """
    samples = np.array(table["samples"], dtype=np.float64)
    share = np.where(samples > 0, np.array(table[f"failing_{limit.metric}"]) / np.maximum(samples, 1.0), 1.0)
    if f"{limit.metric}_median" not in table:
        return np.asarray(share + 1.0)
    median = np.array(table[f"{limit.metric}_median"], dtype=np.float64)
    over = [
        sign * (median - bound) / (abs(bound) or 1.0)
        for sign, bound in ((1.0, limit.maximum), (-1.0, limit.minimum))
        if bound is not None
    ]
    return np.asarray(share + np.clip(np.nan_to_num(np.max(over, axis=0), nan=1.0), 0.0, 1.0))


def _worst(costs: FloatArray) -> float:
    """Over the cases; what could not be measured in one is worse than anything that was."""
    return float(np.nan_to_num(costs, nan=1e9, posinf=1e9, neginf=-1e9).max())


def _suggestion(axis: ParameterAxis) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if axis.values:
        return CategoricalDistribution(list(axis.values))
    if axis.integer:
        return IntDistribution(int(axis.low), int(axis.high), log=axis.log)
    return FloatDistribution(axis.low, axis.high, log=axis.log)


def _value(axis: ParameterAxis, suggested: float) -> float:
    return float(as_stored(np.array([suggested]), axis.integer)[0])
