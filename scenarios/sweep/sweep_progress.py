"""How far a sweep is: a bar on a terminal, a line every now and then in a log."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bridge.clock import WallClock
from scenarios.sweep.engines import Engine
from scenarios.sweep.plan import Plan
from scenarios.sweep.sweeping import Progress

LINE_EVERY_S = 10.0
"""Between two lines of a log."""


@contextmanager
def watching(plan: Plan, engine: Engine, tell: Callable[[str], object]) -> Iterator[Callable[[Progress], object]]:
    """Yields the callback of `sweep_points`.

    Args:
        plan: of the sweep. engine: who works. tell: prints a line for people.
    """
    rate = _Rate(WallClock())
    if sys.stderr is None:
        yield lambda _: None
        return
    if not sys.stderr.isatty():
        yield _Lines(rate, plan, engine, tell)
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    bar = Bar(
        TextColumn("sweep"),
        BarColumn(),
        TextColumn("{task.completed:,.0f} / {task.total:,.0f} points"),
        TextColumn("{task.fields[text]}"),
        console=Console(stderr=True),
        transient=True,
    )
    with bar:
        task = bar.add_task("", total=plan.points, text="the first time compiles the laws: half a minute")

        told = False

        def show(now: Progress) -> None:
            nonlocal told
            if not told:
                told = True
                tell(_first_line(now, engine))
            if now.done > now.begun_with:
                bar.update(task, completed=now.done, text=rate.text(now, plan))
            else:
                bar.update(task, completed=now.done)

        yield show


class _Rate:
    """Points a second since the first ones came."""

    def __init__(self, clock: WallClock) -> None:
        self.clock = clock
        self._since_us = clock.now_us()

    def text(self, now: Progress, plan: Plan) -> str:
        """Rate, time left, best so far and failures, in one line."""
        took_s = max(1e-3, (self.clock.now_us() - self._since_us) * 1e-6)
        rate = (now.done - now.begun_with) / took_s
        words = [f"{rate:,.0f} points/s"]
        if now.done < now.points:
            words.append(f"{_duration((now.points - now.done) / max(rate, 1e-9))} left")
        words.append(f"{now.passing:,} pass")
        if now.best_point >= 0:
            candidate, case = divmod(now.best_point, len(plan.cases))
            words.append(f"best {now.best_pct:.0f} % (candidate {candidate}, {plan.cases[case].name})")
        if now.errors:
            words.append(f"{now.errors:,} failed")
        if now.lost_workers:
            words.append(f"{now.lost_workers} worker{'s' * (now.lost_workers > 1)} died")
        return ", ".join(words)


class _Lines:
    """For a log: at the beginning, every ten seconds, and at the end."""

    def __init__(self, rate: _Rate, plan: Plan, engine: Engine, tell: Callable[[str], object]) -> None:
        self._rate = rate
        self._plan = plan
        self._engine = engine
        self._tell = tell
        self._next_us: int | None = None

    def __call__(self, now: Progress) -> None:
        at = self._rate.clock.now_us()
        if self._next_us is None:
            self._tell(_first_line(now, self._engine))
        elif at >= self._next_us or now.done == now.points:
            self._tell(f"{now.done:,} of {now.points:,} points: {self._rate.text(now, self._plan)}")
        else:
            return
        self._next_us = at + round(LINE_EVERY_S * 1e6)


def _first_line(now: Progress, engine: Engine) -> str:
    before = f", {now.begun_with:,} of them done before" if now.begun_with else ""
    return f"{now.points:,} points{before}; {engine.workers} worker{'s' * (engine.workers > 1)}, {engine.name}"


def _duration(seconds: float) -> str:
    """`45 s`, `12 min`, `3.4 h`."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"
