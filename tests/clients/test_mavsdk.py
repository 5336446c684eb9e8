"""MAVSDK-Python 4: connect, parameters, rates, a flight with an offboard attitude step."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

import pytest
from mavsdk_script import Craft, fly, until
from vehicle_process import VehicleProcess

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

from mavsdk.asyncio.plugins.info import InfoAsync  # noqa: E402
from mavsdk.asyncio.plugins.offboard import Attitude, AttitudeRate, OffboardAsync  # noqa: E402
from mavsdk.plugins.action.action import ActionError, ActionResult  # noqa: E402
from mavsdk.plugins.offboard.offboard import OffboardError, OffboardResult  # noqa: E402
from mavsdk.plugins.param.param import ParamError, ParamResult  # noqa: E402


@pytest.fixture(scope="module")
def vehicle(sitl: Callable[..., VehicleProcess]) -> VehicleProcess:
    return sitl(speed=3.0)


def test_parameters(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        param = craft.param
        before = await param.get_param_float("MC_ROLLRATE_P")
        await param.set_param_float("MC_ROLLRATE_P", 0.16)
        assert await param.get_param_float("MC_ROLLRATE_P") == pytest.approx(0.16)
        await param.set_param_float("MC_ROLLRATE_P", 7.77)  # beyond PX4's range: taken, not clamped
        assert await param.get_param_float("MC_ROLLRATE_P") == pytest.approx(7.77)
        await param.set_param_float("MC_ROLLRATE_P", before)
        await param.set_param_int("COM_OBL_RC_ACT", 5)
        assert await param.get_param_int("COM_OBL_RC_ACT") == 5
        await param.set_param_int("COM_OBL_RC_ACT", parameter_specs()["COM_OBL_RC_ACT"].default)
        for attempt, result in (
            (param.get_param_float("NO_SUCH_PARAM"), ParamResult.DOES_NOT_EXIST),
            (param.set_param_float("NO_SUCH_PARAM", 1.0), ParamResult.DOES_NOT_EXIST),
            (param.set_param_int("MC_ROLLRATE_P", 1), ParamResult.TYPE_MISMATCH),
        ):
            with pytest.raises(ParamError) as refused:
                await attempt
            assert refused.value.result in (result, ParamResult.WRONG_TYPE)

    fly(vehicle.port, script)


def test_all_parameters(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        everything = await craft.param.get_all_params()
        specs = parameter_specs()
        floats = {one.name: one.value for one in everything.float_params}
        ints = {one.name: one.value for one in everything.int_params}
        assert set(floats) | set(ints) == set(specs)
        assert not set(floats) & set(ints)
        assert floats["MC_ROLL_P"] == pytest.approx(specs["MC_ROLL_P"].default)
        assert ints["MAV_SYS_ID"] == 1

    fly(vehicle.port, script)


def test_ready_and_rates(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        telemetry = craft.telemetry
        await craft.ready()
        health = await until(telemetry.subscribe_health(), lambda one: one.is_armable)
        assert health.is_home_position_ok
        assert health.is_global_position_ok
        assert health.is_local_position_ok
        assert health.is_gyrometer_calibration_ok
        assert health.is_accelerometer_calibration_ok
        assert health.is_magnetometer_calibration_ok
        version = await InfoAsync(craft.system).get_version()
        assert (version.flight_sw_major, version.flight_sw_minor) == (1, 17)

        await telemetry.set_rate_attitude_euler(20.0)
        await telemetry.set_rate_attitude_quaternion(25.0)
        stamps: list[int] = []

        def enough(attitude: Any) -> bool:
            stamps.append(attitude.timestamp_us)
            return len(stamps) == 60

        await until(telemetry.subscribe_attitude_quaternion(), enough)
        # In vehicle time: the computer may be as slow as it likes.
        assert (stamps[-1] - stamps[10]) / 49 == pytest.approx(1e6 / 25, rel=0.05)

    fly(vehicle.port, script)


def test_a_flight_with_an_attitude_step(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        telemetry, action, offboard = craft.telemetry, craft.action, OffboardAsync(craft.system)
        # Set-points come by the wall clock, the time-out is the vehicle's.
        await craft.param.set_param_float("COM_OF_LOSS_T", 5.0)
        await craft.ready()
        with pytest.raises(OffboardError) as refused:
            await offboard.start()
        assert refused.value.result == OffboardResult.NO_SETPOINT_SET

        await craft.up(8.0)
        assert await until(telemetry.subscribe_in_air(), bool)
        await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.5))
        await asyncio.sleep(0.2)
        await offboard.start()
        assert await offboard.is_active()
        await craft.mode("OFFBOARD")
        await offboard.set_attitude(Attitude(8.0, 0.0, 0.0, 0.5))
        await until(telemetry.subscribe_attitude_euler(), lambda one: abs(one.roll_deg - 8.0) < 1.0)
        await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.5))
        await until(telemetry.subscribe_attitude_euler(), lambda one: abs(one.roll_deg) < 1.0)
        await offboard.set_attitude_rate(AttitudeRate(0.0, 0.0, 20.0, 0.5))
        await until(
            telemetry.subscribe_attitude_angular_velocity_body(),
            lambda one: abs(math.degrees(one.yaw_rad_s) - 20.0) < 3.0,
        )
        await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.5))
        await offboard.stop()
        await craft.mode("HOLD")

        with pytest.raises(ActionError) as denied:
            await action.disarm()  # not in the air
        assert denied.value.result in (ActionResult.COMMAND_DENIED, ActionResult.COMMAND_DENIED_NOT_LANDED)
        await craft.down()

    fly(vehicle.port, script, 90)


def test_disarm_on_the_ground(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        await craft.ready()
        await craft.action.arm()
        assert await until(craft.telemetry.subscribe_armed(), bool)
        await craft.action.disarm()
        await craft.disarmed()

    fly(vehicle.port, script)
