"""MAVSDK-Python 4: position and velocity set-points, sticks, and the commands to go somewhere."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

import pytest
from mavsdk_script import Craft, fly, until
from vehicle_process import VehicleProcess

pytestmark = pytest.mark.client

from mavsdk.asyncio.plugins.manual_control import ManualControlAsync  # noqa: E402
from mavsdk.asyncio.plugins.offboard import OffboardAsync, PositionNedYaw, VelocityNedYaw  # noqa: E402
from mavsdk.plugins.manual_control.manual_control import ManualControlError, ManualControlResult  # noqa: E402

METRES_PER_DEGREE = 111_195.0


@pytest.fixture(scope="module")
def vehicle(sitl: Callable[..., VehicleProcess]) -> VehicleProcess:
    return sitl(speed=3.0)


def speed_m_s(velocity: Any) -> float:
    """How fast it goes, over the ground."""
    return math.hypot(velocity.north_m_s, velocity.east_m_s)


class Sticks:
    """What a pilot's hands hold: x forward, y right, r yaw from -1 to 1, z throttle from 0 to 1."""

    def __init__(self) -> None:
        self.x, self.y, self.z, self.r = 0.0, 0.0, 0.5, 0.0


@asynccontextmanager
async def held(manual: ManualControlAsync) -> AsyncIterator[Sticks]:
    """Send the sticks 25 times a second until the end of the block."""
    sticks = Sticks()

    async def send() -> None:
        while True:
            await manual.set_manual_control_input(sticks.x, sticks.y, sticks.z, sticks.r)
            await asyncio.sleep(0.04)

    task = asyncio.create_task(send())
    try:
        await asyncio.sleep(0.3)
        yield sticks
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


def test_offboard_position_and_velocity(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        offboard, telemetry = OffboardAsync(craft.system), craft.telemetry
        # Set-points come by the wall clock, the time-out is the vehicle's.
        await craft.param.set_param_float("COM_OF_LOSS_T", 5.0)
        await craft.up()
        await offboard.set_position_ned(PositionNedYaw(3.0, -2.0, -6.0, 45.0))
        await asyncio.sleep(0.2)
        await offboard.start()
        await craft.mode("OFFBOARD")
        await until(
            telemetry.subscribe_position_velocity_ned(),
            lambda one: math.dist((one.position.north_m, one.position.east_m, one.position.down_m), (3, -2, -6)) < 0.3,
        )
        await until(telemetry.subscribe_attitude_euler(), lambda one: abs(one.yaw_deg - 45.0) < 3.0)
        await offboard.set_velocity_ned(VelocityNedYaw(0.0, 1.5, 0.0, 0.0))
        await until(
            telemetry.subscribe_velocity_ned(),
            lambda one: abs(one.east_m_s - 1.5) < 0.2 and abs(one.north_m_s) < 0.3 and abs(one.down_m_s) < 0.3,
        )
        await offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
        await until(telemetry.subscribe_velocity_ned(), lambda one: abs(one.east_m_s) < 0.2)
        await offboard.stop()
        await craft.mode("HOLD")
        await craft.down()

    fly(vehicle.port, script, 90)


def test_go_there(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        telemetry = craft.telemetry
        await craft.up()
        home = await until(telemetry.subscribe_home(), lambda one: math.isfinite(one.latitude_deg))
        north = home.latitude_deg + 8.0 / METRES_PER_DEGREE
        await craft.action.goto_location(north, home.longitude_deg, home.absolute_altitude_m + 6.0, 90.0)
        await until(
            telemetry.subscribe_position(),
            lambda one: abs(one.latitude_deg - north) * METRES_PER_DEGREE < 1.0 and one.relative_altitude_m > 5.5,
        )
        await until(telemetry.subscribe_heading(), lambda one: abs(one.heading_deg - 90.0) < 5.0)
        await craft.action.set_current_speed(2.0)
        await craft.down()

    fly(vehicle.port, script, 90)


def test_sticks_in_position_and_altitude(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        manual, telemetry = ManualControlAsync(craft.system), craft.telemetry
        with pytest.raises(ManualControlError) as refused:
            await manual.start_position_control()
        assert refused.value.result == ManualControlResult.INPUT_NOT_SET
        # Sticks come by the wall clock, the time-out is the vehicle's.
        await craft.param.set_param_float("COM_RC_LOSS_T", 5.0)
        await craft.up(5.0)
        async with held(manual) as sticks:
            await manual.start_position_control()
            await craft.mode("POSCTL")
            sticks.x = 0.6
            await until(telemetry.subscribe_velocity_ned(), lambda one: speed_m_s(one) > 1.0)
            sticks.x = 0.0
            await until(telemetry.subscribe_velocity_ned(), lambda one: speed_m_s(one) < 0.3)
            sticks.r = 0.5
            await until(telemetry.subscribe_attitude_angular_velocity_body(), lambda one: one.yaw_rad_s > 0.3)
            sticks.r = 0.0
            await manual.start_altitude_control()
            await craft.mode("ALTCTL")
            sticks.z = 0.9
            await until(telemetry.subscribe_velocity_ned(), lambda one: one.down_m_s < -0.5)
            sticks.z = 0.5
            await until(telemetry.subscribe_velocity_ned(), lambda one: abs(one.down_m_s) < 0.2)
            sticks.y = 0.3
            await until(telemetry.subscribe_attitude_euler(), lambda one: one.roll_deg > 4.0)
            sticks.y = 0.0
            await until(telemetry.subscribe_attitude_euler(), lambda one: abs(one.roll_deg) < 2.0)
        # Nobody holds them any more, and NAV_RCL_ACT sends it home.
        await craft.mode("RETURN_TO_LAUNCH")
        await craft.down()

    fly(vehicle.port, script, 90)
