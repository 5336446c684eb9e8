"""What is drawn of a flight's telemetry: which columns make the lines of which plot, and what follows from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenarios.recorder.blueprints import MEASURED, PALETTE, SETPOINT, TRUTH
from scenarios.recorder.body import RotorPlace
from scenarios.recorder.stream import Colour

DEG = 180.0 / math.pi

Columns = Mapping[str, NDArray[Any]]

AT_LIMIT = 1e-6
"""A motor this near to 0 or 1 is at its limit."""

FLICKER_S = 0.05
"""Saturation that pauses for less is shown as one."""


@dataclass(frozen=True)
class Line:
    """One telemetry column as a line.

    Attributes:
        column: of `scenarios.telemetry.COLUMNS`. name: in the legend, with unit. colour, width: of the line.
    """

    column: str
    name: str
    colour: Colour
    width: float = 1.5


@dataclass(frozen=True)
class Plot:
    """Telemetry columns drawn as the lines of one entity.

    Attributes:
        entity: path in the recording.
        lines: from the lowest to the one drawn on top.
        factor: telemetry's unit to the shown one.
    """

    entity: str
    lines: tuple[Line, ...]
    factor: float = 1.0


def _angle(name: str, symbol: str) -> Plot:
    """An angle with its set-point, above the truth where a simulator tells it."""
    lines = (
        Line(f"{symbol}_true_rad", f"{name}, true [deg]", TRUTH, 4.0),
        Line(f"{symbol}_sp_rad", f"{name} set-point [deg]", SETPOINT),
        Line(f"{symbol}_rad", f"{name} [deg]", MEASURED),
    )
    return Plot(f"/{name}", lines, DEG)


def _rate(name: str, symbol: str) -> Plot:
    lines = (
        Line(f"{symbol}_sp_rad_s", f"{symbol} set-point, as reported [rad/s]", SETPOINT),
        Line(f"{symbol}_rad_s", f"{symbol} [rad/s]", MEASURED),
    )
    return Plot(f"/{name}_rate", lines)


PLOTS = (
    _angle("roll", "phi"),
    _angle("pitch", "theta"),
    _angle("heading", "psi"),
    _rate("roll", "p"),
    _rate("pitch", "q"),
    _rate("yaw", "r"),
    Plot(
        "/velocity",
        (
            Line("v_north_m_s", "v north [m/s]", PALETTE[0]),
            Line("v_east_m_s", "v east [m/s]", PALETTE[1]),
            Line("v_down_m_s", "v down [m/s]", PALETTE[2]),
        ),
    ),
)

TERM_LINES: tuple[tuple[str, Colour, float], ...] = (
    ("P [-]", PALETTE[0], 1.5),
    ("I [-]", PALETTE[1], 1.5),
    ("D [-]", PALETTE[2], 1.5),
    ("FF [-]", PALETTE[3], 1.5),
    ("sum [-]", SETPOINT, 1.0),
)
"""Of the roll rate loop, in the order of `sitl.rate_terms.TERMS`: name, colour, width."""


def saturation(time_s: NDArray[np.float64], motors: NDArray[np.float64]) -> list[tuple[float, str]]:
    """When which motors were at a limit.

    Args:
        time_s: (n,) vehicle time, s. motors: (n, motors) commands, 0 to 1; NaN where not known.

    Returns:
        (time, state) of each change, the first row's state included: "motors 2, 3 at a limit"; empty for none.
    """
    if not len(time_s):
        return []
    at_limit = (motors <= AT_LIMIT) | (motors >= 1.0 - AT_LIMIT)
    any_at = at_limit.any(axis=1)
    changes = np.flatnonzero(np.diff(any_at.astype(np.int8), prepend=0))
    spans: list[tuple[int, int]] = []
    for first, end in zip(changes[::2], [*changes[1::2], len(time_s)][: len(changes[::2])], strict=True):
        if spans and time_s[first] - time_s[spans[-1][1] - 1] < FLICKER_S:
            spans[-1] = spans[-1][0], int(end)
        else:
            spans.append((int(first), int(end)))
    states = [] if spans and spans[0][0] == 0 else [(float(time_s[0]), "")]
    for first, end in spans:
        numbers = ", ".join(str(n + 1) for n in np.flatnonzero(at_limit[first:end].any(axis=0)))
        states.append((float(time_s[first]), f"motor {numbers} at a limit"))
        if end < len(time_s):
            states.append((float(time_s[end]), ""))
    return states


def mode_name(nav_state: int) -> str:
    """Name of PX4's flight mode, or its number if the vehicle here has no such mode; -1 is "Disarmed"."""
    from sitl.modes import MODE_NAMES, Mode

    if nav_state == -1:
        return "Disarmed"
    try:
        return MODE_NAMES[Mode(nav_state)]
    except ValueError:
        return f"nav_state {nav_state}"


def roll_extremes(rotors: Sequence[RotorPlace]) -> tuple[float, float]:
    """Largest positive and negative entry, as magnitudes, of the roll column of PX4's normalised mix."""
    from sitl.actuators import RotorEffect, normalised_mix

    effects = [RotorEffect((rotor.px_m, rotor.py_m, rotor.pz_m), km=rotor.km) for rotor in rotors]
    column = normalised_mix(effects).columns[:, 0]
    return float(column.max()), float(-column.min())


def roll_room(
    thrust: NDArray[np.float64], extremes: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How much delta_lat the motors can give at a collective thrust, the other axes quiet.

    Motors stay within 0 to 1, and PX4 without airmode may lower the collective thrust for roll but not raise
    it (sequential desaturation). With a and b the mix's extremes, delta_lat <= min(thrust / b, 1 / (a + b)),
    and the other way round with a and b exchanged.

    Args:
        thrust: (n,) collective thrust set-point, 0 to 1.
        extremes: of `roll_extremes`.

    Returns:
        The largest and the smallest delta_lat, (n,) each.
    """
    a, b = extremes
    both = 1.0 / (a + b)
    return np.minimum(thrust / b, both), -np.minimum(thrust / a, both)
