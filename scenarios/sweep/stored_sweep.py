"""A sweep as its folder tells it: `sweep.json` alone, so that it can be looked at wherever the folder was taken.

Neither the sweep file nor the vehicles it names need to be there any more, and no law is loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from scenarios.analysis import HIGH_IS_GOOD
from scenarios.limits import STANDING, Limit
from scenarios.sweep.axes import ParameterAxis
from scenarios.sweep.dataset import SWEEP_JSON, Dataset
from scenarios.sweep.objectives import STATISTICS, Objective
from sitl.errors import FileError


@dataclass(frozen=True)
class StoredSweep:
    """What was swept.

    Attributes:
        path: of the folder. facts: of `sweep.json`.
    """

    path: Path
    facts: Mapping[str, Any]

    @property
    def plan(self) -> Mapping[str, Any]:
        """As `Plan.description` gave it."""
        plan: Mapping[str, Any] = self.facts["plan"]
        return plan

    @property
    def name(self) -> str:
        """Of the sweep file, without suffix."""
        return Path(self.facts["file"]).stem

    @property
    def title(self) -> str:
        """One line for people."""
        return str(self.facts["title"])

    @property
    def candidates(self) -> int:
        """How many there are to be."""
        return int(self.facts["candidates"])

    @property
    def cases(self) -> tuple[str, ...]:
        """Names for people, in the order of their numbers."""
        return tuple(self.facts["cases"])

    @property
    def of(self) -> int:
        """Models whose share counts: the uncertain ones, or the nominal one if it is alone."""
        return max(1, int(self.plan["samples"]))

    @cached_property
    def axes(self) -> tuple[ParameterAxis, ...]:
        """Parameters that make a candidate."""
        return tuple(
            ParameterAxis(one["name"], one["integer"], tuple(one["values"]), one["low"], one["high"], one["log"])
            for one in self.plan["parameters"]
        )

    @cached_property
    def objectives(self) -> tuple[Objective, ...]:
        """What is better among candidates that pass alike."""
        return tuple(_objective(column) for column in self.plan["objectives"])

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """That every sample must keep, the standing one among them."""
        named = [Limit(one["metric"], one["minimum"], one["maximum"]) for one in self.plan["limits"]]
        return tuple({limit.metric: limit for limit in (STANDING, *named)}.values())

    def parameters(self, values: Mapping[str, float]) -> dict[str, float | int]:
        """The whole gain set of a candidate.

        Args:
            values: of its axes.
        """
        from sitl.parameters import parameter_specs

        specs = parameter_specs()
        every = {**self.plan["fixed"], **values}
        return {name: int(value) if specs[name].type == "INT32" else float(value) for name, value in every.items()}


def _objective(column: str) -> Objective:
    metric, _, statistic = column.rpartition("_")
    assert statistic in STATISTICS
    return Objective(metric, statistic, metric in HIGH_IS_GOOD)


def stored_sweep(path: Path) -> StoredSweep:
    """The sweep of a folder.

    Args:
        path: of the folder.

    Raises:
        FileError: it is no sweep, or `sweep.json` is damaged or of another schema.
    """
    sweep = StoredSweep(path, Dataset(path).facts())
    try:
        assert sweep.axes
        assert sweep.limits
        assert sweep.candidates * len(sweep.cases) == int(sweep.facts["points"])
        assert (sweep.title, sweep.name, sweep.objectives, sweep.of) is not None
    except (KeyError, TypeError, ValueError, AssertionError) as error:
        problem = f"is damaged: {type(error).__name__} {error}".rstrip()
        raise FileError(path / SWEEP_JSON, problem, "Start the sweep anew") from error
    return sweep
