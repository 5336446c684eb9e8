"""The search: gains of the fixed structure that make the worst weighted norm over all design models smallest.

Hard bounds, never traded: every design model stable, the delay margin, and in a flown step settling and overshoot. The
design models are the nominal one and samples chosen for their extremes; after each search the result is tried on every
sample, and those that fail join the design models (at most a few rounds). They are pushed outwards a little, so that
samples nobody drew do enough as well, unless that asks for too much. If the bounds cannot all be kept, the search
returns the gains that break them least, and says which.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from scenarios.monte_carlo import MAX_SAMPLES, draw_samples
from scenarios.tuning.channels import Channels, Norms
from scenarios.tuning.requirements import Requirements
from scenarios.tuning.step_trial import StepTrial, Trial
from scenarios.tuning.weights import Weight, weights_for
from sitl.crossings import BoolArray, FloatArray, IndexArray
from sitl.errors import UsageError
from sitl.margin_batch import MarginArrays, batch_margins
from sitl.profile import Profile
from sitl.sampled_loop import RollGains
from sitl.uncertainty import Distribution
from sitl.vehicle_spec import VehicleModel

Progress = Callable[[str], object]

ROUNDS = 4
POPULATION = 48
GENERATIONS = 80
PUSH = 1.2
"""Design models lie this much further from the nominal one than the samples they are made of: settling leaps where an
oscillation just leaves the band, and a reserve in seconds would not keep samples that nobody drew on this side."""
RESERVE = 0.05
"""Share by which the design models must do better than required, so that samples not seen do enough."""

# Search ranges: K_phi in 1/s; K_P in rate-loop bandwidth K_P Ld, rad/s; K_I / K_P in 1/s; K_D Ld, dimensionless.
K_PHI = (1.0, 25.0)
BANDWIDTH = (1.5, 400.0)
RESET = (0.05, 80.0)
LEAD = (1e-4, 1.5)

_BROKEN = 100.0
_TIE = 0.02
_SMALLEST_DELAY_S = 1e-6


@dataclass(frozen=True)
class Vehicle:
    """One of the vehicles that a gain set is made for.

    Attributes:
        model: as resolved. derivatives: (S, 6) all samples, the nominal first. lag_s: of its motors.
        holds: (S,) samples that can hold a roll angle at all, see `holds_an_angle`. trial: flies its step.
    """

    model: VehicleModel
    derivatives: FloatArray
    lag_s: float
    holds: BoolArray
    trial: StepTrial


@dataclass(frozen=True)
class Checked:
    """A gain set on every sample of one vehicle.

    Attributes:
        trial: metrics (1, S). margins: (1, S).
    """

    trial: Trial
    margins: MarginArrays

    def failing(self, required: Requirements, holds: BoolArray) -> IndexArray:
        """Numbers of the samples that fall shortest of the requirements, of those that can hold an angle."""
        stable = self.margins.closed_loop_stable[0]
        delay = np.where(stable, self.margins.delay_margin_s[0], -math.inf)
        kinds = [
            self.trial.settling_s[0] - required.settling_time_s,
            self.trial.overshoot_pct[0] - required.overshoot_pct,
            required.delay_margin_s - delay,
            np.where(stable, -1.0, math.inf),
        ]
        kinds = [np.where(holds, kind, -math.inf) for kind in kinds]
        worst = [int(kind.argmax()) for kind in kinds if kind.max() > 0.0]
        return np.array(list(dict.fromkeys(worst)), dtype=np.intp)


@dataclass(frozen=True)
class Synthesis:
    """What the search found.

    Attributes:
        gains: of the roll axis. weights: W1, W2, W3 that it was made with.
        norms: over the design models, (1,) each. checked: of each vehicle, on every sample.
        design_models: how many models the search looked at, of all vehicles together.
        rounds: searches that it took. evaluations: gain sets that were looked at.
        broken: how badly the design models break the bounds, as the search counts it; 0 if they keep all.
    """

    gains: RollGains
    weights: tuple[Weight, ...]
    norms: Norms
    checked: tuple[Checked, ...]
    design_models: int
    rounds: int
    evaluations: int
    broken: float


def prepare(
    models: Sequence[VehicleModel],
    profile: Profile,
    requirements: Requirements,
    samples: int,
    seed: int,
    distribution: Distribution = "gaussian",
) -> tuple[Vehicle, ...]:
    """The vehicles with their samples drawn.

    Args:
        models: at least one. profile: fidelity. requirements: of the step. samples, seed, distribution: of the draw.

    Raises:
        UsageError: no vehicle, or a number that is not usable.
    """
    if not models:
        raise UsageError("no vehicle to tune for")
    names = [model.name for model in models]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"{names.count(name)} of the vehicles are {name}: give each once")
    if not 0 <= samples <= MAX_SAMPLES:
        raise UsageError(f"samples = {samples}: give 0 to {MAX_SAMPLES}")
    made = []
    for model in models:
        count = samples if any(value > 0.0 for value in model.sigma_pct.as_dict().values()) else 0
        derivatives = draw_samples(model, count, seed, distribution)
        if (derivatives[:, 5] <= 0.0).any():
            raise UsageError(
                f"{model.name}: a sample has no roll torque (Ld = {derivatives[:, 5].min():.3g}): its sigma of "
                f"{model.sigma_pct.Ld:g} % is too wide to design gains for"
            )
        lag_s = profile.motor_lag(model.assumptions.motor_lag_s)
        holds = holds_an_angle(derivatives)
        if not holds.any():
            raise UsageError(
                f"{model.name}: no sample can hold a roll angle (Lv Yd - Ld Yv must be above 0); check its derivatives"
            )
        made.append(Vehicle(model, derivatives, lag_s, holds, StepTrial(model, profile, requirements)))
    return tuple(made)


def holds_an_angle(derivatives: FloatArray) -> BoolArray:
    """Which models need torque to one side to stay rolled to that side.

    phi / delta_lat has a zero at (Lv Yd - Ld Yv) / -Ld. Where it lies in the right half plane the torque that holds an
    angle points the other way than the torque that reaches it: an integrator then drives the loop away, whatever its
    gain. Without one the loop may be stable, but comes to rest rolled to the other side.

    Args:
        derivatives: (S, 6).

    Returns:
        (S,).
    """
    Yv, _, Yd, Lv, _, Ld = derivatives.T
    return np.asarray(Lv * Yd - Ld * Yv > 0.0)


def synthesise(
    vehicles: Sequence[Vehicle],
    profile: Profile,
    requirements: Requirements,
    *,
    seed: int = 1,
    starts: int = 2,
    push: float = PUSH,
    firm: bool = False,
    near: RollGains | None = None,
    progress: Progress = lambda _: None,
) -> Synthesis:
    """Gains for all vehicles at once; the same for the same seed.

    Args:
        vehicles: from `prepare`. profile: fidelity. requirements: what to meet.
        seed: of the search. starts: searches until one keeps all bounds on the design models, the first on
            models pushed outwards by `push`, the others without.
        firm: where bounds are broken, the delay margin comes before settling and overshoot.
        near: gains to look at besides. progress: called with a short text.
    """
    weights = weights_for(requirements)
    chosen = [_extremes(vehicle.derivatives, vehicle.holds) for vehicle in vehicles]
    evaluations, best = 0, None
    for number in range(1, ROUNDS + 1):
        progress(f"search {number}: {sum(len(rows) for rows in chosen)} models")
        for start in range(starts if number == 1 else 1):
            # what cannot be had with the models pushed outwards may still be had without
            push = push if start == 0 else 1.0
            search = _Search(vehicles, chosen, profile, requirements, weights, push, firm)
            gains, cost = search.run(seed + number - 1 + ROUNDS * start, near if best is None else best.gains)
            evaluations += search.evaluations
            if cost < _BROKEN:
                break
        progress(f"search {number}: trying every sample")
        checked = tuple(check(vehicle, profile, gains) for vehicle in vehicles)
        best = Synthesis(
            gains=gains,
            weights=weights,
            norms=search.norms([gains]),
            checked=checked,
            design_models=sum(len(rows) for rows in chosen),
            rounds=number,
            evaluations=evaluations,
            broken=max(0.0, cost - _BROKEN),
        )
        failing = [one.failing(requirements, v.holds) for v, one in zip(vehicles, checked, strict=True)]
        if best.broken > 0.0 or not any(len(rows) for rows in failing):
            break
        grown = [np.union1d(rows, new) for rows, new in zip(chosen, failing, strict=True)]
        if all(len(a) == len(b) for a, b in zip(grown, chosen, strict=True)):
            # the failing samples are design models already: ask a little more of them
            requirements = replace(
                requirements,
                settling_time_s=0.98 * requirements.settling_time_s,
                overshoot_pct=0.9 * requirements.overshoot_pct,
                delay_margin_s=1.03 * requirements.delay_margin_s,
            )
        chosen = grown
    assert best is not None
    return best


def check(vehicle: Vehicle, profile: Profile, gains: RollGains) -> Checked:
    """One gain set on every sample of one vehicle.

    Args:
        vehicle: with its samples. profile: fidelity. gains: of the roll axis.
    """
    margins = batch_margins(vehicle.derivatives, [gains], profile, vehicle.lag_s)
    return Checked(vehicle.trial.fly([gains], vehicle.derivatives), margins)


def _extremes(derivatives: FloatArray, holds: BoolArray) -> IndexArray:
    """The nominal model, and the samples with the least and the most of what matters to the loop."""
    able = np.flatnonzero(holds)
    derivatives = derivatives[able]
    Yv, Yp, Yd, Lv, Lp, Ld = derivatives.T
    # roll torque, how far and how fast it rolls back, damping, and the unstable mode's speed
    measures = (Ld, Lv, Lv / Ld, Lp, Yv, Yp * Lv, Lv * Yd - Ld * Yv)
    rows = [0, *(int(pick(measure)) for measure in measures for pick in (np.argmin, np.argmax))]
    return able[np.unique(np.array(rows, dtype=np.intp))]


def _pushed(vehicle: Vehicle, rows: IndexArray, push: float) -> FloatArray:
    """Samples moved away from the nominal model, but for those that could not hold an angle then."""
    there = vehicle.derivatives[rows]
    beyond = vehicle.derivatives[0] + push * (there - vehicle.derivatives[0])
    usable = holds_an_angle(beyond) & (beyond[:, 5] > 0.0)
    return np.where(usable[:, None], beyond, there)


class _Search:
    """One search on fixed design models."""

    def __init__(
        self,
        vehicles: Sequence[Vehicle],
        chosen: Sequence[IndexArray],
        profile: Profile,
        requirements: Requirements,
        weights: Sequence[Weight],
        push: float,
        firm: bool,
    ) -> None:
        pairs = list(zip(vehicles, chosen, strict=True))
        self._parts = [
            (vehicle, models, Channels(models, profile, vehicle.lag_s))
            for vehicle, models in zip(vehicles, (_pushed(v, r, push) for v, r in pairs), strict=True)
        ]
        self._required = requirements
        self._firm = 2.0 if firm else 0.0
        self._weights = weights
        self._scale = float(np.exp(np.mean([np.log(vehicle.derivatives[0, 5]) for vehicle in vehicles])))
        self.evaluations = 0

    def run(self, seed: int, start: RollGains | None) -> tuple[RollGains, float]:
        """(gains, cost) of the best found: below `_BROKEN` the worst norm, above it what is broken."""
        bounds = [tuple(math.log(v) for v in limits) for limits in (K_PHI, BANDWIDTH, RESET, LEAD)]
        found = scipy.optimize.differential_evolution(
            lambda points: self.cost(points.T),
            bounds,
            init=self._first(bounds, seed, start),
            maxiter=GENERATIONS,
            rng=np.random.default_rng(seed),
            mutation=(0.4, 0.9),
            recombination=0.8,
            tol=0.0,
            atol=1e-3,
            polish=False,
            vectorized=True,
            updating="deferred",
        )
        return self._gains(found.x), float(found.fun)

    def _first(self, bounds: Sequence[tuple[float, ...]], seed: int, start: RollGains | None) -> FloatArray:
        """A Sobol sequence over the ranges, with the best of the search before, if there was one."""
        from scipy.stats import qmc

        low, high = np.array(bounds).T
        rough = qmc.scale(qmc.Sobol(4, rng=np.random.default_rng(seed)).random(512), low, high)
        if start is not None:
            scaled = (start.k_phi, start.kp * self._scale, start.ki / start.kp, start.kd * self._scale)
            rough[0] = np.clip(np.log(np.maximum(scaled, 1e-9)), low, high)
        return np.asarray(rough[np.argsort(self.cost(rough), kind="stable")[:POPULATION]])

    def _gains(self, point: FloatArray) -> RollGains:
        k_phi, bandwidth, reset, lead = np.exp(point).tolist()
        # what a vehicle stores is a float32: what is designed is what flies
        single = [float(np.float32(v)) for v in (k_phi, bandwidth / self._scale, bandwidth / self._scale * reset)]
        return RollGains(single[0], 1.0, single[1], single[2], float(np.float32(lead / self._scale)))

    def norms(self, gains: Sequence[RollGains]) -> Norms:
        """The worst over all vehicles."""
        each = [channels.norms(gains, self._weights) for _, _, channels in self._parts]
        return Norms(
            s=np.max([n.s for n in each], axis=0),
            q=np.max([n.q for n in each], axis=0),
            f=np.max([n.f for n in each], axis=0),
            delay_margin_s=np.min([n.delay_margin_s for n in each], axis=0),
        )

    def cost(self, points: FloatArray) -> FloatArray:
        """(K,) of (K, 4) points; the cheap bounds are looked at first, and only who passes them flies."""
        gains = [self._gains(point) for point in points]
        self.evaluations += len(gains)
        norms = self.norms(gains)
        need = self._required
        cost = np.minimum(norms.worst, _BROKEN - 1.0)
        for i, one in enumerate(gains):
            radius = max(float(channels.stable([one])[0]) for _, _, channels in self._parts)
            if radius >= 1.0:
                cost[i] = _BROKEN * (2.0 + min(radius - 1.0, 1.0))
            elif norms.delay_margin_s[i] < need.delay_margin_s * (1.0 + RESERVE):
                # a logarithm: whatever is asked, twice the margin counts for as much
                had = max(norms.delay_margin_s[i], _SMALLEST_DELAY_S)
                cost[i] = _BROKEN + self._firm + math.log(need.delay_margin_s * (1.0 + RESERVE) / had)
        flies = np.flatnonzero(cost < 2.0 * _BROKEN)
        if len(flies):
            share = self._broken([gains[i] for i in flies])
            close = cost[flies]
            cost[flies] = np.where(share > 0.0, np.maximum(close, _BROKEN) + share, close)
        # where nothing settles at all every step is as bad as the other: the norms still point the way
        cost += np.where(cost >= _BROKEN, _TIE * np.log1p(norms.s), 0.0)
        return cost

    def _broken(self, gains: Sequence[RollGains]) -> FloatArray:
        """Largest share by which a flown step breaks settling or overshoot; (K,), 0 if neither."""
        need = self._required
        share = np.zeros(len(gains))
        for vehicle, derivatives, _ in self._parts:
            flown = vehicle.trial.fly(gains, derivatives)
            settling = np.minimum(flown.settling_s, 4.0).max(axis=1) / (need.settling_time_s * (1.0 - RESERVE)) - 1.0
            # the last tenth of a per cent is rounding of a step, not a property of gains
            over = np.minimum(flown.overshoot_pct, 100.0).max(axis=1) - need.overshoot_pct * (1.0 - 3.0 * RESERVE)
            share = np.maximum(share, np.maximum(settling, over / 10.0))
        return np.maximum(share, 0.0)
