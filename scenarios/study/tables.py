"""The study's tables, recomputed: 2.1, 2.2, 3.1, 4.1, 5.1 to 5.8, 7.1 to 7.3.

Ours comes from the airframe files, the scaling law and the model; the print is set beside it and used for nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from decimal import Decimal
from typing import Any

from scenarios.gain_set import load_gain_sets
from scenarios.study.printed import AIRFRAMES, digits, printed
from scenarios.study.result import Row, Table
from sitl.airframe import DERIVATIVE_NAMES, Airframe, load_airframe
from sitl.froude import froude_number, scale_derivatives
from sitl.lateral import LateralModel
from sitl.sampled_loop import RollGains

UNITS = {"Yv": "1/s", "Yp": "m/(s rad)", "Yd": "m/s^2", "Lv": "rad/(m s)", "Lp": "1/s", "Ld": "rad/s^2"}

DIMENSIONS = {"Yv": (0, -1), "Yp": (1, -1), "Yd": (1, -2), "Lv": (-1, -1), "Lp": (0, -1), "Ld": (0, -2)}
"""Powers of length and time in the unit of each derivative; an angle has none."""

GAIN_UNITS = {"K_phi": "1/s", "K_P": "s/rad", "K_I": "1/rad", "K_D": "s^2/rad"}
PARAMETERS = {"K_phi": "MC_ROLL_P", "K_P": "MC_ROLLRATE_P", "K_I": "MC_ROLLRATE_I", "K_D": "MC_ROLLRATE_D"}
GAIN_FIELDS = {"K_phi": "k_phi", "K_P": "kp", "K_I": "ki", "K_D": "kd"}

TARGET_TABLES = {"7.1": "ANT-R", "7.2": "ANT-X", "7.3": "ADAM-0"}
"""Tables of chapter 7 by target; CARRIER-1 reuses ADAM-0's."""

Tuned = Mapping[tuple[str, str], RollGains]


def tables(tuned: Tuned | None = None) -> tuple[Table, ...]:
    """Every table, in the study's order.

    Args:
        tuned: gains of ours by (target, reference), set beside those of 7.1 to 7.3; None if none were made.
    """
    frames = {name: load_airframe(name) for name in AIRFRAMES}
    return (
        _identified(frames),
        _flight_gains(frames),
        _modes(frames),
        _exponents(),
        *_scaled(frames),
        *(_synthesised(number, target, tuned) for number, target in TARGET_TABLES.items()),
    )


def row(item: str, column: str, unit: str, value: Decimal | int, ours: float | None) -> Row:
    """One number beside its print.

    Args:
        item, column, unit: as `Row`. value: printed. ours: recomputed.
    """
    return Row(item, column, unit, float(value), ours, digits(value))


def _identified(frames: Mapping[str, Airframe]) -> Table:
    rows = []
    for name, frame in frames.items():
        said = printed()["derivatives"][name]
        for derivative in DERIVATIVE_NAMES:
            ours, sigma = getattr(frame.derivatives, derivative), getattr(frame.sigma_pct, derivative)
            rows.append(row(derivative, name, UNITS[derivative], said["value"][derivative], ours))
            rows.append(row(f"sigma {derivative}", name, "%", said["sigma_pct"][derivative], sigma))
    return Table(
        "2.1", "identified derivatives and their standard deviations", tuple(rows), "Inputs: what we fly with."
    )


def _flight_gains(frames: Mapping[str, Airframe]) -> Table:
    rows = []
    for name, frame in frames.items():
        flown = frame.flight_gains
        for gain, field in GAIN_FIELDS.items():
            ours = None if flown is None else float(getattr(flown, field))
            rows.append(row(gain, name, GAIN_UNITS[gain], printed()["flight_gains"][name][gain], ours))
    return Table("2.2", "gains of the flight tests", tuple(rows), "Inputs: what we fly with.")


def _modes(frames: Mapping[str, Airframe]) -> Table:
    rows = []
    for name, frame in frames.items():
        modes = {mode.name: mode for mode in LateralModel.from_derivatives(frame.derivatives).modes()}
        for mode in ("roll", "phugoid"):
            said = printed()["modes"][name]
            rows.append(row(f"{mode} frequency", name, "rad/s", said[f"{mode}_wn"], modes[mode].wn_rad_s))
            rows.append(row(f"{mode} damping", name, "1", said[f"{mode}_zeta"], modes[mode].zeta))
    return Table("3.1", "natural modes", tuple(rows), "Eigenvalues of the matrix of equation 2.2 with table 2.1.")


def _exponents() -> Table:
    """Lengths go with N^-1 and, at equal Froude number, times with N^-1/2: the unit alone gives the exponent."""
    rows = []
    for name, (length, time) in DIMENSIONS.items():
        rows.append(row(name, "exponent of N", "1", printed()["froude_exponent"][name], -(length + 0.5 * time)))
    note = "Derived from the unit of each derivative, with lengths as 1/N and times as 1/sqrt(N)."
    return Table("4.1", "how each derivative scales", tuple(rows), note)


def _scaled(frames: Mapping[str, Airframe]) -> Iterator[Table]:
    for chapter, target in enumerate(AIRFRAMES):
        said = printed()["froude_number"][target]
        rows = [row("N", name, "1", said[name], froude_number(frame, frames[target])) for name, frame in frames.items()]
        yield Table(f"5.{2 * chapter + 1}", f"Froude numbers for the target {target}", tuple(rows))
        rows = []
        # the study prints the columns of CARRIER-1 again for ADAM-0, whose N are the same
        columns: Mapping[str, Any] = printed()["scaled"]["CARRIER-1" if target == "ADAM-0" else target]
        for name, frame in frames.items():
            ours = scale_derivatives(frame.derivatives, froude_number(frame, frames[target]))
            for derivative in DERIVATIVE_NAMES:
                value = columns[name][derivative]
                rows.append(row(derivative, name, UNITS[derivative], value, getattr(ours, derivative)))
        yield Table(
            f"5.{2 * chapter + 2}",
            f"derivatives scaled to {target}",
            tuple(rows),
            "Table 2.1 of each reference times N to the power of table 4.1.",
        )


def _synthesised(number: str, target: str, tuned: Tuned | None) -> Table:
    ours = {one.name.partition(" ")[2]: one for one in load_gain_sets(f"table_{number.replace('.', '_')}")}
    rows = []
    for name in AIRFRAMES:
        for gain, parameter in PARAMETERS.items():
            value = printed()["hinf_gains"][target][name][gain]
            made = None if tuned is None else tuned.get((target, name))
            mine = float(ours[name].parameters[parameter]) if tuned is None else None
            if made is not None:
                mine = float(getattr(made, GAIN_FIELDS[gain]))
            one = row(gain, name, GAIN_UNITS[gain], value, mine)
            rows.append(replace(one, compared=tuned is None))
    note = (
        "Inputs: the built-in gain sets. `froude study --tune` makes gains of our own."
        if tuned is None
        else "Ours: made by `froude tune` for profile study. The print gives the requirements, not the weights: "
        "another design of the same kind, not the same numbers."
    )
    return Table(number, f"H-infinity gains for {target}", tuple(rows), note)
