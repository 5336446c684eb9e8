"""Whole flights by sticks: armed, up, about, down and disarmed by landing."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.modes import LandedState, Mode, Result


@pytest.fixture
def made(ground: Any, pilot: Any) -> Any:
    """On the ground; ``made.pilot`` holds the sticks."""
    ground.pilot = pilot(ground)
    return ground


def arm(made: Any, mode: Mode, **sticks: float) -> None:
    made.pilot.fly(0.2, **sticks)
    assert made.autopilot.command_mode(mode) is Result.ACCEPTED
    made.pilot.fly(0.2, **sticks)
    assert made.autopilot.command_arm(True) is Result.ACCEPTED, made.autopilot.rejection
    made.listen()


def said(made: Any) -> list[str]:
    return [text for _, text in made.texts]


@pytest.mark.parametrize("mode", [Mode.POSCTL, Mode.POSITION_SLOW])
def test_position(made: Any, mode: Mode) -> None:
    truth = made.vehicle.truth
    arm(made, mode)
    made.pilot.fly(3.0)
    # the throttle's centre is no wish to take off
    assert made.autopilot.landed_state is LandedState.ON_GROUND
    assert truth.position_ned() == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    made.pilot.fly_until(lambda: truth.position_ned()[2] < -6.0, 15.0, throttle=1.0)
    made.pilot.fly(3.0)
    assert math.hypot(*truth.position_ned()[:2]) < 0.5
    assert abs(truth.velocity_ned()[2]) < 0.1
    made.pilot.fly(4.0, pitch=0.7)
    assert truth.velocity_ned()[0] > 3.0
    assert abs(truth.velocity_ned()[1]) < 0.2
    made.pilot.fly(6.0)
    place = truth.position_ned()
    assert place[0] > 10.0
    made.pilot.fly(5.0)
    assert truth.position_ned() == pytest.approx(place, abs=0.3)
    made.pilot.fly_until(lambda: not made.autopilot.armed, 40.0, throttle=-1.0)
    assert said(made) == [
        "Armed by external command\t",
        "Takeoff detected\t",
        "Landing detected\t",
        "Disarmed by landing\t",
    ]
    assert made.autopilot.mode is made.autopilot.intended is mode
    assert truth.position_ned()[2] == pytest.approx(0.0, abs=0.01)
    assert not made.autopilot.failsafe


@pytest.mark.parametrize("mode", [Mode.ALTCTL, Mode.ALTITUDE_CRUISE])
def test_altitude(made: Any, mode: Mode) -> None:
    truth = made.vehicle.truth
    arm(made, mode)
    made.pilot.fly_until(lambda: truth.position_ned()[2] < -5.0, 15.0, throttle=0.8)
    made.pilot.fly(3.0)
    height = truth.position_ned()[2]
    made.pilot.fly(2.0, roll=0.3)
    assert truth.velocity_ned()[1] > 1.0
    assert truth.euler()[0] == pytest.approx(math.atan(0.3 * math.tan(math.radians(35.0))), abs=0.05)
    made.pilot.fly(1.0)
    assert truth.position_ned()[2] == pytest.approx(height, abs=0.5)
    # nothing brakes it in this mode; let go on and land in Position
    assert made.autopilot.command_mode(Mode.POSCTL) is Result.ACCEPTED
    made.pilot.fly(5.0)
    made.pilot.fly_until(lambda: not made.autopilot.armed, 40.0, throttle=-1.0)
    assert said(made)[-2:] == ["Landing detected\t", "Disarmed by landing\t"]
    assert made.autopilot.mode is Mode.POSCTL


@pytest.mark.parametrize("mode", [Mode.STABILIZED, Mode.MANUAL])
def test_stabilized(made: Any, mode: Mode) -> None:
    truth = made.vehicle.truth
    arm(made, mode, throttle=-1.0)
    made.pilot.fly(2.0, throttle=-1.0)
    assert made.autopilot.landed_state is LandedState.ON_GROUND
    made.pilot.fly_until(lambda: truth.position_ned()[2] < -3.0, 8.0, throttle=0.25)
    made.pilot.fly(0.8, throttle=0.0, roll=0.4)
    assert truth.euler()[0] == pytest.approx(math.radians(14.0), abs=math.radians(2.0))
    made.pilot.fly(0.8, throttle=0.0, roll=-0.4)
    made.pilot.fly_until(lambda: truth.position_ned()[2] > -0.02, 30.0, throttle=-0.2)
    made.pilot.fly_until(lambda: not made.autopilot.armed, 8.0, throttle=-1.0)
    assert said(made) == [
        "Armed by external command\t",
        "Takeoff detected\t",
        "Landing detected\t",
        "Disarmed by landing\t",
    ]
    assert made.autopilot.mode is mode


def test_acro_and_back_to_position(made: Any) -> None:
    truth = made.vehicle.truth
    arm(made, Mode.ACRO, throttle=-1.0)
    made.pilot.fly(1.5, throttle=-1.0)
    made.pilot.fly_until(lambda: truth.position_ned()[2] < -4.0, 8.0, throttle=0.3)
    made.pilot.fly(0.4, throttle=0.0, roll=0.5)
    assert math.degrees(made.autopilot.attitude_sp.rates[0]) == pytest.approx(50.0, abs=0.5)
    assert math.degrees(truth.rates()[0]) == pytest.approx(50.0, abs=8.0)
    leaning = truth.euler()[0]
    made.pilot.fly(0.3, throttle=0.1)
    # nothing levels it
    assert truth.euler()[0] > 0.9 * leaning > 0.2
    assert made.autopilot.command_mode(Mode.POSCTL) is Result.ACCEPTED
    made.pilot.fly(6.0)
    assert truth.velocity_ned() == pytest.approx((0.0, 0.0, 0.0), abs=0.1)
    made.pilot.fly_until(lambda: not made.autopilot.armed, 60.0, throttle=-1.0)


def test_sticks_let_go_on_the_ground_do_not_lift_it(made: Any) -> None:
    arm(made, Mode.POSCTL)
    made.run(12.0)
    assert not made.autopilot.armed
    assert made.vehicle.truth.position_ned() == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert "Takeoff detected\t" not in said(made)
