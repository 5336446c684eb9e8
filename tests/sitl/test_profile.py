"""The fidelity profiles and their overrides."""

import math
from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.errors import UsageError
from sitl.profile import PROFILES, Profile, get_profile


def test_study_is_the_bare_model() -> None:
    study = get_profile("study")
    assert (study.rate_hz, study.motor_lag(0.025), study.limits, study.linear) == (1000, 0.0, False, True)
    assert study.gyro_cutoff_hz == study.dgyro_cutoff_hz == study.attitude_late_ticks == 0.0
    assert study.rate_sp_late_ticks == study.transport_delay_ticks == 0
    assert all(row[1] == 0 for row in study.describe() if "noise" in row[0] or "quantum" in row[0])


def test_sitl_has_the_timing_measured_on_a_px4() -> None:
    sitl = get_profile("sitl")
    assert (sitl.rate_hz, sitl.tick_us) == (250, 4000)
    assert (sitl.transport_delay_ticks, sitl.rate_sp_late_ticks, sitl.attitude_late_ticks) == (0, 1, 0.5)
    assert (sitl.gyro_cutoff_hz, sitl.dgyro_cutoff_hz) == (40.0, 20.0)
    assert sitl.motor_lag(0.025) == 0.025


def test_board_differs_from_sitl_in_rate_and_one_tick_of_delay() -> None:
    sitl, board = get_profile("sitl"), get_profile("board")
    differing = {f.name for f in fields(Profile) if getattr(sitl, f.name) != getattr(board, f.name)}
    assert differing == {"name", "rate_hz", "transport_delay_ticks"}
    assert (board.rate_hz, board.tick_us, board.transport_delay_ticks) == (800, 1250, 1)


@pytest.mark.parametrize("name", PROFILES)
def test_every_item_is_described_and_can_be_given_back(name: str) -> None:
    profile = get_profile(name)
    rows = {item: value for item, value, _ in profile.describe()}
    assert list(rows) == [f.name for f in fields(Profile)]
    values = {f.name: getattr(profile, f.name) for f in fields(Profile) if f.name != "name"}
    assert get_profile(name, **values) == profile


def test_one_item_is_overridden_alone() -> None:
    profile = get_profile("sitl", motor_lag_s=0.01)
    assert profile.motor_lag(0.025) == 0.01
    assert get_profile("study", motor_lag_s=None).motor_lag(0.025) == 0.025
    assert get_profile("sitl", gyro_cutoff_hz=100).gyro_cutoff_hz == 100.0
    assert {f.name for f in fields(Profile) if getattr(profile, f.name) != getattr(PROFILES["sitl"], f.name)} == {
        "motor_lag_s"
    }


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"motor_lags": 0.1}, 'unknown item "motor_lags".*did you mean "motor_lag_s"'),
        ({"name": "mine"}, 'unknown item "name"'),
        ({"motor_lag_s": 2.0}, "motor_lag_s = 2: it must be a number from 0 to 0.5 s"),
        ({"motor_lag_s": -0.1}, "motor_lag_s"),
        ({"motor_lag_s": math.nan}, "motor_lag_s = nan"),
        ({"motor_lag_s": "fast"}, "motor_lag_s = 'fast'"),
        ({"gyro_cutoff_hz": None}, "gyro_cutoff_hz = None"),
        ({"gyro_cutoff_hz": True}, "gyro_cutoff_hz = True"),
        ({"transport_delay_ticks": 0.5}, "a whole number from 0 to 64 ticks"),
        ({"rate_sp_late_ticks": 2}, "a whole number from 0 to 1 ticks"),
        ({"limits": 1}, "limits = 1: it must be true or false"),
        ({"rate_hz": 300}, "whole number of microseconds, try 250 or 320"),
        ({"rate_hz": 10}, "a whole number from 50 to 8000 Hz"),
    ],
)
def test_a_bad_override_is_named_with_its_range(overrides: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        get_profile("sitl", **overrides)


def test_an_unknown_profile_is_named() -> None:
    with pytest.raises(UsageError, match=r'unknown profile "stil".*did you mean "sitl"'):
        get_profile("stil")


@given(
    st.sampled_from([f.name for f in fields(Profile) if f.name != "name"]),
    st.one_of(st.floats(), st.integers(), st.booleans(), st.none(), st.text(max_size=3)),
)
def test_any_value_is_taken_whole_or_refused_by_name(key: str, value: object) -> None:
    try:
        profile = get_profile("sitl", **{key: value})
    except UsageError as error:
        text = str(error)
    else:
        text = key
        assert getattr(profile, key) == value
        assert profile.tick_us * profile.rate_hz == 1_000_000
    assert key in text
