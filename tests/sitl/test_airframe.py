"""Airframe files: the study's facts are all there, and a bad file is refused in one clear line."""

import math
import re
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.airframe import (
    AIRFRAMES_DIR,
    DERIVATIVE_KEYS,
    Airframe,
    Assumptions,
    Derivatives,
    FlightGains,
    list_airframes,
    load_airframe,
)
from sitl.errors import FileError, UsageError

STUDY = tomllib.loads((Path(__file__).parents[1] / "data" / "study.toml").read_text())
AIRFRAMES = tuple(STUDY["airframe"])

QUAD = """
name = "MINE"
mass_kg = 1.5
frame_m = [0.4, 0.4, 0.1]
diagonal_m = 0.45
lateral_m = 0.32
layout = "X"

[derivatives]
Yv_1_s = -0.3
Yp_m_s_rad = 0.0
Yd_m_s2 = 9.0
Lv_rad_m_s = -5.0
Lp_1_s = -1.0
Ld_rad_s2 = 300.0

[[rotors]]
px_m = 0.16
py_m = 0.16
km = 0.05
[[rotors]]
px_m = -0.16
py_m = -0.16
km = 0.05
[[rotors]]
px_m = 0.16
py_m = -0.16
km = -0.05
[[rotors]]
px_m = -0.16
py_m = 0.16
km = -0.05
"""


def load_text(text: str | bytes, folder: Path) -> Airframe:
    path = folder / "mine.toml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return load_airframe(path)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_every_fact_of_the_study_is_in_the_file(name: str) -> None:
    airframe, facts = load_airframe(name), STUDY["airframe"][name]
    assert airframe.name == name
    for fact in ("mass_kg", "diagonal_m", "lateral_m", "layout", "battery", "hover_min"):
        assert getattr(airframe, fact) == facts[fact], fact
    assert list(airframe.frame_m) == facts["frame_m"]
    assert len(airframe.rotors) == facts["rotors"]
    assert airframe.derivatives.as_dict() == STUDY["derivatives"][name]["value"]
    assert airframe.sigma_pct.as_dict() == STUDY["derivatives"][name]["sigma_pct"]
    gains = STUDY["flight_gains"][name]
    assert airframe.flight_gains == FlightGains(gains["K_phi"], gains["K_P"], gains["K_I"], gains["K_D"])
    assert airframe.assumptions == Assumptions(0.025, 0.5, 0.3, 20.0, 1.0)
    assert airframe.has_sigma


def test_the_built_in_airframes_are_the_study_s() -> None:
    assert set(list_airframes()) == {name.casefold() for name in AIRFRAMES}


@pytest.mark.parametrize("name", AIRFRAMES)
def test_quads_are_in_px4_s_motor_order_and_every_frame_is_balanced(name: str) -> None:
    rotors = load_airframe(name).rotors
    for pull in ("px_m", "py_m", "km"):
        assert sum(getattr(rotor, pull) for rotor in rotors) == pytest.approx(0.0)
    if len(rotors) == 4:
        # Front right and rear left counter-clockwise, front left and rear right clockwise.
        signs = [(np.sign(r.px_m), np.sign(r.py_m), np.sign(r.km)) for r in rotors]
        assert signs == [(1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1)]


@pytest.mark.parametrize("name", ["ANT-R", "ADAM-0"])
def test_rectangles_have_the_printed_lateral_distance_and_diagonal(name: str) -> None:
    airframe = load_airframe(name)
    for rotor in airframe.rotors:
        assert 2.0 * abs(rotor.py_m) == pytest.approx(airframe.lateral_m)
        assert 2.0 * math.hypot(rotor.px_m, rotor.py_m) == pytest.approx(airframe.diagonal_m, abs=1e-4)


def test_ant_x_is_a_square_of_its_lateral_distance() -> None:
    assert {(abs(r.px_m), abs(r.py_m)) for r in load_airframe("ant-x").rotors} == {(0.06, 0.06)}


def test_carrier_1_is_a_regular_octagon() -> None:
    rotors = load_airframe("carrier-1").rotors
    bearings = sorted(math.degrees(math.atan2(r.py_m, r.px_m)) % 360.0 for r in rotors)
    assert bearings == pytest.approx([22.5 + 45.0 * i for i in range(8)], abs=1e-2)
    for rotor in rotors:
        assert 2.0 * math.hypot(rotor.px_m, rotor.py_m) == pytest.approx(0.55, abs=1e-4)


def test_carrier_1_s_file_tells_how_to_fly_it_as_an_x8(tmp_path: Path) -> None:
    text = (AIRFRAMES_DIR / "carrier-1.toml").read_text()
    number = r"([+-]\d+\.\d+)"
    found = re.findall(rf"px_m {number}  py_m {number}  km {number}", text)
    in_order = [*found[0::2], *found[1::2]]  # 1 to 4 are the left column, 5 to 8 the right one
    rotors = "".join(f"[[rotors]]\npx_m = {px}\npy_m = {py}\nkm = {km}\n".replace("+", "") for px, py, km in in_order)
    head = text[: text.index("\n[[rotors]]")].replace('layout = "octo"', 'layout = "X8"')
    x8 = load_text(f"{head}\n{rotors}", tmp_path)
    assert x8.layout == "X8"
    # PX4's normalised columns of this geometry: roll follows -py, yaw km, motors 1 to 8.
    assert [-np.sign(r.py_m) for r in x8.rotors] == [-1, 1, 1, -1, 1, -1, -1, 1]
    assert [np.sign(r.km) for r in x8.rotors] == [1, -1, 1, -1, 1, -1, 1, -1]


@pytest.mark.parametrize("name", ["ant-x", "ANT-X", "Ant-X"])
def test_names_are_known_in_any_case(name: str) -> None:
    assert load_airframe(name).name == "ANT-X"


def test_an_unknown_name_lists_the_known_and_the_nearest() -> None:
    with pytest.raises(UsageError, match=r'"antx".*did you mean "ant-x".*adam-0, ant-r, ant-x, carrier-1.*toml'):
        load_airframe("antx")


def test_a_user_s_own_file_needs_neither_sigma_nor_gains_nor_assumptions(tmp_path: Path) -> None:
    airframe = load_text(QUAD, tmp_path)
    assert airframe.derivatives == Derivatives(-0.3, 0.0, 9.0, -5.0, -1.0, 300.0)
    assert not airframe.has_sigma
    assert airframe.flight_gains is None
    assert airframe.assumptions == Assumptions()
    assert (airframe.title, airframe.battery, airframe.hover_min, airframe.notes) == ("MINE", "", None, ())
    assert load_airframe(str(airframe.path)) == airframe
    assert load_text(f"{QUAD}[assumptions]\nmotor_lag_s = 0.04\n", tmp_path).assumptions.motor_lag_s == 0.04


def ring(count: int) -> str:
    rotors = []
    for i in range(count):
        bearing = 2.0 * math.pi * (i + 0.5) / count
        place = f"px_m = {0.2 * math.cos(bearing):.6f}\npy_m = {0.2 * math.sin(bearing):.6f}"
        rotors.append(f"[[rotors]]\n{place}\nkm = {0.05 * (-1) ** i}\n")
    return "".join(rotors)


@pytest.mark.parametrize("count", range(2, 14))
def test_a_custom_layout_has_3_to_12_rotors(count: int, tmp_path: Path) -> None:
    text = QUAD[: QUAD.index("[[rotors]]")].replace('"X"', '"custom"') + ring(count)
    if 3 <= count <= 12:
        assert len(load_text(text, tmp_path).rotors) == count
    else:
        with pytest.raises(FileError, match=f"rotors: {count} rotors. Give 3 to 12"):
            load_text(text, tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass_kg = 1.5", "", r"mass_kg: missing key\. Add it"),
        ("mass_kg = 1.5", "mas_kg = 1.5", r'mass_kg: missing key; the file has "mas_kg"'),
        ("mass_kg = 1.5", 'mass_kg = "1.5"', r"mass_kg: '1.5' is not a number"),
        ("mass_kg = 1.5", "mass_kg = true", r"mass_kg: True is not a number"),
        ("mass_kg = 1.5", "mass_kg = nan", r"mass_kg: nan is not finite"),
        ("mass_kg = 1.5", f"mass_kg = 1{'0' * 400}", r"mass_kg: inf is not finite"),
        ("mass_kg = 1.5", "mass_kg = 0", r"mass_kg: 0 is out of range\. It must be > 0"),
        ("mass_kg = 1.5", "mass_kg = -1", r"mass_kg: -1 is out of range"),
        (
            "mass_kg = 1.5",
            "mass_kg = 1.5\nhover_mins = 3",
            r'hover_mins: unknown key.*did you mean "hover_min"',
        ),
        ("mass_kg = 1.5", "mass_kg = 1.5\nmass_kg = 2", r"not a TOML file: .*line"),
        ("diagonal_m = 0.45", "diagonal_m = 0.0", r"diagonal_m: 0 is out of range"),
        ("frame_m = [0.4, 0.4, 0.1]", "frame_m = [0.4, 0.4]", r"frame_m: .* is not a list of 3 numbers"),
        ("frame_m = [0.4, 0.4, 0.1]", "frame_m = [0.4, 0.4, -1]", r"frame_m\[2\]: -1 is out of range"),
        ('name = "MINE"', 'name = "ant-r:ant-x"', r"name: 'ant-r:ant-x' is not a name"),
        ('name = "MINE"', "name = 3", r"name: 3 is not a text"),
        ('layout = "X"', 'layout = "okto"', r'layout: unknown layout "okto" \(did you mean "octo"\?\)'),
        ('layout = "X"', 'layout = "X8"', r'rotors: layout "X8" has 8 rotors, the file lists 4'),
        ("Ld_rad_s2 = 300.0", "Ld_rad_s2 = -300.0", r"derivatives\.Ld_rad_s2: -300 is out of range"),
        ("Yp_m_s_rad = 0.0", "Yp_m_s_rad = inf", r"derivatives\.Yp_m_s_rad: inf is not finite"),
        ("Ld_rad_s2 = 300.0", "Ld = 300.0", r"derivatives\.Ld_rad_s2: missing key"),
        ("Ld_rad_s2 = 300.0", "Ld_rad_s2 = 300.0\nLz = 1.0", r"derivatives\.Lz: unknown key"),
        ("[derivatives]", "[[derivatives]]", r"derivatives: .* is not a table"),
        ("[derivatives]", "[sigma]\nYv_pct = -1\n[derivatives]", r"sigma\.Yv_pct: -1 is out of range"),
        (
            "[derivatives]",
            "[flight_gains]\nk_phi_1_s = 6.5\n[derivatives]",
            r"flight_gains\.kp_s_rad: missing",
        ),
        (
            "[derivatives]",
            "[assumptions]\nhover_thrust = 0.95\n[derivatives]",
            r"assumptions\.hover_thrust: 0\.95 is out of range\. It must be < 0\.95",
        ),
        (
            "[derivatives]",
            "[assumptions]\nmotor_lag_s = 0.6\n[derivatives]",
            r"assumptions\.motor_lag_s: 0\.6 is out of range\. It must be <= 0\.5",
        ),
        ("[derivatives]", "[assumptions]\nmotor_lag_ms = 25\n[derivatives]", r'did you mean "motor_lag_s"'),
        ("[derivatives]", "rotor = 3\n[derivatives]", r'rotor: unknown key.*did you mean "rotors"'),
        (
            "px_m = -0.16\npy_m = 0.16\nkm = -0.05",
            "px_m = -0.16\npy_m = 0.16",
            r"rotors\[3\]\.km: missing key",
        ),
        (
            "px_m = -0.16\npy_m = 0.16\nkm = -0.05",
            "px_m = 0.16\npy_m = 0.16\nkm = 0.05",
            r"rotors\[3\]: at the place of rotors\[0\]",
        ),
        ("km = -0.05", "km = 0.05", r"rotors: they cannot command roll, pitch, yaw and thrust"),
        ("py_m = 0.16", "py_m = -0.16", r"cannot command|at the place of"),
        ("0.16\n", "0.0016\n", r"rotors: longest roll arm 0\.0016 m, PX4 drops an axis"),
    ],
)
def test_a_bad_key_is_named_in_one_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in QUAD
    with pytest.raises(FileError, match=message) as caught:
        load_text(QUAD.replace(old, new), tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'mine.toml'}: ")
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"nowhere\.toml: no such file"):
        load_airframe("nowhere.toml")
    with pytest.raises(FileError, match="cannot be read: Is a directory"):
        load_airframe(tmp_path)
    with pytest.raises(FileError, match="not a TOML file"):
        load_text(b"\xff\xfe\x00", tmp_path)


@settings(max_examples=60, deadline=None)
@given(st.one_of(st.binary(max_size=200), st.text(max_size=200)))
def test_any_bytes_are_refused_as_a_file_error(content: bytes | str) -> None:
    raw = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
    with tempfile.TemporaryDirectory() as folder, pytest.raises(FileError):
        load_text(raw, Path(folder))


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(list(DERIVATIVE_KEYS.items())), st.floats() | st.integers())
def test_a_derivative_that_loads_is_finite_and_unchanged(named: tuple[str, str], value: float) -> None:
    name, key = named
    text = re.sub(rf"{key} = .*", f"{key} = {value}", QUAD)
    with tempfile.TemporaryDirectory() as folder:
        try:
            loaded = getattr(load_text(text, Path(folder)).derivatives, name)
        except FileError:
            assert not math.isfinite(value) or (name == "Ld" and value <= 0.0)
        else:
            assert loaded == float(value)
            assert math.isfinite(loaded)
