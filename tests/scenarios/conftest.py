"""A run of three flights as the runner would hand it to the outputs: one passes, one oscillates, one was broken off."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from scenarios.flight import Event, FlightRecord, RunRecord, Segment
from scenarios.gain_set import GainSet
from scenarios.limits import LIMIT_SETS, judge, measured
from scenarios.manoeuvres import make_manoeuvre
from scenarios.one_flight import FlightJob
from scenarios.runner import plan
from scenarios.scenario import Gate, Scenario, load_scenario
from scenarios.telemetry import Telemetry

BOOT_S = 4.0
STEP_S, TRACK_S, END_S = 6.0, 10.0, 16.0
AMPLITUDE = math.radians(10.0)
RATE_HZ = 250
CYCLE_HZ, CYCLE_RAD_S = 9.0, 3.0

SEGMENTS = (
    Segment("step/1", "step", "step", STEP_S, STEP_S + 2.0, AMPLITUDE, 0.0),
    Segment("step/2", "hold", "step", STEP_S + 2.0, STEP_S + 3.0, -AMPLITUDE, AMPLITUDE),
    Segment("track", "track", "track", TRACK_S, END_S - 1.0, AMPLITUDE, 0.0),
)
OWN = {"MC_ROLL_P": 6.5, "MC_ROLLRATE_P": 0.05, "MC_ROLLRATE_I": 0.05, "MC_ROLLRATE_D": 0.001}


def telemetry(cycling: bool) -> Telemetry:
    """A first-order answer to the set-point; with a sine on top if it cycles."""
    t = BOOT_S + np.arange(round((END_S - BOOT_S) * RATE_HZ)) / RATE_HZ
    phi_sp = np.where((t >= STEP_S) & (t < STEP_S + 2.0), AMPLITUDE, 0.0)
    track = (t >= TRACK_S) & (t < END_S - 1.0)
    phi_sp[track] = AMPLITUDE * np.sin(2.0 * np.pi * 0.5 * (t[track] - TRACK_S))
    phi = np.zeros_like(t)
    for k in range(1, len(t)):
        phi[k] = phi[k - 1] + (phi_sp[k - 1] - phi[k - 1]) * 6.0 / RATE_HZ
    p = np.gradient(phi, t)
    if cycling:
        omega = 2.0 * np.pi * CYCLE_HZ
        phi = phi + CYCLE_RAD_S / omega * np.sin(omega * t)
        p = p + CYCLE_RAD_S * np.cos(omega * t)
    delta = np.clip(0.03 * p, -0.7, 0.7)
    motors = {f"motor{n + 1}": 0.5 + sign * delta * math.sqrt(0.5) for n, sign in enumerate((-1, 1, 1, -1))}
    return Telemetry.from_columns(
        {
            "t_s": t,
            "phi_rad": phi,
            "theta_rad": 0.01 * np.sin(t),
            "psi_rad": np.full_like(t, 0.3),
            "p_rad_s": p,
            "q_rad_s": np.zeros_like(t),
            "r_rad_s": np.zeros_like(t),
            "phi_sp_rad": phi_sp,
            "theta_sp_rad": np.zeros_like(t),
            "p_sp_rad_s": 6.0 * (phi_sp - phi),
            "thrust_sp": np.full_like(t, 0.5),
            "north_m": 0.1 * t,
            "east_m": -0.2 * t,
            "down_m": np.full_like(t, -5.0),
            "v_north_m_s": np.zeros_like(t),
            "v_east_m_s": np.zeros_like(t),
            "v_down_m_s": np.zeros_like(t),
            **motors,
            "delta_lat": delta,
            "delta_lon": np.zeros_like(t),
            "nav_state": np.where(t < 5.0, 17, 14),
            "armed": (t >= 4.5) & (t < 15.8),
        }
    )


def _flight(
    name: str, parameters: dict, rows: Telemetry, segments: tuple, metrics: list, failure: str = ""
) -> FlightRecord:
    outcome, reason, judged = judge(metrics, LIMIT_SETS["practical"], failure)
    return FlightRecord(
        gain_set=GainSet(name, parameters, "a table"),
        vehicle_spec="ant-x",
        telemetry=rows,
        segments=segments,
        events=(Event(4.5, 6, "Armed by external command"), Event(9.0, 2, "Attitude failure (roll)")),
        metrics=judged,
        margins={"delay_margin_s": 0.03, "gain_margin_high_db": math.inf},
        outcome=outcome,
        reason=reason,
        warnings=("MC_ROLLRATE_I 35.8 exceeds PX4's maximum 10",) if failure == "" and "cycles" in name else (),
        telemetry_sha256=rows.sha256(),
        seed=7,
        parameters={**parameters, "MC_PITCH_P": 6.5},
    )


@pytest.fixture(scope="session")
def flown_run() -> RunRecord:
    cycle = "limit cycle on roll: 2.1 rad/s at 9.0 Hz"
    passes = _flight(
        "own gains",
        OWN,
        telemetry(cycling=False),
        SEGMENTS,
        [
            measured("overshoot_pct", 0.0),
            measured("rise_time_s", 0.366),
            measured("settling_time_5pct_s", 0.5),
            measured("settling_time_2pct_s", None, "never inside the band"),
            measured("droop_deg", -0.0001),
            measured("vaf_pct", 92.81),
            measured("rms_error_deg", 1.3),
            measured("oscillation_rad_s", 0.004),
            measured("oscillation_hz", None, "quiet"),
            measured("peak_delta_lat", 0.06),
            measured("delay_margin_s", 0.0312),
            measured("gain_margin_high_db", math.inf),
            measured("overshoot_pct", 99.0, segment="step/2"),
        ],
    )
    cycles = _flight(
        "7.2 cycles",
        {"MC_ROLL_P": 12.0, "MC_ROLLRATE_P": 0.6, "MC_ROLLRATE_I": 35.8, "MC_ROLLRATE_D": 0.0},
        telemetry(cycling=True),
        SEGMENTS,
        [
            measured("overshoot_pct", None, "limit cycle"),
            measured("rise_time_s", None, "limit cycle"),
            measured("oscillation_rad_s", 2.1, cycle),
            measured("oscillation_hz", 9.0),
            measured("delay_margin_s", 0.0021),
        ],
    )
    broken = _flight("refused", {"MC_ROLL_P": 4.0}, Telemetry.empty(), (), [], "arming refused: no gyro\x07 <&>")
    scenario = Scenario(
        name="demo",
        title="Step and track",
        vehicle="ant-x",
        scaling=("derivatives",),
        profile="sitl",
        overrides={"motor_lag_s": 0.01},
        assumptions={},
        axes="roll",
        takeoff_altitude_m=5.0,
        setpoint_rate_hz=50.0,
        seed=7,
        gain_sets=("table_7_2",),
        manoeuvres=(),
        limits=LIMIT_SETS["practical"],
        limits_name="practical",
    )
    vehicle = {
        "name": "ANT-X",
        "derivatives": {"Yv": -0.1068, "Ld": 450.71},
        "sigma_pct": {"Yv": 4.26, "Ld": 0.81},
        "assumptions": {"motor_lag_s": 0.025, "hover_thrust": 0.5},
        "flight_gains": {"k_phi": 6.5, "kp": 0.05, "ki": 0.05, "kd": 0.001},
    }
    profile = (("name", "sitl", ""), ("rate_hz", 250, "Hz"), ("motor_lag_s", 0.01, "s"), ("limits", True, ""))
    return RunRecord(
        scenario, vehicle, profile, (passes, cycles, broken), None, "2026-11-22T20:00:00Z", {"froude": "0.1.0"}
    )


QuickScenario = Callable[..., Scenario]
QuickJob = Callable[..., FlightJob]


@pytest.fixture(scope="session")
def quick_scenario() -> QuickScenario:
    """Makes scenarios that are over soon: a roll step from 3 m height; arguments replace its items."""

    def make(**changes: Any) -> Scenario:
        rate_hz = changes.get("setpoint_rate_hz", 50.0)
        step = make_manoeuvre("step", amplitude_deg=10.0, hold_s=2.0, return_s=2.0, setpoint_rate_hz=rate_hz)
        quick = dataclasses.replace(
            load_scenario("roll_step"),
            gain_sets=("table_2_2/ANT-X",),
            takeoff_altitude_m=3.0,
            gate=Gate(hold_s=0.5, timeout_s=4.0),
            manoeuvres=(step,),
        )
        return dataclasses.replace(quick, **changes)

    return make


@pytest.fixture(scope="session")
def quick_job(quick_scenario: QuickScenario) -> QuickJob:
    """Makes jobs of the quick scenario; `gains` None: the airframe's own flight gains, `job` items of the job."""

    def make(
        gains: dict[str, float | int] | None = None,
        name: str = "set",
        job: dict[str, Any] | None = None,
        **changes: Any,
    ) -> FlightJob:
        scenario = quick_scenario(**changes)
        model = scenario.resolve_vehicle()
        own = model.airframe.flight_gains
        if gains is None:
            assert own is not None
            gains = {
                "MC_ROLL_P": own.k_phi,
                "MC_ROLLRATE_P": own.kp,
                "MC_ROLLRATE_I": own.ki,
                "MC_ROLLRATE_D": own.kd,
            }
        made = plan(GainSet(name, gains), scenario, model, scenario.resolve_profile())
        return dataclasses.replace(made, **(job or {}))

    return make
