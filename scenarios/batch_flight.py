"""A batch flown and measured block by block: what is left of a flight is its metrics, one column per pair.

Each pair of a gain set and a sample flies every manoeuvre; the whole's value of a metric is that of its worst window,
as `scenarios.score` has it for flights. NaN stands for UNSET.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue

import numpy as np
import numpy.typing as npt

from scenarios import batch_metrics as lanes
from scenarios.batch_tracking import TRACK
from scenarios.manoeuvres import EPSILON_S, Manoeuvre, Window
from scenarios.metrics import effort_metrics, oscillation, step_metrics, track_metrics
from sitl.array_form import array_form
from sitl.batch import Batch, Block
from sitl.compiled import compiled, select
from sitl.profile import Profile

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MEASURED = (*lanes.STEP, *TRACK, *lanes.OSCILLATION, *lanes.EFFORT)
"""Metrics of a pair, in the order of the rows of `WorstOf.values`."""

_ROWS = {name: row for row, name in enumerate(MEASURED)}
_STEP, _TRACK = slice(0, len(lanes.STEP)), slice(len(lanes.STEP), len(lanes.STEP) + len(TRACK))
_SHAKE = slice(_TRACK.stop, _TRACK.stop + len(lanes.OSCILLATION))
_EFFORT = slice(_SHAKE.stop, _SHAKE.stop + len(lanes.EFFORT))

_HIGHEST, _LOWEST, _LARGEST, _KNOWN = range(4)
_SENSE = {"vaf_pct": _LOWEST, "vaf_lag_removed_pct": _LOWEST, "droop_deg": _LARGEST, "oscillation_rad_s": _KNOWN}
_SENSES = np.array([_SENSE.get(name, _HIGHEST) for name in MEASURED])


def metrics_of(manoeuvres: Sequence[Manoeuvre]) -> tuple[str, ...]:
    """Names of what is measured on manoeuvres, in the order of MEASURED.

    Args:
        manoeuvres: in any order.
    """
    rows = {row for one in manoeuvres for window in one.windows for part in _rows_of(window.kind) for row in _span(part)}
    return tuple(MEASURED[row] for row in sorted(rows))


def setpoint_ticks(manoeuvre: Manoeuvre, profile: Profile, setpoint_rate_hz: float) -> FloatArray:
    """(T,) roll set-point of every tick, rad: sent at its own rate and held.

    Args:
        manoeuvre: what is flown. profile: its ticks. setpoint_rate_hz: messages per second.
    """
    sent = manoeuvre.samples(setpoint_rate_hz)
    ticks = np.arange(round(manoeuvre.duration_s * profile.rate_hz))
    held = np.floor(ticks / profile.rate_hz * setpoint_rate_hz + EPSILON_S * setpoint_rate_hz).astype(int)
    return np.asarray(sent[np.minimum(held, len(sent) - 1)])


@compiled
def worse(sense: int, held: float, new: float) -> float:
    """The worse of two windows' values; `held` is -inf before the first, and NaN is worse than any number.

    The oscillation alone passes over a window that is too short to tell.
    """
    first, unknown = held == -math.inf, (new != new) | (held != held)
    lowest = select(first, new, select(held < new, held, new))
    highest = select(held > new, held, new)
    largest = select(first | (abs(new) > abs(held)), new, held)
    known = select(new != new, held, highest)
    ordered = select(sense == _LOWEST, lowest, select(sense == _LARGEST, largest, highest))
    return select(sense == _KNOWN, known, select(unknown, math.nan, ordered))


@compiled
def _merge(into: FloatArray, at: int, new: FloatArray, first: int, senses: npt.NDArray[np.int64]) -> None:
    """Take the values of one window, (k, n), into rows `first` and on of all pairs', from column `at` on."""
    rows, n = new.shape
    for row in range(rows):
        sense = senses[first + row]
        for j in range(n):
            into[first + row, at + j] = worse(sense, into[first + row, at + j], new[row, j])


class WorstOf:
    """What a batch has measured so far.

    Attributes:
        values: (len(MEASURED), G * S), sample by sample of the first gain set, then of the next; -inf where no window
            has measured it, NaN where one could not.
        lost: (G * S,) the roll angle passed 80 degrees.
    """

    def __init__(self, sets: int, samples: int) -> None:
        self.shape = sets, samples
        self.values = np.full((len(MEASURED), sets * samples), -math.inf)
        self.lost: BoolArray = np.zeros(sets * samples, dtype=bool)
        self._measured: set[int] = set()

    @property
    def diverged(self) -> BoolArray:
        """(G, S) of `lost`."""
        return self.lost.reshape(self.shape)

    def fly(
        self,
        batch: Batch,
        manoeuvre: Manoeuvre,
        dt_s: float,
        pool: ThreadPoolExecutor | None = None,
        workers: int = 1,
        keep: Callable[[Block], None] | None = None,
    ) -> None:
        """Fly and measure all blocks of a batch.

        Args:
            batch: of as many gain sets and samples. manoeuvre: whose set-points it flies. dt_s: its tick, s.
            pool, workers: threads that blocks are flown in, a few ahead of what has been told; the calling one alone
                without.
            keep: called with every block while its traces are there.
        """
        measure = _measure_lanes if batch.compiled else _measure_each
        signal = batch.job.phi_sp_rad
        self._measured.update(MEASURED.index(name) for name in metrics_of([manoeuvre]))

        def one(number: int, room: FloatArray) -> None:
            block = batch.fly(number, room)
            if keep is not None:
                keep(block)
            for at, part in _runs(block, self.shape[1]):
                self.lost[at : at + len(part.lost)] |= part.lost
                for window in manoeuvre.windows:
                    measure(self.values, at, part, window, signal, dt_s)

        if pool is None:
            room = np.empty(batch.room)
            for number in range(len(batch.blocks)):
                one(number, room)
            return
        rooms: SimpleQueue[FloatArray] = SimpleQueue()
        for _ in range(workers):
            rooms.put(np.empty(batch.room))

        def borrowed(number: int) -> None:
            room = rooms.get()
            try:
                one(number, room)
            finally:
                rooms.put(room)

        # a few ahead of what has been waited for: memory does not grow with the job
        waiting = [pool.submit(borrowed, n) for n in range(min(2 * workers, len(batch.blocks)))]
        for n in range(len(batch.blocks)):
            waiting.pop(0).result()
            if n + 2 * workers < len(batch.blocks):
                waiting.append(pool.submit(borrowed, n + 2 * workers))

    def metrics(self) -> dict[str, FloatArray]:
        """Name -> (G, S) of every metric that some window has measured; NaN is UNSET."""
        cycles = lanes.is_limit_cycle(self.values[_SHAKE.start])
        found = {}
        for row in sorted(self._measured):
            name, value = MEASURED[row], self.values[row]
            unset = self.lost | ~np.isfinite(value)
            if name in lanes.STEP[:4]:
                unset |= cycles
            found[name] = np.where(unset, math.nan, value).reshape(self.shape)
        return found


def _runs(block: Block, samples: int) -> list[tuple[int, Block]]:
    """The block's pairs as stretches that follow one another: gain sets that fly together need not be neighbours."""
    places = block.gain_set * samples + block.sample
    first, last = int(places[0]), int(places[-1])
    if last - first == len(places) - 1:
        return [(first, block)]
    cuts = [0, *(np.flatnonzero(np.diff(places) != 1) + 1).tolist(), len(places)]
    made = []
    for a, b in itertools.pairwise(cuts):
        phi, p, delta = (np.ascontiguousarray(one[:, a:b]) for one in (block.phi_rad, block.p_rad_s, block.delta_lat))
        made.append((int(places[a]), Block(block.gain_set[a:b], block.sample[a:b], phi, p, delta, block.lost[a:b])))
    return made


def _rows_of(kind: str) -> list[slice]:
    """Rows of what a window of a kind measures."""
    of_kind = {"step": [_STEP, _SHAKE], "track": [_TRACK], "hold": [_SHAKE]}
    return [*of_kind.get(kind, []), _EFFORT]


def _span(rows: slice) -> range:
    return range(rows.start, rows.stop)


def _rows(window: Window, dt_s: float) -> slice:
    return slice(round(window.start_s / dt_s), round(window.end_s / dt_s))


def _measure_lanes(values: FloatArray, at: int, block: Block, window: Window, signal: FloatArray, dt_s: float) -> None:
    rows = _rows(window, dt_s)
    phi = block.phi_rad[rows]
    if window.kind == "step":
        found = lanes.measure_step(phi, dt_s, window.phi_from_rad, window.phi_to_rad)
        _merge(values, at, found, _STEP.start, _SENSES)
    elif window.kind == "track":
        _merge(values, at, lanes.measure_track(phi, signal[rows], dt_s), _TRACK.start, _SENSES)
    if window.kind in ("step", "hold"):
        _merge(values, at, lanes.measure_oscillation(block.p_rad_s[rows], dt_s)[None, :], _SHAKE.start, _SENSES)
    _merge(values, at, lanes.measure_effort(block.delta_lat[rows]), _EFFORT.start, _SENSES)


def _measure_each(values: FloatArray, at: int, block: Block, window: Window, signal: FloatArray, dt_s: float) -> None:
    """The same by `scenarios.metrics`, one flight after the other: nothing to compile."""
    rows = _rows(window, dt_s)
    t = np.arange(rows.start, rows.stop) * dt_s
    start, end = window.start_s, window.end_s
    level = np.zeros(len(t))
    found: dict[str, FloatArray] = {}
    for j in range(len(block.lost)):
        phi = block.phi_rad[rows, j]
        metrics = effort_metrics(t, block.delta_lat[rows, j], start_s=start, end_s=end)
        if window.kind == "step":
            before, after = window.phi_from_rad, window.phi_to_rad
            metrics += step_metrics(t, phi, start_s=start, end_s=end, phi_from_rad=before, phi_to_rad=after)
        elif window.kind == "track":
            metrics += track_metrics(t, phi, signal[rows], start_s=start, end_s=end)
        for metric in metrics:
            row = found.setdefault(metric.name, np.full(len(block.lost), math.nan))
            row[j] = math.nan if metric.value is None else metric.value
        if window.kind in ("step", "hold"):
            shake = oscillation(t, block.p_rad_s[rows, j], level, level, start_s=start, end_s=end)
            found.setdefault("oscillation_rad_s", np.full(len(block.lost), math.nan))[j] = shake.worst_rad_s
    _merge_arrays(values, at, found)


def _merge_arrays(values: FloatArray, at: int, found: Mapping[str, FloatArray]) -> None:
    law = array_form(worse)
    for name, new in found.items():
        held = values[_ROWS[name], at : at + len(new)]
        held[:] = law(int(_SENSES[_ROWS[name]]), held, new)
