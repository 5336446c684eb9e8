"""The decorator of the compiled laws, and where their machine code is kept.

numba's own cache looks at the file a function is in, not at the files of the functions it calls, so after an edit of
one law another would go on flying the old one. Here the cache folder's name is a fingerprint of every source in this
package: any change compiles everything anew (about half a minute, once).
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])
_KEPT = 3

Record = Any
"""One element of a structured array, as compiled code sees it: fields are attributes."""


def compiled(function: _Function) -> _Function:
    """Compile a function on its first call, or take the machine code of an earlier run."""
    return _compiled(function, "never")


def inlined(function: _Function) -> _Function:
    """`compiled`, and set into whatever compiled code calls it: a loop over it can then use the vector unit."""
    return _compiled(function, "always")


def _compiled(function: _Function, inline: str) -> _Function:
    before = numba.config.CACHE_DIR
    # numba reads the folder when the function is decorated; other users of numba in this process keep theirs
    numba.config.CACHE_DIR = str(cache_folder())
    try:
        made: _Function = numba.njit(cache=True, nogil=True, inline=inline)(function)
    finally:
        numba.config.CACHE_DIR = before
    return made


@cache
def cache_folder() -> Path:
    """Folder of this version's machine code: beside the sources if they can be written to, else the user's cache."""
    here = Path(__file__).parent
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(here.glob("*.py")):
        digest.update(source.read_bytes())
    name = f"laws-{digest.hexdigest()[:16]}"
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "froude"
    for base in (here / "__pycache__", user):
        try:
            folder = base / name
            folder.mkdir(parents=True, exist_ok=True)
            probe = folder / f".writable-{os.getpid()}"
            probe.touch()
            probe.unlink()
        except OSError:
            continue
        _forget_old(base)
        return folder
    return Path(tempfile.mkdtemp(prefix="froude-laws-"))


def is_warm() -> bool:
    """Has this version's machine code been made before?"""
    return any(cache_folder().rglob("*.nbc"))


def is_compiled(law: Callable[..., Any]) -> bool:
    """Is the machine code of this function there already, in this process or from an earlier one?"""
    if getattr(law, "signatures", None):
        return True
    return any(cache_folder().rglob(f"*.{law.__name__}-*.nbc"))


def _forget_old(base: Path) -> None:
    """Remove the folders of all but the latest few versions."""
    folders = sorted(base.glob("laws-*"), key=lambda folder: folder.stat().st_mtime, reverse=True)
    for folder in folders[_KEPT:]:
        shutil.rmtree(folder, ignore_errors=True)


@compiled
def select(condition: bool, then: float, otherwise: float) -> float:
    """``then if condition else otherwise``, as a function: laws written with it also run on arrays.

    See `sitl.array_form`; both values are worked out, so neither may fail when it is not chosen.
    """
    return then if condition else otherwise
