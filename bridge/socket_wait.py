"""Waiting for one socket, to the microsecond where the system can."""

from __future__ import annotations

import math
import select
import socket
from typing import Final

FIRST_TOO_LARGE: Final = 1024
"""`select.select` knows descriptors below this; a program that has many files open has larger ones."""


def wait_for(sock: socket.socket, timeout_s: float, *, to_write: bool = False) -> bool:
    """Whether a socket can be read, or written to, within a time.

    Args:
        sock: open. timeout_s: s; 0 never waits. Of a large descriptor it is counted in whole milliseconds, upwards.
        to_write: is there room for more, instead of something to read?
    """
    if sock.fileno() < FIRST_TOO_LARGE or not hasattr(select, "poll"):
        reads, writes = ([], [sock]) if to_write else ([sock], [])
        return any(select.select(reads, writes, [], timeout_s))
    poll = select.poll()
    poll.register(sock, select.POLLOUT if to_write else select.POLLIN)
    return bool(poll.poll(math.ceil(timeout_s * 1e3)))
