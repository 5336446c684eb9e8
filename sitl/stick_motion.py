"""From sticks to set-points of the position controller: Altitude and Position.

Source: PX4 ``flight_mode_manager`` (ManualAltitude, ManualAcceleration, StickAccelerationXY), MPC_POS_MODE 4.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sitl.control_settings import reader
from sitl.parameters import ParameterTable
from sitl.position_control import ONE_G_M_S2
from sitl.setpoints import Sticks
from sitl.sticks import STICK_EXPO, StickTilt, StickYaw, expo_deadzone, tilt_rad

Vec3 = tuple[float, float, float]
NAN3 = (math.nan, math.nan, math.nan)

_BRAKE_TAU_S = 0.8
_STOPPED_M2_S2 = 1.2e-7


class MotionSetpoint(NamedTuple):
    """What the position controller is asked for; NaN is left free.

    Attributes:
        position: NED, m. velocity: m/s. acceleration: m/s^2. yaw: rad. yaw_rate: rad/s.
    """

    position: Vec3 = NAN3
    velocity: Vec3 = NAN3
    acceleration: Vec3 = NAN3
    yaw: float = math.nan
    yaw_rate: float = math.nan


class StickMotion:
    """Altitude and Position.

    Args:
        parameters: MPC_*, MAN_DEADZONE, MC_MAN_TILT_TAU.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._get = reader(parameters)
        self._yaw = StickYaw(parameters)
        self._tilt = StickTilt(parameters)
        self.begin((0.0, 0.0, 0.0))

    def begin(self, velocity: Vec3) -> None:
        """The mode begins, or it still stands on the ground. velocity: NED, m/s."""
        self._yaw.reset()
        self._tilt.reset()
        self._flat_velocity = [velocity[0], velocity[1]]
        self._flat_acceleration = [0.0, 0.0]
        self._pushed = [0.0, 0.0]
        self._lock: tuple[float, float] | None = None
        self._boost = 1.0
        self._climb = velocity[2]
        self._lock_down = math.nan

    def altitude(
        self, sticks: Sticks, position: Vec3, velocity: Vec3, yaw: float, height: float, dt_s: float
    ) -> MotionSetpoint:
        """Tilt by the right stick, climb rate by the left one.

        Args:
            sticks: clean. position: NED, m. velocity: m/s. yaw: heading now, rad. height: over home, m.
            dt_s: since the last call.
        """
        heading, rate = self._turn(sticks, yaw, dt_s)
        right, forward = self._tilt.update(sticks.roll, sticks.pitch, dt_s)
        most = math.tan(tilt_rad(self._get("MPC_MAN_TILT_MAX"))) * ONE_G_M_S2
        north, east = _turned(forward * most, right * most, heading if math.isfinite(heading) else yaw)
        down, climb = self._height(sticks, position[2], velocity[2], height, dt_s)
        return MotionSetpoint(
            (math.nan, math.nan, down),
            (math.nan, math.nan, climb),
            (north, east, math.nan),
            heading if math.isfinite(heading) else yaw,
            rate,
        )

    def position(
        self, sticks: Sticks, position: Vec3, velocity: Vec3, yaw: float, height: float, dt_s: float
    ) -> MotionSetpoint:
        """Velocity over ground by the right stick, climb rate by the left one; arguments as of `altitude`."""
        heading, rate = self._turn(sticks, yaw, dt_s)
        deadzone = self._get("MAN_DEADZONE")
        forward, right = (expo_deadzone(stick, STICK_EXPO, deadzone) for stick in (sticks.pitch, sticks.roll))
        size = max(1.0, math.hypot(forward, right))
        stick = _turned(forward / size, right / size, heading if math.isfinite(heading) else yaw)
        self._steer(stick, dt_s)
        moving = self._flat_velocity[0] ** 2 + self._flat_velocity[1] ** 2 > _STOPPED_M2_S2
        if moving:
            self._lock = None
        elif self._lock is None:
            self._lock = position[0], position[1]
        north, east = self._lock or (math.nan, math.nan)
        down, climb = self._height(sticks, position[2], velocity[2], height, dt_s)
        return MotionSetpoint(
            (north, east, down),
            (self._flat_velocity[0], self._flat_velocity[1], climb),
            (self._flat_acceleration[0], self._flat_acceleration[1], math.nan),
            heading if math.isfinite(heading) else yaw,
            rate,
        )

    def _turn(self, sticks: Sticks, yaw: float, dt_s: float) -> tuple[float, float]:
        """Locked heading (NaN while turning) and yaw rate."""
        self._yaw.update(sticks.yaw, yaw, dt_s)
        turning = math.isnan(self._yaw.heading)
        return self._yaw.heading, self._yaw.rate if turning else math.nan

    def _steer(self, stick: tuple[float, float], dt_s: float) -> None:
        """PX4's velocity set-point: pushed by the stick, held back by a drag that makes MPC_VEL_MANUAL the fastest."""
        push = 2.0 * self._get("MPC_ACC_HOR")
        fastest = max(0.1, self._get("MPC_VEL_MANUAL"))
        jerk = self._get("MPC_JERK_MAX") * dt_s
        released = stick[0] ** 2 + stick[1] ** 2 < _STOPPED_M2_S2
        goal = max(2.0, math.sqrt(fastest)) if released else 1.0
        self._boost += dt_s / (dt_s + _BRAKE_TAU_S) * (goal - self._boost)
        v = self._flat_velocity
        speed = math.hypot(v[0], v[1])
        pushed = [0.0, 0.0]
        drag = [0.0, 0.0]
        for i in (0, 1):
            self._pushed[i] += min(jerk, max(-jerk, stick[i] * push - self._pushed[i]))
            pushed[i] = self._pushed[i]
            if speed > 0.0:
                drag[i] = push / fastest * self._boost * v[i] / speed * (speed if speed > 1.0 else math.sqrt(speed))
        if pushed[0] ** 2 + pushed[1] ** 2 < _STOPPED_M2_S2 and speed < math.hypot(drag[0], drag[1]) * dt_s:
            v[:] = drag[:] = [0.0, 0.0]
        most = ONE_G_M_S2 * math.tan(tilt_rad(self._get("MPC_TILTMAX_AIR")))
        size = math.hypot(pushed[0] - drag[0], pushed[1] - drag[1])
        scale = most / size if size > most else 1.0
        for i in (0, 1):
            self._flat_acceleration[i] = (pushed[i] - drag[i]) * scale
            v[i] += self._flat_acceleration[i] * dt_s

    def _height(self, sticks: Sticks, down: float, descent: float, height: float, dt_s: float) -> tuple[float, float]:
        """Height to keep (m, down; NaN while climbing or sinking) and vertical speed (m/s, down)."""
        stick = -expo_deadzone(sticks.throttle, STICK_EXPO, self._get("MAN_DEADZONE"))
        up, dn = self._get("MPC_Z_VEL_MAX_UP"), self._get("MPC_Z_VEL_MAX_DN")
        wanted = stick * (dn if stick > 0.0 else up)
        near, far = self._get("MPC_LAND_ALT2"), self._get("MPC_LAND_ALT1")
        share = min(1.0, max(0.0, (height - near) / max(1e-3, far - near)))
        slow_dn, slow_up = self._get("MPC_LAND_SPEED"), self._get("MPC_TKO_SPEED")
        wanted = min(slow_dn + share * (dn - slow_dn), max(-(slow_up + share * (up - slow_up)), wanted))
        rise, fall = self._get("MPC_ACC_UP_MAX") * dt_s, self._get("MPC_ACC_DOWN_MAX") * dt_s
        self._climb = min(self._climb + fall, max(self._climb - rise, wanted))
        if stick != 0.0 or self._climb != 0.0:
            self._lock_down = math.nan
        elif math.isnan(self._lock_down):
            slowest = self._get("MPC_HOLD_MAX_Z")
            if slowest <= 0.0 or abs(descent) < slowest:
                self._lock_down = down
        return self._lock_down, self._climb


def _turned(forward: float, right: float, yaw: float) -> tuple[float, float]:
    """A vector of the heading frame as north and east."""
    c, s = math.cos(yaw), math.sin(yaw)
    return c * forward - s * right, s * forward + c * right
