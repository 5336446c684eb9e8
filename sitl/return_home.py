"""Return: up, home, down a little, wait, land.

Source: PX4 ``navigator`` (RTL, RtlDirect) with RTL_TYPE 0, destination home.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum

from sitl.control_settings import reader
from sitl.legs import Here, Leg, LegKind, Vec3
from sitl.modes import Severity, Text
from sitl.parameters import ParameterTable
from sitl.rotation import to_euler

_THERE_M = 0.5


class ReturnState(Enum):
    """Stages of the way home."""

    BEGIN = 0
    CLIMB = 1
    GO = 2
    DESCEND = 3
    WAIT = 4
    LAND = 5
    IDLE = 6


class ReturnHome:
    """One return of one vehicle.

    Args:
        parameters: RTL_*, NAV_ACC_RAD, NAV_MC_ALT_RAD.

    Attributes:
        state: where it is. texts: what there is to say.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._get = reader(parameters)
        self.texts: deque[Text] = deque(maxlen=8)
        self.start()

    def start(self) -> None:
        """Return begins anew."""
        self.state = ReturnState.BEGIN
        self._from: Vec3 = (0.0, 0.0, 0.0)
        self._yaw = 0.0
        self._down = 0.0
        self._since_us = 0

    def return_height_m(self, here: Here) -> float:
        """Height above home at which to fly back: RTL_RETURN_ALT, less within the cone, never lower than now."""
        get = self._get
        distance, now = here.flat_distance_m(here.home_ned), here.home_ned[2] - here.position_ned[2]
        height, cone_deg = get("RTL_RETURN_ALT"), get("RTL_CONE_ANG")
        if cone_deg > 0.0:
            if distance <= get("NAV_ACC_RAD"):
                height = 2.0 * distance
            elif distance <= get("RTL_MIN_DIST"):
                cone = distance / math.tan(math.radians(min(89.0, max(1.0, cone_deg))))
                height = min(height, max(cone, 2.0 * get("NAV_ACC_RAD")))
        return max(height, now) if math.isfinite(height) else now

    def leg(self, here: Here) -> Leg:
        """What to fly now."""
        home = here.home_ned
        if self.state is ReturnState.BEGIN:
            self._begin(here)
        yaw = to_euler(here.home.quat)[2] if here.home else math.nan
        if self.state is ReturnState.CLIMB:
            if abs(here.position_ned[2] - self._down) > self._get("NAV_MC_ALT_RAD"):
                return Leg(LegKind.GO, (self._from[0], self._from[1], self._down), self._yaw)
            self.state = ReturnState.GO
        if self.state is ReturnState.GO:
            if here.flat_distance_m(home) > self._get("NAV_ACC_RAD"):
                near = here.flat_distance_m(home) < self._get("RTL_MIN_DIST")
                return Leg(LegKind.GO, (home[0], home[1], self._down), yaw if near else math.nan)
            self.state = ReturnState.DESCEND if self._get("RTL_LAND_DELAY") else self._touch_down()
        lower = (home[0], home[1], max(self._down, home[2] - max(0.0, self._get("RTL_DESCEND_ALT"))))
        if self.state is ReturnState.DESCEND:
            high = abs(here.position_ned[2] - lower[2]) > self._get("NAV_MC_ALT_RAD")
            if high or here.flat_distance_m(home) > _THERE_M:
                return Leg(LegKind.GO, lower, yaw)
            self.state, self._since_us = ReturnState.WAIT, here.now_us
            if self._get("RTL_LAND_DELAY") < 0.0:
                self._say("RTL: completed, loitering")
        if self.state is ReturnState.WAIT:
            wait_s = self._get("RTL_LAND_DELAY")
            if wait_s < 0.0 or here.now_us - self._since_us < wait_s * 1e6:
                return Leg(LegKind.GO, lower, yaw)
            self.state = self._touch_down()
        if self.state is ReturnState.LAND and here.landed:
            self.state = ReturnState.IDLE
        return Leg(LegKind.LAND, home, yaw)

    def _begin(self, here: Here) -> None:
        height = self.return_height_m(here)
        self._from, self._yaw = here.position_ned, here.yaw
        self._down = here.home_ned[2] - height
        amsl = (here.home.alt_m if here.home else 0.0) + height
        if here.landed:
            self.state = ReturnState.IDLE
            return
        self.state = ReturnState.CLIMB if here.position_ned[2] > self._down else ReturnState.GO
        self._say(f"RTL: start return at {math.ceil(amsl)} m ({math.ceil(height)} m above destination)")

    def _touch_down(self) -> ReturnState:
        self._say("RTL: land at destination")
        return ReturnState.LAND

    def _say(self, text: str) -> None:
        self.texts.append(Text(Severity.INFO, f"{text}\t"))
