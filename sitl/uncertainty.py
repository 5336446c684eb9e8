"""Seeded samples of an uncertain set of derivatives, for a Monte Carlo (study, chapters 6 and 7)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from sitl.airframe import DERIVATIVE_NAMES, Derivatives
from sitl.errors import UsageError

Distribution = Literal["gaussian", "uniform"]
DISTRIBUTIONS: tuple[Distribution, ...] = ("gaussian", "uniform")

# Below half a sigma the rejection of a truncated Gaussian in six dimensions would run for ever.
MIN_SPREAD, MAX_SPREAD = 0.5, 8.0


def sample_derivatives(
    nominal: Derivatives,
    sigma_pct: Derivatives,
    n: int,
    rng: np.random.Generator,
    spread_sigma: float = 3.0,
    distribution: Distribution = "gaussian",
    correlation: npt.ArrayLike | None = None,
) -> npt.NDArray[np.float64]:
    """Samples of the derivatives, every one within `spread_sigma` standard deviations of its nominal value.

    "gaussian" is the normal distribution truncated there, which the study's "500 samples within +-3 sigma" is
    taken to mean; "uniform" is flat between the same bounds. A longer run with the same seed begins with the
    samples of the shorter one.

    Args:
        nominal: values at the centre.
        sigma_pct: one standard deviation of each, in per cent of the magnitude of its nominal value.
        n: number of samples.
        rng: source of randomness.
        spread_sigma: half width, in standard deviations.
        distribution: one of DISTRIBUTIONS.
        correlation: (6, 6) in the order of DERIVATIVE_NAMES, before truncation; Gaussian only.

    Returns:
        (n, 6), columns in the order of DERIVATIVE_NAMES.

    Raises:
        UsageError: n, spread, distribution or correlation is not usable.
    """
    if n < 1:
        raise UsageError(f"samples = {n}: at least 1")
    if not MIN_SPREAD <= spread_sigma <= MAX_SPREAD:
        raise UsageError(f"spread_sigma = {spread_sigma:g}: it must be from {MIN_SPREAD:g} to {MAX_SPREAD:g}")
    if distribution not in DISTRIBUTIONS:
        raise UsageError(f'unknown distribution "{distribution}"; use one of {", ".join(DISTRIBUTIONS)}')
    centre = nominal.as_array()
    sigma = np.abs(centre) * sigma_pct.as_array() / 100.0
    if distribution == "uniform":
        if correlation is not None:
            raise UsageError("correlation goes with the gaussian distribution only")
        return centre + sigma * rng.uniform(-spread_sigma, spread_sigma, (n, len(centre)))
    root = np.eye(len(centre)) if correlation is None else _root(correlation)
    return centre + sigma * _truncated(n, rng, spread_sigma, root)


def _truncated(
    n: int, rng: np.random.Generator, spread: float, root: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(n, 6) standard normal rows times root', drawn until n of them lie within +-spread in every column.

    Whole rows are rejected, in order: exact for a correlated distribution, and for an uncorrelated one the
    same as truncating each column, since the columns are independent.
    """
    kept = np.empty((0, len(root)))
    while len(kept) < n:
        rows = rng.standard_normal((max(64, n - len(kept)), len(root))) @ root.T
        kept = np.concatenate([kept, rows[np.all(np.abs(rows) <= spread, axis=1)]])
    return kept[:n]


def _root(correlation: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """R with R R' = correlation; a semidefinite one (derivatives that move as one) is allowed."""
    size = len(DERIVATIVE_NAMES)
    matrix = np.asarray(correlation, dtype=float)
    if matrix.shape != (size, size) or not np.all(np.isfinite(matrix)):
        raise UsageError(f"correlation: it must be {size} x {size} finite numbers ({', '.join(DERIVATIVE_NAMES)})")
    if not np.allclose(matrix, matrix.T, atol=1e-9) or not np.allclose(np.diag(matrix), 1.0, atol=1e-9):
        raise UsageError("correlation: it must be symmetric with ones on the diagonal")
    values, vectors = np.linalg.eigh(matrix)
    if values[0] < -1e-9:
        raise UsageError(f"correlation: not positive semidefinite, smallest eigenvalue {values[0]:.3g}")
    root: npt.NDArray[np.float64] = vectors * np.sqrt(np.clip(values, 0.0, None))
    return root
