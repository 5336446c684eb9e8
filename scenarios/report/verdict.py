"""The verdict in words: which gains to trust, why, and what speaks against trusting the verdict itself.

It works on `run.json`'s object, so the page, the job summary and whoever else tells people say the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scenarios.limits import METRICS, MILLISECONDS, STANDING, TITLES, Limit
from scenarios.manoeuvres import RECORDED
from scenarios.table import number

Object = Mapping[str, Any]

SIGNS = {"PASS": "✓", "FAIL": "✗", "UNSET": "?", "INFO": "i"}
"""Beside the word and the colour: a verdict is never told by colour alone."""

MEANINGS = {
    "PASS": "meets every limit",
    "FAIL": "fails",
    "UNSET": "not decided",
    "INFO": "nothing is limited",
}
ORDER = ("PASS", "INFO", "UNSET", "FAIL")
GOOD_SHARE = 0.95
"""Of the uncertain models; below it a gain set that passes as flown is told with a caveat."""


@dataclass(frozen=True)
class Judged:
    """One gain set.

    Attributes:
        place: its number in the run, from 0. name: of the gain set. outcome: PASS, FAIL, UNSET or INFO.
        why: in a line. warnings: of its flight. share: (passes, of) the uncertain models; None if not computed.
        delay_margin_s: of its loop; None if not known.
    """

    place: int
    name: str
    outcome: str
    why: str
    warnings: tuple[str, ...] = ()
    share: tuple[int, int] | None = None
    delay_margin_s: float | None = None

    @property
    def sign(self) -> str:
        """A character for the outcome."""
        return SIGNS.get(self.outcome, "?")

    @property
    def doubtful(self) -> bool:
        """It passes as flown, but not on enough of the uncertain models."""
        return self.outcome == "PASS" and self.share is not None and self.share[0] < GOOD_SHARE * self.share[1]


@dataclass(frozen=True)
class Verdict:
    """Of a run.

    Attributes:
        headline: in one sentence. choice: which of several that pass, and why; empty for none or one.
        judged: those that pass first. ground: whether the airframe's own flight gains fly here, and whether a real
            autopilot flew; empty if not known.
        doubts: what speaks against the verdicts, a sentence each.
    """

    headline: str
    choice: str
    judged: tuple[Judged, ...]
    ground: str
    doubts: tuple[str, ...]


def verdict_of(data: Object, shares: Sequence[tuple[int, int] | None] = ()) -> Verdict:
    """The verdict of a run.

    Args:
        data: a `run.json` in the present schema. shares: of each flight, how many uncertain models pass of how many.
    """
    limits = limits_of(data)
    judged = [
        Judged(
            place,
            flight["gain_set"]["name"],
            flight["outcome"],
            reason_of(flight, limits),
            tuple(flight["warnings"]),
            shares[place] if place < len(shares) else None,
            _delay_margin_s(flight),
        )
        for place, flight in enumerate(data["flights"])
    ]
    passing = sorted((one for one in judged if one.outcome == "PASS"), key=_rank, reverse=True)
    rest = sorted((one for one in judged if one.outcome != "PASS"), key=lambda one: ORDER.index(one.outcome))
    ground, wrong = _ground(data["own_gains"])
    doubts = [wrong] if wrong else []
    doubts += [
        f"{one.name} passes as flown, but only {one.share[0]} of {one.share[1]} uncertain models do"
        for one in passing
        if one.doubtful and one.share is not None
    ]
    told, apart = _twins(data["twins"], recorded=is_recorded(data))
    ground = f"{ground} {told}".strip()
    doubts += apart
    if not data["complete"]:
        doubts.append("The run was interrupted; gain sets that are not listed were not flown")
    headline = _headline(data, judged, passing, bool(wrong))
    return Verdict(headline, _choice(passing), (*passing, *rest), ground, tuple(doubts))


def _delay_margin_s(flight: Object) -> float | None:
    value = flight["margins"].get("delay_margin_s")
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _rank(one: Judged) -> tuple[float, float, int]:
    share = 1.0 if one.share is None else one.share[0] / max(one.share[1], 1)
    margin = float("inf") if one.delay_margin_s is None else one.delay_margin_s
    return share, margin, -one.place


def _headline(data: Object, judged: Sequence[Judged], passing: Sequence[Judged], shaken: bool) -> str:
    vehicle = data["vehicle"]["name"] or data["scenario"]["vehicle"] or "the vehicle"
    if not judged:
        return "No gain set was flown, so there is nothing to trust."
    count = len(judged)
    if all(one.outcome == "INFO" for one in judged):
        return f"Nothing was limited, so nothing is judged: {count} gain set{_s(count)} flown on {vehicle}."
    if shaken:
        return f"Do not trust these verdicts yet: the airframe's own flight gains do not fly here ({vehicle})."
    if not passing:
        open_ = sum(one.outcome == "UNSET" for one in judged)
        if count == 1:
            name = judged[0].name
            return f"{name} on {vehicle} is not decided." if open_ else f"Do not trust {name} on {vehicle}."
        undecided = f"; {open_} not decided" if open_ else ""
        return f"Trust none of the {count} gain sets on {vehicle}{undecided}."
    names = ", ".join(one.name for one in passing[:4]) + (f" and {len(passing) - 4} more" if len(passing) > 4 else "")
    if count == 1:
        return f"Trust {names} on {vehicle}."
    return f"Trust {len(passing)} of {count} gain sets on {vehicle}: {names}."


def _choice(passing: Sequence[Judged]) -> str:
    if len(passing) < 2:
        return ""
    best = passing[0]
    parts = []
    if best.share is not None:
        parts.append(f"it passes on {best.share[0]} of {best.share[1]} uncertain models")
    if best.delay_margin_s is not None:
        parts.append(f"its delay margin is {number(1e3 * best.delay_margin_s, 1)} ms")
    return f"First choice: {best.name}" + (f" ({' and '.join(parts)})." if parts else ".")


def _s(count: int) -> str:
    return "" if count == 1 else "s"


def _ground(own: Object | None) -> tuple[str, str]:
    """Whether the airframe's own flight gains fly: a sentence, and the doubt that follows from it."""
    if own is None:
        return "", ""
    who, reason = f"The airframe's own flight gains ({own['gain_set']})", _worded(own["reason"])
    if own["fly"] is None:
        return f"{who}: whether they fly here is not known: {reason}.", ""
    if own["fly"]:
        judged = f" ({own['outcome']} here: {reason})" if reason else ""
        return f"{who} fly under these assumptions{judged}, as they did in reality.", ""
    text = f"{who} do NOT fly under these assumptions: {reason}. They flew in reality"
    return f"{text}.", f"{text}: doubt the assumptions before the candidates"


def is_recorded(data: Object) -> bool:
    """The flights were recorded elsewhere; our own autopilot flew beside them on a model, if one was named.

    Args:
        data: a `run.json` in the present schema.
    """
    kinds = [one["kind"] for one in data["scenario"]["manoeuvres"]]
    return data["vehicle"].get("spec") == RECORDED or RECORDED in kinds


def _twins(twins: Sequence[Object], *, recorded: bool) -> tuple[str, list[str]]:
    """That a real autopilot flew, and the doubts that follow."""
    if not twins:
        return "", []
    apart = [twin["gain_set"] for twin in twins if not twin["agree"]]
    agree = f"our own agrees with it in {len(twins) - len(apart)} of {len(twins)} flights"
    real = "What was recorded and our own autopilot on the model" if recorded else "The real autopilot and our own"
    doubt = f"{real} differ by more than is tolerated with {', '.join(apart)}"
    if recorded:
        agree = f"on the model our own autopilot agrees with it in {len(twins) - len(apart)} of {len(twins)} flights"
    flew = "This was recorded elsewhere" if recorded else "A real autopilot flew this plant"
    return f"{flew}; {agree}.", [doubt] if apart else []


def limits_of(data: Object) -> dict[str, str]:
    """What a run asks of its metrics, for people: name -> "at most 10 %".

    Args:
        data: a `run.json` in the present schema.
    """
    found = {}
    for one in data["scenario"]["limits"]:
        if one["metric"] in METRICS:
            found[one["metric"]] = _worded(Limit(one["metric"], one["minimum"], one["maximum"]).for_people())
    return {STANDING.metric: _worded(STANDING.for_people())} | found


def _worded(limit: str) -> str:
    return limit.replace("<=", "at most").replace(">=", "at least")


def reason_of(flight: Object, limits: Mapping[str, str]) -> str:
    """Why a gain set has its verdict; of one that passes, its limited values.

    Args:
        flight: as in run.json. limits: of the run, for people.
    """
    if flight["reason"] or flight["outcome"] != "PASS":
        return _worded(flight["reason"]) or "no reason is given"
    limited = [one for one in flight["metrics"] if one["limit"] and not one["segment"]]
    parts = []
    for one in limited:
        limit = limits.get(one["name"], one["limit"])
        parts.append(f"{title(one['name'])} {value_text(one['name'], one['value'])} ({limit})")
    return ", ".join(parts) or MEANINGS["PASS"]


def title(metric: str) -> str:
    """What a metric is called."""
    return TITLES.get(metric, metric)


def shown(metric: str) -> tuple[str, float]:
    """Unit that a metric is shown in, empty for none, and the factor to it from its own."""
    if metric in MILLISECONDS:
        return "ms", 1e3
    unit = METRICS.get(metric, ("", ""))[0]
    return ("" if unit == "1" else unit), 1.0


def value_text(metric: str, value: float | None, *, unit: bool = True) -> str:
    """A value for people; a dash if there is none.

    Args:
        metric: its name. value: in its own unit. unit: with the unit behind it.
    """
    sign, factor = shown(metric)
    text = number(None if value is None else value * factor, _DECIMALS.get(metric, 2))
    return f"{text} {sign}" if unit and sign and value is not None else text


_DECIMALS = {
    "overshoot_pct": 1,
    "rise_time_s": 3,
    "vaf_pct": 1,
    "vaf_lag_removed_pct": 1,
    "lag_s": 1,
    "phase_margin_deg": 1,
    "gain_margin_low_db": 1,
    "gain_margin_high_db": 1,
    "delay_margin_s": 1,
    "oscillation_hz": 1,
    "attitude_rate_hz": 1,
    "largest_gap_s": 1,
    "modulus_margin": 3,
}
