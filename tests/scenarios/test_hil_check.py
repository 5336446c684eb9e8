"""What keeps a real autopilot from flying our plant: each failure found, each with its exact remedy."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from typing import Any

import pytest

from bridge.client import Client
from bridge.connection import Connection
from bridge.drive import Drive
from bridge.errors import HilUnfit, NotReady, PeerSilent
from bridge.link import Link, MemoryLink
from scenarios.hil_check import Finding, check, must_fly, why_no_thrust, why_not_ready
from scenarios.hil_command import findings_text
from scenarios.hil_session import geometry_parameters
from sitl.vehicle_spec import VehicleModel, resolve_vehicle

NUMBERS = {"INT32": 6, "REAL32": 9}
BOARD = {
    "SYS_HITL": ("INT32", 1),
    "CAL_ACC0_ID": ("INT32", 1310988),
    "CAL_GYRO0_ID": ("INT32", 1310988),
    "CAL_MAG0_ID": ("INT32", 197388),
}


class Autopilot(Drive):
    """An autopilot that answers what a PX4 would to a few questions, and the time that passes while it does.

    Attributes:
        parameters: name -> (type, value); what is not in it does not exist. motors: as the plant's session sees them.
        after_us: vehicle time before the first motor command; None: never.
    """

    def __init__(self, parameters: Mapping[str, tuple[str, float]], *, board: bool) -> None:
        self.link, self._far = MemoryLink.pair()
        self.drive = self
        self.board = board
        self.parameters = dict(parameters)
        self.base_mode = 53 if board else 29
        self.autopilot = 12
        self.after_us: int | None = 40_000
        self.motors: tuple[float, ...] = ()
        self.texts: deque[str] = deque()
        self.mute = False
        self._now_us = 0
        self._voice = Connection(1, 1, datagram=True)

    # the plant's session

    faults = ()

    @property
    def answers(self) -> int:
        return int(self.after_us is not None and self._now_us >= self.after_us)

    def begin(self) -> None: ...

    def summary(self) -> str:
        return ""

    def truth_at(self, time_ms: int) -> None: ...

    # the client's time

    def now_us(self) -> int:
        return self._now_us

    def wait(self, link: Link, until_us: int) -> bytes | None:
        self._now_us += 4_000
        if self._now_us % 200_000 == 4_000:
            self._say("HEARTBEAT", type=2, autopilot=self.autopilot, base_mode=self.base_mode, mavlink_version=3)
            while self.texts:
                self._say("STATUSTEXT", severity=2, text=self.texts.popleft())
        while (data := self._far.recv()) is not None:
            for message in self._voice.receive(data):
                if message.name == "PARAM_REQUEST_READ" and not self.mute:
                    self._answer(message.param_id)
        return link.recv()

    def _answer(self, name: str) -> None:
        if name not in self.parameters:
            self._say("PARAM_ERROR", target_system=255, target_component=190, param_id=name, param_index=-1, error=1)
            return
        kind, value = self.parameters[name]
        raw: Any = int(value).to_bytes(4, "little", signed=True) if kind == "INT32" else float(value)
        self._say("PARAM_VALUE", param_id=name, param_value=raw, param_type=NUMBERS[kind], param_count=9, param_index=0)

    def _say(self, name: str, **fields: Any) -> None:
        self._far.send(self._voice.encode(name, **fields))


def good(model: VehicleModel, *, board: bool) -> dict[str, tuple[str, float]]:
    """Parameters with which nothing is wrong."""
    prefix = "HIL_ACT_FUNC" if board else "PWM_MAIN_FUNC"
    functions = {f"{prefix}{n + 1}": ("INT32", 101.0 + n) for n in range(len(model.airframe.rotors))}
    geometry = {name: (kind, float(value)) for name, (value, kind) in geometry_parameters(model, board=board).items()}
    return {**geometry, **functions, **(BOARD if board else {})}


def rig(vehicle: str = "ant-x", *, board: bool = False) -> tuple[Autopilot, Client, VehicleModel]:
    model = resolve_vehicle(vehicle, ())
    autopilot = Autopilot(good(model, board=board), board=board)
    client = Client(autopilot.link, autopilot)
    client.connect()
    return autopilot, client, model


def found(findings: list[Finding], what: str) -> Finding:
    return next(one for one in findings if one.what == what)


@pytest.mark.parametrize("board", [False, True])
@pytest.mark.parametrize("vehicle", ["ant-x", "ant-r", "carrier-1"])
def test_an_autopilot_that_is_set_up_has_nothing_wrong(vehicle: str, board: bool) -> None:
    autopilot, client, model = rig(vehicle, board=board)
    findings = check(client, autopilot, model)
    assert [one for one in findings if not one.ok] == []
    must_fly(client, autopilot, model)
    assert findings_text(findings).endswith("nothing keeps it from flying this plant")
    json.dumps([one.as_dict() for one in findings])


@pytest.mark.parametrize(
    ("hitl", "remedy"),
    [
        (0, "SYS_HITL is 0 (HITL is off): set SYS_HITL = 1 and SYS_AUTOSTART = 1001, then reboot"),
        (2, "SYS_HITL is 2 (the board simulates a vehicle of its own (SIH)): set SYS_HITL = 1"),
        (-1, "SYS_HITL is -1 (it takes its sensors from elsewhere): set SYS_HITL = 1"),
        (1, "SYS_HITL is 1 already: reboot the board"),
        (None, "This firmware has no SYS_HITL"),
    ],
)
def test_a_board_without_the_hil_flag(hitl: int | None, remedy: str) -> None:
    autopilot, client, model = rig(board=True)
    autopilot.base_mode = 21
    client.wait(0.3)
    if hitl is None:
        del autopilot.parameters["SYS_HITL"]
    else:
        autopilot.parameters["SYS_HITL"] = ("INT32", hitl)
    finding = found(check(client, autopilot, model), "HIL flag")
    assert not finding.ok
    assert finding.fatal
    assert finding.remedy.startswith(remedy)
    with pytest.raises(HilUnfit, match="HIL flag"):
        must_fly(client, autopilot, model)


def test_a_firmware_without_pwm_out_sim() -> None:
    autopilot, client, model = rig(board=True)
    autopilot.after_us = None
    autopilot.parameters = {name: value for name, value in autopilot.parameters.items() if "ACT_FUNC" not in name}
    findings = check(client, autopilot, model)
    assert "CONFIG_MODULES_SIMULATION_PWM_OUT_SIM=y" in found(findings, "motor commands").remedy
    outputs = found(findings, "outputs")
    assert outputs.fatal
    assert "HIL_ACT_FUNC1 is not there" in outputs.seen


def test_a_link_too_slow_for_motor_commands() -> None:
    autopilot, client, model = rig(board=True)
    autopilot.after_us = None
    before_us = client.now_us()
    assert "MAV_n_RATE" in found(check(client, autopilot, model), "motor commands").remedy
    assert client.now_us() - before_us < 5_000_000


def test_a_simulator_build_that_never_answers() -> None:
    autopilot, client, model = rig()
    autopilot.after_us = None
    assert "PX4_SIM_MODEL=none_iris" in found(check(client, autopilot, model), "motor commands").remedy


def test_wrong_output_functions_are_named_and_left_to_fly() -> None:
    autopilot, client, model = rig("carrier-1")
    for n in (5, 6, 7, 8):
        autopilot.parameters[f"PWM_MAIN_FUNC{n}"] = ("INT32", 0)
    outputs = found(check(client, autopilot, model), "outputs")
    assert not outputs.ok
    assert "PWM_MAIN_FUNC5 is 0" in outputs.seen
    assert outputs.remedy.endswith("PWM_MAIN_FUNC5 = 105")
    assert "cannot fly this plant" in findings_text([outputs])
    must_fly(client, autopilot, model)


def test_geometry_of_another_airframe() -> None:
    autopilot, client, model = rig()
    autopilot.parameters["CA_ROTOR2_PY"] = ("REAL32", -0.2)
    del autopilot.parameters["CA_ROTOR3_PX"]
    geometry = found(check(client, autopilot, model), "rotor geometry")
    assert "CA_ROTOR2_PY is -0.2" in geometry.seen
    assert "CA_ROTOR3_PX is not there" in geometry.seen
    assert not geometry.fatal


def test_calibration_of_real_sensors_is_a_note_with_the_ids() -> None:
    autopilot, client, model = rig(board=True)
    autopilot.parameters["CAL_MAG0_ID"] = ("INT32", 0)
    calibration = found(check(client, autopilot, model), "calibration")
    assert "Set CAL_MAG0_ID = 197388" in calibration.remedy
    must_fly(client, autopilot, model)


def test_another_autopilot() -> None:
    autopilot, client, model = rig()
    autopilot.autopilot = 3
    client.wait(0.3)
    with pytest.raises(HilUnfit, match=r"HEARTBEAT\.autopilot is 3, not 12"):
        must_fly(client, autopilot, model)


def test_an_autopilot_that_answers_no_question() -> None:
    autopilot, client, model = rig()
    autopilot.mute = True
    with pytest.raises(PeerSilent, match="PARAM_REQUEST_READ"):
        check(client, autopilot, model)


def test_motors_that_stand_are_told_with_what_is_wrong() -> None:
    autopilot, client, model = rig("carrier-1")
    autopilot.parameters["PWM_MAIN_FUNC5"] = ("INT32", 0)
    error = why_no_thrust(client, autopilot, model, [5, 6, 7, 8], 1.0)
    assert "motors 5, 6, 7, 8 are 0 in HIL_ACTUATOR_CONTROLS for 1 s" in str(error)
    assert "PWM_MAIN_FUNC5 = 105" in str(error)
    assert "all motor commands are 0" in str(why_no_thrust(client, autopilot, model, range(1, 9), 1.0))


def test_what_is_not_ready_is_told_with_its_own_words() -> None:
    autopilot, client, model = rig(board=True)
    autopilot.parameters["CAL_ACC0_ID"] = ("INT32", 7)
    autopilot.texts.extend(["Preflight Fail: Accel 0 uncalibrated"] * 3)
    client.wait(0.3)
    error = why_not_ready(client, autopilot, model, NotReady("x", 60.0, ["pre-arm checks"]))
    assert "not ready after 60 s, missing: pre-arm checks" in str(error)
    assert str(error).count("Accel 0 uncalibrated") == 1
    assert "Set CAL_ACC0_ID = 1310988" in str(error)
