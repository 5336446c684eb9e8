"""Offboard set-points from the wire to the autopilot: attitudes, rates, positions, velocities, accelerations.

PX4 src/modules/mavlink/mavlink_receiver.cpp, handle_message_set_attitude_target and
handle_message_set_position_target_*.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from sitl.modes import Severity
from sitl.plan import GLOBAL_FRAMES, RELATIVE_FRAMES
from sitl.sensors import local_position
from sitl.setpoints import PositionRequest

if TYPE_CHECKING:
    from bridge.vehicle_server import ServerLink, VehicleServer

_IGNORE_ROLL_RATE, _IGNORE_PITCH_RATE, _IGNORE_YAW_RATE = 1, 2, 4
_THRUST_BODY, _IGNORE_THRUST, _IGNORE_ATTITUDE = 32, 64, 128
"""ATTITUDE_TARGET_TYPEMASK bits."""

_FORCE, _IGNORE_YAW, _IGNORE_TURN = 512, 1024, 2048
"""POSITION_TARGET_TYPEMASK bits beside the three for each of position (1), velocity (8) and acceleration (64)."""

_LOCAL_NED, _BODY_NED = 1, 8


class OffboardSetpoints:
    """Passes set-points on to one vehicle's autopilot.

    Args:
        server: the vehicle's face.
    """

    def __init__(self, server: VehicleServer) -> None:
        self._server = server

    def handlers(self) -> dict[str, Callable[[ServerLink, Any], None]]:
        """Return the handler of each message."""
        return {
            "SET_ATTITUDE_TARGET": self._attitude,
            "SET_POSITION_TARGET_LOCAL_NED": self._local,
            "SET_POSITION_TARGET_GLOBAL_INT": self._global,
        }

    def _wanted(self, msg: Any) -> bool:
        return self._server.is_for_us(msg) and bool(self._server.vehicle.parameters.get("MAV_FWDEXTSP"))

    def _attitude(self, _: ServerLink, msg: Any) -> None:
        """Pass a set-point on if it is a whole one: an attitude, or at least roll and pitch rate.

        What is no number or no rotation counts as no set-point, so Offboard times out. (A PX4 flies it and
        loses control.)
        """
        server = self._server
        if not self._wanted(msg):
            return
        mask = msg.type_mask
        quat: tuple[float, float, float, float] | None = None if mask & _IGNORE_ATTITUDE else tuple(msg.q)
        if quat is None and mask & (_IGNORE_ROLL_RATE | _IGNORE_PITCH_RATE):
            return
        rates = (
            math.nan if mask & _IGNORE_ROLL_RATE else msg.body_roll_rate,
            math.nan if mask & _IGNORE_PITCH_RATE else msg.body_pitch_rate,
            math.nan if mask & _IGNORE_YAW_RATE else msg.body_yaw_rate,
        )
        if mask & _IGNORE_THRUST:
            thrust = 0.0
        elif mask & _THRUST_BODY:
            thrust = math.hypot(*msg.thrust_body)
        else:
            thrust = abs(msg.thrust)
        problem = _problem(quat, rates, thrust, mask)
        if problem:
            server.refusals += 1
            server.say_at_times(Severity.WARNING, problem, f"Set-point ignored: {problem}")
            return
        server.vehicle.autopilot.offboard_attitude(quat, rates, thrust)

    def _local(self, _: ServerLink, msg: Any) -> None:
        """SET_POSITION_TARGET_LOCAL_NED; in the body's frame x and y turn with the heading."""
        if not self._wanted(msg):
            return
        frame = msg.coordinate_frame
        if frame not in (_LOCAL_NED, _BODY_NED):
            self._refuse(msg, f"coordinate frame {frame} unsupported")
            return
        position = _axes(msg, ("x", "y", "z"), 1)
        velocity = _axes(msg, ("vx", "vy", "vz"), 8)
        acceleration = _axes(msg, ("afx", "afy", "afz"), 64)
        if frame == _BODY_NED:
            heading = self._server.vehicle.estimate.euler()[2]
            position = (math.nan, math.nan, math.nan)  # a place relative to a moving body is none
            velocity, acceleration = _turned(velocity, heading), _turned(acceleration, heading)
        self._pass_on(msg, position, velocity, acceleration)

    def _global(self, _: ServerLink, msg: Any) -> None:
        """SET_POSITION_TARGET_GLOBAL_INT: degrees x 1e7, height above sea level or home."""
        if not self._wanted(msg):
            return
        frame, vehicle = msg.coordinate_frame, self._server.vehicle
        if frame not in GLOBAL_FRAMES:
            self._refuse(msg, f"coordinate frame {frame} unsupported")
            return
        home = vehicle.autopilot.home
        base_m = home.alt_m if frame in RELATIVE_FRAMES and home is not None else 0.0
        north, east, down = local_position(msg.lat_int * 1e-7, msg.lon_int * 1e-7, base_m + msg.alt)
        mask = msg.type_mask
        position = (
            math.nan if mask & 1 else north,
            math.nan if mask & 2 else east,
            math.nan if mask & 4 else down,
        )
        self._pass_on(msg, position, _axes(msg, ("vx", "vy", "vz"), 8), _axes(msg, ("afx", "afy", "afz"), 64))

    def _pass_on(
        self,
        msg: Any,
        position: tuple[float, float, float],
        velocity: tuple[float, float, float],
        acceleration: tuple[float, float, float],
    ) -> None:
        mask = msg.type_mask
        finite = any(math.isfinite(value) for value in (*position, *velocity, *acceleration))
        if not finite or mask & _FORCE:
            self._refuse(msg, "invalid")
            return
        yaw = math.nan if mask & _IGNORE_YAW else msg.yaw
        yaw_rate = math.nan if mask & _IGNORE_TURN else msg.yaw_rate
        request = PositionRequest(position, velocity, acceleration, yaw, yaw_rate)
        self._server.vehicle.autopilot.offboard_position(request)

    def _refuse(self, msg: Any, problem: str) -> None:
        self._server.refusals += 1
        self._server.say_at_times(Severity.CRITICAL, msg.name, f"{msg.name} {problem}\t")


def _axes(msg: Any, names: tuple[str, str, str], first_bit: int) -> tuple[float, float, float]:
    """Return three fields, NaN where the mask says ignore or where they are no finite numbers."""
    x, y, z = (
        value if not msg.type_mask & first_bit << k and math.isfinite(value) else math.nan
        for k, value in enumerate(getattr(msg, name) for name in names)
    )
    return x, y, z


def _turned(vector: tuple[float, float, float], heading: float) -> tuple[float, float, float]:
    """Return a forward-right-down vector as north-east-down. heading: rad."""
    forward, right, down = vector
    c, s = math.cos(heading), math.sin(heading)
    return forward * c - right * s, forward * s + right * c, down


def _problem(quat: Sequence[float] | None, rates: Sequence[float], thrust: float, mask: int) -> str:
    """Return what makes a set-point unusable, nothing if it can be flown."""
    if quat is not None and not 1e-3 < math.hypot(*quat) < 1e3:
        return "its quaternion is no rotation"
    bits = (_IGNORE_ROLL_RATE, _IGNORE_PITCH_RATE, _IGNORE_YAW_RATE)
    if any(not mask & bit and not math.isfinite(rate) for bit, rate in zip(bits, rates, strict=True)):
        return "a body rate is not a number"
    return "" if math.isfinite(thrust) else "its thrust is not a number"
