"""ArduPilot's side of its JSON backend, as strict as its reader; and a pilot of its own, with ArduPilot's motor order.

Nothing here is the program's: the motor order, the mix and the reader are written anew from ArduPilot's documents.
"""

from __future__ import annotations

import json
import math
import re
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any

# ArduPilot's motors: (angle clockwise from the nose, deg; +1 counter-clockwise seen from above)
QUAD_X = ((45, 1), (-135, 1), (-45, -1), (135, -1))
OCTA_X = ((22.5, -1), (-157.5, -1), (67.5, 1), (157.5, 1), (-22.5, 1), (-112.5, 1), (-67.5, -1), (112.5, -1))

NEEDED = ("timestamp", "gyro", "accel_body", "position", "quaternion", "velocity")


def servo_frame(count: int, pwm: Sequence[int], *, rate_hz: int = 400, outputs: int = 16) -> bytes:
    """A servo frame, unused outputs off."""
    pulses = list(pwm) + [0] * (outputs - len(pwm))
    return struct.pack(f"<HHI{outputs}H", {16: 18458, 32: 29569}[outputs], rate_hz, count, *pulses)


def read_line(data: bytes) -> dict[str, Any]:
    """The state in one answer, checked as ArduPilot's reader needs it: framed, numbers right behind the keys."""
    assert (data[:1], data[-1:], data.count(b"\n")) == (b"\n", b"\n", 2), data
    text = data.decode("ascii").strip("\n")
    for key in NEEDED:
        found = re.search(rf'"{key}":(\[?)(-?[0-9])', text)
        assert found, f"ArduPilot finds no {key} in {text}"
        assert bool(found[1]) == (key != "timestamp")
    state: dict[str, Any] = json.loads(text, parse_constant=_refused)
    numbers = [*state["imu"]["gyro"], *state["imu"]["accel_body"], *state["position"], *state["velocity"]]
    assert (len(numbers), len(state["quaternion"])) == (12, 4)
    assert all(math.isfinite(one) for one in numbers)
    assert math.isclose(sum(one * one for one in state["quaternion"]), 1.0, abs_tol=1e-6)
    return state


def _refused(name: str) -> float:
    raise AssertionError(f"{name} is no number for ArduPilot")


class StandIn:
    """One ArduPilot process: a socket, a frame count, and the lockstep with its repeats."""

    def __init__(self, port: int, *, rate_hz: int = 400, outputs: int = 16) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(0.2)
        self.rate_hz = rate_hz
        self.outputs = outputs
        self.count = 0
        self.time_s = 0.0
        self.repeats = 0
        self.line = b""

    def step(self, pwm: Sequence[int]) -> dict[str, Any]:
        """Send the outputs, wait for the state; without an answer, the same frame goes out again."""
        state = self.ask(pwm)
        step_s = state["timestamp"] - self.time_s
        assert math.isclose(step_s, 1.0 / self.rate_hz, abs_tol=1e-9), f"a step of {step_s} s at {self.rate_hz} Hz"
        self.time_s = state["timestamp"]
        self.count += 1
        return state

    def ask(self, pwm: Sequence[int], *, tries: int = 400) -> dict[str, Any]:
        """The answer to the present frame, however often that takes; the count stays."""
        for _ in range(tries):
            try:
                self.socket.send(servo_frame(self.count, pwm, rate_hz=self.rate_hz, outputs=self.outputs))
                self.line = self.socket.recv(65000)
            except TimeoutError:
                self.repeats += 1
                continue
            except ConnectionRefusedError:
                # no plant yet, and the system says so at once
                time.sleep(0.05)
                continue
            return read_line(self.line)
        raise AssertionError("the plant does not answer")

    def answered(self, wait_s: float = 0.3) -> bool:
        """Whether something comes without being asked for once more."""
        self.socket.settimeout(wait_s)
        try:
            self.line = self.socket.recv(65000)
        except (TimeoutError, ConnectionRefusedError):
            return False
        finally:
            self.socket.settimeout(0.2)
        return True

    def find(self, data: bytes) -> None:
        """Send this until it arrives somewhere, and no longer; nothing may answer."""
        for _ in range(100):
            try:
                self.socket.send(data)
                self.line = self.socket.recv(65000)
            except ConnectionRefusedError:
                time.sleep(0.05)
            except TimeoutError:
                return
        raise AssertionError("nobody listens")

    def close(self) -> None:
        self.socket.close()


class Pilot:
    """Holds attitude and height: rate and attitude loops, ArduPilot's mix, pulses of whole microseconds."""

    def __init__(
        self, motors: Sequence[tuple[float, int]], rate_hz: int, *, p: float, d: float, k: float = 6.0, hover: float
    ) -> None:
        angles = [math.radians(angle) for angle, _ in motors]
        rows = [
            [-math.sin(angle) for angle in angles],
            [math.cos(angle) for angle in angles],
            [float(turn) for _, turn in motors],
        ]
        # ArduPilot scales each row so that its largest entry is one half
        self.rows = [[0.5 * one / max(abs(other) for other in row) for one in row] for row in rows]
        self.dt_s = 1.0 / rate_hz
        self.p, self.d, self.k, self.hover = p, d, k, hover
        self.integral = [0.0, 0.0]
        self.rates = [0.0, 0.0]

    def pulses(self, state: dict[str, Any], roll_sp: float, height_sp: float) -> list[int]:
        w, x, y, z = state["quaternion"]
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        gyro = state["imu"]["gyro"]
        command = []
        for axis, error in enumerate((roll_sp - roll, -pitch)):
            rate_error = self.k * error - gyro[axis]
            self.integral[axis] = max(-0.3, min(0.3, self.integral[axis] + 2.0 * self.p * rate_error * self.dt_s))
            slope = (gyro[axis] - self.rates[axis]) / self.dt_s
            self.rates[axis] = gyro[axis]
            command.append(self.p * rate_error + self.integral[axis] - self.d * slope)
        command.append(0.3 * (-yaw) - 0.15 * gyro[2])
        height, climb = -state["position"][2], -state["velocity"][2]
        lift = self.hover + 0.08 * (height_sp - height) - 0.12 * climb
        lift = max(0.2, min(0.8, lift)) / max(0.5, math.cos(roll) * math.cos(pitch))
        pulses = []
        for motor in range(len(self.rows[0])):
            thrust = lift + sum(value * row[motor] for value, row in zip(command, self.rows, strict=True))
            pulses.append(round(1000 + 1000 * max(0.0, min(1.0, thrust))))
        return pulses
