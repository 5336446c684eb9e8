"""MAVSDK-Python 4: missions up, down and flown; fence and rally points."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from mavsdk_script import Craft, fly, until
from vehicle_process import VehicleProcess

pytestmark = pytest.mark.client

from mavsdk.asyncio.plugins.mission import MissionAsync  # noqa: E402
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync  # noqa: E402
from mavsdk.plugins.mission.mission import MissionError, MissionItem, MissionPlan, MissionResult  # noqa: E402
from mavsdk.plugins.mission_raw.mission_raw import MissionItem as RawItem  # noqa: E402
from mavsdk.plugins.mission_raw.mission_raw import MissionRawError, MissionRawResult  # noqa: E402

METRES_PER_DEGREE = 111_195.0
WAYPOINT, LAND, TAKEOFF = 16, 21, 22


@pytest.fixture(scope="module")
def vehicle(sitl: Callable[..., VehicleProcess]) -> VehicleProcess:
    return sitl(speed=4.0)


async def home(craft: Craft) -> Any:
    return await until(craft.telemetry.subscribe_home(), lambda one: math.isfinite(one.latitude_deg))


def waypoint(start: Any, north_m: float, east_m: float, altitude_m: float) -> MissionItem:
    """A waypoint that far from a place."""
    east_per_degree = METRES_PER_DEGREE * math.cos(math.radians(start.latitude_deg))
    return MissionItem(
        latitude_deg=start.latitude_deg + north_m / METRES_PER_DEGREE,
        longitude_deg=start.longitude_deg + east_m / east_per_degree,
        relative_altitude_m=altitude_m,
        is_fly_through=True,
    )


def raw(seq: int, command: int, start: Any, *, mission_type: int = 0, altitude_m: float = 5.0) -> RawItem:
    """A mission item as it is on the wire, at a place."""
    return RawItem(
        seq=seq,
        frame=6,
        command=command,
        current=int(seq == 0),
        autocontinue=1,
        param1=0.0,
        param2=0.0,
        param3=0.0,
        param4=math.nan,
        x=round(start.latitude_deg * 1e7),
        y=round(start.longitude_deg * 1e7),
        z=altitude_m,
        mission_type=mission_type,
    )


def test_a_mission_comes_back_as_it_went_up(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        mission = MissionAsync(craft.system)
        start = await home(craft)
        corners = [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)]
        plan = MissionPlan([waypoint(start, north, east, 5.0 + north) for north, east in corners])
        await mission.upload_mission(plan)
        stored = (await mission.download_mission()).mission_items
        assert len(stored) == len(corners)
        for item, sent in zip(stored, plan.mission_items, strict=True):
            assert item.latitude_deg == pytest.approx(sent.latitude_deg, abs=1e-7)
            assert item.longitude_deg == pytest.approx(sent.longitude_deg, abs=1e-7)
            assert item.relative_altitude_m == sent.relative_altitude_m
        await mission.clear_mission()
        assert (await mission.download_mission()).mission_items == []
        with pytest.raises(MissionError) as refused:
            await mission.upload_mission(MissionPlan([]))
        assert refused.value.result == MissionResult.NO_MISSION_AVAILABLE

    fly(vehicle.port, script)


def test_a_long_mission(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        mission = MissionRawAsync(craft.system)
        start = await home(craft)
        sent = [raw(seq, WAYPOINT, start, altitude_m=5.0 + seq) for seq in range(150)]
        await mission.upload_mission(sent)
        stored = await mission.download_mission()
        assert [(one.seq, one.command, one.x, one.y, one.z) for one in stored] == [
            (one.seq, one.command, one.x, one.y, one.z) for one in sent
        ]
        await mission.clear_mission()

    fly(vehicle.port, script)


def test_an_item_nobody_can_fly_is_refused(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        mission = MissionRawAsync(craft.system)
        start = await home(craft)
        with pytest.raises(MissionRawError) as refused:
            await mission.upload_mission([raw(0, WAYPOINT, start), raw(1, 60_000, start)])
        assert refused.value.result == MissionRawResult.UNSUPPORTED
        # What was there before is there still: nothing.
        assert await mission.download_mission() == []

    fly(vehicle.port, script)


def test_no_fence_and_no_rally_points(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        mission = MissionRawAsync(craft.system)
        assert await mission.download_geofence() == []
        assert await mission.download_rallypoints() == []

    fly(vehicle.port, script)


def test_a_mission_is_flown(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        mission, telemetry = MissionAsync(craft.system), craft.telemetry
        await craft.ready()
        start = await home(craft)
        corners = [(0.0, 0.0), (12.0, 0.0), (12.0, 8.0)]
        await mission.upload_mission(MissionPlan([waypoint(start, *corner, 6.0) for corner in corners]))
        await craft.action.arm()
        await mission.start_mission()
        await craft.mode("MISSION")
        seen: list[int] = []

        def done(progress: Any) -> bool:
            assert progress.total == len(corners)
            seen.append(progress.current)
            return bool(progress.current == progress.total)

        await until(mission.subscribe_mission_progress(), done)
        assert seen == sorted(seen)
        assert set(seen) >= {1, 2, 3}
        assert await mission.is_mission_finished()
        place = await until(telemetry.subscribe_position_velocity_ned(), lambda _: True)
        assert place.position.north_m == pytest.approx(12.0, abs=3.0)
        assert place.position.east_m == pytest.approx(8.0, abs=3.0)
        assert -place.position.down_m == pytest.approx(6.0, abs=1.5)
        await craft.down()
        await mission.clear_mission()

    fly(vehicle.port, script, 90)


def test_a_mission_from_take_off_to_landing(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        mission = MissionRawAsync(craft.system)
        await craft.ready()
        start = await home(craft)
        place = await until(craft.telemetry.subscribe_position(), lambda _: True)
        await mission.upload_mission(
            [raw(0, TAKEOFF, place), raw(1, WAYPOINT, start), raw(2, LAND, start, altitude_m=0.0)]
        )
        await craft.action.arm()
        await mission.start_mission()
        await until(craft.telemetry.subscribe_position(), lambda one: one.relative_altitude_m > 4.0)
        await craft.disarmed()
        await mission.clear_mission()
        # In Mission without a mission it is not ready to arm.
        await until(craft.telemetry.subscribe_health(), lambda one: not one.is_armable)
        await craft.action.hold()
        await craft.ready()

    fly(vehicle.port, script, 90)


def test_pause_and_return(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        mission = MissionAsync(craft.system)
        await craft.action.set_return_to_launch_altitude(6.0)
        await craft.up()
        start = await home(craft)
        await mission.upload_mission(MissionPlan([waypoint(start, 6.0, 0.0, 5.0), waypoint(start, 40.0, 0.0, 5.0)]))
        await mission.start_mission()
        await until(mission.subscribe_mission_progress(), lambda one: one.current == 1)
        await mission.pause_mission()
        await craft.mode("HOLD")
        await craft.action.return_to_launch()
        await craft.mode("RETURN_TO_LAUNCH")
        await craft.disarmed()
        place = await until(craft.telemetry.subscribe_position_velocity_ned(), lambda _: True)
        assert math.hypot(place.position.north_m, place.position.east_m) < 2.0
        await mission.clear_mission()

    fly(vehicle.port, script, 90)
