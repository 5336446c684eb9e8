"""What a run writes at its end: `run.json`, JUnit XML, the comparison, the report that was begun when it took off."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from scenarios.flight import FlightRecord, RunRecord
from scenarios.flight_job import FlightJob
from scenarios.run_folder import RunFolder, flight_object, run_object

if TYPE_CHECKING:
    from scenarios.report.drafting import ReportDraft


def report_draft(known: RunRecord, jobs: Sequence[FlightJob], candidates: int, real_time: bool) -> ReportDraft:
    """The report of a run that is about to be flown; a context manager.

    Args:
        known: the run without its flights. jobs: what will be flown. candidates: the first so many are; the baseline
            follows.
        real_time: somebody flies who cannot wait, a real autopilot or a vehicle elsewhere.
    """
    from scenarios.report.drafting import ReportDraft

    sets = [
        {
            "name": job.gain_set.name,
            "baseline": number >= candidates,
            "uploaded": {name: value for name, (value, _) in job.parameters.items()},
        }
        for number, job in enumerate(jobs)
    ]
    return ReportDraft(run_object(known), sets, behind=real_time)


def tell_landed(draft: ReportDraft | None, folder: RunFolder | None, number: int, record: FlightRecord) -> None:
    """Tell the report of a flight that is over.

    Args:
        draft: of the report; None for no report. folder: of the run. number: in the order of the run.
        record: of the flight.
    """
    if draft is not None and folder is not None and len(record.telemetry):
        draft.landed(number, flight_object(record), folder.flight_file(record.gain_set.slug, ".parquet"))


def write_run(
    run: RunRecord,
    folder: RunFolder,
    command: Sequence[str],
    draft: ReportDraft | None,
    say: Callable[[str], object],
) -> None:
    """Write the run's own files; `run.json` first, so that it is there even if there is no room for the others.

    Args:
        run: as flown. folder: of the run. command: as typed. draft: of the report; None for no report.
        say: called with a line for people if there is no report.

    Raises:
        FileError: a file cannot be written; the report alone is no reason.
    """
    from scenarios.junit import write_junit
    from scenarios.recorder.comparison import record_compare
    from sitl.batch import fly_lanes
    from sitl.compiled import is_compiled

    folder.write_run_json(run, command)
    if draft is not None:
        draft.begin(folder.path)
    try:
        write_junit(run, folder.path / "junit.xml")
        if draft is not None and not is_compiled(fly_lanes):
            # the very first run: what the comparison needs is being compiled by the report's helper
            _finish(draft, say)
            draft = None
        record_compare(run, folder.compare)
    finally:
        if draft is not None:
            _finish(draft, say)


def _finish(draft: ReportDraft, say: Callable[[str], object]) -> None:
    try:
        draft.finish()
    except Exception as error:  # whatever it is, the flights are worth more than the page
        say(f"warning: no report: {error}")
