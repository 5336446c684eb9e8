"""Motors that stand still under an autopilot that asks for thrust."""

from __future__ import annotations

from scenarios.motor_watch import LIMIT_US, MotorWatch


def test_all_standing_for_a_second_is_noticed_and_not_before() -> None:
    watch = MotorWatch(4)
    assert watch.standing(0, [0.0] * 4, 0.5) == []
    assert watch.standing(LIMIT_US - 1, [0.0] * 4, 0.5) == []
    assert watch.standing(LIMIT_US, [0.0] * 4, 0.5) == [1, 2, 3, 4]


def test_an_octo_with_four_outputs_unassigned() -> None:
    watch = MotorWatch(8)
    motors = [0.9] * 4 + [0.0] * 12
    watch.standing(0, motors, 0.6)
    assert watch.standing(LIMIT_US, motors, 0.6) == [5, 6, 7, 8]


def test_no_commands_at_all_count_as_standing() -> None:
    watch = MotorWatch(4)
    watch.standing(0, (), 0.5)
    assert watch.standing(LIMIT_US, (), 0.5) == [1, 2, 3, 4]


def test_a_motor_that_a_limit_cycle_cuts_to_zero_comes_back_and_is_no_finding() -> None:
    watch = MotorWatch(4)
    for at_us in range(0, 5 * LIMIT_US, 4_000):
        low = (at_us // 100_000) % 2
        assert watch.standing(at_us, [0.5, 0.5, 0.5, 0.0 if low else 0.3], 0.5) == []


def test_without_thrust_asked_for_motors_may_stand() -> None:
    watch = MotorWatch(4)
    watch.standing(0, [0.0] * 4, 0.5)
    assert watch.standing(LIMIT_US, [0.0] * 4, 0.0) == []
    assert watch.standing(LIMIT_US + 1, [0.0] * 4, 0.5) == []
