"""The simulator's face towards a real autopilot: HIL_SENSOR and HIL_GPS out, HIL_ACTUATOR_CONTROLS in; no socket.

Source: PX4 ``simulator_mavlink`` (lockstep over TCP) and ``mavlink_receiver`` (boards).
"""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import Any, NamedTuple

from bridge.connection import Connection, Message
from bridge.messages import BY_NAME
from bridge.telemetry import int16, int32, uint16
from sitl.body import Body
from sitl.sensors import Gps, geodetic

SIM_SYSID, SIM_COMPID = 254, 51

IMU, MAG, BARO = 0x3F, 0x1C0, 0x1A00
"""Groups of fields_updated; a group that is not complete is ignored by the autopilot."""

TRUTH_US = 20_000
"""Least interval of the truth, however often it is asked for: a PX4 asks for 200 Hz and logs it; each costs both sides
time that the lockstep waits for, and a run's own record has it for every tick anyway."""

SLOW_TICKS = 5
"""Ticks between two readings of magnetometer and barometer: 50 Hz."""

TEMPERATURE_DEG_C = 25.0
_ARMED, _LOCKSTEP = 128, 1
_PX4 = 12
_NOBODY = 8
_COG_UNKNOWN = 65535
_KEPT = 64

# In wire order; packed and unpacked without the messages' general way, because the lockstep waits for it.
_SENSOR_KIND, _ACTUATOR_KIND = BY_NAME["HIL_SENSOR"], BY_NAME["HIL_ACTUATOR_CONTROLS"]
_SENSOR, _ACTUATOR = struct.Struct("<Q13fIB"), struct.Struct("<QQ16fB")
_NO_SLOW = (0.0,) * 7


class Actuators(NamedTuple):
    """One HIL_ACTUATOR_CONTROLS, made safe.

    Attributes:
        time_us: as sent: with lockstep that of the sample it answers.
        motors: (16,) 0 to 1 in PX4's order; what was no number is 0, what lay outside is cut.
        armed, lockstep: as the message's flags say.
    """

    time_us: int
    motors: tuple[float, ...]
    armed: bool
    lockstep: bool


class Simulator:
    """Messages of one body to one autopilot and back.

    Args:
        body: what flies.
        truth: also send HIL_STATE_QUATERNION when it is asked for. Never to a board: PX4 takes it there for its own
            state, and scales every later acceleration wrongly.

    Attributes:
        connection: frames the messages; its counters tell what was damaged.
        system: the autopilot's system id, 0 before its first message.
        is_px4: whether its HEARTBEAT says so; None before one.
        not_numbers, outside: actuator values that were no numbers, or outside 0 to 1 (servos: -1 to 1).
        strangers: messages of other systems on this link.
        others: what is for ground stations, oldest first: messages that are not the simulator's.
    """

    def __init__(self, body: Body, *, truth: bool) -> None:
        self.body = body
        self.truth = truth
        self.connection = Connection(SIM_SYSID, SIM_COMPID)
        self.system = 0
        self.is_px4: bool | None = None
        self.not_numbers = 0
        self.outside = 0
        self.strangers = 0
        self.others: deque[Message] = deque(maxlen=_KEPT)
        self._truth_interval_us: int | None = None
        self._truth_due_us = 0

    # -- out ---------------------------------------------------------------------------------------------------

    def frames(self) -> bytes:
        """What belongs to this tick, HIL_SENSOR last: it sets the autopilot's clock and lets it run."""
        frames = []
        fix = self.body.fix()
        if fix is not None:
            frames.append(self.connection.encode_fields("HIL_GPS", gps_fields(fix)))
        now_us = self.body.time_us
        if self.truth and self._truth_interval_us is not None and now_us >= self._truth_due_us:
            # whole intervals, so that 5 ms asked of a 4 ms tick are 5 ms on average
            self._truth_due_us = max(self._truth_due_us + self._truth_interval_us, now_us)
            frames.append(self.connection.encode_fields("HIL_STATE_QUATERNION", truth_fields(self.body)))
        sensor = self.connection.encode_payload(_SENSOR_KIND, _SENSOR.pack(*sensor_values(self.body)))
        return b"".join((*frames, sensor)) if frames else sensor

    def heartbeat(self) -> bytes:
        """A HEARTBEAT of a simulator: a board streams nothing to a link that it has never heard on."""
        return self.connection.encode("HEARTBEAT", type=0, autopilot=_NOBODY, mavlink_version=3)

    # -- in ----------------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> list[Actuators]:
        """Actuator commands in a piece of the stream.

        Args:
            data: as it came.
        """
        lone = self.connection.lone_payload(data, _ACTUATOR_KIND)
        if lone is not None:
            return self._lone(*lone)
        return [made for message in self.connection.receive(data) if (made := self.take(message)) is not None]

    def take(self, message: Message) -> Actuators | None:
        """One message of the link; None if it moves no motor."""
        if self.system and message.sysid != self.system:
            self.strangers += 1
            return None
        if message.name == "HIL_ACTUATOR_CONTROLS":
            self.system = message.sysid
            return self._actuators(message.time_usec, message.flags, message.controls, message.mode)
        if message.name == "HEARTBEAT" and message.autopilot != _NOBODY:
            self.system = message.sysid
            self.is_px4 = message.autopilot == _PX4
        elif message.name == "COMMAND_LONG" and message.command == 511 and message.param1 == 115:
            interval = float(message.param2)
            wanted = interval > 0.0 and math.isfinite(interval)
            self._truth_interval_us = max(TRUTH_US, int(interval)) if wanted else None
        self.others.append(message)
        return None

    def new_peer(self) -> None:
        """Another autopilot, or the same one started anew, is on the link."""
        self.connection = Connection(SIM_SYSID, SIM_COMPID)
        self.system = 0
        self.is_px4 = None
        self._truth_interval_us = None
        self.others.clear()

    def _lone(self, system: int, payload: bytes) -> list[Actuators]:
        if self.system and system != self.system:
            self.strangers += 1
            return []
        self.system = system
        values = _ACTUATOR.unpack_from(payload)
        return [self._actuators(values[0], values[1], values[2:18], values[18])]

    def _actuators(self, time_us: int, flags: int, controls: tuple[float, ...], mode: int) -> Actuators:
        # a sum with a NaN or an infinity in it is one itself
        if not (math.isfinite(sum(controls)) and min(controls) >= 0.0 and max(controls) <= 1.0):
            controls = self._made_safe(controls)
        return Actuators(time_us, controls, bool(mode & _ARMED), bool(flags & _LOCKSTEP))

    def _made_safe(self, controls: tuple[float, ...]) -> tuple[float, ...]:
        motors = []
        for value in controls:
            if not math.isfinite(value):
                self.not_numbers += 1
                motors.append(0.0)
            else:
                if not -1.0 <= value <= 1.0:
                    self.outside += 1
                motors.append(min(1.0, max(0.0, value)))
        return tuple(motors)


def sensor_values(body: Body) -> tuple[float, ...]:
    """HIL_SENSOR of this tick, in wire order: m/s^2, rad/s, gauss, hPa, body axes forward-right-down; id 0.

    Args:
        body: just stepped.
    """
    sensors = body.sensors
    fast = (body.time_us, *sensors.accel(), *sensors.gyro.tolist())
    if body.tick % SLOW_TICKS:
        return *fast, *_NO_SLOW, IMU, 0
    pressure = sensors.pressure()
    pressure_alt_m = 44330.77 * (1.0 - (max(0.0, pressure) / 1013.25) ** 0.1902632)
    return *fast, *sensors.mag(), pressure, 0.0, pressure_alt_m, TEMPERATURE_DEG_C, IMU | MAG | BARO, 0


def sensor_fields(body: Body) -> dict[str, Any]:
    """`sensor_values` by the names of the fields.

    Args:
        body: just stepped.
    """
    return dict(zip((field.name for field in _SENSOR_KIND.fields), sensor_values(body), strict=True))


def gps_fields(fix: Gps) -> dict[str, Any]:
    """HIL_GPS of a fix: degE7, mm, cm (accuracy, too: PX4 reads eph and epv so), cm/s, centidegrees.

    Args:
        fix: with its own time, from before the receiver's delay.
    """
    north, east, down = fix.vel_ned
    speed = math.hypot(north, east)
    course = math.degrees(math.atan2(east, north)) % 360.0
    return {
        "time_usec": fix.time_us,
        "fix_type": fix.fix_type,
        "lat": int32(fix.lat_deg * 1e7),
        "lon": int32(fix.lon_deg * 1e7),
        "alt": int32(fix.alt_m * 1e3),
        "eph": uint16(fix.eph_m * 100.0),
        "epv": uint16(fix.epv_m * 100.0),
        "vel": uint16(speed * 100.0),
        "vn": int16(north * 100.0),
        "ve": int16(east * 100.0),
        "vd": int16(down * 100.0),
        "cog": uint16(course * 100.0) % 36000 if speed > 0.5 else _COG_UNKNOWN,
        "satellites_visible": fix.satellites,
        "id": 0,
        "yaw": 0,
    }


def truth_fields(body: Body) -> dict[str, Any]:
    """HIL_STATE_QUATERNION: the true state, as PX4's simulator link reads it (accelerations in mm/s^2).

    Args:
        body: just stepped.
    """
    truth = body.truth
    lat, lon, altitude_m = geodetic(truth.position_ned(), body.home)
    p, q, r = truth.rates()
    north, east, down = truth.velocity_ned()
    ax, ay, az = truth.accel_body()
    speed = uint16(math.hypot(north, east, down) * 100.0)
    return {
        "time_usec": body.time_us,
        "attitude_quaternion": truth.quat(),
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
        "lat": int32(lat * 1e7),
        "lon": int32(lon * 1e7),
        "alt": int32(altitude_m * 1e3),
        "vx": int16(north * 100.0),
        "vy": int16(east * 100.0),
        "vz": int16(down * 100.0),
        "ind_airspeed": speed,
        "true_airspeed": speed,
        "xacc": int16(ax * 1e3),
        "yacc": int16(ay * 1e3),
        "zacc": int16(az * 1e3),
    }
