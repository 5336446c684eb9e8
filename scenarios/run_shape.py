"""What `run.json` looks like, so that whoever reads a run finds every key, with a value of the right kind.

A file that was cut, edited or damaged may still be JSON. What is wrong in it is replaced by "nothing" and told, and
the rest stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

MOST_TOLD = 8
"""So many complaints; of the others only how many there are."""


@dataclass(frozen=True)
class Kind:
    """A single value.

    Attributes:
        name: as complaints call it. holds: is a value of this kind? nothing: what stands for a missing one.
    """

    name: str
    holds: Callable[[Any], bool]
    nothing: Any


@dataclass(frozen=True)
class Each:
    """Objects with any keys (`many` False), or lists (True), whose items all obey one rule."""

    rule: Any
    many: bool = False


@dataclass(frozen=True)
class Maybe:
    """Null, absent, or what the rule says."""

    rule: Any


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63


TEXT = Kind("a text", lambda value: isinstance(value, str), "")
NUMBER = Kind("a number", lambda value: value is None or _number(value), None)
REAL = Kind("a number", _number, 0.0)
COUNT = Kind("a whole number", _count, 0)
FLAG = Kind("true or false", lambda value: isinstance(value, bool), False)
ANY = Kind("anything", lambda _: True, None)
VERDICT = Kind(
    "PASS, FAIL, UNSET or INFO",
    lambda value: isinstance(value, str) and value in ("PASS", "FAIL", "UNSET", "INFO"),
    "UNSET",
)
TEXTS = Each(TEXT, many=True)
NUMBERS = Each(REAL)

METRIC = {
    "name": TEXT,
    "segment": TEXT,
    "value": NUMBER,
    "unit": TEXT,
    "meaning": TEXT,
    "limit": Maybe(TEXT),
    "outcome": VERDICT,
    "reason": TEXT,
}
SEGMENT = {
    "name": TEXT,
    "kind": TEXT,
    "manoeuvre": TEXT,
    "start_s": REAL,
    "end_s": REAL,
    "amplitude_rad": REAL,
    "phi_from_rad": REAL,
}
FAULT = {"kind": TEXT, "settings": Each(ANY)}
FLIGHT = {
    "gain_set": {"name": TEXT, "source": TEXT, "note": TEXT, "file": Maybe(TEXT), "parameters": NUMBERS},
    "vehicle": TEXT,
    "seed": COUNT,
    "outcome": VERDICT,
    "reason": TEXT,
    "warnings": TEXTS,
    "uploaded": NUMBERS,
    "metrics": Each(METRIC, many=True),
    "margins": Each(ANY),
    "segments": Each(SEGMENT, many=True),
    "faults": Each(
        {
            **FAULT,
            "text": TEXT,
            "plan": TEXT,
            "start_s": NUMBER,
            "end_s": NUMBER,
            "datagrams": Maybe(Each(COUNT, many=True)),
        },
        many=True,
    ),
    "events": Each({"t_s": REAL, "severity": COUNT, "text": TEXT}, many=True),
    "rows": COUNT,
    "telemetry_sha256": TEXT,
    "files": Each(TEXT),
}
TWIN = {
    "gain_set": TEXT,
    "outcome": VERDICT,
    "own_outcome": VERDICT,
    "verdicts_agree": FLAG,
    "agree": FLAG,
    "cycling": FLAG,
    "alone": TEXTS,
    "outside": TEXTS,
    "quantities": Each(
        {
            "name": TEXT,
            "segment": TEXT,
            "real": NUMBER,
            "own": NUMBER,
            "difference": NUMBER,
            "within": Maybe(FLAG),
            "reason": TEXT,
            "unit": TEXT,
            "tolerance": NUMBER,
            "meaning": TEXT,
        },
        many=True,
    ),
    "own": FLIGHT,
}
SCENARIO = {
    "name": TEXT,
    "title": TEXT,
    "file": Maybe(TEXT),
    "vehicle": TEXT,
    "scaling": TEXTS,
    "profile": TEXT,
    "overrides": Each(ANY),
    "assumptions": Each(ANY),
    "axes": TEXT,
    "takeoff_altitude_m": NUMBER,
    "setpoint_rate_hz": NUMBER,
    "gain_sets": TEXTS,
    "manoeuvres": Each({"name": TEXT, "kind": TEXT, "duration_s": NUMBER, "settings": Each(ANY)}, many=True),
    "limits_name": TEXT,
    "limits": Each({"metric": TEXT, "minimum": NUMBER, "maximum": NUMBER}, many=True),
    "gate": Each(ANY),
    "faults": Each({**FAULT, "at_s": REAL, "manoeuvre": TEXT, "duration_s": NUMBER}, many=True),
}
VEHICLE = {
    "spec": TEXT,
    "name": TEXT,
    "title": TEXT,
    "reference": Maybe(TEXT),
    "froude_number": NUMBER,
    "scaling": TEXTS,
    "derivatives": NUMBERS,
    "derivative_units": Each(TEXT),
    "sigma_pct": Each(NUMBER),
    "assumptions": Each(ANY),
    "flight_gains": Maybe(NUMBERS),
    "layout": TEXT,
    "mass_kg": NUMBER,
    "diagonal_m": NUMBER,
    "rotors": Each(NUMBERS, many=True),
}
RUN = {
    "schema_version": COUNT,
    "complete": FLAG,
    "started_utc": TEXT,
    "command": TEXTS,
    "versions": Each(TEXT),
    "seed": COUNT,
    "folder": Maybe(TEXT),
    "scenario": SCENARIO,
    "vehicle": VEHICLE,
    "profile": Each({"item": TEXT, "value": ANY, "unit": TEXT}, many=True),
    "own_gains": Maybe({"gain_set": TEXT, "fly": Maybe(FLAG), "outcome": VERDICT, "reason": TEXT}),
    "flown": COUNT,
    "passed": COUNT,
    "flights": Each(FLIGHT, many=True),
    "baseline": Maybe(FLIGHT),
    "twins": Each(TWIN, many=True),
}
CAME_LATER = frozenset({"twins", "faults"})
"""Keys that the present schema version got after others had written it already: not there is no damage."""


def conform(run: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Fill what is missing and replace what cannot be.

    Args:
        run: a `run.json` of the present schema version, perhaps damaged.

    Returns:
        The run with every key of `RUN`, keys beyond it as they are, and what was wrong, a sentence each.
    """
    wrong: list[str] = []
    whole: dict[str, Any] = _checked(run, RUN, "", wrong)
    if len(wrong) > MOST_TOLD:
        wrong = [*wrong[:MOST_TOLD], f"{len(wrong) - MOST_TOLD} more like these"]
    return whole, tuple(wrong)


def fitted(value: Any, rule: Any) -> Any:
    """A value made to obey a rule, without complaints.

    Args:
        value: of a part of a run. rule: of this module.
    """
    return _checked(value, rule, "", [])


def nothing(rule: Any) -> Any:
    """What stands for a value that is not there: every key of an object, each with its own nothing."""
    if isinstance(rule, Kind):
        return rule.nothing
    if isinstance(rule, Maybe):
        return None
    if isinstance(rule, Each):
        return [] if rule.many else {}
    return {key: nothing(part) for key, part in rule.items()}


def _checked(value: Any, rule: Any, where: str, wrong: list[str]) -> Any:
    wanted = _unfit(value, rule)
    if wanted:
        wrong.append(f"{where} is {_shown(value)}, not {wanted}")
        return nothing(rule)
    if isinstance(rule, Kind) or value is None:
        return value
    if isinstance(rule, Maybe):
        return _checked(value, rule.rule, where, wrong)
    if isinstance(rule, Each):
        return _items(value, rule, where, wrong)
    known = {}
    for key, part in rule.items():
        if key in value:
            known[key] = _checked(value[key], part, _inside(where, key), wrong)
        else:
            known[key] = nothing(part)
            if not isinstance(part, Maybe) and key not in CAME_LATER:
                wrong.append(f"{_inside(where, key)} is missing")
    return {**value, **known}


def _items(value: Any, rule: Each, where: str, wrong: list[str]) -> Any:
    """Of a list or an object: an item that cannot be is left out, for nothing that could stand for it is true."""
    named = [(f"{where}[{n}]", n, item) for n, item in enumerate(value)] if rule.many else []
    named = named or [(_inside(where, key), key, item) for key, item in ({} if rule.many else value).items()]
    kept = {}
    for name, key, item in named:
        wanted = _unfit(item, rule.rule)
        if wanted:
            wrong.append(f"{name} is {_shown(item)}, not {wanted}: left out")
        else:
            kept[key] = _checked(item, rule.rule, name, wrong)
    return list(kept.values()) if rule.many else kept


def _unfit(value: Any, rule: Any) -> str:
    """What was wanted instead, looking at the value alone and not into it; empty if it may be."""
    if isinstance(rule, Maybe):
        return "" if value is None else _unfit(value, rule.rule)
    if isinstance(rule, Kind):
        return "" if rule.holds(value) else rule.name
    if isinstance(rule, Each) and rule.many:
        return "" if isinstance(value, list) else "a list"
    return "" if isinstance(value, Mapping) else "an object"


def _shown(value: Any) -> str:
    shown = repr(value) if not isinstance(value, list | Mapping) else f"a {type(value).__name__}"
    return shown if len(shown) <= 40 else shown[:37] + "..."


def _inside(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key
