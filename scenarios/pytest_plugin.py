"""pytest plugin: `def test_my_gains(froude): assert froude.fly("roll_step", gains="my.params").passes()`.

pytest loads this module at every start, so nothing is imported here but what pytest itself has loaded. The work is done
by `scenarios.flight_checks`, which the first test that asks for the fixture loads.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from _pytest._code.code import ExceptionRepr

if TYPE_CHECKING:
    from scenarios.flight_checks import Froude

_USED = pytest.StashKey["Froude"]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --froude-out and --froude-px4."""
    add = parser.getgroup("froude", "flights of gain sets").addoption
    add("--froude-out", metavar="DIR", default=None, help="where run folders go (default: the test's tmp_path)")
    add("--froude-px4", metavar="DIR", default=None, help="fly with this PX4 build instead of our own autopilot")


@pytest.fixture
def froude(request: pytest.FixtureRequest, tmp_path: Path) -> Froude:
    """Flies gain sets and says whether they pass; see `scenarios.flight_checks.Froude`."""
    from scenarios.flight_checks import Froude

    out, px4 = (request.config.getoption(name) for name in ("--froude-out", "--froude-px4"))
    base = request.config.invocation_params.dir
    flies = Froude(
        out=tmp_path / "runs" if out is None else base / out,
        px4=None if px4 is None else base / px4,
        folder=request.path.parent,
    )
    request.node.stash[_USED] = flies
    return flies


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Put the tables of what a failed test has flown into its failure."""
    report = yield
    used = item.stash.get(_USED, None)
    if used is not None and call.when == "call" and report.failed:
        for result in used.results:
            if isinstance(report.longrepr, ExceptionRepr):
                report.longrepr.addsection("froude", result.text.rstrip("\n"))
    return report
