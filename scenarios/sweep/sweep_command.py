"""`froude sweep`: thousands of gain sets judged over uncertain models, resumable; and a look at what came out."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scenarios.sweep.dataset import Dataset
    from scenarios.sweep.engines import Engine
    from scenarios.sweep.plan import Plan

EXIT_OK, EXIT_GATE = 0, 1
NEWEST = "newest"
SMALL_STEPS = 400_000_000
"""Vehicle-steps that are flown in this process while processes of their own would still be starting."""

Tell = Callable[[str], object]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude sweep`."""
    add = parser.add_argument
    add("sweep", nargs="?", metavar="SWEEP.toml", help="axes, design, manoeuvres and limits; or a name, roll_gains")
    add("--out", metavar="DIR", default="logs", help="folder that the sweep's folder is made in (default: logs)")
    add(
        "--resume",
        nargs="?",
        const=NEWEST,
        metavar="DIR",
        help="go on with a sweep that was stopped: its folder, or the newest of SWEEP.toml",
    )
    add("--show", nargs="?", const=NEWEST, metavar="DIR", help="show a sweep: its folder, or the newest")
    add("--jobs", type=int, default=0, metavar="N", help="workers (default: one a core)")
    add("--engine", choices=("auto", "in-process", "processes"), default="auto", help="who works (default: by size)")
    add("--dask", metavar="ADDRESS", help="work on a Dask cluster, tcp://HOST:8786; or local: one made on this machine")
    add("--fly", type=int, default=0, metavar="K", help="fly the best K candidates over MAVLink in every condition")
    add("--px4", metavar="DIR", help="fly them with a real PX4, too: its build directory")
    add("--json", action="store_true", help="for machines")
    add("--gate", action="store_true", help="exit status 1 if no candidate passes everywhere")


def run(args: argparse.Namespace, *, tell: Tell) -> int:
    """Sweep, go on, or show.

    Args:
        args: the parsed arguments. tell: prints a line for people on standard error.

    Returns:
        exit status: 0, or 1 with --gate where nothing passes everywhere.

    Raises:
        UsageError, FileError: before any work: a bad file, folder or number.
        LinkError: a cluster that does not answer.
    """
    from scenarios.sweep.sweep_file import find_sweep
    from sitl.errors import UsageError

    if args.show is not None:
        if args.sweep is not None and args.show == NEWEST and Path(args.sweep).is_dir():
            args.show, args.sweep = args.sweep, None
        _check_fly(args)
        if args.sweep is not None or args.resume is not None:
            raise UsageError("--show looks at what is there: leave out SWEEP.toml and --resume")
        path = _folder(args.show, Path(args.out), "")
        if args.fly:
            _fly(path, args, tell)
        return _show(path, args, tell)
    if args.sweep is None and args.resume is None:
        raise UsageError("give a SWEEP.toml, --resume to go on with a sweep, or --show to look at one")
    if args.sweep is not None:
        args.sweep = str(find_sweep(args.sweep))
    if args.jobs < 0:
        raise UsageError(f"--jobs {args.jobs}: give 1 or more")
    _check_fly(args)
    if args.dask is not None and args.engine != "auto":
        raise UsageError(f"--dask and --engine {args.engine} are two engines: leave out one of them")
    plan, begun = _begin(args)
    for warning in plan.warnings:
        tell(warning)
    dataset = _work(plan, begun, args, tell)
    if args.fly:
        _fly(dataset.path, args, tell)
    return _show(dataset.path, args, tell)


def _begin(args: argparse.Namespace) -> tuple[Plan, Dataset | None]:
    """The plan, and the dataset to go on with; none for a new sweep, whose folder is made when all is ready."""
    from scenarios.sweep.dataset import Dataset
    from scenarios.sweep.plan import make_plan
    from scenarios.sweep.resuming import plan_of
    from scenarios.sweep.sweep_file import load_sweep

    if args.resume is None:
        return make_plan(load_sweep(Path(args.sweep))), None
    name = Path(args.sweep).stem if args.sweep else ""
    dataset = Dataset(_folder(args.resume, Path(args.out), name))
    return plan_of(dataset, Path(args.sweep) if args.sweep else None), dataset


def _new(plan: Plan, args: argparse.Namespace) -> Dataset:
    """A dataset in a folder of its own, even if another sweep starts in the same second."""
    from bridge.clock import utc_stamp
    from scenarios.sweep.dataset import Dataset
    from scenarios.sweep.program import program_facts
    from sitl.errors import FileError

    stamp = utc_stamp()
    for attempt in itertools.count(1):
        path = Path(args.out) / (f"{stamp}_sweep_{plan.sweep.name}" + (f"_{attempt}" if attempt > 1 else ""))
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            if path.is_dir():
                continue
            raise FileError(args.out, "is a file, not a folder", "Choose another folder with --out") from None
        except OSError as error:
            raise FileError(path, f"cannot be made: {error.strerror}", "Choose another folder with --out") from error
        break
    dataset = Dataset(path)
    dataset.create(plan, {"started_utc": stamp, "command": list(args.argv), **program_facts()})
    return dataset


def _folder(named: str, base: Path, name: str) -> Path:
    """The folder of a sweep: as named, or the newest below `base` of that name."""
    from scenarios.sweep.dataset import SWEEP_JSON
    from sitl.errors import FileError

    if named != NEWEST:
        return Path(named)
    found = sorted(path.parent for path in base.glob(f"*_sweep_{name or '*'}/{SWEEP_JSON}"))
    if not found:
        raise FileError(
            base, f"holds no sweep{f' of {name}.toml' if name else ''}", "Start one: froude sweep SWEEP.toml"
        )
    return found[-1]


def _engine(plan: Plan, args: argparse.Namespace) -> Engine:
    from scenarios.sweep.engines import InProcess, Processes

    if args.dask is not None:
        from scenarios.sweep.cluster import Dask

        return Dask(plan, args.dask, args.jobs)
    small = plan.points * plan.steps_per_point < SMALL_STEPS
    if args.engine == "in-process" or (args.engine == "auto" and small):
        return InProcess(plan, args.jobs)
    return Processes(plan, args.jobs)


def _work(plan: Plan, begun: Dataset | None, args: argparse.Namespace, tell: Tell) -> Dataset:
    from scenarios import interrupts
    from scenarios.sweep.sweep_progress import watching
    from scenarios.sweep.sweeping import sweep_points

    with interrupts.caught(), contextlib.ExitStack() as stack:
        if begun is not None:
            stack.enter_context(begun.locked())
        engine = stack.enter_context(_engine(plan, args))
        # a cluster that does not answer leaves no folder behind
        dataset = begun or _new(plan, args)
        if begun is None:
            stack.enter_context(dataset.locked())
        try:
            with watching(plan, engine, tell) as show:
                sweep_points(plan, dataset, engine, show)
        except KeyboardInterrupt:
            tell(f"stopped; what is done is kept. Go on with: froude sweep --resume {dataset.path}")
            raise
    return dataset


def _check_fly(args: argparse.Namespace) -> None:
    from scenarios.px4_process import Px4Process
    from sitl.errors import UsageError

    if args.fly < 0:
        raise UsageError(f"--fly {args.fly}: give 0 or more")
    if args.px4 is not None:
        if not args.fly:
            raise UsageError("--px4 flies the best: say how many with --fly K")
        Px4Process(Path(args.px4), Path(), 0)  # better now than after hours of sweeping


def _fly(path: Path, args: argparse.Namespace, tell: Tell) -> None:
    """Fly the best, and write down where batch and flights differ; what was flown before an interrupt stays."""
    from scenarios import interrupts
    from scenarios.sweep.flying import fly_best

    with interrupts.caught():
        text = fly_best(
            path,
            args.fly,
            source=Path(args.sweep) if args.sweep else None,
            px4=None if args.px4 is None else Path(args.px4),
            jobs=args.jobs,
            command=("froude", *args.argv),
            tell=tell,
        )
    if not args.json:
        _print(text, path)


def _show(path: Path, args: argparse.Namespace, tell: Tell) -> int:
    """The result on standard output, its files in the sweep's folder."""
    from scenarios.sweep.shown_sweep import show_sweep
    from scenarios.table import terminal_width

    width, colour = terminal_width(sys.stdout)
    passing, text = show_sweep(path, as_json=args.json, width=width, colour=colour, tell=tell)
    _print(text, path)
    return EXIT_GATE if args.gate and not passing else EXIT_OK


def _print(text: str, path: Path) -> None:
    """Whoever reads it may go away: what there is to do is done all the same, and the exit status says how it went."""
    from scenarios.standard_streams import show

    if (problem := show(text, f"Look at it again: froude sweep --show {path}")) is not None:
        raise problem
