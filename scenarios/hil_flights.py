"""The flights of a run with a real autopilot: one that is there already, or a PX4 started anew for each."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from scenarios.board_session import BoardSession
from scenarios.flight import FlightRecord
from scenarios.flown import Flown, Progress
from scenarios.hil_session import HilSession
from scenarios.one_flight import FlightJob, FlightStoppedError, fly
from scenarios.plant_session import PlantSession
from scenarios.px4_process import Px4Process, free_instance
from sitl.errors import FroudeError

Say = Callable[[str], object]


def fly_with_autopilot(
    jobs: Sequence[FlightJob],
    *,
    hil: str,
    px4: Path | None,
    say: Say,
    progress: Callable[[Progress], object],
) -> Flown:
    """Fly every job with a real autopilot on our plant.

    Args:
        jobs: in order; their `connect` is the autopilot's MAVLink, unless `px4` is given.
        hil: link of the simulator's protocol, or a board's serial port. px4: build directory; its own instance flies
            every job, fresh.
        say: called with a line for people. progress: called at every phase of every flight.

    Returns:
        the records; what stopped the run, if anything did.
    """
    flown = Flown()
    with ExitStack() as stack:
        shared: HilSession | BoardSession | None = None
        for index, job in enumerate(jobs):
            try:
                if px4 is None:
                    if shared is None:
                        shared = _session(hil, job, say)
                        stack.enter_context(shared)
                    flown.records[index] = _fly(index, jobs, shared, progress, say)
                else:
                    with _own_autopilot(px4, job, say) as session:
                        flown.records[index] = _fly(index, jobs, session, progress, say)
            except FlightStoppedError as stop:
                flown.records[index] = stop.record
                flown.stopped, flown.owed = stop.cause, "" if px4 is not None else stop.owed
                break
            except (FroudeError, KeyboardInterrupt) as stop:
                flown.stopped = stop
                break
    return flown


def _fly(
    index: int,
    jobs: Sequence[FlightJob],
    session: PlantSession,
    progress: Callable[[Progress], object],
    say: Say,
) -> FlightRecord:
    job = jobs[index]
    session.begin()
    return fly(job, lambda phase: progress(Progress(index, len(jobs), job.gain_set.name, phase)), session, say)


def _session(hil: str, job: FlightJob, say: Say) -> HilSession | BoardSession:
    if hil.startswith("serial"):
        return BoardSession(hil, job.model, job.profile, seed=job.scenario.seed, may_arm=True, say=say)
    return HilSession(hil, job.connect, job.model, job.profile, seed=job.scenario.seed, say=say)


@contextmanager
def _own_autopilot(build: Path, job: FlightJob, say: Say) -> Iterator[HilSession]:
    """A PX4 of one flight's own: nothing of an earlier flight can be in it."""
    with ExitStack() as stack:
        if job.folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="froude-px4-")))
        else:
            folder = job.folder.parent / "px4" / job.gain_set.slug
        process = Px4Process(build, folder, free_instance())
        session = stack.enter_context(
            HilSession(
                process.simulator_url, process.connect_url, job.model, job.profile, seed=job.scenario.seed, say=say
            )
        )
        session.drive.alive = process.check
        stack.enter_context(process)
        yield session
