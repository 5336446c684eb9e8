"""FlightJob: everything that one flight needs, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from scenarios import sampler
from scenarios.gain_set import GainSet
from scenarios.scenario import Scenario
from sitl.parameters import ParameterTable, ParameterType
from sitl.profile import Profile
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import VehicleModel

MEMORY = "memory://"


@dataclass(frozen=True)
class FlightJob:
    """Everything one flight needs; plain data, so that it can go to another process.

    Attributes:
        gain_set: what is tried.
        parameters: name -> (value, type): everything that is uploaded, the other axes' gains too.
        scenario, model, profile: what flies how.
        warnings: of the gain set's check.
        folder: where the flight's files go; None keeps nothing.
        connect: link URL of a vehicle, or memory:// for one of our own.
        live_port: port for viewers, None for none.
        patience_s: wall-clock silence after which a vehicle elsewhere counts as lost, s.
        command: as typed, for who restores what a flight has left.
        suffix: behind the gain set's file name, for a flight that is kept beside another of the same set.
    """

    gain_set: GainSet
    parameters: Mapping[str, tuple[float | int, ParameterType]]
    scenario: Scenario
    model: VehicleModel
    profile: Profile
    warnings: tuple[str, ...] = ()
    folder: Path | None = None
    connect: str = MEMORY
    live_port: int | None = None
    patience_s: float = 5.0
    command: tuple[str, ...] = ()
    suffix: str = ""

    @property
    def slug(self) -> str:
        """What the flight's files are called."""
        return self.gain_set.slug + self.suffix

    def flown_table(self) -> ParameterTable:
        """The airframe's parameters with this job's on top: what the vehicle holds in flight."""
        table = ParameterTable(airframe_parameters(self.model, self.profile))
        for name, (value, _) in self.parameters.items():
            if name in table:  # a board has output functions that a simulator has not
                table.set(name, value)
        return table

    @property
    def rows_per_batch(self) -> int:
        """Telemetry rows that are written together: few for eyes that watch or a link that may die, else many."""
        if self.live_port is not None:
            return 50
        return sampler.ROWS_PER_BATCH if self.in_memory else 250

    @property
    def in_memory(self) -> bool:
        """The vehicle is ours, in this thread."""
        return self.connect.startswith(MEMORY)
