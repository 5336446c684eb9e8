"""The best candidates of a sweep chosen, flown, and compared with what the batch says of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from scenarios.sweep.best_flights import FLIGHTS, BestFlights, Flights
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.disagreements import compare_flights, disagreements_text, write_disagreements
from scenarios.sweep.flight_comparison import Comparison
from scenarios.sweep.plan import Plan
from scenarios.sweep.program import program_facts
from scenarios.sweep.ranking import rank
from scenarios.sweep.resuming import plan_of
from scenarios.sweep.stored_sweep import stored_sweep
from sitl.errors import UsageError

Tell = Callable[[str], object]


def fly_best(
    path: Path,
    count: int,
    *,
    source: Path | None = None,
    px4: Path | None = None,
    jobs: int = 0,
    command: Sequence[str] = (),
    tell: Tell = lambda _: None,
) -> str:
    """Fly the best candidates in every case, and write down where batch and flights differ.

    Args:
        path: of the sweep's folder. count: how many candidates.
        source: the sweep file; where it was read from without. px4, jobs, command, tell: as `BestFlights`.

    Returns:
        the comparison, for people.

    Raises:
        UsageError: no candidate is complete.
        FileError: the sweep cannot be read, or something not be written.
        FroudeError, KeyboardInterrupt: what stopped the flights; those before it are kept and compared.
    """
    dataset = Dataset(path)
    plan = plan_of(dataset, source, same_program=False)
    if dataset.facts().get("program") != program_facts()["program"]:
        tell(
            "the batch was flown by another version of the program than the flights are: that alone may set them apart"
        )
    with dataset.locked():
        best = [int(one) for one in rank(stored_sweep(path)).order[:count]]
        if not best:
            raise UsageError(f"{path}: no candidate is complete yet, none can be flown. Go on with --resume {path}")
        if len(best) < count:
            tell(f"--fly {count}: there are {len(best)} candidates; all are flown")
        flown = BestFlights(plan, dataset, px4=px4, jobs=jobs, command=command, tell=tell)
        flights = flown.fly(best)
        found = compared(plan, dataset, flights)
    if flights.stopped is not None:
        tell(f"stopped; what was flown is kept. Go on with: froude sweep --show {path} --fly {count}")
        raise flights.stopped
    return disagreements_text(plan, found, flights)


def compared(plan: Plan, dataset: Dataset, flights: Flights) -> tuple[Comparison, ...]:
    """Compare flights and write `disagreements.json`.

    Args:
        plan, dataset: of the sweep. flights: flown.
    """
    folder = dataset.path / FLIGHTS
    found = compare_flights(plan, dataset, flights, folder)
    if found or folder.is_dir():
        write_disagreements(folder, plan, found, flights)
    return found
