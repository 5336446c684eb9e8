"""Which run somebody means: by folder, by name or a part of it, by one of its files, or the newest."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scenarios.run_list import newest, run_folders
from scenarios.run_reader import folder_of
from scenarios.stored_flight import FLIGHTS, split_name
from sitl.errors import UsageError
from sitl.keyed_table import nearest

_MOST_NAMED = 5


@dataclass(frozen=True)
class Choice:
    """A run, and perhaps one flight of it.

    Attributes:
        folder: of the run; it need not be readable.
        slug: of the flight whose file was given; empty: none.
    """

    folder: Path
    slug: str = ""


def choose(word: str, out: Path) -> Choice:
    """The run that a word means.

    Args:
        word: a run's folder or a file of it, or its name in `out`, or a part of the name that no other has.
        out: where runs are kept.

    Raises:
        UsageError: no such run, or several.
    """
    path = Path(word)
    if _exists(path):
        slug, kind = split_name(path.name)
        return Choice(folder_of(path), slug if kind and path.parent.name == FLIGHTS else "")
    folders = run_folders(out)
    wanted = word.casefold().rstrip("/")
    found = [folder for folder in folders if folder.name.casefold() == wanted]
    found = found or [folder for folder in folders if wanted in folder.name.casefold()]
    if len(found) == 1:
        return Choice(found[0])
    if found:
        names = ", ".join(folder.name for folder in found[:_MOST_NAMED])
        more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
        raise UsageError(f"{word!r} is in the names of {len(found)} runs: {names}{more}. Give a longer part")
    if not folders:
        raise UsageError(f"there is no file {word!r}, and no run in {out}. {_remedy(out)}")
    names_ = [folder.name for folder in folders]
    raise UsageError(
        f"there is no file {word!r}, and no run in {out} has that in its name{nearest(word, names_)}. "
        "`froude review --list` shows them"
    )


def newest_choice(out: Path) -> Choice:
    """The run that was begun last.

    Args:
        out: where runs are kept.

    Raises:
        UsageError: there is none.
    """
    folder = newest(out)
    if folder is None:
        raise UsageError(f"there is no run in {out}. {_remedy(out)}")
    return Choice(folder)


def _remedy(out: Path) -> str:
    return f"`froude fly` makes one; runs kept elsewhere are found with --out DIR instead of {out}"


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # too long for a name, or a character that no name has
        return False
