"""Which sticks fly the vehicle: a joystick on one of its links or a radio, chosen by COM_RC_IN_MODE.

The first source that speaks keeps the vehicle until it falls silent for COM_RC_LOSS_T.
Source: PX4 ``manual_control/ManualControlSelector.cpp``, ``ManualControl.cpp``.
"""

from __future__ import annotations

import math

from sitl.parameters import ParameterTable
from sitl.setpoints import Sticks

RADIO = -1
"""Source of sticks that came as radio channels; joysticks are numbered from 0 by link."""

_RC_ONLY, _JOYSTICK_ONLY, _BOTH_FALLBACK, _BOTH_FIRST, _DISABLED = range(5)
_RADIO_MODES = (_RC_ONLY, _BOTH_FALLBACK, _BOTH_FIRST)
_JOYSTICK_MODES = (_JOYSTICK_ONLY, _BOTH_FALLBACK, _BOTH_FIRST)
_TAU_S = 0.5
"""How fast the place that a movement of the sticks is measured from follows them."""


class ManualInput:
    """The sticks of one vehicle.

    Args:
        parameters: COM_RC_IN_MODE, COM_RC_LOSS_T, COM_RC_STICK_OV.

    Attributes:
        sticks: where they are, None while there are none.
        moving: a pilot moves them.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self._source: int | None = None
        self._came_us = 0
        self._newest = Sticks()
        self._lag: list[float] | None = None
        self._update_us = 0
        self.sticks: Sticks | None = None
        self.moving = False

    def take(self, now_us: int, source: int, sticks: Sticks) -> bool:
        """Take a new position of the sticks; False if this source does not fly the vehicle.

        Args:
            now_us: vehicle time. source: RADIO or the number of a joystick's link. sticks: each -1..1.
        """
        mode = int(self._parameters.get("COM_RC_IN_MODE"))
        allowed = _RADIO_MODES if source == RADIO else _JOYSTICK_MODES
        if mode not in allowed or not all(math.isfinite(stick) for stick in sticks):
            return False
        if self._source not in (None, source) and self._fresh(now_us):
            return False
        self._source = source
        self._came_us = now_us
        self._newest = Sticks(*(max(-1.0, min(1.0, stick)) for stick in sticks))
        self.sticks = self._newest
        return True

    def update(self, now_us: int) -> None:
        """Look once more: are they still there, do they move?"""
        if self._source is None:
            return
        if not self._fresh(now_us):
            self._source = self.sticks = self._lag = None
            self.moving = False
            return
        if self._lag is None:
            self._lag = list(self._newest)
        share = min(1.0, (now_us - self._update_us) * 1e-6 / _TAU_S)
        self._update_us = now_us
        limit = float(self._parameters.get("COM_RC_STICK_OV")) * 1e-2
        self.moving = any(abs(new - old) > limit for new, old in zip(self._newest, self._lag, strict=True))
        self._lag = [old + share * (new - old) for new, old in zip(self._newest, self._lag, strict=True)]

    def _fresh(self, now_us: int) -> bool:
        return now_us - self._came_us <= float(self._parameters.get("COM_RC_LOSS_T")) * 1e6
