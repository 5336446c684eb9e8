"""What follows from being on the ground: "Takeoff detected", "Landing detected", and disarming by itself.

Source: PX4 ``commander`` (COM_DISARM_LAND, COM_DISARM_PRFLT).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from sitl.land_detector import LandLimits
from sitl.parameters import ParameterTable

_GRACE_S = 1.0
"""PX4 counts COM_DISARM_PRFLT from one second after arming."""


class LandingWatch:
    """Follows one armed stretch from arming to disarming.

    Args:
        parameters: COM_DISARM_LAND, COM_DISARM_PRFLT.

    Attributes:
        took_off_us: vehicle time of the take-off, None before.
        disarm: the text to disarm with; empty while there is no reason to.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self.on_arm(0)

    def on_arm(self, now_us: int) -> None:
        """A new stretch begins."""
        self.disarm = ""
        self._armed_us = now_us
        self.took_off_us: int | None = None
        self._landed_us: int | None = None

    def update(self, now_us: int, landed: bool) -> Iterator[str]:
        """Look once more; texts to say.

        Args:
            now_us: vehicle time, us. landed: from the land detector.
        """
        if not landed:
            self._landed_us = None
            if self.took_off_us is None:
                self.took_off_us = now_us
                yield "Takeoff detected\t"
        elif self.took_off_us is not None:
            if self._landed_us is None:
                self._landed_us = now_us
                yield "Landing detected\t"
            if self._over("COM_DISARM_LAND", now_us - self._landed_us):
                self.disarm = "Disarmed by landing\t"
        elif self._over("COM_DISARM_PRFLT", now_us - self._armed_us - round(_GRACE_S * 1e6)):
            self.disarm = "Disarmed by auto preflight disarming\t"

    def _over(self, parameter: str, waited_us: int) -> bool:
        """Has the time in a parameter passed? Zero or less means never."""
        wait_s = float(self._parameters.get(parameter))
        return wait_s > 0.0 and waited_us >= wait_s * 1e6


def land_limits(parameters: ParameterTable) -> LandLimits:
    """Return the land detector's thresholds from MPC_* and LNDMC_*."""
    get = parameters.get
    return LandLimits(
        thr_min=float(get("MPC_THR_MIN")),
        hover_thrust=float(get("MPC_THR_HOVER")),
        manual_min=float(get("MPC_MANTHR_MIN")),
        z_vel_max=float(get("LNDMC_Z_VEL_MAX")),
        xy_vel_max=float(get("LNDMC_XY_VEL_MAX")),
        rot_max=math.radians(float(get("LNDMC_ROT_MAX"))),
    )
