"""What became of a planned fault in one flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from scenarios.faults import Fault
from scenarios.limits import Outcome

MOST_NAMED = 3
"""So many faults are named before a reason; of the others only how many there are."""


@dataclass(frozen=True)
class InjectedFault:
    """One fault of one flight.

    Attributes:
        kind: one of `scenarios.fault_kinds.KINDS`. text: what it is, in a few words. plan: when it was to begin.
        settings: the kind's keys.
        start_s: vehicle time at which it came into force; None: the flight ended before.
        end_s: vehicle time at which it ended; None: never begun, or the flight was broken off meanwhile.
        datagrams: of a link: how many passed while it was in force, and of how many something became; else None.
    """

    kind: str
    text: str
    plan: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    start_s: float | None = None
    end_s: float | None = None
    datagrams: tuple[int, int] | None = None

    @classmethod
    def of(
        cls, fault: Fault, start_s: float | None, end_s: float | None, datagrams: tuple[int, int] | None = None
    ) -> InjectedFault:
        """Of a planned fault.

        Args:
            fault: as planned. start_s, end_s, datagrams: as the attributes.
        """
        return cls(fault.kind, fault.text, fault.when, fault.settings, start_s, end_s, datagrams)


def judge_faults(outcome: Outcome, reason: str, faults: Sequence[InjectedFault]) -> tuple[Outcome, str]:
    """The verdict of a flight, its faults taken into account.

    Args:
        outcome, reason: without them. faults: of the flight.

    Returns:
        A flight that did not pass names them before its reason; one that met not all of them has not shown that it
        survives them, and is UNSET.
    """
    began = sorted((fault.start_s, fault.text) for fault in faults if fault.start_s is not None)
    if outcome in (Outcome.PASS, Outcome.INFO):
        missed = [f"{fault.text} was never injected ({fault.plan})" for fault in faults if fault.start_s is None]
        return (Outcome.UNSET, "; ".join(missed)) if missed else (outcome, reason)
    if not began:
        return outcome, reason
    named = [f"{text} at {start_s:.1f} s" for start_s, text in began[:MOST_NAMED]]
    if len(began) > MOST_NAMED:
        more = len(began) - MOST_NAMED
        named.append(f"{more} more fault{'' if more == 1 else 's'}")
    return outcome, f"{', '.join(named)}: {reason}"
