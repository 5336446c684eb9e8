"""What PX4's modules write back when parameters contradict one another."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.param_corrections import DELAY_US, ParameterCorrector, correct
from sitl.parameters import ParameterTable

NAMES = (
    "MPC_TILTMAX_AIR",
    "MPC_TILTMAX_LND",
    "MPC_XY_CRUISE",
    "MPC_XY_VEL_MAX",
    "MPC_VEL_MANUAL",
    "MPC_VEL_MAN_BACK",
    "MPC_VEL_MAN_SIDE",
    "MPC_Z_V_AUTO_UP",
    "MPC_Z_VEL_MAX_UP",
    "MPC_Z_V_AUTO_DN",
    "MPC_Z_VEL_MAX_DN",
    "MPC_THR_HOVER",
    "MPC_THR_MIN",
    "MPC_THR_MAX",
    "LNDMC_Z_VEL_MAX",
    "MPC_LAND_CRWL",
    "MPC_LAND_SPEED",
)


def test_the_defaults_need_no_correction() -> None:
    table = ParameterTable()
    assert correct(table) == []
    assert table.revision == 0


@pytest.mark.parametrize(
    ("changes", "corrected", "texts"),
    [
        ({"MPC_XY_VEL_MAX": 4.0}, {"MPC_XY_CRUISE": 4.0, "MPC_VEL_MANUAL": 4.0}, 2),
        ({"MPC_XY_CRUISE": 15.0}, {"MPC_XY_CRUISE": 12.0}, 1),
        ({"MPC_VEL_MAN_BACK": 11.0}, {"MPC_VEL_MAN_BACK": 10.0}, 1),
        ({"MPC_Z_V_AUTO_UP": 5.0, "MPC_Z_V_AUTO_DN": 2.0}, {"MPC_Z_V_AUTO_UP": 3.0, "MPC_Z_V_AUTO_DN": 1.5}, 2),
        ({"MPC_TILTMAX_AIR": 120.0}, {"MPC_TILTMAX_AIR": 89.0}, 1),
        ({"MPC_TILTMAX_AIR": 10.0}, {"MPC_TILTMAX_LND": 10.0}, 1),
        ({"MPC_THR_HOVER": 0.05}, {"MPC_THR_HOVER": 0.12}, 1),
        ({"MPC_THR_MAX": 0.4}, {"MPC_THR_HOVER": 0.4}, 1),
        ({"LNDMC_Z_VEL_MAX": 2.0}, {"LNDMC_Z_VEL_MAX": 0.25}, 0),
        ({"IMU_GYRO_RATEMAX": 0}, {"IMU_GYRO_RATEMAX": 400}, 0),
        ({"IMU_GYRO_RATEMAX": 20}, {"IMU_GYRO_RATEMAX": 50}, 0),
        ({"IMU_GYRO_RATEMAX": 20000}, {"IMU_GYRO_RATEMAX": 10000}, 0),
        ({"MPC_XY_CRUISE": math.nan}, {}, 0),
    ],
)
def test_it_writes_back_what_px4_does(changes: dict[str, float], corrected: dict[str, float], texts: int) -> None:
    table = ParameterTable()
    for name, value in changes.items():
        table.set(name, value)
    said = correct(table)
    assert len(said) == texts
    assert all(text.endswith("\t") for text in said)
    for name in ParameterTable():
        expected = {**changes, **corrected}.get(name, table.default(name))
        assert table.get(name) == pytest.approx(expected, nan_ok=True)


@given(st.dictionaries(st.sampled_from(NAMES), st.floats(width=32)))
def test_what_is_corrected_stays_correct(changes: dict[str, float]) -> None:
    table = ParameterTable()
    for name, value in changes.items():
        table.set(name, value)
    correct(table)
    again = correct(table)
    # the hover thrust cannot be right while the least thrust is above the largest
    least, most = table.get("MPC_THR_MIN"), table.get("MPC_THR_MAX")
    hopeless = least > most and table.get("MPC_THR_HOVER") == table.get("MPC_THR_HOVER")
    assert again == ([] if not hopeless else ["Hover thrust has been constrained by min/max\t"])


def test_it_waits_and_is_heard_as_a_change_of_its_own() -> None:
    table = ParameterTable()
    corrector = ParameterCorrector(table)
    table.set("MPC_XY_CRUISE", 15.0)
    set_at = table.revision
    said = {}
    for now_us in range(0, 3_000_000, 4_000):
        texts = corrector.poll(now_us)
        if texts:
            said[now_us] = texts
        assert (table.get("MPC_XY_CRUISE") == 15.0) == (now_us < DELAY_US)
    assert said == {DELAY_US: ["Cruise speed has been constrained by max speed\t"]}
    assert table.changed_since(set_at) == ("MPC_XY_CRUISE",)
