"""Figures of chapter 6: clouds of eigenvalues under uncertainty, and bands of gain and phase."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scenarios.monte_carlo import draw_samples
from scenarios.study.conclusions import BAND_RAD_S
from scenarios.study.figure_style import COLOURS, LIMIT, MARKERS, TRUE, finished, legend, panels, phase_deg
from scenarios.study.model_figures import OMEGA, responses
from scenarios.study.printed import AIRFRAMES
from scenarios.study.result import Figure, FloatArray
from sitl.airframe import load_airframe
from sitl.lateral import G_M_S2
from sitl.vehicle_spec import VehicleModel, resolve_vehicle

CLOUDS = {
    "6_3": ("6.3", "identified uncertainty alone", ()),
    "6_4_table": ("6.4", "sigma scaled by table 4.1, nominal kept", ("uncertainty",)),
    "6_4_grow": ("6.4", "sigma scaled so that it grows, nominal kept", ("uncertainty-grow",)),
    "6_5": ("6.5", "nominal and sigma scaled", ("derivatives", "uncertainty")),
}


def draw(samples: int, seed: int) -> Iterator[Figure]:
    """All of them.

    Args:
        samples: of each model. seed: of the draw.
    """
    for name, (section, what, words) in CLOUDS.items():
        yield _clouds(name, section, what, words, samples, seed)
    for target in AIRFRAMES:
        yield _bands(target, samples, seed)


def cloud(model: VehicleModel, samples: int, seed: int) -> np.ndarray:
    """(S, 3) eigenvalues of the samples of a model, 1/s.

    Args:
        model: nominal and sigma. samples, seed: of the draw.
    """
    d = draw_samples(model, samples, seed)
    a = np.zeros((len(d), 3, 3))
    a[:, 0, 0], a[:, 0, 1], a[:, 0, 2] = d[:, 0], d[:, 1], G_M_S2
    a[:, 1, 0], a[:, 1, 1], a[:, 2, 1] = d[:, 3], d[:, 4], 1.0
    return np.asarray(np.linalg.eigvals(a))


def _clouds(name: str, section: str, what: str, words: tuple[str, ...], samples: int, seed: int) -> Figure:
    canvas, axes = panels(2, 2, 9.0, 6.8)
    for plane, target in zip(axes.ravel(), AIRFRAMES, strict=True):
        references = [one for one in AIRFRAMES if one != target] if words else []
        for reference in references:
            values = cloud(resolve_vehicle(f"{reference}:{target}", words), samples, seed)
            _scatter(plane, values, reference)
        own = cloud(resolve_vehicle(target), samples, seed)
        if words:
            plane.plot(own[0].real, own[0].imag, "k*", markersize=11, label="target, identified")
        else:
            _scatter(plane, own, target)
            plane.plot(own[0].real, own[0].imag, "k*", markersize=9, label="nominal")
        plane.axvline(0.0, **LIMIT)
        plane.set_title(f"target {target}" if words else target)
        plane.set_xlabel("real part, 1/s")
        plane.set_ylabel("imaginary part, 1/s")
    for name_ in AIRFRAMES:
        label = f"from {name_}" if words else name_
        axes[0, 0].plot([], [], MARKERS[name_], color=COLOURS[name_], markersize=6, label=label)
    legend(canvas, axes[0, 0], 5)
    caption = (
        f"Eigenvalues of {samples} samples within 3 sigma of each model (section {section}: {what}); stars: nominal "
        "models of the airframes themselves."
    )
    return finished(canvas, f"fig_{name}_clouds", f"Uncertainty of the eigenvalues: {what}", caption, section)


def _scatter(plane: object, values: np.ndarray, name: str) -> None:
    plane.plot(  # type: ignore[attr-defined]
        values.real.ravel(), values.imag.ravel(), MARKERS[name], color=COLOURS[name], markersize=2.2, mew=0.0,
        alpha=0.45, rasterized=True,
    )  # fmt: skip


def _bands(target: str, samples: int, seed: int) -> Figure:
    references = [name for name in AIRFRAMES if name != target]
    canvas, axes = panels(2, 3, 10.0, 5.4, sharex=True, sharey="row")
    true = responses(load_airframe(target).derivatives, OMEGA)[0]
    for column, reference in enumerate(references):
        model = resolve_vehicle(f"{reference}:{target}", ("uncertainty", "gain"))
        many = _many(draw_samples(model, samples, seed))
        for row, (band, line) in enumerate(zip(_gain_and_phase(many), _gain_and_phase(true[None]), strict=True)):
            plot = axes[row, column]
            label = f"{reference}, sigma and gain scaled"
            plot.fill_between(
                OMEGA, band.min(axis=0), band.max(axis=0), color=COLOURS[reference], alpha=0.35, lw=0, label=label
            )
            plot.semilogx(OMEGA, np.median(band, axis=0), color=COLOURS[reference])
            plot.semilogx(OMEGA, line[0], label=f"{target}, identified", **TRUE)
            plot.axvspan(*BAND_RAD_S, color="#f3f3f3", zorder=0)
        axes[0, column].set_title(f"from {reference}")
        axes[1, column].set_xlabel("frequency, rad/s")
    for column in (1, 2):
        for line, label in zip(*axes[0, column].get_legend_handles_labels(), strict=True):
            if "scaled" in label:
                axes[0, 0].fill_between([], [], [], color=line.get_facecolor(), label=label, lw=0)
    axes[0, 0].set_ylabel("magnitude, dB re 1 rad/s")
    axes[1, 0].set_ylabel("phase, deg")
    legend(canvas, axes[0, 0], 2)
    caption = (
        f"Gain and phase of p / delta_lat over {samples} samples of each reference's model with its uncertainty and "
        f"gain scaled to {target} (section 6.6), beside the identified model of {target}."
    )
    title = f"Gain and phase bands of the scaled models: {target}"
    return finished(canvas, f"fig_6_13_bands_{target.lower()}", title, caption, "6.13")


def _many(derivatives: FloatArray) -> np.ndarray:
    """(S, F) p / delta_lat of samples."""
    a, b = np.zeros((len(derivatives), 3, 3)), np.zeros((len(derivatives), 3, 1))
    a[:, 0, :2], a[:, 0, 2], a[:, 1, :2], a[:, 2, 1] = derivatives[:, :2], G_M_S2, derivatives[:, 3:5], 1.0
    b[:, 0, 0], b[:, 1, 0] = derivatives[:, 2], derivatives[:, 5]
    return np.stack([np.linalg.solve(1j * omega * np.eye(3) - a, b)[:, 1, 0] for omega in OMEGA], axis=-1)


def _gain_and_phase(value: np.ndarray) -> tuple[FloatArray, FloatArray]:
    return 20.0 * np.log10(np.abs(value)), phase_deg(value)
