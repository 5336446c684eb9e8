"""The kinds of fault: their keys with the ranges of them, what they happen to, what they are called."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from sitl.errors import UsageError
from sitl.keyed_table import KeyedTable, nearest

Settings = Mapping[str, Any]

DIRECTIONS = {"both": "both ways", "to_vehicle": "to the vehicle", "from_vehicle": "from the vehicle"}
GYRO_AXES = ("all", "roll", "pitch", "yaw")
MOST_MOTORS = 12
MOST_DELAY_TICKS = 32


class Where(Enum):
    """What a fault happens to."""

    BODY = "plant and sensors"
    LINK = "link"
    PARAMETER = "parameters"
    AUTOPILOT = "autopilot"


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes:
        where: what it happens to. read: takes its keys. text: what it is, in a few words.
        lasts_by_itself: what to write instead of duration_s, if that means nothing here; else empty.
    """

    where: Where
    read: Callable[[_Keys], None]
    text: Callable[[Settings], str]
    lasts_by_itself: str = ""


class _Keys:
    """Reads a fault's own keys and remembers them with the defaults filled in."""

    def __init__(self, table: KeyedTable) -> None:
        self.table = table
        self.read: dict[str, Any] = {}

    def number(self, key: str, default: float | None = None, **bounds: float) -> float:
        """A number within bounds."""
        value = self.table.number(key, default, **bounds)
        self.read[key] = value
        return value

    def percent(self, key: str, *, most: float = 100.0) -> None:
        """A share in %, above 0."""
        self.number(key, above=0.0, at_most=most)

    def whole(self, key: str, *, at_least: int, at_most: int) -> None:
        """A whole number."""
        value = self.table.number(key, at_least=float(at_least), at_most=float(at_most))
        if value != int(value):
            raise self.table.error(key, f"{value:g} is not a whole number", "Write a whole number")
        self.read[key] = int(value)

    def motor(self, *, one: bool) -> None:
        """A motor's number, from 1 in PX4's order; `one`: it must be given, else all are meant without it."""
        if one or "motor" in self.table:
            self.whole("motor", at_least=1, at_most=MOST_MOTORS)

    def choice(self, key: str, known: Mapping[str, str] | tuple[str, ...]) -> None:
        """One of several words, the first if the key is not there."""
        value = self.table.text(key, next(iter(known)))
        if value not in known:
            problem = f'"{value}" is not known{nearest(value, known)}'
            raise self.table.error(key, problem, f"Known: {', '.join(known)}")
        self.read[key] = value


def read_settings(kind: str, table: KeyedTable) -> dict[str, Any]:
    """The keys of one kind.

    Args:
        kind: of `KINDS`. table: the fault's.

    Raises:
        FileError: one is missing, out of range or not what it must be.
    """
    keys = _Keys(table)
    KINDS[kind].read(keys)
    return keys.read


# -- plant and sensors -------------------------------------------------------------------------------------------------


def _gust(keys: _Keys) -> None:
    pushes = [
        keys.number("side_force_n", 0.0, at_least=-1000.0, at_most=1000.0),
        keys.number("roll_accel_deg_s2", 0.0, at_least=-1e5, at_most=1e5),
        keys.number("wind_m_s", 0.0, at_least=-40.0, at_most=40.0),
    ]
    if not any(pushes):
        remedy = "Give side_force_n, roll_accel_deg_s2 or wind_m_s, above 0 to the right"
        raise keys.table.error("side_force_n", "nothing pushes", remedy)


def _gust_text(s: Settings) -> str:
    parts = [f"{s['side_force_n']:+g} N sideways"] if s["side_force_n"] else []
    parts += [f"{s['roll_accel_deg_s2']:+g} deg/s^2 of roll"] if s["roll_accel_deg_s2"] else []
    parts += [f"{s['wind_m_s']:+g} m/s of wind"] if s["wind_m_s"] else []
    return "gust of " + ", ".join(parts)


def _motor_efficiency(keys: _Keys) -> None:
    keys.motor(one=False)
    keys.number("efficiency_pct", at_least=0.0, below=100.0)


def _motor_saturation(keys: _Keys) -> None:
    keys.motor(one=False)
    keys.number("most_pct", at_least=0.0, below=100.0)


def _motors(s: Settings) -> str:
    return f"motor {s['motor']}" if "motor" in s else "all motors"


def _gyro(key: str, most: float) -> Callable[[_Keys], None]:
    def read(keys: _Keys) -> None:
        if key == "bias_deg_s":
            keys.number(key, at_least=-most, at_most=most)
            if not keys.read[key]:
                raise keys.table.error(key, "0 is no bias", "Give an angular rate")
        else:
            keys.number(key, above=0.0, at_most=most)
        keys.choice("axis", GYRO_AXES)

    return read


def _axis(s: Settings) -> str:
    return "" if s["axis"] == "all" else f" in {s['axis']}"


# -- link --------------------------------------------------------------------------------------------------------------


def _link(key: str) -> Callable[[_Keys], None]:
    def read(keys: _Keys) -> None:
        if key.endswith("_pct"):
            keys.percent(key)
        else:
            keys.number(key, above=0.0, at_most=2.0)
        keys.choice("direction", DIRECTIONS)

    return read


def _share(what: str, key: str = "share_pct") -> Callable[[Settings], str]:
    return lambda s: f"link {what} {s[key]:g} % {DIRECTIONS[s['direction']]}"


# -- autopilot ---------------------------------------------------------------------------------------------------------


def _parameter(keys: _Keys) -> None:
    from sitl.parameters import ParameterTable, to_raw

    name = keys.table.text("parameter")
    known = ParameterTable()
    if name not in known:
        problem = f"no parameter {name}{nearest(name, known.names)}"
        raise keys.table.error("parameter", problem, "PX4's names, such as IMU_GYRO_CUTOFF")
    value = keys.table.number("value")
    if known.spec(name).type != "REAL32":
        if value != int(value):
            raise keys.table.error("value", f"{value:g} is not a whole number, as {name} is", "Write a whole number")
        value = int(value)
    try:
        to_raw(name, known.spec(name).type, value)
    except UsageError as error:
        raise keys.table.error("value", str(error)) from error
    keys.read |= {"parameter": name, "value": value}


def _restart(keys: _Keys) -> None:
    keys.number("boot_s", 3.0, at_least=0.1, at_most=60.0)


KINDS: Mapping[str, Kind] = {
    "gust": Kind(Where.BODY, _gust, _gust_text),
    "motor_efficiency": Kind(
        Where.BODY, _motor_efficiency, lambda s: f"{_motors(s)} at {s['efficiency_pct']:g} % efficiency"
    ),
    "motor_out": Kind(Where.BODY, lambda keys: keys.motor(one=True), lambda s: f"{_motors(s)} out"),
    "motor_saturation": Kind(
        Where.BODY, _motor_saturation, lambda s: f"{_motors(s)} limited to {s['most_pct']:g} % of full thrust"
    ),
    "battery_sag": Kind(
        Where.BODY, lambda keys: keys.percent("sag_pct", most=90.0), lambda s: f"battery sag of {s['sag_pct']:g} %"
    ),
    "gyro_noise": Kind(
        Where.BODY, _gyro("noise_deg_s", 500.0), lambda s: f"gyro noise of {s['noise_deg_s']:g} deg/s{_axis(s)}"
    ),
    "gyro_bias": Kind(
        Where.BODY, _gyro("bias_deg_s", 500.0), lambda s: f"gyro bias of {s['bias_deg_s']:g} deg/s{_axis(s)}"
    ),
    "gyro_dropout": Kind(
        Where.BODY, _gyro("loss_pct", 100.0), lambda s: f"gyro loses {s['loss_pct']:g} % of its samples{_axis(s)}"
    ),
    "gyro_stuck": Kind(Where.BODY, lambda keys: keys.choice("axis", GYRO_AXES), lambda s: f"gyro stuck{_axis(s)}"),
    "loop_delay": Kind(
        Where.BODY,
        lambda keys: keys.whole("delay_ticks", at_least=1, at_most=MOST_DELAY_TICKS),
        lambda s: f"motor commands {s['delay_ticks']} ticks later",
    ),
    "link_loss": Kind(Where.LINK, _link("loss_pct"), _share("loses", "loss_pct")),
    "link_delay": Kind(
        Where.LINK, _link("delay_s"), lambda s: f"link {s['delay_s']:g} s late {DIRECTIONS[s['direction']]}"
    ),
    "link_jitter": Kind(
        Where.LINK, _link("jitter_s"), lambda s: f"link up to {s['jitter_s']:g} s late {DIRECTIONS[s['direction']]}"
    ),
    "link_duplication": Kind(Where.LINK, _link("share_pct"), _share("doubles")),
    "link_reordering": Kind(Where.LINK, _link("share_pct"), _share("reorders")),
    "link_corruption": Kind(Where.LINK, _link("share_pct"), _share("corrupts")),
    "parameter": Kind(Where.PARAMETER, _parameter, lambda s: f"{s['parameter']} set to {s['value']:g}"),
    "autopilot_restart": Kind(
        Where.AUTOPILOT,
        _restart,
        lambda s: f"autopilot restart of {s['boot_s']:g} s",
        lasts_by_itself="Write boot_s, how long it says nothing",
    ),
}
