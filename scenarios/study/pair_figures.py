"""Figures of chapter 7: step, tracking and control effort of all pairs, and how their metrics are distributed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from scenarios.study.figure_style import COLOURS, LIMIT, extremes, finished, legend, panels, stretched
from scenarios.study.printed import AIRFRAMES, printed
from scenarios.study.result import Figure, FloatArray, Pair

_BINS = 160
_STEP_SHOWN_S = 1.5
_DISTRIBUTIONS = (
    ("settling_time_5pct_s", "settling time (5 %), s"),
    ("overshoot_pct", "overshoot, %"),
    ("vaf_pct", "VAF, %"),
    ("peak_delta_lat", "peak delta_lat"),
)


def draw(pairs: Sequence[Pair]) -> Iterator[Figure]:
    """All of them, kind by kind of pair (source and profile).

    Args:
        pairs: as many as there are.
    """
    kinds = dict.fromkeys(("tuned" if p.source.startswith("tuned") else "printed", p.profile) for p in pairs)
    for kind, profile in kinds:
        mine = [p for p in pairs if p.profile == profile and p.source.startswith("tuned") == (kind == "tuned")]
        for target in AIRFRAMES:
            some = [p for p in mine if p.target == target]
            if some:
                yield _responses(target, some, kind, profile)
        yield _distributions(mine, kind, profile)


def _responses(target: str, pairs: Sequence[Pair], kind: str, profile: str) -> Figure:
    canvas, axes = panels(4, len(pairs), 11.0, 8.6, sharex="row", sharey="row")
    for column, pair in enumerate(pairs):
        colour = COLOURS[pair.based_on]
        step = slice(0, int(np.searchsorted(pair.step_t_s, _STEP_SHOWN_S)))
        t, whole = pair.step_t_s[step], pair.track_t_s
        for row, (times, values, wanted, factor) in enumerate((
            (t, pair.step_phi_rad[:, step], pair.step_sp_rad[step], 57.29577951308232),
            (t, pair.step_delta_lat[:, step], None, 1.0),
            (whole, pair.track_phi_rad, pair.track_sp_rad, 57.29577951308232),
            (whole, pair.track_delta_lat, None, 1.0),
        )):  # fmt: skip
            _envelope(axes[row, column], times, values * factor, colour)
            if wanted is not None:
                shown = extremes(wanted * factor, _BINS)
                axes[row, column].plot(stretched(times, _BINS), shown, **LIMIT, label="set-point")
        axes[0, column].set_title(f"gains on {pair.based_on}" + (" (itself)" if pair.based_on == target else ""))
        axes[1, column].set_xlabel("time from the step, s")
        axes[3, column].set_xlabel("time, s")
    for row, label in enumerate(("phi, deg", "delta_lat", "phi, deg", "delta_lat")):
        axes[row, 0].set_ylabel(label)
    legend(canvas, axes[0, 0], 3)
    samples = len(pairs[0].metrics["vaf_pct"])
    caption = (
        f"Roll step of 10 degrees and tracking input on {samples} samples of the identified model of {target}, {kind} "
        f"gains, profile {profile}: line nominal, band lowest to highest. The tracking input is ours: the study's "
        "figure 7.2 is not available."
    )
    title = f"{target} with {kind} gains, profile {profile}"
    return finished(canvas, f"fig_7_{kind}_{profile}_{target.lower()}", title, caption, "7")


def _envelope(plot: object, t: FloatArray, values: FloatArray, colour: str) -> None:
    nominal, low, _, high = (extremes(one, _BINS) for one in values)
    times = stretched(t, _BINS)
    plot.fill_between(times, low, high, color=colour, alpha=0.3, lw=0, label="all samples")  # type: ignore[attr-defined]
    plot.plot(times, nominal, color=colour, label="nominal")  # type: ignore[attr-defined]


def _distributions(pairs: Sequence[Pair], kind: str, profile: str) -> Figure:
    canvas, axes = panels(2, 2, 11.0, 7.0, sharex=True)
    places = np.arange(len(pairs))
    for plot, (metric, label) in zip(axes.ravel(), _DISTRIBUTIONS, strict=True):
        for place, pair in zip(places, pairs, strict=True):
            values = pair.metrics[metric]
            known = values[~np.isnan(values)]
            colour = COLOURS[pair.based_on]
            if len(known):
                low, quarter, middle, three, high = np.percentile(known, [0, 25, 50, 75, 100])
                plot.plot([place, place], [low, high], color=colour, linewidth=1.2)
                plot.plot([place, place], [quarter, three], color=colour, linewidth=6.0, solid_capstyle="butt")
                plot.plot([place, place], [low, high], "_", color=colour, markersize=9)
                plot.plot([place], [middle], "o", color=colour, markersize=4.5)
            if len(known) < len(values):
                share = 100.0 * (1.0 - len(known) / len(values))
                plot.annotate(
                    f"unset {share:.0f} %", (place, 0.98), xycoords=("data", "axes fraction"), rotation=90, ha="center",
                    va="top", fontsize=6.5,
                )  # fmt: skip
        plot.set_ylabel(label)
        for edge in range(1, len(AIRFRAMES)):
            plot.axvline(edge * len(pairs) / len(AIRFRAMES) - 0.5, color="#cccccc", linewidth=0.8)
    required = printed()["requirements"]
    axes[0, 0].axhline(float(required["settling_time_max_s"]), **LIMIT)
    axes[0, 1].axhline(float(required["overshoot_max_pct"]), **LIMIT)
    for plot in axes[1]:
        plot.set_xticks(places, [f"{p.target} < {p.based_on}" for p in pairs], rotation=90, fontsize=7.0)
    for name in AIRFRAMES:
        axes[0, 0].plot([], [], color=COLOURS[name], linewidth=5.0, label=f"gains on {name}")
    legend(canvas, axes[0, 0], 4)
    caption = (
        f"Metrics of all pairs, target < reference, over the samples of the target's identified model, {kind} gains, "
        f"profile {profile}: dot the median, bar the middle half, line the range, dashed what the study requires. "
        "Unset: the sample never settles or shakes in a limit cycle."
    )
    title = f"All pairs: {kind} gains, profile {profile}"
    return finished(canvas, f"fig_7_{kind}_{profile}_distributions", title, caption, "7")
