"""PX4's ULog, its own or ours, as a recorded flight. pyulog reads the format; what it trips over is told in a line."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bridge.clock import utc_stamp
from scenarios.flight import Event
from scenarios.flight_import.recorded import Change, Recorded, Signals, record
from scenarios.flight_import.series import Series, euler
from sitl.airframe import Rotor
from sitl.errors import FileError
from sitl.plain_file import check_plain

if TYPE_CHECKING:
    from pyulog import ULog

TOPICS: Final = (
    "vehicle_attitude",
    "vehicle_attitude_groundtruth",
    "vehicle_angular_velocity",
    "vehicle_angular_velocity_groundtruth",
    "vehicle_attitude_setpoint",
    "vehicle_rates_setpoint",
    "vehicle_torque_setpoint",
    "vehicle_local_position",
    "vehicle_status",
    "vehicle_land_detected",
    "actuator_motors",
    "actuator_outputs",
    "actuator_controls_0",
)
"""The last one, and rates in vehicle_attitude, are those of a PX4 before 1.13 and 1.10."""
_ARMED_STATE = 2
_FIXED_WING, _ROVER = 2, 3
LARGEST = 4_000_000_000
"""Bytes of a log that is read: some days of flight."""
MOST_FIELDS: Final = 200_000
"""Of all topics of a log together; a PX4's has some thousands."""
_READ_FACTOR = 40
"""Bytes that may be read for each byte of the file: pyulog steps back in damaged ones, now and then for ever."""
_REMEDY = "Fetch the log from the vehicle again"


class _Watched(io.BytesIO):
    """A file in memory that notices a reader which goes in circles."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._left = _READ_FACTOR * (len(data) + 4096)

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self._left -= len(data) + 1
        if self._left < 0:
            raise EOFError
        return data


def read_ulog(path: Path, *, rotors: tuple[Rotor, ...] = ()) -> Recorded:
    """Read a ULog.

    Args:
        path: of the file. rotors: geometry to use where the log has none.

    Raises:
        FileError: not a ULog, damaged beyond use, without attitude, of no multirotor, or never armed.
    """
    log = _parse(path)
    notes = []
    if log.file_corruption:
        notes.append("the file is damaged: what could be read of it is used")
    if log.dropouts:
        lost_s = 1e-3 * sum(float(one.duration) for one in log.dropouts)
        notes.append(f"{len(log.dropouts)} dropouts in the log, {lost_s:.2g} s in all: what was lost is a gap")
    attitude = _series(log, "vehicle_attitude", ("q[0]", "q[1]", "q[2]", "q[3]"))
    if attitude is None:
        there = sorted({one.name for one in log.data_list})
        seen = f"it has {', '.join(there[:6])}" if there else "it has no topic that is needed"
        raise FileError(
            path,
            f"has no vehicle_attitude ({seen})",
            "Log with PX4's default topics: SDLOG_PROFILE with bit 0, better 17",
        )
    _check_vehicle(path, log)
    setpoint = _series(log, "vehicle_attitude_setpoint", ("q_d[0]", "q_d[1]", "q_d[2]", "q_d[3]"))
    rates_sp = _series(log, "vehicle_rates_setpoint", ("roll", "pitch", "yaw"))
    thrust = _series(log, "vehicle_rates_setpoint", ("thrust_body[2]",))
    true_attitude = _series(log, "vehicle_attitude_groundtruth", ("q[0]", "q[1]", "q[2]", "q[3]"))
    armed = _series(log, "vehicle_status", ("arming_state",))
    signals = Signals(
        attitude=_angles(attitude),
        rates=_series(log, "vehicle_angular_velocity", ("xyz[0]", "xyz[1]", "xyz[2]"))
        or _series(log, "vehicle_attitude", ("rollspeed", "pitchspeed", "yawspeed")),
        true_attitude=None if true_attitude is None else _angles(true_attitude),
        true_rates=_series(log, "vehicle_angular_velocity_groundtruth", ("xyz[0]", "xyz[1]", "xyz[2]")),
        setpoint=None if setpoint is None else _angles(setpoint),
        rates_setpoint=rates_sp,
        thrust=None if thrust is None else Series(thrust.t_s, -thrust.values),
        position=_series(log, "vehicle_local_position", ("x", "y", "z", "vx", "vy", "vz")),
        motors=_motors(log, notes),
        torque=_series(log, "vehicle_torque_setpoint", ("xyz[0]", "xyz[1]"))
        or _series(log, "actuator_controls_0", ("control[0]", "control[1]")),
        state=_series(log, "vehicle_status", ("nav_state",)),
        armed=None if armed is None else Series(armed.t_s, (armed.values == _ARMED_STATE).astype(np.float64)),
        landed=_series(log, "vehicle_land_detected", ("landed",)),
    )
    if signals.armed is None:
        raise FileError(path, "has no vehicle_status: whether it armed is not known", _REMEDY)
    texts = [Event(1e-6 * one.timestamp, _severity(one), str(one.message)) for one in log.logged_messages]
    return record(
        path,
        "ULog",
        signals,
        _changes(log),
        rotors=rotors,
        events=texts,
        facts=_facts(log.msg_info_dict),
        notes=notes,
    )


def _bounded_reader() -> type[ULog]:
    """The reader of pyulog, but for topics within topics that a few lines of a file make grow beyond any memory."""
    from pyulog import ULog

    left = MOST_FIELDS

    class Topic(ULog._MessageAddLogged):  # type: ignore[misc]
        """A topic with its fields, nested ones laid out flat."""

        def _parse_nested_type(self, prefix_str: str, type_name: str, message_formats: Mapping[str, Any]) -> None:
            nonlocal left
            # an empty nested topic costs its turn, too
            left -= 1 + sum(max(1, count) for _, count, _ in message_formats[type_name].fields)
            if left < 0:
                raise ValueError(f"its topics have more than {MOST_FIELDS} fields")
            super()._parse_nested_type(prefix_str, type_name, message_formats)

    class Reader(ULog):  # type: ignore[misc]
        """pyulog's, with such topics."""

        _MessageAddLogged = Topic

    return Reader


def _parse(path: Path) -> ULog:
    check_plain(path, LARGEST)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FileError(path, f"cannot be read: {error.strerror or error}", "Give the path of a .ulg file") from error
    if not data:
        raise FileError(path, "is empty", _REMEDY)
    # pyulog prints what it thinks of a file
    with contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
        try:
            return _bounded_reader()(_Watched(data), list(TOPICS))
        except Exception as error:  # pyulog has no list of what damaged files make it raise
            reason = str(error) or "its messages do not fit together"
            raise FileError(path, f"is no ULog that can be read: {reason}", _REMEDY) from error


def _series(log: ULog, topic: str, fields: tuple[str, ...]) -> Series | None:
    """The first instance of a topic, on the time of its sample where it tells it; None if the log has none."""
    for data in log.data_list:
        if data.name != topic or any(name not in data.data for name in ("timestamp", *fields)):
            continue
        stamp = data.data["timestamp"]
        if "timestamp_sample" in data.data:
            sampled = data.data["timestamp_sample"]
            # a topic that does not fill it in leaves it at zero
            stamp = np.where(sampled > 0, sampled, stamp)
        if not len(stamp):
            continue
        series = Series.of(stamp.astype(np.float64) * 1e-6, np.column_stack([data.data[name] for name in fields]))
        return series if len(series) else None
    return None


def _angles(series: Series) -> Series:
    values = series.values
    norm = np.linalg.norm(values, axis=1)
    # a sample that is no rotation was damaged, or never set
    whole = np.isfinite(norm) & (np.abs(norm - 1.0) < 0.1)
    return Series(series.t_s[whole], euler(values[whole]), series.dropped)


def _motors(log: ULog, notes: list[str]) -> Series | None:
    """Commands from 0 to 1: actuator_motors; else the outputs, PWM in us or a simulator's own 0 to 1."""
    names = tuple(f"control[{n}]" for n in range(12))
    motors = _series(log, "actuator_motors", names)
    if motors is not None:
        return _used(motors)
    outputs = _series(log, "actuator_outputs", tuple(f"output[{n}]" for n in range(8)))
    if outputs is None:
        return None
    values = outputs.values
    if np.nanmax(np.abs(values), initial=0.0) > 100.0:
        values = np.where(values > 800.0, np.clip((values - 1000.0) / 1000.0, 0.0, 1.0), np.nan)
        notes.append("motors are PWM outputs, 1000 to 2000 us taken as 0 to 1")
    else:
        notes.append("motors are actuator_outputs, in the order of the outputs")
    return _used(Series(outputs.t_s, values))


def _used(series: Series) -> Series:
    """Without the columns in which nothing ever was."""
    used = np.flatnonzero(np.isfinite(series.values).any(axis=0))
    count = int(used[-1]) + 1 if len(used) else 0
    return Series(series.t_s, series.values[:, : max(count, 1)])


def _check_vehicle(path: Path, log: ULog) -> None:
    kinds = _series(log, "vehicle_status", ("vehicle_type",))
    if kinds is None:
        return
    kind = int(np.median(kinds.values[:, 0])) if len(kinds) else 0
    if kind in (_FIXED_WING, _ROVER):
        name = {_FIXED_WING: "a fixed wing", _ROVER: "a rover"}[kind]
        raise FileError(
            path, f"is the flight of {name} (vehicle_type {kind})", "Only multirotors are reviewed: give the log of one"
        )


def _changes(log: ULog) -> list[Change]:
    first = [Change(-math.inf, str(name), value) for name, value in log.initial_parameters.items()]
    later = [Change(1e-6 * float(stamp), str(name), value) for stamp, name, value in log.changed_parameters]
    return [one for one in (*first, *later) if isinstance(one.value, int | float) and math.isfinite(one.value)]


def _severity(message: Any) -> int:
    level = int(message.log_level) - ord("0")
    return min(max(level, 0), 7)


def _facts(info: Mapping[str, Any]) -> dict[str, str]:
    names = {"sys_name": "software", "ver_sw": "revision", "ver_hw": "hardware", "sys_mcu": "processor"}
    facts = {name: str(info[key]) for key, name in names.items() if key in info}
    boot_us = info.get("boot_time_utc_us", 0)
    if isinstance(boot_us, int) and 0 < boot_us < 2**52:
        facts["boot_utc"] = utc_stamp(boot_us)
    return facts
