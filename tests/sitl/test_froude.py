"""Froude scaling against the study's chapter 5 and against what similarity means."""

import tomllib
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.airframe import Derivatives, load_airframe
from sitl.froude import (
    EXPONENTS,
    derivative_factors,
    froude_number,
    scale_derivatives,
    scale_gain,
    scale_sigma,
)
from sitl.lateral import LateralModel

STUDY = tomllib.loads((Path(__file__).parents[1] / "data" / "study.toml").read_text())
AIRFRAMES = tuple(STUDY["airframe"])
PAIRS = [(reference, target) for reference in AIRFRAMES for target in AIRFRAMES]

# Tables 5.6 and 5.8 contradict table 2.1 in these places; the value is what table 2.1 says, N being 1.
ERRATA = {
    (e["where"].split(", ")[1], e["where"].split(", ")[2]): (e["printed"], e["follows"])
    for e in STUDY["erratum"]
    if e["where"].startswith("tables 5.6 and 5.8")
}


def tolerance(printed: float) -> float:
    """One unit of the last digit printed, and 1 in 100,000: the study rounds CARRIER-1's Ld to 229.44."""
    return max(10.0 ** -len(repr(float(printed)).partition(".")[2]), 1e-5 * abs(printed))


@pytest.mark.parametrize(("reference", "target"), PAIRS)
def test_froude_numbers_are_those_printed(reference: str, target: str) -> None:
    number = froude_number(load_airframe(reference), load_airframe(target))
    assert number == pytest.approx(STUDY["froude_number"][target][reference], abs=5.1e-5)


@pytest.mark.parametrize("target", ["ANT-R", "ANT-X", "CARRIER-1", "ADAM-0"])
@pytest.mark.parametrize("reference", AIRFRAMES)
def test_scaled_derivatives_are_those_printed(reference: str, target: str) -> None:
    """Tables 5.2, 5.4, 5.6 and 5.8, but for the three errata."""
    table = STUDY["scaled"]["CARRIER-1" if target == "ADAM-0" else target]
    a, b = load_airframe(reference), load_airframe(target)
    scaled = scale_derivatives(a.derivatives, froude_number(a, b)).as_dict()
    for name, printed in table[reference].items():
        expected = printed
        if table is STUDY["scaled"]["CARRIER-1"] and (reference, name) in ERRATA:
            wrong, expected = ERRATA[reference, name]
            assert wrong == printed
        assert scaled[name] == pytest.approx(expected, abs=tolerance(expected)), name


def test_the_errata_are_three() -> None:
    assert set(ERRATA) == {("CARRIER-1", "Yp"), ("CARRIER-1", "Lp"), ("ADAM-0", "Lp")}


def test_exponents_are_table_4_1() -> None:
    assert EXPONENTS.as_dict() == STUDY["froude_exponent"]


@pytest.mark.parametrize("name", AIRFRAMES)
@pytest.mark.parametrize("N", [0.29, 1.0, 3.4375])
def test_scaling_replays_the_same_motion_sqrt_n_times_faster(name: str, N: float) -> None:
    """Eigenvalues move along rays by sqrt(N), and p/delta(j w sqrt N) = sqrt(N) p/delta(j w)."""
    derivatives = load_airframe(name).derivatives
    before = LateralModel.from_derivatives(derivatives)
    after = LateralModel.from_derivatives(scale_derivatives(derivatives, N))
    slow, fast = (np.sort_complex(np.linalg.eigvals(m.A)) for m in (before, after))
    assert fast == pytest.approx(slow * np.sqrt(N), rel=1e-9)

    def response(m: LateralModel, omega: float) -> complex:
        return complex(np.linalg.solve(1j * omega * np.eye(3) - m.A, m.B.astype(complex))[1, 0])

    for omega in (1.0, 7.0, 50.0):
        expected = np.sqrt(N) * response(before, omega)
        assert response(after, omega * np.sqrt(N)) == pytest.approx(expected, rel=1e-9)


@settings(deadline=None)
@given(st.floats(0.05, 20.0), st.floats(0.05, 20.0))
def test_scaling_twice_is_scaling_once_by_the_product(first: float, second: float) -> None:
    derivatives = Derivatives(-0.2, 0.1, 10.0, -6.0, -2.0, 450.0)
    twice = scale_derivatives(scale_derivatives(derivatives, first), second)
    assert astuple(twice) == pytest.approx(astuple(scale_derivatives(derivatives, first * second)), rel=1e-12)


@pytest.mark.parametrize("N", [0.29, 1.0, 3.4375])
def test_sigma_scales_by_the_derivative_s_own_factor_or_only_grows(N: float) -> None:
    sigma = Derivatives(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    factors = derivative_factors(N).as_array()
    assert scale_sigma(sigma, N).as_array() == pytest.approx(sigma.as_array() * factors)
    grown = scale_sigma(sigma, N, "grow").as_array()
    assert grown == pytest.approx(sigma.as_array() * np.maximum(factors, 1.0 / factors))
    assert grown == pytest.approx(scale_sigma(sigma, 1.0 / N, "grow").as_array())
    assert np.all(grown >= sigma.as_array())


def test_gain_scaling_keeps_the_eigenvalues_and_multiplies_both_outputs() -> None:
    derivatives, N = load_airframe("ant-r").derivatives, 1.625
    before = LateralModel.from_derivatives(derivatives)
    after = LateralModel.from_derivatives(scale_gain(derivatives, N))
    assert np.array_equal(before.A, after.A)
    assert pytest.approx(before.B * np.sqrt(N)) == after.B
    assert pytest.approx(before.D * np.sqrt(N)) == after.D


@pytest.mark.parametrize("N", [0.0, -1.0, float("nan"), float("inf")])
def test_a_froude_number_is_positive(N: float) -> None:
    with pytest.raises(ValueError, match="Froude number"):
        derivative_factors(N)
