"""Versions of `run.json`: what an older program wrote is made into what the present one would have written.

A key that goes, or changes its meaning, raises `SCHEMA_VERSION` and gets a function here that leads from the version
before to the new one. Keys that only come are filled by `scenarios/run_shape.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sitl.errors import FileError

SCHEMA_VERSION = 2

Step = Callable[[dict[str, Any]], dict[str, Any]]


def _from_1(run: dict[str, Any]) -> dict[str, Any]:
    """Version 2: telemetry has the true angles, runs have twins. Version 1 knew no real autopilot."""
    return {**run, "twins": []}


class NewerError(FileError):
    """A run that this program is too old for."""


STEPS: Mapping[int, Step] = {1: _from_1}
"""Version -> function from it to the next one; none is left out between the first and the present."""


def migrate(run: Any, file: Path) -> dict[str, Any]:
    """Bring what a `run.json` holds to the present schema.

    Args:
        run: as read from the file. file: to name it in errors.

    Returns:
        A new object of version `SCHEMA_VERSION`; `schema_version` says so. `run` is not changed.

    Raises:
        FileError: it is no run. NewerError: a newer froude wrote it.
    """
    version = run.get("schema_version") if isinstance(run, dict) else None
    if not isinstance(version, int) or isinstance(version, bool) or version < min(STEPS, default=SCHEMA_VERSION):
        raise FileError(
            file,
            f"schema_version is {version!r}, this program reads 1 to {SCHEMA_VERSION}: it is no run of froude",
            "Give the folder of a run",
        )
    if version > SCHEMA_VERSION:
        raise NewerError(
            file,
            f"schema_version is {version}, this program reads 1 to {SCHEMA_VERSION}: written by a newer froude",
            "Use the version of froude that wrote it, or a newer one",
        )
    present = dict(run)
    for older in range(version, SCHEMA_VERSION):
        present = STEPS[older](present)
    present["schema_version"] = SCHEMA_VERSION
    return present
