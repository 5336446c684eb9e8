"""An airframe file made of fitted derivatives: everything else is that of the airframe that flew."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from scenarios.identification.lateral_fit import Fit
from scenarios.run_folder import write_atomically
from scenarios.toml_file import quoted
from sitl.airframe import DERIVATIVE_KEYS, Airframe
from sitl.errors import FileError, UsageError

GAIN_UNITS = {"k_phi": "1_s", "kp": "s_rad", "ki": "1_rad", "kd": "s2_rad"}


def write_airframe(path: Path, name: str, body: Airframe, fit: Fit, origin: str) -> None:
    """Write a file that `load_airframe` reads.

    Args:
        path: of the .toml.
        name: of the new airframe.
        body: whose mass, geometry, flight gains and assumptions are kept.
        fit: whose derivatives, deviations and motor lag are written.
        origin: the flight, for the comment at the top.

    Raises:
        FileError: the folder cannot be made or written to.
        UsageError: the fit has no roll authority: not a model of an aircraft.
    """
    if not fit.derivatives.Ld > 0.0:
        raise UsageError(
            f"the fitted Ld is {fit.derivatives.Ld:g} rad/s^2, not above 0: the motors' roll command does not roll "
            "this aircraft right. Check the airframe's rotors against the vehicle's motor order"
        )
    lag, lag_half = fit.motor_lag_s
    lines = [
        f"# {name}: derivatives identified by froude identify from {_one_line(origin)}.",
        f"# {fit.points} points of two frequency responses; misfit {fit.misfit:.2f} (1: noise alone).",
        "",
        f"name = {quoted(name)}",
        f"title = {quoted(f'{body.title}, identified from a flight')}",
        f"mass_kg = {body.mass_kg!r}",
        f"frame_m = [{', '.join(repr(x) for x in body.frame_m)}]",
        f"diagonal_m = {body.diagonal_m!r}",
        f"lateral_m = {body.lateral_m!r}",
        f"layout = {quoted(body.layout)}",
    ]
    lines += [f"battery = {quoted(body.battery)}"] if body.battery else []
    lines += [f"hover_min = {body.hover_min!r}"] if body.hover_min is not None else []
    lines += ["", "# Per unit of delta_lat", "[derivatives]"]
    lines += [f"{DERIVATIVE_KEYS[key]} = {value!r}" for key, value in fit.derivatives.as_dict().items()]
    lines += ["", "# One standard deviation in per cent of the value", "[sigma]"]
    lines += [f"{key}_pct = {value:.4g}" for key, value in fit.sigma_pct.as_dict().items()]
    if body.flight_gains is not None:
        lines += ["", "# What it flew with before", "[flight_gains]"]
        gains = dataclasses.asdict(body.flight_gains)
        lines += [f"{key}_{GAIN_UNITS[key]} = {value!r}" for key, value in gains.items()]
    lines += ["", f"# Motor lag identified, +-{1e3 * lag_half:.2g} ms; the others are the body's assumptions"]
    lines += ["[assumptions]"]
    assumed = dataclasses.asdict(body.assumptions) | {"motor_lag_s": round(min(max(lag, 0.0), 0.5), 6)}
    lines += [f"{key} = {value!r}" for key, value in assumed.items()]
    for rotor in body.rotors:
        lines += ["", "[[rotors]]", *(f"{key} = {value!r}" for key, value in dataclasses.asdict(rotor).items())]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(path, f"its folder cannot be made: {error.strerror}", "Choose another --out") from error
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _one_line(text: str) -> str:
    return " ".join(text.split())
