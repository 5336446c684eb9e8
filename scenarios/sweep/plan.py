"""Plan: a sweep with its vehicles resolved, its points numbered and cut into chunks.

A candidate is one choice of every parameter axis, a case one choice of every condition; a point is a candidate in a
case, and number `candidate * cases + case`. A chunk is a stretch of candidates in one case: what one worker does at a
time and one file of the dataset holds. Nothing of it depends on the engine or the number of workers.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from scenarios.gain_set import GainSet, check
from scenarios.roll_set import roll_set
from scenarios.scenario import beside
from scenarios.sweep.axes import ASSUMPTIONS, PROFILE, SCALING, VEHICLE
from scenarios.sweep.sweep_file import GRID, SEARCH, Sweep, check_count, typed
from sitl.errors import UsageError
from sitl.parameters import ParameterTable
from sitl.profile import Profile, get_profile
from sitl.vehicle_spec import DEFAULT_SCALING, VehicleModel, resolve_vehicle

CHUNK_STEPS = 40_000_000
"""Vehicle-steps of a chunk, about: half a second of one core."""
MOST_CHUNK = 4096
MOST_CASES = 10_000
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Case:
    """One choice of every condition.

    Attributes:
        conditions: name -> value, of the sweep's condition axes. model, profile: what they mean.
    """

    conditions: Mapping[str, Any]
    model: VehicleModel
    profile: Profile

    @property
    def name(self) -> str:
        """For people: `ant-x, motor_lag_s 0.01`."""
        words = [str(v) if k in (VEHICLE, PROFILE, SCALING) else f"{k} {v:g}" for k, v in self.conditions.items()]
        return ", ".join(words) or self.model.name


@dataclass(frozen=True)
class Chunk:
    """A stretch of candidates in one case.

    Attributes:
        number: of the chunk, and of its file. case: number of the case. start, stop: candidates.
    """

    number: int
    case: int
    start: int
    stop: int


@dataclass(frozen=True)
class Plan:
    """What is to be done; see `make_plan`.

    Attributes:
        sweep: as read. cases: in the order of the axes, the last varying quickest. candidates: how many.
        block: candidates of a chunk.
        warnings: for people, one line each.
    """

    sweep: Sweep
    cases: tuple[Case, ...]
    candidates: int
    block: int
    warnings: tuple[str, ...] = ()

    @property
    def points(self) -> int:
        """Candidates times cases."""
        return self.candidates * len(self.cases)

    @property
    def samples(self) -> int:
        """Models that each point flies, the nominal one included."""
        return self.sweep.samples + 1

    @property
    def blocks(self) -> int:
        """Stretches of candidates."""
        return math.ceil(self.candidates / self.block)

    @property
    def chunks(self) -> int:
        """Files of the whole dataset."""
        return self.blocks * len(self.cases)

    def chunk(self, number: int) -> Chunk:
        """A chunk by number; those of one stretch of candidates follow one another."""
        block, case = divmod(number, len(self.cases))
        start = block * self.block
        return Chunk(number, case, start, min(start + self.block, self.candidates))

    @cached_property
    def steps_per_point(self) -> int:
        """Vehicle-steps of one point, the mean over the cases."""
        total = sum(round(m.duration_s * case.profile.rate_hz) for case in self.cases for m in self.sweep.manoeuvres)
        return math.ceil(total * self.samples / len(self.cases))

    def description(self) -> dict[str, Any]:
        """Everything that the results depend on but the program itself, as JSON keeps it."""
        sweep = self.sweep
        return {
            "schema_version": SCHEMA_VERSION,
            "parameters": [dataclasses.asdict(axis) for axis in sweep.parameters],
            "design": dataclasses.asdict(sweep.design),
            "fixed": dict(sweep.fixed),
            "manoeuvres": [dataclasses.asdict(one) for one in sweep.manoeuvres],
            "setpoint_rate_hz": sweep.setpoint_rate_hz,
            "limits": [dataclasses.asdict(limit) for limit in sweep.limits],
            "margins": sweep.margins,
            "required_pass_pct": sweep.required_pass_pct,
            "samples": sweep.samples,
            "seed": sweep.seed,
            "distribution": sweep.distribution,
            "spread_sigma": sweep.spread_sigma,
            "objectives": [one.column for one in sweep.objectives],
            "block": self.block,
            "candidates": self.candidates,
            "cases": [_case_description(case) for case in self.cases],
        }

    @cached_property
    def fingerprint(self) -> str:
        """Of `description`: two plans with the same one give the same rows."""
        text = json.dumps(self.description(), sort_keys=True, default=plain)
        return hashlib.sha256(text.encode()).hexdigest()


def _case_description(case: Case) -> dict[str, Any]:
    model = case.model
    return {
        "conditions": dict(case.conditions),
        "vehicle": model.name,
        "derivatives": dataclasses.asdict(model.derivatives),
        "sigma_pct": dataclasses.asdict(model.sigma_pct),
        "assumptions": dataclasses.asdict(model.assumptions),
        "rotors": [dataclasses.asdict(rotor) for rotor in model.airframe.rotors],
        "profile": dataclasses.asdict(case.profile),
    }


def plain(value: Any) -> Any:
    """What JSON does not know by itself."""
    if isinstance(value, set | frozenset):
        return sorted(value)
    return value.item() if hasattr(value, "item") else str(value)


def make_plan(sweep: Sweep) -> Plan:
    """Resolve the vehicles and number the points; nothing is flown yet.

    Args:
        sweep: as read.

    Raises:
        UsageError, FileError: too many points; a vehicle, a profile item or a value that cannot be flown.
    """
    cases = _cases(sweep)
    candidates = sweep.design.points
    if sweep.design.kind == GRID:
        candidates = math.prod(len(axis.values) for axis in sweep.parameters)
    check_count(candidates, len(cases), sweep.path)
    warnings = _check_values(sweep, cases)
    plan = Plan(sweep, tuple(cases), candidates, 1, tuple(warnings))
    block = min(MOST_CHUNK, max(1, CHUNK_STEPS // plan.steps_per_point), candidates)
    if sweep.design.kind == SEARCH:
        block = min(block, max(1, sweep.design.generation // 8))
        while sweep.design.generation % block:  # a chunk belongs to one generation
            block -= 1
    return dataclasses.replace(plan, block=block)


def _cases(sweep: Sweep) -> list[Case]:
    axes = {axis.name: axis.values for axis in sweep.conditions}
    count = math.prod(len(values) for values in axes.values())
    if count > MOST_CASES:
        raise UsageError(
            f"{sweep.path}: {count:,} combinations of conditions; at most {MOST_CASES:,}. Give fewer values"
        )
    cases: dict[str, Case] = {}
    models: dict[tuple[str, str], VehicleModel] = {}
    for values in itertools.product(*axes.values()):
        conditions = dict(zip(axes, values, strict=True))
        named, scaling = str(conditions.get(VEHICLE, "ant-x")), conditions.get(SCALING)
        spec = ":".join(beside(sweep.path, part) for part in named.split(":"))
        words = DEFAULT_SCALING if scaling is None else tuple(w.strip() for w in str(scaling).split(",") if w.strip())
        items = {name: value for name, value in conditions.items() if name not in (VEHICLE, SCALING, PROFILE)}
        assumed = {name: float(items.pop(name)) for name in ASSUMPTIONS if name in items}
        try:
            model = models.get((spec, ",".join(words))) or resolve_vehicle(spec, words)
            models[spec, ",".join(words)] = model
            profile = get_profile(str(conditions.get(PROFILE, "sitl")), **items)
        except UsageError as error:
            raise UsageError(f"{sweep.path}: axes: {error}") from error
        if model.reference is None and SCALING in conditions:
            conditions[SCALING] = ""  # an identified airframe is not scaled: one case, however many words
        model = dataclasses.replace(model, assumptions=dataclasses.replace(model.assumptions, **assumed))
        case = Case(conditions, model, profile)
        _check_rate(sweep, case)
        cases.setdefault(json.dumps(conditions, sort_keys=True), case)
    return list(cases.values())


def _check_rate(sweep: Sweep, case: Case) -> None:
    ticks = case.profile.rate_hz / sweep.setpoint_rate_hz
    if abs(ticks - round(ticks)) > 1e-9:
        raise UsageError(
            f"{sweep.path}: setpoint_rate_hz = {sweep.setpoint_rate_hz:g} does not divide the "
            f"{case.profile.rate_hz} Hz of {case.name}: a set-point must be due on a tick. Try 50"
        )


def _check_values(sweep: Sweep, cases: Sequence[Case]) -> list[str]:
    """Both ends of every axis and the fixed parameters as a gain set is checked before it is uploaded."""
    warnings: list[str] = []
    table = ParameterTable()
    warnings += check(GainSet("[parameters] and gains", sweep.fixed, path=sweep.path), table)
    for axis in sweep.parameters:
        ends = [typed({axis.name: value}) for value in (axis.low, axis.high)]
        for end in ends:
            warnings += check(GainSet("[axes]", end, path=sweep.path), table)
        if axis.low != axis.high and not any(_acts(sweep, case, *ends) for case in cases):
            warnings.append(f"{axis.name} does not act on the roll axis: the batch cannot tell its values apart")
    return list(dict.fromkeys(warnings))


_PER_AXIS = ("att_gain", "rate_max", "int_lim", "k", "kp", "ki", "kd", "kff")
_OF_YAW = ("yaw_weight", "yaw_torque_alpha")


def _of_roll(settings: npt.NDArray[np.void]) -> bytes:
    """Settings without what the other axes alone have."""
    rest = settings.copy()
    for name in _PER_AXIS:
        rest[name][1:] = 0.0
    for name in _OF_YAW:
        rest[name] = 0.0
    # field by field: what lies between the fields of a record is not ours
    return b"".join(np.asarray(rest[name]).tobytes() for name in rest.dtype.names or ())


def _acts(sweep: Sweep, case: Case, low: Mapping[str, float], high: Mapping[str, float]) -> bool:
    """Do two values of a parameter make two different loops?"""
    try:
        one, other = (roll_set(case.model, case.profile, {**sweep.fixed, **end}) for end in (low, high))
    except UsageError as error:
        raise UsageError(f"{sweep.path}: axes: {error}") from error
    return _of_roll(one.settings) != _of_roll(other.settings) or one.profile != other.profile
