"""Is there enough in a recorded set-point to judge gains by? What is not enough is refused, with the numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from scenarios.flight import Segment
from scenarios.flight_import.recorded import Recorded
from scenarios.flight_import.series import FloatArray
from scenarios.flight_import.step_finder import HELD_S, LEAST_STEP_RAD, Found
from scenarios.metrics import LARGEST_GAP_S
from sitl.errors import FileError

LEAST_TRACK_S = 3.0
LEAST_SPREAD_RAD = math.radians(1.5)
"""Standard deviation of a set-point that is followed: that of a sine of two degrees."""

LEAST_BANDWIDTH_HZ = 0.1
"""Slower than this any gains follow."""

MOST_CLIPPED = 0.3
CLIP_RAD = math.radians(0.02)
"""A set-point this close to its largest value is at a limit: tilt, or the stick's end."""

THIN_HZ, SLOW_SETPOINT_HZ = 80.0, 40.0
"""With fewer samples a second the fastest limit cycles that were recorded, 35 Hz, or when a step came, are missed."""

LEAST_RATE_HZ = 10.0
"""Attitude samples per second; with fewer a rise is a guess."""


@dataclass(frozen=True)
class Excitation:
    """What a set-point asks of the loop in one stretch.

    Attributes:
        duration_s: of the stretch. spread_rad: standard deviation of the set-point.
        bandwidth_hz: mean frequency: deviation of its slope over its own, over two pi.
        clipped: share of the time at its largest magnitude. reason: why it is not enough; empty if it is.
    """

    duration_s: float
    spread_rad: float
    bandwidth_hz: float
    clipped: float
    reason: str = ""


def assess_track(t_s: FloatArray, phi_sp_rad: FloatArray, start_s: float, end_s: float) -> Excitation:
    """Judge a stretch in which the set-point moves.

    Args:
        t_s: (n,) times of the set-point. phi_sp_rad: (n,), each held until the next. start_s, end_s: the stretch.
    """
    first = max(0, int(np.searchsorted(t_s, start_s + 1e-6, side="right")) - 1)
    last = int(np.searchsorted(t_s, end_s - 1e-6))
    duration_s = end_s - start_s
    if last - first < 3:
        return Excitation(duration_s, 0.0, 0.0, 0.0, f"only {last - first} set-points")
    t = np.append(np.maximum(t_s[first:last], start_s), end_s)
    phi_sp, held_s = phi_sp_rad[first:last], np.diff(t)
    mean = float(np.average(phi_sp, weights=held_s))
    spread = math.sqrt(float(np.average((phi_sp - mean) ** 2, weights=held_s)))
    even = np.arange(start_s, end_s, 0.02)
    # steps have no slope: as seen through a tenth of a second
    sampled = phi_sp[np.maximum(np.searchsorted(t[:-1], even, side="right") - 1, 0)]
    smooth = np.convolve(sampled, np.full(5, 0.2), mode="valid")
    slope = float(np.std(np.diff(smooth) / 0.02)) if len(smooth) > 2 else 0.0
    bandwidth_hz = slope / (math.tau * spread) if spread > 0.0 else 0.0
    clipped = max(_share(np.abs(phi_sp - limit) < CLIP_RAD, held_s) for limit in (phi_sp.max(), phi_sp.min()))
    found = Excitation(duration_s, spread, bandwidth_hz, clipped)
    return replace(found, reason=_reason(found))


def _share(at: FloatArray, held_s: FloatArray) -> float:
    return float(np.sum(held_s[at]) / np.sum(held_s))


def _reason(found: Excitation) -> str:
    """The first thing that is not enough, with its number and what is needed."""
    if found.duration_s < LEAST_TRACK_S:
        return f"moves for {found.duration_s:.1f} s; {LEAST_TRACK_S:g} s are needed"
    if found.spread_rad < LEAST_SPREAD_RAD:
        needed = math.degrees(LEAST_SPREAD_RAD)
        return f"set-point deviation {math.degrees(found.spread_rad):.2g} deg; {needed:g} deg are needed"
    if found.bandwidth_hz < LEAST_BANDWIDTH_HZ:
        return f"mean frequency {found.bandwidth_hz:.2g} Hz; {LEAST_BANDWIDTH_HZ:g} Hz are needed"
    if found.clipped > MOST_CLIPPED:
        share = 100.0 * found.clipped
        return f"set-point at its limit for {share:.0f} % of the time; at most {100 * MOST_CLIPPED:.0f} % are usable"
    return ""


def accepted(recorded: Recorded, found: Found) -> tuple[tuple[Segment, ...], tuple[str, ...]]:
    """The segments that are worth measuring, and why the others are not.

    Args:
        recorded: the flight. found: in its set-point.

    Raises:
        FileError: there are none; says what there is and what is needed.
    """
    path, telemetry = recorded.path, recorded.telemetry
    if not len(recorded.setpoint):
        topic = "vehicle_attitude_setpoint" if recorded.kind == "ULog" else "ATTITUDE_TARGET"
        raise FileError(path, f"has no roll set-point ({topic})", f"Record a flight with {topic} in the log")
    t = recorded.setpoint.t_s
    kept: list[Segment] = []
    refused: list[str] = []
    for segment in found.segments:
        reason = _coverage(recorded, segment)
        if not reason and segment.kind == "track":
            reason = assess_track(t, recorded.setpoint.values[:, 0], segment.start_s, segment.end_s).reason
        if reason:
            refused.append(f"{segment.name} ({segment.start_s:.1f} to {segment.end_s:.1f} s) is not judged: {reason}")
        else:
            kept.append(segment)
    if any(segment.kind != "hold" for segment in kept):
        return tuple(kept), tuple(refused)
    held = f"held for {HELD_S:g} s before and after"
    text = (
        f"not enough excitation to judge gains: largest step in roll {_largest_deg(found):.1f} deg over the flight; "
        f"{math.degrees(LEAST_STEP_RAD):g} deg are needed, {held}"
    )
    if kept:
        text += "; steps there are, but none from rest"
    armed_s = float(np.sum(np.diff(telemetry["t_s"])[telemetry["armed"][:-1]]))
    text += f" ({armed_s:.0f} s armed, the set-point moved in {found.moved_s:.0f} s of them)"
    if refused:
        text += "; " + "; ".join(refused[:3])
    raise FileError(path, text, "Fly a roll step of 10 deg held for 3 s in Offboard or Stabilized, and log it")


def thin(recorded: Recorded, segments: Sequence[Segment]) -> tuple[str, ...]:
    """What the log is too thin to show in these segments."""
    told = []
    rates, setpoints = recorded.rates, (recorded.setpoint, recorded.rates_setpoint)
    slowest = min((rates.rate_between(one.start_s, one.end_s) for one in segments), default=0.0)
    if 0.0 < slowest < THIN_HZ:
        told.append(f"rates are logged {slowest:.0f} times a second: above {slowest / 2:.0f} Hz no oscillation is seen")
    steps = [one for one in segments if one.kind == "step"]
    # a step is seen in either of them
    seen = [max(series.rate_between(one.start_s - 1.0, one.end_s) for series in setpoints) for one in steps]
    if seen and 0.0 < min(seen) < SLOW_SETPOINT_HZ:
        late_ms = 1e3 / min(seen)
        told.append(f"set-points are logged {min(seen):.0f} times a second: a step may be seen {late_ms:.0f} ms late")
    return tuple(told)


def _largest_deg(found: Found) -> float:
    """The largest change between neighbouring levels, whatever kind it is."""
    values = [level.value_rad for level in found.levels]
    changes = [abs(b - a) for a, b in pairwise(values)]
    return math.degrees(max([found.largest_step_rad, *changes], default=0.0))


def _coverage(recorded: Recorded, segment: Segment) -> str:
    """Why the attitude does not cover a segment; empty if it does."""
    times = recorded.telemetry.between(segment.start_s, segment.end_s)["t_s"]
    length_s = segment.end_s - segment.start_s
    if len(times) < LEAST_RATE_HZ * length_s:
        rate_hz = len(times) / length_s
        return f"attitude logged {rate_hz:.1f} times a second; {LEAST_RATE_HZ:g} are needed"
    gap_s = float(np.max(np.diff(times)))
    return f"a gap of {gap_s:.2f} s in the attitude" if gap_s > LARGEST_GAP_S else ""
