"""Faults of plant and sensors against what the model says they must do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sitl.actuators import MAX_MOTORS
from sitl.body import Body
from sitl.faults import AXES, BatterySag, Faults, Gust, GyroFault, LoopDelay, MotorFault
from sitl.modes import Mode
from sitl.plant import G_M_S2, MAX_DELAY_TICKS
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

MODEL = resolve_vehicle("ant-x")
EXACT = get_profile("sitl", motor_lag_s=0.0, gyro_noise_rad_s=0.0, gyro_quantum_rad_s=0.0)


def hovering(profile: Any = EXACT, height_m: float = 50.0) -> Body:
    """A body in the air, level and still, motors at hover thrust; `rest` holds it there."""
    body = Body(MODEL, profile)
    body.plant.x[2] = -height_m
    return body


def hover(body: Body) -> list[float]:
    return [MODEL.assumptions.hover_thrust] * len(MODEL.airframe.rotors)


def change(body: Body, motors: list[float]) -> np.ndarray:
    """Mean acceleration of the state over one tick, per second."""
    before = body.plant.x.copy()
    body.step(motors)
    return (body.plant.x - before) / (body.tick_us * 1e-6)


V, P = 4, 10
"""Places in the plant's state: sideways speed and roll rate."""


class TestGust:
    def test_the_force_is_the_acceleration_and_the_accelerometer_feels_it(self) -> None:
        body = hovering()
        body.faults.begin(0, Gust(side_m_s2=1.5))
        rate = change(body, hover(body))
        assert rate[V] == pytest.approx(1.5, rel=2e-3)  # Yv v has begun to brake within the tick
        assert body.plant.force[1] == pytest.approx(1.5, rel=2e-3)

    def test_the_moment_is_the_angular_acceleration(self) -> None:
        body = hovering()
        body.faults.begin(0, Gust(roll_rad_s2=3.0))
        assert change(body, hover(body))[P] == pytest.approx(3.0, rel=0.01)

    def test_wind_is_the_vehicles_own_speed_the_other_way(self) -> None:
        blown, moving = hovering(), hovering()
        blown.faults.begin(0, Gust(wind_m_s=4.0))
        moving.plant.x[V] = -4.0
        a, b = change(blown, hover(blown)), change(moving, hover(moving))
        assert a[V] == pytest.approx(b[V], rel=0.01)
        assert a[P] == pytest.approx(b[P], rel=0.01)
        assert a[V] == pytest.approx(-MODEL.derivatives.Yv * 4.0, rel=0.02)

    def test_a_constant_wind_carries_the_free_vehicle_along_as_the_model_says(self) -> None:
        """v' = Yv (v - wind) while roll is kept level: an exponential with Yv's time constant."""
        body = hovering(height_m=400.0)
        body.faults.begin(0, Gust(wind_m_s=2.0))
        for _ in range(500):
            body.step(hover(body))
            body.plant.x[6:10] = 1.0, 0.0, 0.0, 0.0
            body.plant.x[10:13] = 0.0
        # Yp p of a rate that is taken away again at every tick's end is left
        expected = 2.0 * (1.0 - math.exp(MODEL.derivatives.Yv * 2.0))
        assert body.plant.x[V] == pytest.approx(expected, rel=0.03)

    def test_gusts_add_up_and_go(self) -> None:
        body = hovering()
        body.faults.begin(0, Gust(side_m_s2=1.5))
        body.faults.begin(1, Gust(side_m_s2=-1.5))
        assert abs(change(body, hover(body))[V]) < 1e-9
        body.faults.end(1)
        body.faults.end(0)
        body.faults.end(7)  # was never in force
        assert abs(change(body, hover(body))[V]) < 1e-9

    def test_in_the_linear_form_too(self) -> None:
        vehicle = Vehicle(MODEL, get_profile("study"))
        vehicle.plant.x[2] = -50.0
        vehicle.faults.begin(0, Gust(side_m_s2=2.0))
        vehicle.step()
        assert vehicle.plant.x[V] == pytest.approx(2.0 * vehicle.tick_us * 1e-6, rel=1e-3)


class TestMotors:
    @pytest.mark.parametrize("motor", range(4))
    def test_a_weak_motor_rolls_the_vehicle_as_its_place_says(self, motor: int) -> None:
        """Half of motor n is gone: the missing thrust, at its arm, in units of the mix."""
        body = hovering()
        body.faults.begin(0, MotorFault(motor, efficiency=0.5))
        rate = change(body, hover(body))
        rotors = MODEL.airframe.rotors
        # the pseudo-inverse of a symmetric quad's mix: arms over the root mean square of all four
        side = -math.copysign(1.0, rotors[motor].py_m)
        torque = -0.5 * MODEL.assumptions.hover_thrust * side * math.sqrt(0.5) / 2.0
        lost = sum(body.plant.settings["inverse"][0, 0, :4] * [0.5 if n == motor else 0.0 for n in range(4)]) * -0.5
        assert torque == pytest.approx(lost, rel=0.02)
        assert rate[P] == pytest.approx(MODEL.derivatives.Ld * torque, rel=0.03)
        assert rate[5] == pytest.approx(G_M_S2 / 8.0, rel=0.02)  # an eighth of the thrust is missing

    def test_a_motor_that_is_out_runs_down_with_its_lag(self) -> None:
        body = hovering(get_profile("sitl", motor_lag_s=0.025))
        body.plant.state["motors"][0, :4] = MODEL.assumptions.hover_thrust
        body.faults.begin(0, MotorFault(1, efficiency=0.0))
        for _ in range(25):
            body.step(hover(body))
        left = body.plant.state["motors"][0, :4] / MODEL.assumptions.hover_thrust
        assert left == pytest.approx([1.0, math.exp(-0.1 / 0.025), 1.0, 1.0])

    def test_a_limit_cuts_what_is_above_it_only(self) -> None:
        body = hovering()
        body.faults.begin(0, MotorFault(most=0.45))
        body.step([0.2, 0.4, 0.6, 0.8])
        assert body.plant.state["motors"][0, :4] == pytest.approx([0.2, 0.4, 0.45, 0.45])

    def test_a_sagging_battery_takes_thrust_by_the_square_of_its_voltage(self) -> None:
        body = hovering()
        body.faults.begin(0, BatterySag(0.2))
        assert change(body, hover(body))[5] == pytest.approx(G_M_S2 * (1.0 - 0.64), rel=0.01)
        assert body.faults.voltage == pytest.approx(0.8)
        body.faults.end(0)
        assert body.plant.weaken is None

    def test_the_battery_says_so(self) -> None:
        vehicle = Vehicle(MODEL, EXACT)
        before = vehicle.battery().voltage_v
        vehicle.faults.begin(0, BatterySag(0.2))
        assert vehicle.battery().voltage_v == pytest.approx(0.8 * before)

    def test_weaknesses_multiply_and_the_lowest_limit_counts(self) -> None:
        body = hovering()
        for number, fault in enumerate(
            (
                MotorFault(0, efficiency=0.8),
                MotorFault(None, efficiency=0.5),
                MotorFault(1, most=0.3),
                MotorFault(most=0.4),
            )
        ):
            body.faults.begin(number, fault)
        body.step([1.0, 1.0, 1.0, 0.2])
        assert body.plant.state["motors"][0, :4] == pytest.approx([0.4, 0.3, 0.4, 0.1])


class TestLoopDelay:
    @pytest.mark.parametrize("own", [0, 3])
    def test_commands_come_later_by_so_many_ticks_and_none_is_lost(self, own: int) -> None:
        vehicle = Vehicle(MODEL, get_profile("sitl", motor_lag_s=0.0, transport_delay_ticks=own))
        plant, seen = vehicle.plant, []

        def step(n: int) -> None:
            plant.step(np.full(MAX_MOTORS, 1e-3 * n))
            seen.append(round(1e3 * float(plant.state["motors"][0, 0])))

        for n in range(1, 11):
            step(n)
        vehicle.faults.begin(0, LoopDelay(4))
        for n in range(11, 21):
            step(n)
        vehicle.faults.end(0)
        step(21)
        late = [max(0, n - own) for n in range(1, 11)]
        held = [max(10 - own, n - own - 4) for n in range(11, 21)]
        assert seen == [*late, *held, 21 - own]

    def test_it_ends_at_what_the_plant_can_remember(self) -> None:
        body = hovering()
        body.faults.begin(0, LoopDelay(50))
        body.faults.begin(1, LoopDelay(50))
        assert int(body.plant.settings["delay_ticks"][0]) == MAX_DELAY_TICKS


class TestGyro:
    def rates(self, *faults: GyroFault, ticks: int = 4000, profile: Any = EXACT) -> np.ndarray:
        vehicle = Vehicle(MODEL, profile, seed=5)
        for number, fault in enumerate(faults):
            vehicle.faults.begin(number, fault)
        return np.array([(vehicle.step(), vehicle.estimate.gyro_body())[1] for _ in range(ticks)])

    def test_a_bias_is_added_on_its_axes_alone(self) -> None:
        rates = self.rates(GyroFault(AXES["roll"], bias_rad_s=0.1), GyroFault(AXES["all"], bias_rad_s=0.02), ticks=50)
        assert rates == pytest.approx(np.tile([0.12, 0.02, 0.02], (50, 1)), abs=1e-6)

    def test_noise_has_the_deviation_asked_for(self) -> None:
        rates = self.rates(GyroFault(AXES["all"], noise_rad_s=0.05))
        assert rates.std(axis=0) == pytest.approx([0.05] * 3, rel=0.05)
        assert abs(rates.mean(axis=0)).max() < 4 * 0.05 / math.sqrt(len(rates))

    def test_a_share_of_the_samples_is_lost_and_the_one_before_stands(self) -> None:
        noisy = get_profile("sitl", gyro_quantum_rad_s=0.0)
        rates = self.rates(GyroFault(AXES["all"], lost=0.3), profile=noisy)
        stood = (np.diff(rates, axis=0) == 0.0).all(axis=1)
        assert stood.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.3 * 0.7 / len(stood)))

    def test_a_stuck_axis_says_the_same_for_ever_and_the_others_go_on(self) -> None:
        noisy = get_profile("sitl", gyro_quantum_rad_s=0.0)
        rates = self.rates(GyroFault(AXES["pitch"], lost=1.0), profile=noisy, ticks=200)
        assert len(np.unique(rates[:, 1])) == 1
        assert all(len(np.unique(rates[:, axis])) == 200 for axis in (0, 2))

    def test_the_same_seed_gives_the_same_and_another_another(self) -> None:
        fault = GyroFault(AXES["all"], noise_rad_s=0.05, lost=0.2)
        assert (self.rates(fault, ticks=100) == self.rates(fault, ticks=100)).all()
        body = hovering()
        again = Faults(body.plant, body.sensors, seed=6)
        again.begin(0, fault)
        assert body.sensors.gyro_fault is not None
        first = [body.sensors.gyro_fault.added() for _ in range(5)]
        again.begin(1, fault)
        again.end(0)
        assert (np.array(first) != [body.sensors.gyro_fault.added() for _ in range(5)]).all()

    def test_a_fault_leaves_the_sensors_own_noise_as_it_is(self) -> None:
        """What follows after a fault is what would have followed without it."""
        plain, faulty = (Vehicle(MODEL, get_profile("sitl"), seed=3) for _ in range(2))
        faulty.faults.begin(0, GyroFault(AXES["all"], noise_rad_s=0.1, lost=0.5))
        for _ in range(1500):
            plain.step()
            faulty.step()
        faulty.faults.end(0)
        plain.step()
        faulty.step()
        assert faulty.estimate.gyro_body() == plain.estimate.gyro_body()


class TestRestart:
    def test_in_flight_the_motors_stop_and_it_comes_back_disarmed(self) -> None:
        vehicle = Vehicle(MODEL, get_profile("sitl"))
        while not vehicle.autopilot.ready:
            vehicle.step()
        vehicle.autopilot.command_arm(True)
        vehicle.autopilot.command_takeoff(None)
        while vehicle.autopilot.mode is not Mode.LOITER:
            vehicle.step()
        vehicle.parameters.set("MC_ROLL_P", 5.0)
        vehicle.autopilot.restart()
        assert -vehicle.truth.position_ned()[2] > 2.0
        climbing = vehicle.truth.velocity_ned()[2]
        for _ in range(round(0.5e6 / vehicle.tick_us)):
            vehicle.step()
            assert not any(vehicle.autopilot.motors)
        assert not vehicle.autopilot.armed
        assert not vehicle.autopilot.healthy
        # a stone in air that brakes it, let go when the motors have run down
        damping, fallen_s = MODEL.assumptions.heave_damping_1_s, 0.5 - MODEL.assumptions.motor_lag_s
        braked = math.exp(-damping * fallen_s)
        expected = climbing * braked + G_M_S2 / damping * (1.0 - braked)
        assert vehicle.truth.velocity_ned()[2] == pytest.approx(expected, rel=0.02)
        while vehicle.time_us < 60_000_000 and not vehicle.autopilot.ready:
            vehicle.step()
        assert vehicle.autopilot.ready
        assert vehicle.autopilot.mode is Mode.LOITER
        assert vehicle.parameters.get("MC_ROLL_P") == 5.0
