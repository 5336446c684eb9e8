"""The same gains on the same plant, flown by two autopilots: what differs, and whether it is within what is tolerated.

Wherever a real autopilot flies our plant, our own one flies it, too: same scenario, airframe, profile, seed and gains.
A difference is always that of the real one minus our own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from scenarios.flight_facts import LATEST_S, Fact, flight_facts, lateness, true_roll
from scenarios.limits import LIMIT_CYCLE_RAD_S, Metric
from scenarios.metrics import FloatArray, Oscillation, oscillation

if TYPE_CHECKING:
    from scenarios.flight import FlightRecord, Segment

OWN_SUFFIX = ".own"
"""Between a gain set's file name and the kind of file: a flight of our own autopilot beside that of a real one."""

QUANTITIES: Mapping[str, tuple[str, float | None, str]] = {
    # name: (unit of the difference, largest tolerated difference, meaning)
    "overshoot_pct": ("points", 1.5, "overshoot of a step"),
    "settling_time_5pct_s": ("s", 0.05, "settling time, 5 % band"),
    "settling_time_2pct_s": ("s", 0.05, "settling time, 2 % band"),
    "rise_time_s": ("s", None, "10 to 90 % of a step"),
    "droop_deg": ("deg", None, "mean error in the last second of the hold"),
    "vaf_pct": ("points", None, "variance of the set-point accounted for"),
    "lag_s": ("s", None, "delay of roll behind the set-point"),
    "peak_delta_lat": ("1", None, "largest roll torque"),
    "roll_difference_deg": ("deg", None, "RMS of the difference of the true roll angles, from the segment's start"),
    "response_late_s": ("s", None, "how much later the real one's roll comes, by least squares"),
    "oscillation_hz": ("Hz", 0.2, "frequency of a limit cycle"),
    "oscillation_rad_s": ("%", 5.0, "amplitude of a limit cycle, relative to the real one's"),
    "hold_p_std_rad_s": ("rad/s", None, "roll rate deviation in the last second of Hold before the manoeuvre"),
    "hold_q_std_rad_s": ("rad/s", None, "pitch rate deviation there"),
    "hold_hz": ("Hz", None, "frequency of the larger of the two, if it is above noise"),
    "hover_thrust": ("1", None, "mean thrust set-point there"),
    "liftoff_time_s": ("s", None, "from Take-off mode to 0.3 m above the ground"),
    "takeoff_time_s": ("s", None, "from Take-off mode to Hold at height"),
    "landing_time_s": ("s", None, "from Land mode to disarming"),
    "touchdown_m_s": ("m/s", None, "speed of descent in the last 0.3 s before the ground, as reported"),
    "rebound_m_s": ("m/s", None, "largest speed upwards after that"),
    "ground_tilt_deg": ("deg", None, "largest roll or pitch after that"),
    "ground_time_s": ("s", None, "from touch-down to disarming"),
    "estimate_error_rms_deg": ("deg", None, "RMS of estimated minus true roll, its lateness taken off"),
    "estimate_late_s": ("s", None, "how late the estimate is"),
    "roll_estimate_error_deg": ("deg", 0.5, "largest error of the real one's estimate in a stable flight"),
    "setpoint_late_s": ("s", None, "from sending a step to the vehicle reporting its set-point"),
    "attitude_rate_hz": ("Hz", None, "ATTITUDE messages per second"),
    "saturated_high_pct": ("points", None, "share of the time with a motor at its upper limit"),
    "saturated_low_pct": ("points", None, "share of the time with a motor at its lower limit"),
}

NOT_FLOWN = "not flown"

_RESPONSE = ("overshoot_pct", "rise_time_s", "settling_time_5pct_s", "settling_time_2pct_s", "droop_deg")
_TRACKING = ("vaf_pct", "lag_s")


@dataclass(frozen=True)
class Quantity:
    """One quantity of two flights.

    Attributes:
        name: a key of `QUANTITIES`. segment: empty for the whole flight.
        real, own: values, in the unit of the name; None if not measured, or if only the difference has a meaning.
        difference: real minus own, in the unit of `QUANTITIES`; None if there is none.
        within: is it tolerated? None where nothing is asked for, or nothing was there to compare.
        reason: why there is no difference, or what it does not say by itself.
    """

    name: str
    segment: str
    real: float | None
    own: float | None
    difference: float | None
    within: bool | None
    reason: str = ""

    @property
    def unit(self) -> str:
        """Of the difference."""
        return QUANTITIES[self.name][0]

    @property
    def tolerance(self) -> float | None:
        """Largest tolerated difference, in its unit; None if none is stated."""
        return QUANTITIES[self.name][1]

    @property
    def excess(self) -> float:
        """Difference relative to what is tolerated; infinite where one flight has the value and the other has not."""
        if self.difference is None or not self.tolerance:
            return math.inf
        return abs(self.difference) / self.tolerance


@dataclass(frozen=True)
class Difference:
    """What differs between two flights of one gain set.

    Attributes:
        verdicts_agree: both have the same outcome.
        cycling: at least one is in a limit cycle: then only verdict, frequency and amplitude are compared.
        quantities: of the whole flight and of each segment, then AUTO modes, ground and autopilot.
        alone: names of the segments that only one of them came to.
    """

    verdicts_agree: bool
    cycling: bool
    quantities: tuple[Quantity, ...]
    alone: tuple[str, ...] = ()

    @property
    def agree(self) -> bool:
        """Same verdict, everything flown by both, and everything with a tolerance is within it."""
        return self.verdicts_agree and not self.alone and all(one.within is not False for one in self.quantities)

    def quantity(self, name: str, segment: str = "") -> Quantity | None:
        """The quantity of that name and segment; None if it was not compared."""
        return next((one for one in self.quantities if (one.name, one.segment) == (name, segment)), None)

    def outside(self) -> list[Quantity]:
        """What is beyond its tolerance: per name, where it is furthest."""
        worst: dict[str, Quantity] = {}
        for one in self.quantities:
            # >=: a segment says more than the whole flight, whose value it is
            if one.within is False and (one.name not in worst or one.excess >= worst[one.name].excess):
                worst[one.name] = one
        return list(worst.values())


@dataclass(frozen=True)
class Twin:
    """A gain set flown by a real autopilot and by our own.

    Attributes:
        flight: the real one's. own: ours. difference: between the two.
    """

    flight: FlightRecord
    own: FlightRecord
    difference: Difference

    @classmethod
    def of(cls, flight: FlightRecord, own: FlightRecord) -> Twin:
        """Compare two flights of one gain set.

        Args:
            flight: of the real autopilot. own: of ours.
        """
        return cls(flight, own, compare(flight, own))

    @property
    def name(self) -> str:
        """Of the gain set."""
        return self.flight.gain_set.name

    @property
    def warning(self) -> str:
        """Both verdicts, if they are not the same; empty if they are."""
        if self.difference.verdicts_agree:
            return ""
        sides = ("the real autopilot", self.flight), ("our own", self.own)
        told = [f"{one.outcome} with {who}" + (f" ({one.reason})" if one.reason else "") for who, one in sides]
        return f"{self.name}: verdicts differ: {told[0]}, {told[1]}"


def compare(flight: FlightRecord, own: FlightRecord) -> Difference:
    """What differs between two flights of one gain set.

    Args:
        flight: of the real autopilot. own: of ours.
    """
    cycling = _cycles(flight) or _cycles(own)
    pairs = list(_pairs(flight, own))
    quantities: list[Quantity] = []
    if not cycling:
        quantities += _metrics(flight, own, "", (*_RESPONSE, *_TRACKING, "peak_delta_lat"))
        quantities += _roll(flight, own, pairs, "")
    quantities += _oscillation(flight, own, "")
    for a, b in pairs:
        if not cycling:
            names = {"step": _RESPONSE, "track": _TRACKING}.get(a.kind, ())
            found = _metrics(flight, own, a.name, (*names, "peak_delta_lat"))
            quantities += (_explained(one, flight, own, a, b) for one in found)
            quantities += _roll(flight, own, [(a, b)], a.name)
        if a.kind != "track":
            quantities += _oscillation(flight, own, a.name)
    quantities += _facts(flight, own, cycling)
    came = [dict.fromkeys(segment.name for segment in one.segments) for one in (flight, own)]
    alone = tuple(name for name in came[0] | came[1] if name not in came[0] or name not in came[1])
    return Difference(flight.outcome is own.outcome, cycling, tuple(quantities), alone)


def _pairs(flight: FlightRecord, own: FlightRecord) -> Iterator[tuple[Segment, Segment]]:
    """Segments that both flew."""
    others = {segment.name: segment for segment in own.segments}
    for segment in flight.segments:
        if segment.name in others:
            yield segment, others[segment.name]


def _cycles(flight: FlightRecord) -> bool:
    metric = flight.metric("oscillation_rad_s")
    return metric is not None and metric.value is not None and metric.value > LIMIT_CYCLE_RAD_S


def _quantity(name: str, segment: str, real: Fact, own: Fact) -> Quantity:
    """Both values and their difference, judged."""
    tolerance = QUANTITIES[name][1]
    if real.value is None or own.value is None:
        sides = [f"{who}: {fact.reason or 'not measured'}" for who, fact in (("real", real), ("own", own))]
        if real.value is None and own.value is None:
            same = real.reason == own.reason
            return Quantity(name, segment, None, None, None, None, real.reason if same else "; ".join(sides))
        # what only one of them came to at all is told once, for the segment
        within = None if tolerance is None or NOT_FLOWN in (real.reason, own.reason) else False
        return Quantity(name, segment, real.value, own.value, None, within, sides[own.value is None])
    if not (math.isfinite(real.value) and math.isfinite(own.value)):
        return Quantity(name, segment, real.value, own.value, None, None, "infinite")
    difference = real.value - own.value
    within = None if tolerance is None else abs(difference) <= tolerance
    return Quantity(name, segment, real.value, own.value, difference, within, real.reason or own.reason)


def _fact(metric: Metric | None, flight: FlightRecord) -> Fact:
    if metric is None or (metric.value is None and not flight.segments):
        return Fact(None, NOT_FLOWN)
    return Fact(metric.value, metric.reason)


def _metrics(flight: FlightRecord, own: FlightRecord, segment: str, names: Sequence[str]) -> Iterator[Quantity]:
    for name in names:
        real, ours = (_fact(one.metric(name, segment), one) for one in (flight, own))
        if NOT_FLOWN not in (real.reason, ours.reason) or real.value is not None or ours.value is not None:
            yield _quantity(name, segment, real, ours)


def _explained(quantity: Quantity, flight: FlightRecord, own: FlightRecord, a: Segment, b: Segment) -> Quantity:
    """Why two settling times are apart: how far the two angles are, where one has settled and the other has not.

    A response that creeps into the band does so a second later for a few hundredths of a degree.
    """
    if not quantity.name.startswith("settling") or quantity.within is not False:
        return quantity
    settled = [math.inf if value is None else value for value in (quantity.real, quantity.own)]
    begin, end = min(settled), min(max(settled), a.end_s - a.start_s, b.end_s - b.start_s)
    rows = flight.telemetry.between(a.start_s + begin, a.start_s + end)
    theirs = np.interp(rows["t_s"] - a.start_s + b.start_s, own.telemetry["t_s"], own.telemetry["phi_rad"])
    if not len(rows):
        return quantity
    apart = math.degrees(float(np.abs(rows["phi_rad"] - theirs).max()))
    reason = f"roll at most {apart:.2f} deg apart there"
    return replace(quantity, reason=f"{quantity.reason}; {reason}" if quantity.reason else reason)


def _roll(
    flight: FlightRecord, own: FlightRecord, pairs: Sequence[tuple[Segment, Segment]], segment: str
) -> Iterator[Quantity]:
    """The true roll angles beside each other, each from the start of its own segment."""
    if not pairs:
        return
    differences: list[FloatArray] = []
    lates = []
    (t, phi), (own_t, own_phi) = true_roll(flight.telemetry), true_roll(own.telemetry)
    for a, b in pairs:
        rows = (t >= a.start_s - 1e-9) & (t <= a.start_s + min(a.end_s - a.start_s, b.end_s - b.start_s))
        when = t[rows] - a.start_s
        differences.append(phi[rows] - np.interp(when + b.start_s, own_t, own_phi))
        if len(when) and when[-1] > 4.0 * LATEST_S:
            near = (own_t >= b.start_s - LATEST_S) & (own_t <= b.end_s + LATEST_S)
            found = lateness(when, phi[rows], own_t[near] - b.start_s, own_phi[near])
            lates += [found[0]] if found is not None else []
    joined = np.concatenate(differences)
    rms = math.degrees(math.sqrt(float(np.mean(joined**2)))) if len(joined) else None
    yield Quantity("roll_difference_deg", segment, None, None, rms, None)
    if lates and segment:
        yield Quantity("response_late_s", segment, None, None, lates[0], None)


def _oscillation(flight: FlightRecord, own: FlightRecord, segment: str) -> Iterator[Quantity]:
    """Frequency and amplitude, judged where at least one is in a limit cycle."""
    real, ours = _shake(flight, segment), _shake(own, segment)
    cycling = [shake.is_limit_cycle for shake in (real, ours)]
    values = [None if shake.reason else shake.worst_rad_s for shake in (real, ours)]
    hertz = [None if shake.reason else shake.frequency_hz for shake in (real, ours)]
    if not all(cycling):
        within = False if any(cycling) and None not in values else None
        reason = real.reason or ours.reason or "no limit cycle"
        if within is False:
            reason = f"only {'the real one' if cycling[0] else 'our own'} is in a limit cycle"
        yield Quantity("oscillation_hz", segment, hertz[0], hertz[1], None, within, reason)
        yield Quantity("oscillation_rad_s", segment, values[0], values[1], None, within, reason)
        return
    axes = "" if real.axis == ours.axis else f"in {real.axis} with the real one, in {ours.axis} with our own"
    yield _quantity("oscillation_hz", segment, Fact(hertz[0], axes), Fact(hertz[1], axes))
    percent = 100.0 * (real.worst_rad_s - ours.worst_rad_s) / real.worst_rad_s
    within = abs(percent) <= (QUANTITIES["oscillation_rad_s"][1] or 0.0)
    yield Quantity("oscillation_rad_s", segment, values[0], values[1], percent, within, axes)


def _shake(flight: FlightRecord, segment: str) -> Oscillation:
    """Of one segment, or the worst of the flight."""
    t, p, q, r = (flight.telemetry[name] for name in ("t_s", "p_rad_s", "q_rad_s", "r_rad_s"))
    shakes = [
        oscillation(t, p, q, r, start_s=one.start_s, end_s=one.end_s)
        for one in flight.segments
        if one.kind != "track" and segment in ("", one.name)
    ]
    known = [shake for shake in shakes if not shake.reason]
    if known:
        return max(known, key=lambda shake: shake.worst_rad_s)
    return shakes[0] if shakes else Oscillation((math.nan, math.nan, math.nan), "", None, NOT_FLOWN)


def _facts(flight: FlightRecord, own: FlightRecord, cycling: bool) -> Iterator[Quantity]:
    """AUTO modes, ground contact, and what the two autopilots are like."""
    real, ours = flight_facts(flight), flight_facts(own)
    names = [name for name in QUANTITIES if name in real]
    for name in names:
        yield _quantity(name, "", real[name], ours[name])
    yield from _metrics(flight, own, "", ("attitude_rate_hz",))
    if not cycling:
        yield _estimate_error(flight, own)


def _estimate_error(flight: FlightRecord, own: FlightRecord) -> Quantity:
    """What is asked of a real estimate is its own error, not that it errs as ours does."""
    name = "roll_estimate_error_deg"
    quantity = _quantity(name, "", _fact(flight.metric(name), flight), _fact(own.metric(name), own))
    within = None if quantity.real is None else quantity.real <= (QUANTITIES[name][1] or 0.0)
    return replace(quantity, within=within)
