"""What identification needs of a recorded flight: the excitation, and what answered it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenarios.flight import Segment
from scenarios.identification.frequency_response import (
    ComplexArray,
    FloatArray,
    FrequencyResponse,
    period_of,
    response,
    spectra,
)
from scenarios.metrics import oscillation
from scenarios.telemetry import Telemetry
from sitl.errors import FileError, UsageError
from sitl.lateral import G_M_S2

SETTLE_S = 4.0
"""After the multisine begins, before the first period counts: the loop's transient is over."""

SATURATED = 0.02
"""Share of the rows with a motor at its limit above which the response is no linear one."""


@dataclass(frozen=True)
class Excitation:
    """A multisine that was flown.

    Attributes:
        start_s, end_s: vehicle time. frequencies_hz: (F,). fade_s: at both ends, when it does not repeat.
    """

    start_s: float
    end_s: float
    frequencies_hz: FloatArray
    fade_s: float = 1.0


def excitation_of(manoeuvres: Sequence[Mapping[str, Any]], segments: Sequence[Segment], path: Path) -> Excitation:
    """The multisine of a flight.

    Args:
        manoeuvres: of the scenario, as in run.json. segments: of the flight. path: for the error.

    Raises:
        FileError: it flew none.
    """
    for manoeuvre in manoeuvres:
        if manoeuvre.get("kind") != "multisine":
            continue
        name = str(manoeuvre.get("name", "multisine"))
        for segment in segments:
            if segment.manoeuvre == name and segment.kind == "track":
                flown = manoeuvre["settings"]
                frequencies = np.array(flown["frequencies_hz"], dtype=float)
                return Excitation(segment.start_s, segment.end_s, frequencies, float(flown["fade_s"]))
    raise FileError(
        path, "holds no multisine", 'Fly the scenario "identify", or one with a [[manoeuvre]] kind = "multisine"'
    )


@dataclass(frozen=True)
class LateralResponse:
    """How an aircraft answered.

    Attributes:
        roll: p per delta_lat, rad/s. speed: v per delta_lat, m/s.
        gravity_m_s2: what gravity pulls sideways per radian of roll at the amplitude that was flown: sin(phi) is less
            than phi, and half a per cent of gravity is several of Yd.
    """

    roll: FrequencyResponse
    speed: FrequencyResponse
    gravity_m_s2: float


def responses(telemetry: Telemetry, excitation: Excitation) -> LateralResponse:
    """Roll rate and lateral speed per delta_lat.

    Args:
        telemetry: of the flight. excitation: what was flown.

    Raises:
        UsageError: saturated motors, a limit cycle, columns that were not recorded, or too few periods.
    """
    rows = telemetry.between(excitation.start_s, excitation.end_s)
    t = np.asarray(rows["t_s"], dtype=float)
    p, delta = (np.asarray(rows[name], dtype=float) for name in ("p_rad_s", "delta_lat"))
    speed = lateral_speed(rows)
    for name, column in (("p_rad_s", p), ("delta_lat", delta), ("velocity", speed)):
        if len(t) < 100 or not np.isfinite(column).any():
            raise UsageError(f"the flight's {name} was not recorded: nothing to identify from")
    _check_linear(rows, t, excitation)
    known = np.isfinite(p) & np.isfinite(delta) & np.isfinite(speed)
    t, p, delta, speed = t[known], p[known], delta[known], speed[known]
    period = period_of(excitation.frequencies_hz)
    start = excitation.start_s + max(SETTLE_S, excitation.fade_s)
    periods = math.floor((excitation.end_s - excitation.fade_s - start) / period + 1e-9)
    omega = 2.0 * math.pi * excitation.frequencies_hz
    phi, theta = (np.asarray(rows[name], dtype=float)[known] for name in ("phi_rad", "theta_rad"))
    signals = (delta, p, speed, phi, np.sin(phi) * np.cos(theta))
    u, rate, side, angle, pull = (spectra(t, signal, start, period, max(periods, 0), omega) for signal in signals)
    side /= _hold(omega, _interval(t, np.asarray(rows["v_east_m_s"], dtype=float)[known]))
    roll, lateral = response(u, rate, omega), response(u, side, omega)
    share = np.vdot(angle.mean(axis=0), pull.mean(axis=0)).real / np.vdot(angle.mean(axis=0), angle.mean(axis=0)).real
    return LateralResponse(roll, lateral, G_M_S2 * float(share))


def lateral_speed(rows: Telemetry) -> FloatArray:
    """Speed to the right in body axes, m/s: velocity north, east, down turned by the attitude.

    Args:
        rows: of the flight.
    """
    phi, theta, psi = (np.asarray(rows[name], dtype=float) for name in ("phi_rad", "theta_rad", "psi_rad"))
    north, east, down = (np.asarray(rows[f"v_{name}_m_s"], dtype=float) for name in ("north", "east", "down"))
    sf, cf, st, ct, sp, cp = np.sin(phi), np.cos(phi), np.sin(theta), np.cos(theta), np.sin(psi), np.cos(psi)
    return np.asarray((sf * st * cp - cf * sp) * north + (sf * st * sp + cf * cp) * east + sf * ct * down)


def _interval(t: FloatArray, held: FloatArray) -> float:
    """Median time between two values of a signal that comes less often than the rows and is held between, s."""
    return float(np.median(np.diff(t[1:][np.diff(held) != 0.0])))


def _hold(omega: FloatArray, interval_s: float) -> ComplexArray:
    """(F,) complex: what holding samples makes of a signal, amplitude and half an interval of delay."""
    s = 1j * omega * interval_s
    return np.asarray((1.0 - np.exp(-s)) / s)


def _check_linear(rows: Telemetry, t: FloatArray, excitation: Excitation) -> None:
    motors = np.stack([np.asarray(rows[f"motor{n}"], dtype=float) for n in range(1, 9)])
    known = np.isfinite(motors)
    at_limit = ((motors <= 0.001) | (motors >= 0.999)) & known
    if known.any() and at_limit.any(axis=0).mean() > SATURATED:
        raise UsageError(
            f"motors at their limits in {100 * at_limit.any(axis=0).mean():.0f} % of the rows: the response is not "
            "linear. Fly a smaller peak_deg"
        )
    q, r = (np.asarray(rows[name], dtype=float) for name in ("q_rad_s", "r_rad_s"))
    quiet = np.zeros(len(t))
    shake = oscillation(t, quiet, q, r, start_s=excitation.start_s, end_s=excitation.end_s)
    if shake.is_limit_cycle:
        raise UsageError(f"{shake}: identify on gains that fly without oscillation")
