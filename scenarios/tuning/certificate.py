"""What is proven of tuned gains, by methods that share nothing with the search.

The search looks at magnitudes on a grid of frequencies; here each weighted channel is a state space whose H-infinity
norm is found without a grid, stability is decided by the eigenvalues of every sample, and margins by refined roots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scenarios.tuning.channels import Channels
from scenarios.tuning.synthesis import Synthesis, Vehicle
from scenarios.tuning.weights import Weight
from sitl.crossings import FloatArray
from sitl.hinf_norm import hinf_norm
from sitl.profile import Profile
from sitl.sampled_loop import PHI, RollGains, SampledLoop


@dataclass(frozen=True)
class Certificate:
    """Of one gain set on one vehicle.

    Attributes:
        vehicle: its name.
        norms: of |W1 S|, |W2 Q|, |W3 F|, the largest over `models` models, each without a grid.
        models: nominal and extreme samples that the norms were worked out for.
        spectral_radius: largest over all samples: below 1 every one of them is stable.
        samples: how many, the nominal among them.
    """

    vehicle: str
    norms: tuple[float, float, float]
    models: int
    spectral_radius: float
    samples: int


def certify(synthesis: Synthesis, vehicle: Vehicle, profile: Profile, rows: Sequence[int]) -> Certificate:
    """The certificate of what a search found.

    Args:
        synthesis: with gains and weights. vehicle: with its samples. profile: fidelity.
        rows: samples whose norms are worked out.
    """
    loop = SampledLoop(vehicle.derivatives, synthesis.gains, profile, vehicle.lag_s)
    radius = float(np.abs(loop.eigenvalues()).max())
    norms = np.zeros(3)
    for row in rows:
        norms = np.maximum(norms, channel_norms(loop.sample(row), profile, synthesis.weights))
    first, second, third = norms.tolist()
    return Certificate(vehicle.model.name, (first, second, third), len(rows), radius, len(vehicle.derivatives))


def channel_norms(loop: SampledLoop, profile: Profile, weights: Sequence[Weight]) -> FloatArray:
    """(3,) H-infinity norms of W1 S, W2 Q, W3 F of one model; inf if the loop is unstable.

    Args:
        loop: of one model. profile: whether the rate set-point is a tick late. weights: W1, W2, W3.
    """
    tick = loop.tick()
    n, late = len(tick.matrix), profile.rate_sp_late_ticks
    a, b = np.zeros((n + late, n + late)), np.zeros(n + late)
    a[:n, :n] = tick.matrix
    if late:  # the last state is the set-point of the tick before, which the rate law uses
        a[:n, n], b[n] = tick.setpoint, 1.0
    else:
        b[:n] = tick.setpoint
    phi, delta = np.zeros(n + late), np.zeros(n + late)
    phi[PHI] = 1.0
    delta[:n] = tick.delta
    direct = 0.0 if late else tick.direct
    if late:
        delta[n] = tick.direct
    channels = ((-phi, 1.0), (delta, direct), (phi, 0.0))
    return np.array(
        [
            hinf_norm(*_weighted(a, b, c, d, weight.sampled(loop.dt_s)), loop.dt_s)
            for (c, d), weight in zip(channels, weights, strict=True)
        ]
    )


def _weighted(
    a: FloatArray, b: FloatArray, c: FloatArray, d: float, weight: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The channel with its weight behind it, as a state space."""
    b0, b1, a1 = weight
    n = len(a)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n] = a
    share = b1 - a1 * b0
    whole[n, :n], whole[n, n] = share * c, -a1
    inputs = np.append(b, share * d)[:, None]
    outputs = np.append(b0 * c, 1.0)[None, :]
    return whole, inputs, outputs, np.array([[b0 * d]])


def worst_rows(
    vehicle: Vehicle, profile: Profile, gains: RollGains, weights: Sequence[Weight], count: int = 12
) -> list[int]:
    """The nominal model and the samples whose weighted channels are largest on a grid, of those that hold an angle.

    Args:
        vehicle: with its samples. profile: fidelity. gains: of the roll axis. weights: W1, W2, W3.
        count: how many besides the nominal, as many for each channel.
    """
    able = np.flatnonzero(vehicle.holds)
    each = Channels(vehicle.derivatives[able], profile, vehicle.lag_s).each(gains, weights)
    order = [able[np.argsort(-peaks, kind="stable")[: count // 3]].tolist() for peaks in each]
    return list(dict.fromkeys([int(able[0]), *(row for rows in order for row in rows)]))
