"""The services of one vehicle on its links: parameters, plans, files, logs, events; each a protocol without I/O.

A service takes messages (`handle`), is asked what is due on each link (`poll`), and forgets a link whose peer is
gone. `bridge.vehicle_server` carries the messages; here is which services there are and what they work on.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bridge.component_metadata import ComponentMetadata
from bridge.event_list import events_json
from bridge.events import EventServer
from bridge.flight_log import FLUSH_US, FlightLog
from bridge.ftp import FtpServer
from bridge.ftp_files import FileTree
from bridge.key_file import load_key
from bridge.log_transfer import LogServer
from bridge.mission_progress import MissionProgress
from bridge.mission_protocol import MissionServer
from bridge.param_file import ParameterFile, preflight_storage
from bridge.param_pack import serve_parameters
from bridge.param_protocol import ParamServer
from bridge.plan_store import PlanStore
from bridge.serial_link import is_usb
from bridge.server_link import ServerLink
from bridge.signing import NO_KEY
from bridge.signing_setup import SigningSetup
from sitl.modes import Mode, Result, Severity
from sitl.param_corrections import ParameterCorrector
from sitl.vehicle import Vehicle

Reply = tuple[str, dict[str, Any]]

_SIGN_ALWAYS = 2
_EVENTS_TYPE = 4  # COMP_METADATA_TYPE_EVENTS
_MISSION_MODES = (Mode.MISSION, Mode.TAKEOFF, Mode.LAND)


class Service(Protocol):
    """A protocol that serves any number of links."""

    @property
    def HANDLES(self) -> Collection[str]:  # noqa: N802 - a constant of each service
        """Names of the messages it takes."""

    @property
    def refused(self) -> int:
        """Messages for this vehicle that made no sense."""

    def handle(self, msg: Any, link_id: int, now_us: int) -> list[Reply]:
        """Answer one message; the replies go out on the link it came from."""

    def poll(self, link_id: int, now_us: int) -> list[Reply]:
        """Return what is due on a link; called every 4 ms."""

    def forget(self, link_id: int) -> None:
        """The link's peer is gone."""


@dataclass(frozen=True)
class VehicleFiles:
    """Files that a vehicle keeps; None for none.

    Attributes:
        logs: folder of its ULog files. parameters: what differs from the defaults. signing_key: MAVLink 2 signing.
        log_flush_us: flight that one write to a ULog carries, us.
        behind: written by threads: the vehicle keeps to the wall clock and waits for no disk.
    """

    logs: Path | None = None
    parameters: Path | None = None
    signing_key: Path | None = None
    log_flush_us: int = FLUSH_US
    behind: bool = False


class Services:
    """Everything that serves one vehicle.

    Args:
        vehicle: the vehicle; it takes over what its file of parameters holds.
        links: its links. sysid, compid: its MAVLink address.
        say: tells everybody a text; the second only so often, for what anybody can bring about.
        files: what it keeps on disk.
        utc_boot_us: UTC of vehicle time zero, us; 0 = unknown.

    Attributes:
        all: every service. bursting: those that may have something every few ms.
        params, events: for those who have more to do with them than to carry their messages.
        metadata: what the vehicle says of its parameters and events.
        log: writes the flights; None without a directory.

    Raises:
        FileError: the file of parameters or the key file is damaged.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        links: Sequence[ServerLink],
        *,
        sysid: int,
        compid: int,
        say: Callable[[Severity, str], None],
        say_at_times: Callable[[Severity, str, str], None],
        files: VehicleFiles,
        utc_boot_us: int = 0,
    ) -> None:
        self._vehicle = vehicle
        self._say, self._say_at_times = say, say_at_times
        table = vehicle.parameters
        self._corrector = ParameterCorrector(table)
        self._stored: ParameterFile | None = None
        self._failures_told = 0
        if files.parameters is not None:
            self._stored = ParameterFile(files.parameters, table, sysid, behind=files.behind)
            table.reset("MAV_SYS_ID")  # the links decide, not the file of another instance
            for notice in self._stored.notices:
                say(Severity.WARNING, notice)
        if files.signing_key is not None and "MAV_SIGN_CFG" not in table.changed():
            table.set("MAV_SIGN_CFG", _SIGN_ALWAYS)
        address = {"system_id": sysid, "component_id": compid}
        self.params = ParamServer(table, **address)
        self.events = EventServer(**address)
        self.plans = PlanStore(self._new_mission, self._set_current)
        self.metadata = ComponentMetadata(table, more={_EVENTS_TYPE: ("all_events.json", events_json())})
        tree = FileTree()
        self.metadata.mount(tree)
        serve_parameters(tree, table)
        self._signing = SigningSetup(
            {link.link_id: link.connection for link in links},
            NO_KEY if files.signing_key is None else load_key(files.signing_key, may_be_missing=True),
            path=files.signing_key,
            usb_links={link.link_id for link in links if is_usb(link.link)},
            mode=lambda: int(table.get("MAV_SIGN_CFG")),
            armed=lambda: vehicle.autopilot.armed,
            utc_us=lambda: vehicle.time_us + utc_boot_us if utc_boot_us else 0,
            say=lambda severity, text: say_at_times(severity, "signing", text),
            **address,
        )
        self.log: FlightLog | None = None
        files_server = FtpServer(tree, **address)
        missions = MissionServer(self.plans, say=say, progress=self._progress, **address)
        self.all: tuple[Service, ...] = (self.params, self.events, missions, files_server, self._signing)
        self.bursting: tuple[Service, ...] = (self.params, files_server, missions)
        if files.logs is not None:
            self.log = FlightLog(
                files.logs,
                vehicle,
                system_id=sysid,
                utc_boot_us=utc_boot_us,
                flush_us=files.log_flush_us,
                behind=files.behind,
                say=say,
                sticks=lambda: vehicle.autopilot.manual.sticks,
            )
            tree.mount("log", files.logs)
            tree.mount("fs/microsd/log", files.logs)
            logs = LogServer(files.logs, writing=self._written, **address)
            self.all = (*self.all, logs)
            self.bursting = (*self.bursting, logs)

    @property
    def refused(self) -> int:
        """Messages for this vehicle that made no sense to a service."""
        return sum(service.refused for service in self.all)

    def poll(self, now_us: int) -> None:
        """Keep what has changed on disk. now_us: vehicle time."""
        for notice in self.params.take_notices():
            self._say_at_times(Severity.WARNING, "parameters", notice)
        for text in self._corrector.poll(now_us):
            self._say(Severity.CRITICAL, text)
        if self._stored is not None:
            self._stored.poll(now_us)
            if self._stored.failures > self._failures_told:
                self._failures_told = self._stored.failures
                self._say_at_times(Severity.CRITICAL, "parameter file", self._stored.problem)

    def store(self, action: float) -> Result | None:
        """Carry out PREFLIGHT_STORAGE's param1; None: nothing that a PX4 answers."""
        answer = preflight_storage(action, self._vehicle.parameters, self._stored)
        if answer.problem:
            self._say_at_times(Severity.CRITICAL, "parameter file", answer.problem)
        return Result.ACCEPTED if answer.acknowledged else None

    def close(self) -> None:
        """End what is being written.

        Raises:
            FileError: the key file's timestamp cannot be kept.
        """
        if self.log is not None:
            self.log.close()
        if self._stored is not None:
            self._stored.close()
        self._signing.save()

    def _written(self) -> Path | None:
        return None if self.log is None else self.log.path

    def _new_mission(self, items: Any, _: int) -> None:
        self._vehicle.autopilot.control.mission.load(items)

    def _set_current(self, seq: int) -> bool:
        return self._vehicle.autopilot.control.mission.set_current(seq)

    def _progress(self) -> MissionProgress:
        autopilot = self._vehicle.autopilot
        mission = autopilot.control.mission
        flying = autopilot.armed and autopilot.mode in _MISSION_MODES
        return MissionProgress(mission.current, mission.reached_seq, mission.finished, flying)
