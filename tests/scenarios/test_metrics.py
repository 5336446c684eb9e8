"""Metrics against closed forms, against a real PX4's recorded flights, and under what must not matter."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.limits import LIMIT_CYCLE_RAD_S, Metric, Outcome
from scenarios.metrics import (
    Oscillation,
    divergence,
    dominant_frequency,
    effort_metrics,
    oscillation,
    step_metrics,
    track_metrics,
)

STEPS = Path(__file__).parents[1] / "data" / "px4-steps"
A = math.radians(10.0)


def values(metrics: tuple[Metric, ...]) -> dict[str, float | None]:
    return {metric.name: metric.value for metric in metrics}


def recorded(case: str) -> tuple[dict[str, Any], dict[str, Any]]:
    import pyarrow.parquet as pq

    table = pq.read_table(STEPS / f"{case}.parquet")
    columns = {name: table[name].to_numpy().astype(float) for name in table.column_names}
    return columns, json.loads(table.schema.metadata[b"froude"])


def second_order(t: np.ndarray, zeta: float, wn: float) -> np.ndarray:
    """Unit step response of wn^2 / (s^2 + 2 zeta wn s + wn^2), closed form, zeta < 1; 0 before t = 0."""
    wd = wn * math.sqrt(1 - zeta**2)
    decay = np.exp(-zeta * wn * np.clip(t, 0, None))
    y = 1 - decay * (np.cos(wd * t) + zeta / math.sqrt(1 - zeta**2) * np.sin(wd * t))
    return np.where(t > 0, y, 0.0)


def step(t: np.ndarray, phi: np.ndarray, phi0: float = 0.0, amplitude: float = A, hold: float = 3.0) -> Any:
    return step_metrics(t, phi, start_s=0.0, end_s=hold, phi_from_rad=phi0, phi_to_rad=phi0 + amplitude)


T = np.arange(-0.5, 3.2, 0.004)


@pytest.mark.parametrize("zeta", [0.3, 0.5, 0.7, 0.9])
def test_second_order_step(zeta: float) -> None:
    wn = 10.0
    got = values(step(T, A * second_order(T, zeta, wn)))
    assert got["overshoot_pct"] == pytest.approx(100 * math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2)), abs=0.1)
    fine = np.arange(0, 3, 1e-5)
    y = second_order(fine, zeta, wn)
    assert got["rise_time_s"] == pytest.approx(fine[np.argmax(y >= 0.9)] - fine[np.argmax(y >= 0.1)], abs=2e-4)
    for name, band in (("settling_time_5pct_s", 0.05), ("settling_time_2pct_s", 0.02)):
        assert got[name] == pytest.approx(fine[np.abs(y - 1) > band][-1], abs=2e-4)
    assert got["droop_deg"] == pytest.approx(0.0, abs=2e-3)


def test_first_order_step_has_textbook_times() -> None:
    tau = 0.2
    got = values(step(T, A * (1 - np.exp(-np.clip(T, 0, None) / tau))))
    assert got["overshoot_pct"] == 0.0
    assert got["rise_time_s"] == pytest.approx(tau * math.log(9), abs=2e-4)
    assert got["settling_time_5pct_s"] == pytest.approx(tau * math.log(20), abs=2e-4)
    assert got["settling_time_2pct_s"] == pytest.approx(tau * math.log(50), abs=2e-4)


@given(
    amplitude=st.floats(0.01, 0.7),
    negative=st.booleans(),
    phi0=st.floats(-0.5, 0.5),
    shift=st.floats(-100, 100),
)
def test_step_does_not_depend_on_sign_size_start_angle_or_epoch(
    amplitude: float, negative: bool, phi0: float, shift: float
) -> None:
    unit = second_order(T, 0.5, 10.0) * (1 - 0.03 * np.clip(T, 0, None))
    plain = values(step(T, A * unit))
    signed = -amplitude if negative else amplitude
    moved = values(
        step_metrics(
            T + shift,
            phi0 + signed * unit,
            start_s=shift,
            end_s=shift + 3.0,
            phi_from_rad=phi0,
            phi_to_rad=phi0 + signed,
        )
    )
    droop, plain_droop = moved.pop("droop_deg"), plain.pop("droop_deg")
    assert droop is not None
    assert plain_droop is not None
    assert droop / math.degrees(amplitude) == pytest.approx(plain_droop / 10.0, abs=1e-6)
    for name, value in plain.items():
        assert moved[name] == (None if value is None else pytest.approx(value, abs=1e-5))


def test_step_on_dropped_messages_agrees_with_all_of_them() -> None:
    phi = A * second_order(T, 0.5, 10.0)
    keep = np.random.default_rng(1).random(len(T)) > 0.5
    whole, thin = values(step(T, phi)), values(step(T[keep], phi[keep]))
    for name in whole:
        assert thin[name] == pytest.approx(whole[name], abs=0.2 if name == "overshoot_pct" else 0.01)


def test_droop_out_of_the_band_leaves_settling_unset_and_says_why() -> None:
    phi = A * (1 - np.exp(-np.clip(T, 0, None) / 0.05)) - math.radians(1.0) * np.clip(T, 0, 2)
    metrics = {metric.name: metric for metric in step(T, phi)}
    settling = metrics["settling_time_5pct_s"]
    assert settling.value is None
    assert settling.outcome is Outcome.UNSET
    assert settling.reason == "leaves the 5 % band: droop -2.00 deg at the end of the hold"
    assert metrics["droop_deg"].value == pytest.approx(-2.0, abs=0.01)


def test_step_that_never_reaches_ninety_per_cent() -> None:
    metrics = {metric.name: metric for metric in step(T, 0.8 * A * (1 - np.exp(-np.clip(T, 0, None) / 0.1)))}
    assert metrics["rise_time_s"].value is None
    assert metrics["rise_time_s"].reason == "never reaches 90 %: at most 80.0 %"
    assert metrics["settling_time_5pct_s"].reason.startswith("never enters the 5 % band")
    assert metrics["overshoot_pct"].value == 0.0


def test_step_in_a_limit_cycle_means_nothing() -> None:
    p = 3.0 * np.sin(2 * math.pi * 8.4 * T)
    cycle = oscillation(T, p, 0 * T, 0 * T, start_s=0.0, end_s=3.0)
    metrics = step_metrics(T, A * np.ones_like(T), start_s=0.0, end_s=3.0, phi_from_rad=0.0, phi_to_rad=A, cycle=cycle)
    unset = {metric.name for metric in metrics if metric.outcome is Outcome.UNSET}
    assert unset == {"overshoot_pct", "rise_time_s", "settling_time_5pct_s", "settling_time_2pct_s"}
    assert metrics[0].reason == "limit cycle 8.4 Hz, 2.1 rad/s in roll"


def test_a_hole_in_the_telemetry_is_not_measured_over() -> None:
    keep = (T < 0.05) | (T > 0.4)
    metrics = step(T[keep], A * second_order(T, 0.5, 10.0)[keep])
    assert {metric.value for metric in metrics} == {None}
    assert metrics[0].reason == "a gap of 0.35 s in the telemetry"
    ended = T < 1.0
    assert "gap of 2.0" in step(T[ended], T[ended])[0].reason
    assert step(np.array([0.0, 1.0]), np.zeros(2))[0].reason == "only 2 samples"


@pytest.mark.parametrize("hertz", [1.5, 2.0, 5.0, 8.4, 16.4, 35.6, 90.0])
@pytest.mark.parametrize("uneven", [False, True])
def test_dominant_frequency_of_one_second(hertz: float, uneven: bool) -> None:
    rng = np.random.default_rng(3)
    t = np.arange(0, 1, 0.004) + (rng.uniform(-0.001, 0.001, 250) if uneven else 0.0)
    for phase in rng.uniform(0, 2 * math.pi, 5):
        wave = np.sin(2 * math.pi * hertz * t + phase)
        signal = 3.0 * wave + 0.3 * wave**3 + 0.5 * t + 0.05 * rng.standard_normal(len(t))
        assert dominant_frequency(t, signal) == pytest.approx(hertz, abs=0.1)


@pytest.mark.parametrize("hertz", [0.61, 2.03, 5.317, 8.4137, 16.43, 35.6])
def test_frequency_of_a_pure_sine_is_good_to_a_thousandth(hertz: float) -> None:
    t = 7.0 + np.arange(0, 1, 0.004)
    for phase in (0.0, 1.0, 2.5, 4.0):
        assert dominant_frequency(t, np.sin(2 * math.pi * hertz * t + phase)) == pytest.approx(hertz, abs=6e-4)


@pytest.mark.parametrize("hole", [(2.0, 2.25), (2.4, 2.65), (2.75, 3.0)])
def test_an_oscillation_is_not_measured_over_a_hole(hole: tuple[float, float]) -> None:
    keep = (hole[0] > T) | (hole[1] < T)
    shake = oscillation(T[keep], T[keep], T[keep], T[keep], start_s=0.0, end_s=3.0)
    assert shake.reason.startswith("a gap of 0.2")


def test_oscillation_finds_the_axis_and_amplitude() -> None:
    shake = oscillation(T, 0.01 * np.sin(40 * T), 2.0 * np.sin(2 * math.pi * 21.2 * T), 0 * T, start_s=0, end_s=3)
    assert shake.axis == "pitch"
    assert shake.worst_rad_s == pytest.approx(math.sqrt(2), rel=0.01)
    assert shake.frequency_hz == pytest.approx(21.2, abs=0.1)
    assert shake.is_limit_cycle
    quiet = oscillation(T, 0.01 * np.sin(40 * T), 0 * T, 0 * T, start_s=0, end_s=3)
    assert not quiet.is_limit_cycle
    assert quiet.frequency_hz is None


def test_oscillation_needs_a_hold_and_data() -> None:
    still = np.zeros_like(T)
    short = oscillation(T, still, still, still, start_s=1.5, end_s=3.0)
    assert short.reason == "held for 1.5 s: oscillation needs 2 s"
    assert math.isnan(short.worst_rad_s)
    assert not short.is_limit_cycle
    assert oscillation(T, still, still, still, start_s=2.0, end_s=6.0).reason.startswith("only 0 samples")
    assert "body rates" in oscillation(T, still + np.nan, still, still, start_s=0.0, end_s=3.0).reason


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.141])
def test_tracking_a_delayed_sine(delay: float) -> None:
    t = np.arange(0, 20, 0.004)
    hertz = 0.5
    phi_sp = A * np.sin(2 * math.pi * hertz * t)
    got = values(track_metrics(t, A * np.sin(2 * math.pi * hertz * (t - delay)), phi_sp, start_s=0, end_s=20))
    # sin(x) - sin(x - d) has variance (1 - cos d) A^2: VAF = 2 cos d - 1
    assert got["vaf_pct"] == pytest.approx(100 * (2 * math.cos(2 * math.pi * hertz * delay) - 1), abs=0.05)
    assert got["lag_s"] == pytest.approx(delay, abs=2e-3)
    assert got["vaf_lag_removed_pct"] == pytest.approx(100, abs=0.01)
    spread = math.degrees(A) * math.sqrt(1 - math.cos(2 * math.pi * hertz * delay))
    assert got["rms_error_deg"] == pytest.approx(spread, abs=0.02)


@given(sign=st.sampled_from([-1.0, 1.0]), size=st.floats(0.2, 4), shift=st.floats(-50, 50))
def test_tracking_does_not_depend_on_sign_size_or_epoch(sign: float, size: float, shift: float) -> None:
    t = np.arange(0, 5, 0.02)
    phi_sp = A * np.sign(np.sin(2 * t))
    phi = A * np.sin(2 * t - 0.4)
    plain = values(track_metrics(t, phi, phi_sp, start_s=0, end_s=5))
    k = sign * size
    moved = values(track_metrics(t + shift, k * phi, k * phi_sp, start_s=shift, end_s=5 + shift))
    for name in ("vaf_pct", "vaf_lag_removed_pct", "lag_s"):
        assert moved[name] == pytest.approx(plain[name], abs=1e-4)
    assert moved["rms_error_deg"] == pytest.approx((plain["rms_error_deg"] or 0) * size, rel=1e-6)


def test_an_oscillation_that_was_not_measured_says_why_and_is_no_limit_cycle() -> None:
    unknown = Oscillation((9.0, 9.0, 9.0), "", None, "only 3 samples")
    assert str(unknown) == "only 3 samples"
    assert math.isnan(unknown.worst_rad_s)
    assert not unknown.is_limit_cycle
    assert not Oscillation((0.1, LIMIT_CYCLE_RAD_S, 0.2), "pitch", None).is_limit_cycle
    assert str(Oscillation((0.1, 0.31, 0.2), "pitch", None)) == "limit cycle 0.31 rad/s in pitch"
    assert str(Oscillation((0.1, 0.05, 0.2), "yaw", 4.0)) == "rate 4.0 Hz, 0.2 rad/s in yaw"


def test_an_oscillation_needs_two_seconds_and_not_more() -> None:
    still = np.zeros_like(T)
    assert not oscillation(T, still, still, still, start_s=1.0, end_s=3.0).reason
    assert oscillation(T, still, still, still, start_s=1.01, end_s=3.0).reason
    # only the last second counts
    early = np.where(T < 1.9, 5.0 * np.sin(40.0 * T), 0.0)
    assert oscillation(T, early, still, still, start_s=0.0, end_s=3.0).worst_rad_s == 0.0
    assert oscillation(T, early, still, still, start_s=0.0, end_s=2.0).worst_rad_s > 1.0


@pytest.mark.parametrize(("std_rad_s", "known"), [(0.019, False), (0.021, True)])
def test_a_rate_near_noise_has_no_frequency(std_rad_s: float, known: bool) -> None:
    shake = oscillation(
        T, math.sqrt(2.0) * std_rad_s * np.sin(2 * math.pi * 5.0 * T), 0 * T, 0 * T, start_s=0.0, end_s=3.0
    )
    assert (shake.frequency_hz is not None) is known


def test_a_step_that_jumps_is_there_at_once() -> None:
    jumped = step(T, np.where(T >= -0.001, A, 0.0))
    assert values(jumped) == {
        "overshoot_pct": pytest.approx(0.0, abs=1e-9),
        "rise_time_s": 0.0,
        "settling_time_5pct_s": pytest.approx(0.0, abs=1e-9),
        "settling_time_2pct_s": pytest.approx(0.0, abs=1e-9),
        "droop_deg": pytest.approx(0.0, abs=1e-9),
    }


def test_a_rise_that_began_before_is_counted_from_the_step_on() -> None:
    # half way there at 0 s, 90 % at 0.8 s
    assert values(step(T, A * (0.5 + 0.5 * np.clip(T, 0.0, 1.0))))["rise_time_s"] == pytest.approx(0.8, abs=1e-6)


def test_a_level_is_crossed_between_the_first_sample_beyond_it_and_the_one_before() -> None:
    t = np.arange(0.0, 3.0, 0.1)
    # at rest up to 0.1 s, half way at 0.2 s, there at 0.3 s: 10 % at 0.12 s and 90 % at 0.28 s
    rising = step(t, A * np.interp(t, [0.1, 0.2, 0.3], [0.0, 0.5, 1.0]))
    assert values(rising)["rise_time_s"] == pytest.approx(0.16)


def test_settling_ends_between_the_last_sample_outside_and_the_next() -> None:
    t = np.arange(0.0, 3.0, 0.1)
    got = values(step(t, np.where(t < 0.95, 0.8 * A, A)))  # 80 % at 0.9 s, there at 1.0 s
    assert got["settling_time_5pct_s"] == pytest.approx(0.975)
    assert got["settling_time_2pct_s"] == pytest.approx(0.99)


def test_a_set_point_that_does_not_step() -> None:
    metrics = step(T, 0 * T, amplitude=0.0)
    assert len(metrics) == 5
    assert {metric.reason for metric in metrics} == {"the set-point does not step"}


@pytest.mark.parametrize(("hold", "measured_"), [(1.0, True), (0.99, False)])
def test_droop_needs_a_second_of_hold(hold: float, measured_: bool) -> None:
    droop = step(T, np.where(T >= 0, 0.9 * A, 0.0), hold=hold)[-1]
    assert (droop.value is not None) is measured_
    assert droop.reason == ("" if measured_ else "held for 0.99 s: droop needs 1 s")
    if measured_:
        assert droop.value == pytest.approx(-1.0)


@pytest.mark.parametrize(("gap_s", "measured_"), [(0.19, True), (0.21, False)])
def test_a_gap_of_a_fifth_of_a_second_is_too_long(gap_s: float, measured_: bool) -> None:
    t = np.concatenate([np.arange(0.0, 1.0, 0.01), np.arange(0.99 + gap_s, 3.0, 0.01)])
    assert (step(t, A * np.ones_like(t))[0].value is not None) is measured_


@pytest.mark.parametrize(("samples", "measured_"), [(7, False), (8, True)])
def test_eight_samples_are_enough(samples: int, measured_: bool) -> None:
    t = np.arange(samples) * 0.1
    metrics = step(t, A * np.ones_like(t), hold=samples * 0.1)
    assert (metrics[0].value is not None) is measured_


def test_a_lag_is_looked_for_up_to_a_second() -> None:
    t = np.arange(0.0, 20.0, 0.02)
    phi_sp = A * np.sign(np.sin(0.7 * t))

    def lagging(lag_s: float) -> dict[str, Metric]:
        phi = A * np.sign(np.sin(0.7 * (t - lag_s)))
        return {one.name: one for one in track_metrics(t, phi, phi_sp, start_s=0.0, end_s=20.0)}

    assert lagging(0.9)["lag_s"].value == pytest.approx(0.9, abs=0.02)
    assert lagging(1.2)["lag_s"].reason == "the lag exceeds 1 s"
    assert lagging(1.2)["vaf_lag_removed_pct"].reason == "the lag exceeds 1 s"
    assert lagging(1.2)["vaf_pct"].value is not None


def test_a_lag_is_looked_for_up_to_a_quarter_of_a_short_window() -> None:
    t = np.arange(0.0, 2.0, 0.004)
    metrics = track_metrics(t, A * np.sin(math.pi * (t - 0.7)), A * np.sin(math.pi * t), start_s=0.0, end_s=2.0)
    assert metrics[2].reason == "the lag exceeds 0.5 s"


@pytest.mark.parametrize("lag_s", [0.0537, 0.0563, 0.0599])
def test_a_lag_is_found_between_two_samples(lag_s: float) -> None:
    t, w = np.arange(0.0, 60.0, 0.01), 4.0 * math.pi
    metrics = track_metrics(t, A * np.sin(w * (t - lag_s)), A * np.sin(w * t), start_s=0.0, end_s=60.0)
    assert metrics[2].value == pytest.approx(lag_s, abs=5e-4)


def test_a_standing_error_does_not_hide_the_lag() -> None:
    t = np.arange(0, 20, 0.004)
    phi = 2.0 * A + A * np.sin(math.pi * (t - 0.1))
    assert values(track_metrics(t, phi, A * np.sin(math.pi * t), start_s=0, end_s=20))["lag_s"] == pytest.approx(
        0.1, abs=2e-3
    )


def test_nor_does_a_set_point_far_from_level() -> None:
    t = np.arange(0, 20, 0.004)
    phi_sp, phi = (2.0 * A + A * np.sin(math.pi * (t - lag)) for lag in (0.0, 0.1))
    assert values(track_metrics(t, phi, phi_sp, start_s=0, end_s=20))["lag_s"] == pytest.approx(0.1, abs=2e-3)


@pytest.mark.parametrize(("std_deg", "moves"), [(0.49, False), (0.51, True)])
def test_a_set_point_that_moves_by_half_a_degree_excites(std_deg: float, moves: bool) -> None:
    t = np.arange(0.0, 10.0, 0.02)
    phi_sp = math.radians(std_deg) * math.sqrt(2.0) * np.sin(2.0 * math.pi * t)
    assert (track_metrics(t, phi_sp, phi_sp, start_s=0.0, end_s=10.0)[0].value is not None) is moves


def test_two_motor_commands_are_an_effort_and_one_is_none() -> None:
    t, delta = np.arange(0.0, 1.0, 0.1), np.full(10, math.nan)
    delta[3] = 0.2
    assert effort_metrics(t, delta, start_s=0.0, end_s=1.0)[0].value is None
    delta[4] = -0.2
    assert values(effort_metrics(t, delta, start_s=0.0, end_s=1.0)) == {
        "peak_delta_lat": 0.2, "rms_delta_lat": pytest.approx(0.2),
    }  # fmt: skip


def test_a_window_has_the_sample_at_its_start_and_not_the_one_at_its_end() -> None:
    t, delta = np.arange(0.0, 3.0, 0.125), np.zeros(24)
    delta[[7, 16]] = 5.0  # at 0.875 s and at 2.0 s
    delta[8] = 0.5
    assert effort_metrics(t, delta, start_s=1.0, end_s=2.0)[0].value == 0.5


def test_tracking_refuses_without_excitation_or_correlation() -> None:
    t = np.arange(0, 5, 0.02)
    still = {m.name: m for m in track_metrics(t, 0 * t + 0.1, 0 * t, start_s=0, end_s=5)}
    assert still["vaf_pct"].reason == "the set-point hardly moves (0 deg): no excitation"
    assert still["rms_error_deg"].value == pytest.approx(math.degrees(0.1))
    noise = np.random.default_rng(0).standard_normal(len(t))
    lost = {m.name: m for m in track_metrics(t, noise, A * np.sin(t), start_s=0, end_s=5)}
    assert lost["lag_s"].value is None
    assert "hardly correlate" in lost["vaf_lag_removed_pct"].reason
    assert track_metrics(t, t, t + np.nan, start_s=0, end_s=5)[0].reason == "the vehicle reported no roll set-point"


def test_effort_and_divergence() -> None:
    t = np.arange(0, 2, 0.01)
    got = values(effort_metrics(t, -0.4 * np.sin(2 * math.pi * t), start_s=0, end_s=2))
    assert got["peak_delta_lat"] == pytest.approx(0.4)
    assert got["rms_delta_lat"] == pytest.approx(0.4 / math.sqrt(2), rel=0.01)
    assert effort_metrics(t, t + np.nan, start_s=0, end_s=2)[0].reason == "no motor commands reported"
    assert divergence(t, 0.5 * t, 0 * t) == ""
    assert divergence(t, t, 0 * t) == "diverged: roll beyond 80 deg at 1.40 s"
    assert divergence(t, 0 * t, -t) == "diverged: pitch beyond 80 deg at 1.40 s"


# A real PX4's flights; overshoot, rise and 5 % settling time, droop, p std and its frequency as they were
# published with the recordings (two to three digits); None: not reached.
RECORDED = [
    ("ANT-X_flight_both_25", 0.0, 0.22, None, -1.97, 0.001, None),
    ("ANT-R_flight_both_10", 0.7, 0.15, None, -0.69, 0.006, None),
    ("ANT-R-H_flight_both_10", 0.4, 0.15, None, -0.69, 0.006, None),
    ("CARRIER-1_default_both_10", 0.0, None, None, -1.36, 0.001, None),
    ("CARRIER-1-octoX_flight_both_10", 0.0, 0.26, None, -0.89, 0.001, None),
    ("ANT-X_hinf-ANT-R_roll_10", 9.7, None, 0.75, None, 0.02, None),
    ("ANT-X_hinf-ADAM-0_roll_0", 0.0, None, 0.49, None, 0.00, None),
    ("ANT-X_hinf-CARRIER-1_roll_25", None, None, None, None, 2.78, 9.0),
]


@pytest.mark.parametrize(("case", "overshoot", "rise", "settling", "droop", "p_std", "hertz"), RECORDED)
def test_recorded_steps(
    case: str,
    overshoot: float | None,
    rise: float | None,
    settling: float | None,
    droop: float | None,
    p_std: float,
    hertz: float | None,
) -> None:
    c, _ = recorded(case)
    cycle = oscillation(c["t_s"], c["p_rad_s"], c["q_rad_s"], 0 * c["t_s"], start_s=0, end_s=3)
    got = values(step_metrics(c["t_s"], c["phi_rad"], start_s=0, end_s=3, phi_from_rad=0, phi_to_rad=A, cycle=cycle))
    assert cycle.std_rad_s[0] == pytest.approx(p_std, abs=0.006)
    assert cycle.is_limit_cycle == (hertz is not None)
    if hertz is not None:
        assert cycle.frequency_hz == pytest.approx(hertz, abs=0.1)
    if overshoot is None or settling is None:
        assert got["settling_time_5pct_s"] is None
    else:
        assert got["settling_time_5pct_s"] == pytest.approx(settling, abs=0.006)
    assert got["overshoot_pct"] == (None if overshoot is None else pytest.approx(overshoot, abs=0.06))
    if rise is not None:
        assert got["rise_time_s"] == pytest.approx(rise, abs=0.006)
    if droop is not None:
        assert got["droop_deg"] == pytest.approx(droop, abs=0.011)
    if case.startswith("CARRIER-1_default"):
        assert got["rise_time_s"] is None


def test_recorded_track() -> None:
    c, about = recorded("ANT-X_track-flight_both_10")
    t = c["t_s"]
    sent = np.radians(about["setpoint_deg"])
    # The autopilot has a set-point in force, and reports it, from the 4 ms tick after it was sent.
    k = np.floor((t - 0.004) / 0.02 + 1e-6).astype(int)
    phi_sp = np.where(k < 0, 0.0, sent[np.clip(k, 0, 999)])
    got = values(track_metrics(t, c["phi_rad"], phi_sp, start_s=0, end_s=20))
    assert got["vaf_pct"] == pytest.approx(72.9, abs=0.1)
    assert got["rms_error_deg"] == pytest.approx(3.79, abs=0.01)
    assert got["lag_s"] == pytest.approx(0.140, abs=0.001)
    assert got["vaf_lag_removed_pct"] == pytest.approx(94.2, abs=0.1)
    sines = values(track_metrics(t, c["phi_rad"], phi_sp, start_s=12, end_s=19.5))
    assert sines["vaf_pct"] == pytest.approx(30.3, abs=0.1)
    assert sines["lag_s"] == pytest.approx(0.149, abs=0.001)
