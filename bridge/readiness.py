"""Waiting for a datagram on any of many sockets, with one system call instead of one for each.

readiness = Readiness(servers)
for server in readiness.wait(0.0013):
    server.listen()
"""

from __future__ import annotations

import select
import selectors
from collections.abc import Sequence

from bridge.socket_wait import FIRST_TOO_LARGE
from bridge.vehicle_server import VehicleServer


class Readiness:
    """Tells which vehicles have something to read.

    Args:
        servers: the vehicles; those with a link that no descriptor stands for (memory, TCP, serial) are always
            taken for ready.

    Attributes:
        hears_all: whether `wait` wakes up for every link, so that nobody has to ask again meanwhile.
    """

    def __init__(self, servers: Sequence[VehicleServer]) -> None:
        self._selector = selectors.DefaultSelector()
        self._descriptors: dict[VehicleServer, list[int]] = {}
        self._always: list[VehicleServer] = []
        for server in servers:
            descriptors = [link.link.fileno() for link in server.links]
            if -1 in descriptors:
                self._always.append(server)
            else:
                self._descriptors[server] = descriptors
                for descriptor in descriptors:
                    self._selector.register(descriptor, selectors.EVENT_READ, server)
        self._own = _descriptor(self._selector)

    @property
    def hears_all(self) -> bool:
        """Whether `wait` wakes up for every link."""
        return not self._always

    def wait(self, timeout_s: float) -> list[VehicleServer]:
        """Return the vehicles that have something to read, each once; empty after `timeout_s` at the latest.

        Args:
            timeout_s: 0 never waits. With vehicles that are always ready, wait in small steps.
        """
        if timeout_s > 0.0 and self._own is not None:
            # epoll counts in milliseconds and rounds up, which is a quarter of a tick; select does not.
            select.select((self._own,), (), (), timeout_s)
            timeout_s = 0.0
        ready = self._selector.select(max(0.0, timeout_s)) if self._descriptors else []
        if not ready and not self._always:
            return []
        found = dict.fromkeys(self._always)
        for key, _ in ready:
            found[key.data] = None
        return list(found)

    def forget(self, server: VehicleServer) -> None:
        """Leave a vehicle out from now on; call it before its links are closed."""
        if server in self._always:
            self._always.remove(server)
        for descriptor in self._descriptors.pop(server, ()):
            self._selector.unregister(descriptor)

    def close(self) -> None:
        """Release what the system keeps for it."""
        self._selector.close()


def _descriptor(selector: selectors.BaseSelector) -> int | None:
    """Return the descriptor of an epoll or kqueue selector that select can wait for; None if there is none."""
    fileno = getattr(selector, "fileno", None)
    if fileno is None or fileno() >= FIRST_TOO_LARGE:
        return None
    return int(fileno())
