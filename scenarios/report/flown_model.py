"""What flew, put together from what `run.json` says of it: no airframe file is needed, so none can have changed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scenarios.manoeuvres import RECORDED, Manoeuvre, make_manoeuvre
from scenarios.roll_set import RollSet, roll_set
from sitl.airframe import Airframe, Assumptions, Derivatives, Rotor
from sitl.errors import FileError
from sitl.parameters import ParameterTable
from sitl.profile import Profile
from sitl.vehicle import airframe_parameters
from sitl.vehicle_spec import VehicleModel

NO_SIGMA = Derivatives(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class FlownModel:
    """What a run flew.

    Attributes:
        model: of the vehicle; of its airframe only what decides the roll axis. profile: fidelity.
        manoeuvres: in the order flown. setpoint_rate_hz: of the pilot.
    """

    model: VehicleModel
    profile: Profile
    manoeuvres: tuple[Manoeuvre, ...]
    setpoint_rate_hz: float

    def roll_set(self, uploaded: Mapping[str, float]) -> RollSet:
        """The gain set that a flight has flown.

        Args:
            uploaded: everything that was uploaded, PX4 name -> value.
        """
        table = ParameterTable(airframe_parameters(self.model, self.profile))
        # a board has output functions that a simulator has not
        return roll_set(self.model, self.profile, {name: v for name, v in uploaded.items() if name in table})


def flown_model(data: Mapping[str, Any]) -> FlownModel:
    """What a run flew.

    Args:
        data: a `run.json` in the present schema.

    Raises:
        FileError: it does not say enough, for example one that an older froude wrote.
    """
    try:
        return FlownModel(
            _model(data["vehicle"]),
            _profile(data["profile"]),
            _manoeuvres(data["scenario"]),
            float(data["scenario"]["setpoint_rate_hz"] or 50.0),
        )
    except (TypeError, ValueError, KeyError) as error:
        problem = "does not say enough of vehicle, profile or manoeuvres to compute with"
        raise FileError("run.json", problem, "Fly it again with this version") from error


def _model(vehicle: Mapping[str, Any]) -> VehicleModel:
    derivatives = Derivatives(**vehicle["derivatives"])
    sigma = {name: float(value or 0.0) for name, value in vehicle["sigma_pct"].items()}
    sigma_pct = Derivatives(**sigma) if sigma else NO_SIGMA
    assumptions = Assumptions(**vehicle["assumptions"])
    rotors = tuple(Rotor(**rotor) for rotor in vehicle["rotors"])
    if not rotors:
        raise ValueError("it lists no rotors")
    size = float(vehicle["diagonal_m"] or 0.0)
    body = Airframe(
        name=vehicle["name"],
        title=vehicle["title"],
        path=Path("run.json"),
        mass_kg=float(vehicle["mass_kg"] or 0.0),
        frame_m=(size, size, 0.0),
        diagonal_m=size,
        lateral_m=size,
        layout=vehicle["layout"],
        rotors=rotors,
        derivatives=derivatives,
        sigma_pct=sigma_pct,
        flight_gains=None,
        assumptions=assumptions,
        battery="",
        hover_min=None,
        notes=(),
    )
    return VehicleModel(
        spec=vehicle["spec"],
        airframe=body,
        reference=None,
        derivatives=derivatives,
        sigma_pct=sigma_pct,
        froude_number=float(vehicle["froude_number"] or 1.0),
        scaling=frozenset(vehicle["scaling"]),
        assumptions=assumptions,
    )


def _profile(rows: Sequence[Mapping[str, Any]]) -> Profile:
    values: dict[str, Any] = {row["item"]: None if row["value"] == "airframe" else row["value"] for row in rows}
    known = {field.name for field in dataclasses.fields(Profile)}
    return Profile(**{name: value for name, value in values.items() if name in known})


def _manoeuvres(scenario: Mapping[str, Any]) -> tuple[Manoeuvre, ...]:
    """None where they were recorded elsewhere: nothing says how to fly them again."""
    if any(one["kind"] == RECORDED for one in scenario["manoeuvres"]):
        return ()
    rate_hz = float(scenario["setpoint_rate_hz"] or 50.0)
    made = []
    for one in scenario["manoeuvres"]:
        keys = {name: value for name, value in one["settings"].items() if name not in ("kind", "name")}
        made.append(make_manoeuvre(one["kind"], one["name"], setpoint_rate_hz=rate_hz, **keys))
    return tuple(made)
