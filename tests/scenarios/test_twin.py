"""Two flights of one gain set beside each other: analytic ones, our own with other filters, and those of a real PX4."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenarios import cli, hil_flights
from scenarios.flight import FlightRecord, Segment
from scenarios.flown import Flown
from scenarios.gain_set import GainSet
from scenarios.limits import LIMIT_SETS, Outcome, judge
from scenarios.one_flight import MEMORY, FlightStoppedError, fly
from scenarios.runner import RunOptions, RunResult, run_scenario
from scenarios.score import flight_metrics
from scenarios.table import run_text
from scenarios.telemetry import Telemetry
from scenarios.twin import QUANTITIES, Twin, compare
from scenarios.twin_table import complaint, headline, markdown, response, signed
from sitl.errors import LinkError
from tests.scenarios.test_px4_recordings import RECORDINGS, flown, recorded

A = math.radians(10.0)
RATE_HZ = 250


def flight(
    *,
    start_s: float = 20.0,
    damping: float = 0.5,
    omega: float = 10.0,
    cycle: tuple[float, float] = (0.0, 8.0),
    kind: str = "step",
    estimate_off_rad: float = 0.0,
    limits: str = "none",
) -> FlightRecord:
    """A second-order answer to a step of 10 degrees and back, or to a sine; with a limit cycle (rad/s, Hz) on top."""
    t = start_s + np.arange(-RATE_HZ, 6 * RATE_HZ) / RATE_HZ
    since = t - start_s
    if kind == "step":
        phi_sp = np.where((since >= 0.0) & (since < 3.0), A, 0.0)
        segments = (
            Segment("step/1", "step", "step", start_s, start_s + 3.0, A, 0.0),
            Segment("step/2", "hold", "step", start_s + 3.0, start_s + 6.0, -A, A),
        )
    else:
        phi_sp = np.where(since >= 0.0, A * np.sin(2.0 * math.pi * 0.7 * since), 0.0)
        segments = (Segment("track", "track", "track", start_s, start_s + 6.0, A, 0.0),)
    phi, p = np.zeros_like(t), np.zeros_like(t)
    for k in range(1, len(t)):
        pull = omega**2 * (phi_sp[k - 1] - phi[k - 1]) - 2.0 * damping * omega * p[k - 1]
        p[k] = p[k - 1] + pull / RATE_HZ
        phi[k] = phi[k - 1] + p[k] / RATE_HZ
    amplitude, hertz = cycle
    turn = 2.0 * math.pi * hertz
    p = p + amplitude * math.sqrt(2.0) * np.cos(turn * since)
    phi = phi + amplitude * math.sqrt(2.0) / turn * np.sin(turn * since)
    telemetry = Telemetry.from_columns(
        {
            "t_s": t,
            "phi_rad": phi + estimate_off_rad,
            "phi_true_rad": phi,
            "theta_rad": 0.0 * t,
            "p_rad_s": p,
            "q_rad_s": 0.0 * t,
            "r_rad_s": 0.0 * t,
            "phi_sp_rad": phi_sp,
            "delta_lat": 0.01 * p,
            "segment": np.where(since >= 0.0, 0, -1),
            "armed": np.ones(len(t), bool),
        }
    )
    metrics = flight_metrics(telemetry, segments)
    outcome, reason, metrics = judge(metrics, LIMIT_SETS[limits])
    return FlightRecord(
        *(GainSet("a set", {}), "ant-x", telemetry, segments, (), metrics, {}, outcome, reason, (), "", 0)
    )


# -- what is compared ------------------------------------------------------------------------------------------------


def test_the_same_flight_at_another_time_does_not_differ() -> None:
    difference = compare(flight(start_s=20.0), flight(start_s=33.336))
    assert difference.agree
    assert difference.verdicts_agree
    assert not difference.cycling
    assert difference.outside() == []
    numbers = [one.difference for one in difference.quantities if one.difference is not None]
    assert len(numbers) > 10
    assert max(map(abs, numbers)) < 1e-3


@pytest.mark.parametrize("damping", [0.5, 0.52, 0.6])
def test_overshoot_in_points_and_settling_in_seconds(damping: float) -> None:
    real, own = flight(damping=damping), flight(damping=0.5)
    difference = compare(real, own)
    for name in ("overshoot_pct", "settling_time_5pct_s", "settling_time_2pct_s"):
        quantity = difference.quantity(name, "step/1")
        assert quantity is not None
        assert quantity.tolerance == (1.5 if name == "overshoot_pct" else 0.05)
        values = [one.metric(name).value for one in (real, own)]  # type: ignore[union-attr]
        assert (quantity.real, quantity.own) == tuple(values)
        assert quantity.difference == pytest.approx(values[0] - values[1])
        assert quantity.within is (abs(values[0] - values[1]) <= quantity.tolerance)
    exact = 100.0 * (math.exp(-math.pi * damping / math.sqrt(1 - damping**2)) - math.exp(-math.pi / math.sqrt(3.0)))
    overshoot = difference.quantity("overshoot_pct")
    assert overshoot is not None
    assert overshoot.difference == pytest.approx(exact, abs=0.3)
    assert difference.agree is (damping == 0.5)


def test_one_that_settles_and_one_that_does_not_differ() -> None:
    real = flight(damping=0.5)
    drooping = dataclasses.replace(
        real,
        metrics=tuple(
            dataclasses.replace(m, value=None, reason="leaves the 5 % band") if m.name == "settling_time_5pct_s" else m
            for m in real.metrics
        ),
    )
    for a, b, who in ((drooping, real, "real"), (real, drooping, "own")):
        quantity = compare(a, b).quantity("settling_time_5pct_s", "step/1")
        assert quantity is not None
        assert (quantity.within, quantity.difference) == (False, None)
        assert quantity.reason == f"{who}: leaves the 5 % band; roll at most 0.00 deg apart there"
    both = compare(drooping, drooping)
    assert both.agree
    assert both.quantity("settling_time_5pct_s").reason == "leaves the 5 % band"  # type: ignore[union-attr]


def test_roll_difference_is_that_of_the_true_angles() -> None:
    difference = compare(flight(estimate_off_rad=math.radians(0.3)), flight())
    rms = difference.quantity("roll_difference_deg")
    assert rms is not None
    assert rms.difference == pytest.approx(0.0, abs=1e-3)
    off = difference.quantity("estimate_error_rms_deg")
    assert off is not None
    assert off.difference == pytest.approx(0.3, abs=0.01)
    largest = difference.quantity("roll_estimate_error_deg")
    assert largest is not None
    assert largest.within is True
    worse = compare(flight(estimate_off_rad=math.radians(0.6)), flight())
    assert "roll_estimate_error_deg" in [one.name for one in worse.outside()]


def test_a_response_that_comes_later_is_timed() -> None:
    real = flight(kind="track")
    late = real.segments[0]
    late = dataclasses.replace(late, start_s=late.start_s - 0.012, end_s=late.end_s - 0.012)
    difference = compare(dataclasses.replace(real, segments=(late,)), flight(kind="track"))
    quantity = difference.quantity("response_late_s", "track")
    assert quantity is not None
    assert quantity.difference == pytest.approx(0.012, abs=5e-4)
    assert difference.quantity("vaf_pct", "track") is not None


CYCLE = (2.0, 8.0)


@pytest.mark.parametrize(
    ("cycle", "outside"),
    [
        ((2.08, 8.1), []),
        ((2.0, 8.3), ["oscillation_hz"]),
        ((2.2, 8.0), ["oscillation_rad_s"]),
        ((0.0, 8.0), ["oscillation_hz", "oscillation_rad_s"]),
    ],
)
def test_limit_cycles_by_frequency_and_amplitude_alone(cycle: tuple[float, float], outside: list[str]) -> None:
    difference = compare(flight(cycle=cycle), flight(cycle=CYCLE))
    assert difference.cycling
    assert [one.name for one in difference.outside()] == outside
    assert difference.quantity("overshoot_pct") is None
    assert difference.quantity("roll_difference_deg") is None
    if cycle[0]:
        amplitude = difference.quantity("oscillation_rad_s")
        assert amplitude is not None
        assert amplitude.difference == pytest.approx(100.0 * (cycle[0] - CYCLE[0]) / cycle[0], abs=1.0)


def test_only_one_in_a_limit_cycle_is_said_once() -> None:
    twin = Twin.of(flight(), flight(cycle=CYCLE))
    assert twin.warning == (
        f"a set: verdicts differ: INFO with the real autopilot (no limits set), FAIL with our own ({twin.own.reason})"
    )
    assert complaint(twin) == "a set differs: verdict INFO instead of FAIL; only our own is in a limit cycle"


def test_what_only_one_flew_is_a_difference() -> None:
    real = flight()
    broken = dataclasses.replace(real, segments=real.segments[:0], metrics=(), telemetry=Telemetry.empty())
    difference = compare(broken, real)
    assert difference.alone == ("step/1", "step/2")
    assert not difference.agree
    assert complaint(Twin.of(broken, real)) == "a set differs: only our own came to step/1, step/2"
    assert "only the real one came to" in complaint(Twin.of(real, broken))


def test_every_quantity_has_its_unit_and_its_meaning() -> None:
    for kinds in ({"kind": "step"}, {"kind": "track"}, {"cycle": CYCLE}):
        for one in compare(flight(**kinds), flight(**kinds)).quantities:  # type: ignore[arg-type]
            assert one.unit == QUANTITIES[one.name][0]
            assert one.difference is not None or one.reason or one.real is not None, one


# -- as text ---------------------------------------------------------------------------------------------------------


def test_the_table_has_three_rows_per_gain_set() -> None:
    twins = [Twin.of(flight(damping=0.6), flight()), Twin.of(flight(cycle=(2.2, 8.0)), flight(cycle=CYCLE))]
    head, rows = response(twins)
    assert [row[0] for row in rows] == ["a set", "  own autopilot", "  difference"] * 2
    assert {len(row) for row in rows} == {len(head)}
    assert not any("VAF" in title for title in head)  # nothing was tracked
    overshoot = next(k for k, title in enumerate(head) if title.startswith("over-"))
    assert float(rows[2][overshoot]) == pytest.approx(float(rows[0][overshoot]) - float(rows[1][overshoot]), abs=0.11)
    assert [row[-1] for row in rows] == ["INFO", "INFO", "differs", "FAIL", "FAIL", "differs"]
    assert any("+9.1% 0.00" in cell for cell in rows[5])
    assert headline(twins).endswith("0 of 2 gain sets agree within the tolerances.")
    assert "amplitude (step/1) +9.1 % (5 allowed)" in markdown(twins)


@pytest.mark.parametrize(
    ("value", "text"), [(0.04, "0.0"), (-0.04, "0.0"), (0.06, "+0.1"), (-2.0, "-2.0"), (None, "–")]
)
def test_differences_have_a_sign_unless_they_are_none(value: float | None, text: str) -> None:
    assert signed(value, 1) == text


# -- whole runs ------------------------------------------------------------------------------------------------------


@pytest.fixture
def another_autopilot(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """In place of a PX4 our own one flies, with a filter of its own; `stop` ends the run at the second set."""
    how: dict[str, Any] = {"gyro_cutoff_hz": 30.0, "stop": None}

    def fly_with_another(jobs: Any, *, hil: str, px4: Path | None, say: Any, progress: Any) -> Flown:
        flown_ = Flown()
        for index, job in enumerate(jobs):
            if index and how["stop"] is not None:
                flown_.stopped = how["stop"]
                break
            profile = dataclasses.replace(job.profile, gyro_cutoff_hz=how["gyro_cutoff_hz"])
            flown_.records[index] = fly(dataclasses.replace(job, connect=MEMORY, profile=profile))
        return flown_

    monkeypatch.setattr(hil_flights, "fly_with_autopilot", fly_with_another)
    return how


def run_twice(quick_scenario: Any, tmp_path: Path, **options: Any) -> RunResult:
    scenario = quick_scenario(gain_sets=("table_2_2/ANT-X", "table_7_2/ADAM-0"))
    return run_scenario(scenario, RunOptions(out=tmp_path, px4=Path("nowhere"), report=False, **options))


def test_a_run_with_a_real_autopilot_flies_everything_twice(
    another_autopilot: dict[str, Any], quick_scenario: Any, tmp_path: Path
) -> None:
    result = run_twice(quick_scenario, tmp_path)
    own, cycling = result.run.twins
    assert own.difference.agree
    assert cycling.difference.cycling  # a filter at 30 Hz is what takes this set over the edge
    assert cycling.flight is result.run.flights[1]
    assert not cycling.difference.agree
    assert result.folder is not None
    run = json.loads((result.folder / "run.json").read_text())
    twin = run["twins"][1]
    assert (twin["gain_set"], twin["cycling"], twin["agree"]) == (cycling.name, True, False)
    assert twin["outside"] == ["oscillation_hz", "oscillation_rad_s"]
    assert twin["own"]["files"]["parquet"] == "flights/7_2_adam-0.own.parquet"
    for kind in ("rrd", "tlog", "params", "backup.params"):
        assert (result.folder / twin["own"]["files"][kind]).is_file()
    assert run["flights"][1]["files"]["parquet"] == "flights/7_2_adam-0.parquet"
    names = {one["name"] for one in twin["quantities"]}
    assert {"hold_p_std_rad_s", "takeoff_time_s", "touchdown_m_s", "estimate_late_s", "saturated_high_pct"} <= names
    telemetry, _ = Telemetry.from_parquet(result.folder / twin["own"]["files"]["parquet"])
    assert telemetry.sha256() == cycling.own.telemetry_sha256 == twin["own"]["telemetry_sha256"]
    for width in (80, 100, 120):
        text = run_text(result.run, width=width)
        assert max(len(line) for line in text.splitlines() if not line.startswith("Run folder")) <= width
        assert "1 of 2 gain sets" in text
        assert f"{cycling.name} differs: only the real one is in a limit cycle" in " ".join(text.split())


def test_the_comparison_shows_both(another_autopilot: dict[str, Any], quick_scenario: Any, tmp_path: Path) -> None:
    from tests.scenarios.test_recorder import Read

    folder = run_twice(quick_scenario, tmp_path).folder
    assert folder is not None
    recording = Read(folder / "compare.rrd")
    (real,) = (entity for entity in recording.chunks if entity.endswith("_2_2_ant-x") and "/roll/" in entity)
    (own,) = (entity for entity in recording.chunks if entity.endswith("_2_2_ant-x_own") and "/roll/" in entity)
    assert real < own  # drawn on top
    (name,) = recording.column(own, "SeriesLines:names")[1][0]
    assert name == "2.2 ANT-X, own autopilot: PASS [deg]"
    _, dashed = recording.lines(own)
    _, solid = recording.lines(real)
    assert np.isnan(dashed).any()
    assert not np.isnan(solid).any()
    assert "beside our own" in recording.text("/twins")


def test_verdicts_and_gate_are_those_of_the_real_one(
    another_autopilot: dict[str, Any], quick_scenario: Any, tmp_path: Path
) -> None:
    another_autopilot["gyro_cutoff_hz"] = 3.0  # nothing flies with that
    scenario = quick_scenario()
    result = run_scenario(scenario, RunOptions(out=tmp_path, px4=Path("nowhere"), report=False))
    (twin,) = result.run.twins
    assert (twin.flight.outcome, twin.own.outcome) == (Outcome.FAIL, Outcome.PASS)
    assert result.folder is not None
    assert 'failures="0"' not in (result.folder / "junit.xml").read_text().split("<testcase")[0]
    text = " ".join(run_text(result.run).split())
    assert "warning: 2.2 ANT-X: verdicts differ: FAIL with the real autopilot" in text
    assert "PASS with our own" in text


def test_no_twin(another_autopilot: dict[str, Any], quick_scenario: Any, tmp_path: Path) -> None:
    result = run_twice(quick_scenario, tmp_path, twin=False)
    assert result.run.twins == ()
    assert result.folder is not None
    assert not list(result.folder.glob("flights/*.own.*"))
    assert "beside our own" not in run_text(result.run)
    args = cli._parser().parse_args(["fly", "--no-twin"])
    assert args.no_twin


def test_what_was_flown_before_a_stop_is_compared(
    another_autopilot: dict[str, Any], quick_scenario: Any, tmp_path: Path
) -> None:
    another_autopilot["stop"] = LinkError("the PX4 died")
    result = run_twice(quick_scenario, tmp_path)
    assert result.stopped is another_autopilot["stop"]
    assert [twin.name for twin in result.run.twins] == ["2.2 ANT-X"]
    another_autopilot["stop"] = KeyboardInterrupt()
    assert run_twice(quick_scenario, tmp_path).run.twins == ()


def test_a_twin_that_cannot_be_kept_stops_the_run_and_loses_nothing(
    another_autopilot: dict[str, Any], quick_scenario: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(job: Any, progress: Any) -> FlightRecord:
        record = flight()
        raise FlightStoppedError(record, LinkError("the disk is full"))

    monkeypatch.setattr("scenarios.runner.fly", full)
    result = run_twice(quick_scenario, tmp_path)
    assert str(result.stopped) == "the disk is full"
    assert len(result.run.flights) == 2
    assert result.run.twins == ()


# -- a real PX4 ------------------------------------------------------------------------------------------------------


def as_flight(about: dict[str, Any], columns: dict[str, np.ndarray], own: FlightRecord) -> FlightRecord:
    """A recorded flight of a real PX4 with the segments of ours; its set-point is the one that was sent at t = 0."""
    shift = 10.0
    start = own.segments[0].start_s
    segments = tuple(
        dataclasses.replace(one, start_s=one.start_s - start + shift, end_s=one.end_s - start + shift)
        for one in own.segments
    )
    t = columns["t_s"] + shift
    phi_sp = np.interp(t - shift + start, own.telemetry["t_s"], own.telemetry["phi_sp_rad"])
    names = ("phi_rad", "theta_rad", "p_rad_s", "q_rad_s", "delta_lat", "delta_lon")
    telemetry = Telemetry.from_columns(
        {
            "t_s": t,
            **{name: columns[name] for name in names},
            "r_rad_s": 0.0 * t,
            "phi_sp_rad": phi_sp,
            "segment": np.where(t >= shift, 0, -1),
            "armed": np.ones(len(t), bool),
        }
    )
    metrics = flight_metrics(telemetry, segments, own.margins)
    outcome, reason, metrics = judge(metrics, LIMIT_SETS["practical"])
    return dataclasses.replace(
        own, telemetry=telemetry, segments=segments, metrics=metrics, outcome=outcome, reason=reason, events=()
    )


@pytest.mark.parametrize("path", RECORDINGS, ids=[path.stem for path in RECORDINGS])
def test_recorded_flights_of_a_real_px4_agree_with_ours(path: Path) -> None:
    about, columns = recorded(path)
    own, _, _ = flown(about)
    outcome, reason, metrics = judge(flight_metrics(own.telemetry, own.segments, own.margins), LIMIT_SETS["practical"])
    own = dataclasses.replace(own, outcome=outcome, reason=reason, metrics=metrics)
    twin = Twin.of(as_flight(about, columns, own), own)
    assert twin.difference.verdicts_agree
    # two of them creep into the 2 % band, which is 0.2 deg: a tenth decides when, and the complaint says so
    outside = twin.difference.outside()
    assert {one.name for one in outside} <= {"settling_time_2pct_s"}, complaint(twin)
    for one in outside:
        assert float(one.reason.split("at most ")[1].split()[0]) < 0.2
    if not twin.difference.cycling:
        rms = twin.difference.quantity("roll_difference_deg")
        assert rms is not None
        assert rms.difference is not None
        assert rms.difference < 0.2


# -- what the README promises ----------------------------------------------------------------------------------------


def test_the_readme_lists_every_quantity_and_key() -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text()
    for name, (unit, tolerance, meaning) in QUANTITIES.items():
        shown = "–" if tolerance is None else f"{tolerance:g}"
        assert f"| `{name}` | {unit} | {shown} | {meaning} |" in text, name
