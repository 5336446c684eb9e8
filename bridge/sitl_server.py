"""Vehicles for any ground station: on PX4's own ports, in real time, slower, faster, or as fast as it goes.

    links = open_links(default_urls(instance=0), instance=0)
    serve(vehicle, links, ScaledClock(1.0), stop=stop)

Instance i is system i + 1 and speaks from PX4's ports: to the ground station at 127.0.0.1:14550 from
18570 + i and to programs (MAVSDK) at 127.0.0.1:14540 + i from 14580 + i. It speaks first.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import get_args

from bridge.clock import Clock, ScaledClock, WallClock, utc_us
from bridge.connection import Connection
from bridge.errors import LinkUrlError
from bridge.link import LOOPBACK, open_link
from bridge.px4_modes import PX4_MODES
from bridge.streams import LinkMode
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.errors import UsageError
from sitl.vehicle import Vehicle

LAST_INSTANCE = 249
"""System ids end at 250."""

_GCS_PORT, _GCS_LOCAL = 14550, 18570
_API_PORT, _API_LOCAL, _LAST_API_PORT = 14540, 14580, 14549
_LISTEN_US = 1_000
_TOO_LATE_US = 100_000
_REPORT_US = 1_000_000


def default_urls(instance: int = 0) -> tuple[str, ...]:
    """Return the link addresses of a vehicle as PX4's simulator uses them.

    Raises:
        UsageError: no such instance.
    """
    if not 0 <= instance <= LAST_INSTANCE:
        raise UsageError(f"--instance {instance}: choose one from 0 to {LAST_INSTANCE}")
    api_port = min(_API_PORT + instance, _LAST_API_PORT)
    return (
        f"udpout://{LOOPBACK}:{_GCS_PORT}?local={_GCS_LOCAL + instance}#gcs",
        f"udpout://{LOOPBACK}:{api_port}?local={_API_LOCAL + instance}#onboard",
    )


def open_links(urls: Sequence[str], *, instance: int = 0) -> list[ServerLink]:
    """Open a vehicle's links; all are closed again if one cannot be opened.

    Args:
        urls: addresses as `bridge.link` reads them; `#onboard` at the end gives a link the stream rates of a
            companion computer, `#gcs`, the default, those of a ground station.
        instance: 0 is system 1.

    Raises:
        LinkUrlError: an address that cannot be read.
        PortBusy: another program holds a port.
    """
    links: list[ServerLink] = []
    try:
        for number, url in enumerate(urls):
            address, mode = _split_mode(url)
            link = open_link(address)
            connection = Connection(instance + 1, 1, datagram=link.datagram)
            links.append(ServerLink(link, connection, number, mode))
    except BaseException:
        close_links(links)
        raise
    return links


def close_links(links: Sequence[ServerLink]) -> None:
    """Release every port."""
    for link in links:
        link.link.close()


def banner(title: str, links: Sequence[ServerLink]) -> str:
    """Return the line that says who is served where."""
    names = {"gcs": "ground station", "onboard": "MAVSDK and other programs", "memory": "this program"}
    where = ", ".join(f"{names[link.mode]} at {link.link.name}" for link in links)
    sysid = links[0].connection.sysid if links else 0
    return f"{title} is system {sysid}, serving {where or 'nobody'}"


@dataclass(frozen=True)
class Status:
    """One second of serving.

    Attributes:
        vehicle_s: vehicle time in seconds.
        speed: vehicle seconds per wall second, achieved since the last status.
        asked_speed: what was asked for, None for as fast as possible.
        mode, armed: what the vehicle does.
        sent, received: messages so far, all links together.
        damaged: bytes received that were no message, so far.
        refused: messages for this vehicle that made no sense, so far.
        defects: bugs hit so far.
    """

    vehicle_s: float
    speed: float
    asked_speed: float | None
    mode: str
    armed: bool
    sent: int
    received: int
    damaged: int
    refused: int
    defects: int

    def line(self) -> str:
        """Return it as one line for people; trouble is named only where there is some."""
        parts = [
            f"{self.vehicle_s:8.1f} s",
            f"{self.speed:.2f} x",
            f"{self.mode}{', armed' if self.armed else ''}",
            f"sent {self.sent}",
            f"received {self.received}",
        ]
        if self.asked_speed is not None and self.speed < 0.95 * self.asked_speed:
            parts[1] += f" (too slow for {self.asked_speed:g} x)"
        for what, count in (
            ("damaged bytes", self.damaged),
            ("refused", self.refused),
            ("defects", self.defects),
        ):
            if count:
                parts.append(f"{what} {count}")
        return "  ".join(parts)


def serve(
    vehicle: Vehicle,
    links: Sequence[ServerLink],
    clock: ScaledClock | None,
    *,
    stop: Callable[[], bool],
    report: Callable[[Status], object] | None = None,
    wall: Clock | None = None,
) -> VehicleServer:
    """Run a vehicle on its links until `stop` says so or a ground station shuts it down.

    A machine that cannot keep up flies slower than asked and says so in the status: what is more than 0.1 s
    late is not made up for.

    Args:
        vehicle: the vehicle.
        links: see `open_links`; they stay open. The vehicle's MAV_SYS_ID becomes theirs.
        clock: its speed; None for as fast as possible.
        stop: asked before every tick.
        report: gets a status once per wall second.
        wall: the clock that measures the speed; tests pass their own.

    Returns:
        The server, with its counters.
    """
    wall = wall or WallClock()
    if links:
        vehicle.parameters.set("MAV_SYS_ID", links[0].connection.sysid)
    server = VehicleServer(vehicle, links, utc_boot_us=utc_us() - vehicle.time_us)
    server.step()  # before the clock starts: the first tick loads the compiled laws
    pace = None if clock is None else _Pace(clock, vehicle.time_us)
    watch = _Watch(server, None if clock is None else clock.speed, wall)
    while not (stop() or server.shutdown_asked):
        if pace is not None:
            while not pace.due(vehicle.time_us + vehicle.tick_us):
                server.listen()
        server.step()
        if report is not None and vehicle.tick % _WATCH_TICKS == 0:
            status = watch.look()
            if status is not None:
                report(status)
    return server


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C and SIGTERM end `serve` after the tick it is in; yields the `stop` to give to it."""
    stopped = False

    def stop(_number: int, _frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_WATCH_TICKS = 16


class _Pace:
    """Lets ticks happen when they are due on a clock."""

    def __init__(self, clock: ScaledClock, vehicle_us: int) -> None:
        self._clock = clock
        self._slice_us = max(1, int(_LISTEN_US * clock.speed))
        self._too_late_us = int(_TOO_LATE_US * clock.speed)
        self._ahead_us = clock.now_us() - vehicle_us

    def due(self, vehicle_us: int) -> bool:
        """Return whether it is vehicle time `vehicle_us`; if not, wait for it, but at most a millisecond."""
        remaining_us = vehicle_us + self._ahead_us - self._clock.now_us()
        if remaining_us > 0:
            self._clock.sleep_until_us(self._clock.now_us() + min(remaining_us, self._slice_us))
            return remaining_us <= self._slice_us
        if -remaining_us > self._too_late_us:
            self._ahead_us -= remaining_us
        return True


class _Watch:
    """Measures what `serve` achieves."""

    def __init__(self, server: VehicleServer, asked_speed: float | None, wall: Clock) -> None:
        self._server = server
        self._asked_speed = asked_speed
        self._wall = wall
        self._wall_us = wall.now_us()
        self._vehicle_us = server.vehicle.time_us

    def look(self) -> Status | None:
        """Return a status if a second has passed since the last one."""
        wall_us = self._wall.now_us()
        passed_us = wall_us - self._wall_us
        if passed_us < _REPORT_US:
            return None
        server, autopilot = self._server, self._server.vehicle.autopilot
        vehicle_us = server.vehicle.time_us
        speed = (vehicle_us - self._vehicle_us) / passed_us
        self._wall_us, self._vehicle_us = wall_us, vehicle_us
        connections = [link.connection for link in server.links]
        return Status(
            vehicle_s=vehicle_us * 1e-6,
            speed=speed,
            asked_speed=self._asked_speed,
            mode=PX4_MODES[autopilot.mode].name,
            armed=autopilot.armed,
            sent=sum(connection.sent for connection in connections),
            received=sum(connection.counters.received for connection in connections),
            damaged=sum(connection.counters.bad_bytes for connection in connections),
            refused=server.refused,
            defects=server.defects,
        )


def _split_mode(url: str) -> tuple[str, LinkMode]:
    """Return (address, mode) of an address with `#mode` at its end."""
    address, _, mode = url.partition("#")
    choices: tuple[LinkMode, ...] = get_args(LinkMode)
    for choice in choices:
        if choice == (mode or "gcs"):
            return address, choice
    raise LinkUrlError(url, f"unknown stream rates {mode!r}", "Write #gcs or #onboard, or neither")
