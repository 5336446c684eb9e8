"""What worked a sweep out: versions and a fingerprint of the sources that its numbers depend on."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from scenarios.versions import versions

_PARTS = (("sitl", "*.py"), ("sitl", "*.toml"), ("scenarios", "*.py"), ("scenarios/sweep", "*.py"))


@cache
def program_digest() -> str:
    """Of the sources of the laws, the batch and the metrics: workers that differ in it may differ in the last bit."""
    root = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for folder, pattern in _PARTS:
        for path in sorted((root / folder).glob(pattern)):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


_COUNT = ("froude", "python", "numpy", "scipy", "numba")
"""Versions that numbers depend on."""


def program_facts() -> dict[str, Any]:
    """Versions and digest, for `sweep.json` and for the comparison of workers."""
    found = versions()
    return {"program": program_digest(), "versions": {name: found[name] for name in _COUNT}}
