"""The H-infinity norm against peaks known on paper, dense grids and invariances."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.signal
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sitl.errors import UsageError
from sitl.hinf_norm import hinf_norm


def second_order(wn: float, zeta: float) -> tuple[np.ndarray, ...]:
    return (
        np.array([[0, 1], [-(wn**2), -2 * zeta * wn]]),
        np.array([[0], [wn**2]]),
        np.array([[1, 0]]),
        np.zeros((1, 1)),
    )


@pytest.mark.parametrize("zeta", [0.01, 0.1, 0.3, 0.6])
@pytest.mark.parametrize("wn", [1e-3, 1.0, 300.0])
def test_a_resonance(wn: float, zeta: float) -> None:
    peak = 1.0 / (2.0 * zeta * math.sqrt(1.0 - zeta**2))
    assert hinf_norm(*second_order(wn, zeta), None) == pytest.approx(peak, rel=1e-5)


@pytest.mark.parametrize("zeta", [0.75, 1.0, 3.0])
def test_without_a_resonance_it_is_the_static_gain(zeta: float) -> None:
    assert hinf_norm(*second_order(5.0, zeta), None) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("dt_s", [1e-3, 0.1])
def test_sampled_with_tustin_the_peak_stays(dt_s: float) -> None:
    """The bilinear transform warps frequencies and keeps heights."""
    a, b, c, d, _ = scipy.signal.cont2discrete(second_order(8.0, 0.2), dt_s, "bilinear")
    assert hinf_norm(a, b, c, d, dt_s) == pytest.approx(1.0 / (0.4 * math.sqrt(0.96)), rel=1e-5)


def test_high_pass_peaks_at_half_the_rate() -> None:
    """y = x_k - x_k-1: 2 at z = -1."""
    assert hinf_norm([[0.0]], [[1.0]], [[-1.0]], [[1.0]], 0.01) == pytest.approx(2.0, rel=1e-5)


@pytest.mark.parametrize("n", [1, 3, 7])
def test_a_delay_of_some_ticks_has_gain_one(n: int) -> None:
    a = np.eye(n, k=-1)
    b, c = np.eye(n)[:, :1], np.eye(n)[-1:]
    assert hinf_norm(a, 2.5 * b, c, np.zeros((1, 1)), 0.1) == pytest.approx(2.5, rel=1e-5)


def test_all_pass_is_one_and_parallel_channels_take_the_larger() -> None:
    assert hinf_norm([[-3.0]], [[1.0]], [[-6.0]], [[1.0]], None) == pytest.approx(1.0, rel=1e-5)
    a = np.diag([-1.0, -2.0])
    assert hinf_norm(a, np.eye(2), np.diag([1.0, 8.0]), np.zeros((2, 2)), None) == pytest.approx(4.0, rel=1e-5)


@pytest.mark.parametrize("dt_s", [None, 0.01])
def test_what_is_not_stable_has_no_norm(dt_s: float | None) -> None:
    edge = 0.0 if dt_s is None else 1.0
    for pole in (edge, edge + 0.5):
        assert hinf_norm([[pole]], [[1.0]], [[1.0]], [[0.0]], dt_s) == math.inf


def test_a_mere_gain() -> None:
    empty = np.zeros((0, 0))
    assert hinf_norm(empty, np.zeros((0, 2)), np.zeros((2, 0)), np.diag([3.0, -7.0]), None) == 7.0
    assert hinf_norm([[-1.0]], [[0.0]], [[0.0]], [[0.0]], None) == 0.0


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 3), st.integers(1, 3), st.booleans())
@settings(deadline=None, max_examples=150)
def test_never_below_a_dense_grid_and_hardly_above(seed: int, n: int, inputs: int, outputs: int, sampled: bool) -> None:
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n))
    scale = np.exp(rng.uniform(-4, 4, n))  # badly scaled states
    poles = np.linalg.eigvals(a)
    if sampled:
        a = a / (np.abs(poles).max() * rng.uniform(1.001, 2.0))
    else:
        a = a - np.eye(n) * (poles.real.max() + rng.uniform(0.01, 1.0))
    a = a * scale[:, None] / scale
    b, c = rng.standard_normal((n, inputs)) * scale[:, None], rng.standard_normal((outputs, n)) / scale
    d = rng.standard_normal((outputs, inputs))
    poles = np.linalg.eigvals(a)
    near = np.abs(np.angle(poles)) if sampled else np.abs(poles.imag)
    wide = np.linspace(0.0, math.pi, 1500) if sampled else np.geomspace(1e-3, 1e3, 1500)
    close = np.concatenate([w + np.linspace(-0.2, 0.2, 101) for w in near])
    omega = np.concatenate([[0.0], wide, np.clip(close, 0.0, math.pi if sampled else None)])
    points = np.exp(1j * omega) if sampled else 1j * omega
    value = c @ np.linalg.solve(points[:, None, None] * np.eye(n) - a, np.broadcast_to(b, (len(points), n, inputs))) + d
    peak = float(np.linalg.norm(value, 2, axis=(1, 2)).max())
    peak = max(peak, 0.0 if sampled else float(np.linalg.norm(d, 2)))
    assume(peak < 1e6)
    norm = hinf_norm(a, b, c, d, 0.01 if sampled else None)
    assert norm >= peak * (1.0 - 1e-5)
    assert norm <= peak * 1.02


def test_bad_input_is_told() -> None:
    with pytest.raises(UsageError, match="fit together"):
        hinf_norm(np.eye(2), np.eye(3), np.eye(2), np.eye(2), None)
    with pytest.raises(UsageError, match="finite"):
        hinf_norm([[math.nan]], [[1.0]], [[1.0]], [[0.0]], None)
