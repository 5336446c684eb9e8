"""KeyedTable: a TOML table whose every key is asked for by name, so that a misspelt key is an error.

A file that is read with `dict.get` accepts `mas_kg` in silence and flies with the default. Here each reader
takes the keys it knows; `finish` refuses whatever is left and names the nearest key it would have taken.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sitl.errors import FileError
from sitl.plain_file import check_plain


def nearest(word: str, known: Iterable[str]) -> str:
    """The known word nearest to `word` as ` (did you mean "..."?)`, or an empty text if none is near."""
    folded = {candidate.casefold(): candidate for candidate in known}
    found = difflib.get_close_matches(word.casefold(), folded, n=1, cutoff=0.5)
    return f' (did you mean "{folded[found[0]]}"?)' if found else ""


class KeyedTable:
    """One table of a TOML file; remembers which keys were asked for.

    Args:
        path: the file, for messages.
        values: the table as tomllib gives it.
        where: its name inside the file ("derivatives"), empty for the top level.
    """

    def __init__(self, path: Path, values: dict[str, Any], where: str = "") -> None:
        self.path = path
        self.where = where
        self._values = values
        self._asked: set[str] = set()

    @classmethod
    def read(cls, path: Path) -> KeyedTable:
        """Parse a whole file.

        Raises:
            FileError: the file cannot be read, or is not TOML.
        """
        check_plain(path)
        try:
            with path.open("rb") as file:
                return cls(path, tomllib.load(file))
        except FileNotFoundError:
            raise FileError(path, "no such file", "Check the path") from None
        except OSError as error:
            raise FileError(path, f"cannot be read: {error.strerror or error}") from None
        except (
            ValueError,
            RecursionError,
        ) as error:  # bad TOML and bad UTF-8 are ValueErrors
            raise FileError(path, f"not a TOML file: {error}", "Correct the line it names") from None

    def error(self, key: str, problem: str, remedy: str = "") -> FileError:
        """A FileError that names `key` of this table."""
        return FileError(self.path, f"{self.name(key)}: {problem}", remedy)

    def name(self, key: str) -> str:
        """The key as a person finds it in the file: `derivatives.Ld_rad_s2`."""
        return f"{self.where}.{key}" if self.where else key

    def __contains__(self, key: str) -> bool:
        self._asked.add(key)
        return key in self._values

    def _take(self, key: str) -> Any:
        self._asked.add(key)
        if key not in self._values:
            meant = nearest(key, set(self._values) - self._asked)
            here = f'; the file has "{meant.split(chr(34))[1]}"' if meant else ""
            raise self.error(key, f"missing key{here}", "Add it")
        return self._values[key]

    @property
    def keys(self) -> tuple[str, ...]:
        """Every key of the table, in the file's order."""
        return tuple(self._values)

    def anything(self, key: str) -> Any:
        """The value of a key, of whatever kind.

        Raises:
            FileError: missing.
        """
        return self._take(key)

    def number(
        self,
        key: str,
        default: float | None = None,
        *,
        at_least: float = -math.inf,
        at_most: float = math.inf,
        above: float = -math.inf,
        below: float = math.inf,
    ) -> float:
        """A finite number within the range; `default` makes the key optional.

        Raises:
            FileError: missing, not a number, not finite, or out of range.
        """
        if default is not None and key not in self:
            return default
        return self._number(key, self._take(key), at_least=at_least, at_most=at_most, above=above, below=below)

    def _number(self, key: str, value: object, *, at_least: float, at_most: float, above: float, below: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, f"{value!r} is not a number", "Give a number without quotes")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.error(key, f"{number} is not finite", "Give a finite number")
        limits = [
            f"{sign} {bound:g}"
            for sign, bound, broken in (
                (">=", at_least, number < at_least),
                ("<=", at_most, number > at_most),
                (">", above, number <= above),
                ("<", below, number >= below),
            )
            if broken
        ]
        if limits:
            raise self.error(key, f"{number:g} is out of range", f"It must be {' and '.join(limits)}")
        return number

    def numbers(self, key: str, count: int, *, above: float = -math.inf) -> tuple[float, ...]:
        """A list of exactly `count` finite numbers, each greater than `above`."""
        value = self._take(key)
        if not isinstance(value, list) or len(value) != count:
            raise self.error(key, f"{value!r} is not a list of {count} numbers")
        return tuple(
            self._number(f"{key}[{i}]", item, at_least=-math.inf, at_most=math.inf, above=above, below=math.inf)
            for i, item in enumerate(value)
        )

    def text(self, key: str, default: str | None = None) -> str:
        """A non-empty text; `default` makes the key optional."""
        if default is not None and key not in self:
            return default
        value = self._take(key)
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, f"{value!r} is not a text", "Give a text in quotes")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of texts; empty when the key is absent."""
        if key not in self:
            return ()
        value = self._take(key)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self.error(key, f"{value!r} is not a list of texts")
        return tuple(value)

    def table(self, key: str) -> KeyedTable:
        """The sub-table `[key]`."""
        value = self._take(key)
        if not isinstance(value, dict):
            raise self.error(key, f"{value!r} is not a table", f"Write it as [{self.name(key)}]")
        return KeyedTable(self.path, value, self.name(key))

    def tables(self, key: str) -> tuple[KeyedTable, ...]:
        """The array of tables `[[key]]`; members are named `key[0]`, `key[1]`, ..."""
        value = self._take(key)
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error(key, "is not a list of tables", f"Write each as [[{self.name(key)}]]")
        return tuple(KeyedTable(self.path, item, f"{self.name(key)}[{i}]") for i, item in enumerate(value))

    def finish(self) -> None:
        """Refuse every key that nobody asked for.

        Raises:
            FileError: names the first such key and the nearest valid one.
        """
        for key in self._values:
            if key not in self._asked:
                raise self.error(
                    key,
                    f"unknown key{nearest(key, self._asked)}",
                    f"Keys here are {', '.join(sorted(self._asked))}",
                )
