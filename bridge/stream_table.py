"""Which messages a link carries, and how often: PX4's streams and their rates.

Rates are PX4's: mavlink_main.cpp's configure_streams_to_default, and for what its simulator adds
init.d-posix/px4-rc.mavlink.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from bridge import sensor_telemetry, status_telemetry, telemetry
from bridge.identity import REQUESTED
from bridge.telemetry import Fields, Source

LinkMode = Literal["gcs", "onboard", "memory"]

_FALLBACK_US = 500_000
"""Without a new attitude set-point for this long, PX4 sends ATTITUDE_TARGET for the rate set-points alone."""


@dataclass(frozen=True)
class Stream:
    """One message that can be streamed or requested.

    Attributes:
        message_id: its MAVLink id.
        name: its MAVLink name.
        build: makes the fields, None when there is nothing to send.
        version: a number that changes when there is something new; None = every tick has something new.
        fallback_us: sent after this long even if nothing is new; 0 = never.
    """

    message_id: int
    name: str
    build: Callable[[Source], Fields | None]
    version: Callable[[Source], int] | None = None
    fallback_us: int = 0


HEARTBEAT_ID = 0

_WITHOUT_SOURCE = {
    25: "GPS_STATUS",
    62: "NAV_CONTROLLER_OUTPUT",
    69: "MANUAL_CONTROL",
    106: "OPTICAL_FLOW_RAD",
    112: "CAMERA_TRIGGER",
    116: "SCALED_IMU2",
    124: "GPS2_RAW",
    129: "SCALED_IMU3",
    132: "DISTANCE_SENSOR",
    137: "SCALED_PRESSURE2",
    143: "SCALED_PRESSURE3",
    192: "MAG_CAL_REPORT",
    225: "EFI_STATUS",
    231: "WIND_COV",
    246: "ADSB_VEHICLE",
    247: "COLLISION",
    250: "DEBUG_VECT",
    251: "NAMED_VALUE_FLOAT",
    254: "DEBUG",
    263: "CAMERA_IMAGE_CAPTURED",
    265: "MOUNT_ORIENTATION",
    330: "OBSTACLE_DISTANCE",
    339: "RAW_RPM",
    350: "DEBUG_FLOAT_ARRAY",
    360: "ORBIT_EXECUTION_STATUS",
    370: "SMART_BATTERY_INFO",
}
"""Streams of a PX4 that have nothing to say without a sensor or a device: a rate can be set, nothing comes."""


def _on_request(message_id: int) -> Stream:
    """A message that is sent on request, and at a rate if one is set."""
    name, make = REQUESTED[message_id]
    return Stream(message_id, name, lambda source: next(iter(make(source, 0)), None))


STREAMS: dict[int, Stream] = {
    stream.message_id: stream
    for stream in (
        # HEARTBEAT first: what is due in the same tick goes out in this order.
        Stream(HEARTBEAT_ID, "HEARTBEAT", telemetry.heartbeat),
        Stream(30, "ATTITUDE", telemetry.attitude),
        Stream(
            83,
            "ATTITUDE_TARGET",
            telemetry.attitude_target,
            lambda source: source.vehicle.autopilot.attitude_sp_count,
            _FALLBACK_US,
        ),
        Stream(93, "HIL_ACTUATOR_CONTROLS", sensor_telemetry.hil_actuator_controls),
        Stream(32, "LOCAL_POSITION_NED", telemetry.local_position_ned),
        Stream(31, "ATTITUDE_QUATERNION", telemetry.attitude_quaternion),
        Stream(85, "POSITION_TARGET_LOCAL_NED", telemetry.position_target_local_ned),
        Stream(33, "GLOBAL_POSITION_INT", telemetry.global_position_int),
        Stream(24, "GPS_RAW_INT", telemetry.gps_raw_int),
        Stream(36, "SERVO_OUTPUT_RAW", sensor_telemetry.servo_output_raw),
        Stream(74, "VFR_HUD", telemetry.vfr_hud),
        Stream(141, "ALTITUDE", telemetry.altitude),
        Stream(105, "HIGHRES_IMU", sensor_telemetry.highres_imu),
        Stream(331, "ODOMETRY", sensor_telemetry.odometry),
        Stream(1, "SYS_STATUS", telemetry.sys_status),
        Stream(245, "EXTENDED_SYS_STATE", telemetry.extended_sys_state),
        Stream(147, "BATTERY_STATUS", sensor_telemetry.battery_status),
        Stream(242, "HOME_POSITION", telemetry.home_position),
        Stream(230, "ESTIMATOR_STATUS", sensor_telemetry.estimator_status),
        Stream(436, "CURRENT_MODE", sensor_telemetry.current_mode),
        Stream(111, "TIMESYNC", sensor_telemetry.timesync),
        Stream(2, "SYSTEM_TIME", sensor_telemetry.system_time),
        Stream(4, "PING", sensor_telemetry.ping),
        Stream(241, "VIBRATION", sensor_telemetry.vibration),
        Stream(29, "SCALED_PRESSURE", sensor_telemetry.scaled_pressure),
        # Once: the origin never moves.
        Stream(49, "GPS_GLOBAL_ORIGIN", telemetry.gps_global_origin, lambda _: 1),
        Stream(26, "SCALED_IMU", sensor_telemetry.scaled_imu),
        Stream(375, "ACTUATOR_OUTPUT_STATUS", sensor_telemetry.actuator_output_status),
        Stream(115, "HIL_STATE_QUATERNION", sensor_telemetry.hil_state_quaternion),
        Stream(8, "LINK_NODE_STATUS", status_telemetry.link_node_status),
        Stream(65, "RC_CHANNELS", status_telemetry.rc_channels),
        Stream(87, "POSITION_TARGET_GLOBAL_INT", status_telemetry.position_target_global_int),
        Stream(290, "ESC_INFO", status_telemetry.esc_info),
        Stream(291, "ESC_STATUS", status_telemetry.esc_status),
        Stream(380, "TIME_ESTIMATE_TO_TARGET", status_telemetry.time_estimate_to_target),
        Stream(12901, "OPEN_DRONE_ID_LOCATION", status_telemetry.open_drone_id_location),
        Stream(12904, "OPEN_DRONE_ID_SYSTEM", status_telemetry.open_drone_id_system),
        Stream(12900, "OPEN_DRONE_ID_BASIC_ID", status_telemetry.open_drone_id_basic_id),
        Stream(235, "HIGH_LATENCY2", status_telemetry.high_latency),
        Stream(340, "UTM_GLOBAL_POSITION", status_telemetry.utm_global_position),
        *(_on_request(message_id) for message_id in (148, 261, 264, 300, 395, 397)),
        *(Stream(message_id, name, lambda _: None) for message_id, name in _WITHOUT_SOURCE.items()),
    )
}
"""Every message this vehicle can stream, by id."""

_NORMAL_HZ: dict[str, float] = {
    "HEARTBEAT": 1,
    "ALTITUDE": 1,
    "ATTITUDE": 15,
    "ATTITUDE_QUATERNION": 10,
    "ATTITUDE_TARGET": 2,
    "BATTERY_STATUS": 0.5,
    "CURRENT_MODE": 0.5,
    "ESC_INFO": 1,
    "ESC_STATUS": 1,
    "ESTIMATOR_STATUS": 0.5,
    "EXTENDED_SYS_STATE": 1,
    "GLOBAL_POSITION_INT": 5,
    "GPS_GLOBAL_ORIGIN": 1,
    "GPS_RAW_INT": 5,
    "HOME_POSITION": 0.5,
    "LINK_NODE_STATUS": 1,
    "LOCAL_POSITION_NED": 1,
    "OPEN_DRONE_ID_LOCATION": 1,
    "OPEN_DRONE_ID_SYSTEM": 1,
    "PING": 0.1,
    "POSITION_TARGET_GLOBAL_INT": 1,
    "POSITION_TARGET_LOCAL_NED": 1.5,
    "RC_CHANNELS": 5,
    "SCALED_PRESSURE": 1,
    "SERVO_OUTPUT_RAW": 1,
    "SYS_STATUS": 1,
    "TIME_ESTIMATE_TO_TARGET": 0.5,
    "VFR_HUD": 4,
    "VIBRATION": 0.1,
}
_ONBOARD_HZ: dict[str, float] = {
    "HEARTBEAT": 1,
    "ALTITUDE": 10,
    "ATTITUDE": 100,
    "ATTITUDE_QUATERNION": 50,
    "ATTITUDE_TARGET": 10,
    "BATTERY_STATUS": 0.5,
    "CURRENT_MODE": 0.5,
    "ESC_INFO": 10,
    "ESC_STATUS": 10,
    "ESTIMATOR_STATUS": 1,
    "EXTENDED_SYS_STATE": 5,
    "GLOBAL_POSITION_INT": 50,
    "GPS_GLOBAL_ORIGIN": 1,
    "GPS_RAW_INT": 10,
    "HIGHRES_IMU": 50,
    "HOME_POSITION": 0.5,
    "LINK_NODE_STATUS": 1,
    "LOCAL_POSITION_NED": 30,
    "ODOMETRY": 30,
    "OPEN_DRONE_ID_LOCATION": 1,
    "OPEN_DRONE_ID_SYSTEM": 1,
    "PING": 1,
    "POSITION_TARGET_GLOBAL_INT": 10,
    "POSITION_TARGET_LOCAL_NED": 10,
    "RC_CHANNELS": 20,
    "SCALED_PRESSURE": 1,
    "SERVO_OUTPUT_RAW": 10,
    "SYSTEM_TIME": 1,
    "SYS_STATUS": 5,
    "TIMESYNC": 10,
    "TIME_ESTIMATE_TO_TARGET": 0.5,
    "VFR_HUD": 10,
    "VIBRATION": 0.5,
}
_SIMULATOR_HZ: dict[str, float] = {"RC_CHANNELS": 20.0} | dict.fromkeys(
    (
        "ATTITUDE",
        "ATTITUDE_QUATERNION",
        "ATTITUDE_TARGET",
        "GLOBAL_POSITION_INT",
        "LOCAL_POSITION_NED",
        "POSITION_TARGET_LOCAL_NED",
        "SERVO_OUTPUT_RAW",
    ),
    50.0,
)
"""What PX4's simulator raises on the ground station's link at start; interval 0 does not bring these back."""

_UNWATCHED = ("ESC_INFO", "ESC_STATUS", "OPEN_DRONE_ID_LOCATION", "OPEN_DRONE_ID_SYSTEM", "POSITION_TARGET_GLOBAL_INT")
"""What nobody looks at on the link between a runner and its own vehicle."""

DEFAULT_HZ: dict[LinkMode, dict[str, float]] = {
    "gcs": _NORMAL_HZ,
    "onboard": _ONBOARD_HZ,
    "memory": {name: hz for name, hz in _ONBOARD_HZ.items() if name not in _UNWATCHED},
}
START_HZ: dict[LinkMode, dict[str, float]] = {**DEFAULT_HZ, "gcs": _NORMAL_HZ | _SIMULATOR_HZ}
