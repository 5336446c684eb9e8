"""From sticks to attitude and thrust (Stabilized, which Manual is on a multicopter) or to body rates (Acro).

Source: PX4 ``mc_att_control`` and ``mc_rate_control``; curves of ``mathlib``.
"""

from __future__ import annotations

import math

from sitl.control_settings import reader
from sitl.parameters import ParameterTable
from sitl.rotation import from_euler, multiply
from sitl.setpoints import Sticks

Quat = tuple[float, float, float, float]
Vec3 = tuple[float, float, float]

STICK_EXPO = 0.6
"""Share of the cubic in PX4's stick curves outside Acro."""
CENTRED = Sticks()
TAKEOFF_THROTTLE = 0.3
"""Throttle beyond which Altitude and Position leave the ground."""

_THROTTLE_MIN_SLEW, _THROTTLE_MAX_SLEW = 0.05, 0.5
_ARMING_GESTURE = -0.9
_STILL_RAD_S = 1e-3


def clean(sticks: Sticks | None) -> Sticks:
    """Sticks within +-1; what is missing or not finite is centred."""
    if sticks is None:
        return CENTRED
    roll, pitch, yaw, throttle = (min(1.0, max(-1.0, x)) if math.isfinite(x) else 0.0 for x in sticks)
    return Sticks(roll, pitch, yaw, throttle)


def expo_deadzone(value: float, expo: float, deadzone: float) -> float:
    """A stick with nothing happening around its centre and a part of its cube beyond."""
    deadzone = min(0.99, max(0.0, deadzone)) if math.isfinite(deadzone) else 0.0
    if abs(value) <= deadzone:
        return 0.0
    moved = (value - math.copysign(deadzone, value)) / (1.0 - deadzone)
    return (1.0 - expo) * moved + expo * moved**3


def superexpo(value: float, expo: float, steep: float) -> float:
    """PX4's curve for Acro: expo, then ever steeper towards full deflection (steep 0..0.95)."""
    expo = min(1.0, max(0.0, expo)) if math.isfinite(expo) else 0.0
    steep = min(0.95, max(0.0, steep)) if math.isfinite(steep) else 0.0
    return ((1.0 - expo) * value + expo * value**3) * (1.0 - steep) / (1.0 - abs(value) * steep)


def tilt_rad(limit_deg: float) -> float:
    """A tilt limit that can be reckoned with, rad: 0..89 deg; NaN is no tilt at all."""
    return math.radians(min(89.0, max(0.0, limit_deg))) if not math.isnan(limit_deg) else 0.0


class StickYaw:
    """Yaw stick to yaw rate; the heading is locked while the stick is centred.

    Args:
        parameters: MAN_DEADZONE, MPC_MAN_Y_MAX, MPC_MAN_Y_TAU.

    Attributes:
        rate: rad/s. heading: the locked one, rad; NaN while turning.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._get = reader(parameters)
        self.reset()

    def reset(self) -> None:
        """Nothing is locked."""
        self.rate = 0.0
        self.heading = math.nan

    def update(self, stick: float, yaw: float, dt_s: float) -> None:
        """One look at the stick (+-1). yaw: where it heads, rad. dt_s: since the last look."""
        get = self._get
        wanted = expo_deadzone(stick, STICK_EXPO, get("MAN_DEADZONE")) * math.radians(get("MPC_MAN_Y_MAX"))
        self.rate += _share(dt_s, get("MPC_MAN_Y_TAU")) * (wanted - self.rate)
        if not math.isfinite(self.rate):
            self.rate = 0.0
        if abs(self.rate) > _STILL_RAD_S:
            self.heading = math.nan
        else:
            self.rate = self.rate if wanted else 0.0
            if math.isnan(self.heading):
                self.heading = yaw


class StickTilt:
    """Roll and pitch sticks as one vector of at most unit length, smoothed with MC_MAN_TILT_TAU."""

    def __init__(self, parameters: ParameterTable) -> None:
        self._get = reader(parameters)
        self.reset()

    def reset(self) -> None:
        """Sticks were centred until now."""
        self._right = self._forward = 0.0

    def update(self, right: float, forward: float, dt_s: float) -> tuple[float, float]:
        """One look at the sticks; smoothed (right, forward)."""
        share = _share(dt_s, self._get("MC_MAN_TILT_TAU"))
        self._right += share * (right - self._right)
        self._forward += share * (forward - self._forward)
        size = max(1.0, math.hypot(self._right, self._forward))
        return self._right / size, self._forward / size


class AttitudeSticks:
    """Stabilized and Acro.

    Args:
        parameters: MPC_MAN_*, MPC_THR_*, MPC_MANTHR_MIN, MC_MAN_TILT_TAU, MC_ACRO_*, COM_SPOOLUP_TIME, MAN_DEADZONE.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._get = reader(parameters)
        self.yaw = StickYaw(parameters)
        self._tilt = StickTilt(parameters)
        self._throttle_min = self._throttle_max = 0.0

    def begin(self, *, flying: bool) -> None:
        """The mode begins. flying: motors turn and carry already; otherwise thrust is released slowly."""
        self.yaw.reset()
        self._tilt.reset()
        self._throttle_min = self._get("MPC_MANTHR_MIN") if flying else 0.0
        self._throttle_max = 1.0 if flying else 0.0

    def attitude(
        self, sticks: Sticks, yaw: float, dt_s: float, *, landed: bool, spooled_up: bool
    ) -> tuple[Quat, float, float]:
        """Stabilized.

        Args:
            sticks: clean. yaw: heading now, rad. dt_s: since the last call.
            landed: least thrust is given up on the ground. spooled_up: COM_SPOOLUP_TIME after arming has passed.

        Returns:
            attitude set-point (body to world), yaw rate set-point (rad/s), thrust (0..1).
        """
        self.yaw.update(sticks.yaw, yaw, dt_s)
        if sticks.throttle < _ARMING_GESTURE and self._get("MC_AIRMODE") != 2:
            self.yaw.heading = math.nan
        right, forward = self._tilt.update(sticks.roll, sticks.pitch, dt_s)
        most = tilt_rad(self._get("MPC_MAN_TILT_MAX"))
        size = math.hypot(right, forward)
        angle = size * most
        lean = math.sin(0.5 * angle) / size if size > 1e-9 else 0.0
        heading = self.yaw.heading if math.isfinite(self.yaw.heading) else yaw
        quat = multiply(from_euler(0.0, 0.0, heading), (math.cos(0.5 * angle), right * lean, -forward * lean, 0.0))
        low = 0.0 if landed else self._get("MPC_MANTHR_MIN")
        self._throttle_min = _slewed(self._throttle_min, low, _THROTTLE_MIN_SLEW * dt_s)
        self._throttle_max = _slewed(self._throttle_max, 1.0, _THROTTLE_MAX_SLEW * dt_s) if spooled_up else 0.0
        return quat, self.yaw.rate, min(self._throttle(sticks.throttle), self._throttle_max)

    def _throttle(self, stick: float) -> float:
        """Stick (+-1) to thrust: over hover thrust at the centre unless MPC_THR_CURVE is 1."""
        low, high = self._throttle_min, self._get("MPC_THR_MAX")
        if self._get("MPC_THR_CURVE") == 1:
            return low + 0.5 * (stick + 1.0) * (high - low)
        hover = self._get("MPC_THR_HOVER")
        return low + (stick + 1.0) * (hover - low) if stick < 0.0 else hover + stick * (high - hover)

    def rates(self, sticks: Sticks) -> tuple[Vec3, float]:
        """Acro: body rate set-points (rad/s) and thrust (0..1)."""
        expo, steep = self._get("MC_ACRO_EXPO"), self._get("MC_ACRO_SUPEXPO")
        expo_yaw, steep_yaw = self._get("MC_ACRO_EXPO_Y"), self._get("MC_ACRO_SUPEXPOY")
        p = superexpo(sticks.roll, expo, steep) * math.radians(self._get("MC_ACRO_R_MAX"))
        q = -superexpo(sticks.pitch, expo, steep) * math.radians(self._get("MC_ACRO_P_MAX"))
        r = superexpo(sticks.yaw, expo_yaw, steep_yaw) * math.radians(self._get("MC_ACRO_Y_MAX"))
        return (p, q, r), 0.5 * (sticks.throttle + 1.0)


def _share(dt_s: float, tau_s: float) -> float:
    """How much of the way a first-order filter goes in one step."""
    return dt_s / (dt_s + tau_s) if tau_s > 0.0 else 1.0


def _slewed(value: float, goal: float, most: float) -> float:
    return value + min(most, max(-most, goal - value))
