"""ArduPilot's JSON backend: its frames byte by byte, our line as its reader takes it, its motors found by place."""

from __future__ import annotations

import contextlib
import math
import struct
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1]))

from ardupilot_stand_in import read_line, servo_frame

from bridge.ardupilot_frames import CCW, FRAMES, ardupilot_mix, fit_frame
from bridge.ardupilot_json import ArduPilotFace, NotArduPilot, ServoFrame, parse_frame
from sitl.actuators import RotorEffect, normalised_mix
from sitl.airframe import Rotor
from sitl.errors import UsageError
from sitl.profile import get_profile
from sitl.true_body import TrueBody
from sitl.vehicle_spec import resolve_vehicle

G_M_S2 = 9.81
QUAD = (0, 1, 2, 3)
COUNTS = st.integers(0, 2**32 - 1)
PULSES = st.integers(0, 65535)
RATES = st.integers(50, 8000)


def new_body(rate_hz: float = 400) -> TrueBody:
    return TrueBody(resolve_vehicle("ant-x"), get_profile("sitl"), rate_hz=rate_hz)


def new_face(said: list[str] | None = None) -> ArduPilotFace:
    return ArduPilotFace(new_body(), QUAD, say=(said if said is not None else []).append)


def frame(count: int, pulse_us: int = 1000, rate_hz: int = 400) -> ServoFrame:
    return ServoFrame(rate_hz, count, (pulse_us,) * 16)


# -- frames ----------------------------------------------------------------------------------------------------


def test_a_frame_is_read_byte_by_byte() -> None:
    data = bytes.fromhex("1a48 b004 07000000") + bytes.fromhex("e803d007dc05") + bytes(26)
    assert len(data) == 40
    assert parse_frame(data) == ServoFrame(1200, 7, (1000, 2000, 1500) + (0,) * 13)


def test_a_frame_of_32_outputs_is_read_byte_by_byte() -> None:
    data = bytes.fromhex("8173 9001 ffffffff") + bytes(62) + bytes.fromhex("dc05")
    assert len(data) == 72
    assert parse_frame(data) == ServoFrame(400, 2**32 - 1, (0,) * 31 + (1500,))


@given(RATES, COUNTS, st.sampled_from([16, 32]).flatmap(lambda n: st.lists(PULSES, min_size=n, max_size=n)))
def test_any_frame_is_read_as_it_was_packed(rate_hz: int, count: int, pwm: list[int]) -> None:
    data = servo_frame(count, pwm, rate_hz=rate_hz, outputs=len(pwm))
    assert parse_frame(data) == ServoFrame(rate_hz, count, tuple(pwm))


@given(st.binary(max_size=100))
def test_what_is_no_frame_is_refused_and_nothing_else_happens(data: bytes) -> None:
    # by chance it may be one: 40 or 72 bytes with the right magic number
    with contextlib.suppress(NotArduPilot):
        assert len(parse_frame(data).pwm_us) in (16, 32)


@given(st.sampled_from([16, 32]), st.integers(0, 71))
def test_a_frame_cut_short_or_with_more_behind_it_is_refused(outputs: int, cut: int) -> None:
    whole = servo_frame(3, [1500] * outputs, outputs=outputs)
    for data in (whole[:cut], whole + bytes(1 + cut)):
        if len(data) != len(whole):
            with pytest.raises(NotArduPilot, match=f"^{len(data)} bytes"):
                parse_frame(data)


@pytest.mark.parametrize("rate_hz", [0, 1, 49, 8001, 65535])
def test_an_absurd_rate_is_refused_with_its_parameter(rate_hz: int) -> None:
    with pytest.raises(NotArduPilot, match=rf"frame_rate {rate_hz} Hz.*SIM_RATE_HZ"):
        parse_frame(servo_frame(0, [], rate_hz=rate_hz))


def test_another_magic_number_is_named() -> None:
    with pytest.raises(NotArduPilot, match=r"magic number 18459.*18458 or 29569.*--model JSON"):
        parse_frame(struct.pack("<HHI16H", 18459, 400, 0, *[0] * 16))


# -- lockstep --------------------------------------------------------------------------------------------------


def test_the_answer_at_rest_is_exact() -> None:
    assert new_face().answer(frame(0)) == (
        b'\n{"timestamp":0.0025,"imu":{"gyro":[0.0,0.0,0.0],"accel_body":[0.0,0.0,-9.81]},'
        b'"position":[0.0,0.0,0.0],"velocity":[0.0,0.0,0.0],"quaternion":[1.0,0.0,0.0,0.0]}\n'
    )


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(*[PULSES] * 16), min_size=1, max_size=20), RATES)
def test_every_answer_is_a_line_that_ardupilot_reads(pulses: list[tuple[int, ...]], rate_hz: int) -> None:
    face = new_face()
    states = [read_line(face.answer(ServoFrame(rate_hz, i, pwm))) for i, pwm in enumerate(pulses)]
    for before, after in pairwise([{"timestamp": 0.0}, *states]):
        assert math.isclose(after["timestamp"] - before["timestamp"], 1.0 / rate_hz, rel_tol=1e-9)


def test_a_frame_that_comes_again_gets_the_same_bytes_and_moves_nothing() -> None:
    face = new_face()
    face.answer(frame(0, 1900))
    first = face.answer(frame(1, 1900))
    assert face.answer(frame(1, 1900)) == first
    assert (face.report.frames, face.report.repeated) == (2, 1)
    assert read_line(face.answer(frame(2, 1900)))["timestamp"] == 3 / 400


def test_frames_that_never_came_are_counted_and_said_once() -> None:
    said: list[str] = []
    face = new_face(said)
    for count in (0, 3, 4, 6):
        face.answer(frame(count))
    assert face.report.lost == 3
    assert [line for line in said if "lost" in line] == face.report.faults


def test_a_count_that_goes_back_puts_the_plant_on_the_ground_at_time_zero() -> None:
    said: list[str] = []
    face = new_face(said)
    for count in range(400):
        state = read_line(face.answer(frame(count, 1700)))
    assert state["position"][2] < -0.5
    state = read_line(face.answer(frame(0)))
    assert (state["timestamp"], state["position"]) == (1 / 400, [0.0, 0.0, 0.0])
    assert face.report.restarts == 1
    assert any("restarted in flight" in fault for fault in face.report.faults)
    assert any("went back from 399 to 0" in line for line in said)


def test_a_restart_on_the_ground_is_no_fault() -> None:
    face = new_face()
    for count in (0, 1, 2, 0, 1):
        face.answer(frame(count))
    assert (face.report.restarts, face.report.faults) == (1, [])


def test_the_count_may_run_over() -> None:
    face = new_face()
    for count in (2**32 - 2, 2**32 - 1, 0, 1):
        face.answer(frame(count))
    assert (face.report.lost, face.report.restarts, face.report.frames) == (0, 0, 4)


def test_a_rate_that_changes_in_flight_moves_nothing_but_the_step() -> None:
    face = new_face()
    for count in range(400):
        before = read_line(face.answer(frame(count, 1600)))
    for count in range(400, 500):
        # ArduPilot goes to another SIM_RATE_HZ by 1 Hz per frame
        rate_hz = 400 + count - 399
        after = read_line(face.answer(frame(count, 1600, rate_hz)))
        step_s = after["timestamp"] - before["timestamp"]
        assert math.isclose(step_s, 1 / rate_hz, rel_tol=1e-9)
        climbed = before["position"][2] - after["position"][2]
        assert math.isclose(climbed, -step_s * (before["velocity"][2] + after["velocity"][2]) / 2, rel_tol=1e-3)
        before = after


@pytest.mark.parametrize(
    ("pulse_us", "command"), [(0, 0.0), (900, 0.0), (1000, 0.0), (1250, 0.25), (2000, 1.0), (2100, 1.0), (65535, 1.0)]
)
def test_pulses_become_commands(pulse_us: int, command: float) -> None:
    face = new_face()
    for count in range(800):
        face.answer(frame(count, pulse_us))
    assert math.isclose(face.body.truth.delta()[3], command, abs_tol=1e-6)
    assert bool(face.report.outside) == (pulse_us == 65535)
    assert face.armed == (command > 0.0)


def test_a_pulse_that_is_none_is_named_once() -> None:
    face = new_face()
    for count in range(10):
        face.answer(ServoFrame(400, count, (1000, 1000, 40000 + count, *[1000] * 13)))
    assert len(face.report.faults) == 1
    assert "output 3 is no servo's pulse (40000 us)" in face.report.faults[0]


def test_a_motion_that_diverges_is_said_and_still_answered() -> None:
    face = new_face()
    pwm = (1000, 2000, 2000, 1000, *[0] * 12)
    face.answer(ServoFrame(400, 0, pwm))
    face.body.plant.x[3] = 1e9
    for count in range(1, 4):
        read_line(face.answer(ServoFrame(400, count, pwm)))
    assert sum("diverged" in fault for fault in face.report.faults) == 1


# -- motors ----------------------------------------------------------------------------------------------------


def rotors_of(number: int, radius_m: float = 0.2) -> list[Rotor]:
    """Rotors in ArduPilot's own order of one of its frames."""
    return [
        Rotor(
            px_m=radius_m * math.cos(math.radians(angle)),
            py_m=radius_m * math.sin(math.radians(angle)),
            pz_m=0.0,
            km=0.05 * turn,
        )
        for angle, turn in FRAMES[number].motors
    ]


def effects(rotors: list[Rotor]) -> list[RotorEffect]:
    return [RotorEffect((one.px_m, one.py_m, one.pz_m), km=one.km) for one in rotors]


@settings(max_examples=50, deadline=None)
@given(st.integers(0, len(FRAMES) - 1), st.randoms(use_true_random=False), st.floats(0.05, 2.0))
def test_each_output_drives_the_rotor_that_stands_where_ardupilot_takes_it_to_be(
    number: int, random: object, radius_m: float
) -> None:
    mine = rotors_of(number, radius_m)
    order = list(range(len(mine)))
    random.shuffle(order)  # type: ignore[attr-defined]
    rotors = [mine[i] for i in order]
    fit = fit_frame("X", rotors, normalised_mix(effects(rotors)))
    assert (fit.frame.frame_class, len(fit.order)) == (FRAMES[number].frame_class, len(mine))
    for output, rotor in enumerate(fit.order):
        angle, turn = fit.frame.motors[output]
        assert math.isclose(math.cos(math.radians(angle)) * radius_m, rotors[rotor].px_m, abs_tol=1e-9)
        assert math.isclose(math.sin(math.radians(angle)) * radius_m, rotors[rotor].py_m, abs_tol=1e-9)
        assert (turn == CCW) == (rotors[rotor].km > 0.0)
    assert sorted(fit.order) == list(range(len(mine)))


@pytest.mark.parametrize(
    ("spec", "name", "roll"),
    [
        ("ant-x", "quad X", 0.7071),
        ("ant-r", "quad X", 0.7071),
        ("adam-0", "quad X", 0.7493),
        ("carrier-1", "octa X", 0.5412),
    ],
)
def test_the_built_in_airframes_have_a_frame(spec: str, name: str, roll: float) -> None:
    rotors = list(resolve_vehicle(spec).airframe.rotors)
    mix = normalised_mix(effects(rotors))
    fit = fit_frame(spec, rotors, mix)
    assert fit.frame.name == name
    assert math.isclose(fit.roll, roll, abs_tol=5e-5)
    # a unit of ArduPilot's roll command, motor by motor, as PX4's mix sees it
    motors = ardupilot_mix(fit.frame)[:, 0]
    torque = sum(mix.inverse[0, rotor] * motors[output] for output, rotor in enumerate(fit.order))
    assert math.isclose(torque, roll, abs_tol=5e-5)


def test_half_a_roll_command_is_that_much_delta_lat_in_the_plant() -> None:
    face = new_face()
    roll = ardupilot_mix(FRAMES[0])[:, 0]
    pulses = [round(1500 + 1000 * 0.5 * one) for one in roll]
    for count in range(200):
        face.answer(ServoFrame(400, count, (*pulses, *[0] * 12)))
    lateral, longitudinal, yaw, thrust = face.body.truth.delta()
    assert math.isclose(lateral, 0.5 * 0.70711, abs_tol=1e-4)
    assert max(abs(longitudinal), abs(yaw), abs(thrust - 0.5)) < 1e-4


@pytest.mark.parametrize("place", ["turned", "three", "spins"])
def test_rotors_that_are_no_frame_of_ardupilots_are_said_so(place: str) -> None:
    rotors = rotors_of(0)
    if place == "turned":
        rotors = [
            Rotor(0.2 * math.cos(a), 0.2 * math.sin(a), 0.0, 0.05 * (-1) ** i)
            for i, a in enumerate([0.1, 0.5, 2.0, 4.0])
        ]
    elif place == "three":
        rotors = rotors[:3]
    else:
        rotors = [Rotor(one.px_m, one.py_m, one.pz_m, 0.05 if one.px_m > 0 else -0.05) for one in rotors]
    with pytest.raises(UsageError, match=r"MINE: ArduPilot has no frame with its rotors .*deg (ccw|cw).*PX4"):
        fit_frame("MINE", rotors, normalised_mix(effects(rotors)))
