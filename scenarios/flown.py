"""Where a run is, and what came back from its flights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from scenarios.flight import FlightRecord

Landed = Callable[[int, FlightRecord], object]
"""Called with the number and the record of each flight that is over."""


@dataclass(frozen=True)
class Progress:
    """Where a run is: flight `index` of `count`, in `phase`."""

    index: int
    count: int
    name: str
    phase: str


@dataclass
class Flown:
    """What came back from the flights.

    Attributes:
        records: by job number. stopped: what ended the run early. owed: what is left to do by hand.
    """

    records: dict[int, FlightRecord] = field(default_factory=dict)
    stopped: BaseException | None = None
    owed: str = ""
