"""PX4's way off the ground: spool-up, waiting, thrust ramp, flight.

Source: PX4 ``mc_pos_control/Takeoff``.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from sitl.position_control import ONE_G_M_S2


class TakeoffState(Enum):
    """PX4's take-off states."""

    DISARMED = 0
    SPOOLUP = 1
    READY = 2
    RAMPUP = 3
    FLIGHT = 4


ON_GROUND = (TakeoffState.DISARMED, TakeoffState.SPOOLUP, TakeoffState.READY)
"""Without thrust."""


class Takeoff:
    """The state machine of one vehicle.

    Args:
        get: reads COM_SPOOLUP_TIME, MPC_TKO_RAMP_T, MPC_Z_VEL_P_ACC.

    Attributes:
        armings: how often it was armed.
    """

    def __init__(self, get: Callable[[str], float]) -> None:
        self._get = get
        self.state = TakeoffState.DISARMED
        self.armings = 0
        self._armed_us = 0
        self._ramp = 0.0

    @property
    def grounded(self) -> bool:
        """Do the motors idle?"""
        return self.state in ON_GROUND

    def arm(self, now_us: int) -> None:
        """Start the spool-up clock."""
        self.state = TakeoffState.SPOOLUP
        self.armings += 1
        self._armed_us = now_us
        self._ramp = 0.0

    def spooled_up(self, now_us: int) -> bool:
        """Has COM_SPOOLUP_TIME passed since arming?"""
        return now_us - self._armed_us >= self._get("COM_SPOOLUP_TIME") * 1e6

    def airborne(self) -> None:
        """Another mode brought it into the air: skip spool-up and ramp."""
        if self.state in (TakeoffState.SPOOLUP, TakeoffState.READY, TakeoffState.RAMPUP):
            self.state = TakeoffState.FLIGHT

    def update(self, now_us: int, *, landed: bool, wanted: bool) -> bool:
        """Look once more. wanted: the mode wants to leave the ground. True when the ramp begins."""
        if self.state is TakeoffState.SPOOLUP and self.spooled_up(now_us):
            self.state = TakeoffState.READY
        if self.state is TakeoffState.FLIGHT and landed:
            self.state = TakeoffState.READY
        if self.state is TakeoffState.READY and wanted:
            self.state = TakeoffState.RAMPUP
            self._ramp = 0.0
            return True
        return False

    def ramped(self, climb: float, dt_s: float) -> float:
        """The vertical speed set-point (m/s, down) on the ramp from the one that means no thrust to the wanted one."""
        ramp_s = self._get("MPC_TKO_RAMP_T")
        self._ramp = min(1.0, self._ramp + dt_s / ramp_s) if ramp_s > dt_s else 1.0
        if self._ramp >= 1.0:
            self.state = TakeoffState.FLIGHT
            return climb
        start = ONE_G_M_S2 / max(0.01, self._get("MPC_Z_VEL_P_ACC"))
        return start + self._ramp * (climb - start)
