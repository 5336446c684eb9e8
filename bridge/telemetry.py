"""The fields of each telemetry message about attitude, place and status, from the vehicle's state this tick.

One function per message: it takes a `Source` and returns the fields, or None when there is nothing to send.
Sensors, actuators and time are in sensor_telemetry.py; who sends what how often is streams.py. Contents
follow PX4's src/modules/mavlink/streams; every stamp is vehicle time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from bridge.px4_modes import ARMED, CUSTOM, OFFBOARD, PX4_MODES
from sitl.sensors import geodetic
from sitl.vehicle import Vehicle

if TYPE_CHECKING:
    from bridge.vehicle_server import ServerLink

Fields = dict[str, Any]

_NAN = math.nan
_MAV_AUTOPILOT_PX4 = 12
_LOAD_PER_MILLE = 100
_NO_OFFSET = (0.0, 0.0, 0.0, 0.0)  # all zero: not a tailsitter

_POSITION_TARGET_MASK = {
    "x": 1,
    "y": 2,
    "z": 4,
    "vx": 8,
    "vy": 16,
    "vz": 32,
    "afx": 64,
    "afy": 128,
    "afz": 256,
    "yaw": 1024,
    "yaw_rate": 2048,
}

GYRO, ACCEL, MAG, BARO, GPS = 0x1, 0x2, 0x4, 0x8, 0x20
ATTITUDE, XY_POSITION, MOTORS, AHRS, BATTERY = 0x800, 0x4000, 0x8000, 0x200000, 0x2000000
PREARM_CHECK = 0x10000000
"""MAV_SYS_STATUS_SENSOR bits."""
RADIO, LOGGING = 0x10000, 0x1000000
PRESENT = GYRO | ACCEL | MAG | BARO | GPS | XY_POSITION | MOTORS | LOGGING | BATTERY
"""What a PX4 multicopter in simulation says it has; it expects a radio even when there is none."""
HEALTHY = PRESENT | ATTITUDE | AHRS
STARTING = HEALTHY & ~(GPS | XY_POSITION | ATTITUDE | AHRS)
"""Health as long as the estimator has no attitude and position yet: who waits for it waits for that."""


@dataclass
class Source:
    """What the messages are made of.

    Attributes:
        vehicle: the vehicle.
        sysid: its MAVLink system id.
        utc_boot_us: UTC of vehicle time zero in microseconds; 0 = unknown, SYSTEM_TIME is then not sent.
        ping_seq: number of the last PING.
        link: the link that the next message goes out on.
        metadata: its component metadata, None for none.
        channels: pulse widths of a radio's channels, us. channels_us: vehicle time they came, None before.
        mav_type: HEARTBEAT.type; the parameter MAV_TYPE as it was at start, as on a PX4.
    """

    vehicle: Vehicle
    sysid: int = 1
    utc_boot_us: int = 0
    ping_seq: int = 0
    link: ServerLink | None = None
    channels: tuple[int, ...] = ()
    metadata: Any = None
    channels_us: int | None = None
    mav_type: int = field(init=False)

    def __post_init__(self) -> None:
        """Read what a PX4 reads once, at start."""
        self.mav_type = int(self.vehicle.parameters.get("MAV_TYPE")) & 0xFF

    @property
    def time_us(self) -> int:
        """Vehicle time in microseconds."""
        return self.vehicle.time_us

    @property
    def time_ms(self) -> int:
        """Vehicle time in milliseconds, as `time_boot_ms`."""
        return self.vehicle.time_us // 1000

    @property
    def base_mode(self) -> int:
        """HEARTBEAT.base_mode as it is now."""
        autopilot = self.vehicle.autopilot
        flags = PX4_MODES[autopilot.mode].base_mode
        if autopilot.mode == OFFBOARD and not autopilot.offboard_levels:
            flags = CUSTOM
        return flags | ARMED if autopilot.armed else flags

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode as it is now."""
        return PX4_MODES[self.vehicle.autopilot.mode].custom_mode


def whole(value: float, low: int, high: int) -> int:
    """Round to an integer field's range: NaN becomes 0, what does not fit the nearest end."""
    if not low <= value <= high:
        return 0 if value != value else low if value < low else high
    return round(value)


# These three are `whole` written out: they run ten times in a message that goes out every tick.


def int16(value: float) -> int:
    """Round to int16."""
    if -32768.0 <= value <= 32767.0:
        return round(value)
    return 0 if value != value else 32767 if value > 0.0 else -32768


def uint16(value: float) -> int:
    """Round to uint16."""
    if 0.0 <= value <= 65535.0:
        return round(value)
    return 65535 if value > 0.0 else 0


def int32(value: float) -> int:
    """Round to int32."""
    if -2147483648.0 <= value <= 2147483647.0:
        return round(value)
    return 0 if value != value else 2147483647 if value > 0.0 else -2147483648


def heartbeat(source: Source) -> Fields:
    """HEARTBEAT: who, which mode, armed or not."""
    autopilot = source.vehicle.autopilot
    if autopilot.terminated:
        status = 8
    elif autopilot.armed:
        status = 5 if autopilot.failsafe else 4
    else:
        status = 3 if autopilot.ready else 0
    return {
        "type": source.mav_type,
        "autopilot": _MAV_AUTOPILOT_PX4,
        "base_mode": source.base_mode,
        "custom_mode": source.custom_mode,
        "system_status": status,
        "mavlink_version": 3,
    }


def sys_status(source: Source) -> Fields:
    """SYS_STATUS: every sensor there and healthy; PREARM_CHECK, in health alone, says it may be armed."""
    battery, autopilot = source.vehicle.battery(), source.vehicle.autopilot
    health = HEALTHY if autopilot.healthy else STARTING
    return {
        "onboard_control_sensors_present": PRESENT,
        "onboard_control_sensors_enabled": PRESENT | RADIO,
        "onboard_control_sensors_health": health | (PREARM_CHECK if autopilot.ready else 0),
        "load": _LOAD_PER_MILLE,
        "voltage_battery": uint16(battery.voltage_v * 1000.0),
        "current_battery": int16(battery.current_a * 100.0),
        "battery_remaining": whole(battery.remaining * 100.0, 0, 100),
    }


def extended_sys_state(source: Source) -> Fields:
    """EXTENDED_SYS_STATE: on the ground, in the air, taking off, landing."""
    return {"vtol_state": 0, "landed_state": int(source.vehicle.autopilot.landed_state)}


def attitude(source: Source) -> Fields:
    """ATTITUDE: the attitude controller's Euler angles (rad) and the filtered gyro (rad/s)."""
    vehicle = source.vehicle
    phi, theta, psi = vehicle.estimate.euler()
    p, q, r = vehicle.estimate.rates()
    return {
        "time_boot_ms": vehicle.time_us // 1000,
        "roll": phi,
        "pitch": theta,
        "yaw": psi,
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
    }


def attitude_quaternion(source: Source) -> Fields:
    """ATTITUDE_QUATERNION: the same, as a quaternion (w, x, y, z)."""
    w, x, y, z = source.vehicle.estimate.quat()
    p, q, r = source.vehicle.estimate.rates()
    return {
        "time_boot_ms": source.time_ms,
        "q1": w,
        "q2": x,
        "q3": y,
        "q4": z,
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
        "repr_offset_q": _NO_OFFSET,
    }


def attitude_target(source: Source) -> Fields:
    """ATTITUDE_TARGET: the set-point flown and the rates asked for (rad/s); type_mask is always 0."""
    attitude_sp = source.vehicle.autopilot.attitude_sp
    p, q, r = attitude_sp.rates
    return {
        "time_boot_ms": source.vehicle.time_us // 1000,
        "type_mask": 0,
        "q": attitude_sp.quat,
        "body_roll_rate": p,
        "body_pitch_rate": q,
        "body_yaw_rate": r,
        "thrust": abs(attitude_sp.thrust),
    }


def local_position_ned(source: Source) -> Fields:
    """LOCAL_POSITION_NED: metres and m/s from the origin."""
    x, y, z = source.vehicle.estimate.position_ned()
    vx, vy, vz = source.vehicle.estimate.velocity_ned()
    return {"time_boot_ms": source.time_ms, "x": x, "y": y, "z": z, "vx": vx, "vy": vy, "vz": vz}


def position_target_local_ned(source: Source) -> Fields:
    """POSITION_TARGET_LOCAL_NED: what the position controller follows; the rest is NaN and masked."""
    position_sp = source.vehicle.autopilot.position_sp
    values = (
        *position_sp.position_ned,
        *position_sp.velocity_ned,
        *position_sp.acceleration_ned,
        position_sp.yaw,
        position_sp.yaw_rate,
    )
    fields: Fields = dict(zip(_POSITION_TARGET_MASK, values, strict=True))
    fields["type_mask"] = sum(bit for name, bit in _POSITION_TARGET_MASK.items() if fields[name] != fields[name])
    fields["time_boot_ms"] = source.time_ms
    fields["coordinate_frame"] = 1
    return fields


def global_position_int(source: Source) -> Fields:
    """GLOBAL_POSITION_INT: the estimate as latitude, longitude (1e-7 deg), altitude (mm), velocity (cm/s)."""
    vehicle = source.vehicle
    lat, lon, _ = geodetic(vehicle.estimate.position_ned(), vehicle.origin)
    vx, vy, vz = vehicle.estimate.velocity_ned()
    return {
        "time_boot_ms": source.time_ms,
        "lat": int32(lat * 1e7),
        "lon": int32(lon * 1e7),
        "alt": int32(vehicle.estimate.altitude_m() * 1000.0),
        "relative_alt": int32(above_home_m(source) * 1000.0),
        "vx": int16(vx * 100.0),
        "vy": int16(vy * 100.0),
        "vz": int16(vz * 100.0),
        "hdg": uint16(_heading_deg(source) * 100.0) % 36000,
    }


def gps_raw_int(source: Source) -> Fields:
    """GPS_RAW_INT: the receiver's fix; it gives accuracies, no dilutions: eph and epv are 65535, unknown."""
    gps = source.vehicle.gps()
    north, east, _ = gps.vel_ned
    altitude_mm = int32(gps.alt_m * 1000.0)
    return {
        "time_usec": source.time_us,
        "fix_type": gps.fix_type,
        "lat": int32(gps.lat_deg * 1e7),
        "lon": int32(gps.lon_deg * 1e7),
        "alt": altitude_mm,
        "eph": 65535,
        "epv": 65535,
        "vel": uint16(math.hypot(north, east) * 100.0),
        "cog": uint16(math.degrees(math.atan2(east, north)) % 360.0 * 100.0) % 36000,
        "satellites_visible": gps.satellites,
        "alt_ellipsoid": altitude_mm,
        "h_acc": int32(gps.eph_m * 1000.0),
        "v_acc": int32(gps.epv_m * 1000.0),
        "vel_acc": 250,
    }


def gps_global_origin(source: Source) -> Fields:
    """GPS_GLOBAL_ORIGIN: where LOCAL_POSITION_NED counts from."""
    lat, lon, altitude_m = source.vehicle.origin
    return {
        "latitude": int32(lat * 1e7),
        "longitude": int32(lon * 1e7),
        "altitude": int32(altitude_m * 1000.0),
        "time_usec": source.time_us,
    }


def home_position(source: Source) -> Fields | None:
    """HOME_POSITION: only once home is set."""
    home = source.vehicle.autopilot.home
    if home is None:
        return None
    x, y, z = home.position_ned
    return {
        "latitude": int32(home.lat_deg * 1e7),
        "longitude": int32(home.lon_deg * 1e7),
        "altitude": int32(home.alt_m * 1000.0),
        "x": x,
        "y": y,
        "z": z,
        "q": home.quat,
        "time_usec": source.time_us,
    }


def vfr_hud(source: Source) -> Fields:
    """VFR_HUD: airspeed is NaN (no such sensor), throttle is the thrust set-point in per cent, 0 disarmed."""
    vehicle = source.vehicle
    vx, vy, vz = vehicle.estimate.velocity_ned()
    thrust = abs(vehicle.autopilot.attitude_sp.thrust) if vehicle.autopilot.armed else 0.0
    return {
        "airspeed": _NAN,
        "groundspeed": math.hypot(vx, vy),
        "heading": whole(_heading_deg(source), 0, 360) % 360,
        "throttle": whole(thrust * 100.0, 0, 100),
        "alt": vehicle.estimate.altitude_m(),
        "climb": -vz,
    }


def altitude(source: Source) -> Fields:
    """ALTITUDE: metres; terrain and clearance are unknown (no range finder)."""
    amsl_m = source.vehicle.estimate.altitude_m()
    return {
        "time_usec": source.time_us,
        "altitude_monotonic": amsl_m,
        "altitude_amsl": amsl_m,
        "altitude_local": -source.vehicle.estimate.position_ned()[2],
        "altitude_relative": above_home_m(source),
        "altitude_terrain": _NAN,
        "bottom_clearance": _NAN,
    }


def above_home_m(source: Source) -> float:
    """Return the height above home, above the origin as long as there is no home, in metres."""
    vehicle = source.vehicle
    home = vehicle.autopilot.home
    return vehicle.estimate.altitude_m() - (vehicle.origin[2] if home is None else home.alt_m)


def _heading_deg(source: Source) -> float:
    """Return the heading in [0, 360) degrees, NaN if the attitude is."""
    return math.degrees(source.vehicle.estimate.euler()[2]) % 360.0
