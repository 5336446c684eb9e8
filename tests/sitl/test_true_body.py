"""The plant with its true state at any rate: the same motion whatever the step, and time that does not drift."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sitl.body import Body
from sitl.errors import UsageError
from sitl.profile import get_profile
from sitl.true_body import TrueBody
from sitl.vehicle_spec import resolve_vehicle

MOTORS = (0.55, 0.56, 0.58, 0.57)


def new_body(rate_hz: float, spec: str = "ant-x") -> TrueBody:
    return TrueBody(resolve_vehicle(spec), get_profile("sitl"), rate_hz=rate_hz)


def test_at_250_hz_it_is_the_plant_that_a_px4_flies() -> None:
    mine, px4s = new_body(250), Body(resolve_vehicle("ant-x"), get_profile("sitl"))
    for _ in range(250):
        mine.step(MOTORS)
        px4s.step(MOTORS)
        np.testing.assert_array_equal(mine.plant.x, px4s.plant.x)
    assert mine.truth.accel_body() == px4s.truth.accel_body()


def test_the_motion_hardly_depends_on_the_rate() -> None:
    ends = []
    for rate_hz in (333, 400, 1200):
        body = new_body(rate_hz)
        for _ in range(rate_hz // 2):
            body.step(MOTORS)
        if body.time_s < 0.5:
            # half a second of an odd rate ends with half a step
            body.set_rate(1.0 / (0.5 - body.time_s))
            body.step(MOTORS)
        assert math.isclose(body.time_s, 0.5, abs_tol=1e-12)
        ends.append(body.plant.x.copy())
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-3)
    np.testing.assert_allclose(ends[1], ends[2], atol=1e-3)


def test_time_is_whole_steps_however_long_it_flies() -> None:
    body = new_body(1200)
    for _ in range(12_000):
        body.step(())
    assert body.time_s == 10.0


def test_another_rate_in_flight_moves_nothing() -> None:
    body = new_body(400)
    for _ in range(200):
        body.step(MOTORS)
    before, time_s = body.plant.x.copy(), body.time_s
    body.set_rate(1000)
    np.testing.assert_array_equal(body.plant.x, before)
    assert body.time_s == time_s
    body.step(MOTORS)
    assert math.isclose(body.time_s - time_s, 1e-3, rel_tol=1e-12)


def test_reset_puts_it_on_the_ground_at_time_zero_and_keeps_the_rate() -> None:
    body = new_body(400)
    for _ in range(200):
        body.step(MOTORS)
    body.reset()
    assert (body.time_s, body.truth.position_ned()) == (0.0, (0.0, 0.0, 0.0))
    body.step(())
    assert (body.time_s, body.truth.accel_body()) == (1 / 400, (0.0, 0.0, -9.81))


def test_the_study_profile_has_no_attitude_to_fly() -> None:
    with pytest.raises(UsageError, match=r'profile "study".*use profile "sitl"'):
        TrueBody(resolve_vehicle("ant-x"), get_profile("study"), rate_hz=400)
