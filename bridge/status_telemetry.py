"""The fields of telemetry about links, motors, radio and plans: what ground stations show at the edge of the screen.

Like telemetry.py: one function per message, from a `Source` to its fields, None when there is nothing to send.
"""

from __future__ import annotations

import math

from bridge.telemetry import Fields, Source, above_home_m, int16, int32, uint16, whole
from sitl.modes import LandedState
from sitl.sensors import geodetic

_ESC_GROUP = 4
_ESC_CONNECTION_PWM = 0
_RADIO_FRESH_US = 500_000
_UNKNOWN_S = -1
_UTC_2019_S = 1_546_300_800
"""Open Drone ID counts seconds from 2019-01-01."""
_UNKNOWN_TIME = 65535.0
_UTM_TIME_POSITION_ALTITUDES_VELOCITIES = 0x7F & ~0x10
"""UTM_DATA_AVAIL_FLAGS: all but the next way-point."""
_WITHIN_10_M, _WITHIN_3_M, _WITHIN_1_M_S, _WITHIN_100_MS = 10, 5, 3, 1
"""Accuracy classes of Open Drone ID: horizontal, vertical, speed, time."""


def link_node_status(source: Source) -> Fields | None:
    """LINK_NODE_STATUS: what this link has carried; rates are not limited here, so the buffers are never full."""
    link = source.link
    if link is None:
        return None
    counters = link.connection.counters
    return {
        "timestamp": source.time_us // 1000,
        "messages_sent": link.connection.sent & 0xFFFFFFFF,
        "messages_received": counters.received & 0xFFFFFFFF,
        "messages_lost": counters.lost & 0xFFFFFFFF,
        "rx_parse_err": uint16(float(counters.bad_crc)),
    }


def esc_info(source: Source) -> Fields:
    """ESC_INFO: four motors at a time, the groups in turn."""
    motors = source.vehicle.autopilot.motors
    first = _next_group(source, len(motors))
    count = len(motors)
    online = sum(1 << k for k in range(min(_ESC_GROUP, count - first)))
    return {
        "index": first,
        "time_usec": source.time_us,
        "counter": source.time_us // 1_000_000 & 0xFFFF,
        "count": count,
        "connection_type": _ESC_CONNECTION_PWM,
        "info": online,
    }


def esc_status(source: Source) -> Fields:
    """ESC_STATUS: voltage and the motors' share of the current; no model gives a speed, so rpm is 0."""
    vehicle = source.vehicle
    motors = vehicle.autopilot.motors
    first = _next_group(source, len(motors))
    battery = vehicle.battery()
    total = sum(motors)
    group = [*motors[first : first + _ESC_GROUP], *[0.0] * _ESC_GROUP][:_ESC_GROUP]
    here = min(_ESC_GROUP, len(motors) - first)
    return {
        "index": first,
        "time_usec": source.time_us,
        "voltage": [battery.voltage_v if k < here else 0.0 for k in range(_ESC_GROUP)],
        "current": [battery.current_a * motor / total if total > 0.0 else 0.0 for motor in group],
    }


def _next_group(source: Source, count: int) -> int:
    """Return the first motor of the group whose turn it is."""
    groups = max(1, -(-count // _ESC_GROUP))
    return source.time_us // 1_000_000 % groups * _ESC_GROUP


def position_target_global_int(source: Source) -> Fields | None:
    """POSITION_TARGET_GLOBAL_INT: where a mode that holds a position flies to; nothing where it has no place."""
    vehicle = source.vehicle
    autopilot = vehicle.autopilot
    position_sp = autopilot.position_sp
    if autopilot.landed_state is LandedState.ON_GROUND or not autopilot.by_position:
        return None
    if not all(map(math.isfinite, position_sp.position_ned)):
        return None
    lat, lon, altitude_m = geodetic(position_sp.position_ned, vehicle.origin)
    vx, vy, vz = position_sp.velocity_ned
    afx, afy, afz = position_sp.acceleration_ned
    return {
        "time_boot_ms": source.time_ms,
        "coordinate_frame": 5,
        "type_mask": 0,
        "lat_int": int32(lat * 1e7),
        "lon_int": int32(lon * 1e7),
        "alt": altitude_m,
        "vx": vx,
        "vy": vy,
        "vz": vz,
        "afx": afx,
        "afy": afy,
        "afz": afz,
        "yaw": position_sp.yaw,
        "yaw_rate": position_sp.yaw_rate,
    }


def time_estimate_to_target(source: Source) -> Fields:
    """TIME_ESTIMATE_TO_TARGET: seconds to fly home and land at cruise speed; the rest is not estimated."""
    vehicle = source.vehicle
    home = vehicle.autopilot.home
    safe_return = 0
    if home is not None and vehicle.autopilot.landed_state is not LandedState.ON_GROUND:
        get = vehicle.parameters.get
        north, east, down = vehicle.estimate.position_ned()
        away_m = math.hypot(north - home.position_ned[0], east - home.position_ned[1])
        cruise_m_s, sink_m_s = float(get("MPC_XY_CRUISE")), float(get("MPC_LAND_SPEED"))
        seconds = away_m / max(0.1, cruise_m_s) + max(0.0, home.position_ned[2] - down) / max(0.1, sink_m_s)
        safe_return = int32(seconds)
    rest = ("land", "mission_next_item", "mission_end", "commanded_action")
    return {"safe_return": safe_return, **dict.fromkeys(rest, _UNKNOWN_S)}


def rc_channels(source: Source) -> Fields | None:
    """RC_CHANNELS: the radio's channels (us) while they come."""
    if source.channels_us is None or source.time_us - source.channels_us > _RADIO_FRESH_US:
        return None
    fields: Fields = {f"chan{number}_raw": width for number, width in enumerate(source.channels, start=1)}
    return {**fields, "time_boot_ms": source.time_ms, "chancount": len(source.channels), "rssi": 255}


def open_drone_id_location(source: Source) -> Fields:
    """OPEN_DRONE_ID_LOCATION: where the vehicle is, as remote identification wants it."""
    vehicle = source.vehicle
    lat, lon, altitude_m = geodetic(vehicle.estimate.position_ned(), vehicle.origin)
    north, east, down = vehicle.estimate.velocity_ned()
    utc_s = (source.utc_boot_us + source.time_us) * 1e-6
    return {
        "status": 1 if vehicle.autopilot.landed_state is LandedState.ON_GROUND else 2,
        "latitude": int32(lat * 1e7),
        "longitude": int32(lon * 1e7),
        "altitude_barometric": altitude_m,
        "altitude_geodetic": altitude_m,
        "height": above_home_m(source),
        "direction": whole(math.degrees(math.atan2(east, north)) % 360.0 * 100.0, 0, 35999),
        "speed_horizontal": uint16(math.hypot(north, east) * 100.0),
        "speed_vertical": int16(-down * 100.0),
        "horizontal_accuracy": _WITHIN_10_M,
        "vertical_accuracy": _WITHIN_3_M,
        "barometer_accuracy": _WITHIN_3_M,
        "speed_accuracy": _WITHIN_1_M_S,
        "timestamp": utc_s % 3600.0 if source.utc_boot_us else _UNKNOWN_TIME,
        "timestamp_accuracy": _WITHIN_100_MS,
    }


def open_drone_id_system(source: Source) -> Fields:
    """OPEN_DRONE_ID_SYSTEM: the operator is where the vehicle took off."""
    home = source.vehicle.autopilot.home
    lat, lon, altitude_m = (home.lat_deg, home.lon_deg, home.alt_m) if home else (0.0, 0.0, -1000.0)
    utc_s = (source.utc_boot_us + source.time_us) // 1_000_000
    return {
        "operator_location_type": 0,
        "operator_latitude": int32(lat * 1e7),
        "operator_longitude": int32(lon * 1e7),
        "operator_altitude_geo": altitude_m,
        "area_count": 1,
        "area_ceiling": -1000.0,
        "area_floor": -1000.0,
        "timestamp": max(0, utc_s - _UTC_2019_S) if source.utc_boot_us else 0,
    }


def open_drone_id_basic_id(source: Source) -> Fields:
    """OPEN_DRONE_ID_BASIC_ID: a serial number of its own for each simulated vehicle."""
    return {"id_type": 1, "ua_type": 2, "uas_id": b"FROUDE%d" % source.sysid}


def utm_global_position(source: Source) -> Fields:
    """UTM_GLOBAL_POSITION: place and velocity for air traffic; who the vehicle is, is not told."""
    vehicle = source.vehicle
    lat, lon, altitude_m = geodetic(vehicle.estimate.position_ned(), vehicle.origin)
    vx, vy, vz = vehicle.estimate.velocity_ned()
    on_ground = vehicle.autopilot.landed_state is LandedState.ON_GROUND
    gps = vehicle.gps()
    return {
        "time": source.utc_boot_us + source.time_us if source.utc_boot_us else 0,
        "lat": int32(lat * 1e7),
        "lon": int32(lon * 1e7),
        "alt": int32(altitude_m * 1000.0),
        "relative_alt": int32(above_home_m(source) * 1000.0),
        "vx": int16(vx * 100.0),
        "vy": int16(vy * 100.0),
        "vz": int16(vz * 100.0),
        "h_acc": uint16(gps.eph_m * 1000.0),
        "v_acc": uint16(gps.epv_m * 1000.0),
        "flight_state": 2 if on_ground else 3,
        "flags": _UTM_TIME_POSITION_ALTITUDES_VELOCITIES,
    }


def high_latency(source: Source) -> Fields:
    """HIGH_LATENCY2: everything in one short message, for a slow link."""
    vehicle = source.vehicle
    lat, lon, altitude_m = geodetic(vehicle.estimate.position_ned(), vehicle.origin)
    vx, vy, vz = vehicle.estimate.velocity_ned()
    thrust = abs(vehicle.autopilot.attitude_sp.thrust) if vehicle.autopilot.armed else 0.0
    heading_deg = math.degrees(vehicle.estimate.euler()[2]) % 360.0
    return {
        "timestamp": source.time_ms & 0xFFFFFFFF,
        "type": source.mav_type,
        "autopilot": 12,
        "custom_mode": source.custom_mode >> 16 & 0xFFFF,
        "latitude": int32(lat * 1e7),
        "longitude": int32(lon * 1e7),
        "altitude": int16(altitude_m),
        "target_altitude": int16(altitude_m),
        "heading": whole(heading_deg / 2.0, 0, 180),
        "target_heading": whole(heading_deg / 2.0, 0, 180),
        "throttle": whole(thrust * 100.0, 0, 100),
        "groundspeed": whole(math.hypot(vx, vy) * 5.0, 0, 255),
        "eph": 255,
        "epv": 255,
        "climb_rate": whole(-vz * 10.0, -127, 127),
        "battery": whole(vehicle.battery().remaining * 100.0, 0, 100),
    }
