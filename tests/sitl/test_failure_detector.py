from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.failsafe import Action
from sitl.failure_detector import TiltDetector
from sitl.modes import Mode
from sitl.parameters import ParameterTable
from sitl.rotation import from_euler

TILTED, UPRIGHT = math.radians(61.0), math.radians(59.0)


class TestTilt:
    def watch(self, detector: TiltDetector, phi: float, theta: float, start_us: int, seconds: float) -> int:
        for now_us in range(start_us, start_us + round(seconds * 1e6), 10_000):
            detector.update(now_us, phi, theta, True)
        return start_us + round(seconds * 1e6)

    @pytest.mark.parametrize(("phi", "theta"), [(TILTED, 0.0), (-TILTED, 0.0), (0.0, TILTED), (0.0, -TILTED)])
    def test_fails_after_300_ms_beyond_60_degrees(self, phi: float, theta: float) -> None:
        detector = TiltDetector(ParameterTable())
        now_us = self.watch(detector, phi, theta, 0, 0.3)
        assert not detector.failed
        self.watch(detector, phi, theta, now_us, 0.02)
        assert detector.failed

    def test_shorter_excursions_do_not_add_up(self) -> None:
        detector, now_us = TiltDetector(ParameterTable()), 0
        for _ in range(5):
            now_us = self.watch(detector, TILTED, 0.0, now_us, 0.25)
            now_us = self.watch(detector, UPRIGHT, 0.0, now_us, 0.02)
        assert not detector.failed

    def test_recovers_when_upright_again(self) -> None:
        detector = TiltDetector(ParameterTable())
        now_us = self.watch(detector, TILTED, 0.0, 0, 0.5)
        assert detector.failed
        self.watch(detector, UPRIGHT, 0.0, now_us, 0.02)
        assert not detector.failed

    def test_obeys_its_parameters_as_they_change(self) -> None:
        table = ParameterTable({"FD_FAIL_R": 30, "FD_FAIL_R_TTRI": 0.1})
        detector = TiltDetector(table)
        now_us = self.watch(detector, 0.6, 0.0, 0, 0.15)
        assert detector.failed
        table.set("FD_FAIL_R", 0)
        self.watch(detector, 3.0, 0.0, now_us, 1.0)
        assert not detector.failed

    def test_not_watched_not_failed(self) -> None:
        detector = TiltDetector(ParameterTable())
        for now_us in range(0, 1_000_000, 10_000):
            detector.update(now_us, 3.0, 3.0, False)
        assert not detector.failed

    @pytest.mark.parametrize(
        ("breaker", "armed_s", "action"),
        [
            (121212, 3.9, Action.DISARM),
            (0, 3.9, Action.DISARM),
            (121212, 4.1, Action.WARN),
            (0, 4.1, Action.TERMINATE),
        ],
    )
    def test_disarms_just_after_arming_and_later_only_if_the_breaker_allows(
        self, breaker: int, armed_s: float, action: Action
    ) -> None:
        detector = TiltDetector(ParameterTable({"CBRK_FLIGHTTERM": breaker}))
        assert detector.action(round(armed_s * 1e6)) is action


class TestAttitudeFailure:
    def tip(self, made: Any, seconds: float) -> None:
        """Fly on the side: 75 degrees of roll, with thrust to spare."""
        quat = from_euler(math.radians(75.0), 0.0, 0.0)
        made.run(seconds, lambda k: made.autopilot.offboard_attitude(quat, (0.0, 0.0, math.nan), 0.9))

    def test_is_a_warning_by_default_and_passes(self, offboard: Any) -> None:
        self.tip(offboard, 1.2)
        assert offboard.said("Attitude failure detected\t")
        assert offboard.autopilot.failsafe
        assert offboard.autopilot.armed
        assert offboard.autopilot.mode is Mode.OFFBOARD
        offboard.run(2.0, offboard.keep)
        assert not offboard.autopilot.failsafe
        assert len(offboard.texts) == 1

    def test_terminates_if_the_circuit_breaker_is_open(self, offboard: Any) -> None:
        offboard.parameters.set("CBRK_FLIGHTTERM", 0)
        self.tip(offboard, 1.2)
        assert offboard.autopilot.terminated
        assert offboard.autopilot.motors == (0.0, 0.0, 0.0, 0.0)

    def test_just_after_arming_it_disarms(self, flight: Any) -> None:
        made = flight()
        made.get_ready()
        made.autopilot.command_mode(Mode.OFFBOARD)
        made.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.nan), 0.9)
        made.arm()
        made.run(1.5, lambda k: made.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.nan), 0.9))
        self.tip(made, 1.2)
        assert made.said("Attitude failure detected\t")
        assert made.said("Disarmed by failsafe\t")
        assert not made.autopilot.armed
