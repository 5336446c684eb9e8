"""Parameters that contradict one another, put right by the vehicle itself as PX4's modules do.

Storing a parameter never fails or clamps. Half a second later the module that uses it may find that a design speed
is above the limit it has to stay below; then it writes the limit back, says so, and the ground station hears the
corrected value as a second announcement.
Source: PX4 MulticopterPositionControl (parameters_update), MulticopterLandDetector and VehicleAngularVelocity.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from sitl.parameters import ParameterTable, from_raw, to_raw

DELAY_US: Final = 500_000
"""Time from a change to its correction, us."""

_SAFE_TILT_DEG: Final = 89.0
_GYRO_RATE_HZ: Final = (50, 10_000)
_LANDING_MARGIN: Final = 1.2

_BELOW: Final = (
    ("MPC_TILTMAX_LND", "MPC_TILTMAX_AIR", "Land tilt has been constrained by max tilt\t"),
    ("MPC_XY_CRUISE", "MPC_XY_VEL_MAX", "Cruise speed has been constrained by max speed\t"),
    ("MPC_VEL_MANUAL", "MPC_XY_VEL_MAX", "Manual speed has been constrained by max speed\t"),
    ("MPC_VEL_MAN_BACK", "MPC_VEL_MANUAL", "Manual backward speed has been constrained by forward speed\t"),
    ("MPC_VEL_MAN_SIDE", "MPC_VEL_MANUAL", "Manual sideways speed has been constrained by forward speed\t"),
    ("MPC_Z_V_AUTO_UP", "MPC_Z_VEL_MAX_UP", "Ascent speed has been constrained by max speed\t"),
    ("MPC_Z_V_AUTO_DN", "MPC_Z_VEL_MAX_DN", "Descent speed has been constrained by max speed\t"),
)
"""Parameter, the one it must not exceed, and what PX4 says when it does."""


_FOLLOWS: Final = (
    *((name, limit) for name, limit, _ in _BELOW),
    ("MPC_THR_HOVER", "MPC_THR_MIN"),
    ("MPC_THR_HOVER", "MPC_THR_MAX"),
    ("LNDMC_Z_VEL_MAX", "MPC_LAND_SPEED"),
    ("LNDMC_Z_VEL_MAX", "MPC_LAND_CRWL"),
)
"""Parameter that may be corrected, and the one whose change may bring that about."""


def companions(names: Collection[str]) -> tuple[str, ...]:
    """Return the parameters that a vehicle may correct when these are set: who puts these back puts those back, too.

    Args:
        names: of parameters. A name that a PX4 has not is no harm.
    """
    found: set[str] = set()
    while more := {name for name, cause in _FOLLOWS if cause in found.union(names)} - found:
        found |= more
    return tuple(sorted(found - set(names)))


def corrected(names: Collection[str]) -> tuple[str, ...]:
    """Return those of some parameters that a vehicle may correct, each behind the ones that it is corrected against.

    Args:
        names: of parameters.
    """
    return tuple(dict.fromkeys(name for name, _ in _FOLLOWS if name in names))


def correct(table: ParameterTable) -> list[str]:
    """Put right what PX4's modules would; a NaN is beyond comparison and stays.

    Args:
        table: changed in place.

    Returns:
        texts for a ground station, of severity CRITICAL; some corrections are made without one, as on a PX4.
    """
    said: list[str] = []
    if table.get("MPC_TILTMAX_AIR") > _SAFE_TILT_DEG:
        table.set("MPC_TILTMAX_AIR", _SAFE_TILT_DEG)
        said.append("Tilt constrained to safe value\t")
    for name, limit, text in _BELOW:
        if table.get(name) > table.get(limit):
            table.set_raw(name, table.raw(limit))
            said.append(text)
    hover, least, most = (table.get(f"MPC_THR_{what}") for what in ("HOVER", "MIN", "MAX"))
    if hover > most or hover < least:
        table.set("MPC_THR_HOVER", min(max(hover, least), most))
        said.append("Hover thrust has been constrained by min/max\t")
    landing = min(table.get("MPC_LAND_CRWL"), table.get("MPC_LAND_SPEED")) / _LANDING_MARGIN
    if table.get("LNDMC_Z_VEL_MAX") > _real32(landing):
        table.set("LNDMC_Z_VEL_MAX", landing)
    rate_hz = int(table.get("IMU_GYRO_RATEMAX"))
    if rate_hz <= 0:
        table.reset("IMU_GYRO_RATEMAX")
    elif not _GYRO_RATE_HZ[0] <= rate_hz <= _GYRO_RATE_HZ[1]:
        table.set("IMU_GYRO_RATEMAX", min(max(rate_hz, _GYRO_RATE_HZ[0]), _GYRO_RATE_HZ[1]))
    return said


def _real32(value: float) -> float:
    return from_raw("REAL32", to_raw("", "REAL32", value))


class ParameterCorrector:
    """Corrects a table a while after it was changed.

    Args:
        table: the vehicle's parameters; what they are at the start is taken as it is.
    """

    def __init__(self, table: ParameterTable) -> None:
        self.table = table
        self._revision = table.revision
        self._due_us: int | None = None

    def poll(self, now_us: int) -> list[str]:
        """Correct what is due; call it every few milliseconds.

        Args:
            now_us: vehicle time, us.

        Returns:
            texts, see `correct`.
        """
        if self._revision != self.table.revision:
            self._revision = self.table.revision
            if self._due_us is None:
                self._due_us = now_us + DELAY_US
        if self._due_us is None or now_us < self._due_us:
            return []
        self._due_us = None
        said = correct(self.table)
        self._revision = self.table.revision
        return said
