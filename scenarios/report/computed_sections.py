"""Sections of what is computed: the loop and its margins, sensitivity, delay, uncertain models."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from scenarios.analysis import sensitivity, spread, wilson
from scenarios.report.computed import SAMPLES, SEED, Computed, LoopCurves, SampleSet
from scenarios.report.elements import UNSET, Cell, Figure, Line, Section, Set, Sets, Table, heading, number_of
from scenarios.report.loop_figures import DelayBar, DrawnLoop, bode_figure, delay_figure, sensitivity_figure
from scenarios.report.sample_figures import Bounds, Entry, share_figure, spread_figure
from scenarios.report.verdict import title, value_text
from scenarios.table import number
from sitl.vehicle_spec import VehicleModel

Found = Mapping[int, Computed]
"""What was computed, by the gain set's number."""

MARGINS = ("gain_margin_low_db", "gain_margin_high_db", "phase_margin_deg", "delay_margin_s", "modulus_margin")
SPREAD = (
    "overshoot_pct",
    "rise_time_s",
    "settling_time_5pct_s",
    "vaf_pct",
    "phase_margin_deg",
    "delay_margin_s",
)
"""Metrics whose distribution is drawn, those that are limited first."""

SAME = 1e-6
"""Relative; margins further from those in run.json are another program's."""


def loop_section(sets: Sets, found: Found) -> Section:
    """Bode diagrams with margins, and the margins of run.json."""
    grid, notes = [], []
    for one in sets.all:
        computed = found[one.number]
        if computed.curves is None:
            notes.append(f"{one.name}: its loop cannot be shown: {computed.problem}")
            continue
        drawing = bode_figure(computed.curves, one.style, one.name, f"bode-{one.number}")
        grid.append(
            Figure(f"loop-{one.number}", one.name, drawing.svg, drawing.label, one.style, one.outcome, drawing.caption)
        )
        if not _same(one.data["margins"], computed.curves):
            notes.append(
                f"{one.name}: this version computes other margins than run.json holds; the figure shows this version's"
            )
    columns = [*(heading(name) for name in MARGINS), "crossover [Hz]", "phase crossover [Hz]", "stable"]
    rows = [Line(one.name, _margin_cells(one), one.style) for one in sets.all]
    lead = [
        "L, the loop cut at delta_lat as it flies: sampled, with every filter, delay and motor lag of the profile. "
        "Grey lines: 0 dB, and the phases at which L meets -1. Heavy bars: gain margins above, phase margin below. "
        "The airframe needs feedback, so there is a lower gain margin, too."
    ]
    table = Table("Margins, as in run.json", "gain set", columns, rows)
    return Section("loop", "The loop: Bode diagram and margins", lead, (), grid, [table], notes)


def _same(margins: Mapping[str, Any], curves: LoopCurves) -> bool:
    if not margins:
        return True
    for name, value in dataclasses.asdict(curves.margins).items():
        finite = value if not isinstance(value, float) or math.isfinite(value) else None
        there = margins.get(name)
        if isinstance(finite, bool) or finite is None or not isinstance(there, int | float):
            if finite != there:
                return False
        elif not math.isclose(finite, there, rel_tol=SAME, abs_tol=1e-12):
            return False
    return True


def _margin_cells(one: Set) -> list[Cell]:
    margins = one.data["margins"]
    stable = margins.get("closed_loop_stable")
    cells = []
    for name in MARGINS:
        value = number_of(margins.get(name))
        metric = one.flight.metric(name)
        text = value_text(name, value, unit=False)
        if value is None and metric is not None and metric["reason"].startswith("infinite"):
            text = "∞"
        if name == "modulus_margin" and not stable:
            text = UNSET  # of an unstable loop its distance from -1 means nothing
        cells.append(Cell(text, metric["outcome"] if metric is not None and metric["limit"] else ""))
    for name in ("crossover_rad_s", "phase_crossover_rad_s"):
        omega = number_of(margins.get(name))
        cells.append(Cell(number(None if omega is None else omega / (2.0 * math.pi), 2)))
    told = UNSET if stable is None else "yes" if stable else "NO"
    return [*cells, Cell(told, "" if stable is None else "PASS" if stable else "FAIL", words=True)]


def sensitivity_section(sets: Sets, found: Found) -> Section | None:
    """|S| of every stable loop with its peak; None if no loop is known."""
    loops = [(one, found[one.number].curves) for one in sets.all]
    drawn = [DrawnLoop(one.name, one.style, one.passed, curves) for one, curves in loops if curves is not None]
    if not drawn:
        return None
    figure = sensitivity_figure(drawn, "sensitivity")
    rows = []
    for one, curves in loops:
        if curves is None:
            rows.append(Line(one.name, [Cell(UNSET)] * 3, one.style))
            continue
        peak = curves.sensitivity
        k = int(np.argmax(peak))
        stable = curves.margins.closed_loop_stable
        cells = [
            Cell(number(20.0 * math.log10(1.0 / curves.margins.modulus_margin), 1) if stable else UNSET),
            Cell(number(float(curves.hz[k]), 2) if stable else UNSET),
            Cell(number(curves.margins.modulus_margin, 3) if stable else UNSET),
        ]
        rows.append(Line(one.name, cells, one.style))
    table = Table(
        "Sensitivity; an unstable loop has none",
        "gain set",
        ["peak of |S| [dB]", "at [Hz]", "modulus margin, 1 / peak"],
        rows,
    )
    lead = [
        "How much the loop amplifies (above 0 dB) or suppresses what disturbs it. A peak above 6 dB means that L comes "
        "closer to -1 than a half. Thick: passes."
    ]
    wide = [Figure("sensitivity", "Sensitivity of the stable loops", figure.svg, figure.label)]
    return Section("sensitivity-of-loop", "Sensitivity", lead, wide, (), [table])


def delay_section(sets: Sets, found: Found) -> Section:
    """Delay margins beside the loop's own delay."""
    bars, rows = [], []
    for one in sets.all:
        margins, metric = one.data["margins"], one.flight.metric("delay_margin_s")
        margin_s, own_s = number_of(margins.get("delay_margin_s")), number_of(margins.get("loop_delay_s"))
        if margin_s is None and metric is not None and metric["reason"].startswith("infinite"):
            margin_s = math.inf
        bars.append(DelayBar(one.name, one.style, margin_s, own_s))
        share = UNSET
        if margin_s is not None and own_s:
            share = number(100.0 * margin_s / own_s, 0)
        outcome = metric["outcome"] if metric is not None and metric["limit"] else ""
        cells = [
            Cell(value_text("delay_margin_s", margin_s, unit=False), outcome),
            Cell(number(None if own_s is None else 1e3 * own_s, 1)),
            Cell(share),
        ]
        rows.append(Line(one.name, cells, one.style))
    limit_s = next(
        (one["minimum"] for one in sets.run.data["scenario"]["limits"] if one["metric"] == "delay_margin_s"), None
    )
    wide = []
    if bars:
        figure = delay_figure(bars, limit_s, "delay")
        wide = [Figure("delay", "Delay margin of each loop", figure.svg, figure.label)]
    lead = [
        "Bar: how much later the torque could act before the loop is unstable; hatched, to the left of 0: it is "
        "unstable, and would have to be that much quicker. Heavy upright mark: the delay that the loop has already."
        + (f" Dashed: the limit, {1e3 * limit_s:g} ms." if limit_s is not None else "")
        + " A real vehicle has delays no model knows: a margin that is small beside the loop's own delay is no margin."
    ]
    columns = ["delay margin [ms]", "the loop's own delay [ms]", "margin over own delay [%]"]
    table = Table("Delay margins, as in run.json", "gain set", columns, rows)
    return Section("delay-margin", "Delay margin beside the loop's own delay", lead, wide, (), [table])


def samples_section(sets: Sets, found: Found, model: VehicleModel | None) -> Section:
    """What becomes of the gain sets on uncertain models."""
    known = [(one, found[one.number].samples) for one in sets.candidates]
    some = [(one, samples) for one, samples in known if samples is not None]
    problems = {found[one.number].problem for one, samples in known if samples is None} - {""}
    if not some or model is None:
        why = "; ".join(sorted(problems)) or "the airframe states no uncertainty, so there is nothing to vary"
        return Section("uncertain", "Uncertain models", [f"Not computed: {why}."])
    lead = [
        f"{SAMPLES} random models within 3 sigma of the identified one (seed {SEED}), the same for every gain set, "
        f"each flying the run's own manoeuvres on the roll axis alone, without noise{_no_faults(sets)}. "
        "Histograms share an axis; upright "
        "line: median; diamond: the nominal model; dashed: the limit. The tables hold what was flown beside them."
    ]
    entries = tuple(Entry(one.name, one.style, samples) for one, samples in some)
    drawing = share_figure(entries, "share")
    figures = [Figure("share", "How many models pass", drawing.svg, drawing.label, table=_share_table(some))]
    limits = bounds_of(sets.run.data)
    for metric in spread_metrics(limits):
        figure = _spread(metric, some, entries, found, limits.get(metric, (None, None)), model)
        if figure is not None:
            figures.append(figure)
    unsampled = [title(metric) for metric in limits if metric not in some[0][1].values]
    notes = [f"Limits that only a flight can tell are left out here: {', '.join(unsampled)}"] if unsampled else []
    notes += [f"{one.name}: {found[one.number].problem}" for one, samples in known if samples is None]
    return Section("uncertain", "Uncertain models", lead, (), figures, notes=notes)


def _no_faults(sets: Sets) -> str:
    return " and without the scenario's faults" if sets.run.data["scenario"]["faults"] else ""


def bounds_of(data: Mapping[str, Any]) -> dict[str, Bounds]:
    """Limits of a run: metric -> least and largest.

    Args:
        data: a `run.json`, or what is known of it before the flights.
    """
    return {one["metric"]: (one["minimum"], one["maximum"]) for one in data["scenario"]["limits"]}


def spread_metrics(limits: Iterable[str]) -> list[str]:
    """Metrics whose distribution is drawn, those with a limit first.

    Args:
        limits: metrics that are limited.
    """
    limited = set(limits)
    return sorted(SPREAD, key=lambda metric: metric not in limited)


def draw_samples(entries: tuple[Entry, ...], data: Mapping[str, Any]) -> None:
    """Draw the figures of `samples_section`, which keep what is drawn.

    Args:
        entries: of all candidates. data: what is known of the run.
    """
    share_figure(entries, "share")
    limits = bounds_of(data)
    for metric in spread_metrics(limits):
        if all(metric in one.samples.values for one in entries):
            spread_figure(entries, metric, limits.get(metric, (None, None)), f"spread-{metric}")


def _share_table(some: Sequence[tuple[Set, SampleSet]]) -> Table:
    rows = []
    for one, samples in some:
        low, high = wilson(samples.passes, samples.of)
        cells = [
            f"{samples.passes} of {samples.of}",
            f"{100.0 * low:.1f} to {100.0 * high:.1f}",
            "yes" if samples.good[0] else "no",
            *(str(int(what[1:].sum())) for what in (samples.unstable, samples.cycling, samples.lost)),
        ]
        rows.append(Line(one.name, [Cell(text) for text in cells], one.style))
    columns = ["models that pass", "95 % interval [%]", "nominal passes", "unstable", "in a limit cycle", "lost"]
    return Table("Models that meet every limit", "gain set", columns, rows)


def _spread(
    metric: str,
    some: Sequence[tuple[Set, SampleSet]],
    entries: tuple[Entry, ...],
    found: Found,
    bounds: Bounds,
    model: VehicleModel,
) -> Figure | None:
    if any(metric not in samples.values for _, samples in some):
        return None
    drawing = spread_figure(entries, metric, bounds, f"spread-{metric}")
    if drawing is None:
        return None
    rows = []
    for one, samples in some:
        row = samples.values[metric]
        flown = one.flight.metric(metric)
        over = spread(metric, row)
        derivatives = found[one.number].derivatives
        assert derivatives is not None
        why = sensitivity(metric, row, derivatives, model)
        matters = f"{why.dominant} ({100.0 * why.shares[why.dominant]:.0f} %)" if why.dominant else UNSET
        values = [None if flown is None else flown["value"], over.nominal, over.worst, over.median, over.best]
        cells = [*(value_text(metric, value, unit=False) for value in values), str(over.unset), matters]
        rows.append(Line(one.name, [Cell(text) for text in cells], one.style))
    columns = ["flown", "nominal", "worst", "median", "best", "not measured", "matters most"]
    table = Table(f"{heading(metric)} over the models", "gain set", columns, rows)
    name = title(metric)
    return Figure(f"spread-{metric}", name[0].upper() + name[1:], drawing.svg, drawing.label, table=table)
