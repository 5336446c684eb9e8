"""Has the vehicle tipped over? Source: PX4 ``commander/failure_detector``."""

from __future__ import annotations

import math

from sitl.failsafe import Action
from sitl.parameters import ParameterTable

_FLIGHT_TERMINATION_OFF = 121212


class TiltDetector:
    """PX4's failure detector for roll and pitch: beyond FD_FAIL_x for FD_FAIL_x_TTRI seconds.

    Args:
        parameters: the table.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self._since_us: list[int | None] = [None, None]
        self._revision = -1
        self._limits: tuple[tuple[float, float], ...] = ()
        self.failed = False

    def _load(self) -> None:
        get = self._parameters.get
        self._revision = self._parameters.revision
        self._limits = tuple(
            (math.radians(float(get(f"FD_FAIL_{axis}"))), float(get(f"FD_FAIL_{axis}_TTRI")) * 1e6) for axis in "RP"
        )

    def update(self, now_us: int, phi: float, theta: float, watched: bool) -> None:
        """Look once more.

        Args:
            now_us: vehicle time, us. phi: roll, rad. theta: pitch, rad.
            watched: attitude control is on and the vehicle is armed.
        """
        if not watched:
            self._since_us = [None, None]
            self.failed = False
            return
        if self._revision != self._parameters.revision:
            self._load()
        for axis, angle in enumerate((phi, theta)):
            limit, patience_us = self._limits[axis]
            since = self._since_us[axis]
            if not limit > 0.0 or abs(angle) <= limit:
                self._since_us[axis] = None
            elif since is None:
                self._since_us[axis] = now_us
            elif now_us - since >= patience_us:
                self.failed = True
        if self._since_us == [None, None]:
            self.failed = False

    def action(self, armed_for_us: int) -> Action:
        """What to do about it: disarm just after arming, later terminate if CBRK_FLIGHTTERM allows, else warn."""
        get = self._parameters.get
        if armed_for_us < (float(get("COM_SPOOLUP_TIME")) + float(get("COM_LKDOWN_TKO"))) * 1e6:
            return Action.DISARM
        return Action.TERMINATE if int(get("CBRK_FLIGHTTERM")) != _FLIGHT_TERMINATION_OFF else Action.WARN
