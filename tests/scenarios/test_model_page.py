"""`froude model`: the numbers are the model's, and the text says them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from scenarios.model_page import model_object, model_text
from sitl.airframe import list_airframes
from sitl.lateral import LateralModel
from sitl.profile import get_profile
from sitl.vehicle_spec import resolve_vehicle

SPECS = (*list_airframes(), "ant-r:ant-x", "carrier-1:adam-0")


@pytest.mark.parametrize("spec", SPECS)
def test_the_matrices_are_the_models(spec: str) -> None:
    model = resolve_vehicle(spec)
    shown = json.loads(json.dumps(model_object(model, get_profile("sitl")), allow_nan=False))
    d = model.derivatives
    assert np.array(shown["state_space"]["A"]) == pytest.approx(
        np.array([[d.Yv, d.Yp, 9.81], [d.Lv, d.Lp, 0.0], [0.0, 1.0, 0.0]])
    )
    assert np.array(shown["state_space"]["B"]).ravel() == pytest.approx([d.Yd, d.Ld, 0.0])
    lateral = LateralModel.from_derivatives(d)
    assert np.array(shown["state_space"]["C"]) == pytest.approx(lateral.C)
    poles = np.linalg.eigvals(lateral.A)
    wanted = sorted({round(float(abs(pole)), 6) for pole in poles})
    assert sorted(round(mode["natural_frequency_rad_s"], 6) for mode in shown["modes"]) == pytest.approx(wanted)
    assert shown["derivatives"] == d.as_dict()


@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("profile", ["study", "sitl", "board"])
def test_the_text_says_what_the_object_holds(spec: str, profile: str) -> None:
    shown = model_object(resolve_vehicle(spec), get_profile(profile))
    text = model_text(shown)
    assert text.startswith(f"{shown['name']}  {shown['title']}")
    for name, value in shown["derivatives"].items():
        assert f"{name:<10} {value:>10.5g}" in text
    assert ("predicted from" in text) == (":" in spec)
    assert f"profile {profile}:" in text
    margins = shown["flight_gain_margins"]
    assert ("  stable, phase margin" in text) is margins["closed_loop_stable"]
    assert ("  UNSTABLE" in text) is not margins["closed_loop_stable"]
    assert "motor_lag_s 0.025" in text
    assert "None" not in text
    assert "nan" not in text


def test_the_gains_that_flew_are_stable_as_px4_flies_them() -> None:
    for spec in list_airframes():
        for profile in ("sitl", "board"):
            shown = model_object(resolve_vehicle(spec), get_profile(profile))
            assert shown["flight_gain_margins"]["closed_loop_stable"], (spec, profile)


def test_margins_shrink_with_the_delays_of_the_profile() -> None:
    model = resolve_vehicle("ant-x")
    margins = [model_object(model, get_profile(name))["flight_gain_margins"] for name in ("study", "sitl")]
    study, sitl = (margin["delay_margin_s"] for margin in margins)
    assert study > sitl > 0.0


def test_a_vehicle_without_flight_gains_has_no_margins() -> None:
    import dataclasses

    model = resolve_vehicle("ant-x")
    bare = dataclasses.replace(model, airframe=dataclasses.replace(model.airframe, flight_gains=None))
    shown = model_object(bare, get_profile("sitl"))
    assert shown["flight_gain_margins"] is None
    assert "margin" not in model_text(shown)
