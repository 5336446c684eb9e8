"""Motors that stand still under an autopilot that asks for thrust: outputs that were never assigned."""

from __future__ import annotations

from collections.abc import Sequence

LIMIT_US = 1_000_000
"""Vehicle time at exactly 0 after which a motor counts as standing, us: no limit cycle holds one down so long."""

THRUST_MIN = 0.1
"""Collective set-point from which on a motor has to turn."""


class MotorWatch:
    """Follows the motor commands of a flight.

    Args:
        count: rotors of the airframe.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._since_us: list[int | None] = [None] * count

    def standing(self, now_us: int, motors: Sequence[float], thrust_sp: float) -> list[int]:
        """Look at one moment.

        Args:
            now_us: vehicle time. motors: commands, 0 to 1; empty if none came yet. thrust_sp: 0 to 1.

        Returns:
            numbers, from 1, of motors that have been at 0 for LIMIT_US while thrust was asked for.
        """
        if thrust_sp < THRUST_MIN:
            self._since_us = [None] * self._count
            return []
        long: list[int] = []
        for n in range(self._count):
            if n < len(motors) and motors[n] != 0.0:
                self._since_us[n] = None
                continue
            since = self._since_us[n]
            if since is None:
                self._since_us[n] = now_us
            elif now_us - since >= LIMIT_US:
                long.append(n + 1)
        return long
