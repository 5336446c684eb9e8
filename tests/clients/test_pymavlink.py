"""Scripts as people write them with pymavlink's mavutil, mavparm and mavftp."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mavutil_script import INT32, REAL32, Script, open_station
from vehicle_process import VehicleProcess

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

ACCEPTED, TEMPORARILY_REJECTED, UNSUPPORTED = 0, 1, 3
NAN = math.nan


@pytest.fixture(scope="module")
def vehicle(sitl: Callable[..., VehicleProcess]) -> VehicleProcess:
    return sitl(speed=3.0, mode="gcs")


@pytest.fixture
def script(vehicle: VehicleProcess) -> Iterator[Script]:
    connection = open_station(vehicle.port)
    try:
        assert connection.wait_heartbeat(timeout=30) is not None
        yield Script(connection)
    finally:
        connection.close()


def test_all_parameters(script: Script) -> None:
    c = script.c
    c.mav.param_request_list_send(1, 1)
    seen: dict[str, Any] = {}
    end = time.monotonic() + 20
    specs = parameter_specs()
    while len(seen) < len(specs) and time.monotonic() < end:
        message = c.recv_match(type="PARAM_VALUE", blocking=True, timeout=0.3)
        if message is None:
            # A full socket buffer loses some on a busy computer; a script asks for those again.
            for index in list(set(range(len(specs))) - {one.param_index for one in seen.values()})[:50]:
                c.mav.param_request_read_send(1, 1, b"", index)
        elif message.param_index != 65535:
            seen[message.param_id] = message
    assert set(seen) == set(specs)
    assert {message.param_count for message in seen.values()} == {len(specs)}
    assert seen["MC_ROLL_P"].param_value == pytest.approx(specs["MC_ROLL_P"].default)
    assert struct.unpack("<i", struct.pack("<f", seen["MAV_SYS_ID"].param_value)) == (1,)


def test_parameter_set_by_mavparm(script: Script) -> None:
    from pymavlink import mavparm

    assert mavparm.MAVParmDict().mavset(script.c, "MC_ROLL_P", 7.5, retries=3, parm_type=REAL32)
    assert mavparm.MAVParmDict().mavset(script.c, "COM_OBL_RC_ACT", 5, retries=3, parm_type=INT32)
    stored = script.parameter("COM_OBL_RC_ACT").param_value
    assert struct.unpack("<i", struct.pack("<f", stored)) == (5,)
    assert mavparm.MAVParmDict().mavset(script.c, "MC_ROLL_P", 6.5, retries=3, parm_type=REAL32)


def test_a_parameter_file_by_mavparm(script: Script, tmp_path: Path) -> None:
    from pymavlink import mavparm

    path = tmp_path / "gains.parm"
    path.write_text("MC_ROLLRATE_P 0.125\nMC_PITCHRATE_P 0.25\n")
    assert mavparm.MAVParmDict().load(str(path), mav=script.c, check=False)
    assert script.parameter("MC_ROLLRATE_P").param_value == 0.125
    assert script.parameter("MC_PITCHRATE_P").param_value == 0.25


def test_all_parameters_by_mavftp(script: Script, tmp_path: Path) -> None:
    from pymavlink import mavftp

    ftp = mavftp.MAVFTP(script.c, 1, 1)
    path = tmp_path / "all.parm"
    ftp.cmd_getparams([str(path)])
    ftp.process_ftp_reply("getparams", timeout=20)
    stored = dict(line.split(",") for line in path.read_text().splitlines() if not line.startswith("#"))
    assert set(stored) == set(parameter_specs())
    assert int(stored["MAV_SYS_ID"]) == 1
    assert float(stored["MC_PITCH_P"]) == pytest.approx(parameter_specs()["MC_PITCH_P"].default)


def test_files_by_mavftp(script: Script, tmp_path: Path) -> None:
    from pymavlink import mavftp

    ftp = mavftp.MAVFTP(script.c, 1, 1)
    ftp.cmd_list(["/etc/extras"])
    general = next(one for one in ftp.list_result if one.name.startswith("component_general"))
    path = tmp_path / general.name
    ftp.cmd_get([f"/etc/extras/{general.name}", str(path)])
    ftp.process_ftp_reply("get", timeout=20)
    assert path.stat().st_size == general.size_b


@pytest.mark.parametrize("hz", [250, 100, 40])
def test_the_rate_asked_for_arrives(script: Script, hz: int) -> None:
    assert script.command(511, 30, 1e6 / hz) == ACCEPTED
    assert script.command(510, 30) == ACCEPTED
    stamps = [script.c.recv_match(type="ATTITUDE", blocking=True, timeout=2).time_boot_ms for _ in range(hz)]
    # In vehicle time: the computer may be as slow as it likes.
    assert (stamps[-1] - stamps[0]) / (hz - 1) == pytest.approx(1000 / hz, rel=0.02)


def test_a_mission_item_by_item(script: Script) -> None:
    c = script.c
    sent = [(22, 0), (16, 1000), (20, 0)]
    c.mav.mission_count_send(1, 1, len(sent))
    for number, (command, north) in enumerate(sent):
        asked = script.until(lambda m, number=number: m.seq == number, "MISSION_REQUEST_INT", "MISSION_REQUEST")
        c.mav.mission_item_int_send(
            1,
            1,
            asked.seq,
            2 if command == 20 else 6,
            command,
            int(number == 0),
            1,
            0,
            0,
            0,
            NAN,
            473977420 + north,
            85455940,
            5.0,
        )
    assert script.until(lambda _: True, "MISSION_ACK").type == 0
    c.mav.mission_request_list_send(1, 1)
    assert script.until(lambda _: True, "MISSION_COUNT").count == len(sent)
    for number, (command, north) in enumerate(sent):
        c.mav.mission_request_int_send(1, 1, number)
        item = script.until(lambda m, number=number: m.seq == number, "MISSION_ITEM_INT")
        assert item.command == command
        if command == 16:
            assert (item.x, item.y, item.z) == (473977420 + north, 85455940, 5.0)
    c.mav.mission_ack_send(1, 1, 0)
    for mission_type in (1, 2):
        c.mav.mission_request_list_send(1, 1, mission_type)
        assert script.until(lambda m, kind=mission_type: m.mission_type == kind, "MISSION_COUNT").count == 0
        c.mav.mission_ack_send(1, 1, 0, mission_type)
    c.mav.mission_clear_all_send(1, 1)
    assert script.until(lambda _: True, "MISSION_ACK").type == 0


def test_a_flight_with_a_roll_step(script: Script) -> None:
    script.until(lambda m: m.onboard_control_sensors_health & 0x10000000, "SYS_STATUS")
    # Set-points come by the wall clock, the time-out is the vehicle's.
    script.c.param_set_send("COM_OF_LOSS_T", 5.0, parm_type=REAL32)
    script.until(lambda m: m.param_id == "COM_OF_LOSS_T", "PARAM_VALUE")
    assert script.command(31_999) == UNSUPPORTED
    assert script.command(400, 1) == ACCEPTED
    assert script.command(22, 0, 0, 0, NAN, NAN, NAN, 488.0 + 8.0) == ACCEPTED
    script.until(lambda m: m.relative_alt > 7500, "GLOBAL_POSITION_INT")
    script.mode(4, 3)
    assert script.command(400, 0) == TEMPORARILY_REJECTED  # not in the air
    for _ in range(40):
        script.roll(0.0)
    assert script.command(176, 1, 6) == ACCEPTED
    script.mode(6)
    for _ in range(25):
        before = script.roll(0.0).roll
    rolls = [script.roll(0.2).roll for _ in range(40)]
    assert abs(before) < 0.05
    assert rolls[-1] == pytest.approx(0.2, abs=0.06)
    target = script.until(lambda m: m.q[1] > 0.05, "ATTITUDE_TARGET", limit_s=3.0)
    assert target.q[1] == pytest.approx(math.sin(0.1), abs=1e-4)
    assert script.command(21) == ACCEPTED
    script.landed()


def test_set_mode_by_mavutil(script: Script) -> None:
    for name, custom_mode in (("LAND", 0x06040000), ("LOITER", 0x03040000)):
        script.c.set_mode(name)
        assert script.until(lambda m: m.command == 176, "COMMAND_ACK", limit_s=5.0).result == ACCEPTED
        script.until(lambda m, want=custom_mode: m.custom_mode == want, "HEARTBEAT", limit_s=5.0)
