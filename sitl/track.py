"""The way of a leg and the heading on it: straight to a place or round it, and turning meanwhile.

Source of the limits: PX4 ``FlightTaskAuto`` (MPC_XY_CRUISE, MPC_XY_ERR_MAX, MPC_YAWRAUTO_*), MPC_YAW_MODE 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from sitl.goto import Way, WayLimits
from sitl.legs import Leg, LegKind, Vec3, bounded, wrap


class Track:
    """Where a vehicle on its way should be now.

    Args:
        get: reads MPC_*, NAV_ACC_RAD.

    Attributes:
        way: the moving point. goal: where it leads, m.
        yaw: heading set-point, rad. yaw_rate: rad/s, NaN unless turning.
        cruise_m_s: horizontal speed; NaN for MPC_XY_CRUISE.
        turned_rad: how far the circle under way has gone round.
    """

    def __init__(self, get: Callable[[str], float]) -> None:
        self._get = get
        self.way = Way()
        self.goal: Vec3 = (0.0, 0.0, 0.0)
        self.cruise_m_s = math.nan
        self.turned_rad = 0.0
        self._round = self._round_m_s = 0.0
        self.face(0.0)

    def face(self, yaw: float) -> None:
        """Head there, and do not turn any more. yaw: rad."""
        self.yaw = yaw
        self.yaw_rate = self._facing = math.nan
        self._turning = 0.0

    def move(self, dt_s: float, leg: Leg, position: Vec3, *, fresh: bool) -> None:
        """One step.

        Args:
            dt_s: s. leg: with a place. position: of the vehicle, NED, m. fresh: the first of this kind of leg.
        """
        way, limits = self.way, self._limits(leg)
        self.goal = goal = bounded(leg.ned, (way.position[0], way.position[1], way.position[2]))
        # as in PX4 the point waits for a vehicle that falls behind; only then: one that is ahead must not stop it
        speed = math.hypot(way.velocity[0], way.velocity[1])
        behind = sum((way.position[i] - position[i]) * way.velocity[i] for i in (0, 1)) / max(1e-3, speed)
        step_s = dt_s * min(1.0, max(0.0, 1.0 - behind / max(0.1, self._get("MPC_XY_ERR_MAX"))))
        if leg.kind is LegKind.CIRCLE:
            self._circle(step_s, goal, leg.radius_m, limits, fresh=fresh)
        elif step_s > 0.0:
            way.step(step_s, goal, limits, leg.exit_m_s)
        if math.isfinite(leg.yaw):
            self._facing = leg.yaw
        elif leg.kind is not LegKind.LAND:
            to_n, to_e = goal[0] - way.position[0], goal[1] - way.position[1]
            if math.hypot(to_n, to_e) > self._get("NAV_ACC_RAD") or leg.kind is LegKind.CIRCLE:
                self._facing = math.atan2(to_e, to_n)
        self._turn(dt_s)

    def _limits(self, leg: Leg) -> WayLimits:
        get = self._get
        chosen = (v for v in (leg.speed_m_s, self.cruise_m_s, get("MPC_XY_CRUISE")) if math.isfinite(v) and v > 0.0)
        return WayLimits(
            min(next(chosen, 5.0), _at_least(0.1, get("MPC_XY_VEL_MAX"))),
            _at_least(0.1, get("MPC_ACC_HOR")),
            _at_least(0.1, get("MPC_Z_V_AUTO_UP")),
            _at_least(0.1, get("MPC_Z_V_AUTO_DN")),
            _at_least(0.1, get("MPC_ACC_UP_MAX")),
            _at_least(0.1, get("MPC_ACC_DOWN_MAX")),
            _at_least(0.5, get("MPC_JERK_AUTO")),
            _at_least(0.05, get("MPC_XY_TRAJ_P")),
        )

    def _circle(self, dt_s: float, centre: Vec3, radius_m: float, limits: WayLimits, *, fresh: bool) -> None:
        way, radius = self.way, max(0.1, abs(radius_m))
        if fresh:
            self._round = math.atan2(way.position[1] - centre[1], way.position[0] - centre[0])
            self._round_m_s = self.turned_rad = 0.0
        fastest = min(limits.speed_m_s, math.sqrt(0.7 * limits.acceleration_m_s2 * radius))
        push = 0.5 * limits.acceleration_m_s2
        self._round_m_s = min(fastest, self._round_m_s + push * dt_s)
        sense = math.copysign(1.0, radius_m)
        turn = self._round_m_s / radius * dt_s
        self._round = wrap(self._round + sense * turn)
        self.turned_rad += turn
        c, s = math.cos(self._round), math.sin(self._round)
        if dt_s > 0.0:
            way.step(dt_s, (way.position[0], way.position[1], centre[2]), limits)
        speed, pull = self._round_m_s * sense, self._round_m_s**2 / radius
        way.position[:2] = [centre[0] + radius * c, centre[1] + radius * s]
        way.velocity[:2] = [-speed * s, speed * c]
        way.acceleration[:2] = [-pull * c, -pull * s]

    def _turn(self, dt_s: float) -> None:
        """Turn towards where it should face, at MPC_YAWRAUTO_MAX at most."""
        self.yaw_rate = math.nan
        if not math.isfinite(self._facing):
            return
        to_go = wrap(self._facing - self.yaw)
        push = math.radians(_at_least(1.0, self._get("MPC_YAWRAUTO_ACC")))
        if abs(to_go) < 2e-3 and abs(self._turning) < 2.0 * push * dt_s:
            self.yaw, self._turning = self._facing, 0.0
        else:
            fastest = math.radians(_at_least(1.0, self._get("MPC_YAWRAUTO_MAX")))
            wanted = math.copysign(min(fastest, math.sqrt(1.6 * push * abs(to_go))), to_go)
            self._turning += min(push * dt_s, max(-push * dt_s, wanted - self._turning))
            self.yaw = wrap(self.yaw + self._turning * dt_s)
            self.yaw_rate = self._turning


def _at_least(low: float, value: float) -> float:
    return value if math.isfinite(value) and value > low else low
