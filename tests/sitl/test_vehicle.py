from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from sitl.airframe import Derivatives, FlightGains, Rotor
from sitl.modes import Mode
from sitl.parameters import ParameterTable
from sitl.profile import get_profile
from sitl.rotation import from_euler
from sitl.sensors import geodetic, pressure_hpa
from sitl.vehicle import Vehicle, airframe_parameters
from sitl.vehicle_spec import resolve_vehicle

TABLE_7_2 = {
    "ANT-R": FlightGains(11.81, 0.123, 3.2, 4.99e-7),
    "ANT-X": FlightGains(12.04, 0.6, 35.8, 3.57e-6),
    "CARRIER-1": FlightGains(12.49, 0.341, 2.21, 1.64e-5),
    "ADAM-0": FlightGains(6.258, 0.225, 0.987, 3.89e-4),
}
ROOT = Path(__file__).parents[2]
AIRFRAMES = ("ant-x", "ant-r", "carrier-1", "adam-0")


def closed_loop(
    d: Derivatives, g: FlightGains, dt_s: float, phi_sp: float, ticks: int, lag_s: float = 0.0, late: int = 0
) -> np.ndarray:
    """Roll angle after every tick of the study's loop, by matrix exponential and one affine map per tick.

    State: v, p, phi, motor, integral, rate of the tick before, rate set-point of the tick before. Written for this
    test alone; it shares nothing with the package.

    Args:
        lag_s: motor lag, 0 for none. late: 1 if the rate law uses the rate set-point of the tick before.
    """
    n = 4
    A = np.zeros((n, n))
    A[:3, :3] = [[d.Yv, d.Yp, 9.81], [d.Lv, d.Lp, 0.0], [0.0, 1.0, 0.0]]
    A[:3, 3] = [d.Yd, d.Ld, 0.0]
    B = np.zeros(n)
    if lag_s > 0.0:
        A[3, 3], B[3] = -1.0 / lag_s, 1.0 / lag_s
    both = scipy.linalg.expm(np.block([[A, B[:, None]], [np.zeros((1, n + 1))]]) * dt_s)
    V, P, PHI, MOTOR, INTEGRAL, LAST, SP, ONE = range(8)
    unit = np.eye(8)
    wanted = g.k_phi * (phi_sp * unit[ONE] - unit[PHI])
    rate_sp = unit[SP] if late else wanted
    error = rate_sp - unit[P]
    torque = g.kp * error + unit[INTEGRAL] - g.kd * (unit[P] - unit[LAST]) / dt_s
    tick = np.zeros((8, 8))
    if lag_s > 0.0:
        tick[:4, :4] = both[:4, :4]
        tick[:4] += np.outer(both[:4, 4], torque)
    else:
        # the motor state is the torque itself, held over the tick
        tick[:3, :3] = both[:3, :3]
        tick[:3] += np.outer(both[:3, 3], torque)
    tick[INTEGRAL] = unit[INTEGRAL] + g.ki * dt_s * error
    tick[LAST] = unit[P]
    tick[SP] = wanted
    tick[ONE] = unit[ONE]
    assert V == 0
    assert MOTOR == 3
    state, angles = unit[ONE].copy(), []
    for _ in range(ticks):
        state = tick @ state
        angles.append(state[PHI])
    return np.array(angles)


def step_flight(flight: Any, gains: FlightGains, phi_sp: float, seconds: float, **profile: Any) -> np.ndarray:
    """Roll angle after every tick of a roll step of the real vehicle in profile ``study``."""
    made = flight("ant-x", "study", **profile)
    made.set_gains("ROLL", gains.k_phi, gains.kp, gains.ki, gains.kd)
    made.take_off(10.0, settle_s=1.0)
    made.go_offboard()
    made.run(0.1)
    assert made.vehicle.truth.euler() == pytest.approx((0.0, 0.0, 0.0), abs=1e-15)
    made.autopilot.offboard_attitude(from_euler(phi_sp, 0.0, 0.0), (0.0, 0.0, math.nan), 0.5)
    angles = []
    for k in range(round(seconds * 1e6 / made.vehicle.tick_us)):
        if k % 100 == 99:
            made.autopilot.offboard_attitude(from_euler(phi_sp, 0.0, 0.0), (0.0, 0.0, math.nan), 0.5)
        made.vehicle.step()
        angles.append(made.vehicle.truth.euler()[0])
    return np.array(angles)


class TestStudyProfile:
    @pytest.mark.parametrize("phi_sp_deg", [0.1, 10.0])
    @pytest.mark.parametrize("reference", list(TABLE_7_2))
    def test_roll_step_is_the_matrix_exponential_of_the_closed_loop(
        self, flight: Any, reference: str, phi_sp_deg: float
    ) -> None:
        gains, phi_sp = TABLE_7_2[reference], math.radians(phi_sp_deg)
        flown = step_flight(flight, gains, phi_sp, 3.0)
        table = ParameterTable()
        rounded = []
        for name, value in zip(("P", "RATE_P", "RATE_I", "RATE_D"), vars(gains).values(), strict=True):
            table.set(f"MC_ROLL{'_P' if name == 'P' else name}", value)
            rounded.append(float(table.get(f"MC_ROLL{'_P' if name == 'P' else name}")))
        # the step is asked for between two ticks and first flown on by the second: one tick of rest
        model = resolve_vehicle("ant-x").derivatives
        expected = closed_loop(model, FlightGains(*rounded), 1e-3, phi_sp, len(flown) - 1)
        assert flown[0] == pytest.approx(0.0, abs=1e-15)
        assert np.abs(flown[1:] - expected).max() < 1e-6
        assert np.abs(flown).max() > 0.9 * phi_sp

    @pytest.mark.parametrize(
        ("changes", "lag_s", "late"),
        [({"motor_lag_s": 0.025}, 0.025, 0), ({"rate_sp_late_ticks": 1}, 0.0, 1), ({"rate_hz": 500}, 0.0, 0)],
    )
    def test_so_it_is_with_a_lag_a_late_set_point_or_another_rate(
        self, flight: Any, changes: dict[str, Any], lag_s: float, late: int
    ) -> None:
        gains = FlightGains(6.5, 0.05, 0.05, 0.001)
        rounded = FlightGains(*(float(np.float32(value)) for value in vars(gains).values()))
        flown = step_flight(flight, gains, math.radians(10.0), 3.0, **changes)
        dt_s = 1.0 / changes.get("rate_hz", 1000)
        model = resolve_vehicle("ant-x").derivatives
        # a late rate set-point needs the tick before it: at rest it is zero
        expected = closed_loop(model, rounded, dt_s, math.radians(10.0), len(flown) - 1, lag_s, late)
        assert np.abs(flown[1:] - expected).max() < 1e-6

    def test_own_gains_settle_within_half_a_second_as_the_study_says(self, flight: Any) -> None:
        phi_sp = math.radians(10.0)
        angles = step_flight(flight, TABLE_7_2["ANT-X"], phi_sp, 3.0)
        outside = np.flatnonzero(np.abs(angles / phi_sp - 1.0) > 0.05)
        assert (outside[-1] + 1) * 1e-3 < 0.5
        assert 100.0 * (angles.max() / phi_sp - 1.0) < 0.15

    def test_is_linear(self, flight: Any) -> None:
        small, large = (step_flight(flight, TABLE_7_2["ANT-X"], phi_sp, 0.5) for phi_sp in (1e-3, 0.5))
        assert large / 0.5 == pytest.approx(small / 1e-3, abs=1e-9)

    @pytest.mark.parametrize("gains", [(-6.0, -0.5, 0.0, 0.0), (6.0, 5e3, 1e3, 1.0), (12.0, 0.6, -300.0, 0.0)])
    def test_what_diverges_is_plain_to_see_and_stays_finite(self, flight: Any, gains: Any) -> None:
        made = flight("ant-x", "study")
        made.take_off(5.0)
        made.set_gains("ROLL", *gains)
        made.go_offboard()
        made.run(10.0, lambda _: made.autopilot.offboard_attitude(from_euler(0.1, 0, 0), (0, 0, math.nan), 0.5))
        vehicle = made.vehicle
        assert abs(vehicle.estimate.euler()[0]) > math.radians(80.0)
        assert made.said("Attitude failure detected\t")
        seen = [vehicle.gps().lat_deg, vehicle.gps().alt_m, vehicle.estimate.pressure_hpa()]
        seen += [*vehicle.estimate.mag_body(), *vehicle.estimate.accel_body()]
        seen += [*made.autopilot.motors, *made.autopilot.attitude_sp.rates]
        assert np.abs(seen).max() < 3e38  # what a float of the wire can hold
        made.autopilot.command_mode(Mode.LOITER)
        made.run(2.0)
        made.autopilot.command_land()
        made.run(2.0)


class TestFlightGains:
    @pytest.mark.parametrize(
        ("airframe", "droop_deg"), [("ant-x", -1.99), ("ant-r", -0.70), ("carrier-1", -0.88), ("adam-0", -2.5)]
    )
    @pytest.mark.parametrize("lag_s", [0.0, 0.010, 0.025, 0.050])
    def test_what_flew_flies_and_droops_as_on_a_real_px4(
        self, flight: Any, airframe: str, droop_deg: float, lag_s: float
    ) -> None:
        made = flight(airframe, motor_lag_s=lag_s)
        made.take_off(10.0, settle_s=2.0)
        made.go_offboard()
        rates, angles = [], []

        def step(k: int) -> None:
            phi_sp = math.radians(10.0) if k >= 100 else 0.0
            if k % 5 == 0:
                made.autopilot.offboard_attitude(from_euler(phi_sp, 0.0, 0.0), (0.0, 0.0, math.nan), 0.505)
            if k >= 600:  # the third second after the step
                rates.append(made.vehicle.truth.rates()[:2])
                angles.append(math.degrees(made.vehicle.truth.euler()[0]))

        made.run(3.4, step)
        assert np.std(rates, axis=0).max() < 0.05
        assert np.mean(angles) - 10.0 == pytest.approx(droop_deg, abs=0.1)


class TestRepeatability:
    def fly(self, flight: Any, seed: int) -> tuple[bytes, bytes]:
        made = flight(seed=seed)
        made.take_off(5.0, settle_s=1.0)
        made.go_offboard()
        made.run(1.0, lambda _: made.autopilot.offboard_attitude(from_euler(0.1, 0, 0), (0, 0, math.nan), 0.5))
        return made.vehicle.plant.state.tobytes(), made.autopilot.state.tobytes()

    def test_same_seed_same_bytes(self, flight: Any) -> None:
        assert self.fly(flight, 7) == self.fly(flight, 7)

    def test_another_seed_other_bytes(self, flight: Any) -> None:
        assert self.fly(flight, 7) != self.fly(flight, 8)

    def test_looking_at_sensors_changes_nothing(self, flight: Any) -> None:
        blind, curious = flight(), flight()
        blind.arm()
        curious.arm()
        vehicle = curious.vehicle

        def look(_: int) -> None:
            vehicle.estimate.accel_body(), vehicle.estimate.mag_body(), vehicle.estimate.pressure_hpa(), vehicle.gps()

        blind.run(3.0)
        curious.run(3.0, look)
        assert blind.vehicle.plant.state.tobytes() == vehicle.plant.state.tobytes()
        assert blind.vehicle.estimate.accel_body() == vehicle.estimate.accel_body()


class TestTime:
    @pytest.mark.parametrize(("profile", "tick_us"), [("sitl", 4000), ("board", 1250), ("study", 1000)])
    def test_is_a_whole_number_of_ticks(self, profile: str, tick_us: int) -> None:
        vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile(profile))
        for _ in range(10):
            vehicle.step()
        assert (vehicle.tick, vehicle.tick_us, vehicle.time_us) == (10, tick_us, 10 * tick_us)


class TestSensors:
    @pytest.fixture
    def leaning(self, flight: Any) -> Any:
        """A vehicle that flies east at a lean."""
        made = flight()
        made.take_off(10.0, settle_s=2.0)
        made.go_offboard()
        made.run(3.0, lambda _: made.autopilot.offboard_attitude(from_euler(0.2, 0, 0), (0, 0, math.nan), 0.51))
        return made

    def test_at_rest_the_accelerometer_reads_its_weight(self, flight: Any) -> None:
        made, readings = flight(), []
        made.run(2.0, lambda _: readings.append(made.vehicle.estimate.accel_body()))
        assert made.vehicle.truth.accel_body() == (0.0, 0.0, -9.81)
        assert np.mean(readings[1:], axis=0) == pytest.approx((0.0, 0.0, -9.81), abs=0.01)
        assert np.std(readings[1:], axis=0) == pytest.approx((0.05,) * 3, rel=0.1)

    def test_gyro_has_its_noise_and_its_steps(self, flight: Any) -> None:
        made, readings = flight(), []
        made.run(4.0, lambda _: readings.append(made.vehicle.estimate.gyro_body()))
        samples = np.array(readings[1:])
        assert np.std(samples, axis=0) == pytest.approx((0.003,) * 3, rel=0.15)
        steps = samples / 1.065e-3
        assert steps == pytest.approx(np.round(steps), abs=1e-9)

    def test_quiet_profile_is_quiet(self, flight: Any) -> None:
        made = flight("ant-x", "study")
        made.run(1.0)
        estimate, truth = made.vehicle.estimate, made.vehicle.truth
        assert estimate.gyro_body() == (0.0, 0.0, 0.0)
        assert estimate.accel_body() == truth.accel_body()
        assert estimate.pressure_hpa() == pressure_hpa(truth.altitude_m())

    def test_attitude_is_half_a_tick_late(self, leaning: Any) -> None:
        vehicle = leaning.vehicle
        leaning.autopilot.offboard_attitude(from_euler(-0.2, 0, 0), (0, 0, math.nan), 0.51)
        for _ in range(12):
            before = vehicle.truth.euler()[0]
            vehicle.step()
        now = vehicle.truth.euler()[0]
        assert abs(now - before) > 1e-4
        assert vehicle.estimate.euler()[0] == pytest.approx((now + before) / 2.0, abs=1e-6)

    def test_rates_are_the_filtered_gyro(self, leaning: Any) -> None:
        assert leaning.vehicle.estimate.rates() == pytest.approx(leaning.vehicle.truth.rates(), abs=0.02)

    def test_lateral_accelerometer_reads_the_studys_output(self, leaning: Any) -> None:
        vehicle, d = leaning.vehicle, leaning.vehicle.model.derivatives
        seen, expected = [], []
        for _ in range(250):
            vehicle.step()
            v, p, delta = vehicle.truth.velocity_body()[1], vehicle.truth.rates()[0], vehicle.truth.delta()[0]
            expected.append(d.Yv * v + d.Yp * p + d.Yd * delta)
            seen.append(vehicle.estimate.accel_body()[1])
        assert np.mean(seen) == pytest.approx(np.mean(expected), abs=0.02)

    def test_compass_shows_the_field_from_where_it_looks(self, leaning: Any) -> None:
        field = np.array(leaning.vehicle.estimate.mag_body())
        assert np.linalg.norm(field) == pytest.approx(0.478, abs=0.01)
        level = flight_field = np.array([0.215, 0.006, 0.427])
        assert np.linalg.norm(field - level) > 0.03  # it leans
        assert field[0] == pytest.approx(flight_field[0], abs=0.01)

    def test_barometer_knows_the_standard_atmosphere(self, leaning: Any) -> None:
        assert pressure_hpa(0.0) == pytest.approx(1013.25)
        assert pressure_hpa(1000.0) == pytest.approx(898.75, abs=0.1)
        assert pressure_hpa(488.0) - pressure_hpa(498.0) == pytest.approx(1.13, abs=0.03)
        expected = pressure_hpa(leaning.vehicle.truth.altitude_m())
        assert leaning.vehicle.estimate.pressure_hpa() == pytest.approx(expected, abs=0.1)

    def test_gps_is_near_the_truth_ten_times_a_second(self, leaning: Any) -> None:
        times, errors = [], []
        for _ in range(500):
            leaning.vehicle.step()
            fix = leaning.vehicle.gps()
            if fix.time_us not in times:
                times.append(fix.time_us)
                truth = geodetic(leaning.vehicle.truth.position_ned())
                north = (fix.lat_deg - truth[0]) * 111_319.49
                east = (fix.lon_deg - truth[1]) * 111_319.49 * math.cos(math.radians(truth[0]))
                errors.append((north, east, fix.alt_m - truth[2]))
                assert fix.vel_ned == pytest.approx(leaning.vehicle.truth.velocity_ned(), abs=0.3)
        assert np.diff(times).tolist() == [100_000] * (len(times) - 1)
        assert np.abs(errors).max() < 1.0
        assert np.std(errors) > 0.05
        assert (fix.fix_type, fix.satellites) == (3, 12)

    def test_east_of_the_origin_is_east(self) -> None:
        lat, lon, alt = geodetic((111.31949, 0.0, -5.0))
        assert (lat, lon, alt) == pytest.approx((47.398742, 8.545594, 493.0), abs=1e-9)
        assert geodetic((0.0, 100.0, 0.0))[1] - 8.545594 == pytest.approx(100.0 / (111_319.49 * 0.67691), rel=1e-4)


class TestParameters:
    def test_airframe_sets_its_geometry(self) -> None:
        model = resolve_vehicle("carrier-1")
        table = ParameterTable(airframe_parameters(model, get_profile("sitl")))
        assert table.get("CA_ROTOR_COUNT") == 8
        assert table.get("MAV_TYPE") == 14
        for i, rotor in enumerate(model.airframe.rotors):
            got = [table.get(f"CA_ROTOR{i}_{what}") for what in ("PX", "PY", "PZ", "KM")]
            assert got == pytest.approx([rotor.px_m, rotor.py_m, rotor.pz_m, rotor.km], rel=1e-6)

    def test_rotor_without_moment_is_not_given_px4s_default(self) -> None:
        model = resolve_vehicle("ant-x")
        rotors = (Rotor(0.1, 0.1, 0.0, 0.0), *model.airframe.rotors[1:])
        changed = replace(model, airframe=replace(model.airframe, rotors=rotors))
        assert airframe_parameters(changed, get_profile("sitl"))["CA_ROTOR0_KM"] == 0.0

    def test_hover_thrust_is_the_airframes(self, flight: Any) -> None:
        model = resolve_vehicle("ant-x")
        heavy = replace(model, assumptions=replace(model.assumptions, hover_thrust=0.65))
        made = flight(heavy)
        made.take_off(5.0)
        assert made.autopilot.attitude_sp.thrust == pytest.approx(0.65, abs=0.01)
        assert made.vehicle.truth.position_ned()[2] == pytest.approx(-5.0, abs=0.1)

    @pytest.mark.parametrize("profile", ["sitl", "board"])
    def test_profile_sets_the_filters(self, profile: str) -> None:
        vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile(profile, gyro_cutoff_hz=55.0))
        assert vehicle.parameters.get("IMU_GYRO_CUTOFF") == 55.0
        assert vehicle.parameters.get("IMU_DGYRO_CUTOFF") == 20.0

    def test_plant_keeps_its_body_whatever_px4_is_told(self, flight: Any) -> None:
        # PX4 left with a longer frame than the one that flies: its pitch column shrinks, so pitch reads less
        made = flight()
        made.parameters.set("CA_ROTOR0_PX", 0.12)
        assert made.vehicle.plant.settings["inverse"][0, 1, 0] == pytest.approx(0.35355, abs=1e-5)

    @pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e30])
    def test_nothing_a_ground_station_may_set_can_stop_the_vehicle(self, flight: Any, value: float) -> None:
        names = [n for n in ParameterTable().names if ParameterTable().spec(n).type == "REAL32"]
        names = [n for n in names if n.startswith(("CA_ROTOR0", "COM_", "FD_", "IMU_", "LNDMC", "MC_", "MIS", "THR"))]
        made = flight()
        made.take_off(3.0, settle_s=0.5)
        made.go_offboard()
        for name in names:
            made.parameters.set(name, value)
            made.run(0.02, lambda _: made.autopilot.offboard_attitude((1, 0, 0, 0), (0, 0, math.nan), 0.5))
            assert all(0.0 <= motor <= 1.0 for motor in made.autopilot.motors), name
            made.parameters.reset(name)
        made.autopilot.command_mode(Mode.LOITER)
        made.run(0.5)
        assert np.isfinite(made.vehicle.plant.x).all()


def test_battery_gives_under_load(flight: Any) -> None:
    made = flight()
    idle = made.vehicle.battery()
    made.take_off(3.0)
    loaded = made.vehicle.battery()
    assert loaded.voltage_v < idle.voltage_v
    assert loaded.current_a > idle.current_a == 0.0
    assert loaded.remaining == 1.0


def test_the_machine_code_is_kept_under_this_version(flight: Any) -> None:
    from sitl.compiled import cache_folder, is_warm

    flight().run(0.01)
    assert is_warm()
    assert cache_folder().name.startswith("laws-")


WARM = """
import json
from numba.core.dispatcher import Dispatcher
from sitl.modes import Mode
from sitl.profile import get_profile
from sitl.vehicle import Vehicle, warm_up
from sitl.vehicle_spec import resolve_vehicle

taken, compile = [], Dispatcher.compile
Dispatcher.compile = lambda law, types: (taken.append(law.__name__), compile(law, types))[1]
warm_up(resolve_vehicle("ant-x"), get_profile("sitl"))
before, taken = taken, []
vehicle = Vehicle(resolve_vehicle("adam-0"), get_profile("sitl"), seed=3)
for _ in range(2500):
    vehicle.step()
autopilot = vehicle.autopilot
said = [autopilot.command_arm(True), autopilot.command_takeoff(None)]
for mode in (Mode.LOITER, Mode.RTL, Mode.LAND):
    for _ in range(2500):
        vehicle.step()
    said.append(autopilot.command_mode(mode))
print(json.dumps({"before": before, "later": taken, "said": [int(one) for one in said]}))
"""


def test_no_law_is_compiled_or_loaded_in_flight() -> None:
    """It takes up to ten seconds, in which a vehicle that flies by the clock would stand still."""
    done = subprocess.run([sys.executable, "-c", WARM], cwd=ROOT, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout)
    assert {"control_tick", "plant_tick", "position_tick"} <= set(told["before"])
    assert told["later"] == []
    assert told["said"] == [0] * 5
