"""Which telemetry goes out on a link, and when.

A `Schedule` keeps one due time per streamed message and a heap over them, so a tick on which nothing is due
costs one comparison. Due times advance by whole intervals in microseconds of vehicle time: the achieved rate
is the rate asked for, without drift, up to the vehicle's tick rate. Rates are PX4's: mavlink_main.cpp's
configure_streams_to_default, and for what its simulator adds init.d-posix/px4-rc.mavlink.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from bridge import sensor_telemetry, status_telemetry, telemetry
from bridge.telemetry import Fields, Source

LinkMode = Literal["gcs", "onboard", "memory"]

OFF = -1
"""Interval of a message that is not streamed."""

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

_DEFAULT_HZ: dict[LinkMode, dict[str, float]] = {
    "gcs": _NORMAL_HZ,
    "onboard": _ONBOARD_HZ,
    "memory": {name: hz for name, hz in _ONBOARD_HZ.items() if name not in _UNWATCHED},
}
_START_HZ: dict[LinkMode, dict[str, float]] = {**_DEFAULT_HZ, "gcs": _NORMAL_HZ | _SIMULATOR_HZ}

_NEVER = 1 << 62


class _Slot:
    """One stream on one link: its interval and what was last sent."""

    __slots__ = ("build", "fallback_us", "interval_us", "name", "order", "sent_us", "sent_version", "version")

    def __init__(self, stream: Stream, order: int, interval_us: int, now_us: int) -> None:
        self.name = stream.name
        self.build = stream.build
        self.version = stream.version
        self.fallback_us = stream.fallback_us
        self.order = order
        self.interval_us = interval_us
        self.sent_version = -1
        self.sent_us = now_us

    def has_news(self, source: Source, now_us: int) -> bool:
        """Return whether there is something to send that has not been sent."""
        version = self.version(source)  # type: ignore[misc]
        if version != self.sent_version:
            self.sent_version = version
            self.sent_us = now_us
            return True
        return 0 < self.fallback_us <= now_us - self.sent_us


class Schedule:
    """When each message is due on one link.

    Args:
        mode: whose default rates; a memory link starts like an onboard one.
        now_us: vehicle time; HEARTBEAT is due at once, everything else one interval later.
    """

    def __init__(self, mode: LinkMode, now_us: int = 0) -> None:
        self.mode = mode
        self._slots: dict[int, _Slot] = {}
        self._waiting: list[tuple[int, _Slot]] = []
        self._heap: list[tuple[int, int, _Slot | None]] = []
        for order, stream in enumerate(STREAMS.values()):
            hz = _START_HZ[mode].get(stream.name, 0.0)
            if hz:
                self._slots[stream.message_id] = _Slot(stream, order, _interval_us(hz), now_us)
        self._rebuild(
            [
                (now_us if message_id == HEARTBEAT_ID else now_us + slot.interval_us, slot.order, slot)
                for message_id, slot in self._slots.items()
            ]
        )

    def interval_us(self, message_id: int) -> int:
        """Return a message's interval in microseconds, OFF if it is not streamed."""
        slot = self._slots.get(message_id)
        return OFF if slot is None else slot.interval_us

    def set_interval(self, message_id: int, interval_us: int, now_us: int) -> None:
        """Change how often a message is streamed; the first one goes out with the next tick.

        Args:
            message_id: which.
            interval_us: in microseconds; 0 is the default of the link's mode, below 0 is off.
            now_us: vehicle time.

        Raises:
            KeyError: not a message that can be streamed.
        """
        stream = STREAMS[message_id]
        if interval_us == 0:
            hz = _DEFAULT_HZ[self.mode].get(stream.name, 0.0)
            interval_us = _interval_us(hz) if hz else OFF
        previous = self._slots.pop(message_id, None)
        entries: list[tuple[int, int, _Slot]] = [
            (due, slot.order, slot)
            for due, slot in self._waiting + [(due, slot) for due, _, slot in self._heap if slot is not None]
            if slot is not previous
        ]
        if interval_us > 0:
            slot = _Slot(stream, list(STREAMS).index(message_id), interval_us, now_us)
            if previous is not None:
                slot.sent_version, slot.sent_us = previous.sent_version, previous.sent_us
            self._slots[message_id] = slot
            entries.append((now_us, slot.order, slot))
        self._rebuild(entries)

    def intervals(self) -> Mapping[str, int]:
        """Return the interval in microseconds of each streamed message, by name."""
        return {slot.name: slot.interval_us for slot in self._slots.values()}

    def run(self, now_us: int, source: Source, send: Callable[[str, Fields], None]) -> None:
        """Send what is due at vehicle time `now_us`."""
        if self._waiting:
            self._send_news(now_us, source, send)
        heap = self._heap
        due_us, _, slot = heap[0]
        while due_us <= now_us:
            assert slot is not None  # the sentinel is never due
            if slot.version is not None and not slot.has_news(source, now_us):
                heapq.heappop(heap)
                self._waiting.append((due_us, slot))
            else:
                # Its next turn first: one that cannot be built or sent must not block the others.
                heapq.heapreplace(heap, (_next_us(due_us, slot, now_us), slot.order, slot))
                fields = slot.build(source)
                if fields is not None:
                    send(slot.name, fields)
            due_us, _, slot = heap[0]

    def _send_news(self, now_us: int, source: Source, send: Callable[[str, Fields], None]) -> None:
        """Send what was due earlier, had nothing new then, and has now."""
        ready = [entry for entry in self._waiting if entry[1].has_news(source, now_us)]
        if not ready:
            return
        self._waiting = [entry for entry in self._waiting if entry not in ready]
        for due_us, slot in ready:
            heapq.heappush(self._heap, (_next_us(due_us, slot, now_us), slot.order, slot))
        for _, slot in ready:
            fields = slot.build(source)
            if fields is not None:
                send(slot.name, fields)

    def _rebuild(self, entries: list[tuple[int, int, _Slot]]) -> None:
        self._waiting = []
        # The sentinel spares the loop in `run` a test for an empty heap.
        self._heap = [*entries, (_NEVER, len(STREAMS), None)]
        heapq.heapify(self._heap)


def _next_us(due_us: int, slot: _Slot, now_us: int) -> int:
    """Return when a message that was due and is sent now is due again; what was missed is not made up for."""
    next_us = due_us + slot.interval_us
    if next_us > now_us:
        return next_us
    return now_us + (slot.interval_us if slot.version is not None else 1)


def _interval_us(hz: float) -> int:
    return int(1e6 / hz)
