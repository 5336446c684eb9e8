"""From telemetry and segments to the flight's metrics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from scenarios.flight import Segment
from scenarios.limits import METRICS, Metric, Outcome, judge
from scenarios.score import diverged, flight_metrics, margin_metrics
from scenarios.telemetry import Telemetry

A = math.radians(10.0)
T0 = 40.0
TIMES = np.arange(T0 - 1, T0 + 13, 0.004)
STEP = Segment("step/1", "step", "step", T0, T0 + 3, A, 0.0)
BACK = Segment("step/2", "hold", "step", T0 + 3, T0 + 6, -A, A)
SECOND = Segment("again/1", "step", "again", T0 + 6, T0 + 9, -A, 0.0)
TRACK = Segment("track/1", "track", "track", T0 + 9, T0 + 13, A, 0.0)
MARGINS = {
    "closed_loop_stable": True,
    "gain_margin_low_db": None,
    "gain_margin_high_db": math.inf,
    "phase_margin_deg": 60.0,
    "delay_margin_s": 0.02,
    "modulus_margin": 0.7,
}


def flown(tau: float = 0.1, tau_second: float = 0.1, **more: Any) -> Telemetry:
    """A vehicle with first-order roll response that steps up, back, down, and then follows a sine."""
    t = TIMES - T0
    phi_sp = np.select([t < 0, t < 3, t < 6, t < 9], [0.0, A, 0.0, -A], default=A * np.sin(2 * math.pi * 0.5 * (t - 9)))
    phi = np.zeros_like(t)
    for k in range(1, len(t)):
        lag = tau_second if t[k] > 6 else tau
        phi[k] = phi[k - 1] + 0.004 / lag * (phi_sp[k] - phi[k - 1])
    p = np.gradient(phi, TIMES)
    columns: dict[str, Any] = {
        "t_s": TIMES,
        "phi_rad": phi,
        "theta_rad": 0 * t,
        "p_rad_s": p,
        "q_rad_s": 0 * t,
        "r_rad_s": 0 * t,
        "phi_sp_rad": phi_sp,
        "delta_lat": 0.1 * np.cos(t),
        "armed": np.ones(len(t), bool),
    }
    return Telemetry.from_columns(columns | more)


def whole(metrics: tuple[Metric, ...]) -> dict[str, Metric]:
    return {metric.name: metric for metric in metrics if not metric.segment}


def test_the_flight_is_its_worst_segment() -> None:
    metrics = flight_metrics(flown(0.1, 0.2), (STEP, BACK, SECOND, TRACK), MARGINS)
    flight = whole(metrics)
    rises = {m.segment: m.value for m in metrics if m.name == "rise_time_s" and m.segment}
    assert set(rises) == {"step/1", "again/1"}
    assert rises["step/1"] == pytest.approx(0.1 * math.log(9), rel=0.03)
    assert flight["rise_time_s"].value == rises["again/1"] == pytest.approx(0.2 * math.log(9), rel=0.03)
    part = flown(0.1, 0.2).between(TRACK.start_s, TRACK.end_s)
    phi, phi_sp = part["phi_rad"].astype(float), part["phi_sp_rad"].astype(float)
    assert flight["vaf_pct"].value == pytest.approx(100 * (1 - np.var(phi_sp - phi) / np.var(phi_sp)), abs=0.2)
    assert flight["peak_delta_lat"].value == pytest.approx(0.1, rel=1e-3)
    assert flight["gain_margin_high_db"].value == math.inf
    assert flight["gain_margin_low_db"].outcome is Outcome.UNSET
    assert flight["attitude_rate_hz"].value == pytest.approx(250.0)
    assert flight["oscillation_rad_s"].value == pytest.approx(0.0, abs=1e-4)
    assert list(flight) == [name for name in METRICS if name in flight]
    assert judge(metrics, ())[0] is Outcome.INFO


def test_a_limit_cycle_anywhere_unsets_the_steps() -> None:
    q = np.where(TIMES > T0 + 5, 2.0 * np.sin(2 * math.pi * 16.9 * TIMES), 0.0)
    metrics = flight_metrics(flown(q_rad_s=q), (STEP, BACK, TRACK))
    flight = whole(metrics)
    assert flight["overshoot_pct"].value is None
    assert flight["overshoot_pct"].reason == "limit cycle 16.9 Hz, 1.4 rad/s in pitch"
    assert flight["oscillation_hz"].value == pytest.approx(16.9, abs=0.1)
    assert flight["vaf_pct"].value is not None
    outcome, reason, _ = judge(metrics, ())
    assert outcome is Outcome.FAIL
    assert reason == "limit cycle 16.9 Hz, 1.4 rad/s in pitch"


def test_one_unmeasured_step_unsets_the_flight_and_is_named() -> None:
    keep = (TIMES < T0 + 6.1) | (TIMES > T0 + 6.5)
    telemetry = flown().select(keep)
    rise = whole(flight_metrics(telemetry, (STEP, BACK, SECOND)))["rise_time_s"]
    assert rise.value is None
    assert rise.reason == "a gap of 0.40 s in the telemetry (again/1)"


def test_a_step_is_scored_against_the_set_point_the_vehicle_reports() -> None:
    small = flown(phi_sp_rad=np.full(len(TIMES), math.radians(3.0)))
    metric = whole(flight_metrics(small, (STEP,)))["overshoot_pct"]
    assert metric.reason == "the vehicle's roll set-point was 3.0 deg, not the 10.0 deg asked for"
    silent = flown(phi_sp_rad=np.full(len(TIMES), np.nan))
    assert whole(flight_metrics(silent, (STEP,)))["rise_time_s"].reason == "the vehicle reported no roll set-point"


def test_a_flight_that_never_took_off() -> None:
    metrics = flight_metrics(Telemetry.empty(), (STEP, BACK, TRACK))
    assert {metric.value for metric in metrics} == {None}
    assert all(metric.reason for metric in metrics)
    assert whole(flight_metrics(Telemetry.empty(), ()))["attitude_rate_hz"].value is None


def test_unstable_margins_are_negative_and_say_so() -> None:
    unstable = MARGINS | {"closed_loop_stable": False, "delay_margin_s": -0.003, "phase_margin_deg": None}
    margins = {metric.name: metric for metric in margin_metrics(unstable)}
    assert margins["delay_margin_s"].value == -0.003
    assert margins["delay_margin_s"].reason == "the linear loop is unstable"
    assert margins["modulus_margin"].value is None
    assert margins["phase_margin_deg"].outcome is Outcome.UNSET


def test_divergence_counts_only_while_armed() -> None:
    phi = np.where(TIMES > T0 + 8, 3.0, 0.0)
    assert diverged(flown(phi_rad=phi)) == "diverged: roll beyond 80 deg at 48.00 s"
    assert diverged(flown(phi_rad=phi, armed=TIMES < T0 + 7)) == ""


def estimated(late_ticks: int, offset_deg: float, known: bool = True) -> Telemetry:
    """A roll step whose estimate is late and off, 250 rows a second."""
    t = np.arange(0.0, 4.0, 0.004)
    true = np.radians(10.0) * (1.0 - np.exp(-8.0 * t))
    phi = np.concatenate([np.full(late_ticks, true[0]), true[: len(true) - late_ticks]]) + math.radians(offset_deg)
    return Telemetry.from_columns({"t_s": t, "phi_rad": phi, **({"phi_true_rad": true} if known else {})})


@pytest.mark.parametrize("late_ticks", [0, 1, 2])
def test_an_estimate_may_be_late_but_not_wrong(late_ticks: int) -> None:
    segment = Segment("step", "hold", "step", 0.0, 3.9, math.radians(10.0), 0.0)
    for offset_deg in (0.0, 0.3, -0.7):
        metrics = flight_metrics(estimated(late_ticks, offset_deg), [segment])
        (found,) = (one for one in metrics if one.name == "roll_estimate_error_deg")
        assert found.value == pytest.approx(abs(offset_deg), abs=0.02)


def test_a_later_estimate_is_wrong() -> None:
    segment = Segment("step", "hold", "step", 0.0, 3.9, math.radians(10.0), 0.0)
    metrics = flight_metrics(estimated(12, 0.0), [segment])
    (found,) = (one for one in metrics if one.name == "roll_estimate_error_deg")
    assert found.value is not None
    # ten of the twelve ticks are left, 40 ms of 80 deg/s at first
    assert found.value > 2.0


def test_without_the_truth_nothing_is_said_of_the_estimate() -> None:
    segment = Segment("step", "hold", "step", 0.0, 3.9, math.radians(10.0), 0.0)
    metrics = flight_metrics(estimated(0, 0.0, known=False), [segment])
    (found,) = (one for one in metrics if one.name == "roll_estimate_error_deg")
    assert (found.value, found.reason) == (None, "the simulator's truth is not known")
