"""Return, flown and by its rules."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.legs import Here, LegKind
from sitl.modes import Home, Mode
from sitl.parameters import ParameterTable
from sitl.return_home import ReturnHome, ReturnState
from sitl.sensors import geodetic
from sitl.setpoints import Reposition

HOME = Home(47.0, 8.0, 488.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def here(n: float, height_m: float, *, landed: bool = False, now_us: int = 0) -> Here:
    return Here(now_us, (n, 0.0, -height_m), 0.0, landed, HOME)


class TestHeight:
    @pytest.mark.parametrize(
        ("n", "height_m", "back_at_m"),
        [
            (100.0, 5.0, 30.0),
            (100.0, 50.0, 50.0),
            (8.0, 3.0, 8.0),  # the cone of 45 deg
            (3.0, 3.0, 4.0),  # twice NAV_ACC_RAD
            (1.0, 1.0, 2.0),  # twice the distance
            (0.0, 19.0, 19.0),
        ],
    )
    def test_known_heights(self, n: float, height_m: float, back_at_m: float) -> None:
        table = ParameterTable({"RTL_RETURN_ALT": 30.0, "RTL_CONE_ANG": 45, "RTL_MIN_DIST": 10.0, "NAV_ACC_RAD": 2.0})
        assert ReturnHome(table).return_height_m(here(n, height_m)) == pytest.approx(back_at_m)

    @given(st.floats(0.0, 500.0), st.floats(0.0, 120.0), st.sampled_from([0, 25, 45, 65, 80, 90]))
    def test_never_lower_than_now_nor_higher_than_asked(self, n: float, height_m: float, cone: int) -> None:
        table = ParameterTable({"RTL_RETURN_ALT": 30.0, "RTL_CONE_ANG": cone})
        height = ReturnHome(table).return_height_m(here(n, height_m))
        assert height_m <= height <= max(30.0, height_m)


def test_on_the_ground_it_stays_there() -> None:
    run = ReturnHome(ParameterTable())
    assert run.leg(here(0.0, 0.0, landed=True)).kind is LegKind.LAND
    assert run.state is ReturnState.IDLE
    assert not run.texts


def test_waits_before_landing_and_for_ever_if_told() -> None:
    table = ParameterTable({"RTL_LAND_DELAY": 5.0})
    run = ReturnHome(table)
    run.leg(here(0.0, 40.0))
    assert run.state is ReturnState.DESCEND
    assert run.leg(here(0.0, 10.0)).kind is LegKind.GO
    assert run.leg(here(0.0, 10.0, now_us=4_000_000)).kind is LegKind.GO
    assert run.leg(here(0.0, 10.0, now_us=5_000_001)).kind is LegKind.LAND
    table.set("RTL_LAND_DELAY", -1.0)
    run.start()
    run.leg(here(0.0, 40.0))
    run.leg(here(0.0, 10.0))
    assert run.leg(here(0.0, 10.0, now_us=10**9)).kind is LegKind.GO
    assert "RTL: completed, loitering\t" in [text.text for text in run.texts]


def test_lands_at_home_from_afar(flown: Any) -> None:
    flight = flown(RTL_RETURN_ALT=20.0)
    flight.run(1.2)
    flight.take_off(6.0)
    lat, lon, _ = geodetic((40.0, -30.0, 0.0))
    flight.control.navigator.reposition(Reposition(lat, lon, math.nan, math.nan, 8.0))
    flight.until(lambda: flight.distance(40.0, -30.0) < 0.5, 40.0)
    flight.begin(Mode.RTL)
    highest = 0.0
    while not flight.landing.landed:
        flight.run(0.1)
        highest = max(highest, -flight.ned[2])
        assert flight.now_us < 200e6
        if flight.distance(0.0, 0.0) > 5.0 and flight.distance(40.0, -30.0) > 5.0:
            assert -flight.ned[2] > 18.5
    assert highest == pytest.approx(20.0, abs=1.0)
    assert flight.distance(0.0, 0.0) < 1.0
    assert flight.texts[-2:] == [
        "RTL: start return at 508 m (20 m above destination)",
        "RTL: land at destination",
    ]
    flight.run(3.0)
    assert flight.mode is Mode.RTL
    assert flight.control.thrust_sp == 0.0
    assert flight.euler_deg[2] == pytest.approx(0.0, abs=10.0)


def test_near_home_it_lands_without_climbing(flown: Any) -> None:
    flight = flown()
    flight.run(1.2)
    flight.take_off(6.0)
    flight.begin(Mode.RTL)
    highest = 0.0
    while not flight.landing.landed:
        flight.run(0.1)
        highest = max(highest, -flight.ned[2])
    assert highest < 6.5
    assert flight.distance(0.0, 0.0) < 1.0
