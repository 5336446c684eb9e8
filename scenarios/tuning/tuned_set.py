"""Tuned gains as files and as text: a gain set for `froude fly`, a parameter file for QGroundControl, a report."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import Any

from scenarios.gain_set import GainSet, save_params
from scenarios.run_folder import plain, write_atomically
from scenarios.table import number
from scenarios.toml_file import quoted
from scenarios.tuning.tuning import Found, Tuning
from sitl.errors import FileError, UsageError
from sitl.sampled_loop import RollGains

SCHEMA_VERSION = 1


def parameters_of(gains: RollGains) -> dict[str, float | int]:
    """The roll gains by PX4's names.

    Args:
        gains: of the roll axis.
    """
    return {
        "MC_ROLL_P": gains.k_phi,
        "MC_ROLLRATE_K": gains.k,
        "MC_ROLLRATE_P": gains.kp,
        "MC_ROLLRATE_I": gains.ki,
        "MC_ROLLRATE_D": gains.kd,
        "MC_ROLLRATE_FF": gains.kff,
    }


def gain_set_of(tuning: Tuning) -> GainSet:
    """The result as a gain set, with where it comes from.

    Args:
        tuning: the result.
    """
    who = " + ".join(tuning.vehicles)
    scaled = f", scaling {', '.join(tuning.scaling)}" if tuning.scaling else ""
    source = (
        f"froude tune: structured H-infinity on {who}{scaled}, profile {tuning.profile.name}, "
        f"{tuning.samples} samples, seed {tuning.seed}"
    )
    return GainSet(f"tuned {who} {tuning.profile.name}", parameters_of(tuning.gains), source, _note(tuning))


def _note(tuning: Tuning) -> str:
    said = [_line(found) for found in tuning.found]
    if tuning.certificates:
        worst = max(max(certificate.norms) for certificate in tuning.certificates)
        said.append(f"largest certified weighted norm {worst:.3f}")
    said += [f"NOT MET: {text}" for text in tuning.unmet]
    return "; ".join(said)


def _line(found: Found) -> str:
    models = found.samples - found.cannot_hold
    return (
        f"{found.vehicle}, worst of {models} models: settles {number(found.settling_s[0])} s, overshoot "
        f"{number(found.overshoot_pct[0], 1)} %, delay margin {number(1e3 * found.delay_margin_s, 1)} ms"
    )


def check_place(path: Path) -> None:
    """Whether a result can be written, better known before a long search than after it.

    Args:
        path: of the .toml.

    Raises:
        UsageError: another ending. FileError: a folder has that name, or a file or a lock is in the way.
    """
    if path.suffix != ".toml":
        raise UsageError(f"--out {path}: the gain set is a .toml file; give it that ending")
    if path.is_dir():
        raise FileError(path, "is a folder", "Give the name of a file")
    there = next(folder for folder in path.absolute().parents if folder.exists())
    if not there.is_dir():
        raise FileError(path, f"{there} is a file, not a folder", "Choose another place")
    if not os.access(there, os.W_OK | os.X_OK):
        raise FileError(path, f"nothing may be written into {there}", "Choose another place")


def write_tuning(tuning: Tuning, path: Path) -> tuple[Path, Path]:
    """Write the gain set and, beside it, QGroundControl's file.

    Args:
        tuning: the result. path: of the .toml; the .params has the same name.

    Returns:
        both paths.

    Raises:
        FileError: a folder is missing or cannot be written to.
    """
    gain_set = gain_set_of(tuning)
    lines = ["# Written by froude tune. Weights and requirements that these gains were made with:"]
    lines += [f"#   {weight}   on {weight.channel}" for weight in tuning.synthesis.weights]
    required = dataclasses.asdict(tuning.requirements)
    lines += [f"#   {name} = {value:g}" for name, value in required.items()]
    lines += ["", "[[gain_set]]"]
    lines += [f"{key} = {quoted(getattr(gain_set, key))}" for key in ("name", "source", "note")]
    lines += ["[gain_set.parameters]", *(f"{name} = {value!r}" for name, value in gain_set.parameters.items()), ""]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(path, f"its folder cannot be made: {error.strerror}", "Choose another place") from error
    write_atomically(path, "\n".join(lines).encode())
    params = path.with_suffix(".params")
    save_params(params, gain_set.parameters)
    return path, params


def default_path(tuning: Tuning) -> Path:
    """Where a result goes if nothing is said: in the folder one is in.

    Args:
        tuning: the result.
    """
    return Path(f"{gain_set_of(tuning).slug}.toml")


def tuning_object(tuning: Tuning) -> dict[str, Any]:
    """The result as plain data.

    Args:
        tuning: the result.
    """
    synthesis = tuning.synthesis
    shown = {
        "schema_version": SCHEMA_VERSION,
        "vehicles": tuning.vehicles,
        "scaling": tuning.scaling,
        "profile": tuning.profile.name,
        "seed": tuning.seed,
        "samples": tuning.samples,
        "distribution": tuning.distribution,
        "requirements": dataclasses.asdict(tuning.requirements),
        "met": tuning.met,
        "unmet": tuning.unmet,
        "parameters": parameters_of(tuning.gains),
        "weights": [
            {"name": w.name, "channel": w.channel, "numerator": [w.a, w.b], "denominator": [w.c, w.d]}
            for w in synthesis.weights
        ],
        "norms_on_grid": {"S": synthesis.norms.s[0], "Q": synthesis.norms.q[0], "F": synthesis.norms.f[0]},
        "certificates": [dataclasses.asdict(one) for one in tuning.certificates],
        "found": [dataclasses.asdict(one) for one in tuning.found],
        "trade_off": [dataclasses.asdict(one) for one in tuning.trade_off],
        "limits": tuning.limits,
        "search": {
            "rounds": synthesis.rounds,
            "design_models": synthesis.design_models,
            "evaluations": synthesis.evaluations,
        },
    }
    made: dict[str, Any] = plain(shown)
    return made


def tuning_text(tuning: Tuning) -> str:
    """The result for people.

    Args:
        tuning: the result.
    """
    g, need = tuning.gains, tuning.requirements
    lines = [
        f"{gain_set_of(tuning).name}: {'all requirements met' if tuning.met else 'NOT all requirements met'}",
        "",
        f"  MC_ROLL_P {g.k_phi:.5g}   MC_ROLLRATE_P {g.kp:.5g}   MC_ROLLRATE_I {g.ki:.5g}   MC_ROLLRATE_D {g.kd:.3g}",
        "",
        f"  required of every sample: settling (5 %) {need.settling_time_s:g} s, overshoot {need.overshoot_pct:g} %, "
        f"delay margin {1e3 * need.delay_margin_s:g} ms",
        "",
        "  vehicle              models   settling s     overshoot %    delay ms  phase deg  gain dB       meets",
        "                               worst median    worst median     worst     worst    low   high",
    ]
    for f in tuning.found:
        lines.append(
            f"  {f.vehicle:<20} {f.samples:>6} {number(f.settling_s[0], 3):>7} {number(f.settling_s[1], 3):>6} "
            f"{number(f.overshoot_pct[0]):>8} {number(f.overshoot_pct[1]):>6} "
            f"{number(1e3 * f.delay_margin_s, 1):>9} {number(f.phase_margin_deg, 1):>9} "
            f"{number(f.gain_margin_low_db, 1):>6} {number(f.gain_margin_high_db, 1):>6} {100 * f.meets:>7.1f} %"
        )
    lines += ["", "  weights"]
    lines += [f"    {weight}   on {weight.channel}" for weight in tuning.synthesis.weights]
    for c in tuning.certificates:
        s, q, f_ = c.norms
        lines.append(
            f"  certificate {c.vehicle}: |W1 S| {s:.3f}, |W2 Q| {q:.3f}, |W3 F| {f_:.3f} over {c.models} models, "
            f"no grid; largest closed-loop eigenvalue of {c.samples} models {c.spectral_radius:.6f}"
        )
    if any(not found.sure for found in tuning.found):
        lines.append("  An airframe states no uncertainty: its nominal model alone was looked at.")
    if tuning.unmet:
        lines += ["", *(f"  not met: {text}" for text in tuning.unmet)]
        lines += [f"  {tuning.limits}"] if tuning.limits else []
    if tuning.trade_off:
        lines += ["", "  what can be had (worst sample):   settling s   overshoot %   delay margin ms"]
        for point in tuning.trade_off:
            settling = "never" if math.isinf(point.settling_s) else number(point.settling_s, 3)
            lines.append(
                f"    {settling:>39} {number(point.overshoot_pct):>13} {number(1e3 * point.delay_margin_s, 1):>17}"
            )
    return "\n".join(lines)
