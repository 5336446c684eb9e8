"""ParamLoan: parameters borrowed from a vehicle for one flight: read, kept on disk, set, put back.

Nothing is sent before the journal is on disk, and the journal goes only when every value was put back and read back. A
flight that ends in any other way leaves it to `froude restore`, or to the next flight of the same vehicle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from bridge.client import Client
from bridge.param_operation import ParamValue
from bridge.param_restore import put_back, touched_by
from bridge.peer_identity import ask_identity
from scenarios import interrupts
from scenarios.journal_text import JournalEntry, Owner
from scenarios.param_journal import ParamJournal
from scenarios.pending_restore import restore_first
from sitl.parameters import ParameterType, to_raw

Values = Mapping[str, tuple[float | int, ParameterType]]


class ParamLoan:
    """What one flight has borrowed.

    Args:
        client: connected. owner: whose the parameters are; None for a vehicle of our own, which needs no journal.

    Attributes:
        was: name -> what it was, of everything backed up so far.
    """

    def __init__(self, client: Client, owner: Owner | None) -> None:
        self.was: dict[str, ParamValue] = {}
        self._client = client
        self._owner = owner
        self._journal: ParamJournal | None = None
        self._sent = False

    def back_up(self, values: Values) -> None:
        """Read what is to be set, and what the vehicle may change then, and write it down.

        Args:
            values: name -> (value, type) that will be set; names that are backed up already keep their first value.

        Raises:
            UploadFailed: a parameter does not exist or does not come.
            FileError: the journal cannot be written; nothing may be set then, and nothing has been.
        """
        new = [name for name in touched_by(values) if name not in self.was]
        if not new:
            return
        read = self._client.read_parameters(new)
        wanted = {name: ParamValue(type_, to_raw(name, type_, value)) for name, (value, type_) in values.items()}
        entries = [JournalEntry(name, value, wanted.get(name)) for name, value in read.items()]
        if self._owner is not None:
            with interrupts.held():
                if self._journal is None:
                    self._journal = ParamJournal.begin(self._owner, entries)
                else:
                    self._journal.extend(entries)
        self.was.update(read)

    def set(self, values: Values) -> None:
        """Set parameters and read them back; what is not backed up yet is backed up first.

        Args:
            values: name -> (value, type).

        Raises:
            UploadFailed: one is not on the vehicle exactly as asked. FileError: as `back_up`.
        """
        self.back_up(values)
        self._sent = True
        self._client.upload(values)

    def give_back(self) -> None:
        """Put everything back, read it back, delete the journal; nothing happens where nothing is owed.

        Raises:
            StillArmed, UploadFailed, LinkError: it did not work; the journal stays.
        """
        if self._sent:
            put_back(self._client, self.was)
        with interrupts.held():
            self._sent = False
            if self._journal is not None:
                self._journal.remove()

    @property
    def is_owed(self) -> bool:
        """Something was set and has not been put back."""
        return self._sent

    def close(self) -> None:
        """End the loan as it is; what is owed stays on disk, a journal of nothing that was sent does not."""
        if self._journal is not None:
            if self._sent:
                self._journal.close()
            else:
                self._journal.remove()

    def owed(self, backup: Path | None) -> str:
        """What is left to do on the vehicle, in a sentence; empty if nothing, or if the vehicle is our own.

        Args:
            backup: the run's own copy of the old values, if one is kept.
        """
        if not self._sent or self._journal is None:
            return ""
        also = f", and in {backup}" if backup is not None else ""
        return (
            "The vehicle's own parameters were NOT restored: run `froude restore` (they are in "
            f"{self._journal.path}{also})"
        )


def open_loan(
    client: Client,
    url: str,
    *,
    gain_set: str,
    folder: Path | None,
    command: tuple[str, ...],
    tell: Callable[[str], object],
) -> ParamLoan:
    """Begin a loan from a vehicle that is not ours, after what an earlier flight owes it has been given back.

    Args:
        client: connected. url: of its link. gain_set: what will be flown. folder: of the flight's files.
        command: as typed. tell: called with a sentence for people and for the record.

    Raises:
        StillArmed, UploadFailed, LinkError: something is owed and could not be given back.
    """
    vehicle = ask_identity(client, url)
    restore_first(client, vehicle, tell)
    run = "" if folder is None else str(folder.parent.absolute())
    return ParamLoan(client, Owner(vehicle, gain_set, run, command))
