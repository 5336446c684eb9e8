"""What `froude restore` is asked to put back, and the putting back, one link after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.client import Client
from bridge.drive import ListeningDrive
from bridge.errors import PeerLost, PeerSilent
from bridge.link import open_link
from bridge.param_file import read_values
from bridge.peer_identity import PeerIdentity, ask_identity
from scenarios.journal_text import JournalEntry, Owner
from scenarios.param_journal import SUFFIX, Pending, pending, read_journal
from scenarios.pending_restore import RestoredParameter, give_back, settle
from sitl.errors import FileError, FroudeError

PATIENCE_S = 10.0
"""Silence after which the vehicle counts as absent, s."""

_PARAMS = ".params"
_BACKUPS = ("*.backup.params", "flights/*.backup.params")


@dataclass(frozen=True)
class RestoreTask:
    """What is to be put back from one file.

    Attributes:
        url: where to. owed: what is in the file. is_journal: it is deleted when all is back.
    """

    url: str
    owed: Pending
    is_journal: bool = True

    @property
    def path(self) -> Path:
        """The file."""
        return self.owed.path


@dataclass(frozen=True)
class RestoreResult:
    """What became of one task.

    Attributes:
        task: it. vehicle: who answered; None if nobody did.
        parameters: what was put back; None if it was put back by somebody else meanwhile.
        problem: why it was not; None if it was.
    """

    task: RestoreTask
    vehicle: PeerIdentity | None = None
    parameters: tuple[RestoredParameter, ...] | None = None
    problem: FroudeError | None = None


def find_tasks(what: Sequence[Path], connect: str | None) -> tuple[list[RestoreTask], list[FroudeError]]:
    """What was asked for, newest first, and what is wrong with the rest.

    A flight's backup is what the flights before it had left on the vehicle, so the oldest one holds the owner's values
    and is put back last.

    Args:
        what: journals, folders of runs, .params files; everything that is pending if empty.
        connect: link to use instead of the flights' own; None for these.
    """
    found: list[RestoreTask] = []
    problems: list[FroudeError] = []
    if not what:
        waiting, damaged = pending()
        found += [_of_journal(owed, connect) for owed in waiting]
        problems += damaged
    for path in what:
        try:
            found += _of_path(path, connect)
        except FileError as problem:
            problems.append(problem)
    unique = {task.path.resolve(): task for task in found}
    return sorted(unique.values(), key=_age, reverse=True), problems


def _age(task: RestoreTask) -> tuple[str, float]:
    try:
        return task.owed.owner.utc, task.path.stat().st_mtime
    except OSError:  # it went away meanwhile
        return task.owed.owner.utc, 0.0


def _of_path(path: Path, connect: str | None) -> list[RestoreTask]:
    """Tasks of one word of the command line. Raises FileError."""
    if path.is_dir():
        return _of_run(path, connect)
    if path.suffix == _PARAMS:
        return [_of_backup(path, connect)]
    if path.name.endswith(SUFFIX) or path.suffix == ".json":
        return [_of_journal(read_journal(path), connect)]
    remedy = "`froude restore --list` shows what is pending"
    if not path.exists():
        raise FileError(path, "does not exist", remedy)
    raise FileError(path, "is no journal, no folder of a run and no .params file", remedy)


def _of_journal(owed: Pending, connect: str | None) -> RestoreTask:
    return RestoreTask(connect or owed.owner.vehicle.url, owed)


def _of_run(folder: Path, connect: str | None) -> list[RestoreTask]:
    """The journals of a run; its backups if none is pending. Raises FileError."""
    waiting, _ = pending()
    mine = [owed for owed in waiting if owed.owner.run and Path(owed.owner.run).resolve() == folder.resolve()]
    if mine:
        return [_of_journal(owed, connect) for owed in mine]
    backups = [path for pattern in _BACKUPS for path in folder.glob(pattern)]
    if not backups:
        raise FileError(folder, "holds no backup of a vehicle's parameters", "Give the folder of a run")
    return [_of_backup(path, connect) for path in backups]


def _of_backup(path: Path, connect: str | None) -> RestoreTask:
    """A .params file, which does not say whose it is. Raises FileError."""
    values = read_values(path)
    if connect is None:
        problem = "no journal is pending for it, and the file does not say which vehicle it is of"
        raise FileError(path, problem, "Say where the vehicle is, such as --connect udpin://127.0.0.1:14540")
    entries = tuple(JournalEntry(name, value) for name, value in values.items())
    return RestoreTask(connect, Pending(path, Owner(PeerIdentity(connect, 0)), entries), is_journal=False)


def restore(
    tasks: Sequence[RestoreTask], *, any_vehicle: bool, show: Callable[[str], object] = lambda _: None
) -> Iterator[RestoreResult]:
    """Put back, link by link; what cannot be done is a result, too.

    Args:
        tasks: in order. any_vehicle: also onto another vehicle than the one they are of.
        show: called with what is being done.
    """
    for url in dict.fromkeys(task.url for task in tasks):
        group = [task for task in tasks if task.url == url]
        show(f"waiting for the vehicle at {url}")
        try:
            link = open_link(url)
        except FroudeError as problem:
            yield from (RestoreResult(task, problem=problem) for task in group)
            continue
        with link:
            yield from _over(Client(link, ListeningDrive(PATIENCE_S)), url, group, any_vehicle, show)


def _over(
    client: Client, url: str, tasks: Sequence[RestoreTask], any_vehicle: bool, show: Callable[[str], object]
) -> Iterator[RestoreResult]:
    """Everything that is owed to the vehicle on one link."""
    vehicle: PeerIdentity | None = None
    gone: FroudeError | None = None
    for task in tasks:
        if gone is not None:
            yield RestoreResult(task, vehicle, problem=gone)
            continue
        try:
            if vehicle is None:
                client.connect(PATIENCE_S)
                vehicle = ask_identity(client, url)
            show(f"putting back {len(task.owed.entries)} parameters onto {vehicle}")
            if task.is_journal:
                done = settle(client, vehicle, task.owed, any_vehicle=any_vehicle)
            else:
                done = give_back(client, task.owed.entries)
        except FroudeError as problem:
            gone = problem if isinstance(problem, PeerLost | PeerSilent) else None
            yield RestoreResult(task, vehicle, problem=problem)
        else:
            yield RestoreResult(task, vehicle, done)
