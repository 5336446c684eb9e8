"""MAVSDK-Python 4 as a companion computer's script uses it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

mavsdk = pytest.importorskip("mavsdk.asyncio")

from mavsdk.asyncio.plugins.action import ActionAsync  # noqa: E402
from mavsdk.asyncio.plugins.info import InfoAsync  # noqa: E402
from mavsdk.asyncio.plugins.offboard import (  # noqa: E402
    Attitude,
    AttitudeRate,
    OffboardAsync,
    PositionNedYaw,
)
from mavsdk.asyncio.plugins.param import ParamAsync  # noqa: E402
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync  # noqa: E402
from mavsdk.plugins.action.action import ActionError, ActionResult  # noqa: E402
from mavsdk.plugins.offboard.offboard import OffboardError, OffboardResult  # noqa: E402
from mavsdk.plugins.param.param import ParamError, ParamResult  # noqa: E402


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[Any]:
    """The vehicle that speaks to a port, as MAVSDK sees it."""
    configuration = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
    async with mavsdk.Mavsdk(configuration) as sdk:
        await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await sdk.first_autopilot(timeout_s=30)
        assert system is not None
        yield system


def within(limit_s: float, script: Callable[[], Awaitable[None]]) -> None:
    """Run a script that may take so long."""
    asyncio.run(asyncio.wait_for(script(), limit_s))  # type: ignore[arg-type]


async def until(stream: Any, good: Callable[[Any], bool]) -> Any:
    """Return the first good item of a telemetry stream."""
    async for item in stream:
        if good(item):
            return item
    raise AssertionError("the stream ended")


def test_parameters(serve: Callable[..., int]) -> None:
    async def script() -> None:
        async with connected(serve(mode="onboard")) as system:
            param = ParamAsync(system)
            await param.set_param_float("MC_ROLLRATE_P", 0.16)
            assert await param.get_param_float("MC_ROLLRATE_P") == pytest.approx(0.16)
            await param.set_param_float("MC_ROLLRATE_P", 7.77)  # beyond PX4's range: taken, not clamped
            assert await param.get_param_float("MC_ROLLRATE_P") == pytest.approx(7.77)
            await param.set_param_int("COM_OBL_RC_ACT", 5)
            assert await param.get_param_int("COM_OBL_RC_ACT") == 5
            for attempt, result in (
                (param.get_param_float("NO_SUCH_PARAM"), ParamResult.DOES_NOT_EXIST),
                (param.set_param_float("NO_SUCH_PARAM", 1.0), ParamResult.DOES_NOT_EXIST),
                (param.set_param_int("MC_ROLLRATE_P", 1), ParamResult.TYPE_MISMATCH),
            ):
                with pytest.raises(ParamError) as refused:
                    await attempt
                assert refused.value.result in (result, ParamResult.WRONG_TYPE)
            everything = await param.get_all_params()
            names = {one.name for one in [*everything.int_params, *everything.float_params]}
            assert names == set(parameter_specs())

    within(60, script)


def test_ready_and_rates(serve: Callable[..., int]) -> None:
    async def script() -> None:
        async with connected(serve(mode="onboard")) as system:
            telemetry = TelemetryAsync(system)
            assert await until(telemetry.subscribe_health_all_ok(), bool)
            health = await until(telemetry.subscribe_health(), lambda one: one.is_armable)
            assert health.is_home_position_ok
            assert health.is_global_position_ok
            assert health.is_gyrometer_calibration_ok
            version = await InfoAsync(system).get_version()
            assert (version.flight_sw_major, version.flight_sw_minor) == (1, 17)

            await telemetry.set_rate_attitude_euler(20.0)
            await telemetry.set_rate_attitude_quaternion(25.0)
            stamps: list[int] = []

            def enough(attitude: Any) -> bool:
                stamps.append(attitude.timestamp_us)
                return len(stamps) == 60

            await until(telemetry.subscribe_attitude_quaternion(), enough)
            assert (stamps[-1] - stamps[10]) / 49 == pytest.approx(1e6 / 25, rel=0.05)

    within(60, script)


def test_a_flight(serve: Callable[..., int]) -> None:
    async def script() -> None:
        async with connected(serve(speed=2.0, mode="onboard")) as system:
            telemetry, action, offboard = TelemetryAsync(system), ActionAsync(system), OffboardAsync(system)
            await until(telemetry.subscribe_health_all_ok(), bool)
            await until(telemetry.subscribe_health(), lambda one: one.is_armable)

            with pytest.raises(OffboardError) as refused:
                await offboard.start()
            assert refused.value.result == OffboardResult.NO_SETPOINT_SET

            await action.set_takeoff_altitude(5.0)
            await action.arm()
            await action.takeoff()
            await until(telemetry.subscribe_position(), lambda one: one.relative_altitude_m > 4.5)
            await until(telemetry.subscribe_flight_mode(), lambda one: "HOLD" in str(one.name))
            assert await until(telemetry.subscribe_in_air(), bool)
            await action.hold()

            await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.5))
            await asyncio.sleep(0.3)
            await offboard.start()
            assert await offboard.is_active()
            await offboard.set_attitude(Attitude(8.0, 0.0, 0.0, 0.5))
            await until(telemetry.subscribe_attitude_euler(), lambda one: abs(one.roll_deg - 8.0) < 2.0)
            await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.5))
            await until(telemetry.subscribe_attitude_euler(), lambda one: abs(one.roll_deg) < 2.0)
            await offboard.set_attitude_rate(AttitudeRate(0.0, 0.0, 20.0, 0.5))
            await until(
                telemetry.subscribe_attitude_angular_velocity_body(),
                lambda one: abs(math.degrees(one.yaw_rad_s) - 20.0) < 5.0,
            )
            await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.5))
            await offboard.stop()

            await offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -5.0, 0.0))
            with pytest.raises(ActionError) as unflown:
                await action.return_to_launch()
            assert unflown.value.result == ActionResult.COMMAND_DENIED

            with pytest.raises(ActionError):
                await action.disarm()  # not in the air
            await action.land()
            await until(telemetry.subscribe_armed(), lambda armed: not armed)

    within(120, script)


def test_disarm_on_the_ground(serve: Callable[..., int]) -> None:
    async def script() -> None:
        async with connected(serve(mode="onboard")) as system:
            telemetry, action = TelemetryAsync(system), ActionAsync(system)
            await until(telemetry.subscribe_health(), lambda one: one.is_armable)
            await action.arm()
            assert await until(telemetry.subscribe_armed(), bool)
            await action.disarm()
            await until(telemetry.subscribe_armed(), lambda armed: not armed)

    within(60, script)
