"""Drawings are kept by what is in them: who draws the same again, from a file read again, gets what there is."""

from __future__ import annotations

import dataclasses
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, ParamSpec

import numpy as np

from scenarios.report.canvas import Drawing

MOST = 160
"""Drawings kept of one kind: four segments of forty gain sets."""

Arguments = ParamSpec("Arguments")


def kept(draw: Callable[Arguments, Drawing]) -> Callable[Arguments, Drawing]:
    """Keep what a function draws.

    Args:
        draw: gives the same drawing for the same arguments: numbers, texts, arrays, mappings, tuples, dataclasses.
    """
    drawn: OrderedDict[bytes, Drawing] = OrderedDict()

    @wraps(draw)
    def keeping(*args: Arguments.args, **named: Arguments.kwargs) -> Drawing:
        key = content(args, named)
        found = drawn.get(key)
        if found is None:
            found = drawn[key] = draw(*args, **named)
            if len(drawn) > MOST:
                drawn.popitem(last=False)
        return found

    return keeping


def content(*things: Any) -> bytes:
    """A digest of what is in things: equal for equal content, whatever objects hold it."""
    digest = hashlib.sha256()
    _add(digest, things)
    return digest.digest()


def _add(digest: Any, thing: Any) -> None:
    if isinstance(thing, np.ndarray):
        digest.update(f"array {thing.dtype.str} {thing.shape} ".encode())
        digest.update(np.ascontiguousarray(thing).tobytes())
        return
    parts: list[Any] = []
    if dataclasses.is_dataclass(thing):
        parts = [getattr(thing, one.name) for one in dataclasses.fields(thing)]
    elif isinstance(thing, Mapping):
        parts = [part for pair in thing.items() for part in pair]
    elif isinstance(thing, tuple | list):
        parts = list(thing)
    else:
        digest.update(f"{type(thing).__name__} {thing!r} ".encode())
        return
    digest.update(f"{type(thing).__name__} of {len(parts)} ".encode())
    for part in parts:
        _add(digest, part)
