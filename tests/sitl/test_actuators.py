from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.actuators import (
    MAX_MOTORS,
    PITCH,
    ROLL,
    THRUST,
    YAW,
    Mix,
    RotorEffect,
    allocate,
    effectiveness,
    motor_output,
    normalised_mix,
    saturation,
)

CCW, CW = 0.05, -0.05


def quad(front: float, right: float, rear: float | None = None, rear_right: float | None = None) -> list[RotorEffect]:
    """PX4's quad X order: front right, rear left (both CCW), front left, rear right (both CW)."""
    rear = front if rear is None else rear
    rear_right = right if rear_right is None else rear_right
    places = [(front, right), (-rear, -rear_right), (front, -right), (-rear, rear_right)]
    return [RotorEffect((x, y, 0.0), km=km) for (x, y), km in zip(places, (CCW, CCW, CW, CW), strict=True)]


def rotors(*rows: tuple[float, float, float]) -> list[RotorEffect]:
    return [RotorEffect((x, y, 0.0), km=km) for x, y, km in rows]


SQUARE = quad(0.06, 0.06)
OCTO_X = rotors(
    (0.25407, 0.10524, CW), (-0.25407, -0.10524, CW), (0.10524, 0.25407, CCW), (-0.25407, 0.10524, CCW),
    (0.25407, -0.10524, CCW), (-0.10524, -0.25407, CCW), (0.10524, -0.25407, CW), (-0.10524, 0.25407, CW),
)  # fmt: skip
X8 = rotors(
    (0.18875, 0.20, CCW), (0.18875, -0.20, CW), (-0.18875, -0.20, CCW), (-0.18875, 0.20, CW),
    (0.18875, -0.20, CCW), (0.18875, 0.20, CW), (-0.18875, 0.20, CCW), (-0.18875, -0.20, CW),
)  # fmt: skip
HEXA_X = rotors(
    (math.sqrt(0.75), 0.5, CCW), (0.0, 1.0, CW), (-math.sqrt(0.75), 0.5, CCW),
    (-math.sqrt(0.75), -0.5, CW), (0.0, -1.0, CCW), (math.sqrt(0.75), -0.5, CW),
)  # fmt: skip
# Roll, pitch and yaw of each motor per unit of torque set-point, from logs of a PX4 and from its sources.
A, B = 0.70711, 0.67840
ROWS = {
    "square": (SQUARE, [(-A, A, 1), (A, -A, 1), (A, A, -1), (-A, -A, -1)]),
    "x500": (
        quad(0.13, 0.22, 0.13, 0.20),
        [(-0.4377, A, 0.9091), (0.4377, -A, 1), (0.4377, A, -0.9091), (-0.4377, -A, -1)],
    ),
    "iris": (
        quad(0.1515, 0.245, 0.1515, 0.1875),
        [(-0.4954, A, 0.7653), (0.4954, -A, 1), (0.4954, A, -0.7653), (-0.4954, -A, -1)],
    ),
    "rectangle": (quad(0.15, 0.25), [(-0.4243, A, 1), (0.4243, -A, 1), (0.4243, A, -1), (-0.4243, -A, -1)]),
    "ANT-R, H": (quad(0.093808, 0.09), [(-A, B, 1), (A, -B, 1), (A, B, -1), (-A, -B, -1)]),
    "hexa X": (
        HEXA_X,
        [(-0.4082, A, 1), (-0.8165, 0, -1), (-0.4082, -A, 1), (0.4082, -A, -1), (0.8165, 0, 1), (0.4082, A, -1)],
    ),
    "octo X": (
        OCTO_X,
        [
            (-0.38268, 0.92388, -1), (0.38268, -0.92388, -1), (-0.92388, 0.38268, 1), (-0.38268, -0.92388, 1),
            (0.38268, 0.92388, 1), (0.92388, -0.38268, 1), (0.92388, 0.38268, -1), (-0.92388, -0.38268, -1),
        ],
    ),
    "X8": (
        X8,
        [
            (-0.66732, A, 1), (0.66732, A, -1), (0.66732, -A, 1), (-0.66732, -A, -1),
            (0.66732, A, 1), (-0.66732, A, -1), (-0.66732, -A, 1), (0.66732, -A, -1),
        ],
    ),
}  # fmt: skip
MIXES = {name: normalised_mix(frame) for name, (frame, _) in ROWS.items()}
FRAMES = pytest.mark.parametrize("name", list(MIXES))


def mixed(
    mix: Mix, torque: tuple[float, float, float], thrust: float, *, airmode: int = 0, method: int = 2
) -> np.ndarray:
    motors = np.zeros(MAX_MOTORS)
    allocate(mix.columns, mix.motors, np.array(torque), thrust, method, airmode, motors)
    assert not motors[mix.motors :].any()
    return motors[: mix.motors]


def by_hand(
    parts: list[tuple[float, float]], axis: int, torque: np.ndarray, thrust: float, *, airmode: int = 0
) -> list[float]:
    """Motors of a mix of which each has a part in one axis and one in thrust."""
    columns = np.zeros((len(parts), 4))
    columns[:, [axis, THRUST]] = parts
    motors = np.zeros(len(parts))
    allocate(columns, len(parts), torque, thrust, 2, airmode, motors)
    return motors.tolist()


def flags(mix: Mix, torque: tuple[float, float, float], motors: np.ndarray) -> tuple[list[int], list[int]]:
    positive, negative = np.zeros(3, np.uint8), np.zeros(3, np.uint8)
    saturation(mix.inverse, mix.motors, np.array(torque), motors, positive, negative)
    return positive.tolist(), negative.tolist()


class TestMix:
    @FRAMES
    def test_rows_are_those_of_px4(self, name: str) -> None:
        assert MIXES[name].columns[:, :3] == pytest.approx(np.array(ROWS[name][1]), abs=1e-4)
        assert MIXES[name].columns[:, THRUST] == pytest.approx(1.0)

    @FRAMES
    def test_inverse_gives_back_what_was_mixed(self, name: str) -> None:
        mix = MIXES[name]
        assert mix.inverse @ mix.columns == pytest.approx(np.eye(4), abs=1e-12)

    @pytest.mark.parametrize(
        ("name", "factors"),
        [("square", (0.35355, 0.35355, 0.25)), ("ANT-R, H", (0.35355, 0.36851, 0.25)), ("rectangle", None)],
    )
    def test_inverse_of_a_symmetric_frame_divides_by_the_sum_of_squares(
        self, name: str, factors: tuple[float, ...] | None
    ) -> None:
        mix = MIXES[name]
        assert mix.inverse == pytest.approx((mix.columns / (mix.columns**2).sum(axis=0)).T, abs=1e-12)
        if factors:
            assert np.abs(mix.inverse[:3]).max(axis=1) == pytest.approx(factors, abs=1e-5)

    def test_octo_x_inverse_is_a_quarter_of_its_rows(self) -> None:
        mix = MIXES["octo X"]
        assert mix.inverse[:2] == pytest.approx(0.25 * mix.columns[:, :2].T, abs=1e-5)

    @given(scale=st.floats(0.2, 20.0))
    def test_size_of_the_frame_does_not_matter(self, scale: float) -> None:
        assert normalised_mix(quad(0.15 * scale, 0.25 * scale)).columns == pytest.approx(
            MIXES["rectangle"].columns, abs=1e-9
        )

    def test_physical_torque_per_unit_is_the_same_in_roll_and_pitch(self) -> None:
        torque = effectiveness(ROWS["rectangle"][0])[:2] @ MIXES["rectangle"].columns[:, :2]
        assert torque[0, 0] == pytest.approx(torque[1, 1], rel=1e-12)

    def test_signs_are_those_of_the_body_frame(self) -> None:
        effect = effectiveness([RotorEffect((0.2, 0.1, -0.05), ct=6.5, km=0.05)])[:, 0]
        # right rotor rolls left, front rotor pitches up, counter-clockwise rotor yaws right, thrust is up
        assert effect == pytest.approx((-6.5 * 0.1, 6.5 * 0.2, 6.5 * 0.05, 0.0, 0.0, -6.5))

    def test_height_of_a_rotor_makes_no_torque(self) -> None:
        high = [RotorEffect((r.position_m[0], r.position_m[1], -0.3), km=r.km) for r in SQUARE]
        assert normalised_mix(high).columns == pytest.approx(MIXES["square"].columns)

    def test_axis_length_does_not_matter(self) -> None:
        long = [RotorEffect(r.position_m, (0.0, 0.0, -7.0), km=r.km) for r in SQUARE]
        assert normalised_mix(long).columns == pytest.approx(MIXES["square"].columns)

    @pytest.mark.parametrize(("arm", "dropped"), [(0.0076, True), (0.0078, False)])
    def test_axis_with_arms_too_short_is_given_up(self, arm: float, dropped: bool) -> None:
        mix = normalised_mix(quad(0.1, arm))
        assert (not mix.columns[:, ROLL].any()) is dropped
        assert mix.columns[:, PITCH].any()
        assert mix.inverse.shape == (4, 4)

    @pytest.mark.parametrize("length", [0.5, 2.0])
    def test_effectiveness_is_that_of_an_axis_of_length_one(self, length: float) -> None:
        slanting = effectiveness([RotorEffect((0.1, 0.2, 0.0), (0.6, 0.0, -0.8))])
        assert effectiveness([RotorEffect((0.1, 0.2, 0.0), (0.6 * length, 0.0, -0.8 * length))]) == pytest.approx(
            slanting
        )

    def test_rotor_without_an_axis_does_nothing(self) -> None:
        assert not effectiveness([RotorEffect((0.1, 0.2, 0.0), (0.0, 0.0, 0.0))]).any()

    def test_rotor_of_which_nothing_else_is_told_has_px4s_coefficients(self) -> None:
        matrix = effectiveness([RotorEffect((0.1, 0.2, 0.0))])
        assert matrix[:, 0] == pytest.approx([-1.3, 0.65, 6.5 * 0.05, 0.0, 0.0, -6.5])

    def test_an_axis_exactly_at_the_threshold_is_given_up(self) -> None:
        weak = effectiveness([RotorEffect((0.1, 0.2, 0.0), ct=1.0, km=0.05)])
        assert weak[2, 0] == 0.0
        assert effectiveness([RotorEffect((0.1, 0.2, 0.0), ct=1.0, km=0.051)])[2, 0] == pytest.approx(0.051)

    def test_one_rotor_that_is_no_number_leaves_the_others_theirs(self) -> None:
        matrix = effectiveness([RotorEffect((math.nan, 0.1, 0.0)), RotorEffect((0.1, 0.2, 0.0))])
        assert np.isnan(matrix[:, 0]).all()
        assert matrix[5, 1] == -6.5

    def test_no_rotors_no_mix(self) -> None:
        assert normalised_mix([]).columns.shape == (0, 4)
        assert normalised_mix([]).inverse.shape == (4, 0)

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_geometry_that_is_no_number_stops_all_motors(self, bad: float) -> None:
        assert normalised_mix([RotorEffect((bad, 0.1, 0.0)), *SQUARE[1:]]).motors == 0
        assert normalised_mix([RotorEffect((0.1, 0.1, 0.0), km=bad), *SQUARE[1:]]).motors == 0

    def test_rotor_without_thrust_has_no_part(self) -> None:
        mix = normalised_mix([*SQUARE, RotorEffect((0.5, 0.5, 0.0), ct=0.0)])
        assert mix.columns[4] == pytest.approx(0.0)


unit = st.floats(-2.0, 2.0)
torques = st.tuples(unit, unit, unit)
thrusts = st.floats(0.0, 1.5)
small = st.floats(-0.1, 0.1)


class TestAllocation:
    @FRAMES
    @pytest.mark.parametrize("airmode", [0, 1, 2])
    @settings(max_examples=30, deadline=None)
    @given(torque=st.tuples(small, small, small), thrust=st.floats(0.35, 0.65))
    def test_gives_exactly_what_was_asked_while_there_is_room(
        self, name: str, airmode: int, torque: tuple[float, float, float], thrust: float
    ) -> None:
        mix = MIXES[name]
        motors = mixed(mix, torque, thrust, airmode=airmode)
        assert mix.inverse @ motors == pytest.approx((*torque, thrust), abs=1e-12)

    @FRAMES
    @settings(max_examples=60, deadline=None)
    @given(torque=torques, thrust=thrusts)
    def test_airmode_off_never_raises_the_thrust(
        self, name: str, torque: tuple[float, float, float], thrust: float
    ) -> None:
        mix = MIXES[name]
        # before clipping: that can only raise what the last desaturation left below zero
        assert (mix.inverse @ mixed(mix, torque, thrust))[THRUST] <= thrust + 1e-9

    @settings(max_examples=200, deadline=None)
    @given(torque=torques, thrust=thrusts)
    def test_little_is_left_for_the_clipping(self, torque: tuple[float, float, float], thrust: float) -> None:
        # half of the 15 per cent that yaw may use at full thrust is what the last step of thrust leaves over
        motors = mixed(MIXES["square"], torque, thrust)
        assert motors.min() > -0.0751
        assert motors.max() < 1.0751

    @settings(max_examples=60, deadline=None)
    @given(torque=torques)
    def test_zero_thrust_leaves_no_torque(self, torque: tuple[float, float, float]) -> None:
        assert mixed(MIXES["square"], torque, 0.0) == pytest.approx(np.zeros(4), abs=1e-12)

    def test_thrust_gives_way_to_roll_at_the_top(self) -> None:
        # 0.95 + 0.7071 * 0.3 = 1.162: thrust falls by 0.162, roll stays whole
        got = MIXES["square"].inverse @ mixed(MIXES["square"], (0.3, 0.0, 0.0), 0.95)
        assert got == pytest.approx((0.3, 0.0, 0.0, 1.0 - 0.3 * A), abs=1e-4)

    def test_roll_gives_way_to_thrust_at_the_bottom(self) -> None:
        # 0.1 - 0.7071 * 0.3 < 0: more thrust is not allowed, so roll is cut to 0.1 / 0.7071
        got = MIXES["square"].inverse @ mixed(MIXES["square"], (0.3, 0.0, 0.0), 0.1)
        assert got == pytest.approx((0.1 / A, 0.0, 0.0, 0.1), abs=1e-4)

    def test_roll_is_cut_before_pitch(self) -> None:
        roll, pitch, _, thrust = MIXES["square"].inverse @ mixed(MIXES["square"], (0.5, 0.5, 0.0), 0.5)
        assert pitch == pytest.approx(0.5, abs=1e-9)
        assert roll == pytest.approx(0.5 / A - 0.5, abs=1e-4)
        assert thrust == pytest.approx(0.5, abs=1e-9)

    def test_pitch_alone_takes_all_authority_from_roll(self) -> None:
        # a pitch limit cycle hides what roll does: the reason to judge roll with pitch on safe gains
        roll, pitch, *_ = MIXES["square"].inverse @ mixed(MIXES["square"], (0.5, 1.0, 0.0), 0.5)
        assert pitch == pytest.approx(0.5 / A, abs=1e-3)
        assert abs(roll) < 0.01

    def test_a_motor_without_a_part_in_an_axis_does_not_end_its_desaturation(self) -> None:
        # motors 2 and 5 of a hexa X have none in pitch; those behind them are the ones at the limit
        roll, pitch, _, thrust = MIXES["hexa X"].inverse @ mixed(MIXES["hexa X"], (0.0, 2.0, 0.0), 0.5)
        assert pitch == pytest.approx(0.5 / A, abs=1e-4)
        assert (roll, thrust) == pytest.approx((0.0, 0.5), abs=1e-9)

    def test_yaw_comes_last(self) -> None:
        got = MIXES["square"].inverse @ mixed(MIXES["square"], (0.5, 0.0, 1.0), 0.5)
        assert got == pytest.approx((0.5, 0.0, 0.5 - 0.5 * A, 0.5), abs=1e-4)

    def test_yaw_keeps_15_per_cent_of_room_at_full_thrust(self) -> None:
        motors = mixed(MIXES["square"], (0.0, 0.0, 0.1), 1.0)
        _, _, yaw, thrust = MIXES["square"].inverse @ motors
        assert yaw == pytest.approx(0.1, abs=1e-9)
        assert thrust == pytest.approx(0.9, abs=1e-9)

    @pytest.mark.parametrize("airmode", [1, 2])
    def test_airmode_raises_thrust_to_keep_roll_at_idle(self, airmode: int) -> None:
        got = MIXES["square"].inverse @ mixed(MIXES["square"], (0.3, 0.2, 0.0), 0.0, airmode=airmode)
        assert got[:2] == pytest.approx((0.3, 0.2), abs=1e-9)
        assert got[THRUST] == pytest.approx(0.5 * A, abs=1e-4)

    def test_airmode_for_roll_and_pitch_gives_yaw_nothing_at_idle(self) -> None:
        motors = mixed(MIXES["square"], (0.0, 0.0, 0.3), 0.0, airmode=1)
        assert motors == pytest.approx(np.zeros(4), abs=1e-12)

    def test_airmode_for_all_axes_raises_thrust_for_yaw_too(self) -> None:
        got = MIXES["square"].inverse @ mixed(MIXES["square"], (0.0, 0.0, 0.3), 0.0, airmode=2)
        assert got == pytest.approx((0.0, 0.0, 0.3, 0.3), abs=1e-9)

    def test_plain_pseudo_inverse_does_not_desaturate(self) -> None:
        motors = mixed(MIXES["square"], (0.9, 0.9, 0.9), 0.9, method=0)
        assert motors == pytest.approx(MIXES["square"].columns @ (0.9, 0.9, 0.9, 0.9), abs=1e-12)

    @pytest.mark.parametrize("axis", [ROLL, PITCH, YAW])
    @pytest.mark.parametrize(("part", "cut"), [(0.15, False), (0.25, True)])
    def test_an_axis_is_not_cut_for_a_motor_with_little_part_in_it(self, axis: int, part: float, cut: bool) -> None:
        torque = np.zeros(3)
        torque[axis] = -2.0
        # nor may thrust rise for it, which it may in no case but airmode
        got = by_hand([(0.0, 1.0), (part, 1.0)], axis, torque, 0.2)
        assert got == pytest.approx([0.2, 0.0 if cut else 0.2 - 2.0 * part])

    @pytest.mark.parametrize(("part", "cut"), [(0.15, False), (0.25, True)])
    def test_nor_is_yaw_for_the_sake_of_thrust(self, part: float, cut: bool) -> None:
        got = by_hand([(0.0, 1.0), (part, 0.0)], YAW, np.array([0.0, 0.0, -2.0]), 0.2, airmode=2)
        assert got == pytest.approx([0.2, 0.0 if cut else -2.0 * part])

    @pytest.mark.parametrize("airmode", [1, 2])
    @pytest.mark.parametrize(("part", "cut"), [(0.15, False), (0.25, True)])
    def test_thrust_does_not_give_way_to_a_motor_with_little_part_in_it(
        self, airmode: int, part: float, cut: bool
    ) -> None:
        got = by_hand([(0.0, 1.0), (1.0, part)], ROLL, np.array([1.1 - 0.5 * part, 0.0, 0.0]), 0.5, airmode=airmode)
        assert got == pytest.approx([0.1, 1.0] if cut else [0.5, 1.1])

    @pytest.mark.parametrize(
        ("axis", "airmode", "thrust"), [(ROLL, 0, 0.8), (PITCH, 0, 0.8), (YAW, 2, 0.5), (YAW, 2, 0.8)]
    )
    def test_an_axis_is_cut_for_the_motor_above_the_top(self, axis: int, airmode: int, thrust: float) -> None:
        # thrust leaves the two as far beyond their limits, -0.25 and 1.25; the upper one has half the lower one's part
        torque = np.zeros(3)
        torque[axis] = -1.0
        assert by_hand([(1.0, 1.0), (-0.5, 1.0)], axis, torque, thrust, airmode=airmode) == pytest.approx([0.25, 1.0])

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_airmode_for_all_axes_cuts_yaw_at_last(self, sign: float) -> None:
        got = MIXES["square"].inverse @ mixed(MIXES["square"], (0.0, 0.0, 0.8 * sign), 0.5, airmode=2)
        assert got == pytest.approx((0.0, 0.0, 0.5 * sign, 0.5), abs=1e-9)

    @pytest.mark.parametrize(("name", "authority"), [("square", 0.7071), ("octo X", 0.5412), ("X8", 0.7493)])
    def test_roll_authority_at_half_thrust(self, name: str, authority: float) -> None:
        motors = np.clip(mixed(MIXES[name], (5.0, 0.0, 0.0), 0.5), 0.0, 1.0)
        if name == "octo X":  # motors of unequal arms saturate one after the other
            just = mixed(MIXES[name], (authority - 1e-4, 0.0, 0.0), 0.5)
            assert 0.0 <= just.min() < 1e-3
        else:
            assert (MIXES[name].inverse @ motors)[ROLL] == pytest.approx(authority, abs=1e-3)


class TestSaturationFlags:
    MIX = MIXES["square"]

    def test_none_while_everything_is_given(self) -> None:
        torque = (0.2, -0.1, 0.05)
        assert flags(self.MIX, torque, mixed(self.MIX, torque, 0.5)) == ([0, 0, 0], [0, 0, 0])

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_axis_and_side_that_got_less_than_asked(self, sign: float) -> None:
        torque = (sign * 0.9, 0.0, 0.0)
        both = flags(self.MIX, torque, np.clip(mixed(self.MIX, torque, 0.5), 0.0, 1.0))
        assert both == (([1, 0, 0], [0, 0, 0]) if sign > 0.0 else ([0, 0, 0], [1, 0, 0]))

    @pytest.mark.parametrize("axis", [ROLL, PITCH, YAW])
    @pytest.mark.parametrize(("missing", "flag"), [(0.99e-3, 0), (1.01e-3, 1)])
    def test_a_shortfall_counts_from_a_thousandth_on(self, axis: int, missing: float, flag: int) -> None:
        given = np.array([0.2, 0.1, 0.05, 0.5])
        given[axis] -= missing
        positive, negative = flags(self.MIX, (0.2, 0.1, 0.05), self.MIX.columns @ given)
        assert positive == [flag if one == axis else 0 for one in range(3)]
        assert negative == [0, 0, 0]

    def test_once_one_axis_falls_short_the_smallest_shortfall_of_another_counts(self) -> None:
        given = self.MIX.columns @ (0.1, 0.1 + 1e-5, 0.0, 0.5)
        positive, negative = flags(self.MIX, (0.2, 0.1, 0.0), given)
        assert positive == [1, 0, 0]
        assert negative == [0, 1, 0]

    def test_axis_that_cannot_be_controlled_counts_as_saturated(self) -> None:
        mix = normalised_mix(quad(0.1, 0.005))
        assert flags(mix, (0.2, 0.0, 0.0), mixed(mix, (0.2, 0.0, 0.0), 0.5)) == ([1, 0, 0], [0, 0, 0])


class TestMotorCurve:
    @pytest.mark.parametrize("factor", [0.1, 0.3, 0.7, 1.0])
    @pytest.mark.parametrize("thrust", [0.0, 0.01, 0.25, 0.5, 1.0])
    def test_signal_makes_the_curve_give_the_thrust(self, factor: float, thrust: float) -> None:
        signal = motor_output(thrust, factor)
        assert factor * signal**2 + (1.0 - factor) * signal == pytest.approx(thrust, abs=1e-12)
        assert 0.0 <= signal <= 1.0

    @pytest.mark.parametrize("factor", [0.0, -0.2, 1.1, math.nan])
    def test_factor_out_of_range_changes_nothing(self, factor: float) -> None:
        assert motor_output(0.4, factor) == 0.4
