from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sitl.actuators import MAX_MOTORS, PITCH, ROLL, THRUST, YAW, RotorEffect, normalised_mix
from sitl.airframe import Assumptions, load_airframe
from sitl.plant import G_M_S2, Plant
from sitl.rotation import from_euler

AIRFRAMES = ("ant-x", "ant-r", "carrier-1", "adam-0")
U, V, W, P, Q, R = 3, 4, 5, 10, 11, 12
HOVER = 0.5


class Rig:
    """A plant in the air with its thrust at hover, moved by torques instead of motor commands."""

    def __init__(
        self,
        airframe: str = "ant-x",
        *,
        tick_us: int = 4000,
        lag_s: float = 0.0,
        height_m: float = 1000.0,
        **plant: Any,
    ) -> None:
        body = load_airframe(airframe)
        self.derivatives = body.derivatives
        self.mix = normalised_mix([RotorEffect((r.px_m, r.py_m, r.pz_m), km=r.km) for r in body.rotors])
        assumptions = plant.pop("assumptions", Assumptions())
        self.plant = Plant(self.derivatives, assumptions, self.mix, tick_us=tick_us, motor_lag_s=lag_s, **plant)
        self.plant.x[2] = -height_m
        self.dt_s = tick_us * 1e-6
        self.plant.state["motors"][0, : self.mix.motors] = HOVER

    def commands(self, *torque: float, thrust: float = HOVER) -> np.ndarray:
        motors = np.zeros(MAX_MOTORS)
        motors[: self.mix.motors] = self.mix.columns @ (*torque, thrust)
        return motors

    def step(self, *torque: float, thrust: float = HOVER) -> None:
        self.plant.step(self.commands(*(torque or (0.0, 0.0, 0.0)), thrust=thrust))

    def lateral(self) -> list[float]:
        return [self.plant.x[V], self.plant.x[P], self.plant.euler()[0]]

    def matrices(self) -> tuple[np.ndarray, np.ndarray]:
        """A and B of the study's equation 2.2, states v, p, phi."""
        d = self.derivatives
        return np.array([[d.Yv, d.Yp, 9.81], [d.Lv, d.Lp, 0.0], [0.0, 1.0, 0.0]]), np.array([d.Yd, d.Ld, 0.0])


def held_input(A: np.ndarray, B: np.ndarray, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """x_k+1 = Phi x_k + Gamma u_k of x' = A x + B u with u held, by one matrix exponential."""
    n = len(A)
    both = scipy.linalg.expm(np.block([[A, B.reshape(n, 1)], [np.zeros((1, n + 1))]]) * dt_s)
    return both[:n, :n], both[:n, n]


class TestStudysModel:
    @pytest.mark.parametrize("airframe", AIRFRAMES)
    @pytest.mark.parametrize("tick_us", [1000, 4000])
    def test_lateral_motion_is_the_matrix_exponential(self, airframe: str, tick_us: int) -> None:
        rig = Rig(airframe, tick_us=tick_us, linear=True)
        phi, gamma = held_input(*rig.matrices(), rig.dt_s)
        state = np.zeros(3)
        inputs = np.random.default_rng(0).uniform(-0.1, 0.1, 500)
        for u in inputs:
            rig.step(u, 0.0, 0.0)
            state = phi @ state + gamma * u
            assert rig.lateral() == pytest.approx(state, abs=1e-9, rel=1e-9)
        assert np.abs(state).max() > 0.1

    @pytest.mark.parametrize("airframe", AIRFRAMES)
    @pytest.mark.parametrize(
        ("lag_s", "error"), [(0.001, 1e-5), (0.005, 5e-8), (0.010, 5e-9), (0.025, 1e-9), (0.050, 1e-9)]
    )
    def test_motor_lag_is_one_more_state_of_it(self, airframe: str, lag_s: float, error: float) -> None:
        # of fourth order in step / lag: what is left at 25 ms is rounding
        rig = Rig(airframe, lag_s=lag_s, linear=True)
        A, B = rig.matrices()
        A = np.block([[A, B.reshape(3, 1)], [np.zeros((1, 3)), np.array([[-1.0 / lag_s]])]])
        phi, gamma = held_input(A, np.array([0.0, 0.0, 0.0, 1.0 / lag_s]), rig.dt_s)
        states = [np.zeros(4)]
        seen = [rig.lateral()]
        for u in np.random.default_rng(0).uniform(-0.1, 0.1, 500):
            rig.step(u, 0.0, 0.0)
            states.append(phi @ states[-1] + gamma * u)
            seen.append(rig.lateral())
            assert rig.plant.delta[0] == pytest.approx(states[-1][3], abs=1e-12)
        expected = np.array(states)[:, :3]
        assert (np.abs(np.array(seen) - expected).max(axis=0) / np.abs(expected).max(axis=0)).max() < error

    @pytest.mark.parametrize("airframe", AIRFRAMES)
    def test_accelerometer_reads_the_studys_second_output(self, airframe: str) -> None:
        rig = Rig(airframe, tick_us=1000, linear=True)
        A, B = rig.matrices()
        # integrals of the states ride along, so that the mean over the tick is exact
        A6 = np.block([[A, np.zeros((3, 3))], [np.eye(3), np.zeros((3, 3))]])
        phi, gamma = held_input(A6, np.concatenate([B, np.zeros(3)]), rig.dt_s)
        state = np.zeros(3)
        d = rig.derivatives
        for u in np.random.default_rng(1).uniform(-0.1, 0.1, 300):
            rig.step(u, 0.0, 0.0)
            whole = phi @ np.concatenate([state, np.zeros(3)]) + gamma * u
            state, mean = whole[:3], whole[3:] / rig.dt_s
            assert rig.plant.force[1] == pytest.approx(d.Yv * mean[0] + d.Yp * mean[1] + d.Yd * u, abs=1e-9)

    @pytest.mark.parametrize("airframe", AIRFRAMES)
    def test_full_form_reduces_to_it_for_small_angles(self, airframe: str) -> None:
        errors = []
        for size in (1e-2, 1e-3):
            full, linear = Rig(airframe), Rig(airframe, linear=True)
            for u in np.random.default_rng(2).uniform(-size, size, 250):
                full.step(u, 0.0, 0.0)
                linear.step(u, 0.0, 0.0)
            errors.append(np.abs(np.array(full.lateral()) - linear.lateral()).max() / size)
        assert errors[1] < 1e-3
        assert errors[1] < errors[0] / 50.0

    def test_phi_of_the_linear_form_is_free_to_grow(self) -> None:
        rig = Rig(linear=True)
        rig.plant.x[P] = 20.0
        for _ in range(100):
            rig.step()
        assert rig.plant.euler()[0] > math.pi


class TestLongitudinal:
    @pytest.mark.parametrize("linear", [True, False])
    @pytest.mark.parametrize("lag_s", [0.0, 0.02])
    def test_pitching_mirrors_rolling(self, linear: bool, lag_s: float) -> None:
        roll, pitch = Rig(linear=linear, lag_s=lag_s), Rig(linear=linear, lag_s=lag_s)
        for u in np.random.default_rng(3).uniform(-0.3, 0.3, 250):
            roll.step(u, 0.0, 0.0)
            pitch.step(0.0, u, 0.0)
            a, b = roll.plant, pitch.plant
            assert (a.x[V], a.x[P], a.euler()[0]) == pytest.approx((-b.x[U], b.x[Q], b.euler()[1]), abs=1e-9)
            assert (a.force[1], a.x[1], a.x[W]) == pytest.approx((-b.force[0], -b.x[0], b.x[W]), abs=1e-9)
        assert abs(a.euler()[0]) > 0.02

    def test_both_at_once_do_not_meet_in_the_linear_form(self) -> None:
        alone, both = Rig(linear=True), Rig(linear=True)
        for u, v in np.random.default_rng(4).uniform(-0.3, 0.3, (100, 2)):
            alone.step(u, 0.0, 0.0)
            both.step(u, v, 0.0)
        assert both.lateral() == pytest.approx(alone.lateral(), abs=1e-12)


class TestVerticalAndYaw:
    def test_hover_thrust_carries_the_weight(self) -> None:
        rig = Rig()
        for _ in range(250):
            rig.step()
        assert rig.plant.velocity_ned() == pytest.approx((0.0, 0.0, 0.0), abs=1e-11)
        assert rig.plant.force == pytest.approx((0.0, 0.0, -G_M_S2), abs=1e-11)

    @pytest.mark.parametrize("linear", [True, False])
    def test_climb_speed_approaches_its_end_with_the_heave_damping(self, linear: bool) -> None:
        rig = Rig(linear=linear)
        for _ in range(500):
            rig.step(thrust=0.55)
        end = -G_M_S2 * 0.1 / 0.3
        assert rig.plant.velocity_ned()[2] == pytest.approx(end * (1.0 - math.exp(-0.3 * 2.0)), rel=1e-9)

    def test_yaw_rate_is_first_order(self) -> None:
        rig = Rig()
        for _ in range(250):
            rig.step(0.0, 0.0, 0.05)
        assert rig.plant.x[R] == pytest.approx(20.0 * 0.05 * (1.0 - math.exp(-1.0)), rel=1e-9)
        assert rig.plant.euler()[2] == pytest.approx(20.0 * 0.05 * math.exp(-1.0), rel=1e-6)

    def test_positive_torques_roll_right_pitch_up_yaw_right_and_thrust_is_up(self) -> None:
        for axis, rate in ((ROLL, P), (PITCH, Q), (YAW, R)):
            rig = Rig()
            rig.step(*(0.1 if i == axis else 0.0 for i in range(3)))
            assert rig.plant.x[rate] > 0.0
        rig = Rig()
        rig.step(thrust=0.7)
        assert rig.plant.velocity_ned()[2] < 0.0
        assert rig.plant.delta[THRUST] == pytest.approx(0.7)

    def test_free_fall_reads_nothing(self) -> None:
        rig = Rig(assumptions=Assumptions(heave_damping_1_s=0.0))
        for _ in range(100):
            rig.step(thrust=0.0)
        assert rig.plant.force == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
        assert rig.plant.velocity_ned()[2] == pytest.approx(9.81 * 0.4, rel=1e-12)


class TestMotionAndMeasurement:
    @settings(deadline=None, max_examples=10)
    @given(seed=st.integers(0, 1000))
    def test_integrated_accelerometer_is_the_velocity(self, seed: int) -> None:
        rig = Rig(tick_us=1000, lag_s=0.01)
        velocity = np.zeros(3)
        rng = np.random.default_rng(seed)
        # a wandering torque, so that the vehicle turns in all axes and moves
        torque = np.zeros(3)
        for _ in range(1000):
            torque += rng.normal(0.0, 0.01, 3) - 0.02 * torque
            before = rig.plant.quat.copy()
            rig.step(*torque)
            middle = before + rig.plant.quat
            w, x, y, z = middle / np.linalg.norm(middle)
            felt = Rotation.from_quat([x, y, z, w]).apply(rig.plant.force)
            velocity += (felt + np.array([0.0, 0.0, 9.81])) * 1e-3
        assert rig.plant.velocity_ned() == pytest.approx(velocity, abs=2e-3)
        assert np.linalg.norm(velocity) > 0.05

    def test_integrated_velocity_is_the_position(self) -> None:
        rig = Rig(tick_us=1000)
        position = np.array(rig.plant.position_ned())
        for u, v in np.random.default_rng(5).uniform(-0.2, 0.2, (2000, 2)):
            before = np.array(rig.plant.velocity_ned())
            rig.step(u, v, 0.02)
            position += (before + rig.plant.velocity_ned()) * 0.5e-3
        assert rig.plant.position_ned() == pytest.approx(position, abs=1e-4)

    def test_velocity_in_the_world_is_body_velocity_turned(self) -> None:
        rig = Rig()
        for u, v in np.random.default_rng(6).uniform(-0.3, 0.3, (100, 2)):
            rig.step(u, v, 0.1)
        w, x, y, z = rig.plant.quat
        expected = Rotation.from_quat([x, y, z, w]).apply(rig.plant.x[U : W + 1])
        assert rig.plant.velocity_ned() == pytest.approx(expected, abs=1e-12)

    def test_quaternion_keeps_its_length_and_turns_as_the_rates_say(self) -> None:
        rig = Rig()
        rng = np.random.default_rng(7)
        for _ in range(1000):
            before, rates = rig.plant.quat.copy(), rig.plant.rates.copy()
            rig.step(*rng.uniform(-0.5, 0.5, 3))
            assert np.linalg.norm(rig.plant.quat) == pytest.approx(1.0, abs=1e-12)
            w, x, y, z = before
            a = Rotation.from_quat([x, y, z, w])
            w, x, y, z = rig.plant.quat
            turned = (a.inv() * Rotation.from_quat([x, y, z, w])).as_rotvec()
            assert turned == pytest.approx((rates + rig.plant.rates) / 2.0 * rig.dt_s, abs=2e-3)


class TestActuation:
    @pytest.mark.parametrize("ticks", [1, 3, 64])
    def test_transport_delay_is_that_many_ticks_exactly(self, ticks: int) -> None:
        now, later = Rig(linear=True), Rig(linear=True, delay_ticks=ticks)
        later.plant.state["queue"][0][:] = later.commands(0.0, 0.0, 0.0)
        inputs = np.random.default_rng(8).uniform(-0.2, 0.2, 150)
        seen = []
        for u in inputs:
            now.step(u, 0.0, 0.0)
            seen.append(now.plant.x[[V, P, 6]].tolist())
        for k, u in enumerate(inputs):
            later.step(u, 0.0, 0.0)
            expected = [0.0, 0.0, 0.0] if k < ticks else seen[k - ticks]
            assert later.plant.x[[V, P, 6]].tolist() == pytest.approx(expected, abs=1e-12)

    @pytest.mark.parametrize("ticks", [-1, 65])
    def test_delay_out_of_range_is_refused(self, ticks: int) -> None:
        with pytest.raises(ValueError, match=str(ticks)):
            Rig(delay_ticks=ticks)

    @pytest.mark.parametrize("lag_s", [0.001, 0.025, 0.5])
    def test_motors_follow_exponentially(self, lag_s: float) -> None:
        rig = Rig(lag_s=lag_s)
        for k in range(1, 30):
            rig.step(thrust=1.0)
            expected = 1.0 - 0.5 * math.exp(-k * 0.004 / lag_s)
            assert rig.plant.state["motors"][0, :4] == pytest.approx([expected] * 4, abs=1e-12)
            assert rig.plant.delta == pytest.approx((0.0, 0.0, 0.0, expected), abs=1e-12)

    def test_vanishing_lag_is_no_lag(self) -> None:
        with_lag, without = Rig(lag_s=1e-5), Rig(lag_s=0.0)
        for u in np.random.default_rng(9).uniform(-0.1, 0.1, 250):
            with_lag.step(u, 0.0, 0.0)
            without.step(u, 0.0, 0.0)
        assert with_lag.lateral() == pytest.approx(without.lateral(), abs=0.05)


class TestGround:
    def rest(self, ticks: int = 500, *, linear: bool = False, thrust: float = 0.0, lag_s: float = 0.025) -> Rig:
        rig = Rig(height_m=0.0, linear=linear, lag_s=lag_s)
        rig.plant.state["motors"][:] = thrust
        for _ in range(ticks):
            rig.step(thrust=thrust)
        return rig

    @pytest.mark.parametrize("linear", [True, False])
    def test_stays_exactly_where_it_is_and_reads_exactly_its_weight(self, linear: bool) -> None:
        rig = self.rest(linear=linear)
        assert rig.plant.position_ned() == (0.0, 0.0, 0.0)
        assert rig.plant.velocity_ned() == (0.0, 0.0, 0.0)
        assert rig.plant.euler() == (0.0, 0.0, 0.0)
        assert rig.plant.rates.tolist() == [0.0, 0.0, 0.0]
        assert rig.plant.force.tolist() == [0.0, 0.0, -G_M_S2]

    def test_thrust_below_weight_does_not_lift_it(self) -> None:
        rig = self.rest(1500, thrust=0.45)
        assert abs(rig.plant.x[2]) < 0.03
        assert rig.plant.velocity_ned() == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
        assert rig.plant.force[2] == pytest.approx(-G_M_S2, abs=1e-5)

    def test_thrust_above_weight_does(self) -> None:
        assert self.rest(500, thrust=0.6).plant.x[2] < -2.0

    @pytest.mark.parametrize("speed_m_s", [0.3, 0.7, 3.0])
    def test_what_comes_down_stays_down(self, speed_m_s: float) -> None:
        rig = Rig(height_m=1.0)
        rig.plant.x[W] = speed_m_s
        deepest = 0.0
        for k in range(2000):
            rig.step(thrust=0.49 if k < 200 else 0.0)
            deepest = max(deepest, float(rig.plant.x[2]))
        assert deepest < 0.25
        assert rig.plant.position_ned()[2] == pytest.approx(0.0, abs=1e-3)
        assert rig.plant.force[2] == pytest.approx(-G_M_S2, abs=1e-3)

    @pytest.mark.parametrize("tilt", [(0.5, 0.0), (-0.3, 0.4), (2.5, 0.0)])
    def test_it_comes_to_lie_level(self, tilt: tuple[float, float]) -> None:
        rig = Rig(height_m=0.5)
        rig.plant.x[6:10] = from_euler(*tilt, 0.7)
        rig.plant.state["motors"][:] = 0.0
        for _ in range(1500):
            rig.step(thrust=0.0)
        assert rig.plant.euler()[:2] == pytest.approx((0.0, 0.0), abs=1e-3)
        assert rig.plant.velocity_ned() == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)

    def test_it_slides_to_a_stop(self) -> None:
        rig = Rig(height_m=0.0)
        rig.plant.x[U], rig.plant.x[V] = 1.0, -2.0
        for _ in range(1000):
            rig.step(thrust=0.0)
        assert rig.plant.velocity_ned() == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


class TestLost:
    @pytest.mark.parametrize("linear", [True, False])
    @pytest.mark.parametrize("torque", [1e30, -1e6, math.inf, math.nan])
    def test_motion_without_sense_ends_upside_down_and_finite(self, linear: bool, torque: float) -> None:
        rig = Rig(linear=linear, height_m=20.0, lag_s=0.025)
        rig.step()
        motors = np.full(MAX_MOTORS, torque)
        motors[0] = 0.5
        for _ in range(200):
            rig.plant.step(motors)
        assert rig.plant.lost
        assert abs(rig.plant.euler()[0]) == pytest.approx(math.pi)
        assert rig.plant.velocity_ned() == (0.0, 0.0, 0.0)
        assert rig.plant.rates.tolist() == [0.0, 0.0, 0.0]
        assert np.isfinite(rig.plant.x).all()
        assert np.isfinite(rig.plant.quat).all()
        assert np.isfinite(rig.plant.force).all()
        assert np.isfinite(rig.plant.delta).all()

    def test_anything_that_flies_is_not(self) -> None:
        rig = Rig(height_m=5000.0)
        for k in range(2000):
            rig.step(0.7 if k % 50 < 25 else -0.7, 0.7, 0.3, thrust=0.0)
        assert not rig.plant.lost


def test_same_commands_same_bytes() -> None:
    states = []
    for _ in range(2):
        rig = Rig(lag_s=0.025, delay_ticks=2)
        for torque in np.random.default_rng(10).uniform(-0.3, 0.3, (200, 3)):
            rig.step(*torque)
        states.append(rig.plant.state.tobytes())
    assert states[0] == states[1]
