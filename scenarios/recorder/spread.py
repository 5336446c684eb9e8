"""The band that a candidate's response may lie in: the uncertain model flown many times by the batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scenarios.flight import FlightRecord
    from scenarios.scenario import Scenario

SAMPLES = 100
PERCENT = (5.0, 95.0)
RATE_HZ = 50.0
"""At which the band is kept."""

COMPILE_STEPS = 1_000_000
"""From here on compiling is worth while: what is compiled stays for all later runs."""

NAME = f"{PERCENT[0]:g} to {PERCENT[1]:g} % of {SAMPLES} models [deg]"


@dataclass(frozen=True)
class Spread:
    """Roll of one manoeuvre over the uncertain models.

    Attributes:
        t_s: (T,) from the manoeuvre's start.
        low_rad, high_rad: slug of the gain set -> (T,) lower and upper percentile.
    """

    t_s: NDArray[np.float64]
    low_rad: Mapping[str, NDArray[np.float64]]
    high_rad: Mapping[str, NDArray[np.float64]]


def spreads(scenario: Scenario, flights: Sequence[FlightRecord]) -> dict[str, Spread]:
    """Fly every gain set on samples of the scenario's model.

    Args:
        scenario: vehicle, profile, manoeuvres, seed. flights: whose gain sets; those that flew a manoeuvre count.

    Returns:
        manoeuvre's name -> spread; empty where the model's uncertainty is not known or the vehicle is not ours.
    """
    from scenarios.monte_carlo import monte_carlo
    from scenarios.roll_set import roll_set
    from sitl.batch import fly_lanes
    from sitl.compiled import is_compiled
    from sitl.errors import FroudeError

    flights = [flight for flight in flights if flight.segments]
    if not flights or not scenario.manoeuvres:
        return {}
    try:
        model, profile = scenario.resolve_vehicle(), scenario.resolve_profile()
        if not np.any(model.sigma_pct.as_array() > 0.0):
            return {}
        sets = {one.gain_set.slug: roll_set(model, profile, one.gain_set.parameters) for one in flights}
        ticks = sum(one.duration_s for one in scenario.manoeuvres) * profile.rate_hz
        worth = is_compiled(fly_lanes) or len(sets) * SAMPLES * ticks > COMPILE_STEPS
        every = max(1, round(profile.rate_hz / RATE_HZ))
        flown = monte_carlo(
            model,
            sets,
            profile,
            scenario.manoeuvres,
            samples=SAMPLES,
            seed=scenario.seed,
            trace_every=every,
            margins=False,
            setpoint_rate_hz=scenario.setpoint_rate_hz,
            compiled=True if worth else None,
        )
    except FroudeError:
        return {}  # a picture more or less is no reason to lose a run
    traces = flown.traces
    assert traces is not None
    low, high = np.percentile(traces.phi_rad[:, 1:], PERCENT, axis=1)
    found, first = {}, 0
    for manoeuvre in scenario.manoeuvres:
        rows = slice(first, first + -(-round(manoeuvre.duration_s * profile.rate_hz) // every))
        first = rows.stop
        found[manoeuvre.name] = Spread(
            traces.t_s[rows] - traces.t_s[rows.start],
            {slug: low[number, rows] for number, slug in enumerate(sets)},
            {slug: high[number, rows] for number, slug in enumerate(sets)},
        )
    return found
