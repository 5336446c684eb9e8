"""Samples of uncertain derivatives: bounds, distribution, repeatability."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.airframe import Derivatives, load_airframe
from sitl.errors import UsageError
from sitl.uncertainty import Distribution, sample_derivatives

ANT_R = load_airframe("ant-r")
NOMINAL, SIGMA = ANT_R.derivatives, ANT_R.sigma_pct


def deviations(samples: np.ndarray) -> np.ndarray:
    """In standard deviations, (n, 6)."""
    sigma = np.abs(NOMINAL.as_array()) * SIGMA.as_array() / 100.0
    return (samples - NOMINAL.as_array()) / sigma


@pytest.mark.parametrize("distribution", ["gaussian", "uniform"])
def test_every_sample_is_within_three_sigma(distribution: Distribution) -> None:
    samples = sample_derivatives(NOMINAL, SIGMA, 5000, np.random.default_rng(1), distribution=distribution)
    assert samples.shape == (5000, 6)
    assert np.abs(deviations(samples)).max() <= 3.0 + 1e-9


def test_gaussian_is_the_truncated_normal_distribution() -> None:
    from scipy.stats import kstest, truncnorm

    for spread in (1.0, 3.0):
        z = deviations(sample_derivatives(NOMINAL, SIGMA, 4000, np.random.default_rng(2), spread_sigma=spread))
        for column in z.T:
            assert kstest(column, truncnorm(-spread, spread).cdf).pvalue > 1e-3
        assert np.abs(np.corrcoef(z.T) - np.eye(6)).max() < 0.08


def test_uniform_is_flat_between_the_bounds() -> None:
    from scipy.stats import kstest, uniform

    z = deviations(sample_derivatives(NOMINAL, SIGMA, 4000, np.random.default_rng(3), 2.0, distribution="uniform"))
    for column in z.T:
        assert kstest(column, uniform(-2.0, 4.0).cdf).pvalue > 1e-3


@pytest.mark.parametrize("distribution", ["gaussian", "uniform"])
def test_the_same_seed_gives_the_same_samples_and_a_longer_run_begins_alike(
    distribution: Distribution,
) -> None:
    def draw(n: int, seed: int) -> np.ndarray:
        return sample_derivatives(NOMINAL, SIGMA, n, np.random.default_rng(seed), distribution=distribution)

    assert np.array_equal(draw(100, 7), draw(100, 7))
    assert not np.array_equal(draw(100, 7), draw(100, 8))
    assert np.array_equal(draw(500, 7)[:100], draw(100, 7))


def test_correlated_derivatives_move_together_in_their_own_signs() -> None:
    """Yd > 0 and Lv < 0 with correlation +0.9: when Yd is above its nominal value, so is Lv, on average."""
    correlation = np.eye(6)
    correlation[2, 3] = correlation[3, 2] = 0.9
    rng = np.random.default_rng(4)
    z = deviations(sample_derivatives(NOMINAL, SIGMA, 4000, rng, correlation=correlation))
    assert np.abs(z).max() <= 3.0 + 1e-9
    assert np.corrcoef(z.T) == pytest.approx(correlation, abs=0.06)


def test_fully_correlated_derivatives_move_as_one() -> None:
    z = deviations(sample_derivatives(NOMINAL, SIGMA, 50, np.random.default_rng(5), correlation=np.ones((6, 6))))
    assert z == pytest.approx(np.repeat(z[:, :1], 6, axis=1), abs=1e-6)


def test_no_sigma_means_the_nominal_model_every_time() -> None:
    none = Derivatives(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    samples = sample_derivatives(NOMINAL, none, 3, np.random.default_rng(0))
    assert np.array_equal(samples, np.tile(NOMINAL.as_array(), (3, 1)))
    assert Derivatives.from_values(samples[0]) == NOMINAL


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 200), st.floats(0.5, 8.0), st.integers(0, 2**32))
def test_any_request_is_filled_within_its_bounds(n: int, spread: float, seed: int) -> None:
    samples = sample_derivatives(NOMINAL, SIGMA, n, np.random.default_rng(seed), spread)
    assert samples.shape == (n, 6)
    assert np.abs(deviations(samples)).max() <= spread + 1e-9


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n": 0}, "samples = 0"),
        ({"spread_sigma": 0.1}, "spread_sigma = 0.1"),
        ({"spread_sigma": float("nan")}, "spread_sigma = nan"),
        ({"distribution": "normal"}, 'unknown distribution "normal"'),
        ({"correlation": np.eye(5)}, "6 x 6"),
        ({"correlation": 2.0 * np.eye(6)}, "ones on the diagonal"),
        ({"correlation": np.eye(6) + np.eye(6, k=1)}, "symmetric"),
        ({"correlation": 1.9 * np.eye(6) - 0.9}, "not positive semidefinite"),
        ({"correlation": np.eye(6), "distribution": "uniform"}, "gaussian distribution only"),
    ],
)
def test_an_unusable_request_is_refused_by_name(changes: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {
        "nominal": NOMINAL,
        "sigma_pct": SIGMA,
        "n": 10,
        "rng": np.random.default_rng(0),
    }
    with pytest.raises(UsageError, match=message):
        sample_derivatives(**(arguments | changes))  # type: ignore[arg-type]
