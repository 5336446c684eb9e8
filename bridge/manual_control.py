"""Sticks from the wire to the autopilot: MANUAL_CONTROL of a joystick, RC_CHANNELS_OVERRIDE of a radio.

Source: PX4 src/modules/mavlink/mavlink_receiver.cpp, src/modules/rc_update/rc_update.cpp.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sitl.manual_input import RADIO
from sitl.setpoints import Sticks

if TYPE_CHECKING:
    from bridge.vehicle_server import ServerLink, VehicleServer

_FULL = 1000.0
_NO_AXIS = 32767  # INT16_MAX: the joystick has no such axis
_CHANNELS = 18
_KEEP = 65535  # UINT16_MAX: this message says nothing of the channel
_RELEASE, _RELEASE_BEYOND_EIGHT = 0, 65534
_STICKS = ("RC_MAP_ROLL", "RC_MAP_PITCH", "RC_MAP_YAW", "RC_MAP_THROTTLE")


class ManualControl:
    """Passes sticks on to one vehicle's autopilot.

    Args:
        server: the vehicle's face.
    """

    def __init__(self, server: VehicleServer) -> None:
        self._server = server
        self._channels = [0] * _CHANNELS

    def handlers(self) -> dict[str, Callable[[ServerLink, Any], None]]:
        """Return the handler of each message."""
        return {"MANUAL_CONTROL": self._joystick, "RC_CHANNELS_OVERRIDE": self._radio}

    def _joystick(self, link: ServerLink, msg: Any) -> None:
        """A joystick: x is pitch, y is roll, z is throttle (0 to 1000), r is yaw."""
        server = self._server
        if msg.target != server.sysid:
            return
        axes = [0.0 if value == _NO_AXIS else value / _FULL for value in (msg.y, msg.x, msg.r)]
        throttle = -1.0 if msg.z == _NO_AXIS else 2.0 * msg.z / _FULL - 1.0
        sticks = Sticks(axes[0], axes[1], axes[2], throttle)
        if not server.vehicle.autopilot.manual.take(server.vehicle.time_us, link.link_id, sticks):
            server.refusals += 1

    def _radio(self, _: ServerLink, msg: Any) -> None:
        """Eighteen pulse widths, mapped by RC_MAP_* and scaled by RCn_MIN, _TRIM, _MAX and _REV."""
        server = self._server
        if not server.is_for_us(msg):
            return
        for number in range(_CHANNELS):
            width_us = getattr(msg, f"chan{number + 1}_raw")
            # the channels beyond eight are an extension: zero there means "not sent"
            if width_us == _RELEASE_BEYOND_EIGHT and number >= 8:
                self._channels[number] = _RELEASE
            elif width_us != _KEEP and (width_us != _RELEASE or number < 8):
                self._channels[number] = width_us
        server.source.channels = tuple(self._channels)
        server.source.channels_us = server.vehicle.time_us
        sticks = [self._stick(name) for name in _STICKS]
        if any(stick is None for stick in sticks):
            server.refusals += 1
            return
        roll, pitch, yaw, throttle = (stick or 0.0 for stick in sticks)
        if not server.vehicle.autopilot.manual.take(server.vehicle.time_us, RADIO, Sticks(roll, pitch, yaw, throttle)):
            server.refusals += 1

    def _stick(self, name: str) -> float | None:
        """Return a stick's place -1..1, None if it is not mapped or its channel is silent."""
        get = self._server.vehicle.parameters.get
        number = int(get(name))
        if not 1 <= number <= _CHANNELS or not self._channels[number - 1]:
            return None
        low, high = float(get(f"RC{number}_MIN")), float(get(f"RC{number}_MAX"))
        trim, sign = float(get(f"RC{number}_TRIM")), float(get(f"RC{number}_REV"))
        width_us = min(high, max(low, float(self._channels[number - 1])))
        if name == "RC_MAP_THROTTLE":
            trim = (low + high) / 2.0
        span = high - trim if width_us > trim else trim - low
        return sign * (width_us - trim) / span if span > 0.0 else 0.0
