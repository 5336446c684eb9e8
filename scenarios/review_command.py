"""`froude review`: look at a run in the viewer, in a browser, as a picture or a page; list runs; compare them."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scenarios import flight_import

if TYPE_CHECKING:
    from scenarios.run_choice import Choice
    from scenarios.run_reader import StoredRun

EXIT_OK, EXIT_GATE = 0, 1
OUT = Path("logs")
LISTED = 30

Tell = Callable[[str], object]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude review`."""
    add = parser.add_argument
    add(
        "runs",
        nargs="*",
        metavar="RUN|FILE",
        help="a run's folder or a file of it, or its name or a part of that; two or more are compared with the first; "
        "a flight's .ulg or .tlog (default: the newest run)",
    )
    add("--out", type=Path, metavar="DIR", default=OUT, help="where runs are kept (default: logs)")
    add("--flight", metavar="NAME", help="the recording of this gain set instead of the comparison of all")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--web", action="store_true", help="serve it to a browser on 127.0.0.1 until Ctrl-C")
    how.add_argument("--screenshot", type=Path, metavar="FILE", help="draw it into a PNG, without a display")
    how.add_argument("--html", action="store_true", help="print the path of the run's report; written if missing")
    how.add_argument("--list", action="store_true", help="list the runs, the newest first")
    add("--port", type=int, metavar="N", help="of --web (default: 9090; 0: any that is free)")
    add("--page", metavar="NAME", help="page that --screenshot draws (default: the first)")
    add("--open", action="store_true", help="with --html: open it in a browser also where nobody looks at a terminal")
    add("--last", type=int, metavar="N", help=f"with --list: so many runs (default: {LISTED}; with --json all)")
    add("--gate", action="store_true", help="comparing: exit status 1 if a gain set got worse")
    add("--json", action="store_true", help="with --list, or comparing: for machines")
    flight_import.add_arguments(parser)


def run(args: argparse.Namespace, *, tell: Tell) -> int:
    """Do what was asked for.

    Args:
        args: the parsed arguments. tell: prints a line for people on standard error.

    Returns:
        exit status: 0 done, 1 with `--gate` a regression, 2 a run that cannot be found, read or shown.
    """
    from scenarios.run_choice import choose, newest_choice

    _check(args)
    if args.list:
        return _list(args)
    if any(flight_import.is_recording(Path(word)) for word in args.runs):
        return flight_import.import_command(args, tell=tell)
    choices = [choose(word, args.out) for word in args.runs] or [newest_choice(args.out)]
    if len(choices) > 1:
        return _compare(choices, args)
    return _look(choices[0], args, tell)


def _check(args: argparse.Namespace) -> None:
    """Options that would be passed over are a mistake, and told."""
    from sitl.errors import UsageError

    several = len(args.runs) > 1
    imported = any(flight_import.is_recording(Path(word)) for word in args.runs)
    for option, given, fits, what in (
        ("--port", args.port is not None, args.web, "goes with --web"),
        ("--page", args.page is not None, args.screenshot is not None, "goes with --screenshot FILE"),
        ("--open", args.open, args.html, "goes with --html"),
        ("--last", args.last is not None, args.list, "goes with --list"),
        ("--gate", args.gate, (several or imported) and not args.list, "compares: give two runs or more"),
        ("--vehicle", args.vehicle is not None, imported, "goes with a .ulg or .tlog"),
        ("--limits", args.limits is not None, imported, "goes with a .ulg or .tlog"),
        ("--profile", args.profile is not None, imported, "goes with a .ulg or .tlog"),
        ("--scaling", args.scaling is not None, imported, "goes with a .ulg or .tlog"),
        ("--system", args.system is not None, imported, "goes with a .tlog"),
        ("--json", args.json, args.list or several or imported, "goes with --list, or two runs or more"),
        ("--flight", args.flight is not None, not (args.list or args.html), "shows a recording"),
    ):
        if given and not fits:
            raise UsageError(f"froude review {option}: {what}")
    if several and not (imported or args.list) and (args.web or args.html or args.screenshot or args.flight):
        raise UsageError(
            f"froude review: {len(args.runs)} runs are compared as a table; give one to look at it with --web, "
            "--screenshot, --html or --flight"
        )
    if args.port is not None and not 0 <= args.port <= 65535:
        raise UsageError(f"--port {args.port}: give 0 to 65535")
    if args.last is not None and args.last < 1:
        raise UsageError(f"--last {args.last}: give 1 or more")


def _list(args: argparse.Namespace) -> int:
    from scenarios.run_list import run_folders, summary
    from scenarios.run_text import list_object, list_text
    from sitl.errors import UsageError

    parts = [word.casefold() for word in args.runs]
    folders = [folder for folder in run_folders(args.out) if all(part in folder.name.casefold() for part in parts)]
    last = args.last or (None if args.json else LISTED)
    if not folders and not args.json:
        named = f" with {' and '.join(map(repr, args.runs))} in the name" if parts else ""
        raise UsageError(f"there is no run{named} in {args.out}. `froude fly` makes one; --out DIR looks elsewhere")
    runs = [summary(folder) for folder in folders[:last]]
    if args.json:
        _print(json.dumps(list_object(args.out, runs), indent=2))
    else:
        _print(list_text(args.out, runs, len(folders) - len(runs)))
    return EXIT_OK


def _compare(choices: Sequence[Choice], args: argparse.Namespace) -> int:
    from scenarios.run_comparison import compare
    from scenarios.run_comparison_text import comparison_object, comparison_text
    from scenarios.run_reader import read_run
    from scenarios.table import terminal_width
    from sitl.errors import UsageError

    first, *others = (read_run(choice.folder) for choice in choices)
    changes = [compare(first, other) for other in others]
    for change in changes:
        if not change.compared:
            old, new = ([one.name for one in run.flights] for run in (change.old, change.new))
            raise UsageError(
                f"{change.old.name} and {change.new.name} have no gain set in common: {', '.join(old) or 'none'}; "
                f"{', '.join(new) or 'none'}. Fly one of them again, or compare others"
            )
    if args.json:
        _print(json.dumps(comparison_object(changes), indent=2, allow_nan=False))
    else:
        width, colour = terminal_width(sys.stdout)
        _print(comparison_text(changes, width=width, colour=colour).rstrip("\n"))
    return EXIT_GATE if args.gate and any(change.regressions for change in changes) else EXIT_OK


def _look(choice: Choice, args: argparse.Namespace, tell: Tell) -> int:
    from scenarios.run_reader import read_run
    from scenarios.run_text import printable

    stored = read_run(choice.folder)
    for problem in stored.problems:
        tell(printable(f"{stored.name}: {problem}"))
    if args.html:
        return _report(stored, args)
    recording = _recording(stored, args.flight or choice.slug, tell)
    from scenarios.recorder.recording_end import whole_recording

    with whole_recording(recording, keep=not (args.web or args.screenshot)) as whole:
        if args.screenshot is not None:
            return _draw(whole, args, tell)
        if args.web:
            return _serve([whole], args, tell)
        from scenarios.recorder import cursor
        from scenarios.recorder.viewer import open_viewer

        open_viewer([whole])
        _print(f"Opened {recording}")
        with contextlib.suppress(KeyboardInterrupt):  # whoever does not want to wait for that has what was asked for
            cursor.put_when_loaded(whole)
    return EXIT_OK


def _recording(stored: StoredRun, flight: str, tell: Tell) -> Path:
    """What there is to be looked at: the comparison, one flight, or what a killed run has left."""
    from sitl.errors import FileError

    if flight:
        chosen = stored.flight(flight)
        if chosen.recording is None:
            problem = f"flight {chosen.name} has no recording"
            raise FileError(stored.folder, problem, "Its telemetry and log, if any, are in flights/")
        return chosen.recording
    if stored.compare is not None:
        return stored.compare
    left = [one for one in stored.everything if one.recording is not None]
    if not left:
        problem = "there is nothing to look at: neither compare.rrd nor a flight's recording is there"
        raise FileError(stored.folder, problem, "`froude fly` makes a new run")
    # of a killed run, what was in the air
    shown = next((one for one in left if not one.finished), left[-1])
    names = ", ".join(one.slug for one in left)
    tell(f"{stored.name}: no comparison, so the flight {shown.slug} is shown; with --flight any of {names}")
    assert shown.recording is not None
    return shown.recording


def _draw(recording: Path, args: argparse.Namespace, tell: Tell) -> int:
    from scenarios.recorder.screenshot import screenshot

    for report in screenshot(recording, args.screenshot, tab=args.page):
        tell(f"the viewer says: {report}")
    _print(str(args.screenshot))
    return EXIT_OK


def _serve(recordings: Sequence[Path], args: argparse.Namespace, tell: Tell) -> int:
    from scenarios.recorder.web_viewer import PORT, WebViewer, viewer_page

    with WebViewer(recordings, PORT if args.port is None else args.port) as viewer:
        viewer.page = viewer_page()
        _print(viewer.url)
        tell("open this address in a browser of this machine; Ctrl-C stops it")
        with contextlib.suppress(KeyboardInterrupt):
            viewer.serve()
    return EXIT_OK


def _report(stored: StoredRun, args: argparse.Namespace) -> int:
    import webbrowser

    from scenarios.recorder.viewer import has_display
    from scenarios.report import write_report
    from sitl.errors import UsageError

    path = stored.report
    if not path.is_file():
        path = write_report(stored.folder)
    _print(str(path))
    looked_at = sys.stdout is not None and sys.stdout.isatty() and has_display()
    if (args.open or looked_at) and not webbrowser.open(path.resolve().as_uri()) and args.open:
        raise UsageError(f"no browser is found to open {path} in. Open it yourself")
    return EXIT_OK


def _print(text: str) -> None:
    if sys.stdout is not None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
