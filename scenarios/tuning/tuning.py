"""`tune`: from vehicles and requirements to gains with their certificate, and a trade-off where they cannot be had."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scenarios.tuning.certificate import Certificate, certify, worst_rows
from scenarios.tuning.requirements import Requirements, requirements_for
from scenarios.tuning.synthesis import Checked, Synthesis, Vehicle, prepare, synthesise
from sitl.profile import Profile
from sitl.sampled_loop import RollGains
from sitl.uncertainty import Distribution
from sitl.vehicle_spec import VehicleModel


@dataclass(frozen=True)
class Found:
    """What one gain set does on all samples of one vehicle.

    Attributes:
        vehicle: its name. samples: how many, the nominal among them. sure: the file states an uncertainty.
        cannot_hold: samples that no gains can make hold a roll angle (`holds_an_angle`); all that follows but `meets`
            is of the others.
        settling_s, overshoot_pct: worst and median over the samples; inf where one never settles or cycles.
        never_settle: samples that do not settle while the step is held, cycle or diverge.
        delay_margin_s, phase_margin_deg, gain_margin_high_db, gain_margin_low_db: least over the samples (the low
            one: nearest to 0 dB); -inf if one is unstable. stable: every one of them is.
        meets: share of all samples that meet every requirement.
    """

    vehicle: str
    samples: int
    sure: bool
    settling_s: tuple[float, float]
    overshoot_pct: tuple[float, float]
    never_settle: int
    delay_margin_s: float
    phase_margin_deg: float
    gain_margin_high_db: float
    gain_margin_low_db: float
    stable: bool
    meets: float
    cannot_hold: int


@dataclass(frozen=True)
class TradeOff:
    """One point of the trade-off between settling and delay margin.

    Attributes:
        asked_delay_margin_s: bound of the search. gains: found with it.
        settling_s: worst over all samples of all vehicles that can hold an angle. overshoot_pct, delay_margin_s: alike.
    """

    asked_delay_margin_s: float
    gains: RollGains
    settling_s: float
    overshoot_pct: float
    delay_margin_s: float


@dataclass(frozen=True)
class Tuning:
    """Tuned gains and all that is known of them.

    Attributes:
        vehicles: names, in the order asked for. scaling: words applied to scaled specs.
        profile: fidelity. requirements: asked for. seed, samples, distribution: of the draw and the search.
        synthesis: what the search found. certificates: of each vehicle. found: of each vehicle.
        unmet: what no gains were found to meet, with the distance; empty if all was met.
        trade_off: if something was not met: what can be had instead. limits: what stands in the way.
    """

    vehicles: tuple[str, ...]
    scaling: tuple[str, ...]
    profile: Profile
    requirements: Requirements
    seed: int
    samples: int
    distribution: str
    synthesis: Synthesis
    certificates: tuple[Certificate, ...]
    found: tuple[Found, ...]
    unmet: tuple[str, ...]
    trade_off: tuple[TradeOff, ...] = ()
    limits: str = ""

    @property
    def gains(self) -> RollGains:
        """Of the roll axis."""
        return self.synthesis.gains

    @property
    def met(self) -> bool:
        """Every sample of every vehicle meets every requirement."""
        return not self.unmet


def tune(
    models: Sequence[VehicleModel],
    profile: Profile,
    *,
    requirements: Requirements | None = None,
    samples: int = 500,
    seed: int = 1,
    distribution: Distribution = "gaussian",
    certified: bool = True,
    progress: Callable[[str], object] = lambda _: None,
) -> Tuning:
    """One gain set for all the vehicles given; the same for the same seed.

    Args:
        models: at least one. profile: fidelity. requirements: those of the profile if None.
        samples, seed, distribution: of the draw; a vehicle without stated uncertainty has its nominal model only.
        certified: work out the norms without a grid and, if something is not met, the trade-off.
        progress: called with a short text.

    Raises:
        UsageError: no vehicle, or numbers that cannot be used.
    """
    required = requirements or requirements_for(profile.name)
    vehicles = prepare(models, profile, required, samples, seed, distribution)
    synthesis = synthesise(vehicles, profile, required, seed=seed, progress=progress)
    found = tuple(_found(vehicle, one, required) for vehicle, one in zip(vehicles, synthesis.checked, strict=True))
    unmet = tuple(text for one in found for text in _unmet(one, required))
    certificates: tuple[Certificate, ...] = ()
    trade_off: tuple[TradeOff, ...] = ()
    limits = ""
    if certified:
        progress("certificate")
        gains, weights = synthesis.gains, synthesis.weights
        certificates = tuple(
            certify(synthesis, vehicle, profile, worst_rows(vehicle, profile, gains, weights)) for vehicle in vehicles
        )
    if certified and any(len(_unmet(replace(one, cannot_hold=0), required)) for one in found):
        trade_off = _trade_off(vehicles, profile, required, synthesis, seed, progress)
        limits = _limits(vehicles, profile)
    return Tuning(
        vehicles=tuple(model.name for model in models),
        scaling=tuple(sorted(set().union(*(model.scaling for model in models)))),
        profile=profile,
        requirements=required,
        seed=seed,
        samples=samples,
        distribution=distribution,
        synthesis=synthesis,
        certificates=certificates,
        found=found,
        unmet=unmet,
        trade_off=trade_off,
        limits=limits,
    )


def _found(vehicle: Vehicle, checked: Checked, required: Requirements) -> Found:
    margins, trial = checked.margins, checked.trial
    holds = vehicle.holds
    stable = margins.closed_loop_stable[0, holds]
    settling, overshoot = trial.settling_s[0, holds], trial.overshoot_pct[0, holds]
    delay = margins.delay_margin_s[0, holds]
    meets = (
        stable
        & (settling <= required.settling_time_s)
        & (overshoot <= required.overshoot_pct)
        & (delay >= required.delay_margin_s)
    )
    return Found(
        vehicle=vehicle.model.name,
        samples=len(holds),
        sure=vehicle.model.airframe.has_sigma or len(holds) > 1,
        settling_s=(float(settling.max()), float(np.median(settling))),
        overshoot_pct=(float(overshoot.max()), float(np.median(overshoot))),
        never_settle=int(np.count_nonzero(np.isinf(settling))),
        delay_margin_s=_least(delay),
        phase_margin_deg=_least(margins.phase_margin_deg[0, holds]),
        gain_margin_high_db=_least(margins.gain_margin_high_db[0, holds]),
        gain_margin_low_db=_largest(margins.gain_margin_low_db[0, holds]),
        stable=bool(stable.all()),
        meets=float(np.count_nonzero(meets) / len(holds)),
        cannot_hold=int(np.count_nonzero(~holds)),
    )


def _least(values: np.ndarray) -> float:
    """NaN (no such margin of an unstable loop) is worse than any number."""
    return -math.inf if np.isnan(values).any() else float(values.min())


def _largest(values: np.ndarray) -> float:
    """NaN: no gain is too low."""
    known = values[~np.isnan(values)]
    return float(known.max()) if len(known) else -math.inf


def _unmet(found: Found, required: Requirements) -> list[str]:
    said = []
    if found.cannot_hold:
        said.append(
            f"{found.vehicle}: {found.cannot_hold} of {found.samples} models cannot hold a roll angle with any gains "
            "(Lv Yd < Ld Yv)"
        )
    if not found.stable:
        said.append(f"{found.vehicle}: unstable on some samples")
    models = found.samples - found.cannot_hold
    for what, value, bound, unit in (
        ("settling time", found.settling_s[0], required.settling_time_s, "s"),
        ("overshoot", found.overshoot_pct[0], required.overshoot_pct, "%"),
    ):
        if value > bound:
            never = f"not seen to end on {found.never_settle} of {models} models"
            shown = never if math.isinf(value) else f"{value:.3g} {unit}"
            said.append(f"{found.vehicle}: {what} {shown}, required {bound:g} {unit}")
    if found.stable and found.delay_margin_s < required.delay_margin_s:
        said.append(
            f"{found.vehicle}: delay margin {1e3 * found.delay_margin_s:.1f} ms, "
            f"required {1e3 * required.delay_margin_s:g} ms"
        )
    return said


def _trade_off(
    vehicles: Sequence[Vehicle],
    profile: Profile,
    required: Requirements,
    made: Synthesis,
    seed: int,
    progress: Callable[[str], object],
) -> tuple[TradeOff, ...]:
    """What is found for a falling delay margin, points left out that another one is as good as in both."""
    points = [_point(vehicles, required.delay_margin_s, made)]
    # a margin far beyond what can be had would only be asked for in vain, again and again
    asked = max(min(required.delay_margin_s, points[0].delay_margin_s), 0.010)
    for share in (1.5, 1.0, 0.75, 0.5, 0.25, 0.0):
        progress(f"trade-off: delay margin {1e3 * asked * share:.0f} ms")
        loose = replace(required, delay_margin_s=asked * share)
        found = synthesise(vehicles, profile, loose, seed=seed, starts=1, push=1.0, firm=True, near=points[-1].gains)
        points.append(_point(vehicles, asked * share, found))
    kept: list[TradeOff] = []
    for point in sorted(points, key=lambda one: (-one.delay_margin_s, one.settling_s, one.overshoot_pct)):
        if not kept or point.settling_s < kept[-1].settling_s:
            kept.append(point)
    return tuple(kept)


def _point(vehicles: Sequence[Vehicle], asked_s: float, one: Synthesis) -> TradeOff:
    """The worst over all samples that can hold an angle."""
    each = list(zip(vehicles, one.checked, strict=True))
    return TradeOff(
        asked_delay_margin_s=asked_s,
        gains=one.gains,
        settling_s=max(float(c.trial.settling_s[0, v.holds].max()) for v, c in each),
        overshoot_pct=max(float(c.trial.overshoot_pct[0, v.holds].max()) for v, c in each),
        delay_margin_s=min(_least(c.margins.delay_margin_s[0, v.holds]) for v, c in each),
    )


def _limits(vehicles: Sequence[Vehicle], profile: Profile) -> str:
    """What stands in the way, in numbers."""
    torque = [float(vehicle.derivatives[0, 5]) for vehicle in vehicles]
    from sitl.sampled_loop import SampledLoop

    loops = [
        SampledLoop(vehicle.derivatives[:1], RollGains(1.0, 1.0, 0.0, 0.0, 0.0), profile, vehicle.lag_s)
        for vehicle in vehicles
    ]
    delay = ", ".join(
        f"{vehicle.model.name} {1e3 * loop.delay_s:.0f} ms" for vehicle, loop in zip(vehicles, loops, strict=True)
    )
    said = f"The loop's own delay (motor lag, filters, ticks) is {delay}."
    if len(vehicles) > 1:
        said += (
            f" One K_P must serve roll torques Ld from {min(torque):.0f} to {max(torque):.0f} rad/s^2, a factor of "
            f"{max(torque) / min(torque):.1f}: the rate loop's bandwidth K_P Ld differs by that much."
        )
    return said
