"""`froude analyse` for people and for machines."""

from __future__ import annotations

import dataclasses
from typing import Any

from scenarios.analysis import SHOWN_MARGINS, Analysis, SetAnalysis
from scenarios.limits import LIMIT_SETS, METRICS
from scenarios.run_folder import plain
from scenarios.table import number

SCHEMA_VERSION = 1

# name: (decimals, factor to the unit shown, unit shown)
_SHOWN = {
    "overshoot_pct": (2, 1.0, "%"),
    "rise_time_s": (3, 1.0, "s"),
    "settling_time_5pct_s": (3, 1.0, "s"),
    "droop_deg": (2, 1.0, "deg"),
    "peak_delta_lat": (2, 1.0, ""),
    "oscillation_rad_s": (3, 1.0, "rad/s"),
    "vaf_pct": (1, 1.0, "%"),
    "vaf_lag_removed_pct": (1, 1.0, "%"),
    "lag_s": (1, 1e3, "ms"),
    "gain_margin_low_db": (1, 1.0, "dB"),
    "gain_margin_high_db": (1, 1.0, "dB"),
    "phase_margin_deg": (1, 1.0, "deg"),
    "delay_margin_s": (1, 1e3, "ms"),
    "modulus_margin": (3, 1.0, ""),
}
assert set(_SHOWN) <= set(METRICS)


def analysis_text(analysis: Analysis) -> str:
    """One block per gain set: verdict, table, what matters most.

    Args:
        analysis: all of it.
    """
    limits = ", ".join(f"{one.metric} {one}" for one in LIMIT_SETS[analysis.limits]) or "none"
    drawn = f"{analysis.samples} samples ({analysis.distribution}, within {analysis.spread_sigma:g} sigma, seed "
    lines = [
        f"{analysis.model.name}, profile {analysis.profile.name}: the nominal model"
        + (f" and {drawn}{analysis.seed})" if analysis.samples else "; it states no uncertainty, nothing to vary"),
        f"limits: {limits}",
    ]
    for one in analysis.sets:
        lines += ["", *_set(one)]
    return "\n".join(lines)


def _set(one: SetAnalysis) -> list[str]:
    low, high = one.interval
    troubles = [
        f"{count} {what}"
        for count, what in ((one.unstable, "unstable"), (one.cycling, "in a limit cycle"), (one.diverged, "lost"))
        if count
    ]
    lines = [
        f"{one.gain_set.name}: passes {one.passes} of {one.of} ({100 * one.passes / one.of:.1f} %, 95 % interval "
        f"{100 * low:.1f} to {100 * high:.1f} %), the nominal model {'passes' if one.nominal_passes else 'fails'}"
        + ("; " + ", ".join(troubles) if troubles else ""),
        f"  {'':<22}{'unit':<6}{'nominal':>9}{'worst':>9}{'median':>9}{'best':>9}{'unset':>7}   matters most",
    ]
    explained = {s.metric: s for s in one.sensitivities}
    for name, (decimals, factor, unit) in _SHOWN.items():
        spread = one.spreads.get(name)
        if spread is None:
            continue
        if name == SHOWN_MARGINS[0]:
            lines.append("")
        cells = (spread.nominal, spread.worst, spread.median, spread.best)
        shown = "".join(number(None if c is None else c * factor, decimals).rjust(9) for c in cells)
        why = ""
        sensitivity = explained.get(name)
        if sensitivity is not None and sensitivity.dominant:
            best = sensitivity.dominant
            why = (
                f"   {best} ({100 * sensitivity.shares[best]:.0f} %, "
                f"{sensitivity.per_sigma[best] * factor:+.2g} {unit} per sigma)"
            )
        label = name.rsplit("_", 1)[0] if name.endswith(("_pct", "_deg", "_db", "_s")) else name
        lines.append(f"  {label:<22}{unit:<6}{shown}{spread.unset:>7}{why}")
    return lines


def analysis_object(analysis: Analysis) -> dict[str, Any]:
    """The same as plain data.

    Args:
        analysis: all of it.
    """
    shown = {
        "schema_version": SCHEMA_VERSION,
        "vehicle": analysis.model.spec,
        "scaling": sorted(analysis.model.scaling),
        "profile": analysis.profile.name,
        "limits": {one.metric: str(one) for one in LIMIT_SETS[analysis.limits]},
        "samples": analysis.samples,
        "seed": analysis.seed,
        "distribution": analysis.distribution,
        "spread_sigma": analysis.spread_sigma,
        "gain_sets": [
            {
                "name": one.gain_set.name,
                "parameters": dict(one.gain_set.parameters),
                "nominal_passes": one.nominal_passes,
                "passes": one.passes,
                "of": one.of,
                "pass_fraction": one.passes / one.of,
                "interval_95": one.interval,
                "unstable": one.unstable,
                "limit_cycle": one.cycling,
                "diverged": one.diverged,
                "metrics": {
                    name: dataclasses.asdict(value) | {"unit": METRICS[name][0]} for name, value in one.spreads.items()
                },
                "sensitivity": {
                    s.metric: {"share": dict(s.shares), "per_sigma": dict(s.per_sigma)} for s in one.sensitivities
                },
            }
            for one in analysis.sets
        ],
    }
    made: dict[str, Any] = plain(shown)
    return made
