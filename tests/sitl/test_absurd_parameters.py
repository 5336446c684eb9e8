"""Whatever a ground station writes into the parameters of commander, navigator and position controller: it flies on
or comes down, and nothing raises."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sitl.modes import Mode
from sitl.parameters import ParameterTable, parameter_specs
from sitl.sensors import geodetic
from sitl.setpoints import PositionRequest, Reposition, Sticks

FAMILIES = ("COM_", "NAV_", "RTL_", "MPC_", "MIS_", "MAN_", "MC_ACRO", "MC_MAN", "FD_", "LNDMC_", "CBRK_")
NAMES = sorted(name for name, spec in parameter_specs().items() if spec.obeyed and name.startswith(FAMILIES))
REALS = [name for name in NAMES if ParameterTable().spec(name).type == "REAL32"]
INTEGERS = sorted(set(NAMES) - set(REALS))
ABSURD = [math.nan, math.inf, -math.inf, 3.4e38, -1.0, 0.0, 1e-38]
WHOLE = [-(2**31), -1, 0, 1, 2, 3, 4, 5, 6, 7, 8, 99, 2**31 - 1]
NAN3 = (math.nan, math.nan, math.nan)
STICKS = (Sticks(0.5, -0.5, 0.5, 0.5), Sticks(), Sticks(-1.0, 1.0, -1.0, -1.0))
MODES = (
    Mode.POSCTL,
    Mode.ALTCTL,
    Mode.STABILIZED,
    Mode.ACRO,
    Mode.LOITER,
    Mode.RTL,
    Mode.TAKEOFF,
    Mode.MISSION,
    Mode.ORBIT,
    Mode.OFFBOARD,
    Mode.LAND,
    Mode.DESCEND,
)


def begin(made: Any, mode: Mode) -> None:
    """Switch, with something to fly."""
    autopilot = made.autopilot
    lat, lon, alt = geodetic((5.0, 2.0, -6.0))
    if mode is Mode.LOITER:
        autopilot.command_reposition(Reposition(lat, lon, alt, 1.0, math.nan))
    elif mode is Mode.ORBIT:
        autopilot.command_orbit(Reposition(lat, lon, alt, math.nan, math.nan), radius_m=math.nan, speed_m_s=2.0)
    elif mode is Mode.TAKEOFF:
        autopilot.command_takeoff(None)
    elif mode is Mode.OFFBOARD:
        autopilot.offboard_position(PositionRequest((1.0, 2.0, -3.0), NAN3, NAN3, 1.0, math.nan))
        autopilot.command_mode(mode)
        autopilot.offboard_position(PositionRequest((1.0, 2.0, -3.0), NAN3, NAN3, 1.0, math.nan))
    else:
        autopilot.command_mode(mode)


def sane(made: Any) -> None:
    assert all(0.0 <= motor <= 1.0 for motor in made.autopilot.motors)
    assert np.isfinite(made.vehicle.plant.x).all()
    assert made.autopilot.mode in Mode
    assert len(made.autopilot.position_sp.position_ned) == 3
    assert made.autopilot.landed_state is not None


@pytest.fixture
def mission(flown: Any) -> Any:
    """Up, a place, a circle, a wait, home."""
    return (
        flown.rise(5.0),
        flown.waypoint(4.0, 0.0, 6.0, hold_s=0.1),
        flown.item(18, (4.0, 2.0, -6.0), (1.0, 0.0, 2.0, math.nan)),
        flown.item(20),
    )


@pytest.mark.parametrize("value", ABSURD)
def test_one_after_the_other_in_every_mode(hover: Any, mission: Any, value: float) -> None:
    hover.parameters.set("COM_DISARM_LAND", -1.0)
    hover.autopilot.control.mission.load(mission)
    for number, name in enumerate(REALS):
        hover.parameters.set(name, value)
        for mode in MODES:
            hover.autopilot.manual.take(hover.vehicle.time_us, 0, STICKS[number % 3])
            begin(hover, mode)
            hover.run(0.024)
        sane(hover)
        hover.parameters.reset(name)
        if not hover.autopilot.armed:
            hover.autopilot.command_mode(Mode.LOITER)
            hover.autopilot.command_arm(True)
    assert len(REALS) > 60


VALUE = st.sampled_from(ABSURD) | st.floats(width=32)
REAL_SETTINGS = st.lists(st.tuples(st.sampled_from(REALS), VALUE), max_size=4)
WHOLE_SETTINGS = st.lists(st.tuples(st.sampled_from(INTEGERS), st.sampled_from(WHOLE)), max_size=3)
STEP = st.tuples(st.sampled_from(MODES), st.sampled_from([*STICKS, None]), REAL_SETTINGS, st.booleans())


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(before=REAL_SETTINGS, whole=WHOLE_SETTINGS, steps=st.lists(STEP, min_size=1, max_size=6))
def test_flights_with_several_at_once(
    flight: Any,
    mission: Any,
    before: list[tuple[str, float]],
    whole: list[tuple[str, int]],
    steps: list[tuple[Mode, Sticks | None, list[tuple[str, float]], bool]],
) -> None:
    made = flight()
    made.run(2.1)
    made.autopilot.gcs_heard()
    made.autopilot.control.mission.load(mission)
    for name, value in (*before, *whole):
        made.parameters.set(name, value)
    made.autopilot.command_arm(True)
    made.autopilot.command_takeoff(None)
    made.run(2.5)
    for mode, sticks, changes, heard in steps:
        for name, value in changes:
            made.parameters.set(name, value)
        if heard:
            made.autopilot.gcs_heard()
        if sticks is not None:
            made.autopilot.manual.take(made.vehicle.time_us, 0, sticks)
        begin(made, mode)
        made.run(0.8)
        sane(made)
    for name in (*NAMES,):
        made.parameters.reset(name)
    made.autopilot.command_land()
    made.run(0.5)
    sane(made)


@pytest.mark.parametrize("name", [name for name in REALS if name.startswith("MPC_")])
def test_a_flight_recovers_from_nonsense_taken_back(hover: Any, pilot: Any, name: str) -> None:
    """An integrator or a filter must not stay poisoned once the parameter is right again."""
    sticks = pilot(hover)
    sticks.fly(0.1)
    hover.autopilot.command_mode(Mode.POSCTL)
    for value in (math.nan, math.inf):
        hover.parameters.set(name, value)
        sticks.fly(0.1, pitch=0.3, throttle=0.1)
        hover.parameters.reset(name)
        sticks.fly(3.0)
    sticks.fly(6.0)
    assert hover.autopilot.armed
    assert hover.vehicle.truth.velocity_ned() == pytest.approx((0.0, 0.0, 0.0), abs=0.15)
    assert hover.autopilot.mode is Mode.POSCTL
