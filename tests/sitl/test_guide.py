"""What all modes must bear: parameters set to nonsense, switches in any order."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from sitl.modes import Mode
from sitl.parameters import parameter_specs
from sitl.setpoints import Sticks

MODES = (Mode.STABILIZED, Mode.ACRO, Mode.ALTCTL, Mode.POSCTL, Mode.MISSION, Mode.RTL, Mode.LOITER, Mode.LAND)
FLOWN_BY = ("MPC_", "RTL_", "NAV_", "MIS_", "MAN_", "MC_ACRO", "MC_MAN", "COM_SPOOLUP")


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1.0, 0.0])
def test_no_parameter_stops_a_mode(flown: Any, mode: Mode, value: float) -> None:
    flight = flown()
    flight.run(1.2)
    flight.take_off(5.0)
    for name, spec in parameter_specs().items():
        if name.startswith(FLOWN_BY):
            flight.parameters.set(name, value if spec.type == "REAL32" else max(-1, int(spec.default) - 1))
    flight.control.load()
    flight.control.sticks = Sticks(0.3, -0.4, 0.5, 0.2)
    flight.control.mission.load((flown.rise(), flown.waypoint(20.0, 5.0, 8.0)))
    flight.begin(mode)
    for _ in range(250):
        flight.step()
    flight.control.sticks = None
    flight.begin(Mode.MISSION if mode is not Mode.MISSION else Mode.RTL)
    for _ in range(250):
        flight.step()


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(order=[(Mode.ALTCTL, 3.0)] * 8)
@example(order=[(Mode.ALTCTL, 2.0), (Mode.ALTCTL, 3.0), (Mode.ALTCTL, 3.0)])
@given(order=st.lists(st.tuples(st.sampled_from(MODES[2:]), st.floats(0.05, 3.0)), min_size=3, max_size=8))
def test_modes_in_any_order_never_upset_it(flown: Any, order: list[tuple[Mode, float]]) -> None:
    flight = flown()
    flight.run(1.2)
    flight.take_off(15.0)
    flight.control.mission.load((flown.waypoint(20.0, 5.0, 12.0), flown.waypoint(-10.0, 5.0, 18.0)))
    flight.control.sticks = Sticks(0.5, 0.7, -0.2, 0.1)
    for mode, seconds in order:
        flight.begin(mode)
        flight.run(seconds)
    assert flight.tilt_max_deg < 50.0
    flight.begin(Mode.LOITER)
    flight.run(16.0)  # Altitude does not hold it against the air: it may come with more than 20 m/s
    assert math.hypot(*flight.velocity) < 0.5


def test_sticks_in_the_modes_that_do_not_look_at_them(flown: Any) -> None:
    flight = flown()
    flight.run(1.2)
    flight.take_off(8.0)
    flight.control.sticks = Sticks(1.0, 1.0, 1.0, -1.0)
    place = flight.ned
    flight.run(4.0)
    assert math.dist(flight.ned, place) < 0.5
    assert np.isfinite(flight.plant.x).all()
