"""Is a ground station there? Source: PX4 ``commander/Commander.cpp``, dataLinkCheck."""

from __future__ import annotations

from sitl.parameters import ParameterTable


class GroundContact:
    """Contact with ground stations, on whatever link.

    Args:
        parameters: COM_DL_LOSS_T, NAV_DLL_ACT.

    Attributes:
        lost: there was one, and it has been silent for COM_DL_LOSS_T.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self._heard_us: int | None = None
        self.lost = False

    @property
    def missed(self) -> bool:
        """None is there, and NAV_DLL_ACT wants one."""
        return (self._heard_us is None or self.lost) and int(self._parameters.get("NAV_DLL_ACT")) > 0

    def heard(self, now_us: int) -> None:
        """One is there. now_us: vehicle time."""
        self._heard_us = now_us

    def update(self, now_us: int) -> str:
        """Look once more; what there is to say about it, or nothing. now_us: vehicle time."""
        if self._heard_us is None:
            return ""
        before, silent_us = self.lost, now_us - self._heard_us
        self.lost = silent_us > float(self._parameters.get("COM_DL_LOSS_T")) * 1e6
        if self.lost == before:
            return ""
        return "Connection to ground station lost\t" if self.lost else "GCS connection regained\t"
