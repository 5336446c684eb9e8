"""The batch flies what the vehicle flies, whichever way it is run, and what a matrix exponential says it must."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sitl.actuators import allocate, motor_output
from sitl.airframe import load_airframe
from sitl.array_form import array_form
from sitl.attitude_control import attitude_control
from sitl.batch import LANES, Batch, RollJob, fly_lanes
from sitl.compiled import is_compiled
from sitl.control_settings import control_settings, mix_of
from sitl.errors import UsageError
from sitl.parameters import ParameterTable
from sitl.profile import Profile, get_profile
from sitl.rate_control import rate_control
from sitl.roll_loop import LOST_RAD, roll_attitude_control, roll_torque, sine, step_matrices
from sitl.rotation import from_euler
from sitl.uncertainty import sample_derivatives
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import resolve_vehicle

FLOWN = {"k_phi": 6.5, "kp": 0.05, "ki": 0.05, "kd": 0.001}


def made_settings(spec: str, profile: Profile, gains: dict[str, float], **parameters: float) -> np.ndarray:
    model = resolve_vehicle(spec)
    names = {"k_phi": "MC_ROLL_P", "kp": "MC_ROLLRATE_P", "ki": "MC_ROLLRATE_I", "kd": "MC_ROLLRATE_D"}
    table = ParameterTable(airframe_parameters(model, profile))
    for name, value in ({names[key]: value for key, value in gains.items()} | parameters).items():
        table.set(name, value)
    return control_settings(table, profile, mix_of(table))


def job(
    spec: str,
    profile: Profile,
    gains: dict[str, float],
    phi_sp: np.ndarray,
    derivatives: np.ndarray | None = None,
    **parameters: float,
) -> RollJob:
    model = resolve_vehicle(spec)
    rows = model.derivatives.as_array()[None, :] if derivatives is None else derivatives
    lag_s = profile.motor_lag(model.assumptions.motor_lag_s)
    thrust = model.assumptions.hover_thrust
    made = made_settings(spec, profile, gains, **parameters)
    return RollJob(made, rows, lag_s, profile.transport_delay_ticks, thrust, phi_sp)


def flown(what: RollJob, compiled: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """phi, p, delta_lat (T, S) and lost (S,) of the first gain set."""
    batch = Batch(what, compiled)
    blocks = [batch.fly(number) for number in range(len(batch.blocks))]
    join = [np.concatenate([getattr(b, name) for b in blocks], axis=1) for name in ("phi_rad", "p_rad_s", "delta_lat")]
    return join[0], join[1], join[2], np.concatenate([b.lost for b in blocks])


def samples(spec: str, count: int, factor: float = 1.0) -> np.ndarray:
    model = resolve_vehicle(spec)
    sigma = replace(model.sigma_pct, **{k: v * factor for k, v in model.sigma_pct.as_dict().items()})
    return sample_derivatives(model.derivatives, sigma, count, np.random.default_rng(5))


class TestAgainstTheVehicle:
    @pytest.mark.parametrize(
        ("profile", "within_rad"),
        [
            (get_profile("study"), 1e-6),
            # the vehicle sinks a little while it is tilted, and its attitude is late as a quaternion is
            (get_profile("sitl", gyro_noise_rad_s=0.0, gyro_quantum_rad_s=0.0), 1e-3),
            (get_profile("board", gyro_noise_rad_s=0.0, gyro_quantum_rad_s=0.0), 1e-3),
        ],
        ids=["study", "sitl", "board"],
    )
    def test_a_roll_step_is_the_one_that_flies_live(self, flight: Any, profile: Profile, within_rad: float) -> None:
        changes = {} if profile.name == "study" else {"gyro_noise_rad_s": 0.0, "gyro_quantum_rad_s": 0.0}
        live = flight("ant-x", profile.name, **changes)
        live.set_gains("ROLL", *FLOWN.values())
        live.take_off(10.0, settle_s=2.0)
        live.go_offboard()
        live.run(1.0)
        phi_sp = math.radians(10.0)
        seen = []
        for k in range(round(1.5 * profile.rate_hz)):
            if k % 100 == 0:
                live.autopilot.offboard_attitude(from_euler(phi_sp, 0.0, 0.0), (0.0, 0.0, math.nan), 0.5)
            live.vehicle.step()
            seen.append(live.vehicle.truth.euler()[0])
        # asked for between two ticks: the tick after is the first to fly on it
        what = job("ant-x", profile, FLOWN, np.full(len(seen), phi_sp))
        phi, _, _, lost = flown(what, True)
        assert not lost.any()
        assert np.abs(phi[:, 0] - seen).max() < within_rad
        assert np.abs(seen).max() > 0.8 * phi_sp


class TestAgainstMathematics:
    @pytest.mark.parametrize("lag_s", [0.0, 0.02])
    def test_the_plant_between_two_ticks_is_the_matrix_exponential(self, lag_s: float) -> None:
        d = samples("carrier-1", 7)
        made = step_matrices(d, lag_s, 0.004)
        for row, (Yv, Yp, Yd, Lv, Lp, Ld) in zip(made, d, strict=True):
            A = np.array([[Yv, Yp, 9.81], [Lv, Lp, 0.0], [0.0, 1.0, 0.0]])
            B = np.array([Yd, Ld, 0.0])
            E = np.array([1.0, 0.0, 0.0])  # a side force
            free = scipy.linalg.expm(A * 0.004)
            assert row[:3, :3] == pytest.approx(free, abs=1e-12)
            held = np.linalg.solve(A, (free - np.eye(3)) @ np.column_stack([B, E]))
            assert row[:3, 5] == pytest.approx(held[:, 1], abs=1e-12)
            if lag_s:
                assert row[3, 3] == pytest.approx(math.exp(-0.004 / lag_s), rel=1e-12)
                assert row[3, 3] + row[3, 4] == pytest.approx(1.0, rel=1e-12)
                # torque that is there already and stays: motors and command alike
                assert row[:3, 3] + row[:3, 4] == pytest.approx(held[:, 0], rel=1e-9, abs=1e-12)
            else:
                assert row[:3, 4] == pytest.approx(held[:, 0], abs=1e-12)

    def test_hands_off_it_moves_in_its_own_modes(self) -> None:
        """Without gains nothing acts; with a first push by the set-point alone the free motion must follow expm."""
        profile = get_profile("study")
        pulse = np.zeros(800)
        pulse[0] = 0.02
        what = job("ant-r", profile, {"k_phi": 1.0, "kp": 0.0, "ki": 0.0, "kd": 0.0}, pulse, MC_ROLLRATE_FF=0.5)
        phi, p, delta, _ = flown(what, True)
        # FF makes delta = 0.5 (phi_sp - phi): closed by one known constant, so a matrix gives the whole answer
        Yv, Yp, Yd, Lv, Lp, Ld = what.derivatives[0]
        A = np.array([[Yv, Yp, 9.81, Yd], [Lv, Lp, 0.0, Ld], [0.0, 1.0, 0.0, 0.0], [0.0] * 4])
        step = scipy.linalg.expm(A * 1e-3)
        x = np.zeros(3)
        for t in range(800):
            assert phi[t, 0] == pytest.approx(x[2], abs=1e-9)
            assert p[t, 0] == pytest.approx(x[1], abs=1e-7)
            u = 0.5 * (pulse[t] - x[2])
            assert delta[t, 0] == pytest.approx(u, abs=1e-9)
            x = (step @ np.append(x, u))[:3]

    def test_sine_is_the_sine(self) -> None:
        angles = np.linspace(-1.75, 1.75, 401)
        assert array_form(sine)(angles) == pytest.approx(np.sin(angles), abs=1e-13)

    @settings(deadline=None)
    @given(st.floats(-1.5, 1.5), st.floats(-0.8, 0.8), st.floats(0.1, 15.0), st.floats(0.5, 5.0))
    def test_the_attitude_law_of_a_roll_is_that_of_three_axes(
        self, phi: float, phi_sp: float, k_phi: float, rate_max: float
    ) -> None:
        three = attitude_control(
            from_euler(phi, 0.0, 0.0), from_euler(phi_sp, 0.0, 0.0), (k_phi, 4.0, 2.0), 0.4, (rate_max,) * 3, math.nan
        )
        assert roll_attitude_control(phi, phi_sp, k_phi, rate_max, False) == pytest.approx(three[0], abs=1e-9)
        assert three[1] == pytest.approx(0.0, abs=1e-9)


class TestWaysOfRunning:
    @settings(deadline=None, max_examples=15)
    @example("sitl", "ant-x", {"k_phi": 0.0, "kp": 0.0, "ki": 32.0, "kd": 0.0}, 0.5, False)
    @given(
        st.sampled_from(["study", "sitl", "board"]),
        st.sampled_from(["ant-x", "ant-r", "carrier-1", "adam-0"]),
        st.fixed_dictionaries(
            {
                "k_phi": st.floats(0.0, 20.0),
                "kp": st.floats(0.0, 1.0),
                "ki": st.floats(0.0, 50.0),
                "kd": st.floats(0.0, 0.01),
            }
        ),
        st.floats(0.0, 0.9),
        st.booleans(),
    )
    def test_arrays_and_lanes_give_the_same_flight(
        self, name: str, spec: str, gains: dict[str, float], fac: float, notched: bool
    ) -> None:
        """Saturating, cycling, diverging: whatever the gains do.

        An unstable loop makes something of rounding itself. How much it makes of little is seen in a neighbour, the
        same flight with numbers larger by 1e-12 of themselves.
        """
        extra = {"THR_MDL_FAC": fac if name != "study" else 0.0}
        if notched:
            extra |= {"IMU_GYRO_NF0_FRQ": 60.0, "IMU_GYRO_NF0_BW": 20.0}
        phi_sp = np.repeat(np.radians([20.0, -35.0, 0.0]), 60)
        what = job(spec, get_profile(name), gains, phi_sp, samples(spec, 5), **extra)
        near = {key: getattr(what, key) * (1.0 + 1e-12) for key in ("derivatives", "hover_thrust", "phi_sp_rad")}
        *lanes, lost = flown(what, True)
        *arrays, lost_too = flown(what, False)
        *neighbours, _ = flown(replace(what, **near), True)
        assert np.array_equal(lost, lost_too)
        for one, other, neighbour in zip(lanes, arrays, neighbours, strict=True):
            assert np.isfinite(one).all()
            apart, grown = (np.abs(one - it).max(axis=1) for it in (other, neighbour))
            assert (apart <= 1e-9 + 100.0 * np.maximum.accumulate(grown)).all()

    def test_a_sample_does_not_depend_on_its_neighbours(self) -> None:
        d = samples("ant-x", LANES + 3)
        phi_sp = np.full(300, 0.2)
        together = flown(job("ant-x", get_profile("sitl"), FLOWN, phi_sp, d), True)[0]
        assert together.shape == (300, LANES + 3)
        for j in (0, 1, LANES - 1, LANES, LANES + 2):
            alone = flown(job("ant-x", get_profile("sitl"), FLOWN, phi_sp, d[j : j + 1]), True)[0]
            assert np.array_equal(alone[:, 0], together[:, j])

    def test_a_small_job_is_not_compiled_for(self, monkeypatch: pytest.MonkeyPatch) -> None:
        small = job("ant-x", get_profile("sitl"), FLOWN, np.full(100, 0.1))
        monkeypatch.setattr("sitl.batch.is_compiled", lambda law: False)
        assert not Batch(small).compiled
        assert Batch(replace(small, derivatives=np.repeat(small.derivatives, 100_000, axis=0))).compiled
        monkeypatch.setattr("sitl.batch.is_compiled", lambda law: True)
        assert Batch(small).compiled

    def test_is_compiled_knows(self) -> None:
        flown(job("ant-x", get_profile("sitl"), FLOWN, np.full(10, 0.1)), True)
        assert is_compiled(fly_lanes)

    @settings(deadline=None)
    @given(st.floats(-10, 10), st.floats(-10, 10), st.floats(-500, 500), st.floats(-0.3, 0.3), st.booleans())
    def test_the_rate_law_on_an_array_is_the_rate_law(
        self, rate: float, rate_sp: float, accel: float, integral: float, up: bool
    ) -> None:
        fixed = (1.0, 0.2, 0.3, 0.003, 0.01, 0.3)
        one = rate_control(rate, rate_sp, accel, integral, *fixed, up, not up, False, 0.004)
        many = array_form(rate_control)(
            np.array([rate, 0.0]), np.array([rate_sp, 1.0]), np.array([accel, 0.0]), np.array([integral, 0.0]),
            *fixed, np.array([up, False]), np.array([not up, False]), False, 0.004,
        )  # fmt: skip
        assert (many[0][0], many[1][0]) == pytest.approx(one, rel=1e-12, abs=1e-15)


class TestRollTorque:
    @pytest.mark.parametrize("spec", ["ant-x", "ant-r", "carrier-1", "adam-0"])
    @pytest.mark.parametrize("airmode", [0, 1])
    @pytest.mark.parametrize("fac", [0.0, 0.5])
    def test_is_what_the_allocator_gives(self, spec: str, airmode: int, fac: float) -> None:
        made = made_settings(spec, get_profile("sitl"), FLOWN, MC_AIRMODE=airmode, THR_MDL_FAC=fac)
        for thrust in (0.3, 0.5, 0.7):
            torque = roll_torque(made, thrust)
            mix = mix_of(ParameterTable(airframe_parameters(resolve_vehicle(spec), get_profile("sitl"))))
            motors = np.empty(12)
            for wanted in (-3.0, -0.9, -0.31, 0.0, 0.1, 0.4, 0.8, 1.5):
                allocate(made["mix"][0], mix.motors, np.array([wanted, 0, 0]), thrust, 1, airmode, motors)
                commands = np.clip(motors[: mix.motors], 0.0, 1.0)
                thrusts = [motor_output(c, fac) for c in commands]
                delta = float(mix.inverse[0] @ thrusts)
                if torque.clips:
                    assert np.clip(wanted, -torque.limit, torque.limit) == pytest.approx(delta, abs=1e-9)
                else:
                    x = np.linspace(-torque.most, torque.most, len(torque.delta))
                    assert np.interp(wanted, x, torque.delta) == pytest.approx(delta, abs=2e-3)

    def test_without_limits_there_is_none(self) -> None:
        assert roll_torque(made_settings("ant-x", get_profile("study"), FLOWN), 0.5).limit == math.inf

    def test_slew_limits_are_refused_by_name(self) -> None:
        made = made_settings("ant-x", get_profile("sitl"), FLOWN, CA_R0_SLEW=0.5)
        with pytest.raises(UsageError, match="CA_Rn_SLEW"):
            roll_torque(made, 0.5)

    def test_saturation_is_felt(self) -> None:
        """A large step at high gain: the torque stops at the limit that the motors have."""
        gains = {"k_phi": 12.0, "kp": 0.6, "ki": 0.0, "kd": 0.0}
        what = job("ant-x", get_profile("sitl", motor_lag_s=0.0), gains, np.full(200, 0.7))
        delta = flown(what, True)[2]
        assert np.abs(delta).max() == pytest.approx(math.sqrt(0.5), rel=1e-9)
        assert np.count_nonzero(np.abs(delta) > 0.7) > 3


class TestWildInput:
    @pytest.mark.parametrize("compiled", [True, False])
    def test_what_diverges_is_told_and_frozen(self, compiled: bool) -> None:
        d = samples("ant-x", 40)
        d[3, 5] = -450.0  # roll torque the wrong way round
        d[7, 3] = 1e9
        phi, p, delta, lost = flown(job("ant-x", get_profile("study"), FLOWN, np.full(4000, 0.2), d), compiled)
        assert lost[3]
        assert lost[7]
        assert not lost[[0, 1, 2, 10]].any()
        assert np.isfinite(phi).all()
        assert np.isfinite(p).all()
        assert np.isfinite(delta).all()
        assert np.abs(phi).max() <= LOST_RAD

    @pytest.mark.parametrize(
        ("change", "names"),
        [
            ({"derivatives": np.zeros((0, 6))}, "shape"),
            ({"derivatives": np.zeros((3, 5))}, "shape"),
            ({"derivatives": np.full((2, 6), math.nan)}, "sample 0"),
            ({"phi_sp_rad": np.array([])}, "set-points"),
            ({"phi_sp_rad": np.array([math.inf])}, "set-points"),
            ({"motor_lag_s": -0.1}, "motor lag"),
            ({"delay_ticks": -1}, "delay"),
        ],
    )
    def test_what_cannot_be_flown_is_refused(self, change: dict[str, Any], names: str) -> None:
        good = job("ant-x", get_profile("sitl"), FLOWN, np.zeros(10))
        with pytest.raises(UsageError, match=names):
            replace(good, **change)

    def test_no_gain_at_all_is_flown(self) -> None:
        phi, _, delta, lost = flown(
            job("adam-0", get_profile("sitl"), dict.fromkeys(FLOWN, 0.0), np.full(500, 0.2)), True
        )
        assert not delta.any()
        assert not phi.any()
        assert not lost.any()
        assert load_airframe("adam-0").derivatives.Ld > 0
