"""What a flight tells of its autopilot, on signals whose answer is known."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from scenarios.flight import Event, FlightRecord, Segment
from scenarios.flight_facts import flight_facts, lateness, true_roll
from scenarios.gain_set import GainSet
from scenarios.limits import Outcome
from scenarios.telemetry import Telemetry
from sitl.modes import Mode

RATE_HZ = 250
TAKEOFF_S, UP_S, HOLD_S, OFFBOARD_S, STEP_S, LAND_S, TOUCH_S, DISARM_S = 2.0, 3.5, 8.0, 12.0, 13.0, 19.0, 24.0, 27.0
A = math.radians(10.0)
STEP = Segment("step/1", "step", "step", STEP_S, STEP_S + 3.0, A, 0.0)
BACK = Segment("step/2", "hold", "step", STEP_S + 3.0, STEP_S + 6.0, -A, A)
TIMES = np.arange(0.0, 30.0, 1.0 / RATE_HZ)


def modes(t: np.ndarray) -> np.ndarray:
    """Hold on the ground, up, Hold, Offboard, down."""
    return np.select(
        [t < TAKEOFF_S, t < HOLD_S, t < OFFBOARD_S, t < LAND_S],
        [Mode.LOITER, Mode.TAKEOFF, Mode.LOITER, Mode.OFFBOARD],
        default=Mode.LAND,
    ).astype(np.int16)


def roll(t: np.ndarray) -> np.ndarray:
    """A smooth way to 10 degrees and back."""
    return A * (np.tanh(6.0 * (t - STEP_S - 0.4)) - np.tanh(6.0 * (t - STEP_S - 3.4))) / 2.0


def flown(events: tuple[Event, ...] = (), segments: tuple[Segment, ...] = (STEP, BACK), **more: Any) -> FlightRecord:
    """A flight that rises at 1 m/s from UP_S on and sinks at 0.6 m/s until TOUCH_S, where it bounces at 0.2 m/s."""
    t = TIMES
    climbing = (t >= UP_S) & (t < UP_S + 3.0)
    v_down = np.select(
        [climbing, (t >= LAND_S) & (t < TOUCH_S), (t >= TOUCH_S) & (t < TOUCH_S + 0.1)], [-1.0, 0.6, -0.2]
    )
    segment = np.select([(t >= s.start_s) & (t < s.end_s) for s in segments], list(range(len(segments))), default=-1)
    columns: dict[str, Any] = {
        "t_s": t,
        "phi_rad": roll(t),
        "theta_rad": np.where((t > TOUCH_S) & (t < DISARM_S), math.radians(-1.5), 0.0),
        "p_rad_s": np.gradient(roll(t), t),
        "q_rad_s": 0.0 * t,
        "r_rad_s": 0.0 * t,
        "phi_sp_rad": np.where((t >= STEP_S + 0.012) & (t < STEP_S + 3.0), A, 0.0),
        "thrust_sp": np.full_like(t, 0.47),
        "down_m": 0.05 + np.cumsum(v_down) / RATE_HZ,
        "v_down_m_s": v_down,
        "nav_state": modes(t),
        "armed": (t >= 1.5) & (t < DISARM_S + 0.7),
        "segment": segment,
        **{f"motor{n}": np.full_like(t, 0.5) for n in range(1, 5)},
    }
    telemetry = Telemetry.from_columns(columns | more)
    return FlightRecord(
        *(GainSet("one", {}), "ant-x", telemetry, segments, events, (), {}, Outcome.PASS, "", (), "", 0)
    )


def values(flight: FlightRecord) -> dict[str, float | None]:
    return {name: fact.value for name, fact in flight_facts(flight).items()}


@pytest.mark.parametrize("late_s", [-0.017, 0.0, 0.002, 0.0063, 0.0431])
def test_lateness_of_a_signal_is_found_to_a_tenth_of_a_millisecond(late_s: float) -> None:
    t = np.arange(0.0, 4.0, 0.004)
    found, rms = lateness(t, np.sin(5.0 * (t - late_s)), t, np.sin(5.0 * t)) or (math.nan, math.nan)
    assert found == pytest.approx(late_s, abs=1e-4)
    assert rms < 1e-4


def test_what_is_left_once_the_lateness_is_off_is_the_error() -> None:
    t = np.arange(0.0, 6.0, 0.004)
    _, rms = lateness(t, np.sin(5.0 * (t - 0.01)) + 0.02, t, np.sin(5.0 * t)) or (math.nan, math.nan)
    assert rms == pytest.approx(0.02, rel=0.01)


def test_hold_before_the_manoeuvre() -> None:
    shake = 0.2 * math.sqrt(2.0) * np.sin(2.0 * math.pi * 7.0 * TIMES)
    found = values(flown(p_rad_s=np.where(TIMES < OFFBOARD_S, shake, 0.0)))
    assert found["hold_p_std_rad_s"] == pytest.approx(0.2, rel=0.01)
    assert found["hold_q_std_rad_s"] == pytest.approx(0.0, abs=1e-6)
    assert found["hold_hz"] == pytest.approx(7.0, abs=0.05)
    assert found["hover_thrust"] == pytest.approx(0.47)
    facts = flight_facts(flown())
    assert facts["hold_hz"].value is None
    assert "quiet" in facts["hold_hz"].reason


def test_take_off() -> None:
    found = values(flown())
    assert found["liftoff_time_s"] == pytest.approx(UP_S + 0.3 - TAKEOFF_S, abs=0.02)
    assert found["takeoff_time_s"] == pytest.approx(HOLD_S - TAKEOFF_S, abs=0.005)


def test_landing() -> None:
    found = values(flown((Event(DISARM_S, 6, "Disarmed by landing"),)))
    assert found["touchdown_m_s"] == pytest.approx(0.6)
    assert found["rebound_m_s"] == pytest.approx(0.2)
    assert found["ground_tilt_deg"] == pytest.approx(1.5, abs=1e-3)
    assert found["landing_time_s"] == pytest.approx(DISARM_S - LAND_S)
    assert found["ground_time_s"] == pytest.approx(DISARM_S - TOUCH_S, abs=0.01)


def test_without_the_text_the_heartbeat_tells_of_disarming() -> None:
    assert values(flown())["landing_time_s"] == pytest.approx(DISARM_S + 0.7 - LAND_S, abs=0.005)


def test_a_flight_that_never_comes_down_has_no_landing() -> None:
    facts = flight_facts(flown(armed=TIMES > 1.5))
    assert facts["touchdown_m_s"] == (None, "did not disarm")
    facts = flight_facts(flown(nav_state=np.full(len(TIMES), Mode.OFFBOARD)))
    assert facts["landing_time_s"].reason == "was never in Land"
    assert facts["takeoff_time_s"].reason == "was never in Take-off"
    assert facts["hold_p_std_rad_s"].reason == "was never in Hold"


def test_estimate_is_late_and_off() -> None:
    facts = flight_facts(flown(phi_true_rad=roll(TIMES + 0.006), phi_rad=roll(TIMES) + math.radians(0.1)))
    assert facts["estimate_late_s"].value == pytest.approx(0.006, abs=5e-4)
    assert facts["estimate_error_rms_deg"].value == pytest.approx(0.1, rel=0.02)
    assert flight_facts(flown())["estimate_late_s"].reason == "the simulator's truth is not known"


def test_true_roll_is_the_truth_where_there_is_one() -> None:
    assert np.allclose(true_roll(flown(phi_true_rad=roll(TIMES) + 1.0).telemetry)[1], roll(TIMES) + 1.0, atol=1e-6)
    assert np.allclose(true_roll(flown().telemetry)[1], roll(TIMES), atol=1e-6)


def test_saturation_is_counted_while_something_is_measured() -> None:
    high = np.where((TIMES < STEP_S + 1.5), 1.0, 0.5)
    found = values(flown(motor2=high, motor3=np.where(TIMES > STEP_S + 4.5, 0.0, 0.5)))
    assert found["saturated_high_pct"] == pytest.approx(25.0, abs=0.1)
    assert found["saturated_low_pct"] == pytest.approx(25.0, abs=0.1)


def test_the_set_point_is_taken_up_late() -> None:
    assert values(flown())["setpoint_late_s"] == pytest.approx(0.012, abs=1e-3)


def test_a_flight_without_rows_has_facts_without_values() -> None:
    empty = dataclasses.replace(flown(), telemetry=Telemetry.empty(), segments=())
    facts = flight_facts(empty)
    assert all(fact.value is None and fact.reason for fact in facts.values())
