from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.control_loop import (
    ATTITUDE,
    CONTROL_INPUT,
    CONTROL_STATE,
    OFF,
    RATES,
    control_tick,
    settle_filters,
)
from sitl.control_settings import control_settings, mix_of
from sitl.parameters import ParameterTable
from sitl.profile import get_profile
from sitl.rotation import from_euler
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import resolve_vehicle

LEVEL = (1.0, 0.0, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0)


class Loop:
    """The control loop alone: its gyro and its attitude come from the test."""

    def __init__(self, profile: str = "sitl", spec: str = "ant-x", /, **parameters: float) -> None:
        self.profile = get_profile(profile)
        model = resolve_vehicle(spec)
        self.table = ParameterTable(airframe_parameters(model, self.profile) | parameters)
        self.mix = mix_of(self.table)
        self.settings = control_settings(self.table, self.profile, self.mix)
        self.input = np.zeros(1, CONTROL_INPUT)
        self.state = np.zeros(1, CONTROL_STATE)
        self.ask()

    def ask(self, quat: Any = LEVEL, *, level: int = ATTITUDE, rates: Any = STILL, thrust: float = 0.5) -> None:
        self.input["level"] = level
        self.input["quat_sp"][0] = quat
        self.input["rates_sp"][0] = rates
        self.input["yaw_rate_sp"] = math.nan
        self.input["thrust_sp"] = thrust

    def tick(self, gyro: Any = STILL, quat: Any = LEVEL) -> np.ndarray:
        control_tick(self.settings, self.input, self.state, np.array(gyro, float), np.array(quat, float))
        return self["outputs"][: self.mix.motors].copy()

    def __getitem__(self, field: str) -> Any:
        return self.state[field][0]


class TestTiming:
    @pytest.mark.parametrize(
        ("profile", "ticks"), [("sitl", 2), ("board", 2), ("study", 1)], ids=["sitl", "board", "study"]
    )
    def test_attitude_set_point_reaches_the_motors(self, profile: str, ticks: int) -> None:
        loop = Loop(profile)
        for _ in range(5):
            before = loop.tick()
        loop.ask(from_euler(0.1, 0.0, 0.0))
        changed = [bool(np.any(loop.tick() != before)) for _ in range(3)]
        assert changed.index(True) + 1 == ticks

    @pytest.mark.parametrize("profile", ["sitl", "board", "study"])
    def test_rate_set_point_reaches_the_motors_at_the_next_tick(self, profile: str) -> None:
        loop = Loop(profile)
        loop.ask(level=RATES)
        before = [loop.tick() for _ in range(5)][-1]
        loop.ask(level=RATES, rates=(0.5, 0.0, 0.0))
        assert np.any(loop.tick() != before)

    @pytest.mark.parametrize("profile", ["sitl", "board", "study"])
    def test_a_gyro_sample_reaches_the_motors_in_its_own_tick(self, profile: str) -> None:
        loop = Loop(profile)
        before = [loop.tick() for _ in range(5)][-1]
        assert np.any(loop.tick(gyro=(0.1, 0.0, 0.0)) != before)

    def test_attitude_is_half_a_tick_late(self) -> None:
        loop = Loop()
        angles = [0.0, 0.1, 0.3, 0.2]
        for now, last in zip(angles[1:], angles, strict=False):
            if last == 0.0:
                loop.tick(quat=from_euler(last, 0.0, 0.0))
            loop.tick(quat=from_euler(now, 0.0, 0.0))
            # half-way by linear interpolation, which for one axis is exact
            assert loop["attitude"] == pytest.approx(from_euler((now + last) / 2.0, 0.0, 0.0), abs=1e-12)

    def test_attitude_of_the_study_is_not_late(self) -> None:
        loop = Loop("study")
        loop.tick()
        loop.tick(quat=from_euler(0.3, 0.0, 0.0))
        assert loop["attitude"] == pytest.approx(from_euler(0.3, 0.0, 0.0), abs=1e-15)

    @pytest.mark.parametrize("late", [0.0, 0.25, 1.0, 2.75, 6.0])
    def test_lateness_is_any_part_of_a_tick_up_to_six(self, late: float) -> None:
        loop = Loop()
        loop.settings["attitude_late_ticks"] = late
        for k in range(12):
            loop.tick(quat=from_euler(0.001 * k, 0.0, 0.0))
        assert 2.0 * math.asin(loop["attitude"][1]) == pytest.approx(0.001 * (11 - late), abs=1e-9)

    def test_sign_flip_of_the_quaternion_on_the_way_does_not_matter(self) -> None:
        loop, flipped = Loop(), Loop()
        for k in range(6):
            quat = np.array(from_euler(0.1 * k, 0.0, 0.0))
            motors = loop.tick(quat=quat)
            assert flipped.tick(quat=quat * (-1.0) ** k) == pytest.approx(motors, abs=1e-12)


class TestFilters:
    def test_rates_are_butterworth_and_their_slope_first_order(self) -> None:
        loop = Loop()
        samples = np.random.default_rng(3).standard_normal(200)
        rates, slopes = [], []
        loop.tick()
        for sample in samples:
            loop.tick(gyro=(sample, 0.0, 0.0))
            rates.append(loop["rates"][0])
            slopes.append(loop["accel"][0])
        b, a = scipy.signal.butter(2, 40.0, fs=250.0)
        expected = scipy.signal.lfilter(b, a, samples)
        alpha = 0.004 / (0.004 + 1.0 / (2.0 * math.pi * 20.0))
        slope = scipy.signal.lfilter([alpha], [1.0, alpha - 1.0], np.diff(expected, prepend=0.0) / 0.004)
        assert rates == pytest.approx(expected, abs=1e-12)
        assert slopes == pytest.approx(slope, abs=1e-9)

    def test_first_sample_starts_the_filters_settled(self) -> None:
        loop = Loop()
        loop.tick(gyro=(2.0, 0.0, 0.0))
        assert loop["rates"][0] == pytest.approx(2.0)
        assert loop["accel"][0] == 0.0

    def test_notches_come_before_the_low_pass(self) -> None:
        loop = Loop(IMU_GYRO_NF0_FRQ=60.0, IMU_GYRO_NF1_FRQ=30.0, IMU_GYRO_NF1_BW=10.0)
        t = np.arange(2000) * 0.004
        for sample in np.sin(2.0 * math.pi * 60.0 * t) + np.sin(2.0 * math.pi * 30.0 * t):
            loop.tick(gyro=(sample, 0.0, 0.0))
        assert abs(loop["rates"][0]) < 1e-6

    def test_changed_cutoff_goes_on_from_the_last_rate(self) -> None:
        loop = Loop()
        for _ in range(50):
            loop.tick(gyro=(3.0, 0.0, 0.0))
        loop.table.set("IMU_GYRO_CUTOFF", 90.0)
        loop.settings = control_settings(loop.table, loop.profile, loop.mix)
        settle_filters(loop.settings, loop.state)
        loop.tick(gyro=(3.0, 0.0, 0.0))
        assert loop["rates"][0] == pytest.approx(3.0, abs=1e-9)
        assert loop["accel"][0] == pytest.approx(0.0, abs=1e-3)

    def test_yaw_torque_is_low_passed_and_the_others_are_not(self) -> None:
        loop = Loop()
        loop.ask(level=RATES, rates=(0.1, 0.1, 0.1))
        loop.input["landed"] = True
        loop.tick()
        alpha = 0.004 / (0.004 + 1.0 / (2.0 * math.pi * 2.0))
        assert loop["torque_sp"] == pytest.approx((0.1 * 0.15, 0.1 * 0.15, alpha * 0.1 * 0.2), rel=1e-5)


class TestIntegrator:
    def flown(self, loop: Loop, ticks: int = 50) -> float:
        loop.ask(from_euler(0.05, 0.0, 0.0))
        for _ in range(ticks):
            loop.tick()
        return float(loop["integral"][0])

    def test_gathers_while_flying(self) -> None:
        assert self.flown(Loop()) > 1e-3

    def test_is_frozen_on_the_ground(self) -> None:
        loop = Loop()
        gathered = self.flown(loop)
        loop.input["landed"] = True
        for _ in range(10):
            loop.tick()
        assert loop["integral"][0] == gathered

    def test_is_reset_while_disarmed(self) -> None:
        loop = Loop()
        self.flown(loop)
        loop.ask(level=OFF)
        loop.tick()
        assert loop["integral"].tolist() == [0.0, 0.0, 0.0]

    def test_limit_set_to_infinity_is_no_limit_but_the_fading_stays(self) -> None:
        loop = Loop(MC_RR_INT_LIM=math.inf, MC_ROLLRATE_I=50.0)
        loop.ask(level=RATES, rates=(math.radians(400.0), 0.0, 0.0), thrust=0.5)
        for _ in range(20):
            loop.tick()
        assert loop["integral"][0] == pytest.approx(0.0, abs=1e-6)

    def test_does_not_wind_up_while_the_allocator_reports_saturation(self) -> None:
        loop = Loop(MC_ROLLRATE_P=2.0, MC_ROLLRATE_I=5.0)
        loop.ask(level=RATES, rates=(1.0, 0.0, 0.0))
        gathered = []
        for _ in range(6):
            loop.tick()
            gathered.append(float(loop["integral"][0]))
        # two ticks until the first status, and none after it
        assert gathered[0] < gathered[1] == gathered[-1]

    def test_flags_stay_until_the_next_status(self) -> None:
        loop = Loop(MC_ROLLRATE_P=2.0)
        seen = []
        for k in range(8):
            loop.ask(level=RATES, rates=(1.0 if k < 3 else 0.0, 0.0, 0.0))
            loop.tick()
            seen.append(int(loop["positive"][0]))
        # a status comes with every second tick (8 ms, the first multiple of 4 ms that is at least 5 ms)
        assert seen == [0, 1, 1, 0, 0, 0, 0, 0]

    @pytest.mark.parametrize(("profile", "ticks"), [("sitl", 2), ("board", 4)])
    def test_status_comes_every_5_ms_at_most(self, profile: str, ticks: int) -> None:
        assert int(Loop(profile).settings["status_ticks"][0]) == ticks


class TestMotors:
    def test_stopped_while_disarmed(self) -> None:
        loop = Loop()
        loop.ask(level=OFF, thrust=0.8)
        assert loop.tick(gyro=(1.0, 2.0, 3.0)).tolist() == [0.0] * 4

    def test_slew_limit_is_the_time_from_none_to_full(self) -> None:
        loop = Loop(**{f"CA_R{i}_SLEW": 0.1 for i in range(4)})
        loop.ask(thrust=1.0)
        up = [loop.tick()[0] for _ in range(25)]
        assert up == pytest.approx([0.04 * (k + 1) for k in range(25)], abs=1e-6)
        loop.ask(thrust=0.5)
        assert loop.tick()[0] == pytest.approx(0.96, abs=1e-6)

    def test_thrust_curve_is_applied_to_the_output_alone(self) -> None:
        loop = Loop(THR_MDL_FAC=0.5)
        output = loop.tick()[0]
        assert 0.5 * output**2 + 0.5 * output == pytest.approx(0.5)
        assert loop["motors"][0] == pytest.approx(0.5)

    def test_motors_beyond_the_rotors_stand_still(self) -> None:
        loop = Loop("sitl", "carrier-1")
        loop.tick()
        loop.table.set("CA_ROTOR_COUNT", 4)
        loop.settings = control_settings(loop.table, loop.profile, mix_of(loop.table))
        loop.tick()
        assert loop["outputs"][4:].tolist() == [0.0] * 8

    @pytest.mark.parametrize(
        "quat", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0), (math.inf, 0.0, 0.0, 0.0), (1e-200, 0.0, 0.0, 0.0)]
    )
    @pytest.mark.parametrize("profile", ["sitl", "study"])
    def test_attitude_set_point_without_direction_asks_for_no_rate_change(self, quat: Any, profile: str) -> None:
        loop = Loop(profile)
        loop.ask(quat)
        for _ in range(4):
            motors = loop.tick(gyro=(0.3, 0.0, 0.0), quat=from_euler(0.3, 0.0, 0.0))
        assert np.isnan(loop["rates_sp"]).all()
        assert motors == pytest.approx([0.5] * 4, abs=0.05)

    numbers = st.one_of(st.floats(-2.0, 2.0), st.sampled_from([math.nan, math.inf, -math.inf, 1e30, -1e30]))

    @pytest.mark.parametrize("spec", ["ant-x", "carrier-1"])
    @pytest.mark.parametrize("airmode", [0, 1, 2])
    @settings(deadline=None, max_examples=60)
    @given(
        quat=st.tuples(numbers, numbers, numbers, numbers),
        rates=st.tuples(numbers, numbers, numbers),
        level=st.sampled_from([RATES, ATTITUDE]),
        thrust=numbers,
        gain=numbers,
        slew_s=st.sampled_from([0.0, 0.1]),
    )
    def test_nothing_but_zero_to_one_ever_reaches_them(
        self, spec: str, airmode: int, quat: Any, rates: Any, level: int, thrust: float, gain: float, slew_s: float
    ) -> None:
        loop = Loop("sitl", spec, MC_AIRMODE=airmode, CA_R0_SLEW=slew_s)
        loop.settings["kp"][0, 0] = loop.settings["att_gain"][0, 1] = gain
        loop.ask(quat, level=level, rates=rates, thrust=thrust)
        for _ in range(4):
            motors = loop.tick(gyro=(0.5, -0.5, 0.1), quat=from_euler(0.2, 0.1, 0.0))
            assert np.all((motors >= 0.0) & (motors <= 1.0))
        assert np.isfinite(loop["integral"]).all()
        # and once the set-points make sense again so does the answer
        loop.ask()
        loop.settings["kp"][0, 0] = loop.settings["att_gain"][0, 1] = 1.0
        for _ in range(1700):  # a yaw torque of 1e30 takes its time to leave the low pass
            motors = loop.tick()
        assert motors.mean() == pytest.approx(0.5, abs=0.1)


def test_study_profile_has_no_limits_at_all() -> None:
    loop = Loop("study", MC_ROLLRATE_P=5.0)
    loop.ask(from_euler(2.0, 0.0, 0.0))
    motors = loop.tick()
    assert loop["rates_sp"][0] == pytest.approx(4.0 * 2.0)
    assert (loop.mix.inverse @ motors)[0] == pytest.approx(5.0 * 8.0, rel=1e-6)
    assert motors.max() > 1.0
    assert motors.min() < 0.0
