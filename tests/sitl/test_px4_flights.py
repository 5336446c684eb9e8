"""Nine flights of a real PX4 on this plant, flown again by the emulated one (tests/data/px4-steps)."""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from sitl.airframe import FlightGains, Rotor
from sitl.rotation import from_euler
from sitl.vehicle_spec import VehicleModel, resolve_vehicle

FLIGHTS = sorted((Path(__file__).parents[1] / "data" / "px4-steps").glob("*.parquet"))
NAMES = [path.stem for path in FLIGHTS]
CYCLING = "ANT-X_hinf-CARRIER-1_roll_25"
STABLE = [name for name in NAMES if name != CYCLING]
DT_S = 0.004
SET_POINT_TICKS = 5
LIMIT_CYCLE_RAD_S = 0.3
PX4_DEFAULTS = FlightGains(4.0, 0.15, 0.2, 0.003)
SQUARE_X = tuple(
    Rotor(x, y, 0.0, km)
    for x, y, km in ((0.06, 0.06, 0.05), (-0.06, -0.06, 0.05), (0.06, -0.06, -0.05), (-0.06, 0.06, -0.05))
)


@dataclass(frozen=True)
class Recorded:
    """One flight of the real PX4: 250 Hz truth and what was flown."""

    columns: dict[str, np.ndarray]
    metadata: dict[str, Any]

    @property
    def tracks(self) -> bool:
        return "setpoint_deg" in self.metadata

    @property
    def duration_s(self) -> float:
        return 0.02 * len(self.metadata["setpoint_deg"]) if self.tracks else 4.0 * self.metadata["hold_s"]

    def set_point(self, t_s: float) -> float:
        """Roll set-point sent at a time, rad."""
        if not 0.0 <= t_s < self.duration_s:
            return 0.0
        if self.tracks:
            return math.radians(self.metadata["setpoint_deg"][int(t_s / 0.02 + 1e-6)])
        size, hold_s = math.radians(self.metadata["step_deg"]), self.metadata["hold_s"]
        return (size, 0.0, -size, 0.0)[int(t_s / hold_s + 1e-9)]

    def model(self) -> VehicleModel:
        model = resolve_vehicle(self.metadata["frame"].lower())
        rotors = tuple(Rotor(r["px"], r["py"], 0.0, r["km"]) for r in self.metadata.get("rotors", ())) or SQUARE_X
        return replace(model, airframe=replace(model.airframe, rotors=rotors))

    def gains(self, axis: str) -> FlightGains:
        flight_gains = self.model().airframe.flight_gains
        assert flight_gains is not None
        if axis == "PITCH" and self.metadata["axes"] == "roll":
            return flight_gains
        gains = self.metadata["gains"]
        if gains is None:
            return PX4_DEFAULTS
        return FlightGains(gains["K_phi"], gains["K_P"], gains["K_I"], gains["K_D"])


@functools.cache
def recorded(name: str) -> Recorded:
    table = pq.read_table(FLIGHTS[NAMES.index(name)])
    columns = {column: table[column].to_numpy() for column in table.column_names}
    return Recorded(columns, json.loads(table.schema.metadata[b"froude"]))


_FLOWN: dict[str, dict[str, np.ndarray]] = {}


def flown(flight: Any, name: str) -> dict[str, np.ndarray]:
    """The same flight by the emulated autopilot: taken off, brought to Offboard, then the recorded set-points."""
    if name in _FLOWN:
        return _FLOWN[name]
    real = recorded(name)
    emulated = flight(real.model(), "sitl", motor_lag_s=real.metadata["motor_lag_s"], flight_gains=False)
    for axis in ("ROLL", "PITCH"):
        gains = real.gains(axis)
        emulated.set_gains(axis, gains.k_phi, gains.kp, gains.ki, gains.kd)
    emulated.take_off(10.0)
    vehicle, autopilot = emulated.vehicle, emulated.autopilot
    emulated.go_offboard()

    def send(phi_sp: float) -> None:
        phi = vehicle.truth.euler()[0]
        height, climb = 10.0 + vehicle.truth.position_ned()[2], vehicle.truth.velocity_ned()[2]
        thrust = real.metadata["hover_thrust"] / math.cos(phi) * (1.0 + 0.10 * height + 0.18 * climb)
        autopilot.offboard_attitude(from_euler(phi_sp, 0.0, 0.0), (0.0, 0.0, math.nan), min(0.8, thrust))

    emulated.run(4.0, lambda k: send(0.0) if k % SET_POINT_TICKS == 0 else None)
    times = np.arange(round(real.duration_s / DT_S)) * DT_S
    rows: dict[str, list[float]] = {"t_s": times.tolist(), "phi_rad": [], "p_rad_s": [], "q_rad_s": []}
    for k, t_s in enumerate(times):
        phi, (p, q, _) = vehicle.truth.euler()[0], vehicle.truth.rates()
        for column, value in (("phi_rad", phi), ("p_rad_s", p), ("q_rad_s", q)):
            rows[column].append(value)
        if k % SET_POINT_TICKS == 0:
            send(real.set_point(float(t_s)))
        vehicle.step()
    _FLOWN[name] = {column: np.array(values) for column, values in rows.items()}
    return _FLOWN[name]


def third_second(columns: dict[str, np.ndarray], column: str) -> np.ndarray:
    return columns[column][(columns["t_s"] >= 2.0 - 1e-9) & (columns["t_s"] < 3.0 - 1e-9)]


def cycles(columns: dict[str, np.ndarray]) -> bool:
    """The verdict: a rate moves by more than 0.3 rad/s in the third second."""
    return max(float(third_second(columns, axis).std()) for axis in ("p_rad_s", "q_rad_s")) > LIMIT_CYCLE_RAD_S


def frequency_hz(rate: np.ndarray) -> float:
    windowed = (rate - rate.mean()) * np.hanning(len(rate))
    return float(np.fft.rfftfreq(16_384, DT_S)[np.abs(np.fft.rfft(windowed, 16_384)).argmax()])


def test_all_nine_are_there() -> None:
    assert len(FLIGHTS) == 9
    assert CYCLING in NAMES


@pytest.mark.parametrize("name", [name for name in NAMES if not recorded(name).tracks])
def test_same_verdict(flight: Any, name: str) -> None:
    assert cycles(recorded(name).columns) is (name == CYCLING)
    assert cycles(flown(flight, name)) is (name == CYCLING)


@pytest.mark.parametrize("name", STABLE)
def test_roll_agrees_within_what_px4_repeats(flight: Any, name: str) -> None:
    real, emulated = recorded(name), flown(flight, name)
    during = (real.columns["t_s"] >= -1e-9) & (real.columns["t_s"] < real.duration_s - 1e-9)
    roll = real.columns["phi_rad"][during]
    assert real.columns["t_s"][during] == pytest.approx(emulated["t_s"], abs=1e-6)
    rms_deg = math.degrees(math.sqrt(float(np.mean((emulated["phi_rad"] - roll) ** 2))))
    assert rms_deg < 0.15
    assert np.ptp(roll) > math.radians(15.0)


def test_limit_cycle_agrees_in_frequency_and_amplitude(flight: Any) -> None:
    real, emulated = recorded(CYCLING), flown(flight, CYCLING)
    ours, theirs = third_second(emulated, "p_rad_s"), third_second(real.columns, "p_rad_s")
    assert frequency_hz(ours) == pytest.approx(frequency_hz(theirs), abs=0.2)
    assert ours.std() == pytest.approx(theirs.std(), rel=0.05)


@pytest.mark.parametrize("name", [name for name in STABLE if not recorded(name).tracks])
def test_steps_overshoot_as_much(flight: Any, name: str) -> None:
    def overshoot_pct(columns: dict[str, np.ndarray]) -> float:
        first = columns["phi_rad"][(columns["t_s"] >= 0.0) & (columns["t_s"] < 3.0)]
        return 100.0 * max(0.0, float(first.max()) / math.radians(10.0) - 1.0)

    assert overshoot_pct(flown(flight, name)) == pytest.approx(overshoot_pct(recorded(name).columns), abs=1.3)


@pytest.mark.parametrize("name", [name for name in STABLE if not recorded(name).tracks])
def test_timing_is_what_makes_them_agree(flight: Any, name: str) -> None:
    """One tick more between set-point and motor shows: the agreement is not a matter of loose limits."""
    real, emulated = recorded(name), flown(flight, name)
    edge = (real.columns["t_s"] >= -1e-9) & (real.columns["t_s"] < 0.2 - 1e-9)
    roll, ours = real.columns["phi_rad"][edge], emulated["phi_rad"][: int(edge.sum())]
    shifted = np.concatenate([[ours[0]], ours[:-1]])
    right, late = (float(np.sqrt(np.mean((x - x[0] - roll + roll[0]) ** 2))) for x in (ours, shifted))
    assert right < late


# What the real PX4 did in Hold with these gains on roll: rate standard deviation (rad/s) and frequency (Hz). The side
# force of the motors comes back through the velocity controller, so these are cycles that Offboard does not have.
ADAM_ON_ANT_X = FlightGains(13.88, 0.604, 3.09, 1.44e-5)
ADAM_ON_ADAM = FlightGains(10.68, 1.07, 47.1, 4.43e-5)
ANT_X_ON_ANT_R = FlightGains(11.81, 0.123, 3.2, 4.99e-7)
ANT_X_ON_ANT_X = FlightGains(12.04, 0.6, 35.8, 3.57e-6)
ANT_X_ON_CARRIER = FlightGains(12.49, 0.341, 2.21, 1.64e-5)
HOLD = [
    ("adam-0", ADAM_ON_ANT_X, 0.0, 0.62, 22.5),
    ("adam-0", ADAM_ON_ANT_X, 0.010, 1.02, 13.3),
    ("adam-0", ADAM_ON_ADAM, 0.0, 0.87, 20.8),
    ("adam-0", ADAM_ON_ADAM, 0.010, 1.14, 12.7),
    ("adam-0", ADAM_ON_ADAM, 0.025, 1.36, 8.3),
    ("ant-x", ANT_X_ON_ANT_R, 0.025, 4.96, 5.7),
    ("ant-x", ANT_X_ON_ANT_X, 0.0, 1.42, 29.9),
    ("ant-x", ANT_X_ON_ANT_X, 0.010, 2.37, 14.0),
    ("ant-x", ANT_X_ON_ANT_X, 0.025, 4.30, 7.0),
    ("ant-x", ANT_X_ON_CARRIER, 0.025, 3.23, 8.2),
]


def hold(flight: Any, airframe: str, gains: FlightGains, lag_s: float, **parameters: float) -> np.ndarray:
    """Roll rate over four seconds of Hold."""
    made = flight(airframe, motor_lag_s=lag_s)
    made.set_gains("ROLL", gains.k_phi, gains.kp, gains.ki, gains.kd)
    for name, value in parameters.items():
        made.parameters.set(name, value)
    made.take_off(10.0, settle_s=6.0)
    rates: list[float] = []
    made.run(4.0, lambda _: rates.append(made.vehicle.truth.rates()[0]))
    return np.array(rates)


@pytest.mark.parametrize(("airframe", "gains", "lag_s", "std_rad_s", "cycle_hz"), HOLD)
def test_hold_cycles_as_it_did(
    flight: Any, airframe: str, gains: FlightGains, lag_s: float, std_rad_s: float, cycle_hz: float
) -> None:
    rate = hold(flight, airframe, gains, lag_s)
    assert rate.std() == pytest.approx(std_rad_s, rel=0.25)
    assert frequency_hz(rate) == pytest.approx(cycle_hz, abs=2.0)


def test_hold_is_quiet_once_the_velocity_controller_has_no_derivative(flight: Any) -> None:
    assert hold(flight, "adam-0", ADAM_ON_ANT_X, 0.0, MPC_XY_VEL_D_ACC=0.0).std() < 0.02
