"""The study's conclusions, each judged by our numbers: confirmed, refuted or undecided.

Those of chapters 3 to 6 and 8 are judged on the models, those of chapter 7 on the pairs that were flown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from scenarios.study.own_statements import judged, own_statements
from scenarios.study.printed import AIRFRAMES, printed
from scenarios.study.result import Conclusion, FloatArray, Pair, Verdict
from sitl.airframe import Derivatives, load_airframe
from sitl.froude import froude_number, scale_derivatives, scale_gain, scale_sigma
from sitl.lateral import LateralModel

BAND_RAD_S = (1.0, 50.0)
"""The study's band of interest."""

PREDICTS_DB = 3.0
"""A model whose magnitude is wrong by more than this in the band does not predict: a factor of 1.4."""

NEAR_EIGENVALUES = 0.25
"""Eigenvalues of two airframes are near-equal when none lies further apart than this share of its magnitude."""

HIGH_VAF_PCT = 80.0
"""What we take "high VAF" for: the plain VAF of a loop of 10 rad/s on our tracking input is about 90 %, mostly lag."""

GOOD_PHASE_DEG = 45.0
"""What we take a "good" phase margin for."""

# The statement of overshoot is met by ours if it is within this share of the one printed.
_NEAR_OVERSHOOT = 0.5


def conclusions(pairs: Sequence[Pair]) -> tuple[Conclusion, ...]:
    """Every conclusion of the study.

    Args:
        pairs: chapter 7 with the printed gains; those of profile `study` are judged. Without any, chapter 7 is
            undecided.
    """
    own = [pair for pair in pairs if pair.profile == "study" and pair.source.startswith("table")]
    return (
        _modes(),
        _rays(),
        _predicts(),
        _same_size(),
        _uncertainty(),
        _gain(),
        *_chapter_7(own),
        *_groups(),
        _authority(),
        *own_statements(pairs),
    )


def magnitude_db(derivatives: Derivatives, omega: FloatArray) -> FloatArray:
    """20 log10 |p / delta_lat| at frequencies in rad/s (equation 2.3).

    Args:
        derivatives: the model. omega: (F,).
    """
    d = derivatives
    s = 1j * omega
    den = np.polyval(LateralModel.from_derivatives(d).denominator(), s)
    return np.asarray(20.0 * np.log10(np.abs(s * (d.Ld * s - d.Ld * d.Yv + d.Lv * d.Yd) / den)))


def band() -> FloatArray:
    """(F,) rad/s over the study's band of interest."""
    return np.geomspace(*BAND_RAD_S, 200)


def eigenvalues(derivatives: Derivatives) -> np.ndarray:
    """(3,) 1/s, by real part, the conjugate pair in a fixed order."""
    values = np.linalg.eigvals(LateralModel.from_derivatives(derivatives).A)
    return np.array(sorted(values, key=lambda value: (round(value.real, 9), value.imag)))


def _models() -> dict[str, Derivatives]:
    return {name: load_airframe(name).derivatives for name in AIRFRAMES}


def _modes() -> Conclusion:
    shapes = []
    for name, d in _models().items():
        values = eigenvalues(d)
        stable_real = sum(1 for v in values if abs(v.imag) < 1e-9 and v.real < 0)
        unstable_pair = sum(1 for v in values if v.imag > 1e-9 and v.real > 0)
        shapes.append((name, stable_real == 1 and unstable_pair == 1))
    return Conclusion(
        "3",
        "Every airframe has one stable real mode and one unstable oscillation.",
        judged(all(ok for _, ok in shapes)),
        f"{sum(ok for _, ok in shapes)} of {len(shapes)} by the eigenvalues of table 2.1.",
    )


def _rays() -> Conclusion:
    worst, crossed = 0.0, 0
    for d in _models().values():
        values = eigenvalues(d)
        for N in np.geomspace(0.25, 4.0, 33):
            scaled = eigenvalues(scale_derivatives(d, float(N)))
            worst = max(worst, float(np.abs(scaled - values * math.sqrt(N)).max() / np.abs(values).max()))
            crossed += int((np.sign(scaled.real) != np.sign(values.real)).any())
    return Conclusion(
        "4",
        "Scaled eigenvalues move along rays by sqrt(N) and never cross the imaginary axis.",
        judged(worst < 1e-6 and crossed == 0),
        f"N from 0.25 to 4: largest relative deviation {worst:.1e}, {crossed} crossings.",
    )


def _predicts() -> Conclusion:
    omega, frames = band(), {name: load_airframe(name) for name in AIRFRAMES}
    errors = {}
    for target, body in frames.items():
        true = magnitude_db(body.derivatives, omega)
        for reference, other in frames.items():
            if reference != target:
                scaled = scale_derivatives(other.derivatives, froude_number(other, body))
                errors[f"{reference}:{target}"] = float(np.abs(magnitude_db(scaled, omega) - true).max())
    good = [name for name, error in errors.items() if error <= PREDICTS_DB]
    worst = max(errors, key=lambda name: errors[name])
    best = min(errors, key=lambda name: errors[name])
    return Conclusion(
        "5",
        "Froude scaling does not predict these airframes from one another.",
        judged(len(good) <= len(errors) // 4),
        f"|p/delta| is within {PREDICTS_DB:g} dB of the truth from 1 to 50 rad/s for {len(good)} of {len(errors)} pairs"
        f"{' (' + ', '.join(good) + ')' if good else ''}; best {best} {errors[best]:.1f} dB, worst {worst} "
        f"{errors[worst]:.1f} dB.",
    )


def _same_size() -> Conclusion:
    adam, carrier = load_airframe("ADAM-0"), load_airframe("CARRIER-1")
    N = froude_number(adam, carrier)
    gap = np.abs(magnitude_db(adam.derivatives, band()) - magnitude_db(carrier.derivatives, band())).max()
    apart = np.abs(eigenvalues(adam.derivatives) - eigenvalues(carrier.derivatives)).max()
    return Conclusion(
        "5",
        "ADAM-0 and CARRIER-1 share a diagonal, so N = 1, and yet differ.",
        judged(N == 1.0 and apart > 0.1),
        f"N = {N:g}; eigenvalues up to {apart:.2f} 1/s apart, |p/delta| up to {gap:.1f} dB.",
    )


def _uncertainty() -> Conclusion:
    frames = {name: load_airframe(name) for name in AIRFRAMES}
    grown = {"table": 0, "grow": 0}
    count = 0
    for target in frames.values():
        for reference in frames.values():
            N = froude_number(reference, target)
            if N == 1.0:
                continue
            count += 6
            for mode in ("table", "grow"):
                scaled = scale_sigma(reference.sigma_pct, N, mode)
                grown[mode] += int((scaled.as_array() > reference.sigma_pct.as_array()).sum())
    return Conclusion(
        "6",
        "The uncertainty grows when a model is scaled, as expected.",
        Verdict.UNDECIDED,
        "How sigma is scaled is not printed. With the factor of table 4.1 it grows for "
        f"{grown['table']} of {count} derivatives and shrinks or stays for the others; with the factor or its inverse, "
        f"whichever is larger, for {grown['grow']}. It holds by definition or not at all.",
    )


def _gain() -> Conclusion:
    worst, gap = 0.0, 0.0
    for name in AIRFRAMES:
        d = load_airframe(name).derivatives
        for N in (0.2909, 0.6154, 1.625, 3.4375):
            scaled = scale_gain(d, N)
            worst = max(worst, float(np.abs(eigenvalues(scaled) - eigenvalues(d)).max()))
            shift = magnitude_db(scaled, band()) - magnitude_db(d, band()) - 10.0 * math.log10(N)
            gap = max(gap, float(np.abs(shift).max()))
    return Conclusion(
        "6.6",
        "Multiplying the model's gain by sqrt(N) leaves the eigenvalues where they are.",
        judged(worst < 1e-9 and gap < 1e-9),
        f"Eigenvalues move by at most {worst:.0e}, magnitudes by 10 log10 N to within {gap:.0e} dB.",
    )


def _chapter_7(pairs: Sequence[Pair]) -> list[Conclusion]:
    if not pairs:
        return [Conclusion("7", "All of chapter 7.", Verdict.UNDECIDED, "No pairs were flown.")]
    limit = float(printed()["requirements"]["settling_time_max_s"])

    def of(names: Callable[[Pair], FloatArray]) -> list[tuple[Pair, FloatArray]]:
        return [(pair, names(pair)) for pair in pairs]

    def told(values: list[tuple[Pair, FloatArray]], good: Callable[[FloatArray], Any]) -> tuple[int, int, str]:
        shares = {f"{p.target} on {p.based_on}": float(np.mean(good(v))) for p, v in values}
        bad = {name: share for name, share in shares.items() if share < 1.0}
        names = ", ".join(f"{name} {100 * share:.1f} %" for name, share in bad.items())
        return len(shares) - len(bad), len(shares), names

    samples = len(next(iter(pairs[0].metrics.values())))
    made = []
    settling = of(lambda p: p.metrics["settling_time_5pct_s"])
    for section, statement, values, good, unit in (
        ("7", f"Every controller settles within {limit:g} s.", settling, lambda v: v <= limit, "s, 5 % band, at most"),
        (
            "7",
            "Every controller tracks with a high VAF.",
            of(lambda p: p.metrics["vaf_pct"]),
            lambda v: v >= HIGH_VAF_PCT,
            f"%, at least (high: {HIGH_VAF_PCT:g}; our own tracking input)",
        ),
        (
            "7",
            "Every controller has a good phase margin.",
            of(lambda p: p.margins["phase_margin_deg"]),
            lambda v: v >= GOOD_PHASE_DEG,
            f"deg, at least (good: {GOOD_PHASE_DEG:g}; continuous loop)",
        ),
        (
            "7",
            "The gain margin is infinite for all samples.",
            of(lambda p: p.margins["gain_margin_high_db"]),
            np.isposinf,
            "dB, at least, upwards, continuous loop; downwards it never is",
        ),
    ):
        every = np.concatenate([v for _, v in values])
        known = every[~np.isnan(every)]
        edge = float(known.max() if "at most" in unit else known.min()) if len(known) else math.nan
        holds, count, exceptions = told(values, good)
        made.append(
            Conclusion(
                section,
                statement,
                judged(holds == count),
                f"{holds} of {count} pairs on all {samples} models{'; not ' + exceptions if exceptions else ''}. "
                f"Over all: {edge:.4g} {unit}." + (_at_the_limit(settling, limit) if values is settling else ""),
            )
        )
    made.append(_sampled_margin(pairs))
    made += [_overshoot(pairs, one) for one in printed()["reported"]["overshoot"]]
    return made


def _at_the_limit(settling: Sequence[tuple[Pair, FloatArray]], limit: float) -> str:
    """Pairs whose slowest sample is within a hundredth of the limit: another draw may have one beyond it."""
    close = [f"{p.target} on {p.based_on}" for p, v in settling if 0.99 * limit < np.nan_to_num(v).max() <= limit]
    return f" At the limit, so that another draw may be beyond it: {', '.join(close)}." if close else ""


def _sampled_margin(pairs: Sequence[Pair]) -> Conclusion:
    high = np.concatenate([p.margins["sampled_gain_margin_high_db"] for p in pairs])
    return Conclusion(
        "ours",
        "The infinite gain margin carries over to a loop that is sampled.",
        judged(bool(np.isposinf(high).all())),
        f"At 1 kHz, without filter, lag or delay, the upper gain margin is {np.nanmin(high):.1f} to "
        f"{np.nanmax(high):.1f} dB: sampling alone bounds it.",
    )


def _overshoot(pairs: Sequence[Pair], said: dict[str, object]) -> Conclusion:
    target, based_on = str(said["target"]), str(said["based_on"])
    pct = float(str(said.get("pct", said.get("pct_above"))))
    above = "pct_above" in said
    statement = f"{target} with gains based on {based_on} overshoots by {'more than ' if above else ''}{pct:g} %."
    mine = [p.metrics["overshoot_pct"] for p in pairs if (p.target, p.based_on) == (target, based_on)]
    if not mine or np.isnan(mine[0]).all():
        return Conclusion("7", statement, Verdict.UNDECIDED, "Not flown.")
    most, nominal = float(np.nanmax(mine[0])), float(mine[0][0])
    (trace,) = (p.step_phi_rad[0] for p in pairs if (p.target, p.based_on) == (target, based_on))
    beyond_end = 100.0 * (float(trace.max()) / float(trace[-1]) - 1.0)
    holds = most > pct if above else abs(most - pct) <= _NEAR_OVERSHOOT * pct
    return Conclusion(
        "7",
        statement,
        judged(holds),
        f"With the printed gains on the printed model: nominal {nominal:.2f} %, most of any sample {most:.2f} %, in a "
        f"hold of 5 s; of the angle at its end instead of the set-point, nominal {beyond_end:.2f} %.",
    )


def _groups() -> list[Conclusion]:
    made = []
    for one, other in (("ANT-R", "ADAM-0"), ("ANT-X", "CARRIER-1")):
        a, b = load_airframe(one).derivatives, load_airframe(other).derivatives
        x, y = eigenvalues(a), eigenvalues(b)
        apart = float((np.abs(x - y) / np.maximum(np.abs(x), np.abs(y))).max())
        ratio = magnitude_db(a, band()) - magnitude_db(b, band())
        made.append(
            Conclusion(
                "8",
                f"{one} and {other} form a group: near-equal eigenvalues, magnitudes apart.",
                judged(apart <= NEAR_EIGENVALUES and float(np.abs(ratio).min()) > PREDICTS_DB),
                f"Eigenvalues at most {100 * apart:.0f} % apart (near: {100 * NEAR_EIGENVALUES:.0f} %); |p/delta| of "
                f"{one} is {ratio.min():.1f} to {ratio.max():.1f} dB above that of {other} from 1 to 50 rad/s.",
            )
        )
    return made


def _authority() -> Conclusion:
    """Four equal rotors at one distance from the centre: arms of 1/sqrt(2) each against two arms of 1."""
    more = 100.0 * (4.0 / math.sqrt(2.0) / 2.0 - 1.0)
    return Conclusion(
        "8.2",
        "A cross has up to about 30 % more roll authority than a plus.",
        Verdict.UNDECIDED,
        "None of the airframes is a plus. By geometry alone, every motor at its limit, a cross of that diagonal has "
        f"{more:.0f} % more; what the air leaves of it no number here can say.",
    )
