"""Faults in the air: they come when planned, do what the model says, and are told."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenarios import one_flight
from scenarios.fault_metrics import NAMES, fault_metrics
from scenarios.faults import parse_faults
from scenarios.flight import FlightRecord, Segment
from scenarios.injected_fault import InjectedFault
from scenarios.limits import Outcome
from scenarios.manoeuvres import make_manoeuvre
from scenarios.one_flight import fly
from scenarios.recorder.recorded_facts import recorded_facts
from scenarios.report import write_report
from scenarios.run_reader import read_run
from scenarios.runner import RunOptions, run_scenario
from scenarios.score import flight_metrics
from scenarios.telemetry import Telemetry
from sitl.errors import UsageError
from sitl.vehicle import Vehicle

STEP = make_manoeuvre("step", amplitude_deg=10.0, hold_s=2.0, return_s=4.0)
"""The second hold is level: the vehicle is not carried away by what it flies."""

Faulty = Callable[..., FlightRecord]


@pytest.fixture(scope="module")
def faulty(quick_job: Any) -> Faulty:
    """Flies the quick scenario with faults; each by default at the second second of the level hold."""

    def make(*tables: dict[str, Any], **changes: Any) -> FlightRecord:
        raw = [{"manoeuvre": "step", "at_s": 4.0, **table} for table in tables]
        faults = parse_faults(raw, Path("test.toml"), (STEP,))
        return fly(quick_job(manoeuvres=(STEP,), takeoff_altitude_m=6.0, faults=faults, **changes))

    return make


@pytest.fixture(scope="module")
def plain(faulty: Faulty) -> FlightRecord:
    return faulty()


def since(record: FlightRecord, plain: FlightRecord, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Time since the fault began, and what it has changed of a column."""
    start_s = record.faults[0].start_s
    assert start_s is not None
    rows = min(len(record.telemetry), len(plain.telemetry))
    t = record.telemetry["t_s"][:rows] - start_s
    return t, (record.telemetry[column][:rows].astype(float) - plain.telemetry[column][:rows])


def value(record: FlightRecord, name: str) -> float:
    metric = record.metric(name)
    assert metric is not None
    assert metric.value is not None, metric.reason
    return metric.value


GUST = {"kind": "gust", "side_force_n": 0.5, "duration_s": 0.5}


class TestWhen:
    def test_to_the_tick_from_the_first_set_point(self, faulty: Faulty) -> None:
        record = faulty(GUST | {"at_s": 0.0}, GUST | {"at_s": 0.1004}, GUST | {"at_s": 1.0, "duration_s": 1.0})
        begin_s = record.segments[0].start_s
        times = [(fault.start_s - begin_s, fault.end_s - begin_s) for fault in record.faults]  # type: ignore[operator]
        # a time between two ticks waits for the next
        assert times == [pytest.approx(pair, abs=1e-9) for pair in ((0.0, 0.5), (0.104, 0.604), (1.0, 2.0))]

    def test_nothing_differs_before_and_everything_after(self, faulty: Faulty, plain: FlightRecord) -> None:
        record = faulty(GUST)
        for column in ("phi_rad", "p_rad_s", "motor1", "v_east_m_s"):
            t, changed = since(record, plain, column)
            assert not changed[t <= 0.0].any(), column
            assert changed[t > 0.1].any(), column

    def test_from_the_take_off_until_the_last_manoeuvre_is_over(self, faulty: Faulty) -> None:
        record = faulty({"kind": "link_duplication", "share_pct": 10.0, "at_s": 0.5, "manoeuvre": "step"}, GUST)
        assert record.faults[0].end_s == pytest.approx(record.segments[-1].end_s, abs=0.021)
        raw = [{"kind": "gyro_noise", "noise_deg_s": 1.0, "at_s": 1.0}]
        (fault,) = parse_faults(raw, Path("test.toml"), (STEP,))
        assert fault.manoeuvre == ""

    def test_the_same_seed_the_same_bytes_and_another_others(self, faulty: Faulty) -> None:
        tables = (
            {"kind": "gyro_noise", "noise_deg_s": 5.0, "at_s": 0.5},
            {"kind": "link_loss", "loss_pct": 30.0, "at_s": 0.5},
            {"kind": "link_jitter", "jitter_s": 0.05, "at_s": 0.5},
        )
        hashes = [faulty(*tables, seed=seed).telemetry_sha256 for seed in (1, 1, 2)]
        assert hashes[0] == hashes[1] != hashes[2]

    def test_one_that_is_never_met_leaves_the_flight_undecided(self, quick_job: Any) -> None:
        faults = parse_faults([{"kind": "motor_out", "motor": 1, "at_s": 500.0}], Path("t.toml"), (STEP,))
        record = fly(quick_job(faults=faults))
        assert record.outcome is Outcome.UNSET
        assert record.reason == "motor 1 out was never injected (500 s after the take-off, to the end)"
        assert record.metric(NAMES[0]).reason == "no fault was injected"  # type: ignore[union-attr]


class TestWhatItDoes:
    def test_a_side_force_pushes_at_force_per_mass(self, faulty: Faulty, plain: FlightRecord) -> None:
        record = faulty(GUST)
        t, east = since(record, plain, "v_east_m_s")
        early = (t > 0.0) & (t <= 0.2)
        pushed = np.polyfit(t[early], east[early], 1)[0]
        # the velocity is reported 50 times a second, up to 20 ms late, and Lv v has begun to roll it back
        assert pushed == pytest.approx(0.5 / 0.307, rel=0.15)

    def test_a_gyro_bias_is_held_off_by_a_roll_angle(self, faulty: Faulty, plain: FlightRecord) -> None:
        """Rates are zero where the gyro reads b, so K_phi (phi_sp - phi) = b in the end."""
        record = faulty({"kind": "gyro_bias", "bias_deg_s": 5.0, "axis": "roll", "at_s": 2.5})
        t, phi = since(record, plain, "phi_rad")
        settled = (t > 2.5) & (t < 3.4)
        assert np.degrees(phi[settled]).mean() == pytest.approx(-5.0 / 6.5, rel=0.25)

    def test_delay_in_the_loop_beyond_its_margin_makes_it_cycle(self, faulty: Faulty, plain: FlightRecord) -> None:
        margin_ticks = value(plain, "delay_margin_s") / 0.004
        for ticks, cycles in ((math.floor(margin_ticks) - 2, False), (math.ceil(margin_ticks) + 2, True)):
            record = faulty({"kind": "loop_delay", "delay_ticks": ticks, "at_s": 0.1})
            assert (value(record, "oscillation_rad_s") > 0.3) is cycles, ticks

    def test_link_loss_of_the_share_asked_for_and_survived(self, faulty: Faulty) -> None:
        record = faulty({"kind": "link_loss", "loss_pct": 30.0, "at_s": 0.0})
        seen, hit = record.faults[0].datagrams or (0, 0)
        assert seen > 1000
        assert abs(hit - 0.3 * seen) < 5.0 * math.sqrt(seen * 0.21)
        assert record.outcome is Outcome.PASS
        assert value(record, "attitude_rate_hz") == pytest.approx(0.7 * 250.0, rel=0.1)

    def test_a_motor_that_is_out_is_the_reason(self, faulty: Faulty) -> None:
        record = faulty({"kind": "motor_out", "motor": 2})
        start_s = record.faults[0].start_s
        assert record.outcome is Outcome.FAIL
        assert record.reason.startswith(f"motor 2 out at {start_s:.1f} s: diverged: tilt beyond 80 deg in step")

    def test_a_sagging_battery_costs_the_height_that_its_thrust_is_worth(self, faulty: Faulty) -> None:
        """The pilot's height loop settles where 0.81 (1 + 0.1/m h) = 1."""
        record = faulty({"kind": "battery_sag", "sag_pct": 10.0, "at_s": 2.0})
        assert value(record, "fault_height_loss_m") == pytest.approx((1.0 / 0.81 - 1.0) / 0.10, rel=0.4)

    def test_a_lost_uplink_is_a_lost_offboard_signal(self, faulty: Faulty) -> None:
        record = faulty({"kind": "link_loss", "loss_pct": 100.0, "direction": "to_vehicle"})
        assert record.outcome is Outcome.FAIL
        assert "link loses 100 % to the vehicle" in record.reason
        assert "the vehicle left Offboard: " in record.reason
        start_s, end_s = record.faults[0].start_s, record.faults[0].end_s
        assert start_s is not None
        assert end_s is not None
        assert end_s - start_s == pytest.approx(1.0, abs=0.3)  # COM_OF_LOSS_T

    def test_a_link_that_is_gone_for_good_fails_the_flight_and_not_the_run(self, faulty: Faulty) -> None:
        record = faulty({"kind": "link_loss", "loss_pct": 100.0})
        assert record.outcome is Outcome.FAIL
        assert "link loses 100 % both ways" in record.reason

    def test_an_autopilot_that_starts_anew_falls(self, faulty: Faulty) -> None:
        record = faulty({"kind": "autopilot_restart", "boot_s": 2.0})
        assert record.outcome is Outcome.FAIL
        assert record.reason.startswith("autopilot restart of 2 s at")
        gap = np.diff(record.telemetry["t_s"]).max()
        assert gap == pytest.approx(2.0, abs=0.05)

    def test_a_parameter_is_another_meanwhile_and_given_back(
        self, faulty: Faulty, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made: list[Vehicle] = []
        seen: set[float] = set()

        class Watched(Vehicle):
            def __init__(self, *args: Any, **keys: Any) -> None:
                super().__init__(*args, **keys)
                made.append(self)

            def step(self) -> None:
                super().step()
                if self.autopilot.armed:
                    seen.add(float(self.parameters.get("IMU_GYRO_CUTOFF")))

        monkeypatch.setattr(one_flight, "Vehicle", Watched)
        table = {"kind": "parameter", "parameter": "IMU_GYRO_CUTOFF", "value": 17.0, "duration_s": 0.5}
        record = faulty(table, {"kind": "parameter", "parameter": "MC_ROLLRATE_P", "value": 0.06})
        assert seen == {40.0, 17.0}
        assert made[0].parameters.get("IMU_GYRO_CUTOFF") == 40.0
        assert made[0].parameters.get("MC_ROLLRATE_P") == pytest.approx(0.15)  # PX4's own, as before the gains
        assert all(fault.start_s is not None for fault in record.faults)


class TestMeasured:
    def rows(self, moved_deg: np.ndarray, down_m: np.ndarray | None = None) -> Telemetry:
        t = 10.0 + 0.004 * np.arange(len(moved_deg))
        down = np.zeros(len(t)) if down_m is None else down_m
        return Telemetry.from_columns({"t_s": t, "phi_rad": np.radians(moved_deg), "down_m": down})

    def measure(self, rows: Telemetry, at_s: float = 12.0, kind: str = "step") -> dict[str, Any]:
        segment = Segment("one", kind, "one", 10.0, 16.0, 0.1, 0.0)
        fault = InjectedFault("gust", "gust", "", start_s=at_s, end_s=at_s + 0.5)
        return {metric.name: metric for metric in fault_metrics(rows, [segment], [fault])}

    def test_an_exponential_recovery(self) -> None:
        """8 degrees that die with a time constant of 0.5 s, on top of a droop that was there before."""
        t = 0.004 * np.arange(1500)
        moved = np.where(t >= 2.0, 8.0 * np.exp(-(t - 2.0) / 0.5), 0.0)
        found = self.measure(self.rows(moved - 1.5, np.where(t >= 2.0, 0.25 * (t - 2.0), 0.0)))
        assert found["fault_roll_deviation_deg"].value == pytest.approx(8.0, abs=1e-3)
        assert found["fault_recovery_s"].value == pytest.approx(0.5 * math.log(5.0), abs=0.004)
        assert found["fault_height_loss_m"].value == pytest.approx(1.0, abs=0.002)

    def test_within_a_degree_nothing_has_to_recover(self) -> None:
        found = self.measure(self.rows(np.where(np.arange(1500) > 500, 0.9, 0.0)))
        assert found["fault_recovery_s"].value == 0.0

    def test_what_stays_away_is_not_back(self) -> None:
        found = self.measure(self.rows(np.where(np.arange(1500) > 500, 3.0, 0.0)))
        assert found["fault_recovery_s"].reason == "still 3.0 deg away at the end of the hold"

    @pytest.mark.parametrize(("at_s", "kind"), [(10.5, "step"), (12.0, "track")])
    def test_where_the_set_point_moves_roll_says_nothing(self, at_s: float, kind: str) -> None:
        found = self.measure(self.rows(np.zeros(1500)), at_s, kind)
        assert list(found) == ["fault_height_loss_m"]
        assert found["fault_height_loss_m"].value == 0.0

    def test_of_several_faults_the_worst_and_what_was_not_measured_says_why(self) -> None:
        step = Segment("one", "step", "one", 10.0, 16.0, 0.1, 0.0)
        faults = [InjectedFault("gust", "gust", "", start_s=at_s, end_s=at_s + 0.5) for at_s in (10.2, 12.0, 14.0)]
        rows = self.rows(np.where(np.arange(1500) > 900, 3.0, 0.0))
        metrics = {
            metric.name: metric.value for metric in flight_metrics(rows, [step], None, faults) if not metric.segment
        }
        assert metrics["fault_roll_deviation_deg"] == pytest.approx(3.0)
        early = {metric.name: metric for metric in flight_metrics(rows, [step], None, faults[:1]) if not metric.segment}
        assert early["fault_recovery_s"].reason.startswith("no fault began where the roll set-point had stood")
        assert early["fault_height_loss_m"].value == 0.0

    def test_holes_and_ends(self) -> None:
        rows = self.rows(np.zeros(1500))
        cut = rows.select((rows["t_s"] < 12.5) | (rows["t_s"] > 12.9))
        assert "a gap of 0.4" in self.measure(cut)["fault_recovery_s"].reason
        assert "no telemetry" in self.measure(rows.select(rows["t_s"] < 11.0))["fault_recovery_s"].reason


def test_everything_that_keeps_a_run_keeps_its_faults(
    quick_scenario: Any, tmp_path: Path, without_report: None
) -> None:
    raw = [{"manoeuvre": "step", "at_s": 1.0, **GUST}]
    faults = parse_faults(raw, Path("test.toml"), (STEP,))
    scenario = quick_scenario(manoeuvres=(STEP,), faults=faults)
    folder = run_scenario(scenario, RunOptions(out=tmp_path)).folder
    assert folder is not None
    run = json.loads((folder / "run.json").read_text())
    (told,) = run["flights"][0]["faults"]
    (segment, _) = run["flights"][0]["segments"]
    assert told["start_s"] == pytest.approx(segment["start_s"] + 1.0)
    assert told["end_s"] == pytest.approx(segment["start_s"] + 1.5)
    assert run["scenario"]["faults"][0]["settings"]["side_force_n"] == 0.5
    stored = read_run(folder)
    assert stored.problems == ()
    texts = [text for _, _, text in recorded_facts(folder / "flights" / "2_2_ant-x.rrd").events]
    assert [text for text in texts if "fault" in text] == [
        "fault begins: gust of +0.5 N sideways",
        "fault ends: gust of +0.5 N sideways",
    ]
    page = write_report(folder, threads=1).read_text()
    assert 'id="faults"' in page
    assert "Faults in force, shaded: 1.0 to 1.5 s." in page


def test_what_cannot_be_done_is_refused_before_anything_is_flown(quick_scenario: Any, tmp_path: Path) -> None:
    faults = parse_faults([{"at_s": 1.0, **GUST}], Path("test.toml"), (STEP,))
    scenario = dataclasses.replace(quick_scenario(), faults=faults)
    with pytest.raises(UsageError, match=r"fault\[0\] \(gust of"):
        run_scenario(scenario, RunOptions(out=tmp_path, connect="udpin://127.0.0.1:0"))
    assert not list(tmp_path.iterdir())
