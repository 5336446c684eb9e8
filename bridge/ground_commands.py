"""Commands for a vehicle on the ground: calibration, parameter storage, reboot, motor test, logging, failures.

Rules are PX4's (src/modules/commander/Commander.cpp); simulated sensors have nothing to calibrate, so a calibration
is done as soon as it has begun.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from sitl.modes import Result, Severity

if TYPE_CHECKING:
    from bridge.commands import Action, Command
    from bridge.vehicle_server import VehicleServer

_CALIBRATIONS = (
    # param, value, what PX4's calibration texts call it
    (1, 1, "gyro"),
    (2, 1, "mag"),
    (3, 1, "baro"),
    (5, 1, "accel"),
    (5, 2, "level"),
    (5, 4, "accel"),
)
_RADIO_CALIBRATION = 4
_TEMPERATURE, _ESC_CALIBRATION = 3, 7
_STOP_LOGGING_US = 1_000_000
"""PX4 answers LOGGING_STOP only about a second later, when its log stream has ended."""
_FIRST_MOTOR, _LAST_MOTOR, _FIRST_SERVO, _LAST_SERVO = 1, 12, 33, 40
_SENSORS_THAT_CAN_FAIL = range(5)  # FAILURE_UNIT_SENSOR_GYRO .. _GPS
_LONGEST_TEST_S = 3.0


class GroundCommands:
    """Carries out commands for one vehicle on the ground.

    Args:
        server: the vehicle's face.

    """

    def __init__(self, server: VehicleServer) -> None:
        self._server = server
        self._autopilot = server.vehicle.autopilot
        self._later: list[tuple[int, Callable[[], None]]] = []

    def actions(self) -> dict[int, Action]:
        """Return what carries out each MAV_CMD."""
        return {
            187: lambda _: Result.ACCEPTED,  # DO_SET_ACTUATOR: no actuator set is mapped
            212: self._autotune,
            241: self._calibrate,
            245: self._storage,
            246: self._reboot,
            310: self._test_actuator,
            401: lambda _: Result.ACCEPTED,  # RUN_PREARM_CHECKS: they run all the time
            420: self._inject_failure,
            2511: self._stop_logging,
            2600: self._high_latency,
            5300: lambda _: Result.ACCEPTED,  # DO_SET_SAFETY_SWITCH_STATE: there is no switch
        }

    def poll(self, now_us: int) -> None:
        """Send acknowledgements that had to wait. now_us: vehicle time."""
        while self._later and self._later[0][0] <= now_us:
            self._later.pop(0)[1]()

    def _calibrate(self, command: Command) -> Result | None:
        if self._autopilot.armed:
            return Result.TEMPORARILY_REJECTED
        if any(command.whole(index) == _TEMPERATURE for index in (1, 5, 7)):
            return None  # a PX4 leaves it to a module that simulated sensors have no use for
        if command.whole(_ESC_CALIBRATION) == 1:
            return Result.DENIED  # never with a battery connected
        for index, value, name in _CALIBRATIONS:
            if command.whole(index) == value:
                self._server.say(Severity.INFO, f"[cal] calibration started: 2 {name}")
                self._server.say(Severity.INFO, "[cal] progress <100>")
                self._server.say(Severity.INFO, f"[cal] calibration done: {name}")
                return Result.ACCEPTED
        return Result.ACCEPTED if command.whole(_RADIO_CALIBRATION) in (0, 1, 2) else Result.UNSUPPORTED

    def _storage(self, command: Command) -> Result | None:
        if self._autopilot.armed:
            return Result.TEMPORARILY_REJECTED
        return self._server.services.store(command.params[0])

    def _reboot(self, command: Command) -> Result | None:
        wish = command.whole(1)
        if wish == 0:
            return Result.ACCEPTED
        if self._autopilot.armed or wish != 2:
            return Result.DENIED
        # there is no later turn to answer in
        self._server.acknowledge(command.number, Result.ACCEPTED, *command.sender, now=True)
        self._server.shutdown_asked = True
        return None

    def _test_actuator(self, command: Command) -> Result | None:
        """ACTUATOR_TEST: turns one motor for at most three seconds; servos are none."""
        if self._autopilot.armed:
            return Result.DENIED
        number, value, seconds = command.whole(5), command.params[0], command.params[1]
        if not (_FIRST_MOTOR <= number <= _LAST_MOTOR or _FIRST_SERVO <= number <= _LAST_SERVO):
            return None
        if number <= _LAST_MOTOR:
            self._autopilot.test_motor(
                number - _FIRST_MOTOR,
                value if math.isfinite(value) else 0.0,
                seconds if 0.0 < seconds <= _LONGEST_TEST_S else _LONGEST_TEST_S,
            )
        return Result.ACCEPTED

    def _autotune(self, command: Command) -> Result:
        """DO_AUTOTUNE_ENABLE: not offered; choosing axes is denied as on a PX4 multicopter."""
        return Result.DENIED if command.whole(2) else Result.UNSUPPORTED

    def _inject_failure(self, command: Command) -> None:
        """INJECT_FAILURE: PX4's simulator acknowledges it, to nobody in particular, for units it has."""
        if command.whole(1) in _SENSORS_THAT_CAN_FAIL:
            result = Result.ACCEPTED if command.whole(2) == 0 else Result.UNSUPPORTED
            command.link.send("COMMAND_ACK", {"command": command.number, "result": int(result)})

    def _stop_logging(self, command: Command) -> None:
        due_us = self._server.vehicle.time_us + _STOP_LOGGING_US
        if len(self._later) < 8:
            answer = (command.number, Result.ACCEPTED, *command.sender)
            self._later.append((due_us, lambda: self._server.acknowledge(*answer, now=True)))

    def _high_latency(self, _: Command) -> Result:
        self._server.say(Severity.CRITICAL, "Control high latency failed! Telemetry unavailable\t")
        return Result.FAILED
