"""Chapter 7 done again: gains tuned on the scaled model, flown over MAVLink on the true one, for all 16 pairs.

Every flight uploads its gains, reads them back, flies a step and the tracking input against the simulated autopilot,
and is scored by the same metrics as any other flight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

from scenarios import interrupts
from scenarios.gain_set import GainSet
from scenarios.study.printed import AIRFRAMES
from scenarios.study.result import Row, Table
from sitl.sampled_loop import RollGains

PROFILES = ("study", "sitl")
SCALING = ("uncertainty", "gain")
"""What chapter 7 scales: the nominal derivatives are kept."""

_COLUMNS = (
    ("settling_time_5pct_s", "settles s", "s"),
    ("overshoot_pct", "overshoot %", "%"),
    ("vaf_pct", "VAF %", "%"),
    ("peak_delta_lat", "peak delta", "1"),
    ("oscillation_rad_s", "shakes rad/s", "rad/s"),
    ("delay_margin_s", "delay margin s", "s"),
)


def tune_pairs(
    profile: str, samples: int, seed: int, progress: Callable[[str], object] = lambda _: None
) -> dict[tuple[str, str], RollGains]:
    """Gains by (target, reference), each tuned on the reference's model scaled to the target.

    Args:
        profile: they are made for. samples, seed: of each design. progress: called with a short text.
    """
    pairs = [(target, reference) for target in AIRFRAMES for reference in AIRFRAMES]
    made = {}
    # two processes: one search is one thread most of the time
    with ProcessPoolExecutor(2, get_context("spawn"), interrupts.end_with_parent) as pool:
        jobs = [pool.submit(tune_pair, target, reference, profile, samples, seed) for target, reference in pairs]
        for pair, job in zip(pairs, jobs, strict=True):
            made[pair] = job.result()
            progress(f"tuned {pair[0]} on {pair[1]}, profile {profile}")
    return made


def tune_pair(target: str, reference: str, profile: str, samples: int, seed: int) -> RollGains:
    """One design; see `tune_pairs`."""
    from scenarios.tuning.tuning import tune
    from sitl.profile import get_profile
    from sitl.vehicle_spec import resolve_vehicle

    spec = target if reference == target else f"{reference}:{target}"
    model = resolve_vehicle(spec, SCALING)
    return tune([model], get_profile(profile), samples=samples, seed=seed, certified=False).gains


def fly_pairs_live(
    gains: Mapping[tuple[str, str], RollGains],
    profile: str,
    seed: int,
    progress: Callable[[str], object] = lambda _: None,
) -> Table:
    """Every pair flown over MAVLink on the target's identified model.

    Args:
        gains: by (target, reference). profile: fidelity. seed: of sensor noise. progress: called with a short text.

    Returns:
        a table of ours: one item per pair, gains and what the flight measured.
    """
    rows: list[Row] = []
    with ProcessPoolExecutor(2, get_context("spawn"), interrupts.end_with_parent) as pool:
        jobs = {pair: pool.submit(fly_live, *pair, one, profile, seed) for pair, one in gains.items()}
        for (target, reference), job in jobs.items():
            item = f"{target} < {reference}"
            g = gains[target, reference]
            for name, value in (("K_phi", g.k_phi), ("K_P", g.kp), ("K_I", g.ki), ("K_D", g.kd)):
                rows.append(Row(item, name, "", None, value))
            measured = job.result()
            rows += [Row(item, title, unit, None, measured[name]) for name, title, unit in _COLUMNS]
            progress(f"flown {item}, profile {profile}")
    return Table(
        f"Cross-validation, {profile}",
        f"gains tuned on the scaled model, flown over MAVLink on the true one, profile {profile}",
        tuple(rows),
        "Target < reference; the study's own gains stand in tables 7.1 to 7.3, and what they do among the pairs of "
        "chapter 7. Nothing in a cell: not measurable, as in a limit cycle, or never settles. The peak is that of the "
        "telemetry, which can miss a spike of one tick in profile study.",
    )


def fly_live(target: str, reference: str, gains: RollGains, profile: str, seed: int) -> dict[str, float | None]:
    """One flight: metric -> value, None if it could not be measured."""
    from scenarios.one_flight import fly
    from scenarios.runner import plan
    from scenarios.scenario import load_scenario
    from scenarios.tuning.tuned_set import parameters_of

    scenario = replace(load_scenario("demo"), vehicle=target, scaling=(), profile=profile, seed=seed)
    if profile == "study":
        # without filters ANT-R's own pitch gains are unstable (K_D Ld > 1): there pitch flies what roll flies
        scenario = replace(scenario, axes="both")
    gain_set = GainSet(f"tuned {target} on {reference}", parameters_of(gains))
    job = plan(gain_set, scenario, scenario.resolve_vehicle(), scenario.resolve_profile())
    record = fly(job)
    found = {name: record.metric(name) for name, _, _ in _COLUMNS}
    return {name: None if metric is None else metric.value for name, metric in found.items()}
