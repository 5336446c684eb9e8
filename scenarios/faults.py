"""Fault: something that goes wrong in a flight at a planned time, read from a scenario's [[fault]] tables.

[[fault]]
kind = "gust"
manoeuvre = "step"      # at_s counts from its first set-point; without it from the take-off command
at_s = 1.5
duration_s = 0.4        # without it until the last manoeuvre is over
side_force_n = 2.0
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.fault_kinds import KINDS, Where, read_settings
from scenarios.manoeuvres import MAX_DURATION_S, Manoeuvre
from sitl.errors import FileError, UsageError
from sitl.keyed_table import KeyedTable, nearest

if TYPE_CHECKING:
    from sitl.vehicle_spec import VehicleModel

MAX_FAULTS = 100
LATEST_S = 0.4
"""So late may datagrams of a vehicle elsewhere come: from one that is a second late it seems to have started anew."""

LONGEST_SILENCE_S = 3.0
"""So long a vehicle elsewhere may be cut off: after five seconds without a word of it a flight gives it up."""


@dataclass(frozen=True)
class Fault:
    """One planned fault.

    Attributes:
        kind: one of `scenarios.fault_kinds.KINDS`.
        at_s: when it begins: from the first set-point of the manoeuvre, or from the take-off command.
        manoeuvre: name of the manoeuvre; empty for the take-off.
        duration_s: how long it lasts; None: until the last manoeuvre is over.
        settings: the kind's own keys, defaults filled in.
    """

    kind: str
    at_s: float
    manoeuvre: str = ""
    duration_s: float | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """What it is, in a few words: "motor 2 out"."""
        return KINDS[self.kind].text(self.settings)

    @property
    def where(self) -> Where:
        """What it happens to."""
        return KINDS[self.kind].where

    @property
    def when(self) -> str:
        """The plan, in a few words: "1.5 s into step, for 0.4 s"."""
        begin = f"{self.at_s:g} s into {self.manoeuvre}" if self.manoeuvre else f"{self.at_s:g} s after the take-off"
        if self.lasts_by_itself:
            return begin
        return f"{begin}, " + ("to the end" if self.duration_s is None else f"for {self.duration_s:g} s")

    @property
    def lasts_by_itself(self) -> bool:
        """Its length is in its settings, or it has none."""
        return bool(KINDS[self.kind].lasts_by_itself)


def parse_faults(tables: Any, path: Path, manoeuvres: Sequence[Manoeuvre]) -> tuple[Fault, ...]:
    """Faults of a scenario file's [[fault]] tables; none if there are none.

    Args:
        tables: as read; None without any. path: of the file. manoeuvres: of the scenario.

    Raises:
        FileError: an unknown kind, key, manoeuvre or parameter, a missing key, or a number out of range.
    """
    if tables is None:
        return ()
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise FileError(path, "fault: is not a list of tables", 'Write [[fault]] kind = "gust", at_s = 5.0')
    if len(tables) > MAX_FAULTS:
        raise FileError(path, f"holds {len(tables)} faults", f"At most {MAX_FAULTS} are injected in one flight")
    lengths_s = {manoeuvre.name: manoeuvre.duration_s for manoeuvre in manoeuvres}
    return tuple(_parse(KeyedTable(path, raw, f"fault[{n}]"), lengths_s) for n, raw in enumerate(tables))


def _parse(table: KeyedTable, lengths_s: Mapping[str, float]) -> Fault:
    kind = table.text("kind")
    if kind not in KINDS:
        raise table.error("kind", f'unknown kind "{kind}"{nearest(kind, KINDS)}', f"Kinds are {', '.join(KINDS)}")
    manoeuvre = table.text("manoeuvre") if "manoeuvre" in table else ""
    if manoeuvre and manoeuvre not in lengths_s:
        problem = f'no manoeuvre is called "{manoeuvre}"{nearest(manoeuvre, lengths_s)}'
        raise table.error("manoeuvre", problem, f"This scenario flies {', '.join(lengths_s)}")
    at_s = table.number("at_s", at_least=0.0, at_most=MAX_DURATION_S)
    if manoeuvre and at_s >= lengths_s[manoeuvre]:
        problem = f"{at_s:g} is after the end of {manoeuvre}, which lasts {lengths_s[manoeuvre]:g} s"
        raise table.error("at_s", problem, "Begin sooner, or in a later manoeuvre")
    duration_s = None
    if "duration_s" in table:
        duration_s = table.number("duration_s", above=0.0, at_most=MAX_DURATION_S)
        if KINDS[kind].lasts_by_itself:
            raise table.error("duration_s", f"a {kind} has no duration of this kind", KINDS[kind].lasts_by_itself)
    settings = read_settings(kind, table)
    table.finish()
    return Fault(kind, at_s, manoeuvre, duration_s, settings)


def check_faults(faults: Sequence[Fault], model: VehicleModel, connect: str, plant: str = "") -> None:
    """Refuse what cannot be made to happen, before anything is flown.

    Args:
        faults: of the scenario. model: what flies. connect: URL of the vehicle's link.
        plant: where a real autopilot flies our plant: its simulator link, its serial port, or its build directory.

    Raises:
        UsageError: names the fault and what would do.
    """
    rotors = len(model.airframe.rotors)
    board = plant.startswith("serial")
    own_autopilot = not plant and connect.startswith("memory")
    foreign = not plant and not own_autopilot
    for number, fault in enumerate(faults):
        name = f"fault[{number}] ({fault.text})"
        motor = fault.settings.get("motor")
        if motor is not None and motor > rotors:
            raise UsageError(f"{name}: {model.name} has {rotors} motors; give motor = 1 to {rotors}")
        if fault.where is Where.AUTOPILOT and not own_autopilot:
            raise UsageError(
                f"{name}: only an autopilot of our own can be started anew in flight. Leave out --connect, --hil and "
                "--px4, or the fault"
            )
        if fault.where is Where.BODY and (foreign or board):
            flown_by = "a vehicle elsewhere has its own body" if foreign else "a board's plant is in another process"
            raise UsageError(
                f"{name}: {flown_by}, out of our reach. Leave out --connect (or fly a PX4 on our plant with --px4 or "
                "--hil tcpin://...), or leave out the fault"
            )
        if fault.where is Where.LINK:
            _check_link(name, fault, connect, elsewhere=foreign or board)


def _check_link(name: str, fault: Fault, link: str, *, elsewhere: bool) -> None:
    if link.startswith("tcp"):
        raise UsageError(f"{name}: {link} is a stream without datagrams to lose. Connect over udpin:// or udpout://")
    late_s = max(fault.settings.get("delay_s", 0.0), fault.settings.get("jitter_s", 0.0))
    if elsewhere and late_s > LATEST_S:
        raise UsageError(
            f"{name}: a vehicle elsewhere is known by the times that it sends, and would seem to have started anew. "
            f"Give {LATEST_S:g} s at most"
        )
    silent = fault.settings.get("loss_pct", 0.0) >= 100.0 and fault.settings["direction"] != "to_vehicle"
    if elsewhere and silent and (fault.duration_s is None or fault.duration_s > LONGEST_SILENCE_S):
        raise UsageError(
            f"{name}: a vehicle elsewhere that is cut off for long would be given up, not landed. Give duration_s of "
            f"{LONGEST_SILENCE_S:g} at most, or less loss_pct"
        )
