from __future__ import annotations

import pytest

from sitl.land_detector import LandDetector, LandLimits, Motion

LIMITS = LandLimits(thr_min=0.12, hover_thrust=0.5, manual_min=0.08, z_vel_max=0.25, xy_vel_max=1.5, rot_max=0.349)
AT_REST = Motion(
    thrust=0.0,
    velocity_ned=(0.0, 0.0, 0.0),
    rates=(0.0, 0.0, 0.0),
    specific_force=(0.0, 0.0, -9.81),
    climb_controlled=True,
    descending=True,
)
FLYING = AT_REST._replace(thrust=0.5, descending=False)
OFFBOARD = AT_REST._replace(climb_controlled=False, descending=False)


class Watch:
    """A detector looked at every 10 ms, as the autopilot does."""

    def __init__(self) -> None:
        self.detector = LandDetector()
        self.now_us = 5_000_000

    def see(self, motion: Motion, seconds: float, *, armed: bool = True) -> None:
        for _ in range(round(seconds * 100)):
            self.now_us += 10_000
            self.detector.update(self.now_us, motion, LIMITS, armed)

    def time_to_landed(self, motion: Motion) -> float:
        start = self.now_us
        while not self.detector.landed:
            self.see(motion, 0.01)
            assert self.now_us - start < 5_000_000
        return (self.now_us - start) * 1e-6

    def stages(self) -> tuple[bool, bool, bool]:
        return self.detector.ground_contact, self.detector.maybe_landed, self.detector.landed


@pytest.fixture
def flown() -> Watch:
    watch = Watch()
    watch.see(FLYING, 2.0)
    assert watch.stages() == (False, False, False)
    return watch


def test_starts_landed() -> None:
    assert Watch().stages() == (True, True, True)


def test_disarmed_is_landed_whatever_it_does() -> None:
    watch = Watch()
    watch.see(FLYING._replace(velocity_ned=(5.0, 5.0, 5.0)), 1.0, armed=False)
    assert watch.stages() == (True, True, True)


def test_stays_landed_when_armed_and_idle() -> None:
    watch = Watch()
    watch.see(AT_REST, 0.5, armed=False)
    watch.see(AT_REST, 5.0)
    assert watch.stages() == (True, True, True)


def test_takes_off_with_the_first_thrust_that_counts() -> None:
    watch = Watch()
    watch.see(AT_REST, 0.5, armed=False)
    # 10 per cent of the way from minimum to hover
    watch.see(AT_REST._replace(thrust=0.157), 0.5)
    assert watch.detector.landed
    watch.see(AT_REST._replace(thrust=0.159), 0.01)
    assert not watch.detector.landed


def test_three_stages_of_a_third_of_a_second_each(flown: Watch) -> None:
    seen = []
    for _ in range(120):
        flown.see(AT_REST, 0.01)
        seen.append(sum(flown.stages()))
    assert [seen.index(stage) for stage in (1, 2, 3)] == pytest.approx([34, 68, 102], abs=2)


@pytest.mark.parametrize(
    "motion",
    [
        AT_REST._replace(thrust=0.36),
        AT_REST._replace(velocity_ned=(0.0, 0.0, 0.3)),
        AT_REST._replace(velocity_ned=(0.0, 0.0, -0.3)),
        AT_REST._replace(velocity_ned=(1.1, 1.1, 0.0)),
        AT_REST._replace(descending=False),
    ],
    ids=["thrust", "sinking", "rising", "sliding", "not meaning to go down"],
)
def test_no_ground_contact_while(flown: Watch, motion: Motion) -> None:
    flown.see(motion, 3.0)
    assert flown.stages() == (False, False, False)


@pytest.mark.parametrize(
    "motion",
    [
        AT_REST._replace(thrust=0.3),
        AT_REST._replace(rates=(0.3, 0.3, 0.0)),
        AT_REST._replace(specific_force=(0.0, 0.0, -1.0)),
    ],
    ids=["some thrust", "turning", "free fall"],
)
def test_ground_contact_alone_while(flown: Watch, motion: Motion) -> None:
    flown.see(motion, 3.0)
    assert flown.stages() == (True, False, False)


def test_yaw_rate_does_not_matter(flown: Watch) -> None:
    assert flown.time_to_landed(AT_REST._replace(rates=(0.0, 0.0, 5.0))) == pytest.approx(1.0, abs=0.05)


def test_once_landed_a_knock_does_not_undo_it(flown: Watch) -> None:
    flown.time_to_landed(AT_REST)
    flown.see(AT_REST._replace(rates=(0.6, 0.0, 0.0)), 0.5)
    assert flown.detector.landed
    flown.see(AT_REST._replace(rates=(0.9, 0.0, 0.0)), 0.05)
    assert not flown.detector.landed


def test_condition_that_breaks_off_starts_again(flown: Watch) -> None:
    flown.see(AT_REST, 0.3)
    flown.see(FLYING, 0.01)
    assert flown.time_to_landed(AT_REST) == pytest.approx(1.0, abs=0.05)


class TestOffboardAttitude:
    """No climb-rate control: only thrust can say that the vehicle means to be on the ground."""

    @pytest.mark.parametrize(("thrust", "landed"), [(0.0, True), (0.089, True), (0.091, False)])
    def test_lands_at_manual_minimum_thrust(self, flown: Watch, thrust: float, landed: bool) -> None:
        flown.see(OFFBOARD._replace(thrust=thrust), 2.0)
        assert flown.detector.landed is landed

    def test_a_rig_above_that_thrust_is_not_landed(self) -> None:
        # else the integrator would be frozen on a test stand
        watch = Watch()
        watch.see(OFFBOARD._replace(thrust=0.2), 2.0)
        assert not watch.detector.maybe_landed
