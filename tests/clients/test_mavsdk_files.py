"""MAVSDK-Python 4: what the vehicle tells about itself and what it keeps: metadata, files, flight logs."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mavsdk_script import Craft, fly, until
from vehicle_process import VehicleProcess

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

from mavsdk.asyncio.plugins.component_metadata import ComponentMetadataAsync  # noqa: E402
from mavsdk.asyncio.plugins.ftp import FtpAsync  # noqa: E402
from mavsdk.asyncio.plugins.log_files import LogFilesAsync  # noqa: E402
from mavsdk.plugins.component_metadata.component_metadata import MetadataType  # noqa: E402
from mavsdk.plugins.ftp.ftp import FtpError, FtpResult  # noqa: E402


@pytest.fixture(scope="module")
def vehicle(sitl: Callable[..., VehicleProcess], tmp_path_factory: pytest.TempPathFactory) -> VehicleProcess:
    return sitl("--log-dir", str(tmp_path_factory.mktemp("logs")), speed=3.0)


async def metadata(craft: Craft, kind: MetadataType) -> Any:
    """The metadata of one kind that the vehicle describes itself by."""
    plugin = ComponentMetadataAsync(craft.system)
    updates = plugin.subscribe_metadata_available()
    first = asyncio.ensure_future(until(updates, lambda one: one.type == kind, 20.0))
    await asyncio.sleep(0.05)
    await plugin.request_autopilot_component()
    return json.loads((await first).json_metadata)


def test_parameter_metadata(vehicle: VehicleProcess) -> None:
    async def script(craft: Craft) -> None:
        described = {one["name"]: one for one in (await metadata(craft, MetadataType.PARAMETER))["parameters"]}
        specs = parameter_specs()
        assert set(described) == set(specs)
        roll = described["MC_ROLL_P"]
        assert roll["type"] == "Float"
        assert roll["default"] == pytest.approx(specs["MC_ROLL_P"].default)
        assert roll["shortDesc"]
        assert described["MAV_SYS_ID"]["type"] == "Int32"

    fly(vehicle.port, script)


def test_files(vehicle: VehicleProcess, tmp_path: Path) -> None:
    async def script(craft: Craft) -> None:
        ftp = FtpAsync(craft.system)
        names = {entry.name for entry in (await ftp.list_directory("/")).entries}
        assert {"etc", "fs"} & names, names
        extras = {entry.name: entry for entry in (await ftp.list_directory("/etc/extras")).entries}
        general = next(name for name in extras if name.startswith("component_general"))
        for burst in (False, True):
            folder = tmp_path / str(burst)
            folder.mkdir()
            async for _ in ftp.download(f"/etc/extras/{general}", str(folder), burst):
                pass
            assert (folder / general).stat().st_size == extras[general].size_bytes
            assert await ftp.are_files_identical(str(folder / general), f"/etc/extras/{general}")
        with pytest.raises(FtpError) as missing:
            async for _ in ftp.download("/etc/extras/nothing.txt", str(tmp_path), True):
                pass
        assert missing.value.result == FtpResult.FILE_DOES_NOT_EXIST

    fly(vehicle.port, script)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_flight_log_for_pyulog(vehicle: VehicleProcess, tmp_path: Path) -> None:
    pyulog = pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"

    async def script(craft: Craft) -> None:
        logs = LogFilesAsync(craft.system)
        await craft.param.set_param_float("MC_ROLL_P", 6.25)
        await craft.up(3.0)
        await craft.down()
        await craft.param.set_param_float("MC_ROLL_P", parameter_specs()["MC_ROLL_P"].default)
        entries = await logs.get_entries()
        assert len(entries) == 1
        assert entries[0].date.startswith("20")
        progress = [step.progress async for _, step in logs.download_log_file(entries[0], str(path))]
        assert progress == sorted(progress)
        assert progress[-1] == pytest.approx(1.0)
        assert path.stat().st_size == entries[0].size_bytes

    fly(vehicle.port, script, 90)
    log = pyulog.ULog(str(path))
    assert not log.file_corruption
    assert log.initial_parameters["MC_ROLL_P"] == pytest.approx(parameter_specs()["MC_ROLL_P"].default)
    assert 6.25 in [value for _, name, value in log.changed_parameters if name == "MC_ROLL_P"]
    height = -log.get_dataset("vehicle_local_position").data["z"]
    assert height.max() == pytest.approx(3.0, abs=0.6)
    assert {one.name for one in log.data_list} >= {
        "vehicle_attitude",
        "vehicle_attitude_setpoint",
        "vehicle_rates_setpoint",
        "vehicle_angular_velocity",
        "rate_ctrl_status",
        "vehicle_status",
        "actuator_motors",
    }
