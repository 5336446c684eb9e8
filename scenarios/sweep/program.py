"""What worked a sweep out: versions and a fingerprint of the sources that its numbers depend on."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from scenarios.versions import versions

_PARTS = (
    ("sitl", ("*.py", "*.toml")),
    (
        "scenarios",
        (
            "batch_*.py",
            "metrics.py",
            "monte_carlo.py",
            "roll_set.py",
            "limits.py",
            "manoeuvres.py",
            "signals.py",
            "analysis.py",
        ),
    ),
    (
        "scenarios/sweep",
        ("axes.py", "candidates.py", "evaluation.py", "dataset.py", "objectives.py", "plan.py", "search.py"),
    ),
)
"""Sources that a row depends on."""


@cache
def program_digest() -> str:
    """Of the sources of the laws, the batch and the metrics: workers that differ in it may differ in the last bit."""
    root = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for folder, patterns in _PARTS:
        for path in sorted(path for pattern in patterns for path in (root / folder).glob(pattern)):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


_COUNT = ("froude", "python", "numpy", "scipy", "numba")
"""Versions that numbers depend on."""


def program_facts() -> dict[str, Any]:
    """Versions and digest, for `sweep.json` and for the comparison of workers."""
    found = versions()
    return {"program": program_digest(), "versions": {name: found[name] for name in _COUNT}}
