"""Gain sets: PX4 parameters to try, from TOML or QGroundControl's `.params`, checked before upload."""

from __future__ import annotations

import importlib.resources
import math
import re
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.toml_file import read_toml
from sitl.errors import FileError, UsageError
from sitl.keyed_table import nearest
from sitl.plain_file import check_plain

if TYPE_CHECKING:
    from sitl.parameters import ParameterTable

BUILT_IN = "gain_sets"
SET_KEYS = ("name", "source", "note", "parameters")

GAIN = re.compile(r"MC_(ROLL|PITCH|YAW)(RATE)?_(P|I|D|FF|K)$")
"""Parameters that are gains: a negative one is positive feedback, never a candidate."""

_SLUG_LENGTH = 80

ABSURD_FACTOR = 100.0  # times PX4's maximum: a slipped decimal point or a wrong unit, not a candidate
ABSURD = 1e3  # for gains whose metadata states no maximum

PITCH_TWIN = {
    "MC_ROLL_P": "MC_PITCH_P",
    "MC_ROLLRATE_P": "MC_PITCHRATE_P",
    "MC_ROLLRATE_I": "MC_PITCHRATE_I",
    "MC_ROLLRATE_D": "MC_PITCHRATE_D",
    "MC_ROLLRATE_FF": "MC_PITCHRATE_FF",
    "MC_ROLLRATE_K": "MC_PITCHRATE_K",
    "MC_ROLLRATE_MAX": "MC_PITCHRATE_MAX",
    "MC_RR_INT_LIM": "MC_PR_INT_LIM",
}


@dataclass(frozen=True)
class GainSet:
    """A named candidate.

    Attributes:
        name: shown in tables; unique among the sets of a run.
        parameters: PX4 parameter -> value, in the parameter's own unit.
        source: where the numbers come from.
        note: anything a reader of the result should know.
        path: the file it was read from.
    """

    name: str
    parameters: Mapping[str, float | int]
    source: str = ""
    note: str = ""
    path: Path | None = None

    @property
    def slug(self) -> str:
        """The name as a file name: lower case letters, digits, `_` and `-`.

        A name that this would rob of letters, or that is too long, gets its checksum at the end.
        """
        text = re.sub(r"[^a-z0-9-]+", "_", self.name.lower()).strip("_")
        if text and len(text) <= _SLUG_LENGTH and self.name.isascii():
            return text
        return f"{text[: _SLUG_LENGTH - 9] or 'set'}_{zlib.crc32(self.name.encode(errors='surrogatepass')):08x}"

    def mirrored(self) -> GainSet:
        """The same gains on pitch as well, but for pitch parameters that the set states itself."""
        twins = {PITCH_TWIN[name]: value for name, value in self.parameters.items() if name in PITCH_TWIN}
        parameters = dict(self.parameters) | {n: v for n, v in twins.items() if n not in self.parameters}
        return GainSet(self.name, parameters, self.source, self.note, self.path)


def list_gain_sets() -> tuple[str, ...]:
    """Names of the gain set files that come with the program."""
    return tuple(sorted(p.name.removesuffix(".toml") for p in _library().iterdir() if p.name.endswith(".toml")))


def load_gain_sets(ref: str | Path) -> tuple[GainSet, ...]:
    """The sets a reference names.

    Args:
        ref: `table_7_2` (every set of a built-in file), `table_7_2/ANT-R` (one of them), a path to a
            `.toml` or QGroundControl `.params` file, or `path.toml/NAME`. A set answers to its name, its
            slug, or its name without the first word, in any case.

    Raises:
        FileError: no such file or set, unreadable, a misspelt key, a value that is not a finite number.
    """
    text = str(ref)
    head, _, tail = text.rpartition("/")
    file, wanted = (head, tail) if _find(text) is None and _find(head) is not None else (text, "")
    sets = _read_file(file)
    if not wanted:
        return sets
    for gain_set in sets:
        short = gain_set.name.partition(" ")[2]
        if wanted.casefold() in (gain_set.name.casefold(), gain_set.slug, short.casefold()):
            return (gain_set,)
    names = [gain_set.name for gain_set in sets]
    raise FileError(file, f'has no gain set "{wanted}"{nearest(wanted, names)}', f"It has {', '.join(names)}")


def load_all(refs: Iterable[str | Path]) -> tuple[GainSet, ...]:
    """Sets of several references, in order.

    Raises:
        FileError: as `load_gain_sets`, or two sets whose names or file names are the same.
    """
    sets = tuple(gain_set for ref in refs for gain_set in load_gain_sets(ref))
    first: dict[str, GainSet] = {}
    for gain_set in sets:
        other = first.setdefault(gain_set.slug, gain_set)
        if other is not gain_set:
            raise FileError(
                gain_set.path or "gain sets",
                f"gain set {gain_set.name!r} has the same name as {other.name!r} of {other.path}, "
                f"or the same file name, {gain_set.slug}",
                "Name it once, or rename one: results and files are told apart by it",
            )
    return sets


def check(gain_set: GainSet, table: ParameterTable) -> list[str]:
    """Compare a set with the vehicle's parameter metadata before anything is uploaded.

    Returns:
        Warnings, one line each: values outside PX4's range, which PX4 takes without complaint and so do we.

    Raises:
        FileError: unknown parameter, NaN or infinity, a fraction for an INT32, a negative gain, or a gain
        so large
            that it must be a slip (over 100 times PX4's maximum; over 1000 where it states none).
    """
    from sitl.parameters import from_raw, range_problem, to_raw

    warnings = []
    for name, value in gain_set.parameters.items():
        if name not in table:
            problem = f"unknown parameter {name}{nearest(name, table.names)}"
            raise _bad(gain_set, problem, "Correct or remove it")
        spec = table.spec(name)
        if not math.isfinite(value):
            raise _bad(gain_set, f"{name} = {value} is not a finite number", "Write a number")
        try:
            stored = from_raw(spec.type, to_raw(name, spec.type, value))
        except UsageError as error:
            raise _bad(gain_set, str(error), "Correct the value") from error
        if GAIN.match(name):
            _check_gain(gain_set, name, value, spec.maximum)
        outside = range_problem(spec, stored)
        if outside:
            warnings.append(f"{outside}; flown anyway")
    return warnings


def _check_gain(gain_set: GainSet, name: str, value: float, maximum: float | None) -> None:
    if value < 0:
        raise _bad(gain_set, f"{name} = {value:g} is negative", "Gains are zero or more")
    ceiling = ABSURD if maximum is None else min(ABSURD, ABSURD_FACTOR * maximum)
    if value > ceiling:
        known = "" if maximum is None else f" (PX4's maximum is {maximum:g})"
        remedy = f"Nothing above {ceiling:g} is flown: check the decimal point and the unit"
        raise _bad(gain_set, f"{name} = {value:g} is absurd{known}", remedy)


def flight_gain_parameters(axis: str, gains: Mapping[str, float]) -> dict[str, float | int]:
    """An airframe's flight gains as PX4 parameters.

    Args:
        axis: ROLL or PITCH.
        gains: the fields of `sitl.airframe.FlightGains` by name.
    """
    return {
        f"MC_{axis}_P": gains["k_phi"],
        f"MC_{axis}RATE_K": 1.0,
        f"MC_{axis}RATE_P": gains["kp"],
        f"MC_{axis}RATE_I": gains["ki"],
        f"MC_{axis}RATE_D": gains["kd"],
        f"MC_{axis}RATE_FF": 0.0,
    }


def flies_gains(gain_set: GainSet, gains: Mapping[str, float]) -> bool:
    """Does this set fly an airframe's flight gains on roll? What it does not name keeps PX4's default.

    Args:
        gain_set: the set. gains: the fields of `sitl.airframe.FlightGains` by name.
    """
    from sitl.parameters import parameter_specs

    wanted = flight_gain_parameters("ROLL", gains)
    flown = {name: gain_set.parameters.get(name, parameter_specs()[name].default) for name in wanted}
    return flown == wanted


def save_params(
    path: str | Path,
    parameters: Mapping[str, float | int],
    table: ParameterTable | None = None,
    *,
    sysid: int = 1,
    compid: int = 1,
) -> None:
    """Write QGroundControl's parameter file: id, id, name, value, type (6 INT32, 9 REAL32), tab separated.

    A float is written as the shortest decimal that reads back as the same float32.

    Args:
        path: of the file.
        parameters: name -> value.
        table: says which are INT32; without it, or for a name it lacks, the Python type does.
        sysid: vehicle id written on each line.
        compid: component id written on each line.

    Raises:
        FileError: cannot be written.
    """
    import numpy as np

    lines = ["# Parameters written by froude", "#", "# Vehicle-Id Component-Id Name Value Type"]
    for name, value in parameters.items():
        known = table is not None and name in table
        integer = table.spec(name).type == "INT32" if table is not None and known else isinstance(value, int)
        text = str(int(value)) if integer else str(np.float32(value))
        lines.append(f"{sysid}\t{compid}\t{name}\t{text}\t{6 if integer else 9}")
    part = Path(path).with_name(Path(path).name + ".part")
    try:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise FileError(path, f"cannot be written: {error.strerror}", "Choose another place") from error


def _library() -> Any:
    return importlib.resources.files("scenarios") / BUILT_IN


def _find(file: str) -> Path | None:
    """The file of that path, or the built-in file of that name; None if there is neither."""
    for path in (Path(file), Path(str(_library() / f"{file}.toml"))):
        if file and path.is_file():
            return path
    return None


def _read_file(file: str) -> tuple[GainSet, ...]:
    path = _find(file)
    if path is None:
        known = list_gain_sets()
        hint = f"Built in: {', '.join(known)}; or give a .toml or .params file"
        raise FileError(file, f"no such gain set file{nearest(file.partition('/')[0], known)}", hint)
    if path.suffix == ".params":
        return (_from_params(path),)
    if path.suffix == ".toml":
        return _from_toml(path)
    raise FileError(path, f"suffix {path.suffix!r} is not known", "Give a .toml or a QGroundControl .params file")


def _from_toml(path: Path) -> tuple[GainSet, ...]:
    data = read_toml(path)
    for key in data:
        if key != "gain_set":
            raise FileError(path, f"unknown key {key!r}", "Every set is a [[gain_set]] table")
    entries = data.get("gain_set")
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise FileError(path, "holds no [[gain_set]]", "Write [[gain_set]] with name and [gain_set.parameters]")
    sets = tuple(_set_from_table(entry, path, n) for n, entry in enumerate(entries, 1))
    slugs = [gain_set.slug for gain_set in sets]
    for gain_set in sets:
        if slugs.count(gain_set.slug) > 1:
            problem = f"two gain sets are named {gain_set.name!r}, or have the same file name, {gain_set.slug}"
            raise FileError(path, problem, "Rename one")
    return sets


def _set_from_table(entry: dict[str, Any], path: Path, number: int) -> GainSet:
    for key in entry:
        if key not in SET_KEYS:
            problem = f'gain_set {number}: unknown key "{key}"{nearest(key, SET_KEYS)}'
            raise FileError(path, problem, f"Keys are {', '.join(SET_KEYS)}")
    for key in ("name", "source", "note"):
        if not isinstance(entry.get(key, ""), str):
            raise FileError(path, f"gain_set {number}: {key} = {entry[key]!r} is not a text", "Quote it")
    name = entry.get("name", "").strip()
    if not name:
        raise FileError(path, f"gain_set {number} has no name", 'Write name = "..."')
    parameters = entry.get("parameters")
    if not isinstance(parameters, dict) or not parameters:
        raise FileError(path, f"gain set {name!r} has no parameters", "Write [gain_set.parameters] MC_ROLL_P = 6.5")
    for key, value in parameters.items():
        _number(value, path, f"gain set {name!r}: {key}")
    return GainSet(name, dict(parameters), entry.get("source", ""), entry.get("note", ""), path)


def _number(value: Any, path: Path, what: str) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FileError(path, f"{what} = {value!r} is not a number", "Write a number without quotes")
    try:
        finite = math.isfinite(value)
    except OverflowError:
        raise FileError(path, f"{what} has {len(str(abs(value)))} digits", "Write a number") from None
    if not finite:
        raise FileError(path, f"{what} = {value} is not a finite number", "Write a number")


def _from_params(path: Path) -> GainSet:
    check_plain(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"cannot be read: {error}", "It must be a UTF-8 text file") from error
    parameters: dict[str, float | int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = line.split()
        if len(words) != 5:
            raise FileError(
                path,
                f"line {number}: {len(words)} columns instead of 5",
                "QGroundControl writes: vehicle id, component id, name, value, type",
            )
        _, _, name, value, kind = words
        if name in parameters:
            raise FileError(path, f"line {number}: {name} is given twice", "Remove one")
        try:
            if not value.isascii() or "_" in value:  # Python's own liberties with numbers
                raise ValueError
            if kind == "6":
                parameters[name] = int(value)
            elif kind == "9":
                parameters[name] = float(value)
            else:
                raise FileError(path, f"line {number}: {name} has type {kind!r}", "PX4 knows 6 (INT32), 9 (REAL32)")
        except ValueError:
            what = "an integer" if kind == "6" else "a number"
            raise FileError(path, f"line {number}: {name} = {value!r} is not {what}", "Correct it") from None
        _number(parameters[name], path, f"line {number}: {name}")
    if not parameters:
        raise FileError(path, "holds no parameter", "Save it from QGroundControl: Parameters, Tools, Save to file")
    return GainSet(path.stem, parameters, f"QGroundControl parameter file {path.name}", "", path)


def _bad(gain_set: GainSet, problem: str, remedy: str) -> UsageError:
    return FileError(gain_set.path or "gain set", f"gain set {gain_set.name!r}: {problem}", remedy)
