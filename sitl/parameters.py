"""The autopilot's parameters: PX4's names, types and stored bits.

A parameter is an INT32 or a REAL32 and is kept as the four bytes it has on the wire, so whatever was set
comes back bit for bit: a NaN with its payload, an infinity, a value outside the documented range. Like PX4
(src/lib/parameters) nothing here clamps: minimum and maximum are metadata, and `out_of_range` says how far
outside a value is.
"""

from __future__ import annotations

import difflib
import functools
import math
import numbers
import operator
import re
import struct
import tomllib
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from sitl.errors import FileError, UsageError

ParameterType = Literal["INT32", "REAL32"]

NAME_LENGTH: Final = 16
"""Longest name MAVLink can carry, in characters."""

KEPT: Final = "Kept; no effect here. "
"""How the description of a parameter begins that this vehicle stores but does not act on."""

_FILES: Final = {
    Path(__file__).with_name("parameters.toml"): True,
    Path(__file__).with_name("parameters_kept.toml"): False,
    Path(__file__).with_name("parameters_estimator.toml"): False,
}
"""Where the parameters are listed, and whether the vehicle acts on those of the file."""

_INT32: Final = struct.Struct("<i")
_REAL32: Final = struct.Struct("<f")
_NAME: Final = re.compile(r"[A-Z][A-Z0-9_]*\Z")
_SERIES: Final = re.compile(r"\{(\d+)\.\.(\d+)\}")
_KEYS: Final = frozenset(
    {"default", "min", "max", "unit", "decimals", "increment", "reboot", "volatile", "short", "values"}
)


class UnknownParameter(UsageError):
    """No parameter of that name; `nearest` holds the names most like it."""

    def __init__(self, name: str, known: tuple[str, ...]) -> None:
        self.name = name
        self.nearest = tuple(difflib.get_close_matches(name.upper(), known, n=3))
        hint = f"did you mean {' or '.join(self.nearest)}?" if self.nearest else "see PX4's parameter names"
        super().__init__(f"unknown parameter {name!r}: {hint}")


class WrongParameterType(UsageError):
    """A value of the wrong kind for the parameter."""

    def __init__(self, name: str, type_: ParameterType, value: object) -> None:
        wanted = "a whole number" if type_ == "INT32" else "a number"
        super().__init__(f"parameter {name} is {type_}: give it {wanted}, not {value!r}")


class UnstorableValue(UsageError):
    """A number that four bytes cannot hold."""

    def __init__(self, name: str, type_: ParameterType, value: object) -> None:
        limits = "-2147483648 to 2147483647" if type_ == "INT32" else "at most 3.4028235e38 in magnitude"
        super().__init__(f"parameter {name} = {value!r} does not fit its type {type_}, which holds {limits}")


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """What is known of one parameter; numbers are in `unit`, as PX4 documents it (degrees stay degrees)."""

    name: str
    type: ParameterType
    default: int | float
    minimum: int | float | None = None
    maximum: int | float | None = None
    unit: str = ""
    decimals: int | None = None
    increment: int | float | None = None
    reboot: bool = False
    """PX4 asks for a restart after a change."""
    group: str = ""
    short: str = ""
    values: Mapping[int, str] = field(default_factory=dict)
    """Choices of an enumeration, empty for a plain number."""
    obeyed: bool = True
    """False: stored and answered, but without effect on this vehicle."""
    volatile: bool = False
    """True: left out of the hash."""


def to_raw(name: str, type_: ParameterType, value: object) -> bytes:
    """Four little-endian bytes of a value, rounded to the nearest float32 for REAL32.

    Raises:
        WrongParameterType: an INT32 takes whole numbers only (5.0 is refused), a REAL32 any real number.
        UnstorableValue: the number needs more than four bytes.
    """
    try:
        if type_ == "INT32":
            return _INT32.pack(operator.index(value))  # type: ignore[arg-type]
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise WrongParameterType(name, type_, value)
        return _REAL32.pack(float(value))
    except TypeError:
        raise WrongParameterType(name, type_, value) from None
    except (struct.error, OverflowError):
        raise UnstorableValue(name, type_, value) from None


def from_raw(type_: ParameterType, raw: bytes) -> int | float:
    """The value of four little-endian bytes."""
    value: int | float = (_INT32 if type_ == "INT32" else _REAL32).unpack(raw)[0]
    return value


def range_problem(spec: ParameterSpec, value: int | float) -> str | None:
    """A sentence saying how far `value` is outside the documented range, or None if it is inside.

    Limits are rounded to float32 first: 0.01 as stored is a hair below 0.01, yet not below a minimum of 0.01.
    """
    shown = f"{spec.name} = {value:.7g}" if isinstance(value, float) else f"{spec.name} = {value}"
    if not math.isfinite(value):
        return f"{shown} is not a finite number"
    for limit, sign in ((spec.minimum, -1), (spec.maximum, 1)):
        if limit is None:
            continue
        bound = from_raw(spec.type, to_raw(spec.name, spec.type, limit))
        if (value - bound) * sign > 0:
            unit = f" {spec.unit}" if spec.unit else ""
            where = "below PX4's minimum" if sign < 0 else "above PX4's maximum"
            ratio = ""
            if limit and value / limit > 1:
                over = value / limit
                ratio = f", {over:.3g} times it" if over >= 1.1 else f", {100 * (over - 1):.2g} % over"
            return f"{shown} is {where} of {limit:g}{unit} by {abs(value - limit):.4g}{unit}{ratio}"
    if spec.values and value not in spec.values:
        choices = ", ".join(f"{number} {text}" for number, text in spec.values.items())
        return f"{shown} is none of PX4's choices ({choices})"
    return None


@functools.cache
def parameter_specs() -> Mapping[str, ParameterSpec]:
    """Every parameter of this vehicle by name, sorted by name; read once from `parameters*.toml`."""
    specs: dict[str, ParameterSpec] = {}
    for path, obeyed in _FILES.items():
        for name, spec in _load(path, obeyed=obeyed).items():
            if name in specs:
                raise FileError(path, f"{name} is listed in another file, too", "Remove one of the two")
            specs[name] = spec
    return dict(sorted(specs.items()))


@functools.cache
def _factory() -> tuple[Mapping[str, int | float], Mapping[str, bytes], tuple[tuple[bytes, str], ...]]:
    """What every table begins with: values, their bytes, and the names that are hashed, encoded and plain."""
    specs = parameter_specs()
    return (
        {name: spec.default for name, spec in specs.items()},
        {name: to_raw(name, spec.type, spec.default) for name, spec in specs.items()},
        tuple((name.encode(), name) for name, spec in specs.items() if not spec.volatile),
    )


def _load(path: Path, *, obeyed: bool = True) -> Mapping[str, ParameterSpec]:
    try:
        with path.open("rb") as file:
            groups = tomllib.load(file)
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror})", "Install froude again") from error
    except tomllib.TOMLDecodeError as error:  # a name written twice ends here
        raise FileError(path, f"is not TOML: {error}") from error
    specs: dict[str, ParameterSpec] = {}
    for group, entries in groups.items():
        for pattern, entry in entries.items():
            for name, number in _expand(pattern):
                if name in specs:
                    raise FileError(path, f"{name} is listed twice", "Remove one of the two")
                specs[name] = _spec(path, name, group, entry, number, obeyed=obeyed)
    return specs


def _expand(pattern: str) -> Iterator[tuple[str, int | None]]:
    """Names of `NAME{0..11}_X`, each with its number; any other name as it is, with None."""
    series = _SERIES.search(pattern)
    if series is None:
        yield pattern, None
        return
    for number in range(int(series[1]), int(series[2]) + 1):
        yield f"{pattern[: series.start()]}{number}{pattern[series.end() :]}", number


def _spec(
    path: Path, name: str, group: str, entry: Mapping[str, Any], number: int | None, *, obeyed: bool
) -> ParameterSpec:
    """One entry of the file, checked."""
    if not _NAME.match(name) or len(name) > NAME_LENGTH:
        raise FileError(path, f"{name} is no parameter name", f"Use 1 to {NAME_LENGTH} of A-Z, 0-9 and _")
    for key in entry.keys() - _KEYS:
        near = difflib.get_close_matches(key, sorted(_KEYS), n=1)
        remedy = f"Nearest valid key: {near[0]}" if near else f"Valid keys: {', '.join(sorted(_KEYS))}"
        raise FileError(path, f"{name} has the unknown key {key!r}", remedy)
    for key in ("default", "short"):
        if key not in entry:
            raise FileError(path, f"{name} lacks {key!r}")
    kind = float if isinstance(entry["default"], float) else int
    for key in ("default", "min", "max", "increment"):
        if key in entry and type(entry[key]) is not kind:
            raise FileError(
                path,
                f"{name}: {key} = {entry[key]!r} is not a {kind.__name__} like its default",
                "Write every number of a REAL32 with a decimal point, those of an INT32 without",
            )
    type_: ParameterType = "REAL32" if kind is float else "INT32"
    short = entry["short"] if number is None else entry["short"].replace("{n}", str(number))
    spec = ParameterSpec(
        name=name,
        type=type_,
        default=from_raw(type_, to_raw(name, type_, entry["default"])),
        minimum=entry.get("min"),
        maximum=entry.get("max"),
        unit=entry.get("unit", ""),
        decimals=entry.get("decimals"),
        increment=entry.get("increment"),
        reboot=entry.get("reboot", False),
        group=group,
        short=short if obeyed else KEPT + short,
        values={int(value): text for value, text in entry.get("values", {}).items()},
        obeyed=obeyed,
        volatile=entry.get("volatile", False),
    )
    problem = range_problem(spec, spec.default)
    if problem:
        raise FileError(path, f"the default of {problem}", "Correct the default or the range")
    return spec


class ParameterTable:
    """The parameters of one vehicle and their present values.

    Args:
        overrides: the airframe's defaults where they differ from PX4's (its geometry, its hover thrust), as
            PX4's airframe scripts set them. `reset` returns to them and `changed` is relative to them.

    Raises:
        UnknownParameter, WrongParameterType, UnstorableValue: from `overrides`.
    """

    def __init__(self, overrides: Mapping[str, float | int] | None = None) -> None:
        self._specs = parameter_specs()
        self.names: tuple[str, ...] = tuple(self._specs)
        self._index = {name: index for index, name in enumerate(self.names)}
        values, raws, self._hashed = _factory()
        self._values = dict(values)
        self._raws = dict(raws)
        for name, value in (overrides or {}).items():
            type_ = self.spec(name).type
            self._raws[name] = raw = to_raw(name, type_, value)
            self._values[name] = from_raw(type_, raw)
        self._initial = dict(self._raws)
        self._stamps: dict[str, int] = {}
        self.revision = 0
        """Number of sets so far: an unchanged number means unchanged values."""
        self._hash = (-1, 0)  # revision it belongs to, and the hash

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self._index

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def spec(self, name: str) -> ParameterSpec:
        """What is known of a parameter. Raises UnknownParameter."""
        try:
            return self._specs[name]
        except KeyError:
            raise UnknownParameter(name, self.names) from None

    def index(self, name: str) -> int:
        """Place of a parameter in the sorted list, from 0: its MAVLink index. Raises UnknownParameter."""
        self.spec(name)
        return self._index[name]

    def get(self, name: str) -> int | float:
        """The value: int for INT32, a float that is exactly a float32 for REAL32. Raises UnknownParameter."""
        try:
            return self._values[name]
        except KeyError:
            raise UnknownParameter(name, self.names) from None

    def raw(self, name: str) -> bytes:
        """The value's four bytes, little-endian, as on the wire and in the hash. Raises UnknownParameter."""
        try:
            return self._raws[name]
        except KeyError:
            raise UnknownParameter(name, self.names) from None

    def default(self, name: str) -> int | float:
        """This vehicle's default: the airframe's override, else PX4's. Raises UnknownParameter."""
        return from_raw(self.spec(name).type, self._initial[name])

    def set(self, name: str, value: float | int) -> None:
        """Store a value; NaN, infinity and numbers out of the documented range are stored as they are.

        Raises:
            UnknownParameter: with the nearest names.
            WrongParameterType: see `to_raw`.
            UnstorableValue: see `to_raw`.
        """
        self.set_raw(name, to_raw(name, self.spec(name).type, value))

    def set_raw(self, name: str, raw: bytes) -> None:
        """Store four little-endian bytes as they are.

        Raises:
            UnknownParameter: with the nearest names.
            UsageError: not four bytes.
        """
        type_ = self.spec(name).type
        if len(raw) != 4:
            raise UsageError(f"parameter {name} takes 4 bytes, not {len(raw)}")
        self.revision += 1
        if raw != self._raws[name]:
            self._raws[name] = bytes(raw)
            self._values[name] = from_raw(type_, raw)
            self._stamps[name] = self.revision

    def reset(self, name: str | None = None) -> None:
        """Return one parameter, or all of them, to this vehicle's defaults. Raises UnknownParameter."""
        for each in self.names if name is None else (name,):
            self.spec(each)
            self.set_raw(each, self._initial[each])

    def changed(self) -> tuple[str, ...]:
        """Names whose value differs from this vehicle's default, sorted."""
        return tuple(name for name in self.names if self._raws[name] != self._initial[name])

    def changed_since(self, revision: int) -> tuple[str, ...]:
        """Names whose stored bits changed after `revision`, sorted; a set to the same value is no change."""
        return tuple(sorted(name for name, stamp in self._stamps.items() if stamp > revision))

    def out_of_range(self, name: str) -> str | None:
        """How far the present value is outside PX4's documented range, or None. Raises UnknownParameter."""
        return range_problem(self.spec(name), self.get(name))

    def hash_check(self) -> int:
        """PX4's `_HASH_CHECK`: CRC-32 (start 0, no final inversion) over name and value bytes in index order.

        Volatile parameters are left out. Nothing is calculated again as long as nothing is set.
        PX4: param_hash_check, crc32part.
        """
        if self._hash[0] != self.revision:
            raws = self._raws
            data = b"".join([part for encoded, name in self._hashed for part in (encoded, raws[name])])
            self._hash = (self.revision, zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF)
        return self._hash[1]
