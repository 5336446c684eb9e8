"""The command line. Everything heavy is imported by the command that needs it: `froude --help` answers at once."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from scenarios import (
    analyse_command,
    fly_command,
    hil_command,
    restore_command,
    review_command,
    sitl_command,
    standard_streams,
)
from scenarios.identification import identify_command
from scenarios.study import study_command
from scenarios.sweep import sweep_command
from scenarios.tuning import tune_command

EXIT_OK, EXIT_GATE, EXIT_USAGE, EXIT_LINK, EXIT_INTERRUPTED = 0, 1, 2, 3, 130

_PROFILES = ("study", "sitl", "board")
_SCALINGS = "derivatives, uncertainty or uncertainty-grow, gain; joined by commas"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_USAGE, f"{self.prog}: {message}\nTry '{self.prog} --help'.\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="froude",
        description="Fly candidate autopilot gains on identified or Froude-scaled multirotors, over MAVLink.",
        epilog="example: froude fly --vehicle ant-r:ant-x --gains table_7_2",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)

    def add(name: str, run: Callable[[argparse.Namespace], int], text: str, example: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text, epilog=f"example: {example}")
        sub.set_defaults(run=run)
        return sub

    sub = add("airframes", _airframes, "List the airframes that come with the program.", "froude airframes")
    sub.add_argument("--json", action="store_true", help="for machines")

    sub = add("model", _model, "Show a vehicle's model: derivatives, modes, margins.", "froude model ant-r:ant-x")
    sub.add_argument("spec", help="airframe, or reference:target; names or paths of .toml files")
    _vehicle_options(sub)
    sub.add_argument("--json", action="store_true", help="for machines")

    sub = add(
        "fly",
        _fly,
        "Upload gain sets, fly manoeuvres, say which sets pass.",
        "froude fly --vehicle ant-x --gains table_7_2 table_2_2/ANT-X",
    )
    fly_command.add_arguments(sub)
    _vehicle_options(sub)

    sub = add("sitl", _sitl, "Serve simulated vehicles to any ground station.", "froude sitl ant-x ant-r --speed 2")
    sitl_command.add_arguments(sub)
    _vehicle_options(sub)

    sub = add(
        "hil",
        _hil,
        "The plant for a real autopilot: a PX4 SITL in lockstep, or a board on a serial port.",
        "froude hil ant-x --check",
    )
    hil_command.add_arguments(sub)
    _vehicle_options(sub)

    sub = add(
        "review",
        _review,
        "Look at a run: in the viewer, a browser, a picture or a report. List runs; compare two or more.",
        "froude review --web",
    )
    review_command.add_arguments(sub)
    _vehicle_options(sub)

    sub = add(
        "restore",
        _restore,
        "Give vehicles their own parameters back that a flight which ended badly has left changed. Arms nothing.",
        "froude restore --connect serial:///dev/ttyACM0:57600",
    )
    restore_command.add_arguments(sub)

    sub = add(
        "analyse",
        _analyse,
        "Margins and a Monte Carlo of gain sets over an uncertain model, without a flight.",
        "froude analyse --vehicle ant-x --gains table_7_2 table_2_2/ANT-X",
    )
    analyse_command.add_arguments(sub)
    _vehicle_options(sub)

    sub = add(
        "sweep",
        _sweep,
        "Judge thousands of gain sets over uncertain models, on one machine or a cluster; resumable.",
        "froude sweep my_sweep.toml --fly 5",
    )
    sweep_command.add_arguments(sub)

    sub = add(
        "tune",
        _tune,
        "Make gains by structured H-infinity synthesis, for one vehicle or several at once.",
        "froude tune ant-r:ant-x --scaling uncertainty,gain",
    )
    tune_command.add_arguments(sub)
    _vehicle_options(sub)

    sub = add(
        "identify",
        identify_command.run,
        "Make an airframe file from a flown multisine, with intervals.",
        "froude identify logs/20261123T081638Z_identify_ANT-X",
    )
    identify_command.add_arguments(sub)

    sub = add("study", _study, "Recompute the study: every table, figure and conclusion.", "froude study --tune")
    study_command.add_arguments(sub)
    return parser


def _vehicle_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scaling", metavar="WORDS", help=f"what Froude scaling applies to: {_SCALINGS}")
    parser.add_argument("--profile", choices=_PROFILES, help="fidelity profile (default: sitl)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments without the program's name; the process's own if None.

    Returns:
        exit status: 0 done, 1 gate, 2 usage or a bad file, 3 link or vehicle, 130 interrupted.
    """
    from sitl.errors import FroudeError

    if argv is None:
        standard_streams.reopen()
    parser = _parser()
    args = parser.parse_args(argv)
    args.argv = list(sys.argv[1:] if argv is None else argv)
    if args.version:
        from importlib.metadata import version

        print(f"froude {version('froude')}")
        return EXIT_OK
    if args.command is None:
        parser.print_help()
        return EXIT_USAGE
    try:
        status: int = args.run(args)
        if sys.stdout is not None:
            sys.stdout.flush()
        return status
    except FroudeError as error:
        return _tell(str(error), error.exit_status)
    except KeyboardInterrupt:
        return _tell("interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # the reader of our output went away (froude model ... | head): nothing is wrong, and nothing can be told
        standard_streams.mute_stdout()
        return EXIT_OK
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _tell(f"{where}{error.strerror or error}. Check the path, permissions and free space", EXIT_USAGE)


def _tell(text: str, status: int = EXIT_OK) -> int:
    # None: closed by whoever started us, and print would write to stdout instead. A terminal that has gone away (its
    # SIGHUP is what we may be telling about) must not end a landing.
    if sys.stderr is not None:
        with contextlib.suppress(OSError):
            print(f"froude: {text}", file=sys.stderr, flush=True)
    return status


def _words(text: str | None, default: tuple[str, ...]) -> tuple[str, ...]:
    return default if text is None else tuple(word.strip() for word in text.split(",") if word.strip())


def _airframes(args: argparse.Namespace) -> int:
    from sitl.airframe import list_airframes, load_airframe

    frames = [load_airframe(name) for name in list_airframes()]
    if args.json:
        print(json.dumps([{**dataclasses.asdict(f), "path": str(f.path)} for f in frames], indent=2))
        return EXIT_OK
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False)
    for title, justify in (("airframe", "left"), ("layout", "left"), ("rotors", "right"), ("mass kg", "right"),
                           ("diagonal m", "right"), ("Ld rad/s^2", "right"), ("motor lag s*", "right")):  # fmt: skip
        table.add_column(title, justify=justify)  # type: ignore[arg-type]
    for f in frames:
        table.add_row(f.name, f.layout, str(len(f.rotors)), f"{f.mass_kg:g}", f"{f.diagonal_m:g}",
                      f"{f.derivatives.Ld:g}", f"{f.assumptions.motor_lag_s:g}")  # fmt: skip
    Console().print(table)
    print("* assumed, not measured. `froude model NAME` shows the rest; any path of a .toml works as a name.")
    return EXIT_OK


def _model(args: argparse.Namespace) -> int:
    from scenarios.model_page import model_object, model_text
    from sitl.profile import get_profile
    from sitl.vehicle_spec import DEFAULT_SCALING, resolve_vehicle

    model = resolve_vehicle(args.spec, _words(args.scaling, DEFAULT_SCALING))
    shown = model_object(model, get_profile(args.profile or "sitl"))
    print(json.dumps(shown, indent=2) if args.json else model_text(shown))
    return EXIT_OK


def _seed(args: argparse.Namespace) -> int:
    from sitl.errors import UsageError

    if args.seed < 0:
        raise UsageError(f"--seed {args.seed}: give 0 or more")
    return int(args.seed)


def _fly(args: argparse.Namespace) -> int:
    scaling = None if args.scaling is None else _words(args.scaling, ())
    return fly_command.run(args, scaling=scaling, seed=None if args.seed is None else _seed(args), tell=_tell)


def _sitl(args: argparse.Namespace) -> int:
    from sitl.vehicle_spec import DEFAULT_SCALING

    return sitl_command.run(args, scaling=_words(args.scaling, DEFAULT_SCALING), seed=_seed(args), tell=_tell)


def _hil(args: argparse.Namespace) -> int:
    from sitl.vehicle_spec import DEFAULT_SCALING

    return hil_command.run(args, scaling=_words(args.scaling, DEFAULT_SCALING), seed=_seed(args), tell=_tell)


def _review(args: argparse.Namespace) -> int:
    return review_command.run(args, tell=_tell)


def _restore(args: argparse.Namespace) -> int:
    return restore_command.run(args, tell=_tell)


def _analyse(args: argparse.Namespace) -> int:
    from sitl.vehicle_spec import DEFAULT_SCALING

    return analyse_command.run(args, scaling=_words(args.scaling, DEFAULT_SCALING), seed=_seed(args), tell=_tell)


def _sweep(args: argparse.Namespace) -> int:
    return sweep_command.run(args, tell=_tell)


def _tune(args: argparse.Namespace) -> int:
    from sitl.vehicle_spec import DEFAULT_SCALING

    return tune_command.run(args, scaling=_words(args.scaling, DEFAULT_SCALING), seed=_seed(args))


def _study(args: argparse.Namespace) -> int:
    return study_command.run(args, seed=_seed(args))


if __name__ == "__main__":
    sys.exit(main())
