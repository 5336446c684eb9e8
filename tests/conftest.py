"""What several folders of tests fly with."""

from __future__ import annotations

import contextlib
import itertools
import signal
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from sitl.modes import Mode, Result
from sitl.parameters import ParameterTable
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import VehicleModel, resolve_vehicle

Each = Callable[[int], None]

_states = itertools.count(1)
_failed = pytest.StashKey[bool]()
_HERE = Path(__file__).parent
_LONGEST_FIRST = {"clients": 0, "test_readme.py": 1, "scenarios": 2}

# how long an example takes depends on what else the computer does
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")


@pytest.fixture(scope="session", autouse=True)
def states(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where journals of borrowed parameters go in tests; the user's own are not touched, nor acted upon."""
    base = tmp_path_factory.mktemp("states")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FROUDE_STATE_DIR", str(base / "0"))
        yield base


@pytest.fixture(autouse=True)
def state_dir(states: Path) -> Iterator[Path]:
    """A state folder of this test's own; it is made when something is kept."""
    folder = states / str(next(_states))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FROUDE_STATE_DIR", str(folder))
        yield folder


def pytest_configure() -> None:
    # a shell that runs in the background has Ctrl-C ignored, and so would every program that a test interrupts
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    # the files that take longest come first: no worker is left with one when the others are done
    items.sort(key=lambda item: _LONGEST_FIRST.get(item.path.relative_to(_HERE).parts[0], len(_LONGEST_FIRST)))
    # ground stations of others give up after times of their own, which a busy computer may miss
    for item in items:
        if item.get_closest_marker("client"):
            item.add_marker(pytest.mark.flaky(reruns=2))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    item.stash[_failed] = item.stash.get(_failed, False) or report.failed
    return report


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    # what the tests of its file share is in a state that nobody knows, a vehicle perhaps in the air
    if isinstance(item, pytest.Function) and item.get_closest_marker("client") and item.stash.get(_failed, False):
        item.stash[_failed] = False
        for fixture in (one for name in item.fixturenames for one in item._fixtureinfo.name2fixturedefs.get(name, ())):
            if fixture.scope == "module":
                fixture.finish(item._request)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for report in terminalreporter.getreports("rerun"):
        terminalreporter.write_sep("_", f"why {report.nodeid} was tried again")
        terminalreporter.write_line(report.longreprtext)


class _NoReport(contextlib.nullcontext):
    """In the place of a `ReportDraft`."""

    def landed(self, number: int, flight: object, telemetry: Path) -> None:
        pass

    def begin(self, folder: Path) -> None:
        pass

    def finish(self) -> None:
        pass


@pytest.fixture
def without_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of this test write no report: it takes longer than a short flight, and it has tests of its own."""
    monkeypatch.setattr("scenarios.runner.report_draft", lambda *_: _NoReport())


class Flight:
    """A vehicle with the texts it said, in order, as (vehicle time in s, text)."""

    def __init__(
        self,
        model: str | VehicleModel = "ant-x",
        profile: str = "sitl",
        *,
        seed: int = 1,
        parameters: ParameterTable | None = None,
        flight_gains: bool = True,
        **overrides: object,
    ) -> None:
        resolved = resolve_vehicle(model) if isinstance(model, str) else model
        self.vehicle = Vehicle(resolved, get_profile(profile, **overrides), seed=seed, parameters=parameters)
        self.autopilot = self.vehicle.autopilot
        self.parameters = self.vehicle.parameters
        self.texts: list[tuple[float, str]] = []
        gains = resolved.airframe.flight_gains
        if flight_gains and gains is not None:
            for axis in ("ROLL", "PITCH"):
                self.set_gains(axis, gains.k_phi, gains.kp, gains.ki, gains.kd)

    @property
    def time_s(self) -> float:
        return self.vehicle.time_us * 1e-6

    def set_gains(self, axis: str, k_phi: float, kp: float, ki: float, kd: float) -> None:
        self.parameters.set(f"MC_{axis}_P", float(k_phi))
        for suffix, value in (("P", kp), ("I", ki), ("D", kd)):
            self.parameters.set(f"MC_{axis}RATE_{suffix}", float(value))

    def run(self, seconds: float, each: Each | None = None) -> None:
        """Step on; ``each`` is called with the number of the step before every step."""
        for k in range(round(seconds * 1e6 / self.vehicle.tick_us)):
            if each is not None:
                each(k)
            self.vehicle.step()
            self.listen()

    def listen(self) -> None:
        """Note what was said."""
        self.texts += [(self.time_s, text.text) for text in self.autopilot.take_texts()]

    def run_until(self, condition: Callable[[], bool], timeout_s: float) -> float:
        """Step on until a condition holds, looked at every 20 ms; s it took."""
        start = self.time_s
        while not condition():
            assert self.time_s - start < timeout_s, f"not within {timeout_s} s; said {self.texts}"
            self.run(0.02)
        return self.time_s - start

    def said(self, text: str) -> list[float]:
        """When a text was said, s."""
        return [time_s for time_s, said in self.texts if said == text]

    def get_ready(self) -> None:
        self.run_until(lambda: self.autopilot.healthy, 5.0)

    def arm(self) -> float:
        """Arm; vehicle time of it, s."""
        if not self.autopilot.healthy:
            self.get_ready()
        assert self.autopilot.command_arm(True) is Result.ACCEPTED, self.autopilot.rejection
        self.listen()
        return self.time_s

    def take_off(self, height_m: float = 10.0, settle_s: float = 5.0) -> None:
        """Arm, take off and hold until the height is still."""
        self.parameters.set("MIS_TAKEOFF_ALT", height_m)
        self.arm()
        assert self.autopilot.command_takeoff(None) is Result.ACCEPTED
        self.run_until(lambda: self.autopilot.mode is Mode.LOITER, 60.0)
        self.run(settle_s)

    def go_offboard(self, thrust: float | None = None) -> None:
        """Switch to Offboard, level, with thrust for hover unless told."""
        wanted = self.vehicle.model.assumptions.hover_thrust if thrust is None else thrust
        self.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), wanted)
        assert self.autopilot.command_mode(Mode.OFFBOARD) is Result.ACCEPTED
        self.autopilot.offboard_attitude((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), wanted)


@pytest.fixture
def flight() -> type[Flight]:
    """The class to make a flight of."""
    return Flight
