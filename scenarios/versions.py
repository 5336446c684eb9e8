"""Versions of this program and of what it rests on."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

LIBRARIES = ("numpy", "scipy", "numba", "control", "pymavlink", "pyarrow", "rerun-sdk")


def versions() -> dict[str, str]:
    """This program's version, Python's and the libraries'."""
    found = {"froude": _version("froude"), "python": platform.python_version()}
    return found | {name: _version(name) for name in LIBRARIES}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"
