"""Files that cannot be judged: a line that names file, lack and remedy, status 2, and never a traceback."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bridge import ulog
from bridge.connection import Connection
from bridge.ulog import Layout
from scenarios import cli
from scenarios.flight_import.excitation import accepted
from scenarios.flight_import.step_finder import find
from scenarios.flight_import.tlog_source import read_tlog
from scenarios.flight_import.ulog_source import read_ulog
from sitl.errors import FileError

ATTITUDE = Layout("vehicle_attitude", "uint64_t timestamp;uint64_t timestamp_sample;float[4] q")
SETPOINT = Layout("vehicle_attitude_setpoint", "uint64_t timestamp;float[4] q_d")
STATUS = Layout("vehicle_status", "uint64_t timestamp;uint8_t arming_state;uint8_t nav_state;uint8_t vehicle_type")
LAYOUTS = (ATTITUDE, SETPOINT, STATUS)
OFFBOARD, ARMED, MULTIROTOR, FIXED_WING = 14, 2, 1, 2


def quat(roll_deg: float) -> tuple[float, float, float, float]:
    half = np.radians(roll_deg) / 2
    return float(np.cos(half)), float(np.sin(half)), 0.0, 0.0


def small_ulog(
    seconds: float = 10.0,
    *,
    kind: int = MULTIROTOR,
    armed: int = ARMED,
    attitude: bool = True,
    backwards: bool = False,
    step_deg: float = 10.0,
    ramp_s: float = 0.0,
) -> bytes:
    """A flight of a first-order vehicle in Offboard, with a step after three seconds."""
    parts = [ulog.header(0), ulog.flag_bits(), *(layout.definition() for layout in LAYOUTS)]
    parts += [ulog.subscription(n, layout.topic) for n, layout in enumerate(LAYOUTS)]
    roll = 0.0
    for k in range(round(seconds * 50)):
        t = 0.02 * k
        wanted = step_deg * min(1.0, max(0.0, (t - 3.0) / ramp_s)) if ramp_s else step_deg * (t >= 3.0)
        roll += (wanted - roll) * 0.12
        stamp = 1_000_000 + 20_000 * (round(seconds * 50) - k if backwards else k)
        if attitude:
            parts.append(ATTITUDE.pack(0, (stamp, stamp, *quat(roll))))
        parts.append(SETPOINT.pack(1, (stamp, *quat(wanted))))
        if k % 25 == 0:
            parts.append(STATUS.pack(2, (stamp, armed, OFFBOARD, kind)))
    return b"".join(parts)


def small_tlog(*, heartbeats_only: bool = False, kind: int = 2, armed: bool = True) -> bytes:
    """The same over MAVLink."""
    out, sender, roll = [], Connection(1, 1), 0.0

    def add(name: str, /, **fields: Any) -> None:
        out.append(struct.pack(">Q", 10**15 + 1000 * len(out)) + sender.encode(name, **fields))

    for k in range(500):
        t_ms = 1000 + 20 * k
        if k % 25 == 0:
            add("HEARTBEAT", type=kind, autopilot=12, base_mode=128 * armed, custom_mode=6 << 16, system_status=4)
        if heartbeats_only:
            continue
        wanted = 10.0 * (k >= 150)
        roll += (wanted - roll) * 0.12
        add("ATTITUDE", time_boot_ms=t_ms, roll=np.radians(roll))
        add("ATTITUDE_TARGET", time_boot_ms=t_ms, q=quat(wanted), thrust=0.5)
    return b"".join(out)


CASES: dict[str, tuple[bytes, str]] = {
    "empty.ulg": (b"", "is empty"),
    "empty.tlog": (b"", "is empty"),
    "text.ulg": (b"this is no log at all, and never was one", "is no ULog that can be read"),
    "text.tlog": (b"this is no log at all, and never was one", "no MAVLink message in its 40 bytes"),
    "header.ulg": (ulog.header(0), "has no vehicle_attitude"),
    "bare.ulg": (small_ulog(attitude=False), "has no vehicle_attitude (it has vehicle_attitude_setpoint"),
    "plane.ulg": (small_ulog(kind=FIXED_WING), "is the flight of a fixed wing (vehicle_type 2)"),
    "bench.ulg": (small_ulog(armed=1), "the vehicle never armed: nothing was flown"),
    "backwards.ulg": (small_ulog(backwards=True), "time goes backwards"),
    "short.ulg": (small_ulog(0.5), "holds 25 attitude samples; 50 are needed"),
    "still.ulg": (small_ulog(step_deg=0.0), "largest step in roll 0.0 deg over the flight; 3 deg are needed"),
    "hearts.tlog": (small_tlog(heartbeats_only=True), "has no ATTITUDE of system 1: 20 HEARTBEAT"),
    "plane.tlog": (small_tlog(kind=1), "system 1 is a fixed wing (MAV_TYPE 1)"),
    "bench.tlog": (small_tlog(armed=False), "the vehicle never armed: nothing was flown"),
}


@pytest.mark.parametrize("name", CASES)
def test_what_cannot_be_judged(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, said = CASES[name]
    path = tmp_path / name
    path.write_bytes(data)
    assert cli.main(["review", str(path), "--out", str(tmp_path / "runs")]) == cli.EXIT_USAGE
    line = capsys.readouterr().err
    assert line.startswith(f"froude: {path}: ")
    assert said in line
    assert line.count("\n") == 1
    assert line.rstrip().count(". ") >= 1, "no remedy"
    assert not (tmp_path / "runs").exists()


def test_a_file_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("none.ulg", "none.tlog"):
        assert cli.main(["review", str(tmp_path / name)]) == cli.EXIT_USAGE
        assert "cannot be read: No such file" in capsys.readouterr().err


def test_what_the_small_logs_show_is_found(tmp_path: Path) -> None:
    for name, data, read in (("a.ulg", small_ulog(), read_ulog), ("a.tlog", small_tlog(), read_tlog)):
        (tmp_path / name).write_bytes(data)
        recorded = read(tmp_path / name)
        (segment,), _ = accepted(recorded, find(recorded))
        assert segment.kind == "step"
        assert segment.start_s == pytest.approx(4.0, abs=0.021)


def test_topics_of_an_older_px4(tmp_path: Path) -> None:
    """Rates were in vehicle_attitude, and torques in actuator_controls_0."""
    attitude = Layout(
        "vehicle_attitude", "uint64_t timestamp;float[4] q;float rollspeed;float pitchspeed;float yawspeed"
    )
    controls = Layout("actuator_controls_0", "uint64_t timestamp;uint64_t timestamp_sample;float[8] control")
    parts = [ulog.header(0), ulog.flag_bits()]
    parts += [one.definition() for one in (attitude, controls, STATUS)]
    parts += [ulog.subscription(n, one.topic) for n, one in enumerate((attitude, controls, STATUS))]
    for k in range(100):
        stamp = 1_000_000 + 10_000 * k
        parts.append(attitude.pack(0, (stamp, *quat(1.0), 0.5, 0.0, 0.0)))
        parts.append(controls.pack(1, (stamp, 0, 0.25, *[0.0] * 7)))
        parts.append(STATUS.pack(2, (stamp, ARMED, OFFBOARD, MULTIROTOR)))
    path = tmp_path / "old.ulg"
    path.write_bytes(b"".join(parts))
    telemetry = read_ulog(path).telemetry
    assert telemetry["p_rad_s"][-1] == 0.5
    assert telemetry["delta_lat"][-1] == 0.25
    with pytest.raises(FileError, match=r"has no roll set-point \(vehicle_attitude_setpoint\)"):
        accepted(read_ulog(path), find(read_ulog(path)))


def test_a_quick_ramp_is_a_step_from_its_half_and_a_slow_one_is_none(tmp_path: Path) -> None:
    path = tmp_path / "ramp.ulg"
    path.write_bytes(small_ulog(ramp_s=0.2))
    found = find(read_ulog(path))
    (segment,) = found.segments
    assert segment.start_s == pytest.approx(4.1, abs=0.03)
    assert any("counted as a step from its half" in note for note in found.notes)
    path.write_bytes(small_ulog(ramp_s=2.5))
    assert not [one for one in find(read_ulog(path)).segments if one.kind == "step"]


def test_a_truncated_log_gives_what_it_has(tmp_path: Path) -> None:
    whole, path = small_ulog(), tmp_path / "cut.ulg"
    path.write_bytes(whole[: len(whole) * 9 // 10])
    assert [one.kind for one in find(read_ulog(path)).segments] == ["step"]


WHOLE = {"ulg": small_ulog(6.0), "tlog": small_tlog()}


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(sorted(WHOLE)),
    cut=st.floats(0.0, 1.0),
    flips=st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 255)), max_size=12),
    head=st.booleans(),
    tail=st.binary(max_size=64),
)
def test_no_bytes_end_in_a_traceback(
    tmp_path: Path, kind: str, cut: float, flips: list[tuple[float, int]], head: bool, tail: bytes
) -> None:
    data = bytearray(WHOLE[kind])
    span = min(len(data), 700) if head else len(data)  # most of the trouble is in the definitions
    for where, value in flips:
        data[min(int(where * span), len(data) - 1)] = value
    path = tmp_path / f"damaged.{kind}"
    path.write_bytes(bytes(data[: int(cut * len(data))]) + tail)
    said = ""
    try:
        recorded = (read_ulog if kind == "ulg" else read_tlog)(path)
        accepted(recorded, find(recorded))
    except FileError as error:
        said = str(error)
    assert said == "" or said.startswith(str(path))
    assert "\n" not in said
