"""The compiled laws on whole arrays: the very same source lines, run by numpy instead of machine code.

Compiling takes a second or more, once per machine. A small job on a machine that has not compiled yet is over sooner
with numpy, and there is still one implementation of each law: a function that is written without branches and
indexing (`select`, `min`, `max` and arithmetic) is run as it stands, each of its scalars an array over the samples.
"""

from __future__ import annotations

import types
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import numpy as np

from sitl.compiled import select

_Function = TypeVar("_Function", bound=Callable[..., Any])

_ON_ARRAYS: dict[str, Any] = {"min": np.minimum, "max": np.maximum, "abs": np.abs, "math": np}


@cache
def plain_form(law: _Function) -> _Function:
    """A compiled law as the Python that it was written in, and all that it calls: for a few calls before compiling.

    Args:
        law: decorated with `compiled`.
    """
    return _rebuilt(law, plain_form, {})


@cache
def array_form(law: _Function) -> _Function:
    """A compiled law for arrays.

    Args:
        law: decorated with `compiled`; it and every law it calls are free of branches, loops and indexing.

    Returns:
        a plain function of the same arguments, each a scalar or an array of one common shape.
    """
    return _rebuilt(law, array_form, _ON_ARRAYS)


def _rebuilt(law: _Function, form: Callable[[Any], Any], other: dict[str, Any]) -> _Function:
    """The function's own code with other meanings of the names that it uses."""
    plain = getattr(law, "py_func", law)
    names = dict(plain.__globals__) | other
    for name in plain.__code__.co_names:
        called = names.get(name)
        if called is select and other:
            names[name] = np.where
        elif hasattr(called, "py_func"):
            names[name] = form(called)
    made: Any = types.FunctionType(plain.__code__, names, plain.__name__, plain.__defaults__)
    return made  # type: ignore[no-any-return]
