"""`froude analyse`: margins and a Monte Carlo of gain sets, without a flight."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable

EXIT_OK = 0
DEFAULT_GAINS = ("table_7_2", "table_2_2/ANT-X", "px4_defaults")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude analyse`, those of a vehicle left out (they are shared with other commands)."""
    add = parser.add_argument
    add("--vehicle", metavar="SPEC", default="ant-x", help="airframe, or reference:target (default: ant-x)")
    add("--gains", nargs="+", metavar="NAME|FILE", default=DEFAULT_GAINS, help="gain sets, as for fly")
    add("--limits", default="practical", metavar="NAME", help="limit set that decides what passes (practical)")
    add("--samples", type=int, default=500, metavar="N", help="uncertain models besides the nominal (default: 500)")
    add("--distribution", choices=("gaussian", "uniform"), default="gaussian", help="of the samples")
    add("--spread", type=float, default=3.0, metavar="SIGMA", help="half width of the samples, sigma (default: 3)")
    add("--seed", type=int, default=1, metavar="N", help="of the samples (default: 1)")
    add("--json", action="store_true", help="for machines")


def run(args: argparse.Namespace, *, scaling: tuple[str, ...], seed: int, tell: Callable[[str], object]) -> int:
    """Analyse and print.

    Args:
        args: the parsed arguments. scaling: words of Froude scaling. seed: checked.
        tell: prints a line for people on standard error: warnings about gain sets.

    Returns:
        exit status 0.
    """
    from scenarios.analysis import analyse
    from scenarios.analysis_text import analysis_object, analysis_text
    from scenarios.gain_set import check, load_all
    from scenarios.limits import LIMIT_SETS
    from scenarios.progress import spinner
    from scenarios.roll_set import roll_set
    from sitl.errors import UsageError
    from sitl.keyed_table import nearest
    from sitl.parameters import ParameterTable
    from sitl.profile import get_profile
    from sitl.vehicle import airframe_parameters
    from sitl.vehicle_spec import resolve_vehicle

    if args.limits not in LIMIT_SETS:
        names = ", ".join(LIMIT_SETS)
        raise UsageError(f'unknown limit set "{args.limits}"{nearest(args.limits, LIMIT_SETS)}; sets are {names}')
    if args.samples < 1:
        raise UsageError(f"--samples {args.samples}: give 1 or more")
    model, profile = resolve_vehicle(args.vehicle, scaling), get_profile(args.profile or "sitl")
    table = ParameterTable(airframe_parameters(model, profile))
    sets, warnings = [], []
    for one in load_all(args.gains):
        warnings += [f"{one.name}: {warning}" for warning in check(one, table)]
        sets.append((one, roll_set(model, profile, one.parameters)))
    with spinner() as show:
        show(f"{len(sets)} gain sets x {args.samples} samples")
        analysis = analyse(
            model,
            profile,
            sets,
            limits=args.limits,
            samples=args.samples,
            seed=seed,
            distribution=args.distribution,
            spread_sigma=args.spread,
        )
    for warning in warnings:
        tell(warning)
    text = json.dumps(analysis_object(analysis), indent=2) if args.json else analysis_text(analysis)
    sys.stdout.write(text + "\n")
    return EXIT_OK
