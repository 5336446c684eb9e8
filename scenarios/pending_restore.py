"""What earlier flights still owe to a vehicle, given back: by `froude restore`, and before the next flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bridge.client import Client
from bridge.param_operation import ParamValue
from bridge.param_restore import StillArmed, await_parameters, put_back
from bridge.peer_identity import Match, OtherVehicle, PeerIdentity
from scenarios import interrupts
from scenarios.journal_text import JournalEntry
from scenarios.param_journal import ParamJournal, Pending, pending


@dataclass(frozen=True, slots=True)
class RestoredParameter:
    """One parameter that was put back.

    Attributes:
        entry: what it is again. before: what the vehicle held until then.
    """

    entry: JournalEntry
    before: ParamValue

    @property
    def name(self) -> str:
        """Of the parameter."""
        return self.entry.name

    @property
    def changed(self) -> bool:
        """It was not right already."""
        return self.before != self.entry.value

    @property
    def by_others(self) -> bool:
        """Somebody changed it since: it was neither what had been there nor what a flight had set."""
        return self.changed and self.entry.set_to is not None and self.before != self.entry.set_to


def give_back(client: Client, entries: tuple[JournalEntry, ...]) -> tuple[RestoredParameter, ...]:
    """Put parameters back and read them back.

    Args:
        client: connected. entries: what they were.

    Returns:
        what became of each, in order.

    Raises:
        StillArmed, UploadFailed, LinkError: they are not all back.
    """
    if not entries:
        return ()
    if client.state.armed:
        raise StillArmed(client.link.name)
    values = {entry.name: entry.value for entry in entries}
    await_parameters(client, entries[0].name)
    before = client.read_parameters(values)
    put_back(client, values)
    return tuple(RestoredParameter(entry, before[entry.name]) for entry in entries)


def settle(
    client: Client, vehicle: PeerIdentity, owed: Pending, *, any_vehicle: bool = False
) -> tuple[RestoredParameter, ...] | None:
    """Give back what one journal owes and delete it.

    Args:
        client: connected. vehicle: who it is. owed: the journal as it was read.
        any_vehicle: restore it even onto another vehicle than its own.

    Returns:
        what became of each parameter; None if the journal has gone meanwhile, so that nothing is owed.

    Raises:
        OtherVehicle: it is not this vehicle's. JournalBusy: a flight is under way.
        StillArmed, UploadFailed, LinkError: they are not all back; the journal stays.
        FileError: it was damaged meanwhile.
    """
    if not any_vehicle and owed.owner.vehicle.match(vehicle) is Match.OTHER:
        remedy = "Connect to its own vehicle, or say --yes-other-vehicle"
        raise OtherVehicle(vehicle, owed.owner.vehicle, remedy)
    journal = ParamJournal.take(owed.path)
    if journal is None:
        return None
    try:
        done = give_back(client, journal.entries)
        with interrupts.held():
            journal.remove()
    finally:
        journal.close()
    return done


def restore_first(client: Client, vehicle: PeerIdentity, tell: Callable[[str], object]) -> None:
    """Before a flight: give back what earlier ones owe to this vehicle, so that its backup is the owner's.

    Args:
        client: connected. vehicle: who it is. tell: called with a sentence for people and for the record.

    Raises:
        StillArmed, UploadFailed, JournalBusy, LinkError: it could not be given back; the journal stays.
    """
    found, problems = pending()
    for problem in problems:
        tell(str(problem))
    # newest first: each backup is older than what the flights after it found, and the oldest one is the owner's
    for owed in reversed(found):
        match = owed.owner.vehicle.match(vehicle)
        if match is Match.POSSIBLE:
            tell(
                f"{owed.path} may be owed to this vehicle (it was met at {owed.owner.vehicle.url}); see "
                "`froude restore --list`"
            )
        if match is not Match.SAME:
            continue
        done = settle(client, vehicle, owed)
        if done is not None:
            tell(summary(owed, done))


def summary(owed: Pending, done: tuple[RestoredParameter, ...]) -> str:
    """What was given back, in a sentence.

    Args:
        owed: the journal. done: what became of it.
    """
    changed = [one.name for one in done if one.changed]
    others = [one.name for one in done if one.by_others]
    of = f" (gain set {owed.owner.gain_set})" if owed.owner.gain_set else ""
    text = (
        f"parameters put back that an earlier flight{of} of {owed.owner.utc} had left: {len(done)}, "
        f"{len(changed)} of them had been changed"
    )
    return text + (f"; by somebody else since: {', '.join(others)}" if others else "")
