from __future__ import annotations

import math

import pytest

from sitl.landing_watch import LandingWatch, land_limits
from sitl.parameters import ParameterTable

STEP_US = 10_000


class Stretch:
    """One armed stretch, looked at every 10 ms."""

    def __init__(self, **parameters: float) -> None:
        self.parameters = ParameterTable(parameters)
        self.watch = LandingWatch(self.parameters)
        self.now_us = 4_000_000
        self.watch.on_arm(self.now_us)

    def run(self, seconds: float, *, landed: bool) -> list[str]:
        """What was said, and when it began to want disarming, until it did."""
        texts: list[str] = []
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.now_us += STEP_US
            texts += self.watch.update(self.now_us, landed)
        return texts

    def disarms_after_s(self, most_s: float) -> float:
        start_us = self.now_us
        while not self.watch.disarm and self.now_us - start_us < most_s * 1e6:
            self.run(0.01, landed=True)
        return (self.now_us - start_us) * 1e-6


@pytest.mark.parametrize(("wait_s", "after_s"), [(10.0, 11.0), (0.5, 1.5), (3.0, 4.0)])
def test_who_never_takes_off_is_disarmed_a_second_after_com_disarm_prflt(wait_s: float, after_s: float) -> None:
    stretch = Stretch(COM_DISARM_PRFLT=wait_s)
    assert stretch.disarms_after_s(20.0) == pytest.approx(after_s, abs=0.02)
    assert stretch.watch.disarm == "Disarmed by auto preflight disarming\t"


def test_texts_of_a_flight_are_said_once() -> None:
    stretch = Stretch()
    assert stretch.run(2.0, landed=True) == []
    assert stretch.run(20.0, landed=False) == ["Takeoff detected\t"]
    assert stretch.run(1.0, landed=True) == ["Landing detected\t"]
    assert not stretch.watch.disarm


@pytest.mark.parametrize("wait_s", [2.0, 0.1, 6.0])
def test_after_landing_com_disarm_land_counts(wait_s: float) -> None:
    stretch = Stretch(COM_DISARM_LAND=wait_s)
    stretch.run(5.0, landed=False)
    assert stretch.disarms_after_s(20.0) == pytest.approx(wait_s, abs=0.03)
    assert stretch.watch.disarm == "Disarmed by landing\t"


def test_a_hop_starts_the_wait_anew() -> None:
    stretch = Stretch()
    stretch.run(5.0, landed=False)
    stretch.run(1.5, landed=True)
    assert stretch.run(0.1, landed=False) == []
    assert stretch.run(1.5, landed=True) == ["Landing detected\t"]
    assert not stretch.watch.disarm


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("flown", [False, True])
def test_can_be_turned_off(value: float, flown: bool) -> None:
    stretch = Stretch()
    stretch.parameters.set("COM_DISARM_LAND", value)
    stretch.parameters.set("COM_DISARM_PRFLT", value)
    stretch.run(0.1, landed=not flown)
    assert stretch.disarms_after_s(60.0) == pytest.approx(60.0, abs=0.02)
    assert not stretch.watch.disarm


def test_a_new_stretch_knows_nothing_of_the_last() -> None:
    stretch = Stretch()
    stretch.run(5.0, landed=False)
    stretch.disarms_after_s(5.0)
    stretch.watch.on_arm(stretch.now_us)
    assert not stretch.watch.disarm
    assert stretch.disarms_after_s(20.0) == pytest.approx(11.0, abs=0.02)


def test_limits_are_the_parameters() -> None:
    limits = land_limits(ParameterTable({"MPC_THR_HOVER": 0.4, "LNDMC_ROT_MAX": 90.0, "LNDMC_Z_VEL_MAX": 0.3}))
    assert (limits.hover_thrust, limits.z_vel_max) == pytest.approx((0.4, 0.3))
    assert limits.rot_max == pytest.approx(math.pi / 2.0)
