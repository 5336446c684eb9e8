"""What a flight needs of a real autopilot on our plant, however the two are joined."""

from __future__ import annotations

from typing import Protocol

from bridge.drive import Drive
from bridge.link import Link
from scenarios.sampler import Truth
from sitl.body import Body


class PlantSession(Protocol):
    """Plant and autopilot of a run: in lockstep (`HilSession`) or in real time (`BoardSession`).

    Attributes:
        board: the autopilot is hardware.
    """

    board: bool

    @property
    def body(self) -> Body | None:
        """Plant and sensors, where they are in this process."""
        ...

    @property
    def link(self) -> Link:
        """The client's way to the autopilot."""
        ...

    @property
    def drive(self) -> Drive:
        """The client's time."""
        ...

    @property
    def faults(self) -> tuple[str, ...]:
        """What makes this flight worthless; empty if nothing does."""
        ...

    @property
    def answers(self) -> int:
        """Motor commands that came since `begin`."""
        ...

    @property
    def motors(self) -> tuple[float, ...]:
        """The latest motor commands, 0 to 1 in PX4's order; empty before the first."""
        ...

    def begin(self) -> None:
        """Another flight begins: what is measured of it is its own."""
        ...

    def summary(self) -> str:
        """How well the two kept time, in a line."""
        ...

    def truth_at(self, time_ms: int) -> Truth | None:
        """What the plant did at a vehicle time.

        Args:
            time_ms: as in ATTITUDE.
        """
        ...
