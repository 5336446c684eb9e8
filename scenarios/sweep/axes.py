"""Axes of a sweep: PX4 parameters that make a candidate, and conditions that every candidate is judged under."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scenarios.scenario import ASSUMPTION_RANGES
from sitl.errors import FileError
from sitl.keyed_table import KeyedTable, nearest
from sitl.parameters import ParameterSpec, parameter_specs
from sitl.profile import PROFILES, Profile

FloatArray = npt.NDArray[np.float64]

VEHICLE, SCALING, PROFILE = "vehicle", "scaling", "profile"
PROFILE_ITEMS = tuple(field.name for field in dataclasses.fields(Profile) if field.name != "name")
ASSUMPTIONS = tuple(name for name in ASSUMPTION_RANGES if name not in PROFILE_ITEMS)
CONDITIONS = (VEHICLE, SCALING, PROFILE, *PROFILE_ITEMS, *ASSUMPTIONS)
"""Axes that are no PX4 parameter. A motor lag or a delay is an item of the profile."""

MOST_VALUES = 100_000
"""Values of one axis."""

_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class ParameterAxis:
    """A PX4 parameter that is varied.

    Attributes:
        name: of the parameter. integer: PX4 keeps it as INT32.
        values: to choose from, in the parameter's own unit, as PX4 stores them; empty for a range that a design
            samples.
        low, high: ends of the range. log: evenly spaced in the logarithm.
    """

    name: str
    integer: bool
    values: tuple[float, ...]
    low: float
    high: float
    log: bool = False

    def at(self, unit: FloatArray) -> FloatArray:
        """Values at places of the unit interval, as PX4 stores them.

        Args:
            unit: (n,) from 0 to 1.
        """
        if self.values:
            at = np.minimum((unit * len(self.values)).astype(int), len(self.values) - 1)
            return np.asarray(np.array(self.values)[at])
        if self.log:
            low, high = math.log(self.low), math.log(self.high)
            return as_stored(np.exp(low + (high - low) * unit), self.integer)
        return as_stored(self.low + (self.high - self.low) * unit, self.integer)


@dataclass(frozen=True)
class ConditionAxis:
    """Something about the vehicle or the loop around it that is varied.

    Attributes:
        name: one of CONDITIONS. values: texts for vehicle, scaling and profile; else of the item's own type.
    """

    name: str
    values: tuple[Any, ...]


def as_stored(values: FloatArray, integer: bool) -> FloatArray:
    """Values as PX4 keeps them: whole numbers, or float32.

    Args:
        values: any shape. integer: of an INT32 parameter.
    """
    return np.rint(values) if integer else values.astype(np.float32).astype(np.float64)


def parse_axes(
    table: KeyedTable, names: Sequence[str], sampled: bool
) -> tuple[tuple[ParameterAxis, ...], tuple[ConditionAxis, ...]]:
    """The table [axes] of a sweep file.

    Args:
        table: of the file. names: its keys. sampled: the design takes its points from ranges, so that a parameter's
            range needs no count.

    Raises:
        FileError: unknown axis, no values, values that are not of its kind; names file and key.
    """
    parameters, conditions = [], []
    specs = parameter_specs()
    for name in names:
        if name in specs:
            parameters.append(_parameter(table, name, specs[name], sampled))
        elif name in CONDITIONS:
            conditions.append(_condition(table, name))
        else:
            near = nearest(name, [*specs, *CONDITIONS])
            known = f"An axis is a PX4 parameter, or one of {', '.join(CONDITIONS)}"
            raise table.error(name, f"no such parameter or condition{near}", known)
    if not parameters:
        remedy = "Add one, such as MC_ROLLRATE_P = { from = 0.05, to = 0.3 }"
        raise FileError(table.path, "axes: no PX4 parameter is varied", remedy)
    return tuple(parameters), tuple(conditions)


def _parameter(table: KeyedTable, name: str, spec: ParameterSpec, sampled: bool) -> ParameterAxis:
    value = table.anything(name)
    integer = spec.type == "INT32"
    if isinstance(value, dict):
        span = table.table(name)
        low, high = span.number("from"), span.number("to")
        count = _count(span) if "count" in span else 0
        log = _scale(span, low)
        span.finish()
        if low >= high:
            raise span.error("from", f"{low:g} is not below to = {high:g}", "Swap them, or give a list of values")
        for key, end in (("from", low), ("to", high)):
            _storable(span, key, end, end, integer)
        if not count and not sampled:
            raise span.error("count", "missing key: a grid needs to know how many values", "Add count = 10")
        axis = ParameterAxis(name, integer, (), low, high, log)
        if count:
            places = np.linspace(0.0, 1.0, count) if count > 1 else np.array([0.5])
            values = _distinct(axis.at(places))
            return dataclasses.replace(axis, values=values, low=min(values), high=max(values))
        return axis
    numbers = [_number(table, name, one) for one in _list(table, name, value)]
    for one, number in zip(value, numbers, strict=True):
        _storable(table, name, one, number, integer)
    values = _distinct(as_stored(np.array(numbers), integer))
    return ParameterAxis(name, integer, values, min(values), max(values))


def _storable(table: KeyedTable, key: str, shown: object, value: float, integer: bool) -> None:
    if integer and (value != int(value) or not -(2**31) <= value < 2**31):
        raise table.error(key, f"{shown!r}: PX4 keeps it as a whole number", "Give whole numbers of 32 bits")
    if not integer and abs(value) > _LARGEST:
        raise table.error(key, f"{shown!r} is more than PX4 can keep", "Give a number of 32 bits")


def _distinct(values: FloatArray) -> tuple[float, ...]:
    return tuple(dict.fromkeys(values.tolist()))


def _count(span: KeyedTable) -> int:
    count = span.number("count", at_least=1.0, at_most=float(MOST_VALUES))
    if count != int(count):
        raise span.error("count", f"{count:g} is not a whole number", "Write a whole number")
    return int(count)


def _scale(span: KeyedTable, low: float) -> bool:
    scale = span.text("scale", "linear")
    if scale not in ("linear", "log"):
        raise span.error("scale", f'"{scale}" is not known', 'Write "linear" or "log"')
    if scale == "log" and low <= 0.0:
        raise span.error("from", f"{low:g} has no logarithm", 'Begin above 0, or write scale = "linear"')
    return scale == "log"


def _condition(table: KeyedTable, name: str) -> ConditionAxis:
    value = table.anything(name)
    if name in (VEHICLE, SCALING, PROFILE):
        values = _list(table, name, [value] if isinstance(value, str) else value)
        for one in values:
            if not isinstance(one, str):
                raise table.error(name, f"{one!r} is not a text", "Quote it")
            if name == PROFILE and one not in PROFILES:
                raise table.error(
                    name, f'unknown profile "{one}"{nearest(one, PROFILES)}', f"Known: {', '.join(PROFILES)}"
                )
        return ConditionAxis(name, tuple(dict.fromkeys(values)))
    if isinstance(value, dict):
        span = table.table(name)
        low, high = span.number("from"), span.number("to")
        if "count" not in span:
            raise span.error("count", "missing key: every candidate is judged under each of them", "Add count = 5")
        count, log = _count(span), _scale(span, low)
        span.finish()
        if low > high:
            raise span.error("from", f"{low:g} is not below to = {high:g}", "Swap them, or give a list of values")
        values = (np.geomspace(low, high, count) if log else np.linspace(low, high, count)).tolist()
    else:
        values = _list(table, name, [value] if isinstance(value, int | float) else value)
    for one in values:
        if not isinstance(one, bool | int | float):
            raise table.error(name, f"{one!r} is not a number", "Give numbers without quotes")
        if isinstance(one, bool) != isinstance(values[0], bool):
            raise table.error(name, f"{values!r} has both true or false and numbers", "Give values of one kind")
        if name in ASSUMPTIONS:
            low, high = ASSUMPTION_RANGES[name]
            if isinstance(one, bool) or not low <= one <= high:
                raise table.error(name, f"{one!r} is out of range", f"It must be from {low:g} to {high:g}")
    return ConditionAxis(name, tuple(dict.fromkeys(values)))


def _list(table: KeyedTable, name: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise table.error(
            name, f"{value!r} is not a list of values", "Write [a, b, c], or { from = a, to = b, count = n }"
        )
    if not value:
        raise table.error(name, "the axis has no values", "Give at least one, or leave the axis out")
    if len(value) > MOST_VALUES:
        raise table.error(name, f"{len(value)} values", f"At most {MOST_VALUES}")
    return value


def _number(table: KeyedTable, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise table.error(name, f"{value!r} is not a finite number", "Give numbers without quotes")
    return float(value)
