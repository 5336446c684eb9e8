"""Figures of the models alone: Bode and eigenvalue plots of chapter 5, rays of chapter 4, ratios of chapter 8."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from scenarios.study.conclusions import BAND_RAD_S, eigenvalues, magnitude_db
from scenarios.study.figure_style import COLOURS, LIMIT, MARKERS, STYLES, TRUE, finished, legend, panels, phase_deg
from scenarios.study.printed import AIRFRAMES
from scenarios.study.result import Figure, FloatArray
from sitl.airframe import Derivatives, load_airframe
from sitl.froude import froude_number, scale_derivatives
from sitl.lateral import LateralModel

OMEGA = np.geomspace(0.3, 120.0, 160)
GROUPS = {"8.2": ("ANT-R", "ADAM-0"), "8.4": ("ANT-X", "CARRIER-1")}


def responses(derivatives: Derivatives, omega: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """Responses of p and a_y to delta_lat (equation 2.3), complex, at frequencies in rad/s.

    Args:
        derivatives: the model. omega: (F,).
    """
    model = LateralModel.from_derivatives(derivatives)
    state = np.linalg.solve(1j * omega[:, None, None] * np.eye(3) - model.A, model.B)
    both = (model.C @ state + model.D)[..., 0]
    return both[:, 0], both[:, 1]


def scaled_to(target: str) -> dict[str, Derivatives]:
    """Every other airframe's derivatives, scaled to the target."""
    body = load_airframe(target)
    others = {name: load_airframe(name) for name in AIRFRAMES if name != target}
    return {name: scale_derivatives(one.derivatives, froude_number(one, body)) for name, one in others.items()}


def draw() -> Iterator[Figure]:
    """All of them."""
    for target in AIRFRAMES:
        yield _bode(target)
        yield _poles(target)
    yield _rays()
    for section, pair in GROUPS.items():
        yield _ratio(section, *pair)


def _bode(target: str) -> Figure:
    canvas, axes = panels(2, 2, 9.0, 5.6, sharex=True)
    true = load_airframe(target).derivatives
    lines = [(f"{name} scaled", scaled, {"color": COLOURS[name], "linestyle": STYLES[name]})
             for name, scaled in scaled_to(target).items()]  # fmt: skip
    for label, derivatives, look in [(f"{target}, identified", true, TRUE), *lines]:
        for column, value in enumerate(responses(derivatives, OMEGA)):
            axes[0, column].semilogx(OMEGA, 20.0 * np.log10(np.abs(value)), label=label, **look)
            axes[1, column].semilogx(OMEGA, phase_deg(value), **look)
    for column, (what, unit) in enumerate((("p / delta_lat", "rad/s"), ("a_y / delta_lat", "m/s^2"))):
        axes[0, column].set_title(what)
        axes[0, column].set_ylabel(f"magnitude, dB re 1 {unit}")
        axes[1, column].set_ylabel("phase, deg")
        axes[1, column].set_xlabel("frequency, rad/s")
        for row in (0, 1):
            axes[row, column].axvspan(*BAND_RAD_S, color="#f3f3f3", zorder=0)
    legend(canvas, axes[0, 0], 4)
    caption = (
        f"Bode plots of the identified model of {target} and of the other airframes' models scaled to it. Shaded: the "
        "study's band of interest, 1 to 50 rad/s."
    )
    title = f"Froude-scaled models against the identified one: {target}"
    return finished(canvas, f"fig_5_bode_{target.lower()}", title, caption, "5")


def _poles(target: str) -> Figure:
    canvas, axes = panels(1, 1, 6.4, 4.6)
    plane = axes[0, 0]
    own = eigenvalues(load_airframe(target).derivatives)
    plane.plot(own.real, own.imag, "k*", markersize=13, label=f"{target}, identified")
    for name, scaled in scaled_to(target).items():
        values = eigenvalues(scaled)
        plane.plot(
            values.real, values.imag, MARKERS[name], color=COLOURS[name], markersize=7, mfc="none", mew=1.6,
            label=f"{name} scaled",
        )  # fmt: skip
    _axes_of_plane(plane)
    legend(canvas, plane, 2)
    caption = f"Eigenvalues of the identified model of {target} and of the other airframes' models scaled to it."
    return finished(canvas, f"fig_5_eigenvalues_{target.lower()}", f"Eigenvalues: {target}", caption, "5")


def _axes_of_plane(plane: object) -> None:
    plane.axvline(0.0, **LIMIT)  # type: ignore[attr-defined]
    plane.axhline(0.0, **LIMIT)  # type: ignore[attr-defined]
    plane.set_xlabel("real part, 1/s")  # type: ignore[attr-defined]
    plane.set_ylabel("imaginary part, 1/s")  # type: ignore[attr-defined]


def _rays() -> Figure:
    canvas, axes = panels(2, 2, 9.0, 6.4, sharex=True, sharey=True)
    factors = np.geomspace(0.25, 4.0, 41)
    for plane, name in zip(axes.ravel(), AIRFRAMES, strict=True):
        own = load_airframe(name).derivatives
        paths = np.array([eigenvalues(scale_derivatives(own, float(N))) for N in factors])
        for k in range(3):
            plane.plot(paths[:, k].real, paths[:, k].imag, color=COLOURS[name])
            for mark, at in (("<", 0), ("*", 20), (">", 40)):
                plane.plot(
                    paths[at, k].real, paths[at, k].imag, mark, color=COLOURS[name], markersize=9 if mark == "*" else 5
                )
        _axes_of_plane(plane)
        plane.set_title(name)
    caption = (
        "Eigenvalues of each airframe's model scaled with N from 0.25 (triangles to the left) over 1 (stars) to 4 "
        "(triangles to the right): they move along rays from the origin by sqrt(N) and never cross the imaginary axis."
    )
    return finished(canvas, "fig_4_sensitivity_to_n", "Eigenvalues against the Froude number", caption, "4")


def _ratio(section: str, one: str, other: str) -> Figure:
    canvas, axes = panels(1, 1, 7.0, 4.0)
    plot = axes[0, 0]
    a, b = load_airframe(one), load_airframe(other)
    ratio = magnitude_db(a.derivatives, OMEGA) - magnitude_db(b.derivatives, OMEGA)
    N = froude_number(b, a)
    plot.semilogx(OMEGA, ratio, color="#111111", linewidth=2.0, label=f"|p/delta| of {one} over {other}, identified")
    scaled = magnitude_db(scale_derivatives(b.derivatives, N), OMEGA) - magnitude_db(b.derivatives, OMEGA)
    plot.semilogx(
        OMEGA, scaled, color=COLOURS[other], linestyle="--", label=f"what Froude scaling of {other} to {one} would give"
    )
    plot.axhline(10.0 * math.log10(N), **LIMIT, label=f"sqrt(N), N = {N:.3f}")
    plot.axvspan(*BAND_RAD_S, color="#f3f3f3", zorder=0)
    plot.set_xlabel("frequency, rad/s")
    plot.set_ylabel("ratio of magnitudes, dB")
    legend(canvas, plot, 1)
    caption = (
        f"Ratio of the magnitudes of p / delta_lat of {one} and {other}, which share near-equal eigenvalues, beside "
        "what scaling by size alone would make of it."
    )
    title = f"Group {one} and {other}: magnitudes apart"
    return finished(canvas, f"fig_{section.replace('.', '_')}_ratio", title, caption, section)
