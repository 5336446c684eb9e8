"""What a vehicle spec means."""

from pathlib import Path

import numpy as np
import pytest

from sitl.airframe import AIRFRAMES_DIR, load_airframe
from sitl.errors import FileError, UsageError
from sitl.froude import scale_derivatives, scale_sigma
from sitl.vehicle_spec import resolve_vehicle

N = 0.26 / 0.16


def test_a_single_name_is_the_identified_airframe_and_is_never_scaled() -> None:
    model = resolve_vehicle("Ant-X", scaling=("derivatives", "gain"))
    airframe = load_airframe("ant-x")
    assert (model.name, model.reference, model.froude_number) == ("ANT-X", None, 1.0)
    assert (model.derivatives, model.sigma_pct) == (airframe.derivatives, airframe.sigma_pct)
    assert model.scaling == frozenset()


def test_reference_and_target_fly_the_reference_s_model_on_the_target_s_body() -> None:
    model = resolve_vehicle("ant-r:ant-x")
    reference, target = load_airframe("ant-r"), load_airframe("ant-x")
    assert model.name == "ANT-R:ANT-X"
    assert model.airframe == target
    assert model.reference == reference
    assert model.assumptions == target.assumptions
    assert model.froude_number == pytest.approx(N)
    assert model.derivatives == scale_derivatives(reference.derivatives, N)
    assert model.sigma_pct == reference.sigma_pct


def test_no_scaling_keeps_the_reference_s_own_derivatives() -> None:
    model = resolve_vehicle("ant-r:ant-x", scaling=())
    assert model.derivatives == load_airframe("ant-r").derivatives
    assert model.airframe.name == "ANT-X"


def test_the_words_act_alone_and_together() -> None:
    reference = load_airframe("ant-r")
    sigma_only = resolve_vehicle("ant-r:ant-x", ["uncertainty"])
    assert sigma_only.derivatives == reference.derivatives
    assert sigma_only.sigma_pct == scale_sigma(reference.sigma_pct, N)
    grown = resolve_vehicle("ant-r:ant-x", ["uncertainty-grow"])
    assert grown.sigma_pct == scale_sigma(reference.sigma_pct, N, "grow")
    gain = resolve_vehicle("ant-r:ant-x", ["gain"])
    assert gain.derivatives.Ld == pytest.approx(reference.derivatives.Ld * np.sqrt(N))
    assert gain.derivatives.Lv == reference.derivatives.Lv
    both = resolve_vehicle("ant-r:ant-x", ["derivatives", "gain", "uncertainty"])
    assert both.derivatives.Ld == pytest.approx(reference.derivatives.Ld * N * np.sqrt(N))
    assert both.derivatives.Lv == pytest.approx(reference.derivatives.Lv * N**1.5)
    assert both.scaling == {"derivatives", "gain", "uncertainty"}


def test_equal_diagonals_predict_the_reference_unchanged() -> None:
    """The study's finding: ADAM-0 and CARRIER-1 have N = 1 and yet differ."""
    model = resolve_vehicle("adam-0:carrier-1", ["derivatives", "uncertainty", "gain"])
    assert model.derivatives == load_airframe("adam-0").derivatives
    assert model.derivatives != load_airframe("carrier-1").derivatives


def test_either_part_may_be_a_path(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text((AIRFRAMES_DIR / "ant-x.toml").read_text().replace('"ANT-X"', '"MINE"'))
    assert resolve_vehicle(f"ant-r:{own}").name == "ANT-R:MINE"
    assert resolve_vehicle(f"{own}:ant-r").name == "MINE:ANT-R"
    odd = tmp_path / "a:b.toml"
    odd.write_text(own.read_text())
    assert resolve_vehicle(str(odd)).name == "MINE"


@pytest.mark.parametrize("spec", ["", ":", "ant-x:", ":ant-x", "ant-r:ant-x:adam-0"])
def test_a_malformed_spec_is_refused(spec: str) -> None:
    with pytest.raises(UsageError, match="REFERENCE:TARGET"):
        resolve_vehicle(spec)


def test_unknown_words_and_airframes_are_named() -> None:
    with pytest.raises(UsageError, match=r'unknown scaling "gains".*did you mean "gain"'):
        resolve_vehicle("ant-r:ant-x", ["gains"])
    with pytest.raises(UsageError, match="give one"):
        resolve_vehicle("ant-r:ant-x", ["uncertainty", "uncertainty-grow"])
    with pytest.raises(UsageError, match='unknown airframe "ant-q"'):
        resolve_vehicle("ant-r:ant-q")
    with pytest.raises(FileError, match="no such file"):
        resolve_vehicle("ant-r:nowhere.toml")
