"""What a log tells of a flight, whichever format it came in."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scenarios.flight import Event
from scenarios.flight_import.series import FloatArray, Series, euler, interpolated
from scenarios.telemetry import Telemetry
from sitl.actuators import Mix, RotorEffect, normalised_mix
from sitl.airframe import Rotor
from sitl.errors import FileError

MOTORS = 8
LEAST_ROWS = 50
THIN_SETPOINT_HZ = 40.0
"""PX4's default log has 20 Hz, and a set-point is sent 50 times a second."""

MOST_DROPPED = 0.1
"""Share of the attitude's samples that may have a time which does not increase; with more the log is damaged."""

Value = float | int


@dataclass(frozen=True)
class Change:
    """A parameter as it was set, or first known. t_s: vehicle time, -inf before the log."""

    t_s: float
    name: str
    value: Value


@dataclass
class Signals:
    """Series by what they are; `None` where the log has none. Units as in `scenarios.telemetry`.

    Attributes:
        attitude: phi, theta, psi, on the time of its own sample; everything else is put on it.
        rates: p, q, r as measured. true_attitude, true_rates: a simulator's truth.
        setpoint: phi, theta, psi set-points. rates_setpoint: p, q, r. thrust: 0 to 1.
        position: north, east, down, and the velocities along them.
        motors: (n, motors) commands, 0 to 1. torque: roll and pitch torque set-points, normalised.
        state: nav_state. armed, landed: 0 or 1.
    """

    attitude: Series
    rates: Series | None = None
    true_attitude: Series | None = None
    true_rates: Series | None = None
    setpoint: Series | None = None
    rates_setpoint: Series | None = None
    thrust: Series | None = None
    position: Series | None = None
    motors: Series | None = None
    torque: Series | None = None
    state: Series | None = None
    armed: Series | None = None
    landed: Series | None = None


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded flight.

    Attributes:
        path: of the file. kind: "ULog" or "tlog".
        telemetry: one row per attitude sample.
        setpoint: phi_sp, rad, as it was recorded. rates_setpoint: p_sp, rad/s. rates: p, q, r, rad/s.
        landed: (rows,) on the ground, as far as the log knows.
        changes: of parameters, in order of time.
        mode_late_s: how much later than it came a mode may be seen, s.
        rotors: of CA_ROTOR*; empty if the log does not say.
        events: texts, in order of time.
        facts: software, hardware, system, date: name -> text.
        notes: what is to be known when its metrics are read.
    """

    path: Path
    kind: str
    telemetry: Telemetry
    setpoint: Series
    rates_setpoint: Series
    rates: Series
    landed: FloatArray
    changes: tuple[Change, ...]
    mode_late_s: float = 0.0
    rotors: tuple[Rotor, ...] = ()
    events: tuple[Event, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def parameters(self, at_s: float = math.inf) -> dict[str, Value]:
        """Parameters in force at a vehicle time, s."""
        return {change.name: change.value for change in self.changes if change.t_s <= at_s}


def rotors_of(parameters: Mapping[str, Value]) -> tuple[Rotor, ...]:
    """The rotors that CA_ROTOR* name; empty if a position is missing or none is known."""
    count = int(parameters.get("CA_ROTOR_COUNT", 0) or 0)
    if not 0 < count <= 12:
        return ()
    rotors = []
    for n in range(count):
        places = [parameters.get(f"CA_ROTOR{n}_{what}") for what in ("PX", "PY")]
        if None in places:
            return ()
        rest = [parameters.get(f"CA_ROTOR{n}_{what}", default) for what, default in (("PZ", 0.0), ("KM", 0.05))]
        rotors.append(Rotor(*(float(value) for value in (*places, *rest) if value is not None)))
    return tuple(rotors)


def mix_of_rotors(rotors: Sequence[Rotor]) -> Mix | None:
    """PX4's normalised mix; None for no rotors, or a geometry that cannot roll."""
    if not rotors:
        return None
    mix = normalised_mix([RotorEffect((one.px_m, one.py_m, one.pz_m), km=one.km) for one in rotors])
    return mix if mix.motors == len(rotors) and np.isfinite(mix.inverse).all() else None


def record(
    path: Path,
    kind: str,
    signals: Signals,
    changes: Iterable[Change],
    *,
    rotors: Sequence[Rotor] = (),
    events: Iterable[Event] = (),
    facts: Mapping[str, str] | None = None,
    notes: Iterable[str] = (),
) -> Recorded:
    """Put every signal on the attitude's own time stamps.

    Args:
        path: of the file. kind: "ULog" or "tlog". signals: what was found. changes: of parameters.
        rotors: to use where the log names none. events, facts, notes: as in `Recorded`.

    Raises:
        FileError: it never armed, has too few attitude samples, or its time goes backwards.
    """
    attitude = signals.attitude
    total = len(attitude) + attitude.dropped
    if attitude.dropped > MOST_DROPPED * total:
        raise FileError(
            path,
            f"time goes backwards: {attitude.dropped} of {total} attitude samples are not later than one before",
            "The file is damaged; fetch it from the vehicle again",
        )
    if len(attitude) < LEAST_ROWS:
        raise FileError(
            path,
            f"holds {len(attitude)} attitude samples; {LEAST_ROWS} are needed",
            "Record the flight again, with attitude in the log",
        )
    told = list(notes)
    if attitude.dropped:
        told.append(f"{attitude.dropped} attitude samples out of order were left out")
    ordered = tuple(sorted(changes, key=lambda change: change.t_s))
    found = rotors_of({change.name: change.value for change in ordered}) or tuple(rotors)
    t = attitude.t_s
    columns: dict[str, Any] = {"t_s": t}
    _put(columns, ("phi_rad", "theta_rad", "psi_rad"), attitude.values)
    rates = _rates(signals)
    _held(columns, ("p_rad_s", "q_rad_s", "r_rad_s"), rates, t)
    if signals.true_attitude is not None and len(signals.true_attitude):
        # logged more thinly than the estimate that it is compared with: held, it would be late, and the estimate wrong
        true = signals.true_attitude
        smooth = Series(true.t_s, np.unwrap(true.values, axis=0))
        angles = (interpolated(smooth, t) + math.pi) % math.tau - math.pi
        _put(columns, ("phi_true_rad", "theta_true_rad", "psi_true_rad"), angles)
    _held(columns, ("phi_sp_rad", "theta_sp_rad", "psi_sp_rad"), signals.setpoint, t)
    if signals.setpoint is not None and 0.0 < signals.setpoint.rate_hz < THIN_SETPOINT_HZ:
        # held, it would come half a period late throughout, and the vehicle would seem that much quicker
        lines = interpolated(Series(signals.setpoint.t_s, signals.setpoint.values[:, :2]), t)
        _put(columns, ("phi_sp_rad", "theta_sp_rad"), lines)
        told.append(
            f"attitude set-points are logged {signals.setpoint.rate_hz:.0f} times a second: taken on straight lines "
            "between, lag and VAF are less sure"
        )
    _held(columns, ("p_sp_rad_s", "q_sp_rad_s", "r_sp_rad_s"), signals.rates_setpoint, t)
    _held(columns, ("thrust_sp",), signals.thrust, t)
    names = ("north_m", "east_m", "down_m", "v_north_m_s", "v_east_m_s", "v_down_m_s")
    _held(columns, names, signals.position, t)
    told += _effort(columns, signals, found, t)
    columns["nav_state"] = _state(signals.state, t, -1.0).astype(np.int16)
    columns["armed"] = _state(signals.armed, t, 0.0) > 0.5
    telemetry = Telemetry.from_columns(columns)
    if not telemetry["armed"].any():
        raise FileError(
            path, "the vehicle never armed: nothing was flown", "Give the log of a flight; a log per boot may hold none"
        )
    empty = Series.of([], [])
    phi_sp = signals.setpoint
    return Recorded(
        path=path,
        kind=kind,
        telemetry=telemetry,
        setpoint=empty if phi_sp is None else Series(phi_sp.t_s, phi_sp.values[:, :1]),
        rates_setpoint=empty if signals.rates_setpoint is None else signals.rates_setpoint,
        rates=empty if rates is None else rates,
        landed=_state(signals.landed, t, 0.0),
        changes=ordered,
        mode_late_s=_mode_late_s(signals.state),
        rotors=found,
        events=tuple(sorted(events, key=lambda event: event.t_s)),
        facts=dict(facts or {}),
        notes=tuple(told),
    )


def _put(columns: dict[str, Any], names: Sequence[str], values: FloatArray) -> None:
    columns.update((name, values[:, k]) for k, name in enumerate(names))


def _held(columns: dict[str, Any], names: Sequence[str], series: Series | None, t: FloatArray) -> None:
    if series is not None and len(series):
        _put(columns, names, series.at(t))


def _state(series: Series | None, t: FloatArray, missing: float) -> FloatArray:
    if series is None or not len(series):
        return np.full(len(t), missing)
    held = series.at(t, stale_s=None)[:, 0]
    return np.where(np.isfinite(held), held, missing)


def _rates(signals: Signals) -> Series | None:
    """The truth, where a simulator tells it as often as the vehicle tells its own measurement."""
    true, measured = signals.true_rates, signals.rates
    if true is None or (measured is not None and true.rate_hz < 0.8 * measured.rate_hz):
        return measured
    return true


def _mode_late_s(state: Series | None) -> float:
    """A mode that only HEARTBEAT tells is seen up to a second after it came."""
    if state is None or state.rate_hz > 2.0 or not state.rate_hz:
        return 0.0
    return min(1.5, 1.1 / state.rate_hz)


def _effort(columns: dict[str, Any], signals: Signals, rotors: Sequence[Rotor], t: FloatArray) -> list[str]:
    """Motors, and the torque they make: of the motors where they are logged often enough, else the set-point."""
    motors, torque = signals.motors, signals.torque
    mix = mix_of_rotors(rotors)
    if motors is not None and len(motors):
        shown = motors.values[:, :MOTORS]
        _put(columns, [f"motor{n + 1}" for n in range(shown.shape[1])], Series(motors.t_s, shown).at(t))
    usable = motors is not None and len(motors) > 1 and mix is not None and motors.values.shape[1] >= mix.motors
    if torque is not None and len(torque) > 1 and (not usable or torque.rate_hz > 1.5 * motors.rate_hz):  # type: ignore[union-attr]
        _put(columns, ("delta_lat", "delta_lon"), torque.at(t))
        return [f"delta_lat is the torque set-point, {torque.rate_hz:.0f} times a second: saturation is not in it"]
    if usable:
        assert motors is not None
        assert mix is not None
        _put(columns, ("delta_lat", "delta_lon"), motors.at(t)[:, : mix.motors] @ mix.inverse[:2].T)
        return [] if motors.rate_hz > 40.0 else [f"motors are logged {motors.rate_hz:.0f} times a second only"]
    if motors is not None and len(motors):
        return ["the log names no rotors (CA_ROTOR*): no delta_lat from its motors"]
    return []


__all__ = ["Change", "Recorded", "Signals", "Value", "euler", "mix_of_rotors", "record", "rotors_of"]
