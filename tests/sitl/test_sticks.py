from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.parameters import ParameterTable
from sitl.rotation import to_euler, to_world
from sitl.setpoints import Sticks
from sitl.sticks import AttitudeSticks, Quat, StickYaw, clean, expo_deadzone, superexpo

DT_S = 0.004
stick = st.floats(-1.0, 1.0)
anything = st.floats(allow_nan=True, allow_infinity=True)


def law(**parameters: float) -> AttitudeSticks:
    made = AttitudeSticks(ParameterTable(parameters))
    made.begin(flying=True)
    return made


def attitude(made: AttitudeSticks, sticks: Sticks, *, landed: bool = False) -> tuple[Quat, float, float]:
    return made.attitude(sticks, 0.0, DT_S, landed=landed, spooled_up=True)


class TestCurves:
    @given(stick, st.floats(0.0, 1.0), st.floats(0.0, 0.9))
    def test_expo_is_odd_and_bounded(self, x: float, expo: float, deadzone: float) -> None:
        y = expo_deadzone(x, expo, deadzone)
        assert y == -expo_deadzone(-x, expo, deadzone)
        assert abs(y) <= 1.0 + 1e-12
        assert abs(x) > deadzone or y == 0.0

    def test_expo_at_known_points(self) -> None:
        assert expo_deadzone(0.5, 0.6, 0.0) == pytest.approx(0.4 * 0.5 + 0.6 * 0.125)
        assert expo_deadzone(1.0, 0.6, 0.1) == pytest.approx(1.0)
        assert expo_deadzone(0.55, 0.0, 0.1) == pytest.approx(0.5)

    @given(stick, anything, anything)
    def test_superexpo_is_odd_and_bounded(self, x: float, expo: float, steep: float) -> None:
        y = superexpo(x, expo, steep)
        assert y == pytest.approx(-superexpo(-x, expo, steep))
        assert abs(y) <= 1.0 + 1e-9

    def test_superexpo_without_steepness_is_expo(self) -> None:
        assert superexpo(0.5, 0.3, 0.0) == pytest.approx(0.7 * 0.5 + 0.3 * 0.125)
        assert superexpo(1.0, 0.69, 0.7) == pytest.approx(1.0)

    @given(anything, anything, anything, anything)
    def test_clean_sticks_are_within_one(self, a: float, b: float, c: float, d: float) -> None:
        assert all(abs(x) <= 1.0 for x in clean(Sticks(a, b, c, d)))

    def test_no_sticks_are_centred(self) -> None:
        assert clean(None) == Sticks()


class TestStabilized:
    def test_stick_is_tilt(self) -> None:
        quat, _, _ = attitude(law(), Sticks(roll=10.0 / 35.0))
        phi, theta, _ = to_euler(quat)
        assert math.degrees(phi) == pytest.approx(10.0, abs=1e-4)
        assert theta == pytest.approx(0.0, abs=1e-12)

    def test_stick_forward_is_nose_down(self) -> None:
        quat, _, _ = attitude(law(), Sticks(pitch=0.4))
        assert math.degrees(to_euler(quat)[1]) == pytest.approx(-14.0, abs=1e-4)

    @given(stick, stick)
    def test_tilt_is_limited_and_goes_where_the_stick_points(self, roll: float, pitch: float) -> None:
        quat, _, _ = attitude(law(), Sticks(roll, pitch))
        x, y, z = to_world(quat, (0.0, 0.0, -1.0))
        tilt = math.degrees(math.acos(min(1.0, -z)))
        assert tilt == pytest.approx(35.0 * min(1.0, math.hypot(roll, pitch)), abs=1e-3)
        assert x * roll == pytest.approx(y * pitch, abs=1e-9)

    def test_tilt_filter_is_first_order(self) -> None:
        made = law(MC_MAN_TILT_TAU=0.5)
        for _ in range(round(0.5 / DT_S)):
            quat, _, _ = attitude(made, Sticks(roll=1.0))
        assert math.degrees(to_euler(quat)[0]) == pytest.approx(35.0 * (1.0 - math.exp(-1.0)), rel=0.01)

    @pytest.mark.parametrize(("throttle", "thrust"), [(-1.0, 0.08), (0.0, 0.5), (1.0, 0.9), (-0.5, 0.29), (0.5, 0.7)])
    def test_throttle_goes_through_hover(self, throttle: float, thrust: float) -> None:
        made = law(MPC_THR_HOVER=0.5, MPC_THR_MAX=0.9)
        assert attitude(made, Sticks(throttle=throttle))[2] == pytest.approx(thrust, abs=1e-6)

    def test_curve_1_is_a_straight_line(self) -> None:
        made = law(MPC_THR_HOVER=0.3, MPC_THR_CURVE=1)
        assert attitude(made, Sticks())[2] == pytest.approx(0.54, abs=1e-6)

    def test_thrust_is_released_slowly_after_spool_up(self) -> None:
        made = law()
        made.begin(flying=False)
        assert made.attitude(Sticks(throttle=1.0), 0.0, DT_S, landed=True, spooled_up=False)[2] == 0.0
        for _ in range(round(0.5 / DT_S)):
            thrust = attitude(made, Sticks(throttle=1.0), landed=True)[2]
        assert thrust == pytest.approx(0.25, abs=0.01)

    def test_on_the_ground_throttle_down_is_no_thrust(self) -> None:
        made = law()
        made.begin(flying=False)
        assert attitude(made, Sticks(throttle=-1.0), landed=True)[2] == 0.0


class TestYaw:
    def test_stick_is_a_rate_and_the_heading_is_locked_again(self) -> None:
        yaw = StickYaw(ParameterTable())
        for _ in range(500):
            yaw.update(1.0, 0.3, DT_S)
        assert yaw.rate == pytest.approx(math.radians(150.0), rel=1e-6)
        assert math.isnan(yaw.heading)
        for _ in range(500):
            yaw.update(0.0, 0.7, DT_S)
        assert (yaw.rate, yaw.heading) == (0.0, 0.7)
        yaw.update(0.0, 0.9, DT_S)
        assert yaw.heading == 0.7

    def test_dead_zone(self) -> None:
        yaw = StickYaw(ParameterTable())
        yaw.update(0.09, 0.3, DT_S)
        assert (yaw.rate, yaw.heading) == (0.0, 0.3)


def test_acro_is_rates() -> None:
    rates, thrust = law(MC_ACRO_R_MAX=200.0).rates(Sticks(0.5, 0.5, -0.5, 0.2))
    assert rates == pytest.approx((math.radians(100.0), math.radians(-50.0), math.radians(-50.0)))
    assert thrust == pytest.approx(0.6)
