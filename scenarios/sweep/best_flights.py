"""Candidates of a sweep flown over MAVLink by the ordinary runner, in every case, to see whether the batch was right.

    <sweep folder>/flights/
        flown.json              which candidate was flown in which case by whose autopilot, and in which run
        disagreements.json      where batch and flight differ
        <run's folder>/ ...     as of any other run: one a case

What was flown once is not flown again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.gain_set import GainSet
from scenarios.run_folder import RUN_JSON, write_atomically
from scenarios.scenario import Scenario
from scenarios.sweep.axes import ASSUMPTIONS, PROFILE_ITEMS
from scenarios.sweep.dataset import Dataset
from scenarios.sweep.evaluation import ERROR
from scenarios.sweep.plan import Case, Plan
from sitl.body import RATE_HZ
from sitl.errors import FileError, FroudeError
from sitl.parameters import parameter_specs
from sitl.plain_file import check_plain
from sitl.profile import get_profile

if TYPE_CHECKING:
    from scenarios.flight import FlightRecord
    from scenarios.flown import Progress
    from scenarios.runner import RunResult

FLIGHTS, FLOWN_JSON = "flights", "flown.json"
SCHEMA_VERSION = 1
OWN, PX4 = "own", "px4"
"""Whose autopilot flew: ours, or a real PX4."""

STOPPED = "flight stopped: "
"""How the event of a flight begins that was broken off."""

Tell = Callable[[str], object]


@dataclass(frozen=True)
class FlownPoint:
    """A candidate that was flown in a case.

    Attributes:
        candidate, case: numbers. autopilot: OWN or PX4. run: name of the run's folder in `flights`.
        fingerprint: of the plan.
    """

    candidate: int
    case: int
    autopilot: str
    run: str
    fingerprint: str


@dataclass(frozen=True)
class LeftOut:
    """What was not flown.

    Attributes:
        case: number. candidate: number; None for all of them. autopilot: OWN or PX4. reason: in a line.
    """

    case: int
    candidate: int | None
    autopilot: str
    reason: str


@dataclass(frozen=True)
class Flights:
    """What there is of flights.

    Attributes:
        points: of the candidates asked for, flown now or earlier. left_out: what was not. stopped: what ended it early.
    """

    points: tuple[FlownPoint, ...]
    left_out: tuple[LeftOut, ...]
    stopped: BaseException | None = None


class BestFlights:
    """Flies candidates of a sweep.

    Args:
        plan: of the sweep. dataset: its points, locked.
        px4: build directory of a PX4 that flies them, too; None for our own autopilot alone.
        jobs: flights of our own at a time; 0 takes every core. command: as typed. tell: prints a line for people.
    """

    def __init__(
        self,
        plan: Plan,
        dataset: Dataset,
        *,
        px4: Path | None = None,
        jobs: int = 0,
        command: Sequence[str] = (),
        tell: Tell = lambda _: None,
    ) -> None:
        self.plan = plan
        self.folder = dataset.path / FLIGHTS
        self._dataset, self._px4, self._jobs = dataset, px4, jobs or os.cpu_count() or 1
        self._command, self._tell = tuple(command), tell

    def fly(self, candidates: Sequence[int]) -> Flights:
        """Fly what has not been flown yet, case by case.

        Args:
            candidates: numbers, the best first.

        Returns:
            what there is; an interrupt or a dead link ends it early and is not raised.

        Raises:
            FileError: the index of the flights cannot be read or written.
        """
        left: list[LeftOut] = []
        stopped: BaseException | None = None
        for number, case in enumerate(self.plan.cases):
            rows = {one: row_of(self.plan, self._dataset, one, number) for one in candidates}
            left += [LeftOut(number, one, OWN, str(row["reason"])) for one, row in rows.items() if _failed(row)]
            rows = {one: row for one, row in rows.items() if not _failed(row)}
            if self._px4 is not None and (reason := px4_reason(case)):
                left.append(LeftOut(number, None, PX4, reason))
                self._tell(f"{case.name}: not flown by the PX4: {reason}")
            try:
                stopped = self._fly_case(number, rows)
            except (FroudeError, KeyboardInterrupt) as stop:
                stopped = stop
            if stopped is not None:
                break
        wanted = set(candidates)
        points = tuple(one for one in self.flown() if one.candidate in wanted)
        return Flights(points, tuple(left), stopped)

    def _fly_case(self, number: int, rows: Mapping[int, Mapping[str, Any]]) -> BaseException | None:
        have = _keys(self.flown())
        if self._px4 is not None and not px4_reason(self.plan.cases[number]):
            real = {one: row for one, row in rows.items() if (one, number, PX4) not in have}
            # our own autopilot flies beside it anyway, unless it has done so before
            beside = any((one, number, OWN) not in have for one in real)
            if real and (stopped := self._run(number, real, self._px4, beside)) is not None:
                return stopped
            have = _keys(self.flown())
        own = {one: row for one, row in rows.items() if (one, number, OWN) not in have}
        return self._run(number, own, None, False) if own else None

    def _run(
        self, number: int, rows: Mapping[int, Mapping[str, Any]], px4: Path | None, beside: bool
    ) -> BaseException | None:
        """One run; what it has flown to the end is put down, whatever stopped it."""
        from scenarios.runner import RunOptions, run_scenario

        case = self.plan.cases[number]
        who = "a PX4" if px4 is not None else "our own autopilot"
        self._tell(f"flying {len(rows)} candidate{'s' * (len(rows) > 1)} with {who}: {case.name}")
        # processes of their own are worth their start from a few flights on
        jobs = 1 if px4 is not None or len(rows) < 3 else self._jobs
        sets = {one: gain_set_of(self.plan, number, row, real=px4 is not None) for one, row in rows.items()}
        options = RunOptions(out=self.folder, px4=px4, twin=beside, jobs=jobs, command=self._command, say=self._tell)
        with _bar() as show:
            result = run_scenario(scenario_of(self.plan, number), options, show, list(sets.values()))
        named = {gain_set.name: one for one, gain_set in sets.items()}
        self._put_down(result, number, named, OWN if px4 is None else PX4)
        return result.stopped

    def _put_down(self, result: RunResult, case: int, candidates: Mapping[str, int], autopilot: str) -> None:
        run = result.folder
        if run is None or not (run / RUN_JSON).is_file():
            return

        def made(records: Iterable[FlightRecord], who: str) -> list[FlownPoint]:
            return [
                FlownPoint(candidates[one.gain_set.name], case, who, run.name, self.plan.fingerprint)
                for one in records
                if one.gain_set.name in candidates and not any(e.text.startswith(STOPPED) for e in one.events)
            ]

        found = made(result.run.flights, autopilot) + made((twin.own for twin in result.run.twins), OWN)
        known = [one for one in self.flown() if (one.candidate, one.case, one.autopilot) not in _keys(found)]
        kept = {"schema_version": SCHEMA_VERSION, "flights": [asdict(one) for one in sorted(known + found, key=_order)]}
        write_atomically(self.folder / FLOWN_JSON, json.dumps(kept, indent=2).encode() + b"\n")

    def flown(self) -> list[FlownPoint]:
        """Everything that was flown for this plan and whose run is still there.

        Raises:
            FileError: the index cannot be read.
        """
        path = self.folder / FLOWN_JSON
        check_plain(path)
        try:
            known = json.loads(path.read_text(encoding="utf-8"))
            points = [FlownPoint(**one) for one in known["flights"]]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise FileError(path, f"cannot be read: {error}", "Remove it: everything is then flown again") from error
        there = [one for one in points if one.fingerprint == self.plan.fingerprint]
        return [one for one in there if (self.folder / one.run / RUN_JSON).is_file()]


def _order(point: FlownPoint) -> tuple[int, int, str]:
    return point.candidate, point.case, point.autopilot


def _keys(points: Iterable[FlownPoint]) -> set[tuple[int, int, str]]:
    return {_order(one) for one in points}


def _failed(row: Mapping[str, Any]) -> bool:
    return bool(row["outcome"] == ERROR)


def row_of(plan: Plan, dataset: Dataset, candidate: int, case: int) -> dict[str, Any]:
    """The row of a point.

    Args:
        plan: of the sweep. dataset: that holds it. candidate, case: numbers.

    Raises:
        FileError: it is not there.
    """
    chunk = plan.chunk(candidate // plan.block * len(plan.cases) + case)
    rows = dataset.read(chunks=[chunk.number]).slice(candidate - chunk.start, 1).to_pylist()
    if not rows or rows[0]["candidate"] != candidate:
        raise FileError(dataset.file(chunk.number), f"holds no candidate {candidate}", "Go on with --resume")
    return dict(rows[0])


def scenario_of(plan: Plan, number: int) -> Scenario:
    """What the runner flies in a case.

    Args:
        plan: of the sweep. number: of the case.
    """
    sweep, case = plan.sweep, plan.cases[number]
    return Scenario(
        name=sweep.name if len(plan.cases) == 1 else f"{sweep.name}-case-{number}",
        title=f"{sweep.title}: {case.name}",
        vehicle=case.model.spec,
        scaling=tuple(sorted(case.model.scaling)),
        profile=case.profile.name,
        overrides={name: value for name, value in case.conditions.items() if name in PROFILE_ITEMS},
        assumptions={name: float(value) for name, value in case.conditions.items() if name in ASSUMPTIONS},
        axes="roll",
        takeoff_altitude_m=10.0,
        setpoint_rate_hz=sweep.setpoint_rate_hz,
        seed=sweep.seed,
        gain_sets=(),
        manoeuvres=sweep.manoeuvres,
        limits=sweep.limits,
        limits_name=sweep.limits_name,
        path=sweep.path,
    )


def gain_set_of(plan: Plan, number: int, row: Mapping[str, Any], *, real: bool = False) -> GainSet:
    """A candidate as a gain set, with the sweep's fixed parameters.

    Args:
        plan: of the sweep. number: of the case. row: of the point.
        real: for an autopilot that does not know the case's filter cutoffs and hover thrust unless it is told.
    """
    case = plan.cases[number]
    own: dict[str, float] = {}
    if real:
        own = {"IMU_GYRO_CUTOFF": case.profile.gyro_cutoff_hz, "IMU_DGYRO_CUTOFF": case.profile.dgyro_cutoff_hz}
        if "hover_thrust" in case.conditions:
            own["MPC_THR_HOVER"] = case.model.assumptions.hover_thrust
    varied = {axis.name: row[axis.name] for axis in plan.sweep.parameters}
    specs = parameter_specs()
    typed = {
        name: int(value) if specs[name].type == "INT32" else float(value)
        for name, value in {**own, **plan.sweep.fixed, **varied}.items()
    }
    return GainSet(f"candidate {row['candidate']}", typed, f"sweep {plan.sweep.name}", "", plan.sweep.path)


def px4_reason(case: Case) -> str:
    """Why a real PX4 cannot fly a case as the batch does; empty if it can.

    Args:
        case: of the plan.
    """
    profile, sitl = case.profile, get_profile("sitl")
    if profile.linear:
        return "it needs attitude, gravity and all axes, not the linear model of the roll axis alone"
    if not profile.limits:
        return "limits = false, and its limits cannot be switched off"
    if profile.rate_hz != RATE_HZ:
        return f"rate_hz = {profile.rate_hz}, and with a simulator it runs at {RATE_HZ} Hz"
    for name in ("attitude_late_ticks", "rate_sp_late_ticks"):
        if getattr(profile, name) != getattr(sitl, name):
            return f"{name} = {getattr(profile, name):g}, and in a PX4 it is {getattr(sitl, name):g}"
    return ""


def _bar() -> AbstractContextManager[Callable[[Progress], object]]:
    import sys

    if sys.stderr is None or not sys.stderr.isatty():
        return nullcontext(lambda _: None)
    from scenarios.progress import progress_bar

    return progress_bar()
