"""Serves an ANT-X in a process of its own until it is told to stop: `vehicle_process.py SPEED URL ...`."""

from __future__ import annotations

import sys

from bridge.clock import ScaledClock
from bridge.sitl_server import banner, close_links, open_links, serve, stop_on_signals
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle


def main() -> None:
    speed, *urls = sys.argv[1:]
    vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"))
    links = open_links(urls)
    with stop_on_signals() as stop:
        print(banner("ant-x", links), flush=True)  # noqa: T201
        server = serve(
            vehicle,
            links,
            ScaledClock(float(speed)),
            stop=stop,
            report=lambda status: print(status.line(), flush=True),  # noqa: T201
        )
    close_links(links)
    sys.exit(1 if server.defects else 0)


if __name__ == "__main__":
    main()
