"""RollSet: a gain set as an analysis of the roll axis sees it, from the PX4 parameters that a flight would hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sitl.control_settings import control_settings, mix_of
from sitl.parameters import ParameterTable
from sitl.profile import Profile
from sitl.sampled_loop import RollGains
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import VehicleModel


@dataclass(frozen=True)
class RollSet:
    """A gain set as the batch flies it.

    Attributes:
        settings: () of CONTROL_SETTINGS.
        gains: of the roll axis. profile: with the filter cutoffs that the set flies.
    """

    settings: npt.NDArray[np.void]
    gains: RollGains
    profile: Profile


def roll_set(model: VehicleModel, profile: Profile, parameters: Mapping[str, float]) -> RollSet:
    """Settings of PX4 parameters on an airframe, as a flight would have them.

    Args:
        model: the body: rotors and hover thrust. profile: fidelity. parameters: PX4 name -> value; the rest keeps
            PX4's default.

    Raises:
        UsageError: an unknown parameter or a value that cannot be stored.
    """
    table = ParameterTable(airframe_parameters(model, profile))
    for name, value in parameters.items():
        table.set(name, value)

    def get(name: str) -> float:
        return float(table.get(name))

    gains = RollGains(
        k_phi=get("MC_ROLL_P"),
        k=get("MC_ROLLRATE_K"),
        kp=get("MC_ROLLRATE_P"),
        ki=get("MC_ROLLRATE_I"),
        kd=get("MC_ROLLRATE_D"),
        kff=get("MC_ROLLRATE_FF"),
    )
    flown = replace(profile, gyro_cutoff_hz=get("IMU_GYRO_CUTOFF"), dgyro_cutoff_hz=get("IMU_DGYRO_CUTOFF"))
    return RollSet(control_settings(table, profile, mix_of(table))[0], gains, flown)


def roll_sets(model: VehicleModel, profile: Profile, gains: Sequence[RollGains]) -> list[RollSet]:
    """Sets that differ in the gains of the roll axis alone.

    Args:
        model: the body. profile: fidelity. gains: one per set.
    """
    base = roll_set(model, profile, {})
    made = []
    for one in gains:
        settings = base.settings.copy()
        settings["att_gain"][0] = one.k_phi
        for field in ("k", "kp", "ki", "kd", "kff"):
            settings[field][0] = getattr(one, field)
        made.append(RollSet(settings, one, base.profile))
    return made
