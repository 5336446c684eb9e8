"""`froude tune`: gains by structured H-infinity synthesis, for one vehicle or several at once."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shlex
import sys
from pathlib import Path

EXIT_OK, EXIT_GATE = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude tune`, those of a vehicle left out (they are shared with other commands)."""
    add = parser.add_argument
    add("spec", nargs="+", help="airframe, or reference:target; several: one gain set that flies them all")
    add("--samples", type=int, default=500, metavar="N", help="uncertain models besides the nominal (default: 500)")
    add("--distribution", choices=("gaussian", "uniform"), default="gaussian", help="of the samples, within 3 sigma")
    add("--seed", type=int, default=1, metavar="N", help="of samples and search (default: 1)")
    add("--settling", type=float, metavar="S", help="required settling time to 5 %%, s")
    add("--overshoot", type=float, metavar="PCT", help="required overshoot, %%")
    add("--delay-margin", type=float, metavar="MS", help="required delay margin, ms")
    add("--out", type=Path, metavar="FILE", help="the gain set's .toml; a .params is written beside it")
    add("--gate", action="store_true", help="exit status 1 unless every requirement is met")
    add("--json", action="store_true", help="print everything for machines")


def run(args: argparse.Namespace, *, scaling: tuple[str, ...], seed: int) -> int:
    """Tune, write both files, print the result.

    Args:
        args: the parsed arguments. scaling: words of Froude scaling. seed: checked.

    Returns:
        exit status: 0, or 1 with --gate if something is not met.
    """
    from scenarios.progress import spinner
    from scenarios.tuning.requirements import requirements_for
    from scenarios.tuning.tuned_set import check_place, default_path, tuning_object, tuning_text, write_tuning
    from scenarios.tuning.tuning import tune
    from sitl.profile import get_profile
    from sitl.vehicle_spec import resolve_vehicle

    if args.out is not None:
        check_place(args.out)
    profile = get_profile(args.profile or "sitl")
    changes = {
        "settling_time_s": args.settling,
        "overshoot_pct": args.overshoot,
        "delay_margin_s": None if args.delay_margin is None else args.delay_margin / 1e3,
    }
    wanted = {name: value for name, value in changes.items() if value is not None}
    required = dataclasses.replace(requirements_for(profile.name), **wanted)
    models = [resolve_vehicle(spec, scaling) for spec in args.spec]
    with spinner() as show:
        tuning = tune(
            models,
            profile,
            requirements=required,
            samples=args.samples,
            seed=seed,
            distribution=args.distribution,
            progress=show,
        )
    toml, params = write_tuning(tuning, args.out or default_path(tuning))
    if args.json:
        files = {"gain_set": str(toml), "params": str(params)}
        sys.stdout.write(json.dumps(tuning_object(tuning) | {"files": files}, indent=2) + "\n")
    else:
        sys.stdout.write(tuning_text(tuning) + "\n\n")
        sys.stdout.write(f"Written: {toml} and, for QGroundControl, {params}\n")
        words = ["froude", "fly", "--vehicle", _target(args.spec[0]), "--gains", str(toml)]
        words += ["--profile", profile.name] if args.profile else []
        sys.stdout.write(f"Fly it: {shlex.join(words)}\n")
    return EXIT_GATE if args.gate and not tuning.met else EXIT_OK


def _target(spec: str) -> str:
    """The true airframe of a spec: what a set made on a scaled model is flown on."""
    return spec if Path(spec).is_file() else spec.rpartition(":")[2].strip()
