"""What a flight tells of its autopilot beside the response: Hold, take-off, landing, estimate, saturation.

One flight's numbers; `scenarios/twin.py` puts those of two autopilots beside each other. None of them has a part in the
verdict: they are there to explain why two flights of the same gains on the same plant are not the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from scenarios.flight import FlightRecord
from scenarios.metrics import LAST_S, QUIET_RAD_S, SETTLE_S, FloatArray, oscillation
from scenarios.telemetry import Telemetry
from sitl.modes import Mode

LIFTED_M = 0.3
"""Height above the place of take-off at which a vehicle has left the ground for certain."""

SINKING_M_S = 0.15
SINKING_S = 0.3
"""A descent this fast for this long ends on the ground, and a bounce is shorter."""

LATEST_S = 0.060
"""How late an estimate, a set-point or a response is looked for."""

_LEAST_ROWS = 50

AT_LIMIT = 5e-4
"""A motor command this close to 0 or 1 is at its limit."""


class Fact(NamedTuple):
    """A number measured on one flight.

    Attributes:
        value: None if it could not be measured. reason: why not, or what the value does not say by itself.
    """

    value: float | None
    reason: str = ""


def flight_facts(flight: FlightRecord) -> dict[str, Fact]:
    """Everything that is measured on a flight beside its metrics.

    Args:
        flight: with telemetry; of one that was broken off some facts have no value.

    Returns:
        name, with its unit as suffix -> fact.
    """
    facts = {**_hold(flight), **_take_off(flight), **_landing(flight), **_estimate(flight), **_saturation(flight)}
    facts["setpoint_late_s"] = _setpoint_late(flight)
    return facts


def true_roll(telemetry: Telemetry) -> tuple[FloatArray, FloatArray]:
    """Times, s, and roll angles, rad, unwrapped: the truth where the simulator tells it, else the estimate."""
    t, phi, true = (telemetry[name].astype(np.float64) for name in ("t_s", "phi_rad", "phi_true_rad"))
    known = np.isfinite(true)
    if known.sum() > len(t) // 2:
        return t[known], np.unwrap(true[known])
    return t, np.unwrap(phi)


def lateness(t: FloatArray, signal: FloatArray, ref_t: FloatArray, ref: FloatArray) -> tuple[float, float] | None:
    """How late a signal is behind a reference, and the RMS of what is left then.

    Args:
        t: (n,) s, inside the span of ref_t. signal: (n,). ref_t, ref: (m,) the same quantity without the lateness.

    Returns:
        lateness, s, negative for a signal that is early, at most `LATEST_S` either way; RMS, in the signal's unit.
        None if the two hardly overlap.
    """
    if not len(ref_t):
        return None
    # reading outside the reference would compare with its last value: leave as much as is looked for at either end
    inside = (t >= ref_t[0] + LATEST_S) & (t <= ref_t[-1] - LATEST_S)
    t, signal = t[inside], signal[inside]
    if len(t) < _LEAST_ROWS:
        return None
    lates = np.arange(-round(LATEST_S * 1e3), round(LATEST_S * 1e3) + 1) * 1e-3
    # a constant error is not mistaken for lateness: it counts in the RMS alone
    rests = [signal - np.interp(t - late, ref_t, ref) for late in lates]
    costs = np.array([float(np.var(rest)) for rest in rests])
    k = int(np.argmin(costs))
    late_s, left, off = float(lates[k]), costs[k], float(np.mean(rests[k]))
    if 0 < k < len(lates) - 1:
        before, least, after = costs[k - 1 : k + 2]
        bend = before - 2.0 * least + after
        shift = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
        late_s, left = late_s + 1e-3 * shift, max(0.0, least - 0.25 * (before - after) * shift)
    return late_s, math.sqrt(left + off**2)


def _hold(flight: FlightRecord) -> dict[str, Fact]:
    """The last second in AUTO Hold before the first manoeuvre: how still it stands, and the thrust that carries it."""
    telemetry = flight.telemetry
    names = ("hold_p_std_rad_s", "hold_q_std_rad_s", "hold_hz", "hover_thrust")
    before = flight.segments[0].start_s if flight.segments else math.inf
    held = np.flatnonzero((telemetry["nav_state"] == Mode.LOITER) & telemetry["armed"] & (telemetry["t_s"] < before))
    if not len(held):
        return dict.fromkeys(names, Fact(None, "was never in Hold"))
    # rows that follow one another: the last stretch
    last = held[np.flatnonzero(np.diff(held, prepend=-2) != 1)[-1] :]
    t = telemetry["t_s"]
    end = float(t[last[-1]])
    if end - t[last[0]] < LAST_S:
        return dict.fromkeys(names, Fact(None, f"in Hold for {end - t[last[0]]:.1f} s only"))
    rates = (telemetry[name] for name in ("p_rad_s", "q_rad_s", "r_rad_s"))
    shake = oscillation(t, *rates, start_s=end - LAST_S - SETTLE_S, end_s=end)
    rows = telemetry.between(end - LAST_S, end)
    thrust = Fact(float(np.mean(rows["thrust_sp"], dtype=np.float64)))
    if not math.isfinite(thrust.value or 0.0):
        thrust = Fact(None, "no thrust set-point reported")
    if shake.reason:
        return {**dict.fromkeys(names[:3], Fact(None, shake.reason)), names[3]: thrust}
    nyquist = 0.5 * (len(rows) - 1) / LAST_S
    shaking = max(shake.std_rad_s[:2]) > QUIET_RAD_S
    hertz = Fact(shake.frequency_hz, f"seen {2 * nyquist:.0f} times a second: above {nyquist:.0f} Hz it is another")
    return {
        names[0]: Fact(shake.std_rad_s[0]),
        names[1]: Fact(shake.std_rad_s[1]),
        names[2]: hertz if shaking else Fact(None, "too quiet to have a frequency"),
        names[3]: thrust,
    }


def _take_off(flight: FlightRecord) -> dict[str, Fact]:
    """Times from AUTO Take-off to leaving the ground, and to Hold at height."""
    t, mode, down = (flight.telemetry[name] for name in ("t_s", "nav_state", "down_m"))
    begun = np.flatnonzero(mode == Mode.TAKEOFF)
    if not len(begun):
        return dict.fromkeys(("liftoff_time_s", "takeoff_time_s"), Fact(None, "was never in Take-off"))
    k = int(begun[0])
    ground = _ground_m(flight.telemetry, k)
    up = np.flatnonzero(ground - down[k:] > LIFTED_M)
    there = np.flatnonzero(mode[k:] == Mode.LOITER)
    return {
        "liftoff_time_s": Fact(float(t[k + up[0]] - t[k])) if len(up) else Fact(None, "did not leave the ground"),
        "takeoff_time_s": Fact(float(t[k + there[0]] - t[k])) if len(there) else Fact(None, "did not reach Hold"),
    }


def _ground_m(telemetry: Telemetry, k: int) -> float:
    """Reported down of the ground, m: the median of the second before row k."""
    t, down = telemetry["t_s"], telemetry["down_m"]
    rows = down[: k + 1][t[: k + 1] >= t[k] - 1.0]
    rows = rows[np.isfinite(rows)]
    return float(np.median(rows)) if len(rows) else math.nan


def _landing(flight: FlightRecord) -> dict[str, Fact]:
    """From the command to land to the end: touch-down, bounce, tilt on the ground, time to disarming."""
    names = ("landing_time_s", "touchdown_m_s", "rebound_m_s", "ground_tilt_deg", "ground_time_s")
    telemetry = flight.telemetry
    landing = np.flatnonzero(telemetry["nav_state"] == Mode.LAND)
    if not len(landing):
        return dict.fromkeys(names, Fact(None, "was never in Land"))
    t = telemetry["t_s"]
    begin = float(t[landing[0]])
    end = _disarmed_s(flight, begin)
    if end is None:
        return dict.fromkeys(names, Fact(None, "did not disarm"))
    facts = {"landing_time_s": Fact(end - begin)}
    rows = telemetry.between(begin, end)
    touch = _touch_down(rows)
    if touch is None:
        return {**facts, **dict.fromkeys(names[1:], Fact(None, "no steady descent to the ground"))}
    touched_s = float(rows["t_s"][touch])
    sinking = rows.between(touched_s - SINKING_S, touched_s)["v_down_m_s"]
    after = rows.select(rows["t_s"] > touched_s)
    tilts = [np.abs(after[name]) for name in ("phi_rad", "theta_rad")]
    return {
        **facts,
        "touchdown_m_s": Fact(float(np.median(sinking))),
        "rebound_m_s": Fact(max(0.0, -float(np.nanmin(after["v_down_m_s"])))) if len(after) else Fact(None, "no rows"),
        "ground_tilt_deg": Fact(math.degrees(max(float(tilt.max()) for tilt in tilts)))
        if len(after)
        else Fact(None, "no rows"),
        "ground_time_s": Fact(end - touched_s),
    }


def _disarmed_s(flight: FlightRecord, begin_s: float) -> float | None:
    """When the vehicle disarmed after a time, s: as it says itself, else as its next heartbeat shows."""
    for event in flight.events:
        if event.t_s >= begin_s and event.text.lower().startswith("disarmed by landing"):
            return event.t_s
    t, armed = flight.telemetry["t_s"], flight.telemetry["armed"]
    off = np.flatnonzero((t > begin_s) & ~armed)
    return float(t[off[0]]) if len(off) else None


def _touch_down(rows: Telemetry) -> int | None:
    """Row at which the last steady descent ends."""
    t, falling = rows["t_s"], rows["v_down_m_s"] > SINKING_M_S
    edges = np.flatnonzero(np.diff(falling.astype(np.int8), prepend=0, append=0))
    runs = [(a, b - 1) for a, b in zip(edges[::2], edges[1::2], strict=True) if t[b - 1] - t[a] >= SINKING_S]
    return int(runs[-1][1]) if runs else None


def _estimate(flight: FlightRecord) -> dict[str, Fact]:
    """Estimated beside true roll while something is measured: how late it is, and the RMS of what is left."""
    names = ("estimate_late_s", "estimate_error_rms_deg")
    if not flight.segments:
        return dict.fromkeys(names, Fact(None, "no manoeuvre was flown"))
    found = []
    # one after the other: between manoeuvres the rows are too far apart to interpolate between
    for segment in flight.segments:
        rows = flight.telemetry.between(segment.start_s, segment.end_s)
        t, phi, true = (rows[name].astype(np.float64) for name in ("t_s", "phi_rad", "phi_true_rad"))
        known = np.isfinite(true)
        one = lateness(t, np.unwrap(phi), t[known], np.unwrap(true[known])) if known.sum() > 0.5 * len(t) else None
        found += [(len(t), len(t) * float(np.var(phi)) + 1e-12, *one)] if one is not None else []
    if not found:
        return dict.fromkeys(names, Fact(None, "the simulator's truth is not known"))
    count, moved, late_s, rms = np.array(found).T
    return {
        # how late what hardly moves is cannot be told
        names[0]: Fact(float(np.average(late_s, weights=moved))),
        names[1]: Fact(math.degrees(math.sqrt(float(np.average(rms**2, weights=count))))),
    }


def _saturation(flight: FlightRecord) -> dict[str, Fact]:
    """Share of the measured time in which at least one motor is at its upper or lower limit."""
    names = ("saturated_high_pct", "saturated_low_pct")
    telemetry = flight.telemetry.select(flight.telemetry["segment"] >= 0)
    motors = np.column_stack([telemetry[f"motor{n}"] for n in range(1, 9)])
    motors = motors[:, np.isfinite(motors).any(axis=0)]
    if not motors.size:
        return dict.fromkeys(names, Fact(None, "no motor commands reported"))
    return {
        names[0]: Fact(100.0 * float(np.mean((motors >= 1.0 - AT_LIMIT).any(axis=1)))),
        names[1]: Fact(100.0 * float(np.mean((motors <= AT_LIMIT).any(axis=1)))),
    }


def _setpoint_late(flight: FlightRecord) -> Fact:
    """From sending a step's set-point to the vehicle reporting it; a row's time is that of its ATTITUDE."""
    lates = []
    for segment in (one for one in flight.segments if one.kind == "step"):
        rows = flight.telemetry.between(segment.start_s, segment.end_s)
        moved = np.abs(rows["phi_sp_rad"] - segment.phi_from_rad) > 0.5 * abs(segment.amplitude_rad)
        if moved.any():
            lates.append(float(rows["t_s"][int(np.argmax(moved))] - segment.start_s))
    return Fact(max(lates)) if lates else Fact(None, "no step, or its set-point was not reported")
