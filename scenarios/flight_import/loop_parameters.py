"""Which of a log's parameters make the roll and pitch loops what they are, and when they were in force."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from scenarios.flight import Segment
from scenarios.flight_import.recorded import Recorded, Value
from scenarios.flight_import.step_finder import Found
from scenarios.gain_set import GainSet

LOOP = re.compile(
    r"MC_(ROLL|PITCH|YAW)(RATE)?_(P|I|D|FF|K|MAX)$|MC_(RR|PR|YR)_INT_LIM$|MC_YAW_(TQ_CUTOFF|WEIGHT)$|MC_AIRMODE$"
    r"|IMU_D?GYRO_CUTOFF$|IMU_GYRO_NF[01]_(FRQ|BW)$|THR_MDL_FAC$|CA_METHOD$"
)
"""Gains, limits, filters and the mix's method: what is flown along when a flight is flown again."""

UNKNOWN = "gains not in the log"


@dataclass(frozen=True)
class Group:
    """Segments that were flown with the same gains.

    Attributes:
        gain_set: what the log says was in force. segments: of the flight, in order of time.
    """

    gain_set: GainSet
    segments: tuple[Segment, ...]


def loop_parameters(recorded: Recorded, at_s: float) -> dict[str, Value]:
    """Parameters of the loops that were in force at a vehicle time, s; those that this program knows."""
    from sitl.parameters import parameter_specs

    known = parameter_specs()
    found: dict[str, Value] = {}
    for name, value in sorted(recorded.parameters(at_s).items()):
        if LOOP.match(name) and name in known:
            found[name] = int(value) if known[name].type == "INT32" else shortest(value)
    return found


def shortest(value: Value) -> float:
    """The shortest decimal that is the same float32: 0.05, not 0.0500000007."""
    import numpy as np

    return float(str(np.float32(value)))


def groups(recorded: Recorded, found: Found, segments: Sequence[Segment]) -> tuple[Group, ...]:
    """The segments by the gains they were flown with: whoever tunes in flight makes several candidates of one log.

    Args:
        recorded: the flight. found: when each manoeuvre begins. segments: to be grouped.
    """
    sets: list[tuple[dict[str, Value], list[Segment]]] = []
    for segment in segments:
        values = loop_parameters(recorded, found.begins[segment.manoeuvre])
        for other, those in sets:
            if other == values:
                those.append(segment)
                break
        else:
            sets.append((values, [segment]))
    stem, made = recorded.path.stem, []
    for number, (values, those) in enumerate(sets, 1):
        name = stem if len(sets) == 1 else f"{stem} gains {number}"
        note = "" if any(LOOP.match(one) and one.startswith("MC_ROLL") for one in values) else UNKNOWN
        source = f"recorded, {recorded.kind} {recorded.path.name}"
        made.append(Group(GainSet(name, values, source, note, recorded.path), tuple(those)))
    return tuple(made)
