"""The roll step of many gain sets on many models: what a synthesis may not break, measured as flights are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scenarios.manoeuvres import make_manoeuvre
from scenarios.monte_carlo import monte_carlo
from scenarios.roll_set import RollSet, roll_set
from scenarios.tuning.requirements import Requirements
from sitl.crossings import FloatArray
from sitl.profile import Profile
from sitl.sampled_loop import RollGains
from sitl.vehicle_spec import VehicleModel

HOLD_S = 3.0


@dataclass(frozen=True)
class Trial:
    """Metrics of the step, each (gain sets, models).

    Attributes:
        settling_s: 5 % band; inf if it never settles, cycles or diverges.
        overshoot_pct: inf if it cycles or diverges.
    """

    settling_s: FloatArray
    overshoot_pct: FloatArray


class StepTrial:
    """Flies the step of the requirements on one vehicle.

    Args:
        model: the vehicle. profile: fidelity. requirements: amplitude of the step.
    """

    def __init__(self, model: VehicleModel, profile: Profile, requirements: Requirements) -> None:
        self._model, self._profile = model, profile
        self._base = roll_set(model, profile, {})
        self._step = make_manoeuvre("step", amplitude_deg=requirements.amplitude_deg, hold_s=HOLD_S, return_s=0.0)

    def fly(self, gains: Sequence[RollGains], derivatives: FloatArray) -> Trial:
        """All gain sets on all models.

        Args:
            gains: K sets. derivatives: (M, 6).
        """
        sets = {str(number): self._set(one) for number, one in enumerate(gains)}
        flown = monte_carlo(
            self._model, sets, self._profile, [self._step], derivatives=derivatives, margins=False
        ).metrics
        return Trial(_or_inf(flown["settling_time_5pct_s"]), _or_inf(flown["overshoot_pct"]))

    def _set(self, gains: RollGains) -> RollSet:
        settings = self._base.settings.copy()
        settings["att_gain"][0] = gains.k_phi
        for field in ("k", "kp", "ki", "kd", "kff"):
            settings[field][0] = getattr(gains, field)
        return RollSet(settings, gains, self._base.profile)


def _or_inf(values: FloatArray) -> FloatArray:
    return np.where(np.isnan(values), math.inf, values)
