"""What scripts with pymavlink's mavutil do again and again."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from typing import Any

# mavutil speaks MAVLink 1 otherwise, and reads this when it is imported.
os.environ["MAVLINK20"] = "1"

INT32, REAL32 = 6, 9


def open_station(port: int, *, system: int = 255, component: int = 0) -> Any:
    """A mavutil connection that waits for a vehicle on a port."""
    from pymavlink import mavutil

    return mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=system, source_component=component)


class Script:
    """A mavutil connection, and the waiting that scripts do."""

    def __init__(self, connection: Any) -> None:
        self.c = connection

    def until(self, good: Callable[[Any], Any], *names: str, limit_s: float = 20.0) -> Any:
        """Return the first message of these names that is good, sending heartbeats meanwhile."""
        end = time.monotonic() + limit_s
        beat = 0.0
        while time.monotonic() < end:
            if time.monotonic() >= beat:
                beat = time.monotonic() + 0.5
                self.c.mav.heartbeat_send(6, 8, 0, 0, 0)
            message = self.c.recv_match(type=list(names), blocking=True, timeout=0.2)
            if message is not None and good(message):
                return message
        raise AssertionError(f"no good {names} within {limit_s} s")

    def command(self, number: int, *params: float) -> int:
        """Send a command and return its one result: a second acknowledgement fails."""
        self.c.mav.command_long_send(1, 1, number, 0, *(list(params) + [0.0] * 7)[:7])
        ack = self.until(lambda one: one.command == number, "COMMAND_ACK", limit_s=5.0)
        again = self.c.recv_match(type="COMMAND_ACK", blocking=True, timeout=0.1)
        assert again is None, again
        result: int = ack.result
        return result

    def mode(self, main: int, sub: int = 0) -> None:
        """Wait until the vehicle is in one of PX4's modes."""
        self.until(lambda m: m.get_srcComponent() == 1 and m.custom_mode == main << 16 | sub << 24, "HEARTBEAT")

    def landed(self) -> None:
        """Wait until the motors are off."""
        self.until(lambda m: m.get_srcComponent() == 1 and not m.base_mode & 128, "HEARTBEAT", limit_s=40.0)

    def roll(self, angle_rad: float) -> Any:
        """Send a roll set-point and return the newest ATTITUDE."""
        quat = [math.cos(angle_rad / 2), math.sin(angle_rad / 2), 0.0, 0.0]
        self.c.mav.set_attitude_target_send(0, 1, 1, 7, quat, 0.0, 0.0, 0.0, 0.5)
        return self.until(lambda _: True, "ATTITUDE", limit_s=2.0)

    def parameter(self, name: str) -> Any:
        """Read one parameter's PARAM_VALUE."""
        self.c.mav.param_request_read_send(1, 1, name.encode(), -1)
        return self.until(lambda m: m.param_id == name, "PARAM_VALUE", limit_s=5.0)
