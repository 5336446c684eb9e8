from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sitl.rotation import canonical, conjugate, from_euler, multiply, normalise, to_body, to_euler, to_world

component = st.floats(-1.0, 1.0)
vectors = st.tuples(*[st.floats(-100.0, 100.0)] * 3)


@st.composite
def quaternions(draw: st.DrawFn) -> tuple[float, float, float, float]:
    raw = np.array([draw(component) for _ in range(4)])
    assume(np.linalg.norm(raw) > 0.1)
    w, x, y, z = (raw / np.linalg.norm(raw)).tolist()
    return w, x, y, z


def rotation(quat: tuple[float, ...]) -> Rotation:
    w, x, y, z = quat
    return Rotation.from_quat([x, y, z, w])


@settings(deadline=None)
@given(quat=quaternions(), vector=vectors)
def test_body_vector_turns_into_the_world_and_back(quat: tuple, vector: tuple) -> None:
    there = to_world(quat, vector)
    assert there == pytest.approx(rotation(quat).apply(vector), abs=1e-10)
    assert to_body(quat, there) == pytest.approx(vector, abs=1e-10)


@settings(deadline=None)
@given(a=quaternions(), b=quaternions())
def test_product_is_one_rotation_after_the_other(a: tuple, b: tuple) -> None:
    both = rotation(multiply(a, b)).as_matrix()
    assert both == pytest.approx(rotation(a).as_matrix() @ rotation(b).as_matrix(), abs=1e-12)
    assert multiply(conjugate(a), a) == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-12)


@settings(deadline=None)
@given(phi=st.floats(-math.pi, math.pi), theta=st.floats(-1.5, 1.5), psi=st.floats(-math.pi, math.pi))
def test_euler_angles_are_yaw_then_pitch_then_roll(phi: float, theta: float, psi: float) -> None:
    quat = from_euler(phi, theta, psi)
    assert rotation(quat).as_matrix() == pytest.approx(
        Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix(), abs=1e-12
    )
    back = to_euler(quat)
    assert from_euler(*back) == pytest.approx(quat, abs=1e-9) or from_euler(*back) == pytest.approx(
        tuple(-c for c in quat), abs=1e-9
    )


def test_small_angles_keep_their_precision() -> None:
    assert to_euler(from_euler(1e-9, -2e-9, 3e-9)) == pytest.approx((1e-9, -2e-9, 3e-9), abs=1e-16)


@pytest.mark.parametrize("theta", [math.pi / 2.0, -math.pi / 2.0])
def test_straight_up_and_down_stay_finite(theta: float) -> None:
    assert to_euler(from_euler(0.3, theta, 0.1))[1] == pytest.approx(theta, abs=1e-7)


@settings(deadline=None)
@given(quat=quaternions(), scale=st.floats(1e-3, 1e3))
def test_normalising_forgets_the_length_only(quat: tuple, scale: float) -> None:
    assert normalise(tuple(c * scale for c in quat)) == pytest.approx(quat, abs=1e-12)


def test_quaternion_without_length_becomes_no_rotation() -> None:
    assert normalise((0.0, 0.0, 0.0, 0.0)) == (1.0, 0.0, 0.0, 0.0)


def test_canonical_is_the_twin_with_positive_w() -> None:
    assert canonical((-0.5, 0.5, -0.5, 0.5)) == (0.5, -0.5, 0.5, -0.5)
    assert canonical((0.5, 0.5, 0.5, 0.5)) == (0.5, 0.5, 0.5, 0.5)
