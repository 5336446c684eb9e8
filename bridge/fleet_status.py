"""What a fleet is doing, in one line for people."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bridge.clock import Clock
from bridge.px4_modes import PX4_MODES
from bridge.vehicle_server import VehicleServer

_REPORT_US = 1_000_000
_TOO_SLOW = 0.95

# Not refusals: what was taken, and how often the splitter found its feet again.
_GOOD = ("received", "resyncs")


@dataclass(frozen=True)
class VehicleStatus:
    """One vehicle.

    Attributes:
        sysid: its system id.
        mode, armed: what it does.
        links: how many it has.
        heard: on how many of them somebody was heard.
        sent, received: messages so far, all links together.
        refusals: what was not taken so far, by kind; kinds with none left out.
    """

    sysid: int
    mode: str
    armed: bool
    links: int
    heard: int
    sent: int
    received: int
    refusals: Mapping[str, int]


@dataclass(frozen=True)
class FleetStatus:
    """One second of serving.

    Attributes:
        vehicle_s: vehicle time in seconds.
        speed: vehicle seconds per wall second, achieved since the last status.
        asked_speed: what was asked for, None for as fast as possible.
        vehicles: those that are served.
        failed: vehicles that are no longer served because of a defect.
    """

    vehicle_s: float
    speed: float
    asked_speed: float | None
    vehicles: tuple[VehicleStatus, ...]
    failed: int = 0

    def refusals(self) -> dict[str, int]:
        """Return what was not taken so far, by kind, all vehicles together."""
        total: Counter[str] = Counter()
        for vehicle in self.vehicles:
            total.update(vehicle.refusals)
        return dict(total)

    def line(self) -> str:
        """Return it as one line; trouble is named only where there is some."""
        speed = f"{self.speed:.2f} x"
        if self.asked_speed is not None and self.speed < _TOO_SLOW * self.asked_speed:
            speed += f" (too slow for {self.asked_speed:g} x)"
        vehicles = self.vehicles
        parts = [
            f"{self.vehicle_s:8.1f} s",
            speed,
            self._modes(),
            f"links heard {sum(one.heard for one in vehicles)}/{sum(one.links for one in vehicles)}",
            f"sent {sum(one.sent for one in vehicles)}",
            f"received {sum(one.received for one in vehicles)}",
            *(f"{kind} {count}" for kind, count in self.refusals().items()),
        ]
        if self.failed:
            parts.append(f"failed vehicles {self.failed}")
        return "  ".join(parts)

    def _modes(self) -> str:
        """Return `Hold, armed` of one vehicle, `20 vehicles: 18 Hold, 2 Land, 5 armed` of several."""
        vehicles = self.vehicles
        if len(vehicles) == 1:
            return f"{vehicles[0].mode}{', armed' if vehicles[0].armed else ''}"
        modes = Counter(one.mode for one in vehicles).most_common()
        parts = [f"{count} {mode}" for mode, count in modes]
        parts.append(f"{sum(one.armed for one in vehicles)} armed")
        return f"{len(vehicles)} vehicles: {', '.join(parts)}"


class FleetWatch:
    """Measures what a fleet achieves.

    Args:
        servers: the vehicles; looked at anew each time, so the list may shrink.
        asked_speed: vehicle seconds per wall second, None for as fast as possible.
        wall: the clock that measures the speed.
    """

    def __init__(self, servers: Sequence[VehicleServer], asked_speed: float | None, wall: Clock) -> None:
        self._servers = servers
        self._asked_speed = asked_speed
        self._wall = wall
        self._wall_us = wall.now_us()
        self._vehicle_us = servers[0].vehicle.time_us
        self.failed = 0

    def look(self) -> FleetStatus | None:
        """Return a status if a second has passed since the last one."""
        passed_us = self._wall.now_us() - self._wall_us
        return None if passed_us < _REPORT_US or not self._servers else self.status()

    def status(self) -> FleetStatus:
        """Return a status now."""
        wall_us = self._wall.now_us()
        vehicle_us = self._servers[0].vehicle.time_us if self._servers else self._vehicle_us
        speed = (vehicle_us - self._vehicle_us) / max(1, wall_us - self._wall_us)
        self._wall_us, self._vehicle_us = wall_us, vehicle_us
        return FleetStatus(
            vehicle_s=vehicle_us * 1e-6,
            speed=speed,
            asked_speed=self._asked_speed,
            vehicles=tuple(vehicle_status(server) for server in self._servers),
            failed=self.failed,
        )


def vehicle_status(server: VehicleServer) -> VehicleStatus:
    """Return what one vehicle is doing."""
    autopilot = server.vehicle.autopilot
    refusals: Counter[str] = Counter()
    received = 0
    for link in server.links:
        counts = counter_values(link.connection.counters)
        received += counts.get("received", 0)
        refusals.update({kind.replace("_", " "): count for kind, count in counts.items() if kind not in _GOOD})
        refusals["strangers"] += link.link.strangers
    refusals["refused"] += server.refused
    refusals["defects"] += server.defects
    refusals["not forwarded"] += server.forwarder.refused
    return VehicleStatus(
        sysid=server.sysid,
        mode=PX4_MODES[autopilot.mode].name,
        armed=autopilot.armed,
        links=len(server.links),
        heard=sum(bool(link.peers) for link in server.links),
        sent=sum(link.connection.sent for link in server.links),
        received=received,
        refusals={kind: count for kind, count in refusals.items() if count},
    )


def counter_values(counters: Any) -> dict[str, int]:
    """Return every public number of a link's counters by name, those added later included."""
    if dataclasses.is_dataclass(counters):
        names = [field.name for field in dataclasses.fields(counters)]
    else:
        names = [*getattr(type(counters), "__slots__", ()), *getattr(counters, "__dict__", ())]
    values = {name: getattr(counters, name) for name in names if not name.startswith("_")}
    return {name: value for name, value in values.items() if isinstance(value, int)}
