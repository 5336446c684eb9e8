"""Chapter 7: gains made on a scaled model, flown on every sample of the true one, for all 16 pairs of airframes.

The study's tracking input (figure 7.2) is not available; ours is the `track` manoeuvre, and says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields

import numpy as np

from scenarios.manoeuvres import make_manoeuvre
from scenarios.monte_carlo import MonteCarlo, draw_samples, monte_carlo
from scenarios.study.printed import AIRFRAMES, printed
from scenarios.study.result import FloatArray, Pair
from sitl.continuous_loop import continuous_margins
from sitl.margin_batch import MarginArrays
from sitl.profile import Profile
from sitl.sampled_loop import RollGains
from sitl.vehicle_spec import resolve_vehicle

STEP = make_manoeuvre("step", amplitude_deg=10.0, hold_s=5.0, return_s=0.0)
TRACK = make_manoeuvre("track")

TRACE_HZ = 100
"""Points of a drawn response per second."""

Gains = Mapping[tuple[str, str], RollGains]


def printed_gains() -> dict[tuple[str, str], RollGains]:
    """Tables 7.1 to 7.3 by (target, reference); CARRIER-1 flies the table of ADAM-0, as in the study."""
    made = {}
    for target in AIRFRAMES:
        table = printed()["hinf_gains"]["ADAM-0" if target == "CARRIER-1" else target]
        for reference in AIRFRAMES:
            g = {name: float(value) for name, value in table[reference].items()}
            made[target, reference] = RollGains(g["K_phi"], 1.0, g["K_P"], g["K_I"], g["K_D"])
    return made


def table_of(target: str) -> str:
    """The table that holds a target's gains.

    Args:
        target: name of the airframe.
    """
    return {"ANT-R": "table 7.1", "ANT-X": "table 7.2"}.get(target, "table 7.3")


def fly_pairs(gains: Gains, profile: Profile, *, samples: int = 500, seed: int = 1, source: str = "") -> Iterator[Pair]:
    """All pairs of one profile, target by target.

    Args:
        gains: by (target, reference). profile: fidelity. samples: of each target's true model, beside the nominal.
        seed: of the draw. source: where the gains come from; the study's own table if empty.
    """
    for target in AIRFRAMES:
        model = resolve_vehicle(target)
        mine = {reference: one for (flown, reference), one in gains.items() if flown == target}
        if not mine:
            continue
        derivatives = draw_samples(model, samples, seed)
        every = max(1, profile.rate_hz // TRACE_HZ)
        flown = monte_carlo(
            model, mine, profile, [STEP, TRACK], derivatives=derivatives, trace_every=every, margins=True
        )
        # the study's own loop is continuous; where it is not, the sampled one is all there is
        continuous = None
        if profile.name == "study":
            continuous = continuous_margins(derivatives, list(mine.values()))
        for number, reference in enumerate(mine):
            yield _pair(target, reference, mine[reference], flown, number, continuous, profile, source)


def _pair(
    target: str,
    reference: str,
    gains: RollGains,
    flown: MonteCarlo,
    number: int,
    continuous: MarginArrays | None,
    profile: Profile,
    source: str,
) -> Pair:
    assert flown.traces is not None
    assert flown.margins is not None
    traces = flown.traces
    step = traces.t_s < STEP.duration_s - 1e-9
    sampled = {f"sampled_{f.name}": getattr(flown.margins, f.name)[number] for f in fields(MarginArrays)}
    shown = continuous or flown.margins
    margins = {f.name: getattr(shown, f.name)[number].astype(float) for f in fields(MarginArrays)}
    return Pair(
        target=target,
        based_on=reference,
        gains=gains,
        source=source or table_of(target),
        profile=profile.name,
        metrics={name: values[number] for name, values in flown.metrics.items()},
        margins=margins | {name: values.astype(float) for name, values in sampled.items()},
        step_t_s=traces.t_s[step],
        step_sp_rad=traces.phi_sp_rad[step],
        step_phi_rad=_spread(traces.phi_rad[number][:, step]),
        step_delta_lat=_spread(traces.delta_lat[number][:, step]),
        track_t_s=traces.t_s[~step] - STEP.duration_s,
        track_sp_rad=traces.phi_sp_rad[~step],
        track_phi_rad=_spread(traces.phi_rad[number][:, ~step]),
        track_delta_lat=_spread(traces.delta_lat[number][:, ~step]),
    )


def _spread(traces: FloatArray) -> FloatArray:
    """(4, T): nominal (the first sample), lowest, median and highest at each time."""
    return np.stack([traces[0], traces.min(axis=0), np.median(traces, axis=0), traces.max(axis=0)])
