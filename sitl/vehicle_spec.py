"""VehicleModel: what flies, from a vehicle spec.

`ant-x` is ANT-X as identified. `ant-r:ant-x` is ANT-R's model scaled to ANT-X's size and flown on ANT-X's
body: geometry, flight gains and assumptions are the target's, the derivatives what the reference predicts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from sitl.airframe import Airframe, Assumptions, Derivatives, load_airframe
from sitl.errors import UsageError
from sitl.froude import froude_number, scale_derivatives, scale_gain, scale_sigma
from sitl.keyed_table import nearest

SCALING_WORDS: dict[str, str] = {
    "derivatives": "each derivative times N**exponent, table 4.1",
    "uncertainty": "each sigma, in per cent, times the derivative's own factor of table 4.1",
    "uncertainty-grow": "each sigma, in per cent, times that factor or its inverse, whichever is above 1",
    "gain": "Yd and Ld times sqrt(N)",
}
DEFAULT_SCALING = ("derivatives",)


@dataclass(frozen=True)
class VehicleModel:
    """A body and the derivatives it flies with; see `resolve_vehicle`."""

    spec: str
    airframe: Airframe
    """The body that flies: the target of a scaled spec."""
    reference: Airframe | None
    """Whose model is scaled; None for an identified airframe."""
    derivatives: Derivatives
    sigma_pct: Derivatives
    """One standard deviation of each derivative in per cent of `derivatives`."""
    froude_number: float
    """N = L_reference / L_target; 1 for an identified airframe."""
    scaling: frozenset[str]
    """The SCALING_WORDS applied; empty for an identified airframe."""
    assumptions: Assumptions
    """About the body that flies; a scenario may replace them."""

    @property
    def name(self) -> str:
        """`ANT-X`, or `ANT-R:ANT-X` for ANT-R scaled to ANT-X."""
        return f"{self.reference.name}:{self.airframe.name}" if self.reference else self.airframe.name


def resolve_vehicle(spec: str, scaling: Iterable[str] = DEFAULT_SCALING) -> VehicleModel:
    """The model that a vehicle spec names.

    Args:
        spec: `target` or `reference:target`; each a built-in name or the path of an airframe file.
        scaling: which of SCALING_WORDS to apply to `reference:target`, alone or together; none keeps the
            reference's own derivatives on the target's body. An identified airframe is never scaled.

    Raises:
        UsageError: the spec is malformed, an airframe or a scaling word is unknown.
        FileError: an airframe's file is not usable.
    """
    words = _scaling_words(scaling)
    reference_name, target_name = _split(spec)
    target = load_airframe(target_name)
    if reference_name is None:
        return VehicleModel(
            spec=spec,
            airframe=target,
            reference=None,
            derivatives=target.derivatives,
            sigma_pct=target.sigma_pct,
            froude_number=1.0,
            scaling=frozenset(),
            assumptions=target.assumptions,
        )
    reference = load_airframe(reference_name)
    N = froude_number(reference, target)
    derivatives, sigma_pct = reference.derivatives, reference.sigma_pct
    if "derivatives" in words:
        derivatives = scale_derivatives(derivatives, N)
    if "gain" in words:
        derivatives = scale_gain(derivatives, N)
    if "uncertainty" in words:
        sigma_pct = scale_sigma(sigma_pct, N, "table")
    if "uncertainty-grow" in words:
        sigma_pct = scale_sigma(sigma_pct, N, "grow")
    return VehicleModel(
        spec=spec,
        airframe=target,
        reference=reference,
        derivatives=derivatives,
        sigma_pct=sigma_pct,
        froude_number=N,
        scaling=words,
        assumptions=target.assumptions,
    )


def _scaling_words(scaling: Iterable[str]) -> frozenset[str]:
    words = frozenset([scaling] if isinstance(scaling, str) else scaling)
    for word in sorted(words):
        if word not in SCALING_WORDS:
            raise UsageError(
                f'unknown scaling "{word}"{nearest(word, SCALING_WORDS)}; words are {", ".join(SCALING_WORDS)}'
            )
    if {"uncertainty", "uncertainty-grow"} <= words:
        raise UsageError("scaling: uncertainty and uncertainty-grow are two ways of the same thing, give one")
    return words


def _split(spec: str) -> tuple[str | None, str]:
    """(reference or None, target); a path may itself hold a colon."""
    if Path(spec).is_file():
        return None, spec
    parts = spec.split(":")
    if len(parts) > 2 or not all(part.strip() for part in parts):
        raise UsageError(f'vehicle "{spec}" is neither an airframe nor REFERENCE:TARGET; write ant-x or ant-r:ant-x')
    return (parts[0].strip(), parts[1].strip()) if len(parts) == 2 else (None, parts[0].strip())
