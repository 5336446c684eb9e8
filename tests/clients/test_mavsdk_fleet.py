"""Several vehicles in one process, and several stations at one vehicle."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

import pytest
from mavsdk_script import connected, until, within
from mavutil_script import open_station
from vehicle_process import VehicleProcess, free_port

pytestmark = pytest.mark.client

ONBOARD_COMPUTER = 191

from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync  # noqa: E402
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkMessage  # noqa: E402


def test_two_vehicles_and_a_mavsdk_for_each(sitl: Callable[..., VehicleProcess]) -> None:
    port = sitl("ant-x", "ant-r", "--instance", "0", speed=3.0, count=2).port

    async def script() -> None:
        async with connected(port) as first, connected(port + 1) as second:
            assert await first.system.get_system_id() == 1
            assert await second.system.get_system_id() == 2
            assert await second.param.get_param_int("MAV_SYS_ID") == 2
            await first.param.set_param_float("MC_ROLL_P", 5.5)
            assert await second.param.get_param_float("MC_ROLL_P") != pytest.approx(5.5)
            await asyncio.gather(first.ready(), second.ready())
            await second.up(3.0)
            low = await until(first.telemetry.subscribe_position(), lambda _: True)
            assert low.relative_altitude_m < 0.5
            assert not await until(first.telemetry.subscribe_armed(), lambda _: True)
            await first.up(3.0)
            await asyncio.gather(first.down(), second.down())

    within(90, script)


def test_stations_on_two_links_hear_each_other(sitl: Callable[..., VehicleProcess]) -> None:
    other = free_port()
    vehicle = sitl("--link", f"udpout://127.0.0.1:{other}#gcs")
    station = open_station(other, system=77, component=ONBOARD_COMPUTER)

    async def script() -> None:
        async with connected(vehicle.port) as craft:
            # It has nobody to speak to before the vehicle has spoken.
            assert await asyncio.to_thread(station.wait_heartbeat, timeout=10) is not None
            other = await _system(craft.sdk, station, 77)
            direct = MavlinkDirectAsync(other)
            heard = asyncio.ensure_future(until(direct.subscribe_message("STATUSTEXT"), lambda _: True, 15.0))
            pinged = asyncio.ensure_future(asyncio.to_thread(_pinged_by, station))
            for _ in range(100):
                station.mav.statustext_send(6, b"good morning")
                await direct.send_message(_ping(77))
                await asyncio.sleep(0.1)
                if heard.done() and pinged.done():
                    break
            text = await heard
            assert text.system_id == 77
            assert json.loads(text.fields_json)["text"] == "good morning"
            assert await pinged == 245

    try:
        within(40, script)
    finally:
        station.close()


def _ping(system: int) -> MavlinkMessage:
    fields = {"time_usec": 1, "seq": 7, "target_system": system, "target_component": 0}
    return MavlinkMessage("PING", 245, 190, system, 0, json.dumps(fields))


async def _system(sdk: Any, station: Any, number: int) -> Any:
    """A system that MAVSDK hears, once it has seen its heartbeats."""
    for _ in range(100):
        station.mav.heartbeat_send(18, 8, 0, 0, 4)
        await asyncio.sleep(0.1)
        for system in await sdk.get_systems():
            if await system.get_system_id() == number:
                return system
    raise AssertionError(f"system {number} was never heard")


def _pinged_by(station: Any) -> int:
    """The system that pings this station within 10 s; 0 for none."""
    message = station.recv_match(
        type="PING", condition="PING.get_srcSystem()!=1 and PING.target_system==77", blocking=True, timeout=10
    )
    return 0 if message is None else int(message.get_srcSystem())
