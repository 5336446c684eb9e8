"""Why a real autopilot does not fly our plant: each failure that people meet again and again, with its remedy.

Asked before anything is armed, answered within a second or two; asked again when an armed autopilot moves no motor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from bridge.client import Client
from bridge.errors import HilUnfit, NotReady, PeerSilent
from bridge.param_operation import Outcome, ParamResult
from scenarios.hil_session import geometry_parameters
from scenarios.plant_session import PlantSession
from sitl.vehicle_spec import VehicleModel

ANSWER_S = 2.0
"""Vehicle time that the first motor command is waited for."""

READ_S = 2.0
_PX4 = 12
_WARNING, _TEXTS = 4, 4
_MOTOR1 = 101
_SIM_ACC_GYRO, _SIM_MAG = 1310988, 197388
_CALIBRATION = {"CAL_ACC0_ID": _SIM_ACC_GYRO, "CAL_GYRO0_ID": _SIM_ACC_GYRO, "CAL_MAG0_ID": _SIM_MAG}
_HITL = {
    -1: "it takes its sensors from elsewhere",
    0: "HITL is off",
    2: "the board simulates a vehicle of its own (SIH)",
}


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        what: in a few words. ok: it is as it must be.
        seen: what was found. remedy: what to do; empty if it is ok.
        fatal: nothing flies before it is put right. mended: `froude fly` does that by itself.
    """

    what: str
    ok: bool
    seen: str
    remedy: str = ""
    fatal: bool = True
    mended: bool = False

    def sentence(self) -> str:
        """For an error's text."""
        return f"{self.what}: {self.seen}. {self.remedy}." if self.remedy else f"{self.what}: {self.seen}."

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def check(client: Client, session: PlantSession, model: VehicleModel) -> list[Finding]:
    """Look at everything that keeps an autopilot from flying our plant; nothing is changed or armed.

    Args:
        client: connected. session: whose plant is being stepped. model: the airframe on it.

    Returns:
        findings in the order in which they matter.
    """
    findings = [_is_px4(client)]
    board = session.board
    client.wait_until(lambda: session.answers > 0, ANSWER_S)
    values = _read(client, _names(model, board=board))
    if board:
        findings.append(_hil_flag(client, values))
    findings.append(_answers(session, values, board=board))
    findings.append(_outputs(values, len(model.airframe.rotors), board=board))
    if board:
        findings.append(_calibration(values))
    findings.append(_geometry(values, model, board=board))
    return findings


def must_fly(client: Client, session: PlantSession, model: VehicleModel) -> None:
    """Raise HilUnfit if something is wrong without whose remedy nothing can fly.

    Args:
        client, session, model: as `check`.
    """
    wrong = [one for one in check(client, session, model) if not one.ok and one.fatal]
    if wrong:
        raise HilUnfit(client.link.name, [one.sentence() for one in wrong])


def why_not_ready(client: Client, session: PlantSession, model: VehicleModel, error: NotReady) -> HilUnfit:
    """What to tell when an autopilot does not get ready: what it lacks, what it said, what looks wrong.

    Args:
        client, session, model: as `check`. error: what is missing.
    """
    texts = [text for _, severity, text in client.state.texts if severity <= _WARNING]
    said = [f"It said: {'; '.join(dict.fromkeys(texts[-_TEXTS:]))}."] if texts else []
    wrong = [one.sentence() for one in check(client, session, model) if not one.ok]
    missing = f"not ready after {error.waited_s:g} s, missing: {', '.join(error.missing)}."
    return HilUnfit(client.link.name, [missing, *said, *wrong])


def why_no_thrust(
    client: Client, session: PlantSession, model: VehicleModel, standing: Iterable[int], armed_s: float
) -> HilUnfit:
    """What to tell when motors stand still under an armed autopilot that wants thrust.

    Args:
        client, session, model: as `check`. standing: numbers of the motors, from 1. armed_s: for how long.
    """
    prefix = "HIL_ACT_FUNC" if session.board else "PWM_MAIN_FUNC"
    numbers = list(standing)
    which = "all motor commands are" if len(numbers) == len(model.airframe.rotors) else f"motors {_list(numbers)} are"
    first = (
        f"armed, thrust is asked for, and {which} 0 in HIL_ACTUATOR_CONTROLS for {armed_s:g} s: "
        f"outputs are assigned by {prefix}n = {_MOTOR1}, {_MOTOR1 + 1} ... while disarmed"
    )
    try:
        values = _read(client, _names(model, board=session.board))
    except PeerSilent:
        return HilUnfit(client.link.name, [first + "."])
    found = [
        _outputs(values, len(model.airframe.rotors), board=session.board),
        _geometry(values, model, board=session.board),
    ]
    return HilUnfit(client.link.name, [first + ".", *(one.sentence() for one in found if not one.ok)])


# -- one look each ---------------------------------------------------------------------------------------------


def _is_px4(client: Client) -> Finding:
    seen = client.state.autopilot
    if seen == _PX4:
        return Finding("autopilot", True, f"PX4, system {client.target_system}")
    return Finding(
        "autopilot",
        False,
        f"HEARTBEAT.autopilot is {seen}, not 12 (PX4)",
        "Connect a PX4; parameters and outputs are PX4's",
    )


def _hil_flag(client: Client, values: dict[str, ParamResult]) -> Finding:
    if client.state.hil_enabled:
        return Finding("HIL flag", True, "HEARTBEAT.base_mode has MAV_MODE_FLAG_HIL_ENABLED (32)")
    hitl = _number(values, "SYS_HITL")
    seen = "HEARTBEAT.base_mode lacks MAV_MODE_FLAG_HIL_ENABLED (32), so the board ignores HIL_SENSOR"
    if hitl is None:
        remedy = "This firmware has no SYS_HITL: build one with HITL (a board's default build of PX4 may leave it out)"
    elif hitl == 1:
        remedy = "SYS_HITL is 1 already: reboot the board (it is read at start only), and check that its SD card is in"
    else:
        why = _HITL.get(int(hitl), "a value PX4 does not know")
        remedy = f"SYS_HITL is {hitl:g} ({why}): set SYS_HITL = 1 and SYS_AUTOSTART = 1001, then reboot"
    return Finding("HIL flag", False, seen, remedy)


def _answers(session: PlantSession, values: dict[str, ParamResult], *, board: bool) -> Finding:
    if session.answers:
        return Finding("motor commands", True, "HIL_ACTUATOR_CONTROLS come")
    seen = f"no HIL_ACTUATOR_CONTROLS within {ANSWER_S:g} s"
    if not board:
        remedy = (
            "Is this port the simulator's of the same PX4 instance (4560 + N beside 14540 + N), started with "
            "PX4_SIM_MODEL=none_iris?"
        )
    elif _number(values, "HIL_ACT_FUNC1") is None:
        remedy = (
            "The parameter HIL_ACT_FUNC1 does not exist, so the firmware has no pwm_out_sim: build it with "
            "CONFIG_MODULES_SIMULATION_PWM_OUT_SIM=y"
        )
    else:
        remedy = (
            "The board streams them only on a link of more than 5000 B/s: raise MAV_n_RATE of that port, or use USB; "
            "and only while SYS_HITL is 1"
        )
    return Finding("motor commands", False, seen, remedy)


def _outputs(values: dict[str, ParamResult], count: int, *, board: bool) -> Finding:
    prefix = "HIL_ACT_FUNC" if board else "PWM_MAIN_FUNC"
    wrong = {}
    for n in range(count):
        value = _number(values, f"{prefix}{n + 1}")
        if value != _MOTOR1 + n:
            wrong[f"{prefix}{n + 1}"] = value
    if not wrong:
        return Finding("outputs", True, f"{prefix}1..{count} are motors 1..{count}")
    seen = ", ".join(f"{name} is {'not there' if value is None else f'{value:g}'}" for name, value in wrong.items())
    first = next(iter(wrong))
    number = int(first.removeprefix(prefix))
    absent = all(value is None for value in wrong.values())
    remedy = (
        f"{first} does not exist on this build: it has no pwm_out_sim, or fewer outputs than the airframe has motors"
        if absent
        else f"Set {prefix}n = {_MOTOR1 - 1} + n while disarmed: {first} = {_MOTOR1 + number - 1}"
    )
    # froude fly sets what differs from a simulator's defaults; what does not exist nobody can set
    return Finding("outputs", False, seen, remedy, fatal=absent, mended=not absent)


def _calibration(values: dict[str, ParamResult]) -> Finding:
    wrong = {name: _number(values, name) for name, wanted in _CALIBRATION.items() if _number(values, name) != wanted}
    if not wrong:
        return Finding("calibration", True, "belongs to the simulated sensors")
    seen = ", ".join(f"{name} is {'not there' if value is None else f'{value:g}'}" for name, value in wrong.items())
    remedy = "Set " + ", ".join(f"{name} = {_CALIBRATION[name]}" for name in wrong)
    remedy += ", if the board does not get ready: they are the simulated sensors' ids"
    return Finding("calibration", False, seen, remedy, fatal=False)


def _geometry(values: dict[str, ParamResult], model: VehicleModel, *, board: bool) -> Finding:
    wanted = geometry_parameters(model, board=board)
    wrong = []
    for name, (value, _) in wanted.items():
        if not name.startswith("CA_"):
            continue
        seen = _number(values, name)
        if seen is None or not math.isclose(seen, float(value), rel_tol=1e-4, abs_tol=1e-5):
            wrong.append(f"{name} is {'not there' if seen is None else f'{seen:g}'}, not {float(value):g}")
    if not wrong:
        return Finding("rotor geometry", True, f"is {model.airframe.name}'s")
    shown = "; ".join(wrong[:3]) + (f"; and {len(wrong) - 3} more" if len(wrong) > 3 else "")
    remedy = "Set them while disarmed (froude fly does it by itself, froude hil with --setup)"
    return Finding("rotor geometry", False, shown, remedy, fatal=False, mended=True)


# -- parameters ------------------------------------------------------------------------------------------------


def _names(model: VehicleModel, *, board: bool) -> list[str]:
    count = len(model.airframe.rotors)
    prefix = "HIL_ACT_FUNC" if board else "PWM_MAIN_FUNC"
    names = [name for name in geometry_parameters(model, board=board) if name.startswith("CA_")]
    names += [f"{prefix}{n + 1}" for n in range(count)]
    return names + (["SYS_HITL", *_CALIBRATION] if board else [])


def _read(client: Client, names: Iterable[str]) -> dict[str, ParamResult]:
    """What came of reading each; one that does not exist is an answer, too.

    Raises:
        PeerSilent: the autopilot answers no request for a parameter.
    """
    results = client.try_read(names, READ_S)
    if results and all(one.outcome is Outcome.TIMEOUT for one in results.values()):
        raise PeerSilent(client.link.name, READ_S, "an answer to PARAM_REQUEST_READ", "Is this link MAVLink's?")
    return results


def _number(values: dict[str, ParamResult], name: str) -> float | None:
    result = values.get(name)
    if result is None or result.seen is None or result.outcome is not Outcome.VERIFIED:
        return None
    return float(result.seen.value)


def _list(numbers: list[int]) -> str:
    return ", ".join(str(number) for number in numbers)
