from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sitl.control_settings import position_settings, position_ticks
from sitl.parameters import ParameterTable
from sitl.position_control import POSITION_INPUT, POSITION_STATE, position_tick
from sitl.profile import get_profile
from sitl.rotation import to_euler, to_world

G = 9.80665
HERE = (0.0, 0.0, 0.0)


class Controller:
    """The position controller alone; position and velocity come from the test."""

    def __init__(self, **parameters: float) -> None:
        self.settings = position_settings(ParameterTable(parameters), get_profile("sitl"))
        self.input = np.zeros(1, POSITION_INPUT)
        self.state = np.zeros(1, POSITION_STATE)

    def run(self, position: Any = HERE, velocity: Any = HERE, times: int = 1, **request: Any) -> None:
        for name, value in request.items():
            self.input[name][0] = value
        for _ in range(times):
            position_tick(self.settings, self.input, self.state, np.array(position, float), np.array(velocity, float))

    def __getitem__(self, field: str) -> Any:
        return self.state[field][0]

    @property
    def thrust(self) -> float:
        return float(self["thrust_sp"])

    def thrust_vector(self) -> np.ndarray:
        """Wanted thrust in the world, NED, up negative."""
        return -self.thrust * np.array(to_world(tuple(self["quat_sp"].tolist()), (0.0, 0.0, 1.0)))


class TestAtTheSetPoint:
    def test_hovers_level_with_hover_thrust(self) -> None:
        controller = Controller(MPC_THR_HOVER=0.42)
        controller.run()
        assert controller.thrust == pytest.approx(0.42, rel=1e-6)
        assert controller["quat_sp"] == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-12)

    @pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5, math.pi])
    def test_keeps_its_heading(self, yaw: float) -> None:
        controller = Controller()
        controller.run(yaw_sp=yaw)
        assert math.remainder(to_euler(tuple(controller["quat_sp"].tolist()))[2] - yaw, math.tau) == pytest.approx(
            0.0, abs=1e-9
        )

    def test_on_the_ground_it_gives_no_thrust_and_forgets(self) -> None:
        controller = Controller()
        controller.run(position=(1.0, 1.0, 1.0), times=50)
        assert controller["vel_int"].any()
        controller.run(position=(1.0, 1.0, 1.0), idle=True)
        assert controller.thrust == 0.0
        assert not controller["vel_int"].any()


class TestGains:
    def test_position_error_becomes_a_speed(self) -> None:
        controller = Controller()
        controller.run(position=(1.0, -2.0, 0.5))
        assert controller["vel_sp"] == pytest.approx((-0.95, 1.9, -0.5), rel=1e-6)

    def test_speed_error_becomes_an_acceleration(self) -> None:
        controller = Controller(MPC_XY_VEL_I_ACC=0.0, MPC_Z_VEL_I_ACC=0.0)
        controller.run(velocity=(0.5, -0.2, 0.1))
        assert controller["acc_sp"] == pytest.approx((-1.8 * 0.5, 1.8 * 0.2, -4.0 * 0.1), rel=1e-6)

    def test_d_acts_on_the_measured_acceleration_through_5_hz(self) -> None:
        controller = Controller(MPC_XY_VEL_P_ACC=0.0, MPC_XY_VEL_I_ACC=0.0, MPC_XY_P=0.0)
        alpha = 0.008 / (0.008 + 1.0 / (2.0 * math.pi * 5.0))
        controller.run(velocity=(0.0, 0.0, 0.0))
        expected = 0.0
        for k in range(1, 6):
            controller.run(velocity=(0.008 * k, 0.0, 0.0))  # 1 m/s^2
            expected += alpha * (1.0 - expected)
            assert controller["acc_sp"][0] == pytest.approx(-0.2 * expected, rel=1e-6)

    def test_integrator_takes_over_a_steady_error(self) -> None:
        controller = Controller(MPC_THR_HOVER=0.5)
        controller.run(position_sp=(math.nan,) * 3, velocity=(0.0, 0.1, 0.0), times=100)
        assert controller["vel_int"][1] == pytest.approx(-0.4 * 0.1 * 0.8, rel=1e-3)

    def test_speed_set_point_is_added_to_the_position_part(self) -> None:
        controller = Controller()
        controller.run(position=(1.0, 0.0, 0.0), velocity_sp=(0.3, 0.0, 0.0))
        assert controller["vel_sp"][0] == pytest.approx(0.3 - 0.95, rel=1e-6)

    def test_without_a_position_the_speed_stands_alone(self) -> None:
        controller = Controller()
        controller.run(position=(9.0, 9.0, 9.0), position_sp=(math.nan,) * 3, velocity_sp=(0.1, 0.2, 0.7))
        assert controller["vel_sp"] == pytest.approx((0.1, 0.2, 0.7))


class TestThrust:
    def test_points_where_the_acceleration_is_wanted(self) -> None:
        controller = Controller(MPC_THR_HOVER=0.5)
        controller.run(velocity=(0.5, -0.3, 0.0))
        north, east, down = controller.thrust_vector()
        ax, ay, _ = controller["acc_sp"]
        assert (north / -down, east / -down) == pytest.approx((ax / G, ay / G), rel=1e-6)
        assert -down == pytest.approx(0.5, rel=1e-6)  # height is kept while it leans
        assert ax < 0.0 < ay

    def test_tilt_is_limited_and_height_still_kept(self) -> None:
        controller = Controller(MPC_TILTMAX_AIR=20.0, MPC_THR_HOVER=0.5)
        controller.run(velocity=(8.0, 0.0, 0.0))
        vector = controller.thrust_vector()
        assert math.degrees(math.atan2(-vector[0], -vector[2])) == pytest.approx(20.0, rel=1e-6)
        assert -vector[2] == pytest.approx(0.5, rel=1e-6)

    def test_never_less_than_the_minimum(self) -> None:
        controller = Controller()
        controller.run(velocity=(0.0, 0.0, -30.0))
        assert controller.thrust == pytest.approx(0.12, rel=1e-6)

    def test_never_more_than_the_maximum_and_some_of_it_is_kept_for_going_sideways(self) -> None:
        controller = Controller(MPC_THR_XY_MARG=0.3)
        controller.run(velocity=(4.0, 0.0, 30.0))
        vector = controller.thrust_vector()
        assert controller.thrust == pytest.approx(1.0, rel=1e-6)
        assert math.hypot(vector[0], vector[1]) == pytest.approx(0.3, rel=1e-6)

    def test_vertical_integrator_does_not_wind_up_at_a_limit(self) -> None:
        controller = Controller()
        controller.run(position_sp=(0.0, 0.0, math.nan), velocity=(0.0, 0.0, -30.0), times=200)
        assert controller["vel_int"][2] == 0.0
        controller.run(velocity=(0.0, 0.0, 30.0), times=200)
        assert controller["vel_int"][2] == 0.0

    def test_horizontal_integrator_unwinds_while_the_tilt_is_limited(self) -> None:
        free = Controller(MPC_TILTMAX_AIR=80.0)
        limited = Controller(MPC_TILTMAX_AIR=10.0)
        for controller in (free, limited):
            controller.run(position_sp=(math.nan, math.nan, 0.0), velocity=(3.0, 0.0, 0.0), times=100)
        assert free["vel_int"][0] == pytest.approx(-0.4 * 3.0 * 0.8, rel=1e-3)
        assert limited["vel_int"][0] > 0.0  # it works against the demand that cannot be met


class TestSpeedLimits:
    def test_horizontal_speed_keeps_its_direction(self) -> None:
        controller = Controller(MPC_XY_VEL_MAX=5.0)
        controller.run(position=(30.0, -40.0, 0.0))
        assert controller["vel_sp"][:2] == pytest.approx((-3.0, 4.0), rel=1e-6)

    @pytest.mark.parametrize(("down", "expected"), [(50.0, -3.0), (-50.0, 1.5)])
    def test_up_and_down_have_their_own(self, down: float, expected: float) -> None:
        controller = Controller(MPC_Z_VEL_MAX_UP=3.0, MPC_Z_VEL_MAX_DN=1.5)
        controller.run(position=(0.0, 0.0, down))
        assert controller["vel_sp"][2] == pytest.approx(expected)

    @pytest.mark.parametrize(("profile", "ticks"), [("sitl", 2), ("board", 6), ("study", 8)])
    def test_it_runs_every_8_ms(self, profile: str, ticks: int) -> None:
        assert position_ticks(get_profile(profile)) == ticks


vector = st.tuples(*[st.floats(-50.0, 50.0)] * 3)


@settings(deadline=None, max_examples=200)
@given(position=vector, velocity=vector, yaw=st.floats(-10.0, 10.0))
def test_attitude_is_a_rotation_with_its_thrust_within_limits(position: Any, velocity: Any, yaw: float) -> None:
    controller = Controller()
    controller.run(position, velocity, yaw_sp=yaw, times=3)
    w, x, y, z = controller["quat_sp"]
    assert math.hypot(w, x, y, z) == pytest.approx(1.0, abs=1e-9)
    assert 0.12 - 1e-6 <= controller.thrust <= 1.0 + 1e-6
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    assert math.degrees(math.acos(min(1.0, rotation[2, 2]))) <= 45.0 + 1e-6
    # the body's x axis lies in the vertical plane of the heading
    assert rotation[0, 0] * math.sin(yaw) == pytest.approx(rotation[1, 0] * math.cos(yaw), abs=1e-9)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e30])
@pytest.mark.parametrize(
    "name", [n for n in ParameterTable().names if n.startswith("MPC_") and ParameterTable().spec(n).type == "REAL32"]
)
def test_no_parameter_can_break_it_for_good(name: str, value: float) -> None:
    controller = Controller(**{name: value})
    for _ in range(5):
        controller.run((1.0, 2.0, 3.0), (0.5, -0.5, 0.2))
        controller.run()
    assert np.isfinite(controller["vel_int"]).all()
