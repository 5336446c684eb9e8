"""`froude sitl`: simulated vehicles, alone or as a fleet, for any ground station."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bridge.clock import ScaledClock

EXIT_OK, EXIT_FAILED = 0, 3
LOOPBACK = "127.0.0.1"
LOGS = "logs/ulog"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude sitl`, those of a vehicle left out (they are shared with other commands)."""
    add = parser.add_argument
    add("spec", nargs="+", help="airframe, or reference:target; ant-x*20 is twenty of them")
    add("--instance", type=int, default=0, metavar="N", help="PX4's port and system id offset of the first vehicle")
    add("--speed", default="1", metavar="X|max", help="vehicle seconds per second (default: 1)")
    add("--seed", type=int, default=0, metavar="N", help="of sensor noise")
    add("--bind", default=LOOPBACK, metavar="ADDRESS", help=f"open PX4's ports here (default: {LOOPBACK})")
    add(
        "--link",
        action="append",
        default=[],
        metavar="URL",
        help="instead of PX4's ports; may be repeated; +i behind a number adds the instance: udpin://127.0.0.1:14560+i",
    )
    add(
        "--state",
        type=Path,
        metavar="FILE",
        help="keep parameters in this file; of several FILE.0, FILE.1 ...",
    )
    add(
        "--log-dir",
        type=Path,
        metavar="DIR",
        help=f"write flight logs (ULog) here; of several in DIR/0, DIR/1 ... (default: {LOGS})",
    )
    add("--no-log", action="store_true", help="write no flight logs")
    add("--signing-key", type=Path, metavar="FILE", help="sign messages and refuse unsigned ones, with the key in here")
    add("--status", action="store_true", help="a status line every second, also where there is no terminal")


def run(args: argparse.Namespace, *, scaling: tuple[str, ...], seed: int, tell: Callable[[str], object]) -> int:
    """Serve vehicles until Ctrl-C, SIGTERM, SIGHUP, or until the last one is switched off.

    Args:
        args: the parsed arguments.
        scaling: words of Froude scaling.
        seed: of sensor noise, checked.
        tell: prints a line for people on standard error.

    Returns:
        exit status: 0 done, 3 if a vehicle failed.
    """
    from bridge import sitl_links
    from bridge.fleet import Fleet, stop_on_signals
    from bridge.sitl_server import (
        SitlOptions,
        build_fleet,
        check_files,
        close_vehicle,
        expand_specs,
        refuses_unsigned,
    )
    from scenarios.status_line import StatusLine
    from sitl.compiled import is_warm
    from sitl.profile import get_profile
    from sitl.vehicle import warm_up
    from sitl.vehicle_spec import resolve_vehicle

    specs = expand_specs(args.spec)
    sitl_links.check_instances(args.instance, len(specs))
    clock = _clock(args.speed)
    options = SitlOptions(
        profile=args.profile or "sitl",
        scaling=scaling,
        seed=seed,
        bind=sitl_links.check_bind(args.bind),
        links=tuple(args.link),
        state=args.state,
        log_dir=None if args.no_log else args.log_dir or Path(LOGS),
        signing_key=args.signing_key,
        several=len(specs) > 1,
        speed=None if clock is None else clock.speed,
    )
    sitl_links.check_links(options.links, bind=options.bind, count=len(specs))
    # where nobody said that logs should go, a folder that cannot be written costs the logs and nothing else
    check_files(options if args.log_dir else dataclasses.replace(options, log_dir=None))
    models = {spec: resolve_vehicle(spec, scaling) for spec in dict.fromkeys(specs)}
    if not is_warm():
        tell("compiling the control laws, once; up to half a minute ...")
    warm_up(next(iter(models.values())), get_profile(options.profile))
    servers = build_fleet([models[spec] for spec in specs], args.instance, options)
    screen = StatusLine(always=args.status, tell=tell)
    try:
        warning = sitl_links.exposure(
            [link for server in servers for link in server.links],
            guarded=all(refuses_unsigned(server) for server in servers),
        )
        if warning is not None:
            tell(warning)
        for spec, server in zip(specs, servers, strict=True):
            _print(sitl_links.banner(models[spec].name, server.links))
        _print("Ctrl-C stops it." if len(servers) == 1 else f"{len(servers)} vehicles; Ctrl-C stops them.")
        with stop_on_signals() as stop:
            # This clock starts now: the one before only found out whether the speed makes sense.
            fleet = Fleet(servers, _clock(args.speed), tell=screen.tell, close=close_vehicle)
            status = fleet.run(stop=stop, report=(lambda now: screen.show(now.line())) if screen.shows else None)
        screen.tell(f"served {status.line().strip()}")
    finally:
        for server in servers:
            sitl_links.close_links(server.links)
    return EXIT_FAILED if fleet.failures else EXIT_OK


def _clock(speed: str) -> ScaledClock | None:
    """Return a clock of this speed that starts now; None for as fast as possible."""
    from bridge.clock import ScaledClock
    from sitl.errors import UsageError

    if speed == "max":
        return None
    try:
        return ScaledClock(float(speed))
    except ValueError:
        raise UsageError(f"--speed {speed}: give a number above 0, or 'max'") from None


def _print(line: str) -> None:
    if sys.stdout is not None:
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()
