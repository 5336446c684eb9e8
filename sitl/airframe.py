"""Airframe: one multirotor, its body, its identified lateral derivatives and what we assume about it.

Built-in airframes are `sitl/airframes/*.toml`; a user's own is any TOML file of the same shape, named by its
path. Every key is checked when the file is read, so an Airframe that exists is one that can be flown.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sitl.errors import UsageError
from sitl.keyed_table import KeyedTable, nearest

AIRFRAMES_DIR = Path(__file__).parent / "airframes"

# Rotors each layout has; "custom" is any list of 3 to 12.
LAYOUTS: dict[str, int | None] = {"X": 4, "H": 4, "octo": 8, "X8": 8, "custom": None}
MIN_ROTORS, MAX_ROTORS = 3, 12

AIRFRAME_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
"""What an airframe may be called."""

# PX4's allocator drops an axis whose effectiveness CT * arm is at most 0.05, with CT 6.5 by default.
MIN_ARM_M = 0.05 / 6.5


@dataclass(frozen=True)
class Derivatives:
    """Lateral stability and control derivatives, per unit of delta_lat (study, equation 2.2, table 2.1).

    The same six fields also hold their standard deviations, then in per cent of the value.
    """

    Yv: float  # 1/s
    Yp: float  # m/(s rad)
    Yd: float  # m/s^2
    Lv: float  # rad/(m s)
    Lp: float  # 1/s
    Ld: float  # rad/s^2

    def as_dict(self) -> dict[str, float]:
        """Name -> value, in the order of the fields."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def as_array(self) -> npt.NDArray[np.float64]:
        """(6,) in the order Yv, Yp, Yd, Lv, Lp, Ld."""
        return np.array(astuple(self))

    @classmethod
    def from_values(cls, values: Iterable[float]) -> Derivatives:
        """From six numbers in the order of the fields, such as one row of `sample_derivatives`."""
        return cls(*(float(value) for value in values))


DERIVATIVE_NAMES: tuple[str, ...] = tuple(field.name for field in fields(Derivatives))

# Key of each derivative in an airframe file.
DERIVATIVE_KEYS = {
    "Yv": "Yv_1_s",
    "Yp": "Yp_m_s_rad",
    "Yd": "Yd_m_s2",
    "Lv": "Lv_rad_m_s",
    "Lp": "Lp_1_s",
    "Ld": "Ld_rad_s2",
}


@dataclass(frozen=True)
class Rotor:
    """One rotor; body frame FRD, origin at the centre of mass, thrust upwards (PX4 CA_ROTORn_*)."""

    px_m: float
    """Forwards."""
    py_m: float
    """To the right."""
    pz_m: float
    """Downwards."""
    km: float
    """Moment coefficient; positive turns counter-clockwise seen from above and yaws the nose right."""


@dataclass(frozen=True)
class FlightGains:
    """Gains the real airframe flew with (study, table 2.2); parallel form, PX4's K = 1 and FF = 0."""

    k_phi: float  # 1/s, MC_ROLL_P
    kp: float  # s/rad, MC_ROLLRATE_P
    ki: float  # 1/rad, MC_ROLLRATE_I
    kd: float  # s^2/rad, MC_ROLLRATE_D


@dataclass(frozen=True)
class Assumptions:
    """What the study does not give. Assumed, not measured: printed with every result."""

    motor_lag_s: float = 0.025
    """Time constant of the first-order lag from motor command to thrust."""
    hover_thrust: float = 0.5
    """Collective thrust command, 0..1, that carries the weight."""
    heave_damping_1_s: float = 0.3
    """Vertical speed's own damping."""
    yaw_gain_rad_s2: float = 20.0
    """Yaw acceleration per unit of delta_yaw."""
    yaw_damping_1_s: float = 1.0
    """Yaw rate's own damping."""


@dataclass(frozen=True)
class Airframe:
    """One multirotor; see `load_airframe`."""

    name: str
    title: str
    path: Path
    mass_kg: float
    frame_m: tuple[float, float, float]
    """Length, width, height."""
    diagonal_m: float
    """Motor to motor across the centre: the length of the Froude number."""
    lateral_m: float
    """Between rotor hub centres, across."""
    layout: str
    """One of LAYOUTS."""
    rotors: tuple[Rotor, ...]
    """In PX4 motor order."""
    derivatives: Derivatives
    sigma_pct: Derivatives
    """One standard deviation of each derivative in per cent of its value; all 0 if the file states none."""
    flight_gains: FlightGains | None
    assumptions: Assumptions
    battery: str
    """As printed, empty if unknown."""
    hover_min: float | None
    """Endurance in hover, minutes."""
    notes: tuple[str, ...]

    @property
    def has_sigma(self) -> bool:
        """Whether the file states any uncertainty; without it a Monte Carlo has nothing to vary."""
        return any(value > 0.0 for value in self.sigma_pct.as_dict().values())


def list_airframes() -> tuple[str, ...]:
    """Names of the built-in airframes, lower case, sorted."""
    return tuple(sorted(path.stem for path in AIRFRAMES_DIR.glob("*.toml")))


def load_airframe(name_or_path: str | Path) -> Airframe:
    """Load a built-in airframe by name, in any case, or a user's own by the path of its TOML file.

    Raises:
        UsageError: no airframe of that name.
        FileError: the file is missing, is not TOML, or a key in it is missing, misspelt or out of range.
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.casefold().endswith(".toml") or "/" in text or "\\" in text:
        return _parse(KeyedTable.read(Path(name_or_path)))
    known = list_airframes()
    name = text.strip().casefold()
    if name not in known:
        raise UsageError(
            f'unknown airframe "{text}"{nearest(text, known)}. '
            f"Known are {', '.join(known)}; for your own give the path of its .toml file"
        )
    return _parse(KeyedTable.read(AIRFRAMES_DIR / f"{name}.toml"))


def _parse(file: KeyedTable) -> Airframe:
    name = file.text("name")
    if not AIRFRAME_NAME.fullmatch(name):
        raise file.error("name", f"{name!r} is not a name", "Use letters, digits, '.', '_', '+' and '-'")
    length, width, height = file.numbers("frame_m", 3, above=0.0)
    layout = file.text("layout")
    airframe = Airframe(
        name=name,
        title=file.text("title", name),
        path=file.path,
        mass_kg=file.number("mass_kg", above=0.0),
        frame_m=(length, width, height),
        diagonal_m=file.number("diagonal_m", above=0.0),
        lateral_m=file.number("lateral_m", above=0.0),
        layout=layout,
        rotors=_rotors(file, layout),
        derivatives=_derivatives(file),
        sigma_pct=_sigma(file),
        flight_gains=_flight_gains(file),
        assumptions=_assumptions(file),
        battery=file.text("battery", ""),
        hover_min=file.number("hover_min", above=0.0) if "hover_min" in file else None,
        notes=file.texts("notes"),
    )
    file.finish()
    return airframe


def _derivatives(file: KeyedTable) -> Derivatives:
    table = file.table("derivatives")
    read = Derivatives(
        **{
            name: table.number(key, above=0.0) if name == "Ld" else table.number(key)
            for name, key in DERIVATIVE_KEYS.items()
        }
    )
    table.finish()
    return read


def _sigma(file: KeyedTable) -> Derivatives:
    if "sigma" not in file:
        return Derivatives(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    table = file.table("sigma")
    read = Derivatives(**{name: table.number(f"{name}_pct", at_least=0.0) for name in DERIVATIVE_NAMES})
    table.finish()
    return read


def _flight_gains(file: KeyedTable) -> FlightGains | None:
    if "flight_gains" not in file:
        return None
    table = file.table("flight_gains")
    read = FlightGains(
        k_phi=table.number("k_phi_1_s", at_least=0.0),
        kp=table.number("kp_s_rad", at_least=0.0),
        ki=table.number("ki_1_rad", at_least=0.0),
        kd=table.number("kd_s2_rad", at_least=0.0),
    )
    table.finish()
    return read


def _assumptions(file: KeyedTable) -> Assumptions:
    if "assumptions" not in file:
        return Assumptions()
    usual = Assumptions()
    table = file.table("assumptions")
    read = Assumptions(
        motor_lag_s=table.number("motor_lag_s", usual.motor_lag_s, at_least=0.0, at_most=0.5),
        hover_thrust=table.number("hover_thrust", usual.hover_thrust, above=0.05, below=0.95),
        heave_damping_1_s=table.number("heave_damping_1_s", usual.heave_damping_1_s, at_least=0.0),
        yaw_gain_rad_s2=table.number("yaw_gain_rad_s2", usual.yaw_gain_rad_s2, above=0.0),
        yaw_damping_1_s=table.number("yaw_damping_1_s", usual.yaw_damping_1_s, at_least=0.0),
    )
    table.finish()
    return read


def _rotors(file: KeyedTable, layout: str) -> tuple[Rotor, ...]:
    if layout not in LAYOUTS:
        raise file.error(
            "layout",
            f'unknown layout "{layout}"{nearest(layout, LAYOUTS)}',
            f'Use one of {", ".join(LAYOUTS)} ("custom" for any other list of rotors)',
        )
    tables = file.tables("rotors")
    count = LAYOUTS[layout]
    if count is not None and len(tables) != count:
        raise file.error("rotors", f'layout "{layout}" has {count} rotors, the file lists {len(tables)}')
    if not MIN_ROTORS <= len(tables) <= MAX_ROTORS:
        raise file.error("rotors", f"{len(tables)} rotors", f"Give {MIN_ROTORS} to {MAX_ROTORS}")
    rotors: list[Rotor] = []
    for table in tables:
        rotor = Rotor(
            px_m=table.number("px_m", at_least=-100.0, at_most=100.0),
            py_m=table.number("py_m", at_least=-100.0, at_most=100.0),
            pz_m=table.number("pz_m", 0.0, at_least=-100.0, at_most=100.0),
            km=table.number("km", at_least=-1.0, at_most=1.0),
        )
        table.finish()
        # Coaxial rotors may share a place as long as they turn against each other.
        for other, seen in enumerate(rotors):
            same_place = (seen.px_m, seen.py_m, seen.pz_m) == (rotor.px_m, rotor.py_m, rotor.pz_m)
            if same_place and seen.km * rotor.km >= 0.0:
                place = f"rotors[{len(rotors)}]"
                raise file.error(place, f"at the place of rotors[{other}] and turning the same way")
        rotors.append(rotor)
    _check_authority(file, rotors)
    return tuple(rotors)


def _check_authority(file: KeyedTable, rotors: list[Rotor]) -> None:
    """Refuse rotors that cannot command roll, pitch, yaw and thrust independently of one another.

    Three rotors are let through without yaw: they hold attitude, and the plant's yaw stays passive.
    """
    longest = {"roll": max(abs(r.py_m) for r in rotors), "pitch": max(abs(r.px_m) for r in rotors)}
    for axis, arm in longest.items():
        if arm <= MIN_ARM_M:
            raise file.error(
                "rotors",
                f"longest {axis} arm {arm:g} m, PX4 drops an axis at {MIN_ARM_M:.4f} m or less",
                "Give positions in metres",
            )
    effect = np.array([[r.py_m, r.px_m, r.km, 1.0] for r in rotors])
    scale = np.maximum(np.abs(effect).max(axis=0), 1e-12)
    if np.linalg.matrix_rank(effect / scale, tol=1e-6) < min(4, len(rotors)):
        raise file.error(
            "rotors",
            "they cannot command roll, pitch, yaw and thrust independently",
            "Check the signs of px_m, py_m and km",
        )
