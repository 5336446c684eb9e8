"""What a simulator says to an autopilot, field by field, and what it takes from one."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1]))

import itertools

from px4_rules import ACCEL, BARO, GYRO, MAG, Rules, taken

from bridge.connection import Connection, Message
from bridge.simulator import Actuators, Simulator, gps_fields, sensor_fields, truth_fields
from sitl.body import LEAST_NOISE, START_US, Body, sensed
from sitl.profile import Profile, get_profile
from sitl.rotation import from_euler, to_body
from sitl.sensors import EARTH_FIELD_GAUSS, ORIGIN, Gps, geodetic
from sitl.vehicle_spec import resolve_vehicle

ANT_X = resolve_vehicle("ant-x")
NOISES = tuple(LEAST_NOISE)


def quiet() -> Profile:
    """As little noise as a simulator sends."""
    return get_profile("sitl", **dict.fromkeys(NOISES, 0.0))


def body(profile: Profile | None = None, **keys: Any) -> Body:
    return Body(ANT_X, profile or get_profile("sitl"), **keys)


def simulator(*, truth: bool = True, profile: Profile | None = None, **keys: Any) -> Simulator:
    return Simulator(body(profile, **keys), truth=truth)


def run(sim: Simulator, ticks: int, motors: Sequence[float] = ()) -> list[Message]:
    """What was sent in so many ticks."""
    reader = Connection(1, 1)
    heard: list[Message] = []
    for _ in range(ticks):
        heard += reader.receive(sim.frames())
        sim.body.step(motors)
    return heard


def named(heard: Sequence[Message], name: str) -> list[Message]:
    return [message for message in heard if message.name == name]


class Autopilot:
    """Writes what an autopilot sends."""

    def __init__(self, sysid: int = 1) -> None:
        self.connection = Connection(sysid, 1)

    def controls(self, values: Sequence[float], *, time_us: int = 4000, mode: int = 129, flags: int = 1) -> bytes:
        padded = [*values, *[0.0] * (16 - len(values))]
        return self.connection.encode(
            "HIL_ACTUATOR_CONTROLS", time_usec=time_us, controls=padded, mode=mode, flags=flags
        )

    def heartbeat(self, autopilot: int = 12) -> bytes:
        return self.connection.encode("HEARTBEAT", type=2, autopilot=autopilot, mavlink_version=3)

    def ask_for_truth(self, interval_us: float, message: float = 115.0, command: int = 511) -> bytes:
        return self.connection.encode("COMMAND_LONG", command=command, param1=message, param2=interval_us)


class TestTheOrderOfATick:
    def test_the_sample_that_sets_the_clock_comes_last(self) -> None:
        sim = simulator()
        sim.receive(Autopilot().ask_for_truth(4000.0))
        reader = Connection(1, 1)
        for _ in range(60):
            names = [message.name for message in reader.receive(sim.frames())]
            assert names[-1] == "HIL_SENSOR"
            assert names.count("HIL_SENSOR") == 1
            sim.body.step(())

    def test_rates_are_250_50_and_10_a_second(self) -> None:
        heard = run(simulator(), 1000)
        sensors = named(heard, "HIL_SENSOR")
        assert len(sensors) == 1000
        assert {int(b.time_usec) - int(a.time_usec) for a, b in itertools.pairwise(sensors)} == {4000}
        assert sum(bool(m.fields_updated & MAG) for m in sensors) == 200
        assert sum(bool(m.fields_updated & BARO) for m in sensors) == 200
        assert 39 <= len(named(heard, "HIL_GPS")) <= 41

    def test_time_begins_above_zero_and_packets_are_counted(self) -> None:
        heard = run(simulator(), 300)
        assert named(heard, "HIL_SENSOR")[0].time_usec == START_US > 0
        assert [m.seq for m in heard] == [k % 256 for k in range(len(heard))]
        assert {(m.sysid, m.compid) for m in heard} == {(254, 51)}

    def test_a_strict_receiver_has_nothing_to_say(self) -> None:
        for profile in (get_profile("sitl"), quiet()):
            sim = simulator(profile=profile)
            rules = Rules(asked_for_truth=True)
            sim.receive(Autopilot().ask_for_truth(5000.0))
            for message in run(sim, 2500, [0.55] * 4):
                if message.name == "HIL_SENSOR":
                    rules.sensor(message, taken(message))
                elif message.name == "HIL_GPS":
                    rules.gps(message)
            assert rules.problems == []


class TestHilSensor:
    def test_at_rest(self) -> None:
        sensors = named(run(simulator(profile=quiet()), 500), "HIL_SENSOR")
        accel = np.array([(m.xacc, m.yacc, m.zacc) for m in sensors])
        gyro = np.array([(m.xgyro, m.ygyro, m.zgyro) for m in sensors])
        assert accel.mean(axis=0) == pytest.approx((0.0, 0.0, -9.81), abs=2e-3)  # specific force, z down: minus g
        assert gyro.mean(axis=0) == pytest.approx((0.0, 0.0, 0.0), abs=5e-4)
        slow = [m for m in sensors if m.fields_updated & MAG]
        mag = np.mean([(m.xmag, m.ymag, m.zmag) for m in slow], axis=0)
        assert mag == pytest.approx(EARTH_FIELD_GAUSS, abs=3e-4)
        assert np.mean([m.abs_pressure for m in slow]) == pytest.approx(956.0, abs=1.0)  # hPa at 488 m
        assert np.mean([m.pressure_alt for m in slow]) == pytest.approx(ORIGIN[2], abs=0.3)
        assert {m.temperature for m in slow} == {25.0}

    def test_groups_are_complete_and_id_is_zero(self) -> None:
        for m in named(run(simulator(), 50), "HIL_SENSOR"):
            assert m["id"] == 0
            for group in (ACCEL, GYRO, MAG, BARO):
                assert m.fields_updated & group in (0, group)
            assert m.fields_updated & (ACCEL | GYRO) == ACCEL | GYRO
            assert m.fields_updated & ~(ACCEL | GYRO | MAG | BARO) == 0
            assert m.diff_pressure == 0.0

    def test_body_axes_turn_with_the_body(self) -> None:
        turned = body(quiet())
        for phi, theta, psi in ((0.3, 0.0, 0.0), (0.0, -0.4, 0.0), (0.1, 0.2, 1.9)):
            quat = from_euler(phi, theta, psi)
            turned.plant.quat[:] = quat
            while turned.tick % 5:
                turned.tick += 1
            fields = sensor_fields(turned)
            wanted = to_body(quat, EARTH_FIELD_GAUSS)
            assert (fields["xmag"], fields["ymag"], fields["zmag"]) == pytest.approx(wanted, abs=3e-3)

    def test_gyro_is_rad_per_s_about_body_axes_and_not_quantised(self) -> None:
        one = body(quiet())
        one.plant.rates[:] = (0.5, -0.25, 0.125)
        one.sensors.sample(one.time_us)
        fields = sensor_fields(one)
        assert (fields["xgyro"], fields["ygyro"], fields["zgyro"]) == pytest.approx((0.5, -0.25, 0.125), abs=0.01)

    def test_the_accelerometer_reads_what_the_air_does(self) -> None:
        """Yv v + Yp p + Yd delta: without it an estimator is wrong by two degrees and nobody is told."""
        one = body(quiet())
        one.plant.x[2] = -20.0
        left_up = [0.45, 0.55, 0.55, 0.45]  # rolls to the right
        for _ in range(40):
            one.step(left_up)
        d = ANT_X.derivatives
        _, v, _ = one.truth.velocity_body()
        p, _, _ = one.truth.rates()
        wanted = d.Yv * v + d.Yp * p + d.Yd * one.truth.delta()[0]
        assert p > 0.1
        assert abs(wanted) > 0.2
        assert sensor_fields(one)["yacc"] == pytest.approx(wanted, rel=0.15)

    @pytest.mark.parametrize("profile", [get_profile("sitl"), quiet()], ids=["sitl", "quiet"])
    def test_noise_never_repeats_itself_for_long(self, profile: Profile) -> None:
        rules = Rules()
        for message in named(run(simulator(profile=profile), 3000), "HIL_SENSOR"):
            rules.sensor(message, taken(message))
        assert rules.problems == []

    def test_same_seed_same_bytes_another_seed_others(self) -> None:
        def sent(seed: int) -> bytes:
            return b"".join(m.raw_frame for m in run(simulator(seed=seed), 100))

        assert sent(3) == sent(3) != sent(4)

    def test_higher_is_thinner(self) -> None:
        one = body(quiet())
        low = sensor_fields(one)["abs_pressure"]
        one.plant.x[2] = -100.0
        assert sensor_fields(one)["abs_pressure"] == pytest.approx(low - 11.4, abs=0.3)

    @pytest.mark.parametrize("down_m", [-9e4, -44_000.0, 9e4])
    def test_where_no_atmosphere_is_nothing_breaks(self, down_m: float) -> None:
        sim = simulator()
        sim.body.plant.x[2] = down_m
        assert named(run(sim, 10), "HIL_SENSOR")

    def test_a_body_that_is_lost_is_still_sent(self) -> None:
        sim = simulator()
        sim.body.plant.x[10] = 1e9
        heard = named(run(sim, 50, [1.0, 0.0, 1.0, 0.0]), "HIL_SENSOR")
        assert sim.body.plant.lost
        assert all(math.isfinite(m.xacc) and math.isfinite(m.zgyro) for m in heard[2:])


class TestHilGps:
    def test_units(self) -> None:
        fix = Gps(7_000_000, 47.397742, 8.545594, 498.5, (3.0, -4.0, 1.25), 0.3, 0.4, 12, 3)
        fields = gps_fields(fix)
        assert fields == {
            "time_usec": 7_000_000, "fix_type": 3, "lat": 473977420, "lon": 85455940, "alt": 498500,
            "eph": 30, "epv": 40, "vel": 500, "vn": 300, "ve": -400, "vd": 125, "cog": 30687,
            "satellites_visible": 12, "id": 0, "yaw": 0,
        }  # fmt: skip

    def test_course_is_unknown_when_standing(self) -> None:
        assert gps_fields(Gps(1, *ORIGIN, (0.1, 0.1, 3.0)))["cog"] == 65535

    @given(st.tuples(*[st.floats(-1e6, 1e6)] * 3), st.floats(0.0, 1e5))
    def test_any_motion_can_be_sent(self, velocity: tuple[float, float, float], accuracy_m: float) -> None:
        fields = gps_fields(Gps(1, *ORIGIN, velocity, accuracy_m, accuracy_m))
        assert fields["cog"] < 36000 or fields["cog"] == 65535
        Connection(1, 1).encode_fields("HIL_GPS", fields)

    @pytest.mark.parametrize("delay_ticks", [0, 2, 30])
    def test_a_fix_is_late_and_says_when_it_was_taken(self, delay_ticks: int) -> None:
        sim = simulator(profile=quiet(), gps_delay_ticks=delay_ticks)
        reader = Connection(1, 1)
        truth: dict[int, tuple[float, float, float]] = {}
        ages = []
        for _ in range(400):
            truth[sim.body.time_us] = geodetic(sim.body.truth.position_ned())
            for m in reader.receive(sim.frames()):
                if m.name == "HIL_GPS":
                    ages.append(sim.body.time_us - int(m.time_usec))
                    where = truth[int(m.time_usec)]
                    assert m.lat * 1e-7 == pytest.approx(where[0], abs=1e-6)
                    assert m.alt * 1e-3 == pytest.approx(where[2], abs=0.1)
            sim.body.step([0.7] * 4)
        assert len(ages) >= 14
        assert set(ages[1:]) == {delay_ticks * 4000}

    def test_as_accurate_as_it_says(self) -> None:
        fixes = named(run(simulator(), 15_000), "HIL_GPS")
        north_m = np.array([(m.lat * 1e-7 - ORIGIN[0]) * 111_319.49 for m in fixes])
        down_m_s = np.array([m.vd * 0.01 for m in fixes])
        profile = get_profile("sitl")
        assert north_m.std() == pytest.approx(profile.gps_noise_m, rel=0.3)
        assert down_m_s.std() == pytest.approx(profile.gps_noise_m_s, rel=0.3)
        assert north_m.std() <= fixes[0].eph * 0.01

    def test_a_reset_after_an_hour_makes_up_for_no_fixes(self) -> None:
        sim = simulator()
        sim.body.tick = 900_000
        sim.body.reset()
        assert len(named(run(sim, 250), "HIL_GPS")) <= 11


class TestTruth:
    def test_only_when_asked_for(self) -> None:
        assert named(run(simulator(), 300), "HIL_STATE_QUATERNION") == []

    @pytest.mark.parametrize(
        ("interval_us", "count"), [(20_000, 100), (22_000, 91), (100_000, 20), (5000, 100), (1000, 100)]
    )
    def test_at_the_interval_asked_for_or_at_50_hz(self, interval_us: int, count: int) -> None:
        sim = simulator()
        sim.receive(Autopilot().ask_for_truth(interval_us))
        assert len(named(run(sim, 500), "HIL_STATE_QUATERNION")) == pytest.approx(count, abs=1)

    @pytest.mark.parametrize("interval_us", [5000.0, 0.0, -1.0])
    def test_never_to_a_board(self, interval_us: float) -> None:
        """There it would be taken for the state itself, and spoil the scale of every later acceleration."""
        sim = simulator(truth=False)
        sim.receive(Autopilot().ask_for_truth(interval_us))
        assert named(run(sim, 300), "HIL_STATE_QUATERNION") == []

    @pytest.mark.parametrize("interval_us", [-1.0, 0.0, math.nan, math.inf, -math.inf])
    def test_an_interval_that_is_none_stops_it(self, interval_us: float) -> None:
        sim, autopilot = simulator(), Autopilot()
        sim.receive(autopilot.ask_for_truth(4000.0))
        sim.receive(autopilot.ask_for_truth(interval_us))
        assert named(run(sim, 100), "HIL_STATE_QUATERNION") == []

    def test_other_requests_are_not_meant(self) -> None:
        sim, autopilot = simulator(), Autopilot()
        sim.receive(autopilot.ask_for_truth(4000.0, message=30.0))
        sim.receive(autopilot.ask_for_truth(4000.0, command=512))
        assert named(run(sim, 100), "HIL_STATE_QUATERNION") == []

    def test_another_autopilot_asks_anew(self) -> None:
        sim = simulator()
        sim.receive(Autopilot().ask_for_truth(4000.0))
        sim.new_peer()
        assert named(run(sim, 100), "HIL_STATE_QUATERNION") == []

    def test_units(self) -> None:
        one = body(quiet())
        one.plant.x[2] = -10.0
        for _ in range(100):
            one.step([0.56, 0.62, 0.60, 0.58])
        fields = truth_fields(one)
        truth = one.truth
        lat, lon, alt_m = geodetic(truth.position_ned())
        assert fields["time_usec"] == one.time_us
        assert fields["attitude_quaternion"] == truth.quat()
        assert (fields["rollspeed"], fields["pitchspeed"], fields["yawspeed"]) == truth.rates()
        assert (fields["lat"], fields["lon"]) == (round(lat * 1e7), round(lon * 1e7))
        assert fields["alt"] == pytest.approx(alt_m * 1e3, abs=0.5)
        velocity = tuple(value * 100.0 for value in truth.velocity_ned())
        assert (fields["vx"], fields["vy"], fields["vz"]) == pytest.approx(velocity, abs=0.5)
        accel = tuple(value * 1e3 for value in truth.accel_body())
        assert (fields["xacc"], fields["yacc"], fields["zacc"]) == pytest.approx(accel, abs=0.5)
        assert fields["true_airspeed"] == pytest.approx(math.hypot(*truth.velocity_ned()) * 100.0, abs=0.5)

    @given(st.tuples(*[st.floats(-1e5, 1e5)] * 3), st.tuples(*[st.floats(-300.0, 300.0)] * 3))
    def test_whatever_the_state(self, where: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        one = body()
        one.plant.x[0:3] = where
        one.plant.velocity[:] = velocity
        Connection(1, 1).encode_fields("HIL_STATE_QUATERNION", truth_fields(one))
        Connection(1, 1).encode_fields("HIL_SENSOR", sensor_fields(one))


class TestActuators:
    def test_as_sent(self) -> None:
        values = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]
        (made,) = simulator().receive(Autopilot().controls(values, time_us=123_456))
        assert made.time_us == 123_456
        assert made.motors == pytest.approx((*values, *[0.0] * 8))
        assert made.armed
        assert made.lockstep

    @pytest.mark.parametrize(("mode", "armed"), [(1, False), (129, True), (53, False), (181, True)])
    @pytest.mark.parametrize("flags", [0, 1])
    def test_flags(self, mode: int, armed: bool, flags: int) -> None:
        (made,) = simulator().receive(Autopilot().controls([0.0], mode=mode, flags=flags))
        assert (made.armed, made.lockstep) == (armed, bool(flags))

    @pytest.mark.parametrize(
        ("value", "motor", "not_numbers", "outside"),
        [
            (math.nan, 0.0, 1, 0), (math.inf, 0.0, 1, 0), (-math.inf, 0.0, 1, 0), (5.0, 1.0, 0, 1),
            (-3.0, 0.0, 0, 1), (-0.5, 0.0, 0, 0), (1.0, 1.0, 0, 0), (3e38, 1.0, 0, 1),
        ],
    )  # fmt: skip
    def test_odd_values_are_made_safe_and_counted(
        self, value: float, motor: float, not_numbers: int, outside: int
    ) -> None:
        sim = simulator()
        (made,) = sim.receive(Autopilot().controls([0.5, value]))
        assert made.motors[:2] == (0.5, motor)
        assert (sim.not_numbers, sim.outside) == (not_numbers, outside)

    @given(st.lists(st.floats(width=32), min_size=16, max_size=16))
    def test_motors_are_always_safe(self, values: list[float]) -> None:
        (made,) = simulator().receive(Autopilot().controls(values))
        assert all(0.0 <= motor <= 1.0 for motor in made.motors)

    @given(st.binary(max_size=300))
    def test_garbage_moves_nothing(self, data: bytes) -> None:
        sim = simulator()
        sim.receive(data)
        assert sim.receive(Autopilot().controls([0.5])) or sim.connection.pending
        assert named(run(sim, 1), "HIL_SENSOR")

    @given(st.binary(max_size=60), st.lists(st.integers(1, 40), max_size=12))
    def test_cut_anywhere_it_is_the_same(self, noise: bytes, cuts: list[int]) -> None:
        autopilot, sim = Autopilot(), simulator()
        data = b"".join(autopilot.controls([0.1 * k], time_us=k) for k in range(1, 6))
        found: list[Actuators] = []
        for cut in cuts:
            found += sim.receive(data[:cut])
            data = data[cut:]
        found += sim.receive(data)
        assert [one.time_us for one in found] == [1, 2, 3, 4, 5]


class TestWhoIsThere:
    def test_the_first_autopilot_counts_others_are_strangers(self) -> None:
        sim = simulator()
        sim.receive(Autopilot(2).heartbeat())
        assert (sim.system, sim.is_px4) == (2, True)
        assert sim.receive(Autopilot(1).controls([1.0])) == []
        assert sim.receive(Autopilot(2).controls([1.0]))
        assert sim.strangers == 1

    def test_motors_alone_tell_who_it_is(self) -> None:
        sim = simulator()
        assert sim.receive(Autopilot(7).controls([0.2]))
        assert (sim.system, sim.is_px4) == (7, None)

    @pytest.mark.parametrize("autopilot", [3, 0, 4])
    def test_another_kind_of_autopilot(self, autopilot: int) -> None:
        sim = simulator()
        sim.receive(Autopilot().heartbeat(autopilot))
        assert sim.is_px4 is False

    def test_a_ground_station_is_no_autopilot(self) -> None:
        sim = simulator()
        sim.receive(Autopilot(255).heartbeat(8))
        assert (sim.system, sim.is_px4) == (0, None)

    def test_what_is_for_ground_stations_is_kept_but_not_for_ever(self) -> None:
        sim, autopilot = simulator(), Autopilot()
        for k in range(500):
            sim.receive(autopilot.connection.encode("ATTITUDE", time_boot_ms=k))
        assert len(sim.others) < 100
        assert sim.others[-1].time_boot_ms == 499

    def test_its_own_heartbeat_is_no_autopilots(self) -> None:
        (message,) = Connection(1, 1).receive(simulator().heartbeat())
        assert (message.name, message.autopilot, message.base_mode) == ("HEARTBEAT", 8, 0)


def test_a_profile_for_a_real_autopilot() -> None:
    given_ = get_profile("sitl", rate_hz=800, transport_delay_ticks=8, gyro_noise_rad_s=0.0)
    made = sensed(given_)
    assert made.rate_hz == 250
    assert made.transport_delay_ticks == 0
    assert made.gyro_quantum_rad_s == 0.0
    assert made.gyro_noise_rad_s == LEAST_NOISE["gyro_noise_rad_s"]
    assert sensed(replace(given_, gyro_noise_rad_s=0.02)).gyro_noise_rad_s == 0.02
    assert sensed(get_profile("sitl", transport_delay_ticks=3)).transport_delay_ticks == 3


class TestTheQuickWay:
    """One whole frame in a piece, nearly always, goes past the splitter: with the same result."""

    @given(
        st.lists(st.floats(0.0, 1.0, width=32), min_size=16, max_size=16),
        st.integers(0, 2**63),
        st.sampled_from([0, 1]),
        st.sampled_from([0, 1, 129, 255]),
    )
    def test_whole_or_in_pieces(self, controls: list[float], time_us: int, flags: int, mode: int) -> None:
        frames = [
            Connection(1, 1).encode(
                "HIL_ACTUATOR_CONTROLS", time_usec=time_us, controls=controls, flags=flags, mode=mode
            )
        ] * 2
        whole, pieces = simulator(), simulator()
        made = [one for frame in frames for one in whole.receive(frame)]
        cut = b"".join(frames)
        assert made == [one for k in range(len(cut)) for one in pieces.receive(cut[k : k + 1])]
        assert repr(whole.connection.counters) == repr(pieces.connection.counters)

    def test_what_is_sent_is_what_the_general_way_sends(self) -> None:
        one = simulator()
        for _ in range(20):
            one.body.step((0.5,) * 4)
            sent = Connection(9, 9).receive(one.frames())[-1]
            general = Connection(9, 9).encode_fields("HIL_SENSOR", sensor_fields(one.body))
            assert sent.raw_payload == Connection(9, 9).receive(general)[0].raw_payload
