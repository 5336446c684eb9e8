"""FlightJob: everything that one flight needs, as plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from scenarios import sampler
from scenarios.gain_set import GainSet
from scenarios.scenario import Scenario
from sitl.parameters import ParameterTable, ParameterType
from sitl.profile import Profile
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import VehicleModel

if TYPE_CHECKING:
    from scenarios.recorder.flight_drawing import FlownVehicle

MEMORY = "memory://"

TELEMETRY_HZ = round(1e6 / sampler.FAST_INTERVAL_US)

BATCH_S = 0.06


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
        live_port: port for viewers, None for none. live_window: open a viewer's window, too.
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
    live_window: bool = False

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

    def flown_vehicle(self) -> FlownVehicle:
        """What a recording draws: the body, and the control loop's settings at the rate that telemetry has at most."""
        from scenarios.recorder.flight_drawing import FlownVehicle
        from sitl.control_settings import control_settings, mix_of

        airframe, table = self.model.airframe, self.flown_table()
        profile = replace(self.profile, rate_hz=min(self.profile.rate_hz, TELEMETRY_HZ))
        return FlownVehicle(airframe.rotors, airframe.frame_m, control_settings(table, profile, mix_of(table)))

    def about(self) -> dict[str, float | int | str]:
        """Facts on the run that each of its recordings carries."""
        return {
            "scenario": self.scenario.name,
            "vehicle": self.model.spec,
            "profile": self.profile.name,
            "gain_set": self.gain_set.name,
            "autopilot": "own" if self.in_memory else "real, or elsewhere",
            "seed": self.scenario.seed,
            "folder": "" if self.folder is None else self.folder.parent.name,
        }

    @property
    def rows_per_chunk(self) -> int:
        """Telemetry rows that wait for others before they are recorded; over a link none does."""
        return 2 * sampler.ROWS_PER_BATCH if self.in_memory else 1

    @property
    def batch_s(self) -> float:
        """Vehicle time after which rows are handed over, and frames logged, even if they are few, s.

        A vehicle elsewhere flies at the pace of the clock, and of what a killed program leaves at most a tenth of a
        second may be missing. One of our own flies many seconds in that time.
        """
        return math.inf if self.in_memory else BATCH_S

    @property
    def in_memory(self) -> bool:
        """The vehicle is ours, in this thread."""
        return self.connect.startswith(MEMORY)
