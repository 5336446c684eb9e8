"""Scripts as people write them with pymavlink's mavutil."""

from __future__ import annotations

import math
import os
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

INT32, REAL32 = 6, 9
NAN = math.nan


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
        again = self.c.recv_match(type="COMMAND_ACK", blocking=True, timeout=0.3)
        assert again is None, again
        result: int = ack.result
        return result

    def roll(self, angle_rad: float) -> Any:
        """Send a roll set-point and return the newest ATTITUDE."""
        quat = [math.cos(angle_rad / 2), math.sin(angle_rad / 2), 0.0, 0.0]
        self.c.mav.set_attitude_target_send(0, 1, 1, 7, quat, 0.0, 0.0, 0.0, 0.5)
        return self.until(lambda _: True, "ATTITUDE", limit_s=2.0)


@pytest.fixture
def script(serve: Callable[..., int], monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Script]]:
    monkeypatch.setitem(os.environ, "MAVLINK20", "1")
    from pymavlink import mavutil

    opened: list[Any] = []

    def connect(speed: float = 1.0) -> Script:
        connection = mavutil.mavlink_connection(f"udpin:127.0.0.1:{serve(speed=speed)}", source_system=255)
        opened.append(connection)
        assert connection.wait_heartbeat(timeout=30) is not None
        return Script(connection)

    yield connect
    for connection in opened:
        connection.close()


def test_all_parameters(script: Callable[..., Script]) -> None:
    c = script().c
    c.mav.param_request_list_send(1, 1)
    seen: dict[str, Any] = {}
    end = time.monotonic() + 20
    while len(seen) < len(parameter_specs()) and time.monotonic() < end:
        message = c.recv_match(type="PARAM_VALUE", blocking=True, timeout=1)
        if message is not None and message.param_index != 65535:
            seen[message.param_id] = message
    specs = parameter_specs()
    assert set(seen) == set(specs)
    assert {message.param_count for message in seen.values()} == {len(specs)}
    assert seen["MC_ROLL_P"].param_value == pytest.approx(specs["MC_ROLL_P"].default)
    assert struct.unpack("<i", struct.pack("<f", seen["MAV_SYS_ID"].param_value)) == (1,)


def test_parameter_set_by_mavparm(script: Callable[..., Script]) -> None:
    from pymavlink import mavparm

    c = script().c
    assert mavparm.MAVParmDict().mavset(c, "MC_ROLL_P", 7.5, retries=3, parm_type=REAL32)
    assert mavparm.MAVParmDict().mavset(c, "COM_OBL_RC_ACT", 5, retries=3, parm_type=INT32)
    c.mav.param_request_read_send(1, 1, b"COM_OBL_RC_ACT", -1)
    message = c.recv_match(
        type="PARAM_VALUE", condition="PARAM_VALUE.param_id=='COM_OBL_RC_ACT'", blocking=True, timeout=5
    )
    assert struct.unpack("<i", struct.pack("<f", message.param_value)) == (5,)


@pytest.mark.parametrize("hz", [250, 100, 40])
def test_the_rate_asked_for_arrives(script: Callable[..., Script], hz: int) -> None:
    one = script()
    assert one.command(511, 30, 1e6 / hz) == 0
    interval = one.command(510, 30)
    assert interval == 0
    stamps = [one.c.recv_match(type="ATTITUDE", blocking=True, timeout=2).time_boot_ms for _ in range(hz)]
    # In vehicle time: the computer may be as slow as it likes.
    assert (stamps[-1] - stamps[0]) / (hz - 1) == pytest.approx(1000 / hz, rel=0.02)


def test_a_flight_with_a_roll_step(script: Callable[..., Script]) -> None:
    one = script(speed=3.0)
    one.until(lambda m: m.onboard_control_sensors_health & 0x10000000, "SYS_STATUS")
    assert one.command(176, 1, 1) == 1  # Manual is not flown here
    assert one.command(400, 1) == 0
    assert one.command(22, 0, 0, 0, NAN, NAN, NAN, 488.0 + 5.0) == 0
    one.until(lambda m: m.relative_alt > 4500, "GLOBAL_POSITION_INT")
    one.until(lambda m: m.custom_mode == 0x03040000, "HEARTBEAT")
    for _ in range(40):
        one.roll(0.0)
    assert one.command(176, 1, 6) == 0
    for _ in range(25):
        before = one.roll(0.0).roll
    rolls = [one.roll(0.2).roll for _ in range(30)]
    assert abs(before) < 0.05
    assert rolls[-1] == pytest.approx(0.2, abs=0.06)
    target = one.until(lambda m: m.q[1] > 0.05, "ATTITUDE_TARGET", limit_s=3.0)
    assert target.q[1] == pytest.approx(math.sin(0.1), abs=1e-4)
    assert one.command(21) == 0
    one.until(lambda m: not m.base_mode & 128, "HEARTBEAT", limit_s=40.0)


def test_set_mode_by_mavutil(script: Callable[..., Script]) -> None:
    one = script()
    one.c.set_mode("LAND")
    assert one.until(lambda m: m.command == 176, "COMMAND_ACK", limit_s=5.0).result == 0
    one.until(lambda m: m.custom_mode == 0x06040000, "HEARTBEAT", limit_s=5.0)
