"""Offboard set-points from the wire to the autopilot: SET_ATTITUDE_TARGET and its masks.

PX4 src/modules/mavlink/mavlink_receiver.cpp, handle_message_set_attitude_target. Position set-points are not
flown; whoever sends them is told.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from sitl.modes import Severity

if TYPE_CHECKING:
    from bridge.vehicle_server import ServerLink, VehicleServer

_IGNORE_ROLL_RATE, _IGNORE_PITCH_RATE, _IGNORE_YAW_RATE = 1, 2, 4
_THRUST_BODY, _IGNORE_THRUST, _IGNORE_ATTITUDE = 32, 64, 128
"""ATTITUDE_TARGET_TYPEMASK bits."""


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
            "SET_POSITION_TARGET_LOCAL_NED": self._position,
            "SET_POSITION_TARGET_GLOBAL_INT": self._position,
        }

    def _attitude(self, _: ServerLink, msg: Any) -> None:
        """Pass a set-point on if it is a whole one: an attitude, or at least roll and pitch rate.

        What is no number or no rotation counts as no set-point, so Offboard times out. (A PX4 flies it and
        loses control.)
        """
        server = self._server
        if not server.is_for_us(msg) or not server.vehicle.parameters.get("MAV_FWDEXTSP"):
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
            server.refused += 1
            server.say_at_times(Severity.WARNING, problem, f"SET_ATTITUDE_TARGET ignored: {problem}")
            return
        server.vehicle.autopilot.offboard_attitude(quat, rates, thrust)
        server.source.offboard_attitude = quat is not None

    def _position(self, _: ServerLink, msg: Any) -> None:
        server = self._server
        if server.is_for_us(msg):
            server.refused += 1
            text = "Position set-points are not flown by this vehicle: send attitudes or rates"
            server.say_at_times(Severity.WARNING, "position", text)


def _problem(quat: Sequence[float] | None, rates: Sequence[float], thrust: float, mask: int) -> str:
    """Return what makes a set-point unusable, nothing if it can be flown."""
    if quat is not None and not 1e-3 < math.hypot(*quat) < 1e3:
        return "its quaternion is no rotation"
    bits = (_IGNORE_ROLL_RATE, _IGNORE_PITCH_RATE, _IGNORE_YAW_RATE)
    if any(not mask & bit and not math.isfinite(rate) for bit, rate in zip(bits, rates, strict=True)):
        return "a body rate is not a number"
    return "" if math.isfinite(thrust) else "its thrust is not a number"
