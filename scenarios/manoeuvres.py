"""Manoeuvres: roll set-points as functions of time, and the windows of them that are measured.

A manoeuvre is a chain of parts (levels, ramps, sines, chirps). Its set-point is sampled and held at the
scenario's set-point rate, so every edge of a part must fall on that grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scenarios.signals import Chirp, FloatArray, Part, Ramp, Sines
from sitl.errors import FileError
from sitl.keyed_table import KeyedTable, nearest

MAX_TILT_DEG = 45.0  # beyond it the thrust of a vehicle that hovers at half throttle no longer carries it for long
MAX_DURATION_S = 600.0
EPSILON_S = 1e-9  # set-point k is due at k / rate: rounding must not push it before its edge


@dataclass(frozen=True)
class Window:
    """A part of a manoeuvre that is measured.

    Attributes:
        kind: "step": scored as a step from rest; "track": how well the set-point is followed; "hold": watched
            for oscillation only. Later edges of a step or doublet are holds: the vehicle has gained speed by
            then and Lv v rolls it past the set-point, which is no property of the gains.
        start_s: from the manoeuvre's start, when the window's first set-point is sent.
        end_s: when the next window's first set-point is sent.
        phi_from_rad: set-point before.
        phi_to_rad: set-point held; for "track" the largest magnitude.
    """

    kind: str
    start_s: float
    end_s: float
    phi_from_rad: float
    phi_to_rad: float


@dataclass(frozen=True)
class Manoeuvre:
    """A roll set-point signal that starts from level; build it with `make_manoeuvre`.

    Attributes:
        name: unique in the scenario.
        kind: one of `KINDS`.
        parts: in order of time.
        windows: in order of time, without overlap, covering the manoeuvre.
        settings: the keys it was built from.
    """

    name: str
    kind: str
    parts: tuple[Part, ...]
    windows: tuple[Window, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def duration_s(self) -> float:
        """Length, return to level included."""
        return math.fsum(part.duration_s for part in self.parts)

    def setpoint(self, t_s: float) -> float:
        """Roll set-point in rad at a time from the start; level before and after."""
        return float(_values(self.parts, np.array([t_s]))[0])

    def samples(self, rate_hz: float) -> FloatArray:
        """Roll set-points in rad to send at 0, 1/rate, 2/rate ...; shape (round(duration * rate),)."""
        return _values(self.parts, np.arange(round(self.duration_s * rate_hz)) / rate_hz)


def make_manoeuvre(kind: str, name: str = "", *, setpoint_rate_hz: float = 50.0, **keys: Any) -> Manoeuvre:
    """Build and check one manoeuvre.

    Args:
        kind: one of `KINDS`.
        name: the kind if empty.
        setpoint_rate_hz: edges must fall on its grid, frequencies stay below half of it, and a multisine has
            its peak at this rate.
        keys: as in a scenario file.

    Raises:
        FileError: as `parse_manoeuvres`.
    """
    return _parse({"kind": kind, "name": name or kind, **keys}, Path("manoeuvre"), "", setpoint_rate_hz)


def parse_manoeuvres(tables: Any, path: Path, setpoint_rate_hz: float) -> tuple[Manoeuvre, ...]:
    """Manoeuvres of a scenario file's [[manoeuvre]] tables.

    Raises:
        FileError: none given, a name used twice, an unknown kind or key, a missing key, a set-point beyond 45
            degrees, a duration or frequency out of range, or an edge between two set-points.
    """
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise FileError(path, "holds no [[manoeuvre]]", 'Write [[manoeuvre]] kind = "step", amplitude_deg = 10.0')
    made: list[Manoeuvre] = []
    for number, table in enumerate(tables):
        where = f"manoeuvre[{number}]"
        manoeuvre = _parse(table, path, where, setpoint_rate_hz)
        if manoeuvre.name in [other.name for other in made]:
            problem = f'{where}.name: "{manoeuvre.name}" is used twice'
            raise FileError(path, problem, "Give each manoeuvre its own name")
        made.append(manoeuvre)
    total_s = math.fsum(manoeuvre.duration_s for manoeuvre in made)
    if total_s > MAX_DURATION_S:
        problem = f"the manoeuvres last {total_s:g} s together"
        raise FileError(path, problem, f"At most {MAX_DURATION_S:g} s are flown")
    return tuple(made)


def _parse(raw: dict[str, Any], path: Path, where: str, rate_hz: float) -> Manoeuvre:
    keys = _Keys(raw, path, where, rate_hz)
    kind = keys.table.text("kind")
    name = keys.table.text("name", kind)
    if kind not in KINDS:
        hint = f"Kinds are {', '.join(KINDS)}"
        raise keys.table.error("kind", f'unknown kind "{kind}"{nearest(kind, KINDS)}', hint)
    signal = KINDS[kind](keys)
    return_s = keys.seconds("return_s", RETURN_S[kind], zero=True) if kind in RETURN_S else 0.0
    keys.table.finish()
    parts = (*signal, Ramp.level(return_s, 0)) if return_s else tuple(signal)
    _check_edges(parts, keys)
    windows = _step_windows(parts) if kind in ("step", "doublet") else _track_windows(signal, return_s, rate_hz)
    return Manoeuvre(name, kind, parts, windows, {"kind": kind, **keys.read})


class _Keys:
    """Reads a manoeuvre's keys with their ranges, and remembers them with the defaults filled in."""

    def __init__(self, raw: dict[str, Any], path: Path, where: str, rate_hz: float) -> None:
        self.raw = raw
        self.table = KeyedTable(path, raw, where)
        self.rate_hz = rate_hz
        self.read: dict[str, Any] = {}

    def degrees(self, key: str) -> float:
        """A roll angle in degrees, not zero."""
        value = self.table.number(key, at_least=-MAX_TILT_DEG, at_most=MAX_TILT_DEG)
        if value == 0:
            raise self.table.error(key, "0 moves nothing", "Give an angle")
        return self._keep(key, value)

    def seconds(self, key: str, default: float | None = None, *, zero: bool = False) -> float:
        """A duration in s."""
        if zero:
            return self._keep(key, self.table.number(key, default, at_least=0.0, at_most=MAX_DURATION_S))
        return self._keep(key, self.table.number(key, default, above=0.0, at_most=MAX_DURATION_S))

    def rate(self, key: str) -> float:
        """A speed in deg/s; the amplitude has the sign."""
        return self._keep(key, self.table.number(key, above=0.0, at_most=1000.0))

    def fade(self, duration_s: float) -> float:
        """Fade-in and fade-out time in s, at most half the duration each."""
        most = duration_s / 2
        return self._keep("fade_s", self.table.number("fade_s", min(0.5, most), at_least=0.0, at_most=most))

    def hertz(self, key: str) -> float:
        """A frequency that the set-point rate can carry."""
        return self._keep(key, self.table.number(key, above=0.0, below=self.rate_hz / 2))

    def sines(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Frequencies in Hz and as many phases in rad."""
        listed = self.raw.get("frequencies_hz")
        count = max(1, len(listed)) if isinstance(listed, list) else 1
        frequencies = self.table.numbers("frequencies_hz", count, above=0.0)
        phases = self.table.numbers("phases_rad", count)
        for frequency in frequencies:
            if frequency >= self.rate_hz / 2:
                remedy = f"It must be < {self.rate_hz / 2:g}, half the set-point rate"
                raise self.table.error("frequencies_hz", f"{frequency:g} is out of range", remedy)
        self.read |= {"frequencies_hz": frequencies, "phases_rad": phases}
        return frequencies, phases

    def sweep(self) -> bool:
        """Is the chirp logarithmic?"""
        value = self.table.text("sweep", "log")
        if value not in ("log", "linear"):
            raise self.table.error("sweep", f'"{value}" is not known', 'Write "log" or "linear"')
        self.read["sweep"] = value
        return value == "log"

    def _keep(self, key: str, value: float) -> float:
        self.read[key] = value
        return value


def _step(keys: _Keys) -> list[Part]:
    """One step and back."""
    return [Ramp.level(keys.seconds("hold_s", 3.0), keys.degrees("amplitude_deg"))]


def _doublet(keys: _Keys) -> list[Part]:
    """+A, level, -A, level, each held."""
    hold_s, amplitude = keys.seconds("hold_s", 3.0), keys.degrees("amplitude_deg")
    return [Ramp.level(hold_s, sign * amplitude) for sign in (1, 0, -1, 0)]


def _3211(keys: _Keys) -> list[Part]:
    """+A for 3 units, -A for 2, +A for 1, -A for 1: the identification input with an even spectrum."""
    unit_s, amplitude = keys.seconds("unit_s", 0.5), keys.degrees("amplitude_deg")
    return [Ramp.level(n * unit_s, sign * amplitude) for n, sign in ((3, 1), (2, -1), (1, 1), (1, -1))]


def _ramp(keys: _Keys) -> list[Part]:
    """Level to A to -A to level at a constant rate, held at both ends if asked."""
    peak, rate = keys.degrees("amplitude_deg"), keys.rate("rate_deg_s")
    hold_s = keys.seconds("hold_s", 0.0, zero=True)
    parts: list[Part] = []
    for start, end in ((0.0, peak), (peak, -peak), (-peak, 0.0)):
        parts.append(Ramp.at_rate(start, end, rate))
        if hold_s and end:
            parts.append(Ramp.level(hold_s, end))
    return parts


def _chirp(keys: _Keys) -> list[Part]:
    """A swept sine, faded in and out."""
    duration_s, amplitude = keys.seconds("duration_s"), math.radians(keys.degrees("amplitude_deg"))
    f0_hz, f1_hz, logarithmic = keys.hertz("f0_hz"), keys.hertz("f1_hz"), keys.sweep()
    return [Chirp(duration_s, amplitude, f0_hz, f1_hz, logarithmic, keys.fade(duration_s))]


def _multisine(keys: _Keys) -> list[Part]:
    """Sines of equal amplitude, faded in and out, scaled to a peak."""
    duration_s, peak = keys.seconds("duration_s"), keys.degrees("peak_deg")
    frequencies, phases = keys.sines()
    fade_s = keys.fade(duration_s)
    if len(set(frequencies)) < len(frequencies):
        raise keys.table.error("frequencies_hz", "a frequency is given twice", "Give each once")
    return [Sines.with_peak(duration_s, peak, frequencies, phases, fade_s, keys.rate_hz)]


def _track(keys: _Keys) -> list[Part]:
    """Steps, ramps and a multisine in 20 s: stands in for the study's figure 7.2, which is not available."""
    frequencies, phases = (0.25, 0.5, 0.9, 1.4, 2.0), (0.0, 2.1, 4.4, 1.2, 3.3)
    return [
        *(Ramp.level(1.0, 0), Ramp.level(1.5, 10), Ramp.level(1.5, -10), Ramp.level(1.0, 0)),
        *(Ramp.at_rate(0, 15, 10), Ramp.at_rate(15, -15, 10), Ramp.at_rate(-15, 0, 10), Ramp.level(1.0, 0)),
        *(Sines.with_peak(7.5, 15.0, frequencies, phases, 0.5, keys.rate_hz), Ramp.level(0.5, 0)),
    ]


RECORDED = "recorded"
"""Kind of a manoeuvre that was found in a recorded flight; none of `KINDS`, which can be planned."""

KINDS: Mapping[str, Callable[[_Keys], list[Part]]] = {
    "step": _step,
    "doublet": _doublet,
    "3211": _3211,
    "ramp": _ramp,
    "chirp": _chirp,
    "multisine": _multisine,
    "track": _track,
}

# Level after the signal, s, unless the file says otherwise: its last second shows whether the vehicle
# oscillates.
RETURN_S = {"step": 3.0, "3211": 2.0, "ramp": 2.0, "chirp": 2.0, "multisine": 2.0, "track": 2.0}


def _values(parts: Sequence[Part], t_s: FloatArray) -> FloatArray:
    """Roll set-point of a chain of parts, rad, shape of t_s; level before and after."""
    out = np.zeros_like(t_s)
    start = 0.0
    for part in parts:
        end = start + part.duration_s
        inside = (t_s >= start - EPSILON_S) & (t_s < end - EPSILON_S)
        out[inside] = part.values(np.clip(t_s[inside] - start, 0.0, part.duration_s))
        start = end
    return out


def _check_edges(parts: Sequence[Part], keys: _Keys) -> None:
    """Every edge on the set-point grid, and not too long."""
    edge = 0.0
    for part in parts:
        edge += part.duration_s
        if abs(edge * keys.rate_hz - round(edge * keys.rate_hz)) > 1e-6:
            remedy = f"Set-points are sent every {1 / keys.rate_hz:g} s: make every duration a multiple of it"
            raise keys.table.error("edge", f"{edge:g} s falls between two set-points", remedy)
        if 0.0 < part.duration_s < 0.5 / keys.rate_hz:
            # within rounding of the grid, and yet not one set-point long
            remedy = f"Set-points are sent every {1 / keys.rate_hz:g} s"
            raise keys.table.error("duration", f"a part of {part.duration_s:g} s holds no set-point", remedy)
    if edge > MAX_DURATION_S:
        raise keys.table.error("duration", f"{edge:g} s in all", f"At most {MAX_DURATION_S:g} s are flown")


def _step_windows(parts: Sequence[Part]) -> tuple[Window, ...]:
    windows: list[Window] = []
    start, before = 0.0, 0.0
    for part in parts:
        after = float(part.values(np.array([0.0]))[0])
        windows.append(Window("hold" if windows else "step", start, start + part.duration_s, before, after))
        start, before = start + part.duration_s, after
    return tuple(windows)


def _track_windows(signal: Sequence[Part], return_s: float, rate_hz: float) -> tuple[Window, ...]:
    end_s = math.fsum(part.duration_s for part in signal)
    sent = _values(signal, np.arange(round(end_s * rate_hz)) / rate_hz)
    track = Window("track", 0.0, end_s, 0.0, float(np.abs(sent).max()))
    if not return_s:
        return (track,)
    return (track, Window("hold", end_s, end_s + return_s, float(sent[-1]), 0.0))
