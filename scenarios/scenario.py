"""Scenario: vehicle, fidelity profile, gain sets, manoeuvres and limits of a run, read from one TOML file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.faults import Fault, parse_faults
from scenarios.limits import LIMIT_SETS, Limit, parse_limits
from scenarios.manoeuvres import Manoeuvre, parse_manoeuvres
from scenarios.toml_file import read_toml
from sitl.airframe import Assumptions
from sitl.errors import FileError, UsageError
from sitl.keyed_table import KeyedTable, nearest

if TYPE_CHECKING:
    from sitl.profile import Profile
    from sitl.vehicle_spec import VehicleModel

LIBRARY_DIR = Path(__file__).parent / "library"
AXES = ("roll", "both")

# What the runner and the plant can still do something sensible with.
ASSUMPTION_RANGES: Mapping[str, tuple[float, float]] = {
    "motor_lag_s": (0.0, 0.5),
    "hover_thrust": (0.05, 0.9),
    "heave_damping_1_s": (0.0, 10.0),
    "yaw_gain_rad_s2": (0.1, 1000.0),
    "yaw_damping_1_s": (0.0, 100.0),
}


@dataclass(frozen=True)
class Gate:
    """When a manoeuvre may begin: the vehicle is level, still and at height, all for a while.

    Attributes:
        level_deg: largest roll and pitch angle.
        rate_deg_s: largest body rate.
        height_m: largest distance from the take-off height.
        hold_s: how long all of them must hold, vehicle time.
        timeout_s: how long to wait, vehicle time; then the manoeuvre is flown all the same and the record
            says so: a set that shakes never gets still, and that is what is to be measured.
    """

    level_deg: float = 2.0
    rate_deg_s: float = 5.0
    height_m: float = 1.0
    hold_s: float = 1.0
    timeout_s: float = 20.0


@dataclass(frozen=True)
class Scenario:
    """What is flown and how it is judged.

    Attributes:
        name: the file's name without suffix; names the run's folder.
        title: one line for reports.
        vehicle: spec, `ant-x` or `reference:target`.
        scaling: what Froude scaling applies to (`sitl.vehicle_spec.SCALING_WORDS`).
        profile: name of the fidelity profile.
        overrides: items of the profile that are replaced.
        assumptions: the airframe's assumptions that are replaced, such as `hover_thrust`.
        axes: "roll": pitch flies the airframe's own flight gains; "both": the gain set is mirrored to pitch.
        takeoff_altitude_m: above the boot place.
        setpoint_rate_hz: SET_ATTITUDE_TARGET per second of vehicle time.
        seed: of sensor noise and lossy links.
        gain_sets: references for `scenarios.gain_set.load_all`.
        manoeuvres: in the order flown.
        limits: on the flight's metrics.
        limits_name: name of the limit set; "custom" for the file's own.
        gate: before each manoeuvre.
        faults: that every flight meets, in the order written.
        path: the file.
    """

    name: str
    title: str
    vehicle: str
    scaling: tuple[str, ...]
    profile: str
    overrides: Mapping[str, Any]
    assumptions: Mapping[str, float]
    axes: str
    takeoff_altitude_m: float
    setpoint_rate_hz: float
    seed: int
    gain_sets: tuple[str, ...]
    manoeuvres: tuple[Manoeuvre, ...]
    limits: tuple[Limit, ...]
    limits_name: str = "custom"
    gate: Gate = field(default_factory=Gate)
    faults: tuple[Fault, ...] = ()
    path: Path | None = None

    def resolve_profile(self) -> Profile:
        """The profile with its overrides.

        Raises:
            UsageError: unknown profile or item, a value out of range, or a set-point period that is no whole
                number of the profile's ticks.
        """
        from sitl.profile import get_profile

        profile = get_profile(self.profile, **self.overrides)
        ticks = profile.rate_hz / self.setpoint_rate_hz
        if abs(ticks - round(ticks)) > 1e-9:
            raise UsageError(
                f"setpoint_rate_hz = {self.setpoint_rate_hz:g} does not divide the {profile.rate_hz} Hz of "
                f'profile "{profile.name}": a set-point must be due on a tick. Try 50'
            )
        return profile

    def resolve_vehicle(self) -> VehicleModel:
        """The vehicle model with the scenario's assumptions.

        Raises:
            UsageError, FileError: as `sitl.vehicle_spec.resolve_vehicle`.
        """
        from sitl.vehicle_spec import resolve_vehicle

        model = resolve_vehicle(self.vehicle, self.scaling)
        return dataclasses.replace(model, assumptions=dataclasses.replace(model.assumptions, **self.assumptions))


def list_scenarios() -> tuple[str, ...]:
    """Names of the scenarios that come with the program."""
    return tuple(sorted(path.stem for path in LIBRARY_DIR.glob("*.toml")))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Read and check a scenario.

    Args:
        name_or_path: of the library (`demo`), or the path of a TOML file.

    Raises:
        FileError: no such scenario, or anything in the file that cannot be flown; names file, key and value.
    """
    path = _find(name_or_path)
    data = read_toml(path)
    file = KeyedTable(path, data)
    profile, overrides = _profile(file, data)
    rate_hz = file.number("setpoint_rate_hz", 50.0, at_least=5.0, at_most=500.0)
    limits, limits_name = read_limits(file)
    manoeuvres = parse_manoeuvres(data["manoeuvre"] if "manoeuvre" in file else None, path, rate_hz)
    scenario = Scenario(
        name=path.stem,
        title=file.text("title", path.stem),
        vehicle=":".join(beside(path, part) for part in file.text("vehicle", "ant-x").split(":")),
        scaling=file.texts("scaling") if "scaling" in file else ("derivatives",),
        profile=profile,
        overrides=overrides,
        assumptions=_assumptions(file),
        axes=_choice(file, "axes", AXES),
        takeoff_altitude_m=file.number("takeoff_altitude_m", 10.0, at_least=2.0, at_most=500.0),
        setpoint_rate_hz=rate_hz,
        seed=_whole(file, "seed", 0),
        gain_sets=tuple(beside(path, ref) for ref in file.texts("gain_sets")),
        manoeuvres=manoeuvres,
        limits=limits,
        limits_name=limits_name,
        gate=_gate(file),
        faults=parse_faults(data["fault"] if "fault" in file else None, path, manoeuvres),
        path=path,
    )
    file.finish()
    try:
        scenario.resolve_profile()
    except UsageError as error:
        raise FileError(path, str(error)) from error
    return scenario


def read_limits(file: KeyedTable) -> tuple[tuple[Limit, ...], str]:
    """The limits of a file, `limits = "practical"` or its own [[limit]], and the name of the set ("custom").

    Args:
        file: a scenario's or a sweep's.

    Raises:
        FileError: both, or as `parse_limits`.
    """
    key = "limit" if "limit" in file else "limits"
    if key == "limit" and "limits" in file:
        raise file.error("limit", "the file has limits, too", "Name a limit set or list your own, not both")
    if key == "limit":
        file.tables(key)
    value = file.anything(key) if key in file else "practical"
    return parse_limits(value, file.path, key), value if isinstance(value, str) else "custom"


def limit_set(name: str) -> tuple[Limit, ...]:
    """The limits of a named set.

    Raises:
        UsageError: no such set.
    """
    if name not in LIMIT_SETS:
        raise UsageError(f'no limit set "{name}"{nearest(name, LIMIT_SETS)}; sets are {", ".join(LIMIT_SETS)}')
    return LIMIT_SETS[name]


def _find(name_or_path: str | Path) -> Path:
    for path in (Path(name_or_path), LIBRARY_DIR / f"{name_or_path}.toml"):
        if path.is_file():
            return path
    known = list_scenarios()
    hint = f"In the library: {', '.join(known)}; or give the path of a .toml file"
    raise FileError(name_or_path, f"no such scenario{nearest(str(name_or_path), known)}", hint)


def beside(scenario: Path, ref: str) -> str:
    """A file named in a scenario is looked for beside it first; anything else is left as it is."""
    folder = scenario.parent
    here = any(part and (folder / part).is_file() for part in (ref, ref.rpartition("/")[0]))
    return str(folder / ref) if here else ref


def _profile(file: KeyedTable, data: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """`profile = "sitl"`, or a table [profile] with `name` and the items to replace."""
    if "profile" not in file or not isinstance(data["profile"], dict):
        return file.text("profile", "sitl"), {}
    file.table("profile")
    items = dict(data["profile"])
    name = items.pop("name", "sitl")
    if not isinstance(name, str):
        raise file.error("profile", f"name = {name!r} is not a text", "Quote it")
    return name, items


def _assumptions(file: KeyedTable) -> dict[str, float]:
    if "airframe" not in file:
        return {}
    table = file.table("airframe")
    found = {
        item.name: table.number(item.name, at_least=low, at_most=high)
        for item in dataclasses.fields(Assumptions)
        for low, high in (ASSUMPTION_RANGES[item.name],)
        if item.name in table
    }
    table.finish()
    return found


def _gate(file: KeyedTable) -> Gate:
    default = Gate()
    if "gate" not in file:
        return default
    table = file.table("gate")
    gate = Gate(
        level_deg=table.number("level_deg", default.level_deg, above=0.0, at_most=45.0),
        rate_deg_s=table.number("rate_deg_s", default.rate_deg_s, above=0.0, at_most=360.0),
        height_m=table.number("height_m", default.height_m, above=0.0, at_most=100.0),
        hold_s=table.number("hold_s", default.hold_s, at_least=0.0, at_most=60.0),
        timeout_s=table.number("timeout_s", default.timeout_s, above=0.0, at_most=600.0),
    )
    table.finish()
    if gate.timeout_s < gate.hold_s:
        raise table.error("timeout_s", f"{gate.timeout_s:g} is shorter than hold_s", "Make it longer")
    return gate


def _choice(file: KeyedTable, key: str, known: tuple[str, ...]) -> str:
    value = file.text(key, known[0])
    if value not in known:
        raise file.error(key, f'"{value}" is not known{nearest(value, known)}', f"Known: {', '.join(known)}")
    return value


def _whole(file: KeyedTable, key: str, default: int) -> int:
    value = file.number(key, float(default), at_least=0.0, at_most=2.0**53)
    if value != int(value):
        raise file.error(key, f"{value:g} is not a whole number", "Write a whole number")
    return int(value)
