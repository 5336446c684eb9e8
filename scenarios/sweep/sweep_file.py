"""Sweep: axes, design, manoeuvres and limits of a sweep, read from one TOML file."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenarios.analysis import SHOWN_MARGINS
from scenarios.batch_flight import metrics_of
from scenarios.gain_set import load_gain_sets
from scenarios.limits import Limit
from scenarios.manoeuvres import Manoeuvre, parse_manoeuvres
from scenarios.metrics import LAST_S, SETTLE_S
from scenarios.monte_carlo import MAX_SAMPLES
from scenarios.scenario import LIBRARY_DIR, beside, read_limits
from scenarios.sweep.axes import ConditionAxis, ParameterAxis, parse_axes
from scenarios.sweep.objectives import Objective, parse_objectives
from scenarios.toml_file import read_toml
from sitl.errors import FileError, UsageError
from sitl.keyed_table import KeyedTable, nearest
from sitl.parameters import parameter_specs
from sitl.uncertainty import DISTRIBUTIONS, MAX_SPREAD, MIN_SPREAD, Distribution

SWEEPS_DIR = LIBRARY_DIR / "sweeps"
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
        fixed: PX4 parameters that every candidate has, INT32 as int; an axis replaces what it varies.
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
    fixed: Mapping[str, float | int]
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


def list_sweeps() -> tuple[str, ...]:
    """Names of the sweeps that come with the program."""
    return tuple(sorted(path.stem for path in SWEEPS_DIR.glob("*.toml")))


def find_sweep(name_or_path: str | Path) -> Path:
    """The file that is meant.

    Args:
        name_or_path: of the library (`roll_gains`), or the path of a TOML file.

    Raises:
        FileError: there is none; names the nearest of the library.
    """
    for path in (Path(name_or_path), SWEEPS_DIR / f"{name_or_path}.toml"):
        if path.is_file():
            return path
    known = list_sweeps()
    hint = f"In the library: {', '.join(known)}; or give the path of a .toml file"
    raise FileError(name_or_path, f"no such sweep{nearest(Path(name_or_path).stem, known)}", hint)


def load_sweep(name_or_path: str | Path) -> Sweep:
    """Read and check a sweep file.

    Args:
        name_or_path: as `find_sweep`.

    Raises:
        FileError: there is none, it cannot be read, or anything in it cannot be swept; names file, key and value.
    """
    path = find_sweep(name_or_path)
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
    _check_measured(file, limits, manoeuvres)
    sweep = Sweep(
        name=path.stem,
        title=file.text("title", path.stem),
        parameters=parameters,
        conditions=conditions,
        design=design,
        fixed=_fixed(file, path, [axis.name for axis in parameters]),
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


def _check_measured(file: KeyedTable, limits: tuple[Limit, ...], manoeuvres: tuple[Manoeuvre, ...]) -> None:
    """A limit on what is never measured would fail every point."""
    holds = [w.end_s - w.start_s for m in manoeuvres for w in m.windows if w.kind in ("step", "hold")]
    need_s = LAST_S + SETTLE_S
    if max(holds, default=0.0) < need_s - 1e-6:
        problem = f"none holds a step for {need_s:g} s, and where no oscillation is measured no point can pass"
        raise file.error("manoeuvre", problem, f'Add one of kind "step" with hold_s = {need_s:g} or more')
    measured = (*metrics_of(manoeuvres), *SHOWN_MARGINS)
    for limit in limits:
        if limit.metric not in measured:
            key = "limit" if "limit" in file else "limits"
            problem = f"{limit.metric} is not measured by these manoeuvres"
            raise file.error(key, problem, f"Add a manoeuvre that does, or limit one of {', '.join(measured)}")


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


def _fixed(file: KeyedTable, path: Path, varied: Collection[str]) -> dict[str, float | int]:
    """The gain set of `gains` and the table [parameters] on top of it; an axis replaces what the gain set has."""
    fixed: dict[str, float] = {}
    if "gains" in file:
        sets = load_gain_sets(beside(path, file.text("gains")))
        if len(sets) != 1:
            names = ", ".join(one.name for one in sets)
            raise file.error("gains", f"names {len(sets)} gain sets", f"Name one of them: {names}")
        fixed.update(sets[0].parameters)
    specs = parameter_specs()
    if "parameters" in file:
        table = file.table("parameters")
        for name in table.keys:
            if name not in specs:
                raise table.error(name, f"no such parameter{nearest(name, specs)}", "Correct or remove it")
            if name in varied:
                raise table.error(name, "it is an axis, too", "Leave it out of one of them")
            value = table.number(name)
            if specs[name].type == "INT32" and value != int(value):
                raise table.error(name, f"{value:g}: PX4 keeps it as a whole number", "Write a whole number")
            fixed[name] = value
    return typed(fixed)


def typed(values: Mapping[str, float]) -> dict[str, float | int]:
    """Parameters with those that are INT32 as int: a value that is no whole number stays, and is refused when set.

    Args:
        values: PX4 name -> value.
    """
    specs = parameter_specs()
    whole = {name for name, value in values.items() if name in specs and specs[name].type == "INT32"}
    return {n: int(v) if n in whole and math.isfinite(v) and v == int(v) else float(v) for n, v in values.items()}


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
