"""A network that loses a tenth of the datagrams each way: what clients repeat must work all the same."""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from mavproxy_console import Console
from mavsdk_script import Craft, fly, until
from mavutil_script import REAL32, open_station
from vehicle_process import VehicleProcess, free_port

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

from mavsdk.asyncio.plugins.ftp import FtpAsync  # noqa: E402
from mavsdk.asyncio.plugins.log_files import LogFilesAsync  # noqa: E402
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync  # noqa: E402
from mavsdk.plugins.mission_raw.mission_raw import MissionItem  # noqa: E402

Start = Callable[..., int]


@pytest.fixture
def port(sitl: Callable[..., VehicleProcess], relay: Start, tmp_path: Path) -> int:
    """Where a client hears a vehicle through a bad network; the vehicle keeps logs."""
    client_port = free_port()
    sitl("--log-dir", str(tmp_path), "--link", f"udpout://127.0.0.1:{relay(client_port)}#onboard", speed=2.0)
    return client_port


def test_mavsdk(port: int, tmp_path: Path) -> None:
    async def script(craft: Craft) -> None:
        param = craft.param
        for value in (0.11, 0.12, 0.13, 0.14, 0.15):
            await param.set_param_float("MC_ROLLRATE_P", value)
            assert await param.get_param_float("MC_ROLLRATE_P") == pytest.approx(value)
        everything = await param.get_all_params()
        names = {one.name for one in [*everything.int_params, *everything.float_params]}
        assert names == set(parameter_specs())

        home = await until(craft.telemetry.subscribe_home(), lambda one: math.isfinite(one.latitude_deg))
        place = round(home.latitude_deg * 1e7), round(home.longitude_deg * 1e7)
        items = [
            MissionItem(number, 6, 16, int(number == 0), 1, 0.0, 0.0, 0.0, math.nan, *place, 5.0 + number, 0)
            for number in range(12)
        ]
        mission = MissionRawAsync(craft.system)
        await mission.upload_mission(items)
        assert [one.z for one in await mission.download_mission()] == [one.z for one in items]

        ftp = FtpAsync(craft.system)
        name = next(
            entry.name
            for entry in (await ftp.list_directory("/etc/extras")).entries
            if entry.name.startswith("parameters")
        )
        for burst in (False, True):
            folder = tmp_path / f"burst-{burst}"
            folder.mkdir()
            async for _ in ftp.download(f"/etc/extras/{name}", str(folder), burst):
                pass
            assert await ftp.are_files_identical(str(folder / name), f"/etc/extras/{name}")

        await craft.ready()
        await craft.action.arm()
        await asyncio.sleep(0.5)
        await craft.action.disarm()
        await craft.disarmed()
        logs = LogFilesAsync(craft.system)
        entries = await logs.get_entries()
        assert len(entries) == 1
        async for _ in logs.download_log_file(entries[0], str(tmp_path / "flight.ulg")):
            pass
        assert (tmp_path / "flight.ulg").stat().st_size == entries[0].size_bytes
        assert (tmp_path / "flight.ulg").read_bytes() == next(
            path.read_bytes() for path in tmp_path.rglob("*.ulg") if path.name != "flight.ulg"
        )

    fly(port, script, 90)


def test_pymavlink(port: int, tmp_path: Path) -> None:
    from pymavlink import mavftp, mavparm

    station = open_station(port)
    try:
        assert station.wait_heartbeat(timeout=30) is not None
        store = mavparm.MAVParmDict()
        for value in (6.0, 6.125, 6.25):
            assert store.mavset(station, "MC_ROLL_P", value, retries=6, parm_type=REAL32)
        ftp = mavftp.MAVFTP(station, 1, 1)
        ftp.cmd_getparams([str(tmp_path / "all.parm")])
        ftp.process_ftp_reply("getparams", timeout=30)
        stored = dict(line.split(",") for line in (tmp_path / "all.parm").read_text().splitlines() if line[0] != "#")
        assert set(stored) == set(parameter_specs())
        assert struct.pack("<f", float(stored["MC_ROLL_P"])) == struct.pack("<f", 6.25)
    finally:
        station.close()


def test_mavproxy(port: int, tmp_path: Path) -> None:
    with Console(port, tmp_path) as mavproxy:
        assert mavproxy.parameters() == len(parameter_specs())
        mavproxy.say("param set MC_ROLL_P 7.25")
        for _ in range(20):
            mavproxy.say("param fetch MC_ROLL_P")
            try:
                if mavproxy.until(r"MC_ROLL_P = (\S+)", limit_s=0.5)[1].startswith("7.25"):
                    return
            except AssertionError:
                continue
        raise AssertionError("MC_ROLL_P never became 7.25")
