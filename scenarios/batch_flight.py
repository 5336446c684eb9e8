"""A batch flown and measured block by block: what is left of a flight is its metrics, one column per pair.

Each pair of a gain set and a sample flies every manoeuvre; the whole's value of a metric is that of its worst window,
as `scenarios.score` has it for flights. NaN stands for UNSET.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue

import numpy as np
import numpy.typing as npt

from scenarios import batch_metrics as lanes
from scenarios.batch_metrics import MEASURED
from scenarios.manoeuvres import EPSILON_S, Manoeuvre, Window
from scenarios.metrics import effort_metrics, oscillation, step_metrics, track_metrics
from sitl.array_form import array_form
from sitl.batch import Batch, Block, IndexArray
from sitl.profile import Profile

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_ROWS = {name: row for row, name in enumerate(MEASURED)}


def metrics_of(manoeuvres: Sequence[Manoeuvre]) -> tuple[str, ...]:
    """Names of what is measured on manoeuvres, in the order of MEASURED.

    Args:
        manoeuvres: in any order.
    """
    rows = {row for one in manoeuvres for window in one.windows for row in _rows_of(window.kind)}
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
        signal = batch.job.phi_sp_rad
        self._measured.update(MEASURED.index(name) for name in metrics_of([manoeuvre]))
        table = lanes.window_table(manoeuvre.windows, dt_s)
        tracks = [_ticks(window, dt_s) for window in manoeuvre.windows if window.kind == "track"]

        def one(number: int, room: FloatArray) -> None:
            block = batch.fly(number, room)
            if keep is not None:
                keep(block)
            places = block.gain_set * self.shape[1] + block.sample
            if not batch.compiled:
                self.lost[places] |= block.lost
                for window in manoeuvre.windows:
                    _measure_each(self.values, places, block, window, signal, dt_s)
                return
            lanes.measure_block(block.flown, table, dt_s, self.values, places, lanes.SENSES, block.lost, self.lost)
            for ticks in tracks:
                found = lanes.measure_track(block.flown[0, ticks], signal[ticks], dt_s)
                lanes.merge_rows(found, lanes.TRACK_ROWS.start, self.values, places, lanes.SENSES)

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
        cycles = lanes.is_limit_cycle(self.values[lanes.SHAKE_ROWS.start])
        found = {}
        for row in sorted(self._measured):
            name, value = MEASURED[row], self.values[row]
            unset = self.lost | ~np.isfinite(value)
            if name in lanes.STEP[:4]:
                unset |= cycles
            found[name] = np.where(unset, math.nan, value).reshape(self.shape)
        return found


def _rows_of(kind: str) -> list[int]:
    """Rows of what a window of a kind measures."""
    of_kind = {
        "step": [*lanes.STEP_ROWS, *lanes.SHAKE_ROWS],
        "track": [*lanes.TRACK_ROWS],
        "hold": [*lanes.SHAKE_ROWS],
    }
    return [*of_kind[kind], *lanes.EFFORT_ROWS]


def _ticks(window: Window, dt_s: float) -> slice:
    return slice(round(window.start_s / dt_s), round(window.end_s / dt_s))


def _measure_each(
    values: FloatArray, places: IndexArray, block: Block, window: Window, signal: FloatArray, dt_s: float
) -> None:
    """A window by `scenarios.metrics`, one flight after the other: nothing to compile."""
    rows = _ticks(window, dt_s)
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
    law = array_form(lanes.worse)
    for name, new in found.items():
        at = _ROWS[name]
        values[at, places] = law(int(lanes.SENSES[at]), values[at, places], new)
