"""How fast a flight is recorded, and what recording is of a flight over memory://.

Run: make bench. Wall-clock figures are printed for the README; asserted are ratios measured side by side, and sizes.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest

from scenarios.flight import FlightRecord, RunRecord
from scenarios.flight_job import FlightJob
from scenarios.gain_set import load_gain_sets
from scenarios.one_flight import fly
from scenarios.recorder import FlightRecorder
from scenarios.recorder.comparison import record_compare
from scenarios.recorder.flight_drawing import FlownVehicle
from scenarios.run_folder import vehicle_description
from scenarios.runner import plan
from scenarios.scenario import load_scenario
from scenarios.telemetry import COLUMNS

pytestmark = pytest.mark.bench

REPEATS = 7
RATE_HZ, DURATION_S = 250, 60
MOST_MB = 20.0
MOST_SHARE = 0.12
MOST_OVER_PARQUET = 30.0
"""Times as long as writing the same rows into Parquet, uncompressed, at most."""


def planned(gains: str = "table_2_2/ANT-X", vehicle: str = "ant-x") -> FlightJob:
    loaded = dataclasses.replace(load_scenario("demo"), vehicle=vehicle)
    (gain_set,) = load_gain_sets(gains)
    return plan(gain_set, loaded, loaded.resolve_vehicle(), loaded.resolve_profile())


def noise(rows: int) -> dict[str, np.ndarray]:
    """Telemetry that nothing can compress."""
    rng = np.random.default_rng(1)
    columns = {name: rng.normal(0.0, 0.1, rows).astype(column.dtype) for name, column in COLUMNS.items()}
    columns["t_s"] = np.arange(rows) / RATE_HZ
    columns["armed"] = np.ones(rows, dtype=bool)
    columns["nav_state"] = np.full(rows, 14, dtype=np.int16)
    return columns


def test_a_minute_of_telemetry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    job = planned(vehicle="carrier-1")
    vehicle: FlownVehicle = job.flown_vehicle()
    columns = noise(RATE_HZ * DURATION_S)
    channels = 45  # 38 lines; what is drawn in space, 31 numbers, has a quarter of the rate
    seconds, yardstick, path = [], [], tmp_path / "a.rrd"
    for number in range(REPEATS):
        start = time.perf_counter()
        recorder = FlightRecorder(
            path, name="a", recording_id=f"a{number}", vehicle=vehicle, rows_per_chunk=job.rows_per_chunk
        )
        for first in range(0, len(columns["t_s"]), 1000):
            recorder.append({name: values[first : first + 1000] for name, values in columns.items()})
        recorder.close("# a")
        seconds.append(time.perf_counter() - start)
        start = time.perf_counter()
        pq.write_table(pa.table(columns), tmp_path / "a.parquet", compression="none", use_dictionary=False)
        yardstick.append(time.perf_counter() - start)
    megabytes = path.stat().st_size / 1e6
    with capsys.disabled():
        print(f"\n{DURATION_S} s of {channels} channels at {RATE_HZ} Hz: {min(seconds):.2f} s", end="")
        print(f" (median {sorted(seconds)[REPEATS // 2]:.2f} s), {megabytes:.1f} MB")
    assert megabytes < MOST_MB
    assert min(seconds) / min(yardstick) < MOST_OVER_PARQUET


def test_share_of_a_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run of two sets with its recordings against the same run without: two flights, one comparison with spread."""
    jobs = [planned(gains) for gains in ("table_2_2/ANT-X", "table_7_2/ADAM-0")]

    def flights(folder: Path | None) -> tuple[float, list[FlightRecord]]:
        start = time.perf_counter()
        records = [fly(dataclasses.replace(job, folder=folder)) for job in jobs]
        return time.perf_counter() - start, records

    def recording(records: list[FlightRecord]) -> float:
        """What the recordings of those flights take by themselves: the same rows, in the same batches."""
        start = time.perf_counter()
        for job, record in zip(jobs, records, strict=True):
            path = tmp_path / f"{job.slug}.again.rrd"
            recorder = FlightRecorder(
                path,
                name=job.slug,
                recording_id="again",
                vehicle=job.flown_vehicle(),
                rows_per_chunk=job.rows_per_chunk,
            )
            for first in range(0, len(record.telemetry), 1000):
                recorder.append(
                    {name: values[first : first + 1000] for name, values in record.telemetry.columns.items()}
                )
            for event in record.events:
                recorder.event(event.t_s, event.severity, event.text)
            for segment in record.segments:
                recorder.segment(segment)
            recorder.close("# again")
        return time.perf_counter() - start

    def compare(records: list[FlightRecord]) -> float:
        scenario, model = jobs[0].scenario, jobs[0].model
        run = RunRecord(scenario, vehicle_description(model), tuple(jobs[0].profile.describe()), tuple(records))
        start = time.perf_counter()
        record_compare(run, tmp_path / "compare.rrd")
        return time.perf_counter() - start

    _, records = flights(tmp_path)
    compare(records), recording(records)  # loads and compiles
    alone, drawn, compared = [], [], []
    for _ in range(REPEATS):
        seconds, records = flights(None)
        alone.append(seconds)
        drawn.append(recording(records))
        compared.append(compare(records))
    share = (min(drawn) + min(compared)) / min(alone)
    with capsys.disabled():
        print(f"\ntwo flights without files {min(alone):.2f} s; their recordings {min(drawn):.3f} s, ", end="")
        print(f"the comparison with its spread {min(compared):.3f} s: {100 * share:.0f} % of the flights")
    assert share < MOST_SHARE
