"""The H-infinity norm of a state space, without any grid of frequencies.

gamma exceeds the norm exactly if a Hamiltonian matrix made with gamma has no eigenvalue on the imaginary axis (Boyd and
Balakrishnan; Bruinsma and Steinbuch). Where it has some, they are the frequencies at which the largest singular value
passes gamma: the middle between two neighbours gives the next, larger guess, and the search converges quadratically.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sitl.errors import UsageError

FloatArray = npt.NDArray[np.float64]

_ROUNDS = 60


def hinf_norm(
    A: npt.ArrayLike,
    B: npt.ArrayLike,
    C: npt.ArrayLike,
    D: npt.ArrayLike,
    dt_s: float | None,
    *,
    tolerance: float = 1e-6,
) -> float:
    """Largest singular value of C (sI - A)^-1 B + D over all frequencies.

    Args:
        A, B, C, D: (n, n), (n, inputs), (outputs, n), (outputs, inputs); n may be 0.
        dt_s: sample time; None for a continuous system.
        tolerance: relative error of the result, which is never above the norm by more than it.

    Returns:
        the norm; inf if the system is not asymptotically stable.

    Raises:
        UsageError: shapes that do not fit, or a number that is not finite.
    """
    a, b, c, d = (np.atleast_2d(np.asarray(m, dtype=float)) for m in (A, B, C, D))
    n = 0 if a.size == 0 else len(a)
    if n == 0:
        return _gain(d)
    if a.shape != (n, n) or b.shape != (n, d.shape[1]) or c.shape != (d.shape[0], n):
        raise UsageError(f"state space of shapes {a.shape}, {b.shape}, {c.shape}, {d.shape} does not fit together")
    if not all(np.isfinite(m).all() for m in (a, b, c, d)):
        raise UsageError("state space: a number is not finite")
    if dt_s is not None:
        if np.abs(np.linalg.eigvals(a)).max() >= 1.0:
            return math.inf
        a, b, c, d = _to_continuous(a, b, c, d)
    poles = np.linalg.eigvals(a)
    if poles.real.max() >= 0.0:
        return math.inf
    a, b, c = _balanced(a, b, c)
    low = max(_response(a, b, c, d, w) for w in _guesses(poles))
    low = max(low, _gain(d))
    if low == 0.0:
        return 0.0
    for _ in range(_ROUNDS):
        gamma = (1.0 + 2.0 * tolerance) * low
        crossings = _crossings(a, b, c, d, gamma)
        if not len(crossings):
            return low * (1.0 + tolerance)
        middles = 0.5 * (crossings[:-1] + crossings[1:]) if len(crossings) > 1 else crossings
        higher = max(_response(a, b, c, d, float(w)) for w in middles)
        if higher <= gamma:  # a tangent found by rounding alone
            return max(low, higher)
        low = higher
    return low


def _to_continuous(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """By z = (1 + s) / (1 - s), which maps the unit circle to the imaginary axis and keeps the norm."""
    unit = np.eye(len(a))
    inverse = np.linalg.inv(a + unit)
    root = math.sqrt(2.0)
    return inverse @ (a - unit), root * inverse @ b, root * c @ inverse, d - c @ inverse @ b


def _balanced(a: FloatArray, b: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States scaled so that none is numerically far from the others; the transfer function stays."""
    import scipy.linalg  # slow to import, and only a certificate needs it

    balanced, (scale, _) = scipy.linalg.matrix_balance(a, permute=False, separate=True)
    return balanced, b / scale[:, None], c * scale


def _guesses(poles: npt.NDArray[np.complex128]) -> list[float]:
    """Frequencies near which a peak may be: 0, the poles' own, and far out."""
    found = {0.0, 1.0}
    for pole in poles:
        found |= {abs(float(pole.imag)), abs(complex(pole))}
    return sorted(found)


def _gain(d: FloatArray) -> float:
    return float(np.linalg.norm(d, 2)) if d.size else 0.0


def _response(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, omega: float) -> float:
    """Largest singular value at one frequency."""
    value = c @ np.linalg.solve(1j * omega * np.eye(len(a)) - a, b) + d
    return float(np.linalg.norm(value, 2))


def _crossings(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, gamma: float) -> FloatArray:
    """Frequencies at which a singular value equals gamma, ascending: imaginary eigenvalues of the Hamiltonian."""
    r = gamma**2 * np.eye(d.shape[1]) - d.T @ d
    s = gamma**2 * np.eye(d.shape[0]) - d @ d.T
    rd = np.linalg.solve(r, d.T @ c)
    rb = np.linalg.solve(r, b.T)
    top = a + b @ rd
    hamiltonian = np.block([[top, gamma * b @ rb], [-gamma * c.T @ np.linalg.solve(s, c), -top.T]])
    values = np.linalg.eigvals(hamiltonian)
    on_axis = np.abs(values.real) < 1e-7 * np.maximum(np.abs(values), 1e-3)
    found: FloatArray = np.unique(np.abs(values.imag[on_axis]))
    # an axis eigenvalue that is one by rounding alone is told by the response there
    real = [w for w in found.tolist() if _response(a, b, c, d, w) >= gamma * (1.0 - 1e-4)]
    return np.array(real)
