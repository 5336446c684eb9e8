"""The way to a place: a point that moves there at limited speed, acceleration and jerk.

Source of the limits and of the braking speeds: PX4 ``motion_planning`` (MPC_XY_CRUISE, MPC_ACC_HOR, MPC_JERK_AUTO,
MPC_XY_TRAJ_P, MPC_Z_V_AUTO_*). PX4 plans the same profile with a closed-form solution; here the point is steered.
"""

from __future__ import annotations

import math
from typing import NamedTuple

Vec3 = tuple[float, float, float]

_ARRIVED_M, _ARRIVED_M_S = 0.01, 0.02


class WayLimits(NamedTuple):
    """How fast the point may move.

    Attributes:
        speed_m_s: horizontal. acceleration_m_s2: horizontal.
        up_m_s, down_m_s: vertical. up_m_s2, down_m_s2: vertical.
        jerk_m_s3: of everything. gain_1_s: speed for every metre to go, at most.
    """

    speed_m_s: float
    acceleration_m_s2: float
    up_m_s: float
    down_m_s: float
    up_m_s2: float
    down_m_s2: float
    jerk_m_s3: float
    gain_1_s: float


def braking_speed(jerk: float, acceleration: float, distance: float, final: float = 0.0) -> float:
    """Speed from which `final` (m/s) can be reached within a distance (m) at limited jerk and acceleration."""
    b = 4.0 * acceleration * acceleration / jerk
    c = -2.0 * acceleration * distance - final * final
    return max(final, 0.5 * (-b + math.sqrt(b * b - 4.0 * c)))


def corner_speed(before: tuple[float, float], after: tuple[float, float], acceleration: float, radius: float) -> float:
    """Speed at which a corner of the track may be passed, m/s.

    Args:
        before: horizontal vector from the corner back to where it came from. after: on to the next place.
        acceleration: m/s^2. radius: how far from the corner the turn may begin, m.
    """
    sizes = math.hypot(*before) * math.hypot(*after)
    if sizes < 1e-9:
        return 0.0
    cosine = min(1.0, max(-1.0, (before[0] * after[0] + before[1] * after[1]) / sizes))
    half = 0.5 * math.acos(cosine)
    return math.sqrt(max(0.0, acceleration * radius * math.tan(min(half, 1.57))))


class Way:
    """The moving point.

    Attributes:
        position: NED, m. velocity: m/s. acceleration: m/s^2.
    """

    def __init__(self) -> None:
        self.position = [0.0, 0.0, 0.0]
        self.velocity = [0.0, 0.0, 0.0]
        self.acceleration = [0.0, 0.0, 0.0]

    def start(self, position: Vec3, velocity: Vec3) -> None:
        """Begin where the vehicle is, as fast as it is."""
        self.position, self.velocity, self.acceleration = list(position), list(velocity), [0.0, 0.0, 0.0]

    def step(self, dt_s: float, goal: Vec3, limits: WayLimits, exit_m_s: float = 0.0) -> None:
        """Move on.

        Args:
            dt_s: s. goal: NED, m. limits: of this step. exit_m_s: horizontal speed at which the goal may be passed.
        """
        self._step_flat(dt_s, goal, limits, min(exit_m_s, limits.speed_m_s))
        self._step_down(dt_s, goal[2], limits)

    def _step_flat(self, dt_s: float, goal: Vec3, limits: WayLimits, exit_m_s: float) -> None:
        to_n, to_e = goal[0] - self.position[0], goal[1] - self.position[1]
        distance = math.hypot(to_n, to_e)
        if exit_m_s <= 0.0 and distance < _ARRIVED_M and math.hypot(*self.velocity[:2]) < _ARRIVED_M_S:
            self.position[:2], self.velocity[:2], self.acceleration[:2] = goal[:2], [0.0, 0.0], [0.0, 0.0]
            return
        speed = min(
            limits.speed_m_s,
            limits.gain_1_s * distance + exit_m_s,
            braking_speed(limits.jerk_m_s3, limits.acceleration_m_s2, distance, exit_m_s),
        )
        scale = speed / distance if distance > 1e-9 else 0.0
        missing = (to_n * scale - self.velocity[0], to_e * scale - self.velocity[1])
        size = math.hypot(*missing)
        wanted = min(limits.acceleration_m_s2, math.sqrt(2.0 * limits.jerk_m_s3 * size), size / dt_s)
        scale = wanted / size if size > 1e-12 else 0.0
        change = (missing[0] * scale - self.acceleration[0], missing[1] * scale - self.acceleration[1])
        size = math.hypot(*change)
        scale = min(1.0, limits.jerk_m_s3 * dt_s / size) if size > 1e-12 else 0.0
        for i in (0, 1):
            self.acceleration[i] += change[i] * scale
            self._move(i, dt_s)

    def _step_down(self, dt_s: float, goal_down: float, limits: WayLimits) -> None:
        to_go = goal_down - self.position[2]
        if abs(to_go) < _ARRIVED_M and abs(self.velocity[2]) < _ARRIVED_M_S:
            self.position[2], self.velocity[2], self.acceleration[2] = goal_down, 0.0, 0.0
            return
        slowest = min(limits.up_m_s2, limits.down_m_s2)
        speed = min(
            limits.down_m_s if to_go > 0.0 else limits.up_m_s,
            limits.gain_1_s * abs(to_go),
            braking_speed(limits.jerk_m_s3, slowest, abs(to_go)),
        )
        missing = math.copysign(speed, to_go) - self.velocity[2]
        most = limits.down_m_s2 if missing > 0.0 else limits.up_m_s2
        wanted = min(most, math.sqrt(2.0 * limits.jerk_m_s3 * abs(missing)), abs(missing) / dt_s)
        change = math.copysign(wanted, missing) - self.acceleration[2]
        most = limits.jerk_m_s3 * dt_s
        self.acceleration[2] += min(most, max(-most, change))
        self._move(2, dt_s)

    def _move(self, i: int, dt_s: float) -> None:
        self.position[i] += dt_s * (self.velocity[i] + 0.5 * dt_s * self.acceleration[i])
        self.velocity[i] += dt_s * self.acceleration[i]
