"""`froude study`: the whole study recomputed, as text, JSON, a page and figures."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

EXIT_OK = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude study`."""
    add = parser.add_argument
    add("--samples", type=int, default=500, metavar="N", help="uncertain models of each Monte Carlo (default: 500)")
    add("--seed", type=int, default=1, metavar="N", help="of every draw and search (default: 1)")
    add("--tune", action="store_true", help="also repeat chapter 7's synthesis and fly it over MAVLink: some minutes")
    add("--out", type=Path, default=Path("logs/study"), metavar="DIR", help="page and figures go here (logs/study)")
    add("--no-figures", action="store_true", help="draw nothing and write no page: numbers alone")
    add("--json", action="store_true", help="print everything for machines")


def run(args: argparse.Namespace, *, seed: int) -> int:
    """Recompute, write, print.

    Args:
        args: the parsed arguments. seed: checked.

    Returns:
        exit status 0.
    """
    from scenarios.progress import spinner
    from scenarios.study.recompute import recompute
    from scenarios.study.text import study_object, study_text
    from sitl.errors import FileError, UsageError

    if not 1 <= args.samples <= 20_000:
        raise UsageError(f"--samples {args.samples}: give 1 to 20000")
    if not args.no_figures:
        try:
            # better now than after minutes of work
            (args.out / "figures").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FileError(args.out, f"cannot be made: {error.strerror}", "Choose another --out") from error
    with spinner() as show:
        study = recompute(samples=args.samples, seed=seed, tune=args.tune, progress=show)
        page = None
        if not args.no_figures:
            from scenarios.run_folder import write_atomically
            from scenarios.study.figures import draw_all, write_figures
            from scenarios.study.page import study_page

            figures = draw_all(study.pairs, samples=args.samples, seed=seed, progress=show)
            write_figures(figures, args.out / "figures")
            page = args.out / "study.html"
            write_atomically(page, study_page(study, figures).encode())
            write_atomically(args.out / "study.json", (json.dumps(study_object(study), indent=2) + "\n").encode())
    if args.json:
        sys.stdout.write(json.dumps(study_object(study), indent=2) + "\n")
    else:
        sys.stdout.write(study_text(study) + "\n")
        if page is not None:
            sys.stdout.write(f"\nPage: {page}\nFigures: {args.out / 'figures'} ({len(figures)}, SVG and PNG)\n")
    return EXIT_OK
