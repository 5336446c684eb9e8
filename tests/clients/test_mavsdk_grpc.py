"""The older generation of MAVSDK-Python: a mavsdk_server process behind gRPC."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from mavsdk_script import until, within
from vehicle_process import VehicleProcess

from sitl.parameters import parameter_specs

# It finds its server by a part of importlib that is on its way out.
pytestmark = [pytest.mark.client, pytest.mark.filterwarnings("ignore:path is deprecated:DeprecationWarning")]

mavsdk_grpc = pytest.importorskip("mavsdk_grpc")

from mavsdk_grpc.action import ActionError  # noqa: E402
from mavsdk_grpc.mission import MissionItem, MissionPlan  # noqa: E402
from mavsdk_grpc.offboard import Attitude, OffboardError, PositionNedYaw  # noqa: E402
from mavsdk_grpc.param import ParamError  # noqa: E402

METRES_PER_DEGREE = 111_195.0


@pytest.fixture(scope="module")
def vehicle(sitl: Callable[..., VehicleProcess]) -> VehicleProcess:
    return sitl(speed=3.0)


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[Any]:
    """The vehicle that speaks to a port, through a mavsdk_server of its own."""
    with socket.socket() as probe:
        # A server that a test left behind would share gRPC's usual port, silently.
        probe.bind(("127.0.0.1", 0))
        grpc_port = probe.getsockname()[1]
    system = mavsdk_grpc.System(port=grpc_port)
    try:
        await asyncio.wait_for(system.connect(system_address=f"udpin://127.0.0.1:{port}"), 30)
        await until(system.core.connection_state(), lambda state: state.is_connected)
        yield system
    finally:
        # Nothing else ends the server.
        system._stop_mavsdk_server()


async def ready(system: Any) -> None:
    await until(system.telemetry.health_all_ok(), bool)
    await until(system.telemetry.health(), lambda one: one.is_armable)


def test_parameters(vehicle: VehicleProcess) -> None:
    async def script() -> None:
        async with connected(vehicle.port) as system:
            param = system.param
            await param.set_param_float("MC_PITCH_P", 5.75)
            assert await param.get_param_float("MC_PITCH_P") == pytest.approx(5.75)
            await param.set_param_int("COM_OBL_RC_ACT", 5)
            assert await param.get_param_int("COM_OBL_RC_ACT") == 5
            with pytest.raises(ParamError):
                await param.get_param_float("NO_SUCH_PARAM")
            everything = await param.get_all_params()
            names = {one.name for one in [*everything.int_params, *everything.float_params]}
            assert names == set(parameter_specs())
            for name in ("MC_PITCH_P", "COM_OBL_RC_ACT"):
                default = parameter_specs()[name].default
                await (param.set_param_float if name == "MC_PITCH_P" else param.set_param_int)(name, default)
            version = await system.info.get_version()
            assert version.flight_sw_major == 1

    within(60, script)


def test_a_flight(vehicle: VehicleProcess) -> None:
    async def script() -> None:
        async with connected(vehicle.port) as system:
            telemetry, action, offboard, mission = system.telemetry, system.action, system.offboard, system.mission
            await ready(system)
            # Set-points come by the wall clock, the time-out is the vehicle's.
            await system.param.set_param_float("COM_OF_LOSS_T", 5.0)
            with pytest.raises(OffboardError):
                await offboard.start()
            await action.set_takeoff_altitude(5.0)
            await action.arm()
            await action.takeoff()
            await until(telemetry.position(), lambda one: one.relative_altitude_m > 4.5)
            await until(telemetry.flight_mode(), lambda one: one.name == "HOLD")

            await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.5))
            await offboard.start()
            await offboard.set_attitude(Attitude(-8.0, 0.0, 0.0, 0.5))
            await until(telemetry.attitude_euler(), lambda one: abs(one.roll_deg + 8.0) < 1.5)
            await offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -6.0, 0.0))
            await until(telemetry.position_velocity_ned(), lambda one: abs(one.position.down_m + 6.0) < 0.4)
            await offboard.stop()
            await until(telemetry.flight_mode(), lambda one: one.name == "HOLD")

            home = await until(telemetry.home(), lambda _: True)
            await mission.upload_mission(MissionPlan([item(home, 0.0), item(home, 8.0)]))
            assert len((await mission.download_mission()).mission_items) == 2
            await mission.start_mission()
            await until(mission.mission_progress(), lambda one: one.current == one.total == 2)
            assert await mission.is_mission_finished()

            with pytest.raises(ActionError):
                await action.disarm()  # not in the air
            await action.land()
            await until(telemetry.armed(), lambda armed: not armed)
            await mission.clear_mission()

    within(90, script)


def item(home: Any, north_m: float) -> MissionItem:
    """A waypoint north of home."""
    nan = float("nan")
    return MissionItem(
        home.latitude_deg + north_m / METRES_PER_DEGREE,
        home.longitude_deg,
        6.0,
        nan,
        True,
        nan,
        nan,
        MissionItem.CameraAction.NONE,
        nan,
        nan,
        nan,
        nan,
        nan,
        MissionItem.VehicleAction.NONE,
    )
