"""MAVProxy: logs and files, from a vehicle in real time."""

from __future__ import annotations

import contextlib
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mavproxy_console import MODULES, Console
from vehicle_process import VehicleProcess

from bridge.flight_log import FlightLog
from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

param_ftp = pytest.importorskip("MAVProxy.modules.lib.param_ftp")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def mavproxy(
    sitl: Callable[..., VehicleProcess], logs: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Console]:
    vehicle = sitl("--log-dir", str(logs), mode="gcs")
    with Console(vehicle.port, tmp_path_factory.mktemp("mavproxy"), modules=f"{MODULES},ftp") as console:
        # It asks for a file that a PX4 has not, too, and then for the list.
        assert console.parameters() == len(parameter_specs())
        console.say("param show MC_ROLL_P")
        console.until(rf"MC_ROLL_P\s+{parameter_specs()['MC_ROLL_P'].default}")
        yield console


def logged_flight(flight: Any, folder: Path) -> int:
    """Bytes of the log of a flight to 4 m that is put into a folder."""
    one = flight()
    one.parameters.set("SDLOG_MODE", 0)
    one.parameters.set("MIS_TAKEOFF_ALT", 4.0)
    log = FlightLog(folder, one.vehicle)
    one.get_ready()
    one.arm()
    one.autopilot.command_takeoff(None)
    one.run(9.0, lambda _: log.tick())
    path = log.path
    assert path is not None
    log.close()
    return path.stat().st_size


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_flight_log(mavproxy: Console, logs: Path, flight: Any) -> None:
    pyulog = pytest.importorskip("pyulog")
    size = logged_flight(flight, logs)
    mavproxy.say(f"log download {listed(mavproxy, size)} flight.ulg")
    mavproxy.until("Finished downloading flight.ulg", limit_s=90.0)
    path = mavproxy.folder / "flight.ulg"
    assert path.stat().st_size == size
    log = pyulog.ULog(str(path))
    assert not log.file_corruption
    assert -log.get_dataset("vehicle_local_position").data["z"].min() > 3.0


def test_files(mavproxy: Console) -> None:
    folder, specs = mavproxy.folder, parameter_specs()
    mavproxy.say("ftp list /etc/extras")
    name, size = mavproxy.until(r"\s+(component_general\S+)\t(\d+)").groups()
    mavproxy.say(f"ftp get /etc/extras/{name} {name}")
    mavproxy.until(rf"Wrote {size} bytes to {name}")
    written(folder / name, int(size))
    mavproxy.say(f"ftp crc /etc/extras/{name}")
    mavproxy.until(rf"crc: /etc/extras/{name} 0x{crc32(folder / name):08x}")
    mavproxy.say("ftp get @PARAM/param.pck param.pck")
    written(folder / "param.pck", int(mavproxy.until(r"Wrote (\d+) bytes to param.pck")[1]))
    packed = param_ftp.ftp_param_decode((folder / "param.pck").read_bytes())
    assert {name.decode() for name, _, _ in packed.params} == set(specs)


def listed(mavproxy: Console, size: int) -> int:
    """Number of the log of that size; MAVProxy does not ask again for what the system dropped of a list."""
    for _ in range(10):
        mavproxy.say("log list")
        # the vehicle writes one itself, from the start on
        with contextlib.suppress(AssertionError):
            return int(mavproxy.until(rf"Log (\d+)  numLogs [23] lastLog \d+ size {size} ", limit_s=5.0)[1])
    raise AssertionError(f"no log of {size} bytes is listed")


def written(path: Path, size: int) -> None:
    """Wait until MAVProxy has put all of a file on the disk, a little later than it says."""
    for _ in range(100):
        if path.stat().st_size == size:
            return
        time.sleep(0.05)
    raise AssertionError(f"{path} is not {size} bytes long")


def crc32(path: Path) -> int:
    """The checksum MAVFTP asks for: CRC-32 without its two inversions."""
    return ~zlib.crc32(path.read_bytes(), 0xFFFFFFFF) & 0xFFFFFFFF
