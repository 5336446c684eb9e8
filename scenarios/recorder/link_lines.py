"""How the link to the vehicle did: counters over time, and a page that sums them up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from scenarios.recorder.blueprints import PALETTE
from scenarios.recorder.stream import Colour

if TYPE_CHECKING:
    from bridge.framing import Counters
    from scenarios.flight import Segment
    from scenarios.telemetry import Telemetry

LINK_NAMES = ("lost [messages]", "late or twice [messages]", "damaged [messages]")
LINK_COLOURS: tuple[Colour, ...] = (PALETTE[5], PALETTE[1], PALETTE[3])


@dataclass(frozen=True)
class LinkCounts:
    """What a connection has counted so far.

    Attributes:
        received: messages. lost: missing from the packet numbers. late: overtaken, or twice. damaged: wrong checksum.
        stray_bytes: that belong to no message.
    """

    received: int = 0
    lost: int = 0
    late: int = 0
    damaged: int = 0
    stray_bytes: int = 0

    @classmethod
    def of(cls, counters: Counters) -> LinkCounts:
        """The counters as they are now."""
        return cls(counters.received, counters.lost, counters.late, counters.bad_crc, counters.bad_bytes)

    def lines(self) -> tuple[int, int, int]:
        """Values of the lines `LINK_NAMES`."""
        return self.lost, self.late, self.damaged


def link_figures(counts: LinkCounts, telemetry: Telemetry, segments: Sequence[Segment]) -> dict[str, Any]:
    """Facts on the link, unit in the name.

    Args:
        counts: at the end of the flight. telemetry: of the flight. segments: what of it was measured.

    Returns:
        name -> number; the rate and the gap are those of the measured parts, None without any.
    """
    heard = counts.received + counts.lost
    gaps = np.concatenate([np.diff(telemetry.between(s.start_s, s.end_s)["t_s"]) for s in segments] or [np.zeros(0)])
    return {
        "messages_received": counts.received,
        "messages_lost": counts.lost,
        "messages_lost_pct": 100.0 * counts.lost / heard if heard else None,
        "messages_late": counts.late,
        "messages_damaged": counts.damaged,
        "stray_bytes": counts.stray_bytes,
        "telemetry_rate_hz": float(1.0 / gaps.mean()) if gaps.size else None,
        "telemetry_median_interval_ms": float(1e3 * np.median(gaps)) if gaps.size else None,
        "telemetry_longest_gap_ms": float(1e3 * gaps.max()) if gaps.size else None,
    }


def link_page(figures: Mapping[str, Any], timing: str) -> str:
    """The figures as markdown.

    Args:
        figures: of `link_figures`. timing: how a real autopilot and our plant kept time; empty where none flew.
    """
    from scenarios.markdown import markdown_table

    rows = [(name, "–" if value is None else _text(value)) for name, value in figures.items()]
    parts = ["# Link", markdown_table(("figure", "value"), rows)]
    parts += [
        "Rate, interval and gap are those of what was measured; on the way there telemetry is slower. Lost are "
        "messages missing from the vehicle's packet numbers."
    ]
    if timing:
        parts += ["## Time", timing]
    return "\n\n".join(parts) + "\n"


def _text(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.4g}" if math.isfinite(value) else "–"
