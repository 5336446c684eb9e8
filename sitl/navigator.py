"""Where Takeoff, Hold, Land and Descend want to be: NED set-points for the position controller.

PX4's take-off state machine (spool-up, thrust ramp, flight) and its landing speeds; the way there is flown at
limited speed and acceleration, without PX4's jerk limit.
"""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from sitl.filters import constrain
from sitl.modes import Mode, Severity, Text
from sitl.parameters import ParameterTable
from sitl.position_control import ONE_G_M_S2, POSITION_INPUT


class TakeoffState(Enum):
    """PX4's take-off states."""

    DISARMED = 0
    SPOOLUP = 1
    READY = 2
    RAMPUP = 3
    FLIGHT = 4


class Navigator:
    """Set-points of the modes that hold a position.

    Args:
        parameters: MPC_*, MIS_TAKEOFF_ALT, COM_SPOOLUP_TIME.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self.request = np.zeros(1, POSITION_INPUT)
        # views: writing through them costs a tenth of writing a field of a structured array
        self._idle = self.request["idle"]
        self._yaw_sp = self.request["yaw_sp"]
        self._position_sp = self.request["position_sp"][0]
        self._velocity_sp = self.request["velocity_sp"][0]
        self._idle[0] = True
        self.state = TakeoffState.DISARMED
        self.hold_ned = [0.0, 0.0, 0.0]
        self.yaw = 0.0
        self.target_down: float | None = None
        self.descending = False
        self._armed_us = 0
        self._ramp = 0.0
        self._climb = 0.0

    def _get(self, name: str) -> float:
        return float(self._parameters.get(name))

    def on_arm(self, now_us: int) -> None:
        """Start the spool-up clock."""
        self.state = TakeoffState.SPOOLUP
        self._armed_us = now_us
        self._ramp = 0.0
        self._climb = 0.0

    def on_disarm(self) -> None:
        """Stop."""
        self.state = TakeoffState.DISARMED
        self.target_down = None

    def airborne(self) -> None:
        """Another mode brought it into the air: skip spool-up and ramp."""
        if self.state in (TakeoffState.SPOOLUP, TakeoffState.READY, TakeoffState.RAMPUP):
            self.state = TakeoffState.FLIGHT

    def enter(self, position: tuple[float, float, float], velocity: tuple[float, float, float], yaw: float) -> None:
        """A mode of this navigator begins: hold where the vehicle can stop.

        Args:
            position: NED, m. velocity: NED, m/s. yaw: rad.
        """
        brake = 2.0 * self._get("MPC_ACC_HOR")
        reach = math.hypot(velocity[0], velocity[1]) / brake if brake > 0.0 else 0.0
        self.hold_ned = [position[0] + velocity[0] * reach, position[1] + velocity[1] * reach, position[2]]
        self.yaw = yaw
        self._climb = velocity[2]
        self.descending = self.state not in (TakeoffState.RAMPUP, TakeoffState.FLIGHT)

    def aim(self, target_down: float | None) -> list[Text]:
        """Choose the height of a take-off that begins where this navigator was entered.

        Args:
            target_down: wanted height in the local frame, m (down); None or not finite for MIS_TAKEOFF_ALT above here.

        Returns:
            texts to say.
        """
        here, texts = self.hold_ned[2], []
        if target_down is None or not math.isfinite(target_down):
            height = self._get("MIS_TAKEOFF_ALT")
            target_down = here - height
            texts.append(Text(Severity.INFO, f"Using default takeoff altitude: {height:.1f} m"))
        if target_down > here:
            target_down = here
            texts.append(Text(Severity.CRITICAL, "Already higher than takeoff altitude"))
        self.target_down = target_down
        return texts

    def reached(self, down: float) -> bool:
        """Is the take-off height reached? down: m."""
        return self.target_down is not None and abs(down - self.target_down) < 0.3 and abs(self._climb) < 0.5

    def _speed_up_to(self, wanted: float, dt_s: float) -> float:
        rise = self._get("MPC_ACC_UP_MAX") * dt_s
        fall = self._get("MPC_ACC_DOWN_MAX") * dt_s
        self._climb = min(self._climb + fall, max(self._climb - rise, wanted))
        return self._climb

    def _landing_speed(self, height: float) -> float:
        fast, slow = self._get("MPC_Z_V_AUTO_DN"), self._get("MPC_LAND_SPEED")
        top, bottom = self._get("MPC_LAND_ALT1"), self._get("MPC_LAND_ALT2")
        share = min(1.0, max(0.0, (height - bottom) / max(1e-3, top - bottom)))
        return slow + share * (fast - slow)

    def update(
        self,
        now_us: int,
        dt_s: float,
        mode: Mode,
        position: tuple[float, float, float],
        ground_contact: bool,
        landed: bool,
        home_down: float,
    ) -> None:
        """Set-points for the next run of the position controller.

        Args:
            now_us: vehicle time. dt_s: time since the last run.
            mode: one of POSITION_MODES.
            position: NED, m.
            ground_contact: from the land detector. landed: likewise.
            home_down: height of home in the local frame, m (down).
        """
        position_sp, velocity_sp = self._position_sp, self._velocity_sp
        self._yaw_sp[0] = self.yaw
        position_sp[0] = self.hold_ned[0]
        position_sp[1] = self.hold_ned[1]
        velocity_sp[:] = 0.0
        if self.state is TakeoffState.SPOOLUP and now_us - self._armed_us >= self._get("COM_SPOOLUP_TIME") * 1e6:
            self.state = TakeoffState.READY
        if self.state is TakeoffState.FLIGHT and landed:
            self.state = TakeoffState.READY
        self.descending = mode in (Mode.LAND, Mode.DESCEND)
        if self.state is TakeoffState.READY and mode is Mode.TAKEOFF and self._is_above(position[2]):
            self.state = TakeoffState.RAMPUP
            self._ramp = 0.0
            self._climb = 0.0
        if self.state in (TakeoffState.DISARMED, TakeoffState.SPOOLUP, TakeoffState.READY):
            self._idle[0] = True
            self.hold_ned = list(position)
            self.descending = True
            return
        self._idle[0] = ground_contact and self.state is TakeoffState.FLIGHT and self.descending
        if self.descending:
            position_sp[2] = math.nan
            velocity_sp[2] = self._speed_up_to(self._landing_speed(home_down - position[2]), dt_s)
            if mode is Mode.DESCEND:
                position_sp[:2] = math.nan
            return
        if mode is Mode.TAKEOFF and self.target_down is not None:
            towards = self._get("MPC_Z_P") * (self.target_down - position[2])
            towards = constrain(towards, -self._get("MPC_TKO_SPEED"), self._get("MPC_Z_V_AUTO_DN"))
            climb = self._speed_up_to(towards, dt_s)
            if self.state is TakeoffState.RAMPUP:
                climb = self._ramped(climb, dt_s)
            position_sp[2] = math.nan
            velocity_sp[2] = climb
            return
        position_sp[2] = self.hold_ned[2]

    def _is_above(self, down: float) -> bool:
        """Is there any way up to the take-off height? down: where the vehicle is, m."""
        return self.target_down is not None and self.target_down < down - 0.01

    def _ramped(self, climb: float, dt_s: float) -> float:
        """PX4's thrust ramp: from the speed set-point that means no thrust to the wanted one."""
        ramp_s = self._get("MPC_TKO_RAMP_T")
        self._ramp = min(1.0, self._ramp + dt_s / ramp_s) if ramp_s > dt_s else 1.0
        if self._ramp >= 1.0:
            self.state = TakeoffState.FLIGHT
            return climb
        start = ONE_G_M_S2 / max(0.01, self._get("MPC_Z_VEL_P_ACC"))
        ramped = start + self._ramp * (climb - start)
        self.descending = ramped > 0.0
        return ramped
