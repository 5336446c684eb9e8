"""Which sticks fly the vehicle: a joystick on one of its links or a radio, chosen by COM_RC_IN_MODE.

A source that flies the vehicle keeps it until it falls silent for COM_RC_LOSS_T, unless one that ranks higher speaks.
Source: PX4 ``manual_control/ManualControlSelector.cpp``, ``ManualControl.cpp``.
"""

from __future__ import annotations

import math

from sitl.parameters import ParameterTable
from sitl.setpoints import Sticks

RADIO = -1
"""Source of sticks that came as radio channels; joysticks are numbered from 0 by link."""

_RADIO_ONLY, _JOYSTICK_ONLY, _FALLBACK, _FIRST_EVER = range(4)
_RANKED = {5: (RADIO, 0, 1), 6: (0, 1, RADIO), 7: (RADIO, 1, 0), 8: (1, 0, RADIO)}
"""Values of COM_RC_IN_MODE that rank the sources, the first the highest."""
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
        self._first: int | None = None
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
        rank = self._rank(source)
        if rank is None or not all(math.isfinite(stick) for stick in sticks):
            return False
        if self._source not in (None, source) and self._fresh(now_us):
            held = self._rank(self._source)
            if held is not None and rank >= held:
                return False
            self._lag = None
        self._source = source
        self._first = source if self._first is None else self._first
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

    def _rank(self, source: int | None) -> int | None:
        """Place of a source among those that COM_RC_IN_MODE allows, the highest 0; None if it does not."""
        mode = int(self._parameters.get("COM_RC_IN_MODE"))
        if mode in _RANKED:
            order = _RANKED[mode]
            return order.index(source) if source in order else None
        first = mode == _FIRST_EVER and self._first in (None, source)
        only = mode == (_RADIO_ONLY if source == RADIO else _JOYSTICK_ONLY)
        return 0 if only or first or mode == _FALLBACK else None

    def _fresh(self, now_us: int) -> bool:
        return now_us - self._came_us <= float(self._parameters.get("COM_RC_LOSS_T")) * 1e6
