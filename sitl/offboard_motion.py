"""Position, velocity and acceleration set-points of an offboard computer, made fit for the position controller.

Source: PX4 ``mc_pos_control`` (PositionControl's checks of its input; when Offboard may leave the ground).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from sitl.legs import FAR_M, Vec3
from sitl.setpoints import PositionRequest
from sitl.stick_motion import NAN3, MotionSetpoint

_FAST_M_S, _HARD_M_S2 = 1e3, 50.0


def offboard_motion(request: PositionRequest, get: Callable[[str], float]) -> MotionSetpoint:
    """What to fly for a request: position before velocity before acceleration, each axis by itself.

    North and east come together or not at all; a request that leaves an axis without anything, or half of a pair,
    holds still (PX4's failsafe set-point). Absurd numbers are cut to ones the controller's limits cut anyway.

    Args:
        request: as it came. get: reads MPC_Z_VEL_MAX_UP, MPC_Z_VEL_MAX_DN.
    """
    position, velocity = _cut(request.position_ned, FAR_M), _cut(request.velocity_ned, _FAST_M_S)
    acceleration = _cut(request.acceleration_ned, _HARD_M_S2)
    three = (position, velocity, acceleration)
    whole = all(math.isfinite(v[0]) == math.isfinite(v[1]) for v in three)
    asked = all(any(math.isfinite(v[axis]) for v in three) for axis in (0, 2))
    if not (whole and asked):
        return MotionSetpoint(velocity=(0.0, 0.0, 0.0))
    if math.isnan(position[2]) and math.isfinite(velocity[2]):
        climb = min(get("MPC_Z_VEL_MAX_DN"), max(-get("MPC_Z_VEL_MAX_UP"), velocity[2]))
        velocity = (velocity[0], velocity[1], climb)
    yaw = math.remainder(request.yaw, math.tau) if math.isfinite(request.yaw) else math.nan
    rate = min(100.0, max(-100.0, request.yaw_rate)) if math.isfinite(request.yaw_rate) else math.nan
    return MotionSetpoint(position, velocity, acceleration, yaw, rate)


def wants_up(request: PositionRequest, down: float) -> bool:
    """Does it ask to leave the ground? down: where the vehicle is, m."""
    height, climb, push = request.position_ned[2], request.velocity_ned[2], request.acceleration_ned[2]
    if math.isfinite(height):
        return height < down
    return climb < 0.0 if math.isfinite(climb) else push < 0.0


def _cut(vector: Vec3, most: float) -> Vec3:
    n, e, d = (min(most, max(-most, v)) if math.isfinite(v) else math.nan for v in vector)
    return n, e, d


NOTHING = PositionRequest(NAN3, NAN3, NAN3, math.nan, math.nan)
"""A request that leaves everything free."""
