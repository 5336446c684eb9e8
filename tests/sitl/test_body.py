"""A plant that a real autopilot flies: its time, its sensors, its motors."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.body import RATE_HZ, START_US, Body
from sitl.errors import UsageError
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

ANT_X = resolve_vehicle("ant-x")
SITL = get_profile("sitl")
HOVER = [ANT_X.assumptions.hover_thrust] * 4


class TestTime:
    def test_it_begins_above_zero_and_counts_ticks(self) -> None:
        body = Body(ANT_X, SITL)
        assert body.time_us == START_US
        for k in range(1, 1000):
            body.step(())
            assert body.time_us == START_US + k * 4000

    def test_it_goes_on_over_a_reset(self) -> None:
        body = Body(ANT_X, SITL)
        for _ in range(300):
            body.step([0.8] * 4)
        before_us, reading = body.time_us, body.sensors.accel()
        body.reset()
        assert body.time_us == before_us
        assert body.truth.position_ned() == (0.0, 0.0, 0.0)
        assert body.truth.velocity_ned() == (0.0, 0.0, 0.0)
        assert body.sensors.accel() != reading
        body.step(())
        assert body.time_us == before_us + 4000

    @pytest.mark.parametrize("rate_hz", [100, 400, 1000])
    def test_any_profile_is_flown_at_the_rate_an_autopilot_takes(self, rate_hz: int) -> None:
        body = Body(ANT_X, get_profile("sitl", rate_hz=rate_hz))
        body.step(())
        assert body.time_us - START_US == 1_000_000 // RATE_HZ

    def test_the_linear_form_knows_no_attitude(self) -> None:
        with pytest.raises(UsageError, match='use profile "sitl"'):
            Body(ANT_X, get_profile("study"))


class TestMotion:
    def test_it_stands_until_motors_turn(self) -> None:
        body = Body(ANT_X, SITL)
        for _ in range(500):
            body.step(())
        assert np.abs(body.truth.position_ned()).max() < 1e-6
        assert body.truth.accel_body() == pytest.approx((0.0, 0.0, -9.81))

    def test_it_moves_as_a_vehicle_of_ours_with_the_same_motors(self) -> None:
        body, vehicle = Body(ANT_X, SITL), Vehicle(ANT_X, SITL)
        rng = np.random.default_rng(1)
        for _ in range(400):
            motors = np.zeros(12)
            motors[:4] = np.clip(0.6 + 0.05 * rng.standard_normal(4), 0.0, 1.0)
            body.step(motors[:4].tolist())
            vehicle.plant.step(motors)
        assert np.array_equal(body.plant.x, vehicle.plant.x)
        assert body.truth.position_ned()[2] < -0.5

    def test_motors_that_are_not_told_stand_still(self) -> None:
        body = Body(ANT_X, SITL)
        body.step([1.0] * 16)
        for _ in range(250):
            body.step([0.5])
        assert body.plant.state["motors"][0][:4] == pytest.approx((0.5, 0.0, 0.0, 0.0), abs=1e-6)

    def test_eight_rotors(self) -> None:
        octo = resolve_vehicle("carrier-1")
        body = Body(octo, SITL)
        for _ in range(500):
            body.step([octo.assumptions.hover_thrust * 1.1] * 8)
        assert body.truth.position_ned()[2] < -0.5
        assert np.degrees(body.truth.euler()) == pytest.approx((0.0, 0.0, 0.0), abs=0.1)

    def test_transport_delay_counts_at_this_rate_only(self) -> None:
        late = Body(ANT_X, get_profile("sitl", transport_delay_ticks=5))
        for _ in range(5):
            late.step(HOVER)
        assert not late.plant.state["motors"][0].any()
        late.step(HOVER)
        assert late.plant.state["motors"][0][:4].all()
        other = Body(ANT_X, get_profile("sitl", rate_hz=500, transport_delay_ticks=5))
        other.step(HOVER)
        assert other.plant.state["motors"][0][:4].all()


class TestFixes:
    @pytest.mark.parametrize("start_tick", [0, 7, 900_000])
    def test_ten_a_second_whenever_it_begins(self, start_tick: int) -> None:
        body = Body(ANT_X, SITL)
        body.tick = start_tick
        body.reset()
        fixes = []
        for _ in range(500):
            body.step(())
            if (fix := body.fix()) is not None:
                fixes.append(fix.time_us)
        assert 19 <= len(fixes) <= 21
        assert set(np.diff(fixes[1:])) == {100_000}

    @pytest.mark.parametrize("period_us", [40_000, 200_000])
    def test_at_another_rate(self, period_us: int) -> None:
        body = Body(ANT_X, SITL, gps_period_us=period_us)
        count = 0
        for _ in range(500):
            body.step(())
            count += body.fix() is not None
        assert count == pytest.approx(2_000_000 / period_us, abs=1)

    def test_each_is_handed_over_once(self) -> None:
        body = Body(ANT_X, SITL)
        seen = set()
        for _ in range(200):
            body.step(())
            while (fix := body.fix()) is not None:
                assert fix.time_us not in seen
                seen.add(fix.time_us)

    def test_none_of_before_a_reset_comes_after_it(self) -> None:
        body = Body(ANT_X, SITL, gps_delay_ticks=20)
        for _ in range(110):
            body.step(())
        body.reset()
        at_us = body.time_us
        for _ in range(100):
            body.step(())
            if (fix := body.fix()) is not None:
                assert fix.time_us >= at_us


def test_same_seed_same_readings() -> None:
    def readings(seed: int) -> list[tuple[float, ...]]:
        body = Body(ANT_X, SITL, seed=seed)
        found = []
        for _ in range(50):
            body.step(HOVER)
            found.append((*body.sensors.accel(), *body.sensors.gyro.tolist(), *body.sensors.mag()))
        return found

    assert readings(1) == readings(1) != readings(2)
