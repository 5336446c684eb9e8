"""ParameterFile: a vehicle's parameters on disk, so that they outlive its process, and PREFLIGHT_STORAGE.

    file = ParameterFile(path, table, system_id)    # reads it, if it is there; a damaged file is refused
    for text in file.notices: ...                   # names that this vehicle does not have
    file.poll(now_us)                               # every few ms: writes a little after the last change
    file.close()

What differs from the vehicle's defaults is kept, one line each, in the form of QGroundControl's .params files. A
file is written beside the old one, synced, and put in its place in one step: whatever happens, one of the two is there.
Source of the behaviour: PX4 src/lib/parameters (param_load_default, autosave) and Commander's worker thread.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from bridge.param_operation import ParamValue
from bridge.param_protocol import TYPE_NUMBERS
from sitl.errors import FileError, UsageError
from sitl.parameters import NAME_LENGTH, ParameterTable, ParameterType, from_raw, to_raw

SAVE_DELAY_US: Final = 300_000
"""Time from a change to its being written, us, so that a burst of changes is written once (PX4's autosave)."""

SAVE_PERIOD_US: Final = 500_000
"""Least time between two writes, us."""

RETRY_US: Final = 5_000_000
"""Time from a write that failed to the next attempt, us."""

KEPT_AT_RESET: Final = ("COM_FLIGHT_UUID", "LND_FLIGHT_T_HI", "LND_FLIGHT_T_LO")
"""What resetting the configuration leaves alone: the vehicle's history (PX4 ParamResetAllConfig)."""

SENSOR_CALIBRATION: Final = ("CAL_ACC", "CAL_GYRO", "CAL_MAG")
"""How names begin that a reset of the sensors' calibration is about (PX4 ParamResetSensorFactory)."""

_LARGEST_REAL32: Final = 3.4028235e38
_LARGEST_FILE: Final = 1_000_000
_COLUMNS: Final = ("vehicle", "component", "name", "value", "type")
_NAME: Final = re.compile(rf"[A-Za-z0-9_]{{1,{NAME_LENGTH}}}\Z")
_RAW: Final = re.compile(r"0x[0-9a-fA-F]{8}\Z")
_WHOLE: Final = re.compile(r"[+-]?\d{1,10}\Z", re.ASCII)
_REAL: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?\Z|[+-]?inf\Z|nan\Z", re.ASCII)
_REMEDY: Final = "Correct it, or move the file away to start from the defaults; nothing has been overwritten"
_HEADER: Final = (
    "# Parameters of a simulated vehicle that differ from its defaults, kept by froude.",
    "# A value like 0x7fc00001 is the four bytes of a number that no other text gives exactly.",
    "#",
    "# Vehicle-Id Component-Id Name Value Type",
)


@dataclass(frozen=True, slots=True)
class StoredParameters:
    """What a file holds."""

    raws: dict[str, bytes]
    """Name -> four bytes, of parameters that the vehicle has."""
    strangers: dict[str, str]
    """Name -> line, of parameters that it does not have: those of another version, say."""


class StorageAnswer(NamedTuple):
    """What became of a PREFLIGHT_STORAGE."""

    acknowledged: bool
    """Accepted; False: nothing PX4 knows, which it does not answer."""
    problem: str
    """What did not work although it was accepted, for a STATUSTEXT; empty if all went well."""


def read_parameters(path: Path, table: ParameterTable) -> StoredParameters:
    """Parameters of a file; nothing if there is no file.

    Args:
        path: the file. table: which names and types there are; it is not changed.

    Raises:
        FileError: it cannot be read or a line makes no sense; names the line.
    """
    stored = StoredParameters({}, {})
    lines = _read(path).split("\n")
    first_seen: dict[str, int] = {}
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        try:
            name, raw = _parse(text, table)
            if name in first_seen:
                raise UsageError(f"{name} is set in line {first_seen[name]} already")
        except UsageError as error:
            raise FileError(path, f"line {number}: {error}", _REMEDY) from None
        first_seen[name] = number
        if raw is None:
            stored.strangers[name] = text
        else:
            stored.raws[name] = raw
    return stored


def read_values(path: Path) -> dict[str, ParamValue]:
    """Every parameter of a .params file, of whatever vehicle, bit for bit.

    Args:
        path: the file; it must be there.

    Raises:
        FileError: it cannot be read, a line makes no sense, or there is none; names the line.
    """
    if not path.is_file():
        raise FileError(path, "is no file", "Give a .params file")
    values: dict[str, ParamValue] = {}
    for number, line in enumerate(_read(path).split("\n"), 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        try:
            name, type_, raw = _columns(text)
        except UsageError as error:
            raise FileError(path, f"line {number}: {error}", "Correct it") from None
        if name in values:
            raise FileError(path, f"line {number}: {name} is set twice", "Remove one of the two")
        values[name] = ParamValue(type_, raw)
    if not values:
        raise FileError(path, "holds no parameter", "Give a .params file with the old values")
    return values


def _read(path: Path) -> str:
    """Text of a file, empty if it is not there yet."""
    try:
        if not path.exists():
            if not path.parent.is_dir():
                raise FileError(path, "its folder does not exist", f"Create {path.parent}")
            return ""
        if not path.is_file():
            raise FileError(path, "is not a file", "Name a file for the vehicle's parameters")
        with path.open("rb") as file:
            data = file.read(_LARGEST_FILE + 1)
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror})", "Name another file, or change its rights") from None
    if len(data) > _LARGEST_FILE:
        raise FileError(path, f"is larger than {_LARGEST_FILE} bytes: no file of parameters", "Name another file")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise FileError(path, f"line {line}: is not text", _REMEDY) from None


def _parse(text: str, table: ParameterTable) -> tuple[str, bytes | None]:
    """Name and bytes of one line; None instead of bytes for a name the table does not have. Raises UsageError."""
    name, type_, raw = _columns(text)
    if name not in table:
        return name, None
    if type_ != table.spec(name).type:
        raise UsageError(f"{name} is {table.spec(name).type}, the file says {type_}")
    return name, raw


def _columns(text: str) -> tuple[str, ParameterType, bytes]:
    """Name, type and bytes of one line. Raises UsageError."""
    columns = text.split()
    if len(columns) != len(_COLUMNS):
        raise UsageError(f"{text[:60]!r} has {len(columns)} columns instead of {len(_COLUMNS)} ({', '.join(_COLUMNS)})")
    _, _, name, value, kind = columns
    if not _NAME.match(name):
        raise UsageError(f"{name[:40]!r} is no parameter name")
    kinds: dict[str, ParameterType] = {str(number): type_ for type_, number in TYPE_NUMBERS.items()}
    if kind not in kinds:
        raise UsageError(f"{name} has type {kind!r}; there are 6 for INT32 and 9 for REAL32")
    return name, kinds[kind], _raw_of(name, kinds[kind], value)


def _raw_of(name: str, type_: ParameterType, text: str) -> bytes:
    """Four bytes of a value as text. Raises UsageError."""
    if _RAW.match(text):
        return int(text, 16).to_bytes(4, "little")
    if type_ == "INT32" and _WHOLE.match(text):
        return to_raw(name, type_, int(text))
    if type_ == "REAL32" and _REAL.match(text):
        return to_raw(name, type_, float(text))
    raise UsageError(f"{name} = {text[:40]!r} is no {type_}")


def text_of(type_: ParameterType, raw: bytes) -> str:
    """The shortest text that `ParameterFile` reads back bit for bit: a NaN with a payload becomes its four bytes."""
    value = from_raw(type_, raw)
    if type_ == "INT32":
        return str(value)
    for digits in range(6, 10):
        text = f"{value:.{digits}g}"
        number = float(text)  # rounding up may leave what four bytes hold, as 3.40283e+38 does
        if not (math.isfinite(number) and abs(number) > _LARGEST_REAL32) and to_raw("", type_, number) == raw:
            return text
    return f"0x{int.from_bytes(raw, 'little'):08x}"


class ParameterFile:
    """The file of one vehicle's parameters.

    Args:
        path: the file; it need not be there yet, its folder must.
        table: the vehicle's parameters. What the file holds is set in it, anything else is left as it is.
        system_id: MAVLink system of the vehicle, written into the file; nothing depends on it when it is read.
        behind: `poll` has the file written by a thread, and the vehicle waits for no disk.

    Attributes:
        problem: why the last write failed, naming the file; empty if it did not. failures: writes that failed.
        notices: sentences for a person about what was read.

    Raises:
        FileError: the file is damaged or cannot be read. Then nothing has been set or written.
    """

    def __init__(self, path: str | Path, table: ParameterTable, system_id: int = 1, *, behind: bool = False) -> None:
        self.path = Path(os.path.realpath(path))  # a link stays a link
        self.table = table
        self.system_id = system_id
        self.problem = ""
        self.failures = 0
        self._behind = behind
        self._writer: threading.Thread | None = None
        self.notices: tuple[str, ...] = ()
        self._strangers: dict[str, str] = {}
        self._apply(read_parameters(self.path, table))
        self._text = self._render()
        self._revision = table.revision
        self._due_us: int | None = None
        self._saved_us = -SAVE_PERIOD_US

    def reload(self) -> None:
        """Return to what the file holds: defaults first, then the file, as PX4 does.

        Raises:
            FileError: the file is damaged or cannot be read. Then nothing is changed.
        """
        stored = read_parameters(self.path, self.table)
        for name in self.table.changed():
            if name not in stored.raws:
                self.table.reset(name)
        self._apply(stored)
        self._text = self._render()

    def poll(self, now_us: int) -> None:
        """Write what has changed, a little after the last change; call it every few milliseconds.

        Nothing is raised: a disk that fails is told in `problem`, and tried again every 5 s.

        Args:
            now_us: vehicle time, us.
        """
        if self._writer is not None:
            if self._writer.is_alive():
                return
            self._writer = None
            if self.problem:
                self._due_us = now_us + RETRY_US
        if self._revision != self.table.revision:
            self._revision = self.table.revision
            if self._due_us is None:
                self._due_us = max(now_us + SAVE_DELAY_US, self._saved_us + SAVE_PERIOD_US)
        elif self._due_us is None:
            return
        if now_us >= self._due_us:
            self._saved_us, self._due_us = now_us, None
            if self._behind:
                text = self._render()
                self._writer = threading.Thread(target=self._put, args=(text,), name=f"writes {self.path}", daemon=True)
                self._writer.start()
            elif not self.save():
                self._due_us = now_us + RETRY_US

    def save(self) -> bool:
        """Write now, if anything differs from what was written last; returns whether the file is right now."""
        if self._writer is not None:
            self._writer.join()
            self._writer = None
        return self._put(self._render())

    def _put(self, text: str) -> bool:
        if text == self._text and not self.problem:
            return True
        try:
            self._write(text.encode())
        except OSError as error:
            self.problem = f"{self.path}: parameters cannot be written ({error.strerror}); they are lost at the end"
            self.failures += 1
            return False
        self.problem = ""
        self._text = text
        return True

    def close(self) -> bool:
        """Write what is not written yet; returns whether the file is right."""
        return self.save()

    def _apply(self, stored: StoredParameters) -> None:
        for name, raw in stored.raws.items():
            if self.table.raw(name) != raw:
                self.table.set_raw(name, raw)
        self._strangers = stored.strangers
        self.notices = tuple(
            f"{self.path}: {name} is no parameter of this vehicle; it is kept in the file" for name in stored.strangers
        )

    def _render(self) -> str:
        """Text of the file as it ought to be."""
        lines = list(_HEADER)
        for name in self.table.changed():
            type_ = self.table.spec(name).type
            value = text_of(type_, self.table.raw(name))
            lines.append(f"{self.system_id}\t1\t{name}\t{value}\t{TYPE_NUMBERS[type_]}")
        lines += self._strangers.values()
        return "\n".join(lines) + "\n"

    def _write(self, data: bytes) -> None:
        """Put a new file in the place of the old one, in one step. Raises OSError."""
        beside = self.path.with_name(f".{self.path.name}.new")
        try:
            with beside.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            with contextlib.suppress(OSError):  # there is no old file, or it is somebody else's
                beside.chmod(self.path.stat().st_mode & 0o777)
            beside.replace(self.path)
        except OSError:
            with contextlib.suppress(OSError):
                beside.unlink()
            raise


def preflight_storage(action: float, table: ParameterTable, file: ParameterFile | None) -> StorageAnswer:
    """Carry out MAV_CMD_PREFLIGHT_STORAGE of a vehicle that is not armed (an armed one rejects it temporarily).

    Args:
        action: param1, cut to a whole number as PX4 does: 0 load, 1 save, 2 reset the configuration to this
            vehicle's defaults, 3 reset the calibration of accelerometers, gyros and magnetometers, 4 reset all.
        table: the vehicle's parameters.
        file: where they are kept, or None: then loading and saving are accepted and do nothing.
    """
    wish = int(action) if math.isfinite(action) else -1
    problem = ""
    if wish == 0 and file is not None:
        try:
            file.reload()
        except FileError as error:
            problem = str(error)
    elif wish in (2, 3, 4):
        for name in table.changed():
            if _is_reset(name, wish):
                table.reset(name)
    if wish in (1, 3) and file is not None and not file.save():  # after 2 and 4 the file follows by itself
        problem = file.problem
    return StorageAnswer(0 <= wish <= 4, problem)


def _is_reset(name: str, wish: int) -> bool:
    """Whether a reset of this kind is about a parameter."""
    if wish == 3:
        return name.startswith(SENSOR_CALIBRATION)
    return wish == 4 or name not in KEPT_AT_RESET
