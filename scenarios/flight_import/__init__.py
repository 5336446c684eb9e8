"""Recorded flights, PX4's ULog or a .tlog, judged by the same metrics as flown ones.

`ulog_source` and `tlog_source` make a `Recorded` of a file: the project's telemetry, parameters, events. `step_finder`
looks for steps and stretches in its roll set-point, `excitation` says whether they are enough, `imported_flight` scores
them as flown ones are, `beside` flies the same again with our own autopilot, and `command` does it all for
`froude review FILE`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

__all__ = ["SUFFIXES", "add_arguments", "import_command", "is_recording"]

SUFFIXES = (".ulg", ".tlog")


def is_recording(path: Path) -> bool:
    """Is this a recorded flight, by its suffix?"""
    return path.suffix.lower() in SUFFIXES


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `froude review` that only recorded flights have."""
    add = parser.add_argument_group("recorded flights (.ulg, .tlog)").add_argument
    add("--vehicle", metavar="SPEC", help="fly the same gains and set-points on this model beside them; margins on it")
    add("--limits", metavar="NAME", help="judge by these limits: practical or study (default: none)")
    add("--system", type=int, metavar="N", help="MAVLink system of a .tlog (default: the one that flew)")


def import_command(args: argparse.Namespace, *, tell: Callable[..., object]) -> int:
    """Import the recorded flights that `froude review` was given; see `scenarios.flight_import.command.run`.

    Args:
        args: the parsed arguments. tell: prints a line for people on standard error.

    Returns:
        exit status.
    """
    from scenarios.flight_import.command import run

    return run(args, tell=tell)
