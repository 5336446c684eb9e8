"""`froude hil`: the plant for a real autopilot, a PX4 SITL in lockstep or a board on a serial port."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.board_session import BoardSession
    from scenarios.hil_check import Finding
    from scenarios.hil_session import HilSession
    from sitl.profile import Profile
    from sitl.vehicle_spec import VehicleModel

EXIT_OK, EXIT_LINK = 0, 3
SIMULATOR_PORT, MAVLINK_PORT = 4560, 14540
CONNECT_S, PATIENCE_S = 10.0, 10.0

Tell = Callable[[str], object]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `froude hil`, those of a vehicle left out (they are shared with other commands)."""
    add = parser.add_argument
    add("spec", help="airframe, or reference:target")
    add(
        "--link",
        metavar="URL",
        help="where the autopilot is: tcpin://127.0.0.1:4560 (PX4 SITL; the default), serial:///dev/ttyACM0:921600 "
        "(a board), json://127.0.0.1:9002 (ArduPilot)",
    )
    add("--instance", type=int, default=0, metavar="N", help="PX4's: ports 4560 + N and 14540 + N")
    add("--connect", metavar="URL", help="its MAVLink, for --check and --setup (udpin://127.0.0.1:14540 + N)")
    add("--check", action="store_true", help="say what keeps it from flying this plant, and stop")
    add("--setup", action="store_true", help="write the airframe's rotors into the autopilot, then serve")
    add("--speed", default="max", metavar="X|max", help="lockstep: vehicle seconds per second at most (default: max)")
    add("--seconds", type=float, metavar="S", help="stop after this much vehicle time")
    add("--ground", action="append", metavar="URL", help="board: pass MAVLink on to here (14550 and 14540)")
    add("--arm-hardware", action="store_true", help="board: let ground stations arm it: propellers may turn")
    add("--home", metavar="LAT,LON,ALT", help="where it stands, degrees and metres (default: PX4's, in Zurich)")
    add("--seed", type=int, default=0, metavar="N", help="of sensor noise")
    add("--status", action="store_true", help="a status line every second, also where there is no terminal")
    add("--json", action="store_true", help="print the report at the end, or the findings of --check, as JSON")


def run(args: argparse.Namespace, *, scaling: tuple[str, ...], seed: int, tell: Tell) -> int:
    """Serve the plant until Ctrl-C, SIGTERM or SIGHUP, or check an autopilot.

    Args:
        args: the parsed arguments. scaling: words of Froude scaling. seed: of sensor noise, checked.
        tell: prints a line for people on standard error.

    Returns:
        exit status: 0 done, 3 if the link or the autopilot failed.
    """
    from bridge import exposure
    from bridge.sitl_links import check_instances
    from sitl.body import Body
    from sitl.compiled import is_warm
    from sitl.errors import UsageError
    from sitl.geomagnetism import home_of
    from sitl.profile import get_profile
    from sitl.sensors import ORIGIN
    from sitl.vehicle_spec import resolve_vehicle

    check_instances(args.instance, 1)
    if args.seconds is not None and not 0.0 < args.seconds < float("inf"):
        raise UsageError(f"--seconds {args.seconds:g}: give a number above 0")
    link = args.link or f"tcpin://127.0.0.1:{SIMULATOR_PORT + args.instance}"
    model = resolve_vehicle(args.spec, scaling)
    profile = get_profile(args.profile or "sitl")
    speed = _speed(args.speed)
    if not is_warm():
        tell("compiling the control laws, once; up to half a minute ...")
    Body(model, profile).step(())  # its laws are compiled, or loaded, before anybody waits for a sample
    board = link.startswith("serial")
    # what is served says itself who else can reach it
    asked = [link] * args.check + [_connect_url(args)] * (args.check or args.setup) * (not board)
    reached = "whoever speaks there reaches the board" + (", and may arm it" if args.arm_hardware else "")
    for line in (
        *exposure.warnings(asked, exposure.FIRST),
        *exposure.warnings((args.ground or ()) if board else (), reached),
    ):
        tell(line)
    if args.check or (args.setup and board):
        status = _with_autopilot(args, link, model, profile, seed, tell)
        if args.check or status != EXIT_OK:
            return status
    from scenarios.hil_serve import Serving, serve

    what = Serving(
        link=link,
        model=model,
        profile=profile,
        seed=seed,
        speed=speed,
        seconds=args.seconds,
        home=home_of(args.home) if args.home else ORIGIN,
        setup=_connect_url(args) if args.setup and not board else "",
        grounds=None if args.ground is None else tuple(args.ground),
        may_arm=args.arm_hardware,
        status=args.status,
    )
    report = serve(what, tell)
    if args.json:
        _print(json.dumps(report, indent=2))
    return EXIT_LINK if report["stopped"] else EXIT_OK


def _connect_url(args: argparse.Namespace) -> str:
    """Where a PX4 SITL's MAVLink for programs arrives."""
    return args.connect or f"udpin://127.0.0.1:{MAVLINK_PORT + args.instance}"


def _speed(text: str) -> float | None:
    from sitl.errors import UsageError

    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed < float("inf"):
        raise UsageError(f"--speed {text}: give a number above 0, or 'max'")
    return speed


def _with_autopilot(
    args: argparse.Namespace, link: str, model: VehicleModel, profile: Profile, seed: int, tell: Tell
) -> int:
    """--check and --setup: connect as a flight does, look, write what was asked for, let go."""
    from bridge.errors import UploadFailed
    from scenarios import interrupts
    from scenarios.hil_check import check
    from scenarios.hil_session import geometry_parameters

    with interrupts.caught(), _session(args, link, model, profile, seed, tell) as session:
        client, findings = _connected(session)
        if client is not None and args.setup:
            values = geometry_parameters(model, board=session.board)
            try:
                client.upload(values)
            except UploadFailed as error:
                tell(str(error))
                return EXIT_LINK
            tell(f"{len(values)} parameters of {model.airframe.name}'s rotors written and read back")
        if client is not None:
            findings += check(client, session, model)
    if args.check and args.json:
        _print(json.dumps([one.as_dict() for one in findings], indent=2))
    elif args.check:
        _print(findings_text(findings))
        if client is not None and not session.board:
            tell("a PX4 SITL does not come back to a simulator that left: start it anew before it flies")
    fatal = [one for one in findings if not one.ok and one.fatal]
    if fatal and not args.check:
        tell("; ".join(one.sentence() for one in fatal))
    return EXIT_LINK if fatal else EXIT_OK


def _session(
    args: argparse.Namespace, link: str, model: VehicleModel, profile: Profile, seed: int, tell: Tell
) -> HilSession | BoardSession:
    from sitl.errors import UsageError

    if link.startswith("serial"):
        from scenarios.board_session import GROUNDS, BoardSession

        grounds = GROUNDS if args.ground is None else tuple(args.ground)
        return BoardSession(link, model, profile, seed=seed, grounds=grounds, may_arm=args.arm_hardware, say=tell)
    if link.startswith("json"):
        raise UsageError("--check and --setup speak PX4's parameters: not with --link json://")
    from scenarios.hil_session import HilSession

    session = HilSession(link, _connect_url(args), model, profile, seed=seed, say=tell)
    session.drive.patience_s = PATIENCE_S
    return session


def _connected(session: HilSession | BoardSession) -> tuple[Any, list[Finding]]:
    """A client that has heard its autopilot; or None, and why there is none."""
    from bridge.client import Client
    from bridge.errors import PeerLost, PeerSilent
    from scenarios.hil_check import Finding

    client = Client(session.link, session.drive)
    try:
        client.connect(CONNECT_S)
    except (PeerSilent, PeerLost) as error:
        return None, [Finding("link", False, str(error), _link_remedy(session))]
    return client, []


def _link_remedy(session: HilSession | BoardSession) -> str:
    from scenarios.board_session import BoardSession

    if not isinstance(session, BoardSession):
        if not session.lockstep.connected:
            return "No PX4 is on the simulator's port. Start one with PX4_SIM_MODEL=none_iris"
        return "Its MAVLink goes to port 14540 + N of instance N: give --instance N, or --connect URL"
    if session.heard:
        return "Bytes come, but no HEARTBEAT: is it MAVLink on that port (MAV_n_CONFIG), and the baud rate right?"
    return "Nothing comes: is it the right port, and does it speak MAVLink (MAV_n_CONFIG; USB does by itself)?"


def findings_text(findings: list[Finding]) -> str:
    """The findings of --check, one below the other.

    Args:
        findings: in order.
    """
    lines = []
    for one in findings:
        mark = "ok   " if one.ok else "WRONG" if one.fatal else "unset" if one.mended else "note "
        lines.append(f"{mark}  {one.what}: {one.seen}")
        if one.remedy:
            lines.append(f"       -> {one.remedy}")
    wrong = sum(1 for one in findings if not one.ok and one.fatal)
    unset = sum(1 for one in findings if one.mended and not one.ok)
    if wrong:
        lines.append(f"{wrong} to put right before it flies")
    elif unset:
        lines.append("froude fly and froude hil --setup put right what is unset; as it is now it cannot fly this plant")
    else:
        lines.append("nothing keeps it from flying this plant")
    return "\n".join(lines)


def _print(text: str) -> None:
    if sys.stdout is not None:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
