"""The whole study from its inputs: tables, errata, pairs, conclusions, and with tuning chapter 7 done again."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version

from scenarios.study.beyond import beyond
from scenarios.study.conclusions import conclusions
from scenarios.study.errata import errata
from scenarios.study.pairs import fly_pairs, printed_gains
from scenarios.study.result import Study, Table
from scenarios.study.tables import tables
from sitl.profile import get_profile

PROFILES = ("study", "sitl")
"""The study's own loop, and one with filters, ticks and motor lag."""


def recompute(
    *, samples: int = 500, seed: int = 1, tune: bool = False, progress: Callable[[str], object] = lambda _: None
) -> Study:
    """Everything; the same for the same seed.

    Args:
        samples, seed: of every Monte Carlo. tune: repeat chapter 7's synthesis and fly it over MAVLink.
        progress: called with a short text.
    """
    pairs = []
    gains = printed_gains()
    for profile in PROFILES:
        progress(f"chapter 7 with the printed gains, profile {profile}")
        pairs += list(fly_pairs(gains, get_profile(profile), samples=samples, seed=seed))
    extra: list[Table] = []
    tuned = None
    if tune:
        from scenarios.study.cross_validation import fly_pairs_live, tune_pairs

        for profile in PROFILES:
            made = tune_pairs(profile, samples, seed, progress)
            tuned = tuned or made
            pairs += list(
                fly_pairs(made, get_profile(profile), samples=samples, seed=seed, source=f"tuned for {profile}")
            )
            extra.append(fly_pairs_live(made, profile, seed, progress))
    progress("beyond the study")
    more, said = beyond()
    found = tables(tuned)
    settings = {
        "command": f"froude study --samples {samples} --seed {seed}" + (" --tune" if tune else ""),
        "version": version("froude"),
        "samples": f"{samples} within 3 sigma, truncated Gaussian, independent, and the nominal model",
        "profiles": ", ".join(PROFILES),
        "step": "10 degrees, held for 5 s; settling to 5 % (the study does not print its band)",
        "tracking input": "ours: steps, ramps and a multisine up to 2 Hz (the study's figure 7.2 is not available)",
        "margins": "profile study: continuous loop as the study's, and sampled; others: sampled",
    }
    return Study(found, errata(found), (*conclusions(pairs), *said), tuple(pairs), (*extra, *more), settings)
