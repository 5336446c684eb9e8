"""`froude identify`: an airframe file from a flown multisine."""

from __future__ import annotations

import argparse
import cmath
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.identification.flight_data import LateralResponse
    from scenarios.identification.lateral_fit import Fit

EXIT_OK = 0
SCHEMA_VERSION = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude identify`."""
    add = parser.add_argument
    add("run_or_flight", type=Path, help="folder of a run that flew a multisine, or one of its flights/*.parquet")
    add("--airframe", metavar="NAME|FILE", help="whose body the file describes (default: the one that flew)")
    add("--name", metavar="NAME", help="of the new airframe (default: that of the body with -identified)")
    add("--out", type=Path, metavar="FILE", help="the airframe's .toml (default: NAME.toml, lower case)")
    add("--json", action="store_true", help="print everything for machines")


def run(args: argparse.Namespace) -> int:
    """Identify, write the airframe file, print the result.

    Args:
        args: the parsed arguments.

    Returns:
        exit status 0.
    """
    from scenarios.flight import Segment
    from scenarios.identification.flight_data import excitation_of, responses
    from scenarios.identification.identified_airframe import write_airframe
    from scenarios.identification.lateral_fit import fit
    from scenarios.telemetry import Telemetry
    from sitl.airframe import AIRFRAME_NAME, load_airframe
    from sitl.errors import UsageError
    from sitl.vehicle_spec import resolve_vehicle

    if args.out is not None and args.out.suffix != ".toml":
        raise UsageError(f"--out {args.out}: an airframe is a .toml file; give it that ending")
    flown, flight, parquet = _flight(args.run_or_flight)
    body = load_airframe(args.airframe) if args.airframe else resolve_vehicle(flown["vehicle"]["spec"], ()).airframe
    name = args.name or f"{body.name}-identified"
    if not AIRFRAME_NAME.fullmatch(name):
        raise UsageError(f"--name {name!r} is not a name: use letters, digits, '.', '_', '+' and '-'")
    excitation = excitation_of(
        flown["scenario"]["manoeuvres"], [Segment(**segment) for segment in flight["segments"]], parquet
    )
    measured = responses(Telemetry.from_parquet(parquet)[0], excitation)
    found = fit(measured.roll, measured.speed, gravity_m_s2=measured.gravity_m_s2)
    path = args.out or Path(f"{name.lower()}.toml")
    write_airframe(path, name, body, found, f"flight {parquet.stem} of run {parquet.parent.parent.name}")
    simulated = "--connect" not in flown.get("command", ())
    shown = identification_object(found, measured, flown["vehicle"], simulated)
    if args.json:
        sys.stdout.write(json.dumps(shown | {"file": str(path)}, indent=2, allow_nan=False) + "\n")
        return EXIT_OK
    sys.stdout.write(_text(shown) + f"\nWritten: {path}\nLook at it: froude model {path}\n")
    return EXIT_OK


def identification_object(
    fit: Fit, measured: LateralResponse, vehicle: dict[str, Any], simulated: bool
) -> dict[str, Any]:
    """The result as plain data.

    Args:
        fit: derivatives with intervals. measured: what they explain. vehicle: of run.json, the model beside.
        simulated: whether that model is what flew, and not only what the scenario named.
    """
    rows = {
        name: {
            "value": value,
            "interval_95": half,
            "unit": vehicle["derivative_units"][name],
            "model": vehicle["derivatives"][name],
            "model_inside": abs(value - vehicle["derivatives"][name]) <= half,
        }
        for (name, value), half in zip(
            fit.derivatives.as_dict().items(), fit.interval_95.as_dict().values(), strict=True
        )
    }
    points = {
        name: {
            "frequency_hz": [round(float(omega) / math.tau, 4) for omega in one.omega_rad_s],
            "magnitude": [float(abs(value)) for value in one.value],
            "phase_rad": [cmath.phase(value) for value in one.value],
            "deviation": [float(x) for x in one.deviation],
            "coherence": [float(x) for x in one.coherence],
        }
        for name, one in (("p_per_delta_lat", measured.roll), ("v_per_delta_lat", measured.speed))
    }
    return {
        "schema_version": SCHEMA_VERSION,
        "vehicle": vehicle["name"],
        "model_is_truth": simulated,
        "derivatives": rows,
        "motor_lag_s": {"value": fit.motor_lag_s[0], "interval_95": fit.motor_lag_s[1]},
        "delay_s": {"value": fit.delay_s[0], "interval_95": fit.delay_s[1]},
        "periods": measured.roll.periods,
        "points": fit.points,
        "misfit": fit.misfit,
        "unknown": list(fit.unknown),
        "responses": points,
    }


def _text(shown: dict[str, Any]) -> str:
    beside = "truth" if shown["model_is_truth"] else "model of the run"
    title = f"{shown['vehicle']}, identified from {shown['periods']} periods of a multisine"
    lines = [title, "", f"  {'':<11} {'identified':>11} {'95 %':>10}   {'unit':<10} {beside:>16}"]
    for name, row in shown["derivatives"].items():
        mark = "" if row["model_inside"] else "   outside the interval"
        lines.append(
            f"  {name:<11} {row['value']:>11.5g} {'+-' + format(row['interval_95'], '.3g'):>10}   {row['unit']:<10} "
            f"{row['model']:>16.5g}{mark}"
        )
    for name, key in (("motor lag", "motor_lag_s"), ("delay", "delay_s")):
        value, half = (1e3 * shown[key][part] for part in ("value", "interval_95"))
        lines.append(f"  {name:<11} {value:>11.3g} {'+-' + format(half, '.2g'):>10}   ms")
    coherence = min(min(one["coherence"]) for one in shown["responses"].values())
    fitted = (
        f"  {shown['points']} points, lowest coherence {coherence:.2f}, misfit {shown['misfit']:.2f} (1: noise alone)"
    )
    lines += ["", fitted]
    if shown["unknown"]:
        names = ", ".join(shown["unknown"])
        lines.append(f"  hardly known: {names}. Fly a larger peak_deg, for longer, or with lower frequencies")
    return "\n".join(lines)


def _flight(path: Path) -> tuple[dict[str, Any], dict[str, Any], Path]:
    """The run, the flight in it and its telemetry."""
    from scenarios.run_folder import RUN_JSON, load_run
    from sitl.errors import FileError

    wanted = path if path.suffix == ".parquet" else None
    folder = wanted.parent.parent if wanted else (path.parent if path.name == RUN_JSON else path)
    run = load_run(folder)
    files = [(one, folder / one["files"]["parquet"]) for one in run["flights"] if "parquet" in one.get("files", {})]
    if wanted is not None:
        files = [(one, file) for one, file in files if file.name == wanted.name]
    if len(files) == 1:
        return run, *files[0]
    if not files:
        raise FileError(path, "holds no recorded flight", "Give the folder of a run, or one of its flights/*.parquet")
    names = ", ".join(str(file.relative_to(folder)) for _, file in files)
    raise FileError(path, f"holds {len(files)} flights", f"Give one: {names}")
