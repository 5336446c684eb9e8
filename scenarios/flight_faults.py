"""The planned faults of one flight, joined with the parts of it that they happen to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from bridge.client import Client
from bridge.drive import Drive
from bridge.faulty_link import FaultyLink, LinkFault
from bridge.link import Link
from bridge.param_operation import Outcome, ParamOperation, ParamValue
from scenarios.fault_injection import BodyTarget, FaultInjection, Target
from scenarios.fault_kinds import Where
from scenarios.faults import Fault
from scenarios.injected_fault import InjectedFault
from scenarios.pilot import Pilot
from sitl.parameters import ParameterTable, ParameterType, to_raw

if TYPE_CHECKING:
    from scenarios.flight_job import FlightJob
    from scenarios.param_loan import ParamLoan
    from sitl.autopilot import Autopilot
    from sitl.faults import Faults

Values = dict[str, tuple[float | int, ParameterType]]


class LinkTarget(Target):
    """The flight's link."""

    def __init__(self, link: FaultyLink) -> None:
        self._link = link

    def begin(self, number: int, fault: Fault) -> None:
        """Put a fault in force."""
        self._link.begin(number, link_fault(fault))

    def end(self, number: int) -> None:
        """Take it away."""
        self._link.end(number)

    def datagrams(self, number: int) -> tuple[int, int]:
        """How many passed, and of how many something became."""
        return self._link.datagrams(number)


def link_fault(fault: Fault) -> LinkFault:
    """What a fault of the link does.

    Args:
        fault: as planned.
    """
    s = fault.settings
    share = s.get("share_pct", 0.0) * 1e-2
    return LinkFault(
        loss=s.get("loss_pct", 0.0) * 1e-2,
        duplicate=share if fault.kind == "link_duplication" else 0.0,
        reorder=share if fault.kind == "link_reordering" else 0.0,
        corrupt=share if fault.kind == "link_corruption" else 0.0,
        delay_us=round(s.get("delay_s", 0.0) * 1e6),
        jitter_us=round(s.get("jitter_s", 0.0) * 1e6),
        to_vehicle=s["direction"] != "from_vehicle",
        from_vehicle=s["direction"] != "to_vehicle",
    )


class ParameterTarget(Target):
    """Parameters, changed over the link as a person would.

    Args:
        client: connected. before: what a parameter is set back to.
    """

    def __init__(self, client: Client, before: Mapping[str, ParamValue]) -> None:
        self._client = client
        self._before = before
        self._operations: dict[int, ParamOperation] = {}
        self._names: dict[int, str] = {}

    def begin(self, number: int, fault: Fault) -> None:
        """Begin to set a parameter."""
        name = self._names[number] = fault.settings["parameter"]
        type_ = self._before[name].type
        self._operations[number] = self._client.params.start_set(name, fault.settings["value"], type_, read_back=True)

    def end(self, number: int) -> None:
        """Begin to set it back."""
        name = self._names[number]
        self._client.params.start_set(name, self._before[name].raw, self._before[name].type)

    def failed(self, number: int) -> str:
        """Why the vehicle never had the value; empty if it had, or may have."""
        result = self._operations[number].result
        if result is None or result.outcome is Outcome.VERIFIED:
            return ""
        return result.reason or "it was not set"

    def tick(self, now_us: int) -> None:
        """Send what setting takes: a parameter is set while the pilot does other things."""
        if self._client.params.busy:
            for name, fields in self._client.params.poll(now_us):
                self._client.send(name, **fields)


class AutopilotTarget(Target):
    """An autopilot of our own.

    Args:
        autopilot: that is started anew. link: over which nothing comes until it has booted.
    """

    def __init__(self, autopilot: Autopilot, link: FaultyLink) -> None:
        self._autopilot = autopilot
        self._link = link

    def begin(self, number: int, fault: Fault) -> None:
        """Its motors stop and it falls silent."""
        self._autopilot.restart()
        self._link.begin(number, LinkFault(loss=1.0))

    def end(self, number: int) -> None:
        """It has booted."""
        self._link.end(number)


class FlightFaults:
    """The faults of one flight.

    Args:
        job: what is flown. say: called with (vehicle time s, severity, text) for the event log.

    Attributes:
        show: called with (vehicle time s, text) when other faults are in force.
    """

    def __init__(self, job: FlightJob, say: Callable[[float, int, str], object]) -> None:
        self.show: Callable[[float, str], object] = lambda *_: None
        self._job = job
        self._faults = job.scenario.faults
        self._say = say
        self._link: FaultyLink | None = None
        self._drive: Drive | None = None
        self._injection: FaultInjection | None = None

    def on_link(self, link: Link, drive: Drive) -> Link:
        """The link for the client to use: the same one, if nothing happens to it."""
        if any(fault.where in (Where.LINK, Where.AUTOPILOT) for fault in self._faults):
            self._link = FaultyLink(link, drive.wire_us, self._job.scenario.seed)
        return self._link or link

    @property
    def parameters(self) -> Values:
        """What they will set in flight: to be borrowed like the gains."""
        table, values = ParameterTable(), Values()
        for fault in self._faults:
            if fault.where is Where.PARAMETER:
                name = fault.settings["parameter"]
                values[name] = fault.settings["value"], table.spec(name).type
        return values

    def begin(
        self,
        client: Client,
        pilot: Pilot,
        loan: ParamLoan,
        *,
        body: Callable[[], Faults] | None,
        autopilot: Autopilot | None,
    ) -> None:
        """Take part in the flight from now on.

        Args:
            client: connected, gains uploaded. pilot: that will fly. loan: of the parameters.
            body: the faults of plant and sensors; None if these are not ours. autopilot: ours, or None.
        """
        if not self._faults:
            return
        flown = {name: ParamValue(type_, to_raw(name, type_, v)) for name, (v, type_) in self._job.parameters.items()}
        parameters = ParameterTarget(client, {**loan.was, **flown})
        targets: dict[Where, Target] = {Where.PARAMETER: parameters}
        if self._link is not None:
            targets[Where.LINK] = LinkTarget(self._link)
            if autopilot is not None:
                targets[Where.AUTOPILOT] = AutopilotTarget(autopilot, self._link)
        if body is not None:
            targets[Where.BODY] = BodyTarget(body, self._job.model.airframe.mass_kg)
        injection = self._injection = FaultInjection(self._faults, targets, self._say, self.show)

        def look(now_us: int) -> None:
            injection.tick(now_us)
            parameters.tick(now_us)

        pilot.began = lambda manoeuvre: injection.begins(manoeuvre, client.now_us())
        pilot.over = lambda: injection.over(client.now_us())
        pilot.excuses_silence = lambda: injection.has_cut_link
        self._drive = client.drive
        self._drive.watch(look)

    @property
    def injected(self) -> tuple[InjectedFault, ...]:
        """What became of each, in the scenario's order."""
        if self._injection is None:
            return tuple(InjectedFault.of(fault, None, None) for fault in self._faults)
        return self._injection.injected

    def end(self) -> None:
        """The flight is over; its drive may go on to fly another."""
        if self._drive is not None:
            self._drive.watch(None)
