"""What tuned gains must do, and the limits that each fidelity profile is judged by."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from sitl.errors import UsageError


@dataclass(frozen=True)
class Requirements:
    """What a roll loop must do on every sample of its model.

    The first three bound the search and decide what is met; the others shape its weights.

    Attributes:
        settling_time_s: last time outside 5 % of a roll step.
        overshoot_pct: of the step's amplitude.
        delay_margin_s: extra delay that the loop must bear; 0 asks for stability only.
        natural_frequency_rad_s: least speed of the closed loop (study, section 7.1).
        damping: least damping ratio (study, section 7.1, whose print says "below"; see the errata).
        peak_sensitivity: largest |S| (study, section 7.1).
        peak_delta_lat: largest roll torque in a step of `amplitude_deg`; inf for the study's "no limit".
        amplitude_deg: of the step that is flown.
    """

    settling_time_s: float
    overshoot_pct: float
    delay_margin_s: float
    natural_frequency_rad_s: float = 10.0
    damping: float = 0.9
    peak_sensitivity: float = 1.3
    peak_delta_lat: float = math.inf
    amplitude_deg: float = 10.0

    def __post_init__(self) -> None:
        """Raise UsageError for a requirement that nothing can meet."""
        for name, value in asdict(self).items():
            may_be_0 = name in ("overshoot_pct", "delay_margin_s")
            endless = math.isinf(value) and name != "peak_delta_lat"
            if math.isnan(value) or endless or value < 0.0 or (value == 0.0 and not may_be_0):
                wanted = "0 or a number above it" if may_be_0 else "a number above 0"
                raise UsageError(f"requirement {name} = {value:g}: give {wanted}")
        if self.settling_time_s < 0.05:
            raise UsageError(
                f"requirement settling_time_s = {self.settling_time_s:g}: no multirotor settles within 0.05 s"
            )
        if not 0.1 <= self.amplitude_deg <= 45.0:
            raise UsageError(f"requirement amplitude_deg = {self.amplitude_deg:g}: give 0.1 to 45")


STUDY = Requirements(settling_time_s=0.5, overshoot_pct=0.15, delay_margin_s=0.0)
"""Section 7.1. It does not print the settling band: 5 % is ours."""

PRACTICAL = Requirements(
    settling_time_s=0.6,
    overshoot_pct=5.0,
    delay_margin_s=0.020,
    natural_frequency_rad_s=6.0,
    damping=0.7,
    peak_sensitivity=1.8,
    peak_delta_lat=0.5,
)
"""With motors, filters and ticks in the loop: room for the delays that a model leaves out."""


def requirements_for(profile: str) -> Requirements:
    """The requirements of a fidelity profile unless others are given.

    Args:
        profile: name of one of `sitl.profile.PROFILES`.
    """
    return STUDY if profile == "study" else PRACTICAL
