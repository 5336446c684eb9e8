"""Sweep: axes, design, manoeuvres and limits of a sweep, read from one TOML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenarios.analysis import SHOWN_MARGINS
from scenarios.gain_set import load_gain_sets
from scenarios.limits import Limit
from scenarios.manoeuvres import Manoeuvre, parse_manoeuvres
from scenarios.monte_carlo import MAX_SAMPLES
from scenarios.scenario import beside, read_limits
from scenarios.sweep.axes import ConditionAxis, ParameterAxis, parse_axes
from scenarios.sweep.objectives import Objective, parse_objectives
from scenarios.toml_file import read_toml
from sitl.errors import UsageError
from sitl.keyed_table import KeyedTable, nearest
from sitl.parameters import parameter_specs
from sitl.uncertainty import DISTRIBUTIONS, MAX_SPREAD, MIN_SPREAD, Distribution

GRID, SOBOL, LATIN, SEARCH = "grid", "sobol", "latin-hypercube", "search"
DESIGNS = (GRID, SOBOL, LATIN, SEARCH)
MARGINS = ("samples", "nominal", "none")

MOST_POINTS = 100_000_000
MOST_LATIN = 1_000_000
"""Candidates of a Latin hypercube, which is made as a whole: 8 bytes a candidate and axis."""
MOST_SEARCH = 100_000


@dataclass(frozen=True)
class Design:
    """How candidates are chosen.

    Attributes:
        kind: one of DESIGNS. points: candidates; 0 for a grid, whose axes say it. seed: of the design.
        generation: candidates that a search asks for at a time.
    """

    kind: str
    points: int
    seed: int
    generation: int


@dataclass(frozen=True)
class Sweep:
    """What is judged, and how.

    Attributes:
        name: the file's name without suffix. title: one line for reports.
        parameters, conditions: axes. design: how candidates are chosen among the parameters' values.
        fixed: PX4 parameters that every candidate has; an axis replaces what it varies.
        manoeuvres, setpoint_rate_hz: flown by every sample. limits, limits_name: on each sample's metrics.
        margins: of the loop, worked out on every sample, on the nominal model alone, or not at all.
        required_pass_pct: of the samples, for a point to pass.
        samples, seed, distribution, spread_sigma: of the uncertain models beside the nominal one.
        objectives: what is better among candidates that pass alike; the first ranks, the first two make the Pareto
            front.
        path: the file. text: as it was read.
    """

    name: str
    title: str
    parameters: tuple[ParameterAxis, ...]
    conditions: tuple[ConditionAxis, ...]
    design: Design
    fixed: Mapping[str, float]
    manoeuvres: tuple[Manoeuvre, ...]
    setpoint_rate_hz: float
    limits: tuple[Limit, ...]
    limits_name: str
    margins: str
    required_pass_pct: float
    samples: int
    seed: int
    distribution: Distribution
    spread_sigma: float
    objectives: tuple[Objective, ...]
    path: Path
    text: str


def load_sweep(path: Path) -> Sweep:
    """Read and check a sweep file.

    Args:
        path: of the TOML file.

    Raises:
        FileError: it cannot be read, or anything in it cannot be swept; names file, key and value.
    """
    data = read_toml(path)
    file = KeyedTable(path, data)
    text = path.read_text(encoding="utf-8")
    rate_hz = file.number("setpoint_rate_hz", 50.0, at_least=5.0, at_most=500.0)
    design = _design(file)
    axes = file.table("axes")
    parameters, conditions = parse_axes(axes, axes.keys, sampled=design.kind != GRID)
    if design.kind == GRID and design.points:
        raise file.error("design", "a grid has as many points as its axes say", "Leave points out")
    limits, limits_name = read_limits(file)
    manoeuvres = parse_manoeuvres(data["manoeuvre"] if "manoeuvre" in file else _DEFAULT, path, rate_hz)
    margins = _choice(file, "margins", MARGINS, _margins_needed(limits))
    metrics = {limit.metric for limit in limits} & set(SHOWN_MARGINS)
    if margins == "none" and metrics:
        raise file.error("margins", f'"none", but {sorted(metrics)[0]} is limited', 'Write "samples" or "nominal"')
    sweep = Sweep(
        name=path.stem,
        title=file.text("title", path.stem),
        parameters=parameters,
        conditions=conditions,
        design=design,
        fixed=_fixed(file, path),
        manoeuvres=manoeuvres,
        setpoint_rate_hz=rate_hz,
        limits=limits,
        limits_name=limits_name,
        margins=margins,
        required_pass_pct=file.number("required_pass_pct", 100.0, at_least=0.0, at_most=100.0),
        samples=_whole(file, "samples", 100, 0, MAX_SAMPLES),
        seed=_whole(file, "seed", 1, 0, 2**53),
        distribution=_choice(file, "distribution", DISTRIBUTIONS, DISTRIBUTIONS[0]),  # type: ignore[arg-type]
        spread_sigma=file.number("spread_sigma", 3.0, at_least=MIN_SPREAD, at_most=MAX_SPREAD),
        objectives=parse_objectives(file, manoeuvres, margins != "none"),
        path=path,
        text=text,
    )
    file.finish()
    return sweep


_DEFAULT: list[dict[str, Any]] = [{"kind": "step", "amplitude_deg": 10.0, "hold_s": 3.0, "return_s": 3.0}]


def _margins_needed(limits: tuple[Limit, ...]) -> str:
    return "samples" if any(limit.metric in SHOWN_MARGINS for limit in limits) else "nominal"


def _design(file: KeyedTable) -> Design:
    if "design" not in file:
        return Design(GRID, 0, 1, 0)
    table = file.table("design")
    kind = _choice(table, "kind", DESIGNS, GRID)
    most = {LATIN: MOST_LATIN, SEARCH: MOST_SEARCH}.get(kind, MOST_POINTS)
    points = 0
    if kind != GRID or "points" in table:
        points = _whole(table, "points", None, 1, most)
    generation = _whole(table, "generation", 64, 2, 10_000) if kind == SEARCH else 0
    design = Design(kind, points, _whole(table, "seed", 1, 0, 2**31 - 1), generation)
    table.finish()
    return design


def _fixed(file: KeyedTable, path: Path) -> dict[str, float]:
    """The gain set of `gains` and the table [parameters] on top of it."""
    fixed: dict[str, float] = {}
    if "gains" in file:
        sets = load_gain_sets(beside(path, file.text("gains")))
        if len(sets) != 1:
            names = ", ".join(one.name for one in sets)
            raise file.error("gains", f"names {len(sets)} gain sets", f"Name one of them: {names}")
        fixed.update({name: float(value) for name, value in sets[0].parameters.items()})
    if "parameters" in file:
        table = file.table("parameters")
        for name in table.keys:
            if name not in parameter_specs():
                problem = f"no such parameter{nearest(name, parameter_specs())}"
                raise table.error(name, problem, "Correct or remove it")
            fixed[name] = table.number(name)
    return fixed


def _choice(file: KeyedTable, key: str, known: tuple[str, ...], default: str) -> str:
    value = file.text(key, default)
    if value not in known:
        raise file.error(key, f'"{value}" is not known{nearest(value, known)}', f"Known: {', '.join(known)}")
    return value


def _whole(file: KeyedTable, key: str, default: int | None, low: int, high: int) -> int:
    value = file.number(key, None if default is None else float(default), at_least=float(low), at_most=float(high))
    if value != int(value):
        raise file.error(key, f"{value:g} is not a whole number", "Write a whole number")
    return int(value)


def check_count(candidates: int, cases: int, path: Path) -> None:
    """Refuse a sweep that would never end.

    Args:
        candidates, cases: to be multiplied. path: the file.

    Raises:
        UsageError: more than MOST_POINTS.
    """
    if candidates * cases > MOST_POINTS:
        raise UsageError(
            f"{path}: {candidates:,} candidates x {cases:,} conditions are {candidates * cases:.3g} points; at most "
            f'{MOST_POINTS:,} are swept. Give the axes fewer values, or sample them: [design] kind = "sobol"'
        )
