"""Margins of the roll loop over gain sets x samples, cut at delta_lat.

The airframe is unstable by itself, so the loop is conditionally stable: too little gain loses it as well as too much,
and both limits are reported. In a sampled loop the upper one often lies at z = -1, half the tick rate. Whether a loop
is stable at all is decided by eigenvalues, never by the shape of L.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from sitl.airframe import DERIVATIVE_NAMES
from sitl.crossings import CriticalGains, Crossings, IndexArray, Loop, least_of
from sitl.errors import UsageError
from sitl.profile import Profile
from sitl.sampled_loop import ComplexArray, FloatArray, RollGains, SampledLoop

# Lowest frequency looked at: below the slowest integrator crossover of any gain worth flying.
OMEGA_MIN_RAD_S = 1e-4

MARGINAL = 1e-9
"""An eigenvalue this close to the unit circle counts as outside: a mode that never dies away, as without K_phi, lies
on it, and rounding would put it on this side for one sample and on that for the next."""


@dataclass(frozen=True)
class MarginArrays:
    """Margins of many loops: every field an array of one shape, (gain sets, samples) from `batch_margins`.

    The meaning of each is that of the same field of `sitl.stability.Margins`; NaN stands for its None.
    """

    closed_loop_stable: npt.NDArray[np.bool_]
    gain_margin_low_db: FloatArray
    gain_margin_high_db: FloatArray
    phase_margin_deg: FloatArray
    delay_margin_s: FloatArray
    modulus_margin: FloatArray
    sensitivity_peak: FloatArray
    """Largest |1 / (1 + L)|: the inverse of the modulus margin."""
    complementary_peak: FloatArray
    """Largest |L / (1 + L)|."""
    crossover_rad_s: FloatArray
    phase_crossover_rad_s: FloatArray


class Sampled:
    """`SampledLoop` of S samples as a `Loop`."""

    def __init__(self, loop: SampledLoop) -> None:
        self.loop = loop
        self.delay_s = loop.delay_s

    def grid(self) -> FloatArray:
        """See `Loop`."""
        loop = self.loop
        top = math.pi / loop.dt_s * (1.0 - 1e-6)
        slow = np.geomspace(OMEGA_MIN_RAD_S, 0.5, 60, endpoint=False)
        fast = np.geomspace(0.5, top, 300)
        turning_s = loop.delay_s - loop.motor_lag_s + 2.0 * loop.dt_s  # a lag turns L by 90 degrees in all
        even = np.linspace(0.5, top, math.ceil(top * turning_s / 0.15))
        return np.unique(np.concatenate([slow, fast, even]))

    def values(self, omega: FloatArray, rows: IndexArray) -> ComplexArray:
        """See `Loop`."""
        p, phi = self.loop.plant(omega, rows)
        on_p, on_phi = self.loop.controller(omega)
        return on_p * p + on_phi * phi

    def table(self, omega: FloatArray, rows: slice) -> ComplexArray:
        """See `Loop`."""
        return self.loop.sample(rows).transfer(omega)

    def real_at(self) -> tuple[float, ...]:
        """See `Loop`."""
        half_rate = math.pi / self.loop.dt_s
        return (half_rate, 0.0) if self.loop.finite_at_zero else (half_rate,)

    def unstable(self, rows: IndexArray, gains: FloatArray) -> IndexArray:
        """See `Loop`."""
        values = np.abs(self.loop.sample(rows).eigenvalues(gains))
        return np.asarray(np.count_nonzero(values >= 1.0 - MARGINAL, axis=-1))


class SampledSets(Sampled):
    """G gain sets on S samples as a `Loop` of G * S rows, sample by sample of the first set, then of the next.

    Args:
        loop: of the samples. gains: of the sets; all of them integrate, or none does.
    """

    def __init__(self, loop: SampledLoop, gains: Sequence[RollGains]) -> None:
        super().__init__(loop.with_gains(gains[0]))
        self._samples = len(loop.phi)
        self._gains = {f.name: np.array([getattr(one, f.name) for one in gains]) for f in fields(RollGains)}
        self._plant: tuple[FloatArray, tuple[ComplexArray, ComplexArray]] | None = None

    def _loop_of(self, sets: IndexArray, samples: IndexArray | None, *, columns: bool = False) -> SampledLoop:
        """With the gains of some rows as arrays; `columns`: each beside all frequencies."""
        gains = {name: value[sets][:, None] if columns else value[sets] for name, value in self._gains.items()}
        loop = self.loop if samples is None else self.loop.sample(samples)
        return loop.with_gains(RollGains(**gains))  # type: ignore[arg-type]  # floats or arrays of them

    def values(self, omega: FloatArray, rows: IndexArray) -> ComplexArray:
        """See `Loop`."""
        sets, samples = np.divmod(rows, self._samples)
        p, phi = self.loop.plant(omega, samples)
        on_p, on_phi = self._loop_of(sets, None).controller(omega)
        return on_p * p + on_phi * phi

    def table(self, omega: FloatArray, rows: slice) -> ComplexArray:
        """See `Loop`."""
        sets, samples = np.divmod(np.arange(rows.start, rows.stop), self._samples)
        if self._samples > _SAMPLES_KEPT:
            p, phi = self.loop.sample(samples).plant(omega)
        else:
            if self._plant is None:
                self._plant = omega, self.loop.plant(omega)
            p, phi = (one[samples] for one in self._plant[1])
        some, place = np.unique(sets, return_inverse=True)
        on_p, on_phi = self._loop_of(some, None, columns=True).controller(omega)
        return np.asarray(on_p[place] * p + on_phi[place] * phi)

    def unstable(self, rows: IndexArray, gains: FloatArray) -> IndexArray:
        """See `Loop`."""
        sets, samples = np.divmod(rows, self._samples)
        values = np.abs(self._loop_of(sets, samples).eigenvalues(gains))
        return np.asarray(np.count_nonzero(values >= 1.0 - MARGINAL, axis=-1))


_SAMPLES_KEPT = 512
"""Samples whose plant is kept at all frequencies for one gain set after the other."""
_ROWS_AT_ONCE = 2048
"""Pairs of a gain set and a sample that are worked on together."""


def batch_margins(
    derivatives: FloatArray,
    gains: Sequence[RollGains],
    profile: Profile,
    motor_lag_s: float,
    transport_delay_s: float = 0.0,
) -> MarginArrays:
    """Margins of the sampled loop of every gain set on every sample.

    Args:
        derivatives: (S, 6) in the order of DERIVATIVE_NAMES. gains: G sets.
        profile: rate, filters, delays. motor_lag_s: of the motors, 0 for none.
        transport_delay_s: further delay, beyond the profile's ticks.

    Returns:
        arrays (G, S).

    Raises:
        UsageError: no sample or gain set, or a number that is not finite.
    """
    check_models(derivatives, gains)
    loop = SampledLoop(derivatives, gains[0], profile, motor_lag_s, transport_delay_s)
    samples, at_once = len(derivatives), max(1, _ROWS_AT_ONCE // len(derivatives))
    made = {
        f.name: np.empty((len(gains), samples), bool if "stable" in f.name else float) for f in fields(MarginArrays)
    }
    for integrates in (True, False):
        members = [g for g, one in enumerate(gains) if (one.k * one.ki != 0.0) == integrates]
        for first in range(0, len(members), at_once):
            some = members[first : first + at_once]
            found = margins_of_loop(SampledSets(loop, [gains[g] for g in some]), len(some) * samples)
            for name, value in made.items():
                value[some] = getattr(found, name).reshape(len(some), samples)
    return MarginArrays(**made)


def check_models(derivatives: FloatArray, gains: Sequence[RollGains]) -> None:
    """Refuse samples and gains that no loop can be made of.

    Raises:
        UsageError: no sample or gain set, or a number that is not finite.
    """
    if derivatives.ndim != 2 or derivatives.shape[1] != len(DERIVATIVE_NAMES) or not len(derivatives):
        raise UsageError(f"samples of derivatives: shape {derivatives.shape}, want (samples, {len(DERIVATIVE_NAMES)})")
    if not np.isfinite(derivatives).all():
        row = int(np.flatnonzero(~np.isfinite(derivatives).all(axis=1))[0])
        raise UsageError(f"sample {row} of the derivatives is not finite: {derivatives[row].tolist()}")
    if not gains:
        raise UsageError("margins of no gain set")
    for one in gains:
        if not all(math.isfinite(getattr(one, f.name)) for f in fields(one)):
            raise UsageError(f"{one}: every gain must be finite")


def stacked(rows: Sequence[MarginArrays]) -> MarginArrays:
    """One more dimension in front."""
    return MarginArrays(**{f.name: np.stack([getattr(row, f.name) for row in rows]) for f in fields(MarginArrays)})


def margins_of_loop(loop: Loop, samples: int) -> MarginArrays:
    """Margins of S loops.

    Args:
        loop: all of them. samples: S.

    Returns:
        arrays (S,).
    """
    found = Crossings(loop, samples)
    every = np.arange(samples)
    unstable = loop.unstable(every, np.ones(samples))
    stable = unstable == 0
    low, high, high_at = _gain_range(loop, found, stable)
    phase, delay = _phase_and_delay(found, unstable, loop.delay_s)
    with np.errstate(all="ignore"):
        modulus = np.sqrt(least_of(loop, found.nearest, lambda value: _square(1.0 + value)))
        inverse = np.sqrt(least_of(loop, found.largest, lambda value: _square(1.0 + value) / _square(value)))
        low_db, high_db = 20.0 * np.log10(low), 20.0 * np.log10(high)
        peaks = 1.0 / modulus, 1.0 / inverse
    crossover = np.full(samples, math.nan)
    falling = found.unity.falling
    np.fmax.at(crossover, found.unity.row[falling], found.unity.omega[falling])
    return MarginArrays(
        closed_loop_stable=stable,
        gain_margin_low_db=np.where(np.isneginf(low_db), math.nan, low_db),
        gain_margin_high_db=high_db,
        phase_margin_deg=phase,
        delay_margin_s=delay,
        modulus_margin=modulus,
        sensitivity_peak=peaks[0],
        complementary_peak=peaks[1],
        crossover_rad_s=crossover,
        phase_crossover_rad_s=high_at,
    )


def _square(value: ComplexArray) -> FloatArray:
    return np.asarray(value.real**2 + value.imag**2)


def _gain_range(
    loop: Loop, found: Crossings, stable: npt.NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(low, high, frequency at high) of the nearest range of gain factors with a stable closed loop; each (S,).

    Between two neighbouring critical gains no eigenvalue can cross the boundary, so one look inside each range
    decides it. low is 0 for a range that begins at zero; all are NaN if there is no stable range.
    """
    critical = found.critical
    low, high = np.zeros(found.samples), np.full(found.samples, math.inf)
    at = np.full(found.samples, math.nan)
    below = critical.gain <= 1.0
    np.maximum.at(low, critical.row[below], critical.gain[below])
    # sorted by sample and gain: the first above 1 of each sample
    rows, first = np.unique(critical.row[~below], return_index=True)
    high[rows], at[rows] = critical.gain[~below][first], critical.omega[~below][first]
    lost = np.flatnonzero(~stable)
    if len(lost):
        low[lost], high[lost], at[lost] = np.array(_nearest_ranges(loop, lost, critical)).T
    return low, high, at


def _nearest_ranges(loop: Loop, rows: IndexArray, critical: CriticalGains) -> list[tuple[float, float, float]]:
    """The same for unstable loops: of all ranges of each, the nearest that is stable."""
    ranges = []
    for mine in _parts(critical.row, rows):
        edges = [0.0, *critical.gain[mine].tolist(), math.inf]
        omega = [*critical.omega[mine].tolist(), math.nan]
        ranges.append([(a, b, w) for (a, b), w in zip(pairwise(edges), omega, strict=True) if a < b])
    inside = np.array([_inside(a, b) for some in ranges for a, b, _ in some])
    unstable = iter(loop.unstable(np.repeat(rows, [len(some) for some in ranges]), inside).tolist())
    nearest = []
    for some in ranges:
        held = [one for one in some if next(unstable) == 0]
        nearest.append(min(held, key=lambda one: _distance(one[0], one[1]), default=(math.nan, math.nan, math.nan)))
    return nearest


def _parts(sorted_rows: IndexArray, rows: IndexArray) -> list[slice]:
    """Where each row's entries are."""
    first, behind = (np.searchsorted(sorted_rows, rows, side).tolist() for side in ("left", "right"))
    return [slice(a, b) for a, b in zip(first, behind, strict=True)]


def _distance(low: float, high: float) -> float:
    """How far a range of gain factors is from 1, as a ratio's logarithm; 0 if 1 lies in it."""
    if high <= 1.0:
        return -math.log(high)
    return math.log(low) if low > 1.0 else 0.0


def _inside(low: float, high: float) -> float:
    """A gain factor well inside a range: the present gain if that is."""
    if low < 1.0 < high:
        return 1.0
    if math.isinf(high):
        return 2.0 * low
    return math.sqrt(low * high) if low else 0.5 * high


def _phase_and_delay(found: Crossings, unstable: IndexArray, loop_delay_s: float) -> tuple[FloatArray, FloatArray]:
    """Phase margin in degrees and delay margin in s; each (S,)."""
    phase, delay = np.full((2, found.samples), math.inf)
    unity = found.unity
    np.minimum.at(phase, unity.row, np.minimum(unity.phase_deg, 360.0 - unity.phase_deg))
    np.minimum.at(delay, unity.row, np.radians(unity.phase_deg) / unity.omega)
    lost = np.flatnonzero(unstable)
    for row, mine in zip(lost.tolist(), _parts(unity.row, lost), strict=True):
        where = list(zip(unity.omega[mine], unity.phase_deg[mine], unity.falling[mine], strict=True))
        count = int(unstable[row])
        leads = [(360.0 - p, bool(inwards)) for _, p, inwards in where]
        phase[row] = -_lead_to_stability(leads, count, 180.0)
        events = [
            (math.radians(360.0 - p + 360.0 * turn) / w, bool(inwards))
            for w, p, inwards in where
            for turn in range(1 + math.ceil(loop_delay_s * w / (2.0 * math.pi)))
        ]
        delay[row] = -_lead_to_stability(events, count, loop_delay_s)
    return phase, delay


def _lead_to_stability(events: list[tuple[float, bool]], unstable: int, most: float) -> float:
    """Least lead after which no eigenvalue is left outside; NaN if none up to `most` does.

    Args:
        events: (lead at which an eigenvalue pair meets the boundary, whether lead brings it inside).
        unstable: eigenvalues outside now. most: lead beyond which not to look.
    """
    for lead, inwards in sorted(events):
        if lead > most:
            break
        unstable += -2 if inwards else 2
        if unstable == 0:
            return lead
    return math.nan
