"""MAVProxy: parameters, a flight, missions."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from mavproxy_console import Console
from vehicle_process import VehicleProcess

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client


@pytest.fixture(scope="module")
def vehicle(sitl: Callable[..., VehicleProcess]) -> VehicleProcess:
    return sitl(speed=3.0, mode="gcs")


@pytest.fixture(scope="module")
def mavproxy(vehicle: VehicleProcess, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Console]:
    """One MAVProxy for the tests of this file: it takes seconds to start."""
    with Console(vehicle.port, tmp_path_factory.mktemp("mavproxy")) as console:
        assert console.parameters() == len(parameter_specs())
        yield console


def test_parameters(mavproxy: Console) -> None:
    specs = parameter_specs()
    mavproxy.say("param show MC_ROLL_P")
    mavproxy.until(rf"MC_ROLL_P\s+{specs['MC_ROLL_P'].default}")
    mavproxy.say("param set MC_ROLL_P 7.25")
    assert mavproxy.fetched("MC_ROLL_P", "7.25")
    mavproxy.say("param set COM_OBL_RC_ACT 5")
    assert mavproxy.fetched("COM_OBL_RC_ACT", "5")


def test_a_parameter_file(mavproxy: Console) -> None:
    (mavproxy.folder / "gains.parm").write_text("MC_ROLLRATE_P 0.125\nMC_PITCHRATE_P 0.25\nMC_YAW_P 3.5\n")
    mavproxy.say("param load gains.parm")
    mavproxy.until(r"Loaded 3 parameters from gains.parm")
    assert mavproxy.fetched("MC_PITCHRATE_P", "0.25")
    mavproxy.say("param save saved.parm")
    mavproxy.until(r"Saved \d+ parameters to saved.parm")
    saved = dict(line.split() for line in (mavproxy.folder / "saved.parm").read_text().splitlines() if line[0] != "#")
    assert float(saved["MC_ROLLRATE_P"]) == 0.125
    for name in ("MC_ROLLRATE_P", "MC_PITCHRATE_P", "MC_YAW_P", "MC_ROLL_P"):
        default = f"{parameter_specs()[name].default:g}"
        mavproxy.say(f"param set {name} {default}")
        assert mavproxy.fetched(name, default)


def test_a_mission(mavproxy: Console) -> None:
    lines = ["QGC WPL 110"]
    for seq, (command, north) in enumerate([(22, 0.0), (16, 1e-4), (21, 0.0)]):
        place = f"{47.397742 + north:.7f}\t8.5455940\t{6 if command != 21 else 0:.6f}"
        lines.append(f"{seq}\t{int(seq == 0)}\t3\t{command}\t0\t0\t0\t0\t{place}\t1")
    (mavproxy.folder / "plan.waypoints").write_text("\n".join(lines) + "\n")
    mavproxy.say("wp load plan.waypoints")
    mavproxy.until(r"Loaded 3 waypoints from plan.waypoints")
    mavproxy.until(r"Loaded 3 waypoints in")
    mavproxy.say("wp list")
    mavproxy.until(r"Requesting 3 waypoints")
    # The vehicle's answers are in the frame of whole numbers.
    for command in (22, 16, 21):
        mavproxy.until(rf"\n{command} 6 47\.397")
    # MAVProxy never says that it has got them all, and until the vehicle gives up waiting it is busy.
    mavproxy.until(r"AP: Mission sync timeout")
    mavproxy.say("wp clear")
    mavproxy.say("wp list")
    mavproxy.until(r"Requesting 0 waypoints")


def test_a_flight(mavproxy: Console) -> None:
    mavproxy.say("long DO_SET_MODE 209 4 3 0 0 0 0")
    mavproxy.until(r"Got COMMAND_ACK: DO_SET_MODE: ACCEPTED")
    # No sticks, so nobody could fly in it.
    mavproxy.say("long DO_SET_MODE 209 3 0 0 0 0 0")
    mavproxy.until(r"Got COMMAND_ACK: DO_SET_MODE: (ACCEPTED|TEMPORARILY_REJECTED)")
    mavproxy.say("long DO_SET_MODE 209 4 3 0 0 0 0")
    mavproxy.until(r"Got COMMAND_ACK: DO_SET_MODE: ACCEPTED")
    mavproxy.say("arm throttle")
    mavproxy.until(r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: ACCEPTED")
    mavproxy.until(r"ARMED")
    mavproxy.say("long NAV_TAKEOFF 0 0 0 nan nan nan 492")
    mavproxy.until(r"Got COMMAND_ACK: NAV_TAKEOFF: ACCEPTED")
    mavproxy.until(r"LOITER", limit_s=30.0)
    mavproxy.say("disarm")
    mavproxy.until(r"Disarming denied: not landed")
    mavproxy.say("long DO_SET_MODE 209 4 5 0 0 0 0")
    mavproxy.until(r"Got COMMAND_ACK: DO_SET_MODE: ACCEPTED")
    mavproxy.until(r"RTL")
    mavproxy.say("long NAV_LAND 0 0 0 nan nan nan nan")
    mavproxy.until(r"Got COMMAND_ACK: NAV_LAND: ACCEPTED")
    mavproxy.until(r"DISARMED", limit_s=40.0)
