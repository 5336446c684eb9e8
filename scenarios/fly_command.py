"""`froude fly`: upload gain sets, fly manoeuvres, say which sets pass."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.flight import RunRecord
    from scenarios.runner import Progress, RunResult
    from scenarios.scenario import Scenario

EXIT_OK, EXIT_GATE, EXIT_LINK, EXIT_INTERRUPTED = 0, 1, 3, 130

Tell = Callable[..., int]
"""Prints a line for people on standard error; with a status, returns it."""


def names_in(folder: str) -> list[str]:
    """Names of the .toml files in a folder of this package.

    Args:
        folder: beside this file.
    """
    return sorted(path.stem for path in (Path(__file__).parent / folder).glob("*.toml"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude fly`, those of a vehicle left out (they are shared with other commands)."""
    add = parser.add_argument
    library = ", ".join(names_in("library"))
    add("scenario", nargs="?", default="demo", help=f"a .toml file, or one of {library} (default: demo)")
    add("--vehicle", metavar="SPEC", help="airframe, or reference:target")
    add(
        "--gains",
        nargs="+",
        metavar="NAME|FILE",
        help=f"a .toml or .params file, or {', '.join(names_in('gain_sets'))}; one set of a file as table_2_2/ANT-X",
    )
    add("--connect", metavar="URL", help="fly this vehicle, such as udpin://127.0.0.1:14540")
    add("--hil", metavar="URL", help="fly the plant with a real PX4 that connects here: tcpin://127.0.0.1:4560")
    add("--px4", type=Path, metavar="DIR", help="start this PX4 build for every flight and fly the plant with it")
    add("--no-twin", action="store_true", help="with --hil, --px4: do not fly the same with our own autopilot")
    add("--arm-hardware", action="store_true", help="allow arming on a serial link: propellers may turn")
    add("--seed", type=int, metavar="N", help="of sensor noise")
    add("--jobs", type=int, default=1, metavar="N", help="flights at a time (default: 1)")
    add("--live", action="store_true", help="watch the flight: opens the viewer, without a display serves 127.0.0.1")
    add("--out", type=Path, default=Path("logs"), metavar="DIR", help="where run folders go (logs)")
    add("--json", action="store_true", help="print run.json instead of the table")
    add("--junit", type=Path, metavar="FILE", help="also write JUnit XML here")
    add("--markdown", type=Path, metavar="FILE", help="also write a short Markdown summary here, for a build's page")
    add("--gate", action="store_true", help="exit status 1 unless every set passes")


def _scenario(args: argparse.Namespace, scaling: tuple[str, ...] | None, seed: int | None) -> Scenario:
    from scenarios.scenario import load_scenario

    scenario = load_scenario(args.scenario)
    changes: dict[str, Any] = {}
    if args.vehicle:
        changes["vehicle"] = args.vehicle
    if scaling is not None:
        changes["scaling"] = scaling
    if args.profile:
        changes["profile"] = args.profile
    if args.gains:
        changes["gain_sets"] = tuple(args.gains)
    if seed is not None:
        changes["seed"] = seed
    return dataclasses.replace(scenario, **changes)


def run(args: argparse.Namespace, *, scaling: tuple[str, ...] | None, seed: int | None, tell: Tell) -> int:
    """Fly and print the result.

    Args:
        args: the parsed arguments. scaling: words of Froude scaling; None leaves the scenario's.
        seed: checked; None leaves the scenario's. tell: see `Tell`.

    Returns:
        exit status.
    """
    from bridge import exposure
    from scenarios import interrupts
    from scenarios.one_flight import MEMORY
    from scenarios.progress import RunWatch
    from scenarios.runner import RunOptions, run_scenario

    for option, path in (("--junit", args.junit), ("--markdown", args.markdown)):
        _check_place(option, path)
    scenario = _scenario(args, scaling, seed)
    options = RunOptions(
        out=args.out,
        connect=args.connect or MEMORY,
        arm_hardware=args.arm_hardware,
        jobs=args.jobs,
        live_port=_live_port() if args.live else None,
        live_window=args.live and _has_viewer(),
        command=("froude", *args.argv),
        hil=args.hil or "",
        px4=args.px4,
        say=tell,
        twin=not args.no_twin,
    )
    # Rerun's own log lines come from other threads, right through the table; what they say we find out ourselves.
    os.environ.setdefault("RUST_LOG", "off")

    def begin() -> None:
        for line in exposure.warnings(filter(None, (args.connect, args.hil)), exposure.FIRST):
            tell(line)
        if options.live_port is not None:
            opened = "opening the viewer; one more" if options.live_window else "look on with"
            tell(f"live view: {opened}: rerun --connect rerun+http://127.0.0.1:{options.live_port}/proxy")
        _tell_of_compiling(tell)

    watch = RunWatch(begin)

    def stopping() -> None:
        if args.connect and watch.touched:
            tell("stopping: the vehicle lands and gets its parameters back; Ctrl-C again leaves it as it is")

    with interrupts.caught(stopping):
        with _progress_bar() as watch.show:
            result = run_scenario(scenario, options, watch)
        return _report(args, result, tell)


def _check_place(option: str, path: Path | None) -> None:
    """Better now than after an hour of flying."""
    from sitl.errors import FileError

    if path is not None and not path.parent.is_dir():
        raise FileError(path, "its folder does not exist", f"Make the folder, or write {option} to another place")


def _report(args: argparse.Namespace, result: RunResult, tell: Tell) -> int:
    """Print the result; the exit status that it means."""
    from scenarios.limits import Outcome
    from scenarios.run_folder import RunFolder, run_object
    from scenarios.standard_streams import show
    from scenarios.table import run_text, terminal_width
    from sitl.errors import FroudeError

    run, folder = result.run, result.folder
    if args.json:
        shown = run_object(run, RunFolder(folder) if folder else None, ("froude", *args.argv))
        text = json.dumps(shown, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    else:
        width, colour = terminal_width(sys.stdout)
        text = run_text(run, folder, width=width, colour=colour)
    unread = show(text, "The result is in run.json")
    stopped = result.stopped or unread
    for write, path in ((_write_junit, args.junit), (_write_markdown, args.markdown)):
        try:
            if path is not None:
                write(run, path)
        except FroudeError as error:
            stopped = stopped or error
    if stopped is not None:
        what, status = "interrupted", EXIT_INTERRUPTED
        if not isinstance(stopped, KeyboardInterrupt):
            what, status = str(stopped), getattr(stopped, "exit_status", EXIT_LINK)
        kept = f"What was flown is in {folder}" if folder is not None else ""
        return tell(". ".join(part for part in (what, result.owed, kept) if part), status)
    if args.gate and any(flight.outcome is not Outcome.PASS for flight in run.flights):
        return EXIT_GATE
    return EXIT_OK


def _write_junit(run: RunRecord, path: Path) -> None:
    from scenarios.junit import write_junit

    write_junit(run, path)


def _write_markdown(run: RunRecord, path: Path) -> None:
    from scenarios.job_summary import write_job_summary

    write_job_summary(run, path)


def _live_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _has_viewer() -> bool:
    from scenarios.recorder.viewer import has_display

    return has_display()


def _progress_bar() -> AbstractContextManager[Callable[[Progress], object]]:
    """A bar on a terminal, nothing elsewhere."""
    if sys.stderr is None or not sys.stderr.isatty():
        return nullcontext(lambda _: None)
    from scenarios.progress import progress_bar

    return progress_bar()


def _tell_of_compiling(tell: Tell) -> None:
    """The first flight of a version takes longer: say so before it."""
    from sitl.compiled import is_warm

    if not is_warm():
        tell("compiling the control laws, once; up to half a minute ...")
