"""A Monte Carlo without a flight: every gain set on every sample of an uncertain model, measured as flights are.

The roll axis is flown by `sitl.batch` with the laws that fly live; what is measured, and how segments become the
value of the whole, is what `scenarios.score` does with telemetry. NaN stands for UNSET.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from scenarios.batch_flight import WorstOf, setpoint_ticks
from scenarios.manoeuvres import Manoeuvre
from scenarios.roll_set import RollSet, roll_sets
from sitl.batch import Batch, Block, RollJob
from sitl.control_loop import CONTROL_SETTINGS
from sitl.errors import UsageError
from sitl.profile import Profile
from sitl.sampled_loop import RollGains
from sitl.uncertainty import Distribution, sample_derivatives
from sitl.vehicle_spec import VehicleModel

if TYPE_CHECKING:
    from sitl.margin_batch import MarginArrays

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MAX_SAMPLES = 1_000_000
TRACES_BYTES = 4e9
"""Traces that would not fit into this are refused."""

SETPOINT_RATE_HZ = 50.0
"""What a scenario sends its set-points at unless it says otherwise."""


@dataclass(frozen=True)
class Traces:
    """What was flown, of every gain set and sample.

    Attributes:
        t_s: (T,) from the start of the first manoeuvre.
        phi_sp_rad: (T,) roll set-point.
        phi_rad, delta_lat, p_rad_s: (G, S, T).
    """

    t_s: FloatArray
    phi_sp_rad: FloatArray
    phi_rad: FloatArray
    delta_lat: FloatArray
    p_rad_s: FloatArray


@dataclass(frozen=True)
class MonteCarlo:
    """Every gain set on every sample.

    Attributes:
        names: of the G gain sets.
        derivatives: (S, 6); row 0 is the nominal model.
        metrics: name of `scenarios.limits.METRICS` -> (G, S); NaN is UNSET.
        margins: of the loop, each (G, S); None if not asked for.
        diverged: (G, S) the roll angle passed 80 degrees.
        traces: None if not asked for.
    """

    names: tuple[str, ...]
    derivatives: FloatArray
    metrics: Mapping[str, FloatArray]
    margins: MarginArrays | None
    diverged: BoolArray
    traces: Traces | None = None


def draw_samples(
    model: VehicleModel,
    samples: int,
    seed: int,
    distribution: Distribution = "gaussian",
    spread_sigma: float = 3.0,
) -> FloatArray:
    """The nominal derivatives and then random ones: (samples + 1, 6).

    Args:
        model: nominal values and sigma. samples: number of random ones, 0 for none.
        seed: of the draw. distribution, spread_sigma: as `sample_derivatives`.

    Raises:
        UsageError: a number that is not usable.
    """
    if not 0 <= samples <= MAX_SAMPLES:
        raise UsageError(f"samples = {samples}: give 0 to {MAX_SAMPLES}")
    nominal = model.derivatives.as_array()[None, :]
    if not samples:
        return nominal
    rng = np.random.default_rng(seed)
    drawn = sample_derivatives(model.derivatives, model.sigma_pct, samples, rng, spread_sigma, distribution)
    return np.concatenate([nominal, drawn])


def monte_carlo(
    model: VehicleModel,
    gains: Mapping[str, RollGains | RollSet],
    profile: Profile,
    manoeuvres: Sequence[Manoeuvre],
    *,
    samples: int = 500,
    seed: int = 1,
    distribution: Distribution = "gaussian",
    spread_sigma: float = 3.0,
    derivatives: FloatArray | None = None,
    trace_every: int = 0,
    margins: bool = True,
    setpoint_rate_hz: float = SETPOINT_RATE_HZ,
    threads: int | None = None,
    compiled: bool | None = None,
) -> MonteCarlo:
    """Fly every gain set on the nominal model and on samples of it.

    Args:
        model: what flies, with its uncertainty. gains: name -> gains, or a whole set. profile: fidelity.
        manoeuvres: each from level flight, without wind or noise.
        samples, seed, distribution, spread_sigma: of the random models beside the nominal one.
        derivatives: (S, 6) to fly instead of drawing.
        trace_every: keep what was flown at every n-th tick; 0 keeps nothing. margins: work out the loop's margins too.
        setpoint_rate_hz: set-points are held in between. threads: None takes all cores.
        compiled: as `sitl.batch.Batch`.

    Returns:
        the same numbers whatever the number of threads.

    Raises:
        UsageError: no gain set or manoeuvre, samples that are not finite, traces too large.
    """
    if not gains or not manoeuvres:
        raise UsageError("a Monte Carlo needs at least one gain set and one manoeuvre")
    plain = {name: one for name, one in gains.items() if isinstance(one, RollGains)}
    made = dict(zip(plain, roll_sets(model, profile, list(plain.values())), strict=True))
    sets = [one if isinstance(one, RollSet) else made[name] for name, one in gains.items()]
    if derivatives is None:
        derivatives = draw_samples(model, samples, seed, distribution, spread_sigma)
    lag_s = profile.motor_lag(model.assumptions.motor_lag_s)
    signals = [setpoint_ticks(manoeuvre, profile, setpoint_rate_hz) for manoeuvre in manoeuvres]
    kept = _Kept(signals, len(sets), len(derivatives), trace_every, profile.dt_s) if trace_every else None
    worst = WorstOf(len(sets), len(derivatives))
    settings = np.zeros(len(sets), CONTROL_SETTINGS)
    for number, one in enumerate(sets):
        settings[number] = one.settings
    workers = threads or os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        found = pool.submit(margins_of, derivatives, sets, lag_s) if margins else None
        matrices = None
        for number, (manoeuvre, signal) in enumerate(zip(manoeuvres, signals, strict=True)):
            job = RollJob(
                settings, derivatives, lag_s, profile.transport_delay_ticks, model.assumptions.hover_thrust, signal
            )
            batch = Batch(job, compiled, matrices)
            matrices = batch.matrices
            keep = None if kept is None else partial(kept.add, number)
            worst.fly(batch, manoeuvre, profile.dt_s, pool, workers, keep)
        margin_arrays = found.result() if found is not None else None
    traces = None if kept is None else kept.traces
    return MonteCarlo(tuple(gains), derivatives, worst.metrics(), margin_arrays, worst.diverged, traces)


class _Kept:
    """Every n-th tick of what is flown, manoeuvre after manoeuvre."""

    def __init__(self, signals: Sequence[FloatArray], sets: int, samples: int, every: int, dt_s: float) -> None:
        self._every = every
        self._starts = [0]
        for signal in signals:
            self._starts.append(self._starts[-1] + len(signal[::every]))
        size = 24.0 * sets * samples * self._starts[-1]
        if size > TRACES_BYTES:
            raise UsageError(
                f"the traces of {sets} gain sets x {samples} samples x {self._starts[-1]} ticks would fill "
                f"{size / 1e9:.0f} GB: keep fewer, or none"
            )
        starts_s = np.cumsum([0.0, *(len(signal) * dt_s for signal in signals[:-1])])
        t_s = [start + np.arange(len(signal))[::every] * dt_s for start, signal in zip(starts_s, signals, strict=True)]
        blank = (np.empty((sets, samples, self._starts[-1])) for _ in range(3))
        self.traces = Traces(np.concatenate(t_s), np.concatenate([signal[::every] for signal in signals]), *blank)

    def add(self, number: int, block: Block) -> None:
        place = (block.gain_set, block.sample, slice(self._starts[number], self._starts[number + 1]))
        kept = self.traces
        for into, flown in (
            (kept.phi_rad, block.phi_rad),
            (kept.delta_lat, block.delta_lat),
            (kept.p_rad_s, block.p_rad_s),
        ):
            into[place] = flown[:: self._every].T


def margins_of(derivatives: FloatArray, sets: Sequence[RollSet], lag_s: float) -> MarginArrays:
    """Margins of every set on every sample, (G, S); sets that share their filters together.

    Args:
        derivatives: (S, 6). sets: gain sets. lag_s: of the motors.
    """
    from dataclasses import fields

    from sitl.margin_batch import MarginArrays, batch_margins

    rows: dict[int, MarginArrays] = {}
    profiles = list(dict.fromkeys(one.profile for one in sets))
    for profile in profiles:
        members = [g for g, one in enumerate(sets) if one.profile == profile]
        found = batch_margins(derivatives, [sets[g].gains for g in members], profile, lag_s)
        if len(profiles) == 1:
            return found
        for row, g in enumerate(members):
            rows[g] = MarginArrays(**{f.name: getattr(found, f.name)[row] for f in fields(found)})
    return MarginArrays(
        **{f.name: np.stack([getattr(rows[g], f.name) for g in range(len(sets))]) for f in fields(MarginArrays)}
    )
