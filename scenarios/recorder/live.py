"""A server of our own that viewers look at while something is flown: `rerun --connect <its address>`.

One server per process and port, kept until the process ends: Rerun's holds its port for as long as a viewer
is connected, so a server per flight could not start for the second one.
"""

from __future__ import annotations

import socket
from typing import Any

from sitl.errors import UsageError

HOST = "127.0.0.1"
MEMORY = "256MB"
"""What is kept for a viewer that joins late; the oldest is dropped first."""

_servers: dict[int, Any] = {}


def address(port: int) -> str:
    """What a viewer connects to."""
    return f"rerun+http://{HOST}:{port}/proxy"


def serve(port: int) -> str:
    """Start the server unless this process has it already; only this machine can reach it.

    Args:
        port: TCP port of 127.0.0.1.

    Returns:
        Its address.

    Raises:
        UsageError: the port is taken.
    """
    import rerun as rr

    if port not in _servers:
        _check_free(port)
        stream = rr.RecordingStream("froude-live", send_properties=False)
        stream.set_sinks(rr.GrpcServerSink(HOST, port, server_memory_limit=MEMORY))
        _servers[port] = stream
    return address(port)


def _check_free(port: int) -> None:
    """Rerun only logs that its server's port is taken, and then shows nothing."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"live view: port {port} of {HOST} cannot be used: {error}. Close the program that has it "
                "(another viewer or run; this run's other process: fly one at a time) or choose another port"
            ) from error
