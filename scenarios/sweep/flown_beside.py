"""Flights of a sweep's best candidates beside the batch, as `flights/disagreements.json` tells them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenarios.limits import METRICS, TITLES
from scenarios.sweep.sweep_words import many, shown, unit_of
from sitl.errors import FileError
from sitl.plain_file import check_plain

DISAGREEMENTS = Path("flights") / "disagreements.json"


@dataclass(frozen=True)
class FlownBeside:
    """What was flown of a sweep.

    Attributes:
        data: of the file.
    """

    data: Mapping[str, Any]

    @property
    def flights(self) -> Sequence[Mapping[str, Any]]:
        """One by one, those that agree with the batch, too."""
        flights: Sequence[Mapping[str, Any]] = self.data["flights"]
        return flights

    @property
    def disagreements(self) -> list[Mapping[str, Any]]:
        """Those that differ in verdict, or in a metric by more than is tolerated."""
        return [one for one in self.flights if not one["agrees"]]

    @property
    def headline(self) -> str:
        """In one line."""
        agreeing = len(self.flights) - len(self.disagreements)
        return (
            f"Flown over MAVLink: {agreeing} of {many(len(self.flights), 'flight')} "
            f"agree{'s' * (agreeing == 1)} with the batch"
            + (":" if self.disagreements or self.data.get("left_out") else ".")
        )

    def lines(self) -> list[str]:
        """Every disagreement, and what was not flown."""
        lines = [
            f"candidate {one['candidate']}, {one['case_name']}, {autopilot(one)}: {self.difference(one)}"
            for one in self.disagreements
        ]
        for one in self.data.get("left_out", ()):
            who = "every candidate" if one["candidate"] is None else f"candidate {one['candidate']}"
            lines.append(f"not flown: {who}, {one['case_name']}: {one['reason']}")
        return lines

    def difference(self, one: Mapping[str, Any]) -> str:
        """How a flight differs from the batch, and what is known to set them apart.

        Args:
            one: of `flights`.
        """
        said = []
        if not one["verdicts_agree"]:
            why = f" ({one['reason']})" if one["reason"] else ""
            said.append(
                f"the batch {'passes' if one['batch_passes'] else 'fails'}, the flight is {one['outcome']}{why}"
            )
        said += [_apart(metric) for metric in one["metrics"] if metric["within"] is False]
        return "; ".join([*said, *one["reasons"]])


def autopilot(one: Mapping[str, Any]) -> str:
    """Whose autopilot flew.

    Args:
        one: a flight.
    """
    return "a real PX4" if one["autopilot"] == "px4" else "own autopilot"


def _apart(metric: Mapping[str, Any]) -> str:
    unit, factor = unit_of(metric["metric"])
    batch, flight = (
        "not measured" if metric[who] is None else f"{shown(metric[who] * factor)} {unit}".rstrip()
        for who in ("batch", "flight")
    )
    return f"{TITLES[metric['metric']]} {batch} by the batch, {flight} in flight"


def flown_beside(folder: Path) -> FlownBeside | None:
    """What was flown of a sweep; None if nothing was.

    Args:
        folder: of the sweep.

    Raises:
        FileError: the file is damaged.
    """
    path = folder / DISAGREEMENTS
    check_plain(path)
    try:
        flown = FlownBeside(json.loads(path.read_text(encoding="utf-8")))
        flown.lines()
        assert all(metric["metric"] in METRICS for one in flown.flights for metric in one["metrics"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AssertionError, RecursionError) as error:
        raise FileError(path, f"cannot be read: {error!r}", "Remove it, and fly the best again with --fly") from error
    return flown
