"""A network that loses a tenth of the datagrams each way: what clients repeat must work all the same."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from lossy_relay import LossyRelay
from mavproxy_console import Console
from mavsdk_script import Craft, fly, until
from mavutil_script import REAL32, open_station
from vehicle_process import VehicleProcess, free_port

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

from mavsdk.asyncio.plugins.ftp import FtpAsync  # noqa: E402
from mavsdk.asyncio.plugins.log_files import LogFilesAsync  # noqa: E402
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync  # noqa: E402
from mavsdk.plugins.log_files.log_files import LogFilesError  # noqa: E402
from mavsdk.plugins.mission_raw.mission_raw import MissionItem, MissionRawError  # noqa: E402


@dataclass
class BadNetwork:
    """A vehicle behind a network that loses datagrams: where it is heard, where it keeps its logs."""

    port: int
    relay: LossyRelay
    logs: Path


@pytest.fixture
def network(
    sitl: Callable[..., VehicleProcess], relay: Callable[..., LossyRelay], tmp_path: Path
) -> Iterator[BadNetwork]:
    port, logs = free_port(), tmp_path / "logs"
    way = relay(port)
    vehicle = sitl("--log-dir", str(logs), "--link", f"udpout://127.0.0.1:{way.port}#onboard", speed=2.0)
    yield BadNetwork(port, way, logs)
    vehicle.stop()


def test_mavsdk_parameters_and_missions(network: BadNetwork) -> None:
    async def script(craft: Craft) -> None:
        param = craft.param
        everything = await param.get_all_params()
        names = {one.name for one in [*everything.int_params, *everything.float_params]}
        assert names == set(parameter_specs())
        for value in (0.11, 0.12, 0.13, 0.14, 0.15):
            await param.set_param_float("MC_ROLLRATE_P", value)
            assert await param.get_param_float("MC_ROLLRATE_P") == pytest.approx(value)

        home = await until(craft.telemetry.subscribe_home(), lambda one: math.isfinite(one.latitude_deg))
        place = round(home.latitude_deg * 1e7), round(home.longitude_deg * 1e7)
        items = [
            MissionItem(number, 6, 16, int(number == 0), 1, 0.0, 0.0, 0.0, math.nan, *place, 5.0 + number, 0)
            for number in range(12)
        ]
        mission = MissionRawAsync(craft.system)
        for _ in range(5):
            # The last acknowledgement is the one message that nobody repeats.
            with suppress(MissionRawError):
                await mission.upload_mission(items)
                break
        assert [one.z for one in await mission.download_mission()] == [one.z for one in items]

        await craft.ready()
        await craft.action.arm()
        await until(craft.telemetry.subscribe_armed(), bool)
        await craft.action.disarm()
        await craft.disarmed()
        assert network.relay.lost > 100

    fly(network.port, script, 90)


def test_mavsdk_files_and_logs(network: BadNetwork, tmp_path: Path) -> None:
    async def script(craft: Craft) -> None:
        # The log that began with the vehicle ends here, short.
        await craft.param.set_param_int("SDLOG_MODE", -1)
        ftp, logs = FtpAsync(craft.system), LogFilesAsync(craft.system)
        names = [entry.name for entry in (await ftp.list_directory("/etc/extras")).entries]
        for kind, burst in (("component_general", False), ("parameters", True)):
            name = next(one for one in names if one.startswith(kind))
            async for _ in ftp.download(f"/etc/extras/{name}", str(tmp_path), burst):
                pass
            assert await ftp.are_files_identical(str(tmp_path / name), f"/etc/extras/{name}")
        # MAVSDK asks for every 90 bytes that are missing by themselves, and waits half a second for each.
        network.relay.loss = 0.02
        entries: list[Any] = []
        for _ in range(4):
            # It repeats this request only when it has had an answer.
            with suppress(LogFilesError):
                entries = await logs.get_entries()
                break
        assert len(entries) == 1
        async for _ in logs.download_log_file(entries[0], str(tmp_path / "flight.ulg")):
            pass
        [kept] = network.logs.rglob("*.ulg")
        assert (tmp_path / "flight.ulg").read_bytes() == kept.read_bytes()

    fly(network.port, script, 90)


def test_pymavlink(network: BadNetwork, tmp_path: Path) -> None:
    from pymavlink import mavftp, mavparm

    station = open_station(network.port)
    try:
        assert station.wait_heartbeat(timeout=30) is not None
        store = mavparm.MAVParmDict()
        for value in (6.0, 6.125, 6.25):
            assert store.mavset(station, "MC_ROLL_P", value, retries=6, parm_type=REAL32)
        for _ in range(5):  # it gives up when it loses the same request too often
            ftp = mavftp.MAVFTP(station, 1, 1)
            ftp.cmd_getparams([str(tmp_path / "all.parm")])
            ftp.process_ftp_reply("getparams", timeout=30)
            if (tmp_path / "all.parm").exists():
                break
        stored = dict(line.split(",") for line in (tmp_path / "all.parm").read_text().splitlines() if line[0] != "#")
        assert set(stored) == set(parameter_specs())
        assert struct.pack("<f", float(stored["MC_ROLL_P"])) == struct.pack("<f", 6.25)
    finally:
        station.close()


def test_mavproxy(network: BadNetwork, tmp_path: Path) -> None:
    # It repeats ten missing parameters every other second: the first list comes whole.
    network.relay.loss = 0.0
    with Console(network.port, tmp_path) as mavproxy:
        assert mavproxy.parameters() == len(parameter_specs())
        network.relay.loss = 0.1
        for value in ("7.25", "7.5", "7.75"):
            # It gives up after three tries, which one set in a hundred and fifty needs here; who types it would not.
            assert any(set_and_shown(mavproxy, "MC_ROLL_P", value) for _ in range(3))


def set_and_shown(mavproxy: Console, name: str, value: str) -> bool:
    mavproxy.say(f"param set {name} {value}")
    return shown(mavproxy, name, value)


def shown(mavproxy: Console, name: str, value: str) -> bool:
    """Ask until the vehicle's value is this: a request may be lost."""
    for _ in range(20):
        mavproxy.say(f"param fetch {name}")
        try:
            if mavproxy.until(rf"{name} = (\S+)", limit_s=0.5)[1].startswith(value):
                return True
        except AssertionError:
            continue
    return False
