"""What a PX4 takes from a simulator, and what it does not forgive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from bridge.connection import Message

GYRO_LSB = math.radians(2000.0 / 32768.0)
"""rad/s of one count of the simulated gyro, which a PX4 cuts towards zero."""
ACCEL_LSB = 9.80665 / 2048.0
"""m/s^2."""

ACCEL, GYRO, MAG, BARO, PITOT = 0x7, 0x38, 0x1C0, 0x1A00, 0x400
GROUPS = {"ACCEL": ACCEL, "GYRO": GYRO, "MAG": MAG, "BARO": BARO, "PITOT": PITOT}

STALE = 25
"""Identical readings in a row after which a sensor counts as dead."""

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class Sample:
    """One HIL_SENSOR as a PX4 takes it in; None for what it ignores. SI, gauss, hPa; body forward-right-down."""

    time_us: int
    gyro: Vec3 | None
    accel: Vec3 | None
    mag: Vec3 | None
    pressure_hpa: float | None


def taken(message: Message) -> Sample:
    """What a PX4 makes of a HIL_SENSOR with id 0."""

    def group(bits: int, *names: str) -> tuple[float, ...] | None:
        # a group that is not complete is ignored
        return tuple(message[name] for name in names) if message.fields_updated & bits == bits else None

    gyro = group(GYRO, "xgyro", "ygyro", "zgyro")
    accel = group(ACCEL, "xacc", "yacc", "zacc")
    baro = group(BARO, "abs_pressure")
    mag = group(MAG, "xmag", "ymag", "zmag")
    return Sample(
        int(message.time_usec),
        quantised(gyro, GYRO_LSB) if gyro else None,
        quantised(accel, ACCEL_LSB) if accel else None,
        (mag[0], mag[1], mag[2]) if mag else None,
        baro[0] if baro else None,
    )


def quantised(values: Sequence[float], lsb: float) -> Vec3:
    """Counts of 16 bits, cut towards zero."""
    x, y, z = (max(-32768, min(32767, math.trunc(value / lsb))) * lsb for value in values)
    return x, y, z


@dataclass
class Rules:
    """What a PX4 does not forgive.

    Attributes:
        problems: each kind once, in order.
    """

    problems: list[str] = field(default_factory=list)
    asked_for_truth: bool = False
    last_us: int = 0
    _same: dict[str, int] = field(default_factory=dict)
    _before: dict[str, Any] = field(default_factory=dict)
    _fix_us: int = 0

    def problem(self, text: str) -> None:
        if text not in self.problems:
            self.problems.append(text)

    def sensor(self, message: Message, sample: Sample) -> None:
        for name, bits in GROUPS.items():
            if message.fields_updated & bits not in (0, bits):
                self.problem(f"{name}: group not complete, fields_updated {message.fields_updated:#x}")
        if message["id"] != 0:
            self.problem(f"HIL_SENSOR of id {message['id']}")
        if sample.time_us <= self.last_us:
            self.problem(f"time does not increase: {self.last_us} us, then {sample.time_us} us")
        self.last_us = sample.time_us
        readings = {"GYRO": sample.gyro, "ACCEL": sample.accel, "MAG": sample.mag, "BARO": sample.pressure_hpa}
        if sample.gyro is None or sample.accel is None:
            self.problem("a HIL_SENSOR without gyro and accelerometer")
        for name, value in readings.items():
            if value is None:
                continue
            if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
                self.problem(f"{name}: no number")
            self._same[name] = self._same.get(name, 0) + 1 if value == self._before.get(name) else 0
            self._before[name] = value
            if self._same[name] >= STALE:
                self.problem(f"{name} STALE")
        if sample.mag is not None and not 0.2 < math.hypot(*sample.mag) < 0.7:
            self.problem(f"no magnetic field of the Earth, in gauss: {sample.mag}")
        if sample.pressure_hpa is not None and not 300.0 < sample.pressure_hpa < 1100.0:
            self.problem(f"no pressure in hPa: {sample.pressure_hpa}")

    def gps(self, message: Message) -> None:
        if message.time_usec <= self._fix_us:
            self.problem("a fix that is not newer than the one before")
        if self.last_us and message.time_usec > self.last_us + 100_000:
            self.problem("a fix from the future")
        self._fix_us = message.time_usec
        # what a PX4 takes as accuracy in cm: below a centimetre or above five metres no flight would begin
        if not (1 <= message.eph <= 500 and 1 <= message.epv <= 500 and message.fix_type >= 3):
            self.problem(f"a fix nobody can fly with: eph {message.eph} epv {message.epv} type {message.fix_type}")

    def truth(self) -> None:
        if not self.asked_for_truth:
            self.problem("HIL_STATE_QUATERNION, which was not asked for")
