"""Vehicles for any ground station: on PX4's own ports, each made from what the user asked for.

    options = SitlOptions(seed=1)
    servers = [build_vehicle("ant-x", 0, options), build_vehicle("ant-r", 1, options)]
    Fleet(servers, ScaledClock(1.0), close=close_vehicle).run(stop=stop)

Instance i is system i + 1 and speaks from PX4's ports (`bridge.sitl_links`). It speaks first.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.clock import Clock, ScaledClock, utc_us
from bridge.fleet import Fleet, stop_on_signals
from bridge.fleet_status import FleetStatus
from bridge.flight_log import FLUSH_US, MOST_FLUSH_US
from bridge.key_file import load_key
from bridge.link import LOOPBACK
from bridge.services import VehicleFiles
from bridge.sitl_links import banner, close_links, default_urls, link_urls, open_links
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.errors import FileError, UsageError
from sitl.parameters import ParameterTable
from sitl.profile import get_profile
from sitl.vehicle import Vehicle, airframe_parameters
from sitl.vehicle_spec import DEFAULT_SCALING, VehicleModel, resolve_vehicle

__all__ = [
    "SitlOptions",
    "banner",
    "build_fleet",
    "build_vehicle",
    "check_files",
    "close_links",
    "close_vehicle",
    "default_urls",
    "expand_specs",
    "open_links",
    "refuses_unsigned",
    "serve",
    "stop_on_signals",
]

_MOST_VEHICLES = 255
_REPEATED = re.compile(r"(.+)\*(\d+)", re.DOTALL)


@dataclass(frozen=True)
class SitlOptions:
    """What all vehicles of a fleet have in common.

    Attributes:
        profile: name of the fidelity profile.
        scaling: words of Froude scaling, for specs that are scaled.
        seed: of sensor noise; among several vehicles instance i uses seed + i.
        bind: the address of this computer that PX4's ports are opened on.
        links: addresses instead of PX4's ports; a number with +i behind it grows by the instance.
        state: file that keeps parameters across restarts; None keeps none.
        log_dir: folder of flight logs; None writes none.
        signing_key: file of the MAVLink 2 signing key, the same for all vehicles; None does not sign.
        several: whether there is more than one vehicle, so that each needs files of its own.
        speed: vehicle seconds per second; None for as fast as possible.
    """

    profile: str = "sitl"
    scaling: tuple[str, ...] = DEFAULT_SCALING
    seed: int = 0
    bind: str = LOOPBACK
    links: tuple[str, ...] = ()
    state: Path | None = None
    log_dir: Path | None = None
    signing_key: Path | None = None
    several: bool = False
    speed: float | None = 1.0

    def of_instance(self, instance: int) -> SitlOptions:
        """Return the options of one vehicle: its own seed, link addresses and, among several, files.

        `FILE.params` becomes `FILE.2.params` for instance 2, and the folder of logs `DIR/2`.
        """
        seed, state, log_dir = self.seed, self.state, self.log_dir
        if self.several:
            seed += instance
            state = None if state is None else state.with_name(f"{state.stem}.{instance}{state.suffix}")
            log_dir = None if log_dir is None else log_dir / str(instance)
        return dataclasses.replace(
            self,
            seed=seed,
            links=link_urls(instance, bind=self.bind, given=self.links),
            state=state,
            log_dir=log_dir,
        )


def expand_specs(words: Sequence[str]) -> list[str]:
    """Return one vehicle spec for each vehicle: `ant-x*3` is three of them.

    Raises:
        UsageError: a count of 0, or more vehicles than MAVLink has system ids.
    """
    specs: list[str] = []
    for word in words:
        match = None if Path(word).is_file() else _REPEATED.fullmatch(word)
        spec, count = (match[1], int(match[2])) if match else (word, 1)
        if not 1 <= count <= _MOST_VEHICLES:
            raise UsageError(f"{word}: {count} vehicles; give a number from 1 to {_MOST_VEHICLES}")
        specs += [spec] * count
    if len(specs) > _MOST_VEHICLES:
        raise UsageError(f"{len(specs)} vehicles: MAVLink has system ids for {_MOST_VEHICLES}")
    return specs


def check_files(options: SitlOptions) -> None:
    """Refuse files that cannot be used: better now than at the end of a flight.

    Raises:
        FileError: which of them, and why: a signing key must be readable by its owner only.
    """
    if options.state is not None:
        if options.state.is_dir():
            raise FileError(options.state, "is a folder", "Give --state a file")
        if not options.state.parent.is_dir():
            raise FileError(options.state, "its folder does not exist", "Make the folder, or write --state elsewhere")
    if options.log_dir is not None:
        if options.log_dir.exists() and not options.log_dir.is_dir():
            raise FileError(options.log_dir, "is not a folder", "Give --log-dir a folder")
        if not options.log_dir.exists() and not options.log_dir.parent.is_dir():
            raise FileError(options.log_dir, "its parent folder does not exist", "Make that, or choose another one")
    key = options.signing_key
    if key is not None:
        if not key.is_file():
            raise FileError(key, "no such key file", "--signing-key needs a file with the key in it")
        load_key(key, may_be_missing=True)


def build_vehicle(spec: str | VehicleModel, instance: int, options: SitlOptions) -> VehicleServer:
    """Make one vehicle with its links and services; `close_vehicle` and `close_links` undo it.

    Args:
        spec: airframe or reference:target, or the model itself.
        instance: 0 is system 1.
        options: of the fleet.

    Raises:
        UsageError: no such vehicle or profile.
        FileError: a file of the vehicle cannot be used.
        LinkError: a port is busy, a peer does not answer.
    """
    own = options.of_instance(instance)
    model = resolve_vehicle(spec, own.scaling) if isinstance(spec, str) else spec
    profile = get_profile(own.profile)
    # a default of this vehicle, so that no file of parameters keeps it
    table = ParameterTable({**airframe_parameters(model, profile), "MAV_SYS_ID": instance + 1})
    vehicle = Vehicle(model, profile, seed=own.seed, parameters=table)
    links = open_links(own.links, instance=instance)
    # of the clock's time, a tenth of a second is what a killed program may lose
    flush_us = MOST_FLUSH_US if own.speed is None else min(max(FLUSH_US, round(FLUSH_US * own.speed)), MOST_FLUSH_US)
    files = VehicleFiles(own.log_dir, own.state, own.signing_key, flush_us, behind=own.speed is not None)
    try:
        return _server(vehicle, links, files)
    except BaseException:
        close_links(links)
        raise


def build_fleet(specs: Sequence[str | VehicleModel], first: int, options: SitlOptions) -> list[VehicleServer]:
    """Make one vehicle for each spec, with instances from `first` on; none is left half made.

    Raises:
        UsageError, FileError, LinkError: as `build_vehicle`; the vehicles made before are closed again.
    """
    servers: list[VehicleServer] = []
    try:
        for instance, spec in enumerate(specs, start=first):
            servers.append(build_vehicle(spec, instance, options))
    except BaseException:
        for server in servers:
            close_vehicle(server)
            close_links(server.links)
        raise
    return servers


def refuses_unsigned(server: VehicleServer) -> bool:
    """Return whether a vehicle obeys only messages that are signed with its key, on every link."""
    keyed = all(link.connection.signer is not None for link in server.links)
    return keyed and bool(server.vehicle.parameters.get("MAV_SIGN_CFG"))


def close_vehicle(server: VehicleServer) -> None:
    """Bring a vehicle's files to an end, in order; its links stay open.

    Raises:
        FileError: one of them cannot be written.
    """
    server.close()


def serve(
    vehicle: Vehicle,
    links: Sequence[ServerLink],
    clock: ScaledClock | None,
    *,
    stop: Callable[[], bool],
    report: Callable[[FleetStatus], object] | None = None,
    wall: Clock | None = None,
) -> VehicleServer:
    """Run one vehicle on its links until `stop` says so or a ground station shuts it down; see `Fleet.run`.

    Args:
        vehicle: the vehicle.
        links: see `open_links`. The vehicle's MAV_SYS_ID becomes theirs.
        clock: its speed; None for as fast as possible.
        stop: asked before every tick.
        report: gets a status once per wall second.
        wall: the clock that measures the speed; tests pass their own.

    Returns:
        The server, with its counters.
    """
    server = _server(vehicle, links)
    Fleet([server], clock, wall=wall, close=close_vehicle).run(stop=stop, report=report)
    return server


def _server(vehicle: Vehicle, links: Sequence[ServerLink], files: VehicleFiles | None = None) -> VehicleServer:
    if links and vehicle.parameters.get("MAV_SYS_ID") != links[0].connection.sysid:
        vehicle.parameters.set("MAV_SYS_ID", links[0].connection.sysid)
    server = VehicleServer(vehicle, links, utc_boot_us=utc_us() - vehicle.time_us, files=files or VehicleFiles())
    server.services.metadata.files()  # takes a tenth of a second, which no tick has
    return server
