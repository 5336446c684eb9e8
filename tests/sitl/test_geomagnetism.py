"""The magnetic field of the World Magnetic Model, and places as people write them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.errors import UsageError
from sitl.geomagnetism import earth_field_gauss, home_of
from sitl.sensors import EARTH_FIELD_GAUSS, ORIGIN


def test_the_default_place_has_the_fields_own_value() -> None:
    assert earth_field_gauss(*ORIGIN) == pytest.approx(EARTH_FIELD_GAUSS, abs=1e-6)


# test values published with WMM2025: height 0, 2025.0; X, Y, Z in nT
@pytest.mark.parametrize(
    ("lat", "lon", "field_nt"),
    [
        (80.0, 0.0, (6521.6, 145.9, 54791.5)),
        (0.0, 120.0, (39677.8, -109.6, -10580.2)),
        (-80.0, 240.0, (6117.5, 15751.9, -52022.5)),
    ],
)
def test_published_values(lat: float, lon: float, field_nt: tuple[float, float, float]) -> None:
    assert [1e5 * one for one in earth_field_gauss(lat, lon, 0.0, 2025.0)] == pytest.approx(field_nt, abs=0.06)


def test_a_place_reads() -> None:
    assert home_of("47.397742,8.545594,488") == ORIGIN
    assert home_of(" -33.9 , 151.2, 6.5") == (-33.9, 151.2, 6.5)


@pytest.mark.parametrize("text", ["", "47,8", "47,8,9,10", "north,8,9", "89,0,0", "0,181,0", "0,0,1e5", "nan,0,0"])
def test_what_is_no_place_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match=r"--home .*47\.397742"):
        home_of(text)


@given(st.floats(-80, 80), st.floats(-180, 180), st.floats(-500, 9000))
def test_the_field_is_that_of_a_planet(lat: float, lon: float, alt_m: float) -> None:
    assert 0.2 < math.hypot(*earth_field_gauss(lat, lon, alt_m)) < 0.7
