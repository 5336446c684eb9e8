"""A .tlog, PX4's or ours, as a recorded flight: the frames of the autopilot that flew, in its own vehicle time."""

from __future__ import annotations

import math
import struct
from array import array
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from bridge.connection import Connection, Message
from bridge.px4_modes import PX4_MODES
from scenarios.flight import Event
from scenarios.flight_import.recorded import Change, Recorded, Signals, Value, record
from scenarios.flight_import.series import FloatArray, Series, euler
from sitl.airframe import Rotor
from sitl.errors import FileError
from sitl.plain_file import check_plain

_NO_AUTOPILOT, _PX4 = 8, 12
_NAMES: Final = {_PX4: "PX4", 3: "ArduPilot"}
_MULTIROTORS: Final = (2, 3, 4, 13, 14, 15, 29, 35, 43)
_AUTOPILOT_TYPES: Final = {1: "a fixed wing", 10: "a rover", 11: "a boat", 12: "a submarine"}
_ARMED = 128
_INTEGERS: Final = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}
"""MAV_PARAM_TYPE -> how PX4 puts it into the float's four bytes."""
_NAV_STATES: Final = {mode.custom_mode: state for state, mode in reversed(PX4_MODES.items())}
_RESTART_S = 1.0
"""Vehicle time that goes back by more than this is another boot."""
LARGEST = 4_000_000_000
"""Bytes of a log that is read: some days of telemetry."""
_CHUNK = 1 << 16
_STAMP = 8
_REMEDY = "Record a flight with ATTITUDE and ATTITUDE_TARGET at 20 Hz or more"


class _Rows:
    """Samples of one signal as flat numbers."""

    def __init__(self) -> None:
        self._t = array("d")
        self._values = array("d")

    def add(self, t_s: float, values: Sequence[float]) -> None:
        self._t.append(t_s)
        self._values.extend(values)

    def series(self) -> Series | None:
        if not len(self._t):
            return None
        return Series.of(np.array(self._t), np.array(self._values).reshape(len(self._t), -1))


class _Boot:
    """What one system sent from one start to the next."""

    def __init__(self) -> None:
        self.now_s = -math.inf
        self.armed = False
        self.armed_since_s = math.nan
        self.armed_s = 0.0
        names = ("attitude", "rates", "true", "true_rates", "setpoint", "rates_sp", "thrust", "position", "motors")
        self.rows = {name: _Rows() for name in (*names, "state", "armed", "landed")}
        self.events: list[Event] = []
        self.changes: list[Change] = []


class _System:
    """An autopilot's messages, boot by boot."""

    def __init__(self) -> None:
        self.type = self.autopilot = 0
        self.boots = [_Boot()]

    @property
    def flown(self) -> _Boot:
        """The boot that was armed longest."""
        return max(self.boots, key=lambda boot: boot.armed_s)

    def take(self, m: Message) -> None:
        """Sort one message of the autopilot in."""
        take = _HANDLERS.get(m.name)
        if take is not None:
            take(self, self._boot(m), m)

    def _boot(self, m: Message) -> _Boot:
        """The present boot, its clock set by the messages that tell the time."""
        boot = self.boots[-1]
        time_ms = m.get("time_boot_ms")
        if m.name in _TIMED and time_ms is not None:
            t_s = 1e-3 * time_ms
            if t_s < boot.now_s - _RESTART_S:
                boot = _Boot()
                self.boots.append(boot)
            boot.now_s = max(boot.now_s, t_s)
        return boot

    def attitude(self, boot: _Boot, m: Message) -> None:
        t_s = 1e-3 * m.time_boot_ms
        boot.rows["attitude"].add(t_s, (m.roll, m.pitch, m.yaw))
        boot.rows["rates"].add(t_s, (m.rollspeed, m.pitchspeed, m.yawspeed))
        if boot.armed:
            boot.armed_s += max(0.0, min(0.5, t_s - boot.armed_since_s)) if math.isfinite(boot.armed_since_s) else 0.0
            boot.armed_since_s = t_s

    def target(self, boot: _Boot, m: Message) -> None:
        t_s = 1e-3 * m.time_boot_ms
        boot.rows["setpoint"].add(t_s, m.q)
        boot.rows["rates_sp"].add(t_s, (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate))
        boot.rows["thrust"].add(t_s, (m.thrust,))

    def position(self, boot: _Boot, m: Message) -> None:
        boot.rows["position"].add(1e-3 * m.time_boot_ms, (m.x, m.y, m.z, m.vx, m.vy, m.vz))

    def motors(self, boot: _Boot, m: Message) -> None:
        boot.rows["motors"].add(_stamped(boot, m.time_usec), m.controls[:12])

    def truth(self, boot: _Boot, m: Message) -> None:
        t_s = _stamped(boot, m.time_usec)
        boot.rows["true"].add(t_s, m.attitude_quaternion)
        boot.rows["true_rates"].add(t_s, (m.rollspeed, m.pitchspeed, m.yawspeed))

    def heartbeat(self, boot: _Boot, m: Message) -> None:
        self.type, self.autopilot = m.type, m.autopilot
        armed = bool(m.base_mode & _ARMED)
        if armed and not boot.armed:
            boot.armed_since_s = math.nan
        boot.armed = armed
        self.mode(boot, m)
        if math.isfinite(boot.now_s):
            boot.rows["armed"].add(boot.now_s, (float(armed),))

    def mode(self, boot: _Boot, m: Message) -> None:
        if self.autopilot == _PX4 and math.isfinite(boot.now_s):
            boot.rows["state"].add(boot.now_s, (_NAV_STATES.get(m.custom_mode, -1),))

    def landed(self, boot: _Boot, m: Message) -> None:
        if math.isfinite(boot.now_s) and m.landed_state:
            boot.rows["landed"].add(boot.now_s, (float(m.landed_state == 1),))

    def text(self, boot: _Boot, m: Message) -> None:
        boot.events.append(Event(max(boot.now_s, 0.0), min(m.severity, 7), m.text))

    def parameter(self, boot: _Boot, m: Message) -> None:
        value = _parameter(m, bytewise=self.autopilot == _PX4)
        if value is not None and math.isfinite(value):
            boot.changes.append(Change(boot.now_s, m.param_id, value))


_TIMED: Final = ("ATTITUDE", "ATTITUDE_TARGET", "LOCAL_POSITION_NED")
_HANDLERS: Final = {
    "ATTITUDE": _System.attitude,
    "ATTITUDE_TARGET": _System.target,
    "LOCAL_POSITION_NED": _System.position,
    "HIL_ACTUATOR_CONTROLS": _System.motors,
    "HIL_STATE_QUATERNION": _System.truth,
    "HEARTBEAT": _System.heartbeat,
    "CURRENT_MODE": _System.mode,
    "EXTENDED_SYS_STATE": _System.landed,
    "STATUSTEXT": _System.text,
    "PARAM_VALUE": _System.parameter,
}


def _stamped(boot: _Boot, time_us: int) -> float:
    """Vehicle time of a message that counts in us; some senders count from another start."""
    t_s = 1e-6 * time_us
    return t_s if abs(t_s - boot.now_s) < _RESTART_S else boot.now_s


def _parameter(m: Message, *, bytewise: bool) -> Value | None:
    code = _INTEGERS.get(m.param_type)
    if code is None:
        return float(m.param_value)
    if not bytewise:
        return int(m.param_value) if math.isfinite(m.param_value) else None
    return int(struct.unpack_from(code, m.raw("param_value"))[0])


def read_tlog(path: Path, *, system: int | None = None, rotors: tuple[Rotor, ...] = ()) -> Recorded:
    """Read a .tlog.

    Args:
        path: of the file. system: MAVLink system that is meant; None: the one that flew.
        rotors: geometry to use where the log has none.

    Raises:
        FileError: no MAVLink in it, no autopilot, none that armed, or several that flew.
    """
    systems, seen, notes = _read(path)
    number = _chosen(path, systems, seen, system)
    one = systems[number]
    if one.type in _AUTOPILOT_TYPES:
        what = f"system {number} is {_AUTOPILOT_TYPES[one.type]} (MAV_TYPE {one.type})"
        raise FileError(path, what, "Only multirotors are reviewed: give the log of one")
    if one.type not in _MULTIROTORS:
        notes.append(f"system {number} has MAV_TYPE {one.type}: taken for a multirotor")
    boot = one.flown
    rows = {name: found.series() for name, found in boot.rows.items()}
    attitude = rows["attitude"]
    if attitude is None:
        raise FileError(path, f"has no ATTITUDE of system {number}: {_counted(seen, number)}", _REMEDY)
    if len(one.boots) > 1:
        notes.append(f"time went backwards {len(one.boots) - 1} times (restarts): the longest flight is looked at")
    if rows["setpoint"] is None:
        notes.append("no ATTITUDE_TARGET: the roll set-point is not known")
    earlier = [change for other in one.boots[: one.boots.index(boot)] for change in other.changes]
    changes = [Change(-math.inf, change.name, change.value) for change in earlier] + boot.changes
    true, setpoint = rows["true"], rows["setpoint"]
    signals = Signals(
        attitude=attitude,
        rates=rows["rates"],
        true_attitude=None if true is None else Series(true.t_s, euler(true.values)),
        true_rates=rows["true_rates"],
        setpoint=None if setpoint is None else Series(setpoint.t_s, euler(setpoint.values)),
        rates_setpoint=rows["rates_sp"],
        thrust=rows["thrust"],
        position=rows["position"],
        motors=_motors(rows["motors"], changes, rotors),
        state=rows["state"],
        armed=rows["armed"],
        landed=rows["landed"],
    )
    return record(
        path,
        "tlog",
        signals,
        changes,
        rotors=rotors,
        events=boot.events,
        facts={"system": str(number), "autopilot": _NAMES.get(one.autopilot, f"MAV_AUTOPILOT {one.autopilot}")},
        notes=notes,
    )


def _read(path: Path) -> tuple[dict[int, _System], Counter[tuple[int, str]], list[str]]:
    """Autopilots by system, messages seen by (system, name), and what is to be said of the file."""
    systems: dict[int, _System] = {}
    components: dict[int, int] = {}
    seen: Counter[tuple[int, str]] = Counter()
    connection = Connection(255, 190)
    size = 0

    def take(messages: list[Message]) -> None:
        for m in messages:
            seen[m.sysid, m.name] += 1
            if m.name == "HEARTBEAT" and m.autopilot != _NO_AUTOPILOT and m.sysid not in components:
                components[m.sysid], systems[m.sysid] = m.compid, _System()
            if components.get(m.sysid) == m.compid:
                systems[m.sysid].take(m)

    check_plain(path, LARGEST)
    try:
        with path.open("rb") as file:
            while data := file.read(_CHUNK):
                size += len(data)
                take(connection.receive(data))
        take(connection.flush())
    except OSError as error:
        raise FileError(path, f"cannot be read: {error.strerror or error}", "Give the path of a .tlog file") from error
    if not size:
        raise FileError(path, "is empty", "Record the flight again")
    counters = connection.counters
    if not counters.received:
        raise FileError(
            path, f"no MAVLink message in its {size} bytes", "Give a .tlog of a ground station or of froude"
        )
    bad = counters.bad_bytes - _STAMP * (counters.received + counters.unknown)
    notes = [f"{bad} bytes of the log are damaged and were left out"] if bad > _STAMP else []
    return systems, seen, notes


def _chosen(path: Path, systems: dict[int, _System], seen: Counter[tuple[int, str]], system: int | None) -> int:
    """The system that is looked at."""
    if system is not None:
        if system not in systems:
            there = ", ".join(map(str, sorted(systems))) or "none"
            raise FileError(path, f"--system {system}: no autopilot of that number; there is {there}", "Name another")
        return system
    if not systems:
        total = sum(seen.values())
        raise FileError(path, f"no autopilot's HEARTBEAT among {total} messages", "Give the log of a vehicle's link")
    flew = [number for number, one in systems.items() if one.flown.armed_s > 0.0]
    if len(flew) == 1:
        return flew[0]
    if flew:
        names = ", ".join(map(str, sorted(flew)))
        raise FileError(path, f"systems {names} all flew in it", f"Say which is meant: --system {min(flew)}")
    if len(systems) == 1:
        (number,) = systems
        if not any(one.boots[-1].rows["attitude"].series() for one in systems.values()):
            raise FileError(path, f"has no ATTITUDE of system {number}: {_counted(seen, number)}", _REMEDY)
        return number
    names = ", ".join(map(str, sorted(systems)))
    raise FileError(path, f"none of the systems {names} armed: nothing was flown", "Give the log of a flight")


def _counted(seen: Counter[tuple[int, str]], number: int) -> str:
    names = Counter({name: count for (sysid, name), count in seen.items() if sysid == number})
    return ", ".join(f"{count} {name}" for name, count in names.most_common(3))


def _motors(motors: Series | None, changes: Sequence[Change], rotors: Sequence[Rotor]) -> Series | None:
    """The columns that are motors: as many as the geometry has, else those that ever turned."""
    if motors is None:
        return None
    counts = [int(change.value) for change in changes if change.name == "CA_ROTOR_COUNT"] or [len(rotors)]
    values: FloatArray = motors.values
    turned = np.flatnonzero((np.abs(np.nan_to_num(values)) > 1e-6).any(axis=0))
    count = counts[-1] or (int(turned[-1]) + 1 if len(turned) else 1)
    return Series(motors.t_s, values[:, : min(max(count, 1), values.shape[1])])
