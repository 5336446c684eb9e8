"""Flights for tests: what the pytest fixture `froude` gives, and what its failures say."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.limits import Outcome

if TYPE_CHECKING:
    from scenarios.analysis import Analysis
    from scenarios.flight import FlightRecord, RunRecord
    from scenarios.scenario import Scenario

SHARE = 0.95
"""Of the uncertain models that must pass unless a test says otherwise."""

Names = str | Path | Sequence[str | Path]


class Verdict:
    """True or false, and why in a line: what `assert ... .passes()` shows.

    Args:
        passed: did everything pass? said: in a line.
    """

    def __init__(self, passed: bool, said: str) -> None:
        self._passed = passed
        self._said = said

    def __bool__(self) -> bool:
        return self._passed

    def __repr__(self) -> str:
        return self._said


@dataclass(frozen=True)
class FlownSets:
    """Flights of one call.

    Attributes:
        run: its record. folder: where it is kept.
    """

    run: RunRecord
    folder: Path

    @property
    def flights(self) -> tuple[FlightRecord, ...]:
        """One per gain set, in the order asked for."""
        return self.run.flights

    def flight(self, name: str) -> FlightRecord:
        """The flight of a gain set.

        Args:
            name: of the set, or its file name.

        Raises:
            KeyError: no such set; names those there are.
        """
        for flight in self.run.flights:
            if name in (flight.gain_set.name, flight.gain_set.slug):
                return flight
        raise KeyError(f"no gain set {name!r}; there is {', '.join(one.gain_set.name for one in self.run.flights)}")

    def passes(self, *names: str) -> Verdict:
        """Do these gain sets pass? UNSET and INFO are no pass.

        Args:
            names: of gain sets; all of them if none is given.
        """
        flights = [self.flight(name) for name in names] or list(self.run.flights)
        bad = [flight for flight in flights if flight.outcome is not Outcome.PASS]
        told = "; ".join(f"{one.gain_set.name} {one.outcome}: {one.reason}" for one in bad[:2])
        return Verdict(
            not bad, f"{len(flights) - len(bad)} of {len(flights)} gain sets pass" + (f" ({told})" * bool(bad))
        )

    @property
    def text(self) -> str:
        """The table, the reasons and where the run's folder is, as `froude fly` prints them."""
        from scenarios.table import run_text

        return run_text(self.run, self.folder)


@dataclass(frozen=True)
class AnalysedSets:
    """An analysis without a flight.

    Attributes:
        analysis: margins and Monte Carlo of each set.
    """

    analysis: Analysis

    def passes(self, share: float = SHARE) -> Verdict:
        """Does every set pass on the nominal model and on this share of the uncertain ones?

        Args:
            share: 0 to 1.
        """
        sets = self.analysis.sets
        bad = [one for one in sets if not one.nominal_passes or one.passes < share * one.of]
        words = {True: "passes", False: "fails"}
        told = "; ".join(
            f"{one.gain_set.name}: nominal {words[one.nominal_passes]}, {one.passes} of {one.of} samples"
            for one in bad[:2]
        )
        return Verdict(not bad, f"{len(sets) - len(bad)} of {len(sets)} gain sets pass" + (f" ({told})" * bool(bad)))

    @property
    def text(self) -> str:
        """As `froude analyse` prints it."""
        from scenarios.analysis_text import analysis_text

        return analysis_text(self.analysis)


@dataclass
class Froude:
    """The fixture.

    Attributes:
        out: where run folders go. px4: build of a PX4 to fly with; None for our own autopilot.
        folder: of the test's file: gain sets, scenarios and airframes are looked for there first.
        results: everything flown and analysed, for the text of a failure.
    """

    out: Path
    px4: Path | None
    folder: Path
    results: list[FlownSets | AnalysedSets] = field(default_factory=list)

    def fly(
        self,
        scenario: str | Path = "roll_step",
        *,
        gains: Names | None = None,
        vehicle: str | Path | None = None,
        profile: str | None = None,
        limits: str | None = None,
        seed: int | None = None,
        px4: str | Path | None = None,
        jobs: int = 1,
    ) -> FlownSets:
        """Fly gain sets through a scenario, as `froude fly` does.

        Args:
            scenario: of the library, or a TOML file. gains: one or several sets or files; None: the scenario's.
            vehicle: airframe, or reference:target. profile: study, sitl or board. limits: practical, study or none.
            seed: of sensor noise. px4: build directory of a PX4 to fly with. jobs: flights at a time.

        Raises:
            UsageError, FileError: a bad name, file or number. Whatever stopped the run, if anything did.
        """
        from scenarios.runner import RunOptions, run_scenario

        options = RunOptions(
            out=self.out,
            px4=self.px4 if px4 is None else self.folder / px4,
            jobs=jobs,
            command=("pytest",),
            twin=False,
        )
        result = run_scenario(self._scenario(scenario, gains, vehicle, profile, limits, seed), options)
        if result.stopped is not None:
            raise result.stopped
        assert result.folder is not None
        flown = FlownSets(result.run, result.folder)
        self.results.append(flown)
        return flown

    def analyse(
        self,
        *,
        gains: Names,
        vehicle: str | Path = "ant-x",
        profile: str = "sitl",
        limits: str = "practical",
        samples: int = 200,
        seed: int = 1,
    ) -> AnalysedSets:
        """Margins and a Monte Carlo of gain sets, as `froude analyse` does.

        Args:
            gains: one or several sets or files. vehicle: airframe, or reference:target. profile: study, sitl or board.
            limits: practical or study. samples: uncertain models besides the nominal. seed: of the samples.

        Raises:
            UsageError, FileError: a bad name, file or number.
        """
        from scenarios.analysis import analyse
        from scenarios.gain_set import check, load_all
        from scenarios.roll_set import roll_set
        from scenarios.scenario import limit_set
        from sitl.parameters import ParameterTable
        from sitl.profile import get_profile
        from sitl.vehicle import airframe_parameters
        from sitl.vehicle_spec import resolve_vehicle

        limit_set(limits)
        model, fidelity = resolve_vehicle(self._vehicle(vehicle), ("derivatives",)), get_profile(profile)
        table = ParameterTable(airframe_parameters(model, fidelity))
        sets = load_all(self._found(one) for one in _listed(gains))
        for one in sets:
            check(one, table)
        pairs = [(one, roll_set(model, fidelity, one.parameters)) for one in sets]
        found = AnalysedSets(analyse(model, fidelity, pairs, limits=limits, samples=samples, seed=seed))
        self.results.append(found)
        return found

    def _scenario(
        self,
        name: str | Path,
        gains: Names | None,
        vehicle: str | Path | None,
        profile: str | None,
        limits: str | None,
        seed: int | None,
    ) -> Scenario:
        from scenarios.scenario import limit_set, load_scenario

        changes: dict[str, Any] = {}
        if gains is not None:
            changes["gain_sets"] = tuple(self._found(one) for one in _listed(gains))
        if vehicle is not None:
            changes["vehicle"] = self._vehicle(vehicle)
        if profile is not None:
            changes["profile"] = profile
        if limits is not None:
            changes |= {"limits": limit_set(limits), "limits_name": limits}
        if seed is not None:
            changes["seed"] = seed
        return replace(load_scenario(self._found(name)), **changes)

    def _vehicle(self, spec: str | Path) -> str:
        return ":".join(self._found(part) for part in str(spec).split(":"))

    def _found(self, name: str | Path) -> str:
        """A file, or one set of it, beside the test; else the name as it is."""
        text = str(name)
        for part in (text, text.rpartition("/")[0]):
            if part and (self.folder / part).is_file():
                return str(self.folder / text)
        return text


def _listed(names: Names) -> Iterable[str | Path]:
    return (names,) if isinstance(names, str | Path) else names
