"""Where a recorded roll set-point steps, and where it moves and can be followed.

A set-point is a chain of levels that are held and of movement between them. A change of level that is over sooner than
the vehicle rises is a step; levels that are left too soon, ramps and sines are a stretch to be followed. What an AUTO
mode asks for is left alone: it is the answer of another loop, and it depends on the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scenarios.flight import Segment
from scenarios.flight_import.recorded import Recorded
from scenarios.flight_import.series import FloatArray
from scenarios.metrics import LAST_S, SETTLE_S
from sitl.modes import STICK_MODES, Mode

FOLLOWED = frozenset({int(Mode.OFFBOARD), *(int(mode) for mode in STICK_MODES), -1}) - {int(Mode.ACRO)}
"""Modes whose set-point comes from outside; -1: not known, of an autopilot whose modes are not PX4's."""

HELD_S = LAST_S + SETTLE_S - 0.2
"""A level that is held this long is one; the last second of it is then free of the step."""

FIRST_S = 0.4
"""A mode's first level may be this short: the vehicle came into it from another one, which is no matter here."""

LONGEST_S = 10.0
"""No window is longer: what comes after is another story."""

TOLERANCE_RAD = math.radians(0.5)
"""A set-point that stays this close to a level is held: fingers and radios are no better."""

LEAST_STEP_RAD = math.radians(3.0)
NOISE_FACTOR = 6.0
"""A step is this many times the deviation of the set-point while it is held, or it is none."""

STILL_M_S = 0.7
LEVEL_RAD = math.radians(2.0)
"""A step is scored from rest: this slow sideways, or, where the speed is not known, this level before."""

SLOW_S = 1.0
"""A change that takes longer is no step, however slowly the vehicle answers."""


@dataclass(frozen=True)
class Level:
    """A set-point that is held. start_s, end_s: vehicle time. value_rad: its median. noise_rad: its deviation."""

    start_s: float
    end_s: float
    value_rad: float
    noise_rad: float


@dataclass(frozen=True)
class Found:
    """What was found.

    Attributes:
        segments: to be scored, in order of time.
        begins: manoeuvre -> vehicle time at which its set-point first moves, s.
        largest_step_rad: of all changes from one held level to the next, scored or not.
        notes: steps whose reference was shifted, and why others count as they do.
        levels: held levels. moved_s: time in which the set-point was moving.
    """

    segments: tuple[Segment, ...]
    begins: dict[str, float]
    largest_step_rad: float
    notes: tuple[str, ...]
    levels: tuple[Level, ...]
    moved_s: float


@dataclass(frozen=True)
class _Edge:
    """A change between two held levels. ramp_s: how long the set-point took. step: sooner than the vehicle."""

    before: Level
    after: Level
    start_s: float
    ramp_s: float
    step: bool

    @property
    def reference_s(self) -> float:
        """When a step of the same effect would have been sent: a ramp counts from its half."""
        return self.start_s + 0.5 * self.ramp_s

    @property
    def amplitude_rad(self) -> float:
        return self.after.value_rad - self.before.value_rad


def find(recorded: Recorded) -> Found:
    """Find steps and stretches to follow.

    Args:
        recorded: with its set-point; without one nothing is found.
    """
    segments: list[Segment] = []
    begins: dict[str, float] = {}
    notes: list[str] = []
    all_levels: list[Level] = []
    largest = moved_s = 0.0
    for start_s, end_s in _stretches(recorded):
        t, phi_sp = _setpoint(recorded, start_s, end_s)
        levels = _levels(t, phi_sp, end_s, first_by_s=start_s + recorded.mode_late_s)
        all_levels += levels
        edges: list[_Edge] = []
        moving: list[tuple[float, float]] = []
        for before, after in pairwise(levels):
            edge = _edge(recorded, t, phi_sp, before, after)
            largest = max(largest, abs(edge.amplitude_rad)) if edge.step else largest
            if edge.step:
                edges.append(edge)
            else:
                moving.append((before.end_s, after.start_s))
        if levels:
            moving += [(a, b) for a, b in ((start_s, levels[0].start_s), (levels[-1].end_s, end_s)) if b - a > HELD_S]
        elif len(t):
            moving.append((start_s, end_s))
        moved_s += math.fsum(b - a for a, b in moving)
        _chains(recorded, edges, segments, begins, notes)
        _tracks(t, phi_sp, moving, levels, segments, begins)
    ordered = tuple(sorted(segments, key=lambda segment: segment.start_s))
    return Found(ordered, begins, largest, tuple(notes), tuple(all_levels), moved_s)


def _stretches(recorded: Recorded) -> list[tuple[float, float]]:
    """Vehicle times, s, between which it flies armed in one mode whose set-point comes from outside."""
    telemetry = recorded.telemetry
    t, mode = telemetry["t_s"], telemetry["nav_state"]
    wanted = telemetry["armed"] & (recorded.landed < 0.5) & np.isin(mode, list(FOLLOWED))
    if not len(recorded.setpoint):
        return []
    key = np.where(wanted, mode.astype(np.int64) + 2, 0)
    starts = np.flatnonzero(np.diff(key, prepend=0) != 0)
    ends = np.append(starts[1:], len(t))
    found = [(float(t[a]), float(t[b - 1])) for a, b in zip(starts, ends, strict=True) if key[a] and b - a > 1]
    earliest = [float(t[np.argmax(telemetry["armed"])]), *(end_s for _, end_s in found)]
    return [
        (max(start_s - recorded.mode_late_s, before_s), end_s)
        for (start_s, end_s), before_s in zip(found, earliest, strict=False)
    ]


def _setpoint(recorded: Recorded, start_s: float, end_s: float) -> tuple[FloatArray, FloatArray]:
    series = recorded.setpoint
    first, last = np.searchsorted(series.t_s, [start_s - 1e-6, end_s + 1e-6])
    # the set-point in force when the stretch begins may be older than it
    first = max(0, int(first) - 1)
    t = np.maximum(series.t_s[first:last], start_s)
    return t, series.values[first:last, 0]


def _levels(t: FloatArray, phi_sp: FloatArray, end_s: float, first_by_s: float) -> list[Level]:
    """Held levels: the longest runs of samples that stay within the tolerance of their middle.

    The first one may be short if it is there by a time: where the mode was entered.
    """
    found: list[Level] = []
    k, count, listed = 0, len(t), phi_sp.tolist()
    while k < count:
        low = high = listed[k]
        n = k + 1
        while n < count and max(high, listed[n]) - min(low, listed[n]) <= 2.0 * TOLERANCE_RAD:
            low, high = min(low, listed[n]), max(high, listed[n])
            n += 1
        until = float(t[n]) if n < count else end_s
        least_s = FIRST_S if not found and t[k] <= first_by_s + 1e-6 else HELD_S
        if until - t[k] < least_s:
            k += 1
            continue
        held = phi_sp[k:n]
        # the tail of the movement before may have come along: the second half is what is held
        value = float(np.median(held[len(held) // 2 :]))
        off = np.flatnonzero(np.abs(held[: len(held) // 2] - value) > 0.5 * TOLERANCE_RAD)
        begin = k + (int(off[-1]) + 1 if len(off) else 0)
        if until - t[begin] < least_s:
            k = max(k + 1, begin)
            continue
        settled = phi_sp[begin:n]
        found.append(Level(float(t[begin]), until, value, float(np.std(settled[len(settled) // 4 :]))))
        k = n
    return found


def _edge(recorded: Recorded, t: FloatArray, phi_sp: FloatArray, before: Level, after: Level) -> _Edge:
    """The change from one level to the next, and whether it is a step."""
    start_s, ramp_s = before.end_s, after.start_s - before.end_s
    amplitude = after.value_rad - before.value_rad
    enough = abs(amplitude) >= max(LEAST_STEP_RAD, NOISE_FACTOR * max(before.noise_rad, after.noise_rad))
    if enough:
        start_s = _sharpened(recorded, start_s, amplitude)
        ramp_s = max(0.0, after.start_s - start_s) if ramp_s > 0.0 else 0.0
    return _Edge(before, after, start_s, ramp_s, enough and ramp_s <= min(SLOW_S, _rise(recorded, before, after)))


def _sharpened(recorded: Recorded, seen_s: float, amplitude: float) -> float:
    """When a step really came: the rate set-point is often logged more densely, and jumps with it."""
    series, period = recorded.rates_setpoint, 1.0 / max(recorded.setpoint.rate_hz, 1.0)
    first, last = np.searchsorted(series.t_s, [seen_s - 1.2 * period, seen_s + 1e-6])
    if last - first < 2 or not series.rate_hz > 1.5 * recorded.setpoint.rate_hz:
        return seen_s
    p_sp = series.values[first:last, 0] * math.copysign(1.0, amplitude)
    # any sensible K_phi makes far more of a step than this, and noise far less
    jumps = np.flatnonzero(np.diff(p_sp) > abs(amplitude))
    return float(series.t_s[first + jumps[0] + 1]) if len(jumps) else seen_s


def _rise(recorded: Recorded, before: Level, after: Level) -> float:
    """Rise time, s, of the roll angle from one level to the next; what it takes altogether if it never gets there."""
    rows = recorded.telemetry.between(before.end_s, min(after.end_s, before.end_s + LONGEST_S))
    done = (rows["phi_rad"].astype(np.float64) - before.value_rad) / (after.value_rad - before.value_rad)
    low, high = np.flatnonzero(done >= 0.1), np.flatnonzero(done >= 0.9)
    if not len(low):
        return 0.0
    return float(rows["t_s"][high[0] if len(high) else -1] - rows["t_s"][low[0]])


def _chains(
    recorded: Recorded, edges: Sequence[_Edge], segments: list[Segment], begins: dict[str, float], notes: list[str]
) -> None:
    """Steps from rest begin a manoeuvre; the edges that follow before the next rest belong to it."""
    chains: list[list[_Edge]] = []
    for edge in edges:
        joined = bool(chains) and chains[-1][-1].after is edge.before
        if not joined or (_at_rest(recorded, edge) and abs(edge.before.value_rad) < LEVEL_RAD):
            chains.append([edge])
        else:
            chains[-1].append(edge)
    for chain in chains:
        name = f"step_{sum(other.startswith('step_') for other in begins) + 1}"
        begins[name] = chain[0].start_s
        for n, edge in enumerate(chain, 1):
            own = f"{name}/{n}" if len(chain) > 1 else name
            later = chain[n] if n < len(chain) else None
            end_s = later.reference_s if later is not None else edge.after.end_s
            rest = n == 1 and _at_rest(recorded, edge)
            if n == 1 and not rest:
                notes.append(f"{own}: the vehicle was not at rest before it: watched for oscillation only")
            if rest and edge.ramp_s > 0.0:
                notes.append(
                    f"{own}: the set-point took {1e3 * edge.ramp_s:.0f} ms, less than the vehicle's rise: "
                    "counted as a step from its half"
                )
            segments.append(
                Segment(
                    name=own,
                    kind="step" if rest else "hold",
                    manoeuvre=name,
                    start_s=edge.reference_s,
                    end_s=min(end_s, edge.reference_s + LONGEST_S),
                    amplitude_rad=edge.amplitude_rad,
                    phi_from_rad=edge.before.value_rad,
                )
            )


def _at_rest(recorded: Recorded, edge: _Edge) -> bool:
    """Slow sideways where the speed is known, else level for long enough."""
    rows = recorded.telemetry.between(edge.start_s - 0.2, edge.start_s)
    north, east, psi = (rows[name].astype(np.float64) for name in ("v_north_m_s", "v_east_m_s", "psi_rad"))
    sideways = -north * np.sin(psi) + east * np.cos(psi)
    known = sideways[np.isfinite(sideways)]
    if len(known):
        return bool(abs(float(known[-1])) < STILL_M_S)
    return abs(edge.before.value_rad) < LEVEL_RAD


def _tracks(
    t: FloatArray,
    phi_sp: FloatArray,
    moving: Sequence[tuple[float, float]],
    levels: Sequence[Level],
    segments: list[Segment],
    begins: dict[str, float],
) -> None:
    """Stretches in which the set-point moves for long enough; whether enough is for `excitation` to say."""
    for start_s, end_s in moving:
        rows = (t >= start_s - 1e-6) & (t < end_s - 1e-6)
        if end_s - start_s < HELD_S or rows.sum() < 8:
            continue
        name = f"track_{sum(other.startswith('track_') for other in begins) + 1}"
        begins[name] = start_s
        level = next((one.value_rad for one in reversed(levels) if one.end_s <= start_s + 1e-6), float(phi_sp[rows][0]))
        after = next((one for one in levels if abs(one.start_s - end_s) < 1e-6), None)
        own = name if after is None else f"{name}/1"
        segments.append(Segment(own, "track", name, start_s, end_s, float(np.abs(phi_sp[rows]).max()), level))
        if after is not None:
            # whether it shakes is seen when the set-point is still again
            last, until_s = float(phi_sp[rows][-1]), min(after.end_s, after.start_s + LONGEST_S)
            change = after.value_rad - last
            segments.append(Segment(f"{name}/2", "hold", name, after.start_s, until_s, change, last))
