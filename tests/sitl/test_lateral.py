"""The lateral model against table 3.1 and against its own state space."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from sitl.airframe import Derivatives, load_airframe
from sitl.lateral import G_M_S2, LateralModel

STUDY = tomllib.loads((Path(__file__).parents[1] / "data" / "study.toml").read_text())
AIRFRAMES = tuple(STUDY["airframe"])


def model(name: str) -> LateralModel:
    return LateralModel.from_derivatives(load_airframe(name).derivatives)


def half_digit(printed: float) -> float:
    """Half a unit of the last digit a number is printed with."""
    return 0.5 * 10.0 ** -len(repr(float(printed)).partition(".")[2]) + 1e-12


@pytest.mark.parametrize("name", AIRFRAMES)
def test_modes_are_those_of_table_3_1(name: str) -> None:
    roll, phugoid = model(name).modes()
    printed = STUDY["modes"][name]
    assert (roll.name, phugoid.name) == ("roll", "phugoid")
    assert roll.wn_rad_s == pytest.approx(printed["roll_wn"], abs=half_digit(printed["roll_wn"]))
    assert roll.zeta == pytest.approx(1.0)
    assert phugoid.wn_rad_s == pytest.approx(printed["phugoid_wn"], abs=half_digit(printed["phugoid_wn"]))
    assert phugoid.zeta == pytest.approx(printed["phugoid_zeta"], abs=half_digit(printed["phugoid_zeta"]))
    assert phugoid.eigenvalue.imag > 0.0


def test_a_mode_s_numbers_are_its_eigenvalue_s() -> None:
    for mode in model("ant-x").modes():
        assert mode.wn_rad_s == pytest.approx(abs(mode.eigenvalue))
        assert mode.zeta * mode.wn_rad_s == pytest.approx(-mode.eigenvalue.real)


def test_three_real_modes_have_names() -> None:
    """Without Lv the model falls apart into Yv, Lp and a free angle."""
    modes = LateralModel.from_derivatives(Derivatives(-1.0, 0.0, 1.0, 0.0, -3.0, 100.0)).modes()
    assert [mode.name for mode in modes] == ["roll", "aperiodic", "aperiodic"]
    assert [mode.wn_rad_s for mode in modes] == pytest.approx([3.0, 1.0, 0.0])


def test_state_space_is_equations_2_2_and_2_3() -> None:
    d = Derivatives(Yv=-0.1, Yp=0.2, Yd=3.0, Lv=-4.0, Lp=-5.0, Ld=600.0)
    m = LateralModel.from_derivatives(d)
    v, p, phi, delta = 0.7, -0.3, 0.2, 0.05
    x_dot = m.A @ [v, p, phi] + m.B[:, 0] * delta
    assert x_dot == pytest.approx(
        [d.Yv * v + d.Yp * p + 9.81 * phi + d.Yd * delta, d.Lv * v + d.Lp * p + d.Ld * delta, p]
    )
    # The accelerometer feels no gravity: a_y is v' without g phi.
    y = m.C @ [v, p, phi] + m.D[:, 0] * delta
    assert y == pytest.approx([p, x_dot[0] - 9.81 * phi])


@pytest.mark.parametrize("name", AIRFRAMES)
def test_transfer_functions_are_the_study_s_and_the_state_space_s(name: str) -> None:
    m, d = model(name), load_airframe(name).derivatives
    rate, accel = m.roll_rate_tf(), m.lateral_accel_tf()
    den = [1.0, -(d.Lp + d.Yv), d.Lp * d.Yv - d.Lv * d.Yp, -G_M_S2 * d.Lv]
    assert rate.den[0][0] == pytest.approx(den)
    assert accel.den[0][0] == pytest.approx(den)
    assert rate.num[0][0] == pytest.approx([d.Ld, -d.Ld * d.Yv + d.Lv * d.Yd, 0.0])
    assert accel.num[0][0] == pytest.approx(
        [d.Yd, d.Ld * d.Yp - d.Lp * d.Yd, 0.0, (d.Ld * d.Yv - d.Lv * d.Yd) * G_M_S2]
    )
    for omega in (0.3, 3.0, 30.0):
        s = 1j * omega
        direct = (m.C @ np.linalg.solve(s * np.eye(3) - m.A, m.B.astype(complex)) + m.D)[:, 0]
        assert complex(rate(s)) == pytest.approx(direct[0], rel=1e-9)
        assert complex(accel(s)) == pytest.approx(direct[1], rel=1e-9)
    assert np.sort_complex(rate.poles()) == pytest.approx(np.sort_complex(np.linalg.eigvals(m.A)))
