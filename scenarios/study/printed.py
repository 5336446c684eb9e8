"""What the study prints, with the decimals it prints: for comparison only."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any

AIRFRAMES = ("ANT-R", "ANT-X", "CARRIER-1", "ADAM-0")
"""In the study's order."""

SIGNIFICANT = 5
"""The study rounds to five significant digits and pads with zeros: -10.1650 stands for -10.1647."""


@cache
def printed() -> Mapping[str, Any]:
    """All of it; numbers with a point are `decimal.Decimal`, as printed."""
    path = Path(__file__).with_name("printed.toml")
    return tomllib.loads(path.read_text(encoding="utf-8"), parse_float=Decimal)


def digits(value: Decimal | int) -> int:
    """Decimals up to which a printed number can be trusted.

    Args:
        value: from `printed`.
    """
    exponent = Decimal(value).as_tuple().exponent
    decimals = -exponent if isinstance(exponent, int) else 0
    if not value:
        return max(decimals, 0)
    return min(decimals, SIGNIFICANT - 1 - math.floor(math.log10(abs(float(value)))))
