"""The parameter table: PX4's facts, exact bits, honest errors."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sitl.parameters
from sitl.errors import FileError, UsageError
from sitl.parameters import (
    ParameterTable,
    UnknownParameter,
    UnstorableValue,
    WrongParameterType,
    from_raw,
    parameter_specs,
    to_raw,
)

FOUR_BYTES = st.binary(min_size=4, max_size=4)

# PX4's own figures, written down independently of the file: name, type, default, min, max
PX4_FACTS = [
    ("MC_ROLL_P", "REAL32", 4.0, 0.0, 12.0),
    ("MC_YAW_P", "REAL32", 2.8, 0.0, 5.0),
    ("MC_YAW_WEIGHT", "REAL32", 0.4, 0.0, 1.0),
    ("MC_ROLLRATE_P", "REAL32", 0.15, 0.01, 0.5),
    ("MC_PITCHRATE_P", "REAL32", 0.15, 0.01, 0.6),
    ("MC_ROLLRATE_I", "REAL32", 0.2, 0.0, None),
    ("MC_ROLLRATE_D", "REAL32", 0.003, 0.0, 0.01),
    ("MC_PITCHRATE_D", "REAL32", 0.003, 0.0, None),
    ("MC_ROLLRATE_K", "REAL32", 1.0, 0.01, 5.0),
    ("MC_RR_INT_LIM", "REAL32", 0.3, 0.0, None),
    ("MC_ROLLRATE_MAX", "REAL32", 220.0, 0.0, 1800.0),
    ("MC_YAWRATE_MAX", "REAL32", 200.0, 0.0, 1800.0),
    ("MC_AIRMODE", "INT32", 0, None, None),
    ("IMU_GYRO_CUTOFF", "REAL32", 40.0, 0.0, 1000.0),
    ("IMU_DGYRO_CUTOFF", "REAL32", 20.0, 0.0, 1000.0),
    ("CA_ROTOR_COUNT", "INT32", 0, 0, 12),
    ("CA_ROTOR0_AZ", "REAL32", -1.0, -100.0, 100.0),
    ("CA_ROTOR11_CT", "REAL32", 6.5, 0.0, 100.0),
    ("CA_ROTOR7_KM", "REAL32", 0.05, -1.0, 1.0),
    ("CA_R11_SLEW", "REAL32", 0.0, 0.0, 10.0),
    ("MPC_THR_HOVER", "REAL32", 0.5, 0.1, 0.8),
    ("COM_OF_LOSS_T", "REAL32", 1.0, 0.0, 60.0),
    ("COM_DISARM_PRFLT", "REAL32", 10.0, None, None),
    ("CBRK_FLIGHTTERM", "INT32", 121212, 0, 121212),
    ("FD_FAIL_R", "INT32", 60, 0, 180),
    ("MAV_TYPE", "INT32", 2, 0, 22),
    ("SYS_PARAM_VER", "INT32", 1, 0, None),
    ("BAT1_CAPACITY", "REAL32", -1.0, -1.0, 100000.0),
    ("BAT_CRIT_THR", "REAL32", 0.07, 0.05, 0.5),
    ("COM_DL_LOSS_T", "INT32", 10, 5, 300),
    ("COM_RC_LOSS_T", "REAL32", 0.5, 0.0, 35.0),
    ("EKF2_ACC_B_NOISE", "REAL32", 0.003, 0.0, 0.01),
    ("EKF2_NOAID_TOUT", "INT32", 5000000, 500000, 10000000),
    ("HTE_HT_NOISE", "REAL32", 0.0036, 0.0001, 1.0),
    ("MPC_XY_CRUISE", "REAL32", 5.0, 3.0, 20.0),
    ("NAV_DLL_ACT", "INT32", 0, 0, 6),
    ("RC18_MAX", "REAL32", 2000.0, 1500.0, 2200.0),
    ("RC_MAP_AUX6", "INT32", 0, 0, 18),
    ("RTL_CONE_ANG", "INT32", 45, 0, 90),
    ("SENS_BOARD_ROT", "INT32", 0, -1, 40),
    ("TRIG_MODE", "INT32", 0, 0, 4),
    ("WV_YRATE_MAX", "REAL32", 90.0, 0.0, 120.0),
    # set by start-up scripts: what PX4's source says is in the file
    ("COM_RC_IN_MODE", "INT32", 1, 0, 8),
    ("NAV_ACC_RAD", "REAL32", 2.0, 0.05, 200.0),
    ("RTL_RETURN_ALT", "REAL32", 30.0, 0.0, None),
    ("RTL_DESCEND_ALT", "REAL32", 10.0, 0.0, None),
    ("SYS_AUTOSTART", "INT32", 10016, 0, 9999999),
]

# Without these QGroundControl complains of a vehicle that lacks parameters, or asks for a calibration
INSISTED_ON = """
    BAT_CRIT_THR BAT_EMERGEN_THR BAT_LOW_THR BAT1_CAPACITY BAT1_N_CELLS BAT1_SOURCE BAT1_V_CHARGED BAT1_V_EMPTY
    CAL_ACC0_ID CAL_GYRO0_ID CAL_MAG0_ID CAL_MAG1_ID CAL_MAG2_ID CAL_MAG0_ROT CAL_MAG1_ROT CAL_MAG2_ROT CAL_MAG3_ROT
    COM_FLTMODE1 COM_FLTMODE2 COM_FLTMODE3 COM_FLTMODE4 COM_FLTMODE5 COM_FLTMODE6 COM_RC_IN_MODE MAV_SYS_ID MAV_TYPE
    MIS_TAKEOFF_ALT NAV_DLL_ACT NAV_RCL_ACT RC_MAP_FLTMODE RC_MAP_PITCH RC_MAP_ROLL RC_MAP_THROTTLE RC_MAP_YAW RC1_TRIM
    RTL_RETURN_ALT SENS_BOARD_ROT SENS_BOARD_X_OFF SENS_BOARD_Y_OFF SENS_BOARD_Z_OFF SENS_DPRES_OFF SYS_AUTOCONFIG
    SYS_AUTOSTART SYS_PARAM_VER TRIG_MODE UAVCAN_ENABLE
"""


@pytest.mark.parametrize(("name", "kind", "default", "low", "high"), PX4_FACTS)
def test_facts_are_px4s(name: str, kind: str, default: float, low: float | None, high: float | None) -> None:
    spec = ParameterTable().spec(name)
    assert (spec.type, spec.minimum, spec.maximum) == (kind, low, high)
    assert spec.default == (default if kind == "INT32" else float(np.float32(default)))


def test_families_are_complete() -> None:
    names = set(parameter_specs())
    for axis, short in (("ROLL", "RR"), ("PITCH", "PR"), ("YAW", "YR")):
        parts = ("P", "I", "D", "FF", "K", "MAX")
        assert {f"MC_{axis}RATE_{p}" for p in parts} | {f"MC_{axis}_P", f"MC_{short}_INT_LIM"} <= names
    rotors = {f"CA_ROTOR{n}_{p}" for n in range(12) for p in ("PX", "PY", "PZ", "AX", "AY", "AZ", "CT", "KM")}
    assert rotors | {f"CA_R{n}_SLEW" for n in range(12)} <= names
    assert not any("{" in name for name in names)


def test_every_parameter_can_go_over_the_wire_and_explains_itself() -> None:
    table = ParameterTable()
    for name in table:
        spec = table.spec(name)
        assert 1 <= len(name.encode("ascii")) <= 16
        assert spec.group
        assert 3 < len(spec.short) < 120
        assert "{" not in spec.short
        assert isinstance(table.get(name), int if spec.type == "INT32" else float)
        assert table.out_of_range(name) is None
        assert spec.obeyed is not spec.short.startswith("Kept; no effect here"), name


def test_what_ground_stations_insist_on_is_there() -> None:
    specs = parameter_specs()
    assert set(INSISTED_ON.split()) <= set(specs)
    sensors = [specs[f"CAL_{sensor}0_ID"].default for sensor in ("ACC", "GYRO", "MAG", "BARO")]
    assert all(sensors), "a sensor without a number is one that was never calibrated"


def test_names_are_sorted_as_bytes_and_indexed_in_that_order() -> None:
    table = ParameterTable()
    assert list(table.names) == sorted(table.names, key=str.encode)
    assert [table.index(name) for name in table.names] == list(range(len(table)))
    assert table.names.index("CA_R10_SLEW") < table.names.index("CA_R1_SLEW")


@given(FOUR_BYTES)
def test_raw_bytes_are_kept_bit_for_bit(raw: bytes) -> None:
    table = ParameterTable()
    table.set_raw("MC_AIRMODE", raw)
    table.set_raw("MC_ROLL_P", raw)
    assert table.raw("MC_AIRMODE") == table.raw("MC_ROLL_P") == raw
    assert table.get("MC_AIRMODE") == int.from_bytes(raw, "little", signed=True)
    expected = float(np.frombuffer(raw, "<f4")[0])
    value = table.get("MC_ROLL_P")
    assert value == expected or (math.isnan(value) and math.isnan(expected))


@given(st.integers(-(2**31), 2**31 - 1))
def test_every_int32_is_stored(value: int) -> None:
    table = ParameterTable()
    table.set("FD_FAIL_R", value)
    assert table.get("FD_FAIL_R") == value


@given(st.floats(allow_nan=False, allow_infinity=True))
def test_real32_is_the_nearest_float32_or_refused(value: float) -> None:
    table = ParameterTable()
    with np.errstate(over="ignore"):
        nearest = float(np.float32(value))
    if math.isinf(nearest) and not math.isinf(value):
        with pytest.raises(UnstorableValue, match="MC_ROLL_P"):
            table.set("MC_ROLL_P", value)
    else:
        table.set("MC_ROLL_P", value)
        assert table.get("MC_ROLL_P") == nearest


def test_nan_infinity_and_out_of_range_are_stored_and_reported() -> None:
    table = ParameterTable()
    table.set("MC_ROLL_P", math.nan)
    assert math.isnan(table.get("MC_ROLL_P"))
    assert "not a finite number" in str(table.out_of_range("MC_ROLL_P"))
    table.set("MC_PITCHRATE_MAX", math.inf)
    assert table.get("MC_PITCHRATE_MAX") == math.inf
    table.set("MC_ROLLRATE_P", 99.0)
    assert table.get("MC_ROLLRATE_P") == 99.0
    assert table.out_of_range("MC_ROLLRATE_P") == (
        "MC_ROLLRATE_P = 99 is above PX4's maximum of 0.5 by 98.5, 198 times it"
    )
    table.set("MC_ROLLRATE_P", -1)
    assert "below PX4's minimum of 0.01 by 1.01" in str(table.out_of_range("MC_ROLLRATE_P"))
    table.set("MC_AIRMODE", 99)
    assert "none of PX4's choices" in str(table.out_of_range("MC_AIRMODE"))


def test_a_limit_itself_is_inside_although_float32_rounds_it_outwards() -> None:
    table = ParameterTable()
    for name in table:
        spec = table.spec(name)
        for limit in (spec.minimum, spec.maximum):
            if limit is not None and not spec.values:
                table.set(name, limit)
                assert table.out_of_range(name) is None


@pytest.mark.parametrize("value", [1.0, "1", None, math.nan, np.float32(1)])
def test_int32_takes_whole_numbers_only(value: object) -> None:
    table = ParameterTable()
    with pytest.raises(WrongParameterType, match=r"MC_AIRMODE is INT32"):
        table.set("MC_AIRMODE", value)  # type: ignore[arg-type]
    assert table.revision == 0
    assert table.changed() == ()


@pytest.mark.parametrize("value", ["1", None, True, 1j, b"\0\0\0\0"])
def test_real32_takes_real_numbers_only(value: object) -> None:
    with pytest.raises(WrongParameterType, match=r"MC_ROLL_P is REAL32"):
        ParameterTable().set("MC_ROLL_P", value)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [2**31, -(2**31) - 1, 10**30])
def test_int32_that_needs_more_bits_is_refused(value: int) -> None:
    with pytest.raises(UnstorableValue, match="MC_AIRMODE"):
        ParameterTable().set("MC_AIRMODE", value)


def test_numpy_numbers_are_numbers() -> None:
    table = ParameterTable()
    table.set("MC_AIRMODE", np.int64(2))
    table.set("MC_ROLL_P", np.float64(0.1))
    table.set("MC_PITCH_P", 5)
    assert table.get("MC_AIRMODE") == 2
    assert table.get("MC_ROLL_P") == float(np.float32(0.1))
    assert table.get("MC_PITCH_P") == 5.0


def test_unknown_names_are_answered_with_the_nearest() -> None:
    table = ParameterTable()
    calls = (
        lambda: table.get("MC_ROLRATE_P"),
        lambda: table.set("MC_ROLRATE_P", 1),
        lambda: table.raw("MC_ROLRATE_P"),
        lambda: table.set_raw("MC_ROLRATE_P", b"\0\0\0\0"),
        lambda: table.spec("MC_ROLRATE_P"),
        lambda: table.index("MC_ROLRATE_P"),
        lambda: table.reset("MC_ROLRATE_P"),
        lambda: table.out_of_range("MC_ROLRATE_P"),
        lambda: ParameterTable({"MC_ROLRATE_P": 1}),
    )
    for call in calls:
        with pytest.raises(UnknownParameter, match="MC_ROLLRATE_P") as caught:
            call()
        assert "MC_ROLLRATE_P" in caught.value.nearest
    with pytest.raises(UnknownParameter, match="MC_ROLL_P"):
        table.get("mc_roll_p")
    assert "MC_ROLRATE_P" not in table


def test_set_raw_wants_four_bytes() -> None:
    for raw in (b"", b"123", b"12345"):
        with pytest.raises(UsageError, match="4 bytes"):
            ParameterTable().set_raw("MC_ROLL_P", raw)


def test_overrides_are_this_vehicles_defaults() -> None:
    table = ParameterTable({"CA_ROTOR_COUNT": 4, "CA_ROTOR0_PX": 0.06})
    assert table.get("CA_ROTOR_COUNT") == 4
    assert table.changed() == ()
    assert table.revision == 0
    table.set("CA_ROTOR0_PX", 0.2)
    table.set("MC_ROLL_P", 9.0)
    assert table.changed() == ("CA_ROTOR0_PX", "MC_ROLL_P")
    table.reset("CA_ROTOR0_PX")
    assert table.get("CA_ROTOR0_PX") == table.default("CA_ROTOR0_PX") == float(np.float32(0.06))
    table.reset()
    assert table.changed() == ()
    assert ParameterTable().get("CA_ROTOR_COUNT") == 0


def test_revision_counts_sets_and_changed_since_counts_changes() -> None:
    table = ParameterTable()
    table.set("MC_ROLL_P", 4.0)
    assert table.revision == 1
    assert table.changed_since(0) == ()
    table.set("MC_PITCH_P", 5.0)
    before = table.revision
    table.set("MC_ROLL_P", 6.0)
    assert table.changed_since(0) == ("MC_PITCH_P", "MC_ROLL_P")
    assert table.changed_since(before) == ("MC_ROLL_P",)
    assert table.changed_since(table.revision) == ()


def crc32_px4(data: bytes) -> int:
    """Reflected polynomial 0xEDB88320, bit by bit, start 0, no final inversion."""
    state = 0
    for byte in data:
        state ^= byte
        for _ in range(8):
            state = (state >> 1) ^ (0xEDB88320 if state & 1 else 0)
    return state


def test_hash_is_px4s_crc_over_names_and_values() -> None:
    table = ParameterTable({"CA_ROTOR_COUNT": 4})
    table.set("MC_ROLL_P", math.nan)
    table.set("MC_AIRMODE", -1)
    data = b""
    for name in sorted(table.names):
        if table.spec(name).volatile:
            continue
        form = "<i" if table.spec(name).type == "INT32" else "<f"
        data += name.encode() + struct.pack(form, table.get(name))
    assert table.hash_check() == crc32_px4(data)
    before = table.hash_check()
    table.set("LND_FLIGHT_T_LO", 5)  # changes with every flight, so no cache may depend on it
    table.set("MC_AIRMODE", -1)
    assert table.hash_check() == before
    table.set("MC_AIRMODE", 0)
    assert table.hash_check() != before
    table.set("MC_AIRMODE", -1)
    assert table.hash_check() == before


def load(tmp_path: Path, text: str) -> object:
    path = tmp_path / "parameters.toml"
    path.write_text(text)
    return sitl.parameters._load(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('["A"]\nX_Y = { default = 1.0, min = 0, short = "x" }', "X_Y: min = 0 is not a float"),
        ('["A"]\nX_Y = { default = 1, max = 2.0, short = "x" }', "X_Y: max = 2.0 is not a int"),
        ('["A"]\nX_Y = { default = "1", short = "x" }', "X_Y: default = '1'"),
        ('["A"]\nX_Y = { default = true, short = "x" }', "X_Y: default = True"),
        ('["A"]\nX_Y = { short = "x" }', "X_Y lacks 'default'"),
        (
            '["A"]\nX_Y = { default = 1, shrt = "x" }',
            "X_Y has the unknown key 'shrt'. Nearest valid key: short",
        ),
        ('["A"]\nX_Y = { default = 3, max = 2, short = "x" }', "X_Y = 3 is above"),
        (
            '["A"]\nA12345678901234567 = { default = 1, short = "x" }',
            "A12345678901234567 is no parameter name",
        ),
        ('["A"]\nx_y = { default = 1, short = "x" }', "x_y is no parameter name"),
        ('["A"]\nX_Y = { default = 1, short = "x" }\nX_Y = { default = 1, short = "x" }', "is not TOML"),
        (
            '["A"]\nX_Y = { default = 1, short = "x" }\n["B"]\nX_Y = { default = 1, short = "x" }',
            "listed twice",
        ),
        (
            '["A"]\n"X{0..2}" = { default = 1, short = "x" }\nX1 = { default = 1, short = "x" }',
            "X1 is listed twice",
        ),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FileError) as caught:
        load(tmp_path, text)
    assert message in str(caught.value)
    assert "parameters.toml" in str(caught.value)


@given(FOUR_BYTES)
def test_raw_and_value_agree_with_numpy(raw: bytes) -> None:
    assert from_raw("INT32", raw) == int(np.frombuffer(raw, "<i4")[0])
    value = from_raw("REAL32", raw)
    if not math.isnan(value):
        assert to_raw("X", "REAL32", value) == raw
