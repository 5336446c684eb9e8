"""The simulator's face towards ArduPilot's JSON backend: servo frames in, one line of JSON out for each; no socket.

ArduPilot asks, the plant answers: every frame that follows the one before moves the plant by the time step that the
frame itself names. A frame that comes again, because its answer was late or lost, gets the same answer again.

Source: ArduPilot ``libraries/SITL`` (JSON backend). Its reader takes numbers right behind `"key":`, so no blank may
stand there.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from sitl.true_body import TrueBody

PORT = 9002
MAGICS = {18458: 16, 29569: 32}
"""First number of a frame -> how many outputs follow: 16, or 32 with SERVO_32_ENABLE."""

LOWEST_HZ, HIGHEST_HZ = 50, 8000
"""Rates that are flown. ArduPilot's own time stands still for steps of 0.1 s and longer."""

PWM_LOW_US, PWM_HIGH_US = 1000, 2000
_ODD_LOW_US, _ODD_HIGH_US = 800, 2200
_HEAD = struct.Struct("<HHI")
_COUNTS = 1 << 32


class NotArduPilot(ValueError):
    """A datagram that is no servo frame, or one that cannot be flown; the text says what was seen and what to do."""


@dataclass(frozen=True)
class ServoFrame:
    """What ArduPilot sends.

    Attributes:
        rate_hz: steps per second that it wants (SIM_RATE_HZ). count: from 0 at its start, one more per answer.
        pwm_us: pulse of every output, us; 0 while an output is off.
    """

    rate_hz: int
    count: int
    pwm_us: tuple[int, ...]


def parse_frame(data: bytes) -> ServoFrame:
    """One datagram of ArduPilot's.

    Args:
        data: as it came.

    Raises:
        NotArduPilot: another size or magic number, or a rate that makes no sense.
    """
    magic = int.from_bytes(data[:2], "little") if len(data) >= _HEAD.size else None
    outputs = MAGICS.get(magic) if magic is not None else None
    if outputs is None:
        seen = f"{len(data)} bytes" + (f" with magic number {magic}" if magic is not None else "")
        raise NotArduPilot(
            f"{seen}: a servo frame begins with {' or '.join(str(one) for one in MAGICS)}. Start ArduPilot with "
            "--model JSON:127.0.0.1, and nothing else on this port"
        )
    if len(data) != _HEAD.size + 2 * outputs:
        raise NotArduPilot(
            f"{len(data)} bytes with magic number {magic}: {_HEAD.size + 2 * outputs} belong to {outputs} outputs. "
            "This is another version of ArduPilot's JSON backend"
        )
    _, rate_hz, count = _HEAD.unpack_from(data)
    if not LOWEST_HZ <= rate_hz <= HIGHEST_HZ:
        raise NotArduPilot(
            f"frame_rate {rate_hz} Hz: the plant takes {LOWEST_HZ} to {HIGHEST_HZ} Hz. "
            "Set SIM_RATE_HZ, 1200 by default and not below the copter's loop rate of 400"
        )
    return ServoFrame(rate_hz, count, struct.unpack_from(f"<{outputs}H", data, _HEAD.size))


def state_line(body: TrueBody) -> bytes:
    """The true state: s, rad/s, m/s^2 (specific force), m, m/s; body axes forward-right-down, local north-east-down.

    Args:
        body: just stepped.

    Returns:
        one line between two newlines, as ArduPilot's reader finds it.
    """
    truth = body.truth
    state = {
        "timestamp": body.time_s,
        "imu": {"gyro": truth.rates(), "accel_body": truth.accel_body()},
        "position": truth.position_ned(),
        "velocity": truth.velocity_ned(),
        "quaternion": truth.quat(),
    }
    return f"\n{json.dumps(state, separators=(',', ':'), allow_nan=False)}\n".encode()


@dataclass
class ArduPilotReport:
    """How the two kept step.

    Attributes:
        frames: answered with a step. repeated: frames that came again, answered again or once for several.
        lost: frames that never came. restarts: times ArduPilot began anew.
        outside: pulses that are no servo's, cut.
        served_s: vehicle time altogether, s.
        faults: what makes the flight worthless, in order, each with its vehicle time.
    """

    frames: int = 0
    repeated: int = 0
    lost: int = 0
    restarts: int = 0
    outside: int = 0
    served_s: float = 0.0
    faults: list[str] = field(default_factory=list)


class ArduPilotFace:
    """Steps one body with one ArduPilot, a frame at a time.

    Args:
        body: what flies; it is put on the ground.
        order: rotor of each output, in PX4's numbering from 0.
        say: called with a line for people when something happens.

    Attributes:
        armed: the last frame turns a motor.
        report: how it went.
    """

    def __init__(self, body: TrueBody, order: Sequence[int], *, say: Callable[[str], object] = lambda _: None) -> None:
        self.body = body
        self.armed = False
        self.report = ArduPilotReport()
        self._order = tuple(order)
        self._say = say
        self._count: int | None = None
        self._line = b""
        self._lost = False
        self._before_s = 0.0
        body.reset()

    def answer(self, frame: ServoFrame) -> bytes:
        """What to send back for a frame; the plant has moved if the frame is a new one.

        Args:
            frame: of the one ArduPilot that flies this body.
        """
        if self._count is None:
            self._begin(frame)
        else:
            ahead = (frame.count - self._count) % _COUNTS
            if ahead == 0:
                self.report.repeated += 1
                return self._line
            if ahead >= _COUNTS // 2:
                self.restart(f"its frame count went back from {self._count} to {frame.count}")
            elif ahead > 1:
                self.report.lost += ahead - 1
                self._fault("servo frames were lost")
        self._count = frame.count
        self.body.set_rate(frame.rate_hz)
        motors = self._motors(frame)
        self.armed = any(motors)
        self.body.step(motors)
        self.report.frames += 1
        self.report.served_s = self._before_s + self.body.time_s
        if self.body.plant.lost and not self._lost:
            self._lost = True
            self._fault("the motion diverged out of all sense; it lies upside down until ArduPilot restarts")
        self._line = state_line(self.body)
        return self._line

    def restart(self, why: str) -> None:
        """ArduPilot begins anew: the plant goes back to the ground, its time to zero.

        Args:
            why: how that is known.
        """
        if self.armed:
            self._fault("ArduPilot restarted in flight")
        self._say(f"ArduPilot started anew ({why}): back on the ground")
        self.report.restarts += 1
        self._count, self._lost, self.armed = None, False, False
        self._before_s = self.report.served_s
        self.body.reset()

    def _begin(self, frame: ServoFrame) -> None:
        if frame.count:
            self._say(f"ArduPilot is at frame {frame.count} already: it goes on from the ground here")

    def _motors(self, frame: ServoFrame) -> list[float]:
        """Commands 0..1 in PX4's order."""
        motors = [0.0] * len(self._order)
        for output, rotor in enumerate(self._order):
            pwm_us = frame.pwm_us[output]
            if pwm_us and not _ODD_LOW_US <= pwm_us <= _ODD_HIGH_US:
                self.report.outside += 1
                self._fault(f"output {output + 1} is no servo's pulse ({pwm_us} us), cut to 1000 to 2000 us")
            motors[rotor] = min(1.0, max(0.0, (pwm_us - PWM_LOW_US) / (PWM_HIGH_US - PWM_LOW_US)))
        return motors

    def _fault(self, text: str) -> None:
        kind = text.partition("(")[0]
        if not any(fault.startswith(kind) for fault in self.report.faults):
            self.report.faults.append(f"{text} (vehicle time {self.body.time_s:.3f} s)")
            self._say(self.report.faults[-1])
