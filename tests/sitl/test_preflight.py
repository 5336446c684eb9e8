from __future__ import annotations

import pytest

from sitl.failsafe import Links
from sitl.modes import CLIMB_MODES, STICK_MODES, Mode
from sitl.preflight import health_problem, mode_problem, stick_problem
from sitl.setpoints import Sticks

ALL_THERE = Links(False, False, False)


def test_nothing_wrong_is_empty() -> None:
    assert health_problem(True, False, 4, False) == ""


@pytest.mark.parametrize(
    ("healthy", "terminated", "motors", "no_gcs", "word"),
    [
        (False, True, 0, True, "heading estimate invalid"),
        (True, True, 0, True, "terminated"),
        (True, False, 0, True, "CA_ROTOR"),
        (True, False, 4, True, "No connection to the ground control station"),
    ],
)
def test_the_first_problem_is_named(healthy: bool, terminated: bool, motors: int, no_gcs: bool, word: str) -> None:
    assert word in health_problem(healthy, terminated, motors, no_gcs)


@pytest.mark.parametrize("mode", list(Mode))
def test_what_a_mode_needs(mode: Mode) -> None:
    assert mode_problem(mode, ALL_THERE, "") == ""
    no_sticks = mode_problem(mode, ALL_THERE._replace(manual_lost=True), "")
    assert no_sticks == ("no manual control" if mode in STICK_MODES else "")
    no_signal = mode_problem(mode, ALL_THERE._replace(offboard_lost=True), "")
    assert no_signal == ("no offboard signal" if mode is Mode.OFFBOARD else "")
    assert mode_problem(mode, ALL_THERE._replace(gcs_lost=True), "") == ""
    assert mode_problem(mode, ALL_THERE, "No valid mission") == "No valid mission"


@pytest.mark.parametrize("mode", list(Mode))
def test_throttle_counts_only_in_modes_by_sticks(mode: Mode) -> None:
    assert stick_problem(mode, None) == ""
    assert stick_problem(mode, Sticks(throttle=-1.0)) == ""
    high = stick_problem(mode, Sticks(throttle=1.0))
    if mode in CLIMB_MODES:
        assert high == "throttle above center"
    else:
        assert high == ("throttle not in safe position" if mode in STICK_MODES else "")
    centred = stick_problem(mode, Sticks())
    assert bool(centred) is (mode in STICK_MODES - CLIMB_MODES)
