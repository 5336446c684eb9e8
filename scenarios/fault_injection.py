"""Makes a flight's planned faults happen: begins and ends each at its vehicle time, and keeps when that was."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from scenarios.fault_kinds import Where
from scenarios.faults import Fault
from scenarios.injected_fault import InjectedFault
from sitl.errors import UsageError

if TYPE_CHECKING:
    from sitl.faults import Effect, Faults

BEGINS, ENDS = "fault begins", "fault ends"
WARNING, NOTICE = 4, 5
"""MAV_SEVERITY of their lines in the event log."""


class Target(ABC):
    """Something that faults can be put into."""

    @abstractmethod
    def begin(self, number: int, fault: Fault) -> None:
        """Put a fault in force, by its number in the scenario."""

    @abstractmethod
    def end(self, number: int) -> None:
        """Take it away."""

    def datagrams(self, number: int) -> tuple[int, int] | None:
        """How many datagrams passed and of how many something became; None if it is no link."""
        return None

    def failed(self, number: int) -> str:
        """Why a fault that was begun never came into force; empty if it did."""
        return ""


class BodyTarget(Target):
    """Plant and sensors of our own.

    Args:
        faults: of the body; asked for anew each time, because a body that is reset has new ones.
        mass_kg: of the vehicle.
    """

    def __init__(self, faults: Callable[[], Faults], mass_kg: float) -> None:
        self._faults = faults
        self._mass_kg = mass_kg

    def begin(self, number: int, fault: Fault) -> None:
        """Put a fault in force."""
        self._faults().begin(number, body_effect(fault, self._mass_kg))

    def end(self, number: int) -> None:
        """Take it away."""
        self._faults().end(number)


def body_effect(fault: Fault, mass_kg: float) -> Effect:
    """What a fault of plant or sensors does, in SI.

    Args:
        fault: as planned. mass_kg: of the vehicle.
    """
    from sitl.faults import AXES, BatterySag, Gust, GyroFault, LoopDelay, MotorFault

    s, kind = fault.settings, fault.kind
    if kind == "gust":
        return Gust(s["side_force_n"] / mass_kg, math.radians(s["roll_accel_deg_s2"]), s["wind_m_s"])
    if kind == "battery_sag":
        return BatterySag(s["sag_pct"] * 1e-2)
    if kind == "loop_delay":
        return LoopDelay(s["delay_ticks"])
    if kind.startswith("motor_"):
        motor = s["motor"] - 1 if "motor" in s else None
        efficiency = 0.0 if kind == "motor_out" else s.get("efficiency_pct", 100.0) * 1e-2
        return MotorFault(motor, efficiency, s.get("most_pct", 100.0) * 1e-2)
    lost = 1.0 if kind == "gyro_stuck" else s.get("loss_pct", 0.0) * 1e-2
    bias, noise = (math.radians(s.get(key, 0.0)) for key in ("bias_deg_s", "noise_deg_s"))
    return GyroFault(AXES[s["axis"]], bias, noise, lost)


@dataclass
class _Planned:
    """A fault and where it stands; times in us of vehicle time, None: not known yet."""

    fault: Fault
    due_us: int | None = None
    start_us: int | None = None
    until_us: int | None = None
    end_us: int | None = None

    @property
    def in_force(self) -> bool:
        return self.start_us is not None and self.end_us is None


class FaultInjection:
    """All faults of one flight.

    Args:
        faults: as planned. targets: for each place where they happen.
        say: called with (vehicle time s, severity, text) for the event log.
        show: called with (vehicle time s, text) whenever other faults are in force than before.
    """

    def __init__(
        self,
        faults: Sequence[Fault],
        targets: Mapping[Where, Target],
        say: Callable[[float, int, str], object],
        show: Callable[[float, str], object],
    ) -> None:
        for fault in faults:
            if fault.where not in targets:
                raise UsageError(f"{fault.text}: this vehicle's {fault.where.value} are out of reach")
        self._planned = [_Planned(fault) for fault in faults]
        self._targets = targets
        self._say = say
        self._show = show
        self._next_us: float = math.inf

    def begins(self, manoeuvre: str, now_us: int) -> None:
        """A manoeuvre begins with the next set-point, or the take-off was commanded.

        Args:
            manoeuvre: its name; empty for the take-off. now_us: vehicle time.
        """
        for one in self._planned:
            if one.fault.manoeuvre == manoeuvre and one.due_us is None:
                one.due_us = now_us + round(one.fault.at_s * 1e6)
        self._look(now_us)

    def tick(self, now_us: int) -> None:
        """Begin and end what is due; called with every tick.

        Args:
            now_us: vehicle time at which the next tick of the plant begins.
        """
        if now_us >= self._next_us:
            self._look(now_us)

    def over(self, now_us: int) -> None:
        """The last manoeuvre is over: what is in force ends, what has not begun never will."""
        changed = False
        for number, one in enumerate(self._planned):
            one.due_us = one.due_us if one.start_us is not None else None
            if one.in_force:
                self._end(number, one, now_us)
                changed = True
        self._next_us = math.inf
        if changed:
            self._show(now_us * 1e-6, "")

    @property
    def has_cut_link(self) -> bool:
        """A fault that can keep the vehicle from being heard, or from hearing, has begun."""
        cutting = (Where.LINK, Where.AUTOPILOT)
        return any(one.start_us is not None and one.fault.where in cutting for one in self._planned)

    @property
    def injected(self) -> tuple[InjectedFault, ...]:
        """What became of every fault, in the scenario's order."""
        told = []
        for number, one in enumerate(self._planned):
            target = self._targets[one.fault.where]
            if one.start_us is None or target.failed(number):
                told.append(InjectedFault.of(one.fault, None, None))
                continue
            end_s = None if one.end_us is None else one.end_us * 1e-6
            told.append(InjectedFault.of(one.fault, one.start_us * 1e-6, end_s, target.datagrams(number)))
        return tuple(told)

    def _look(self, now_us: int) -> None:
        changed = False
        for number, one in enumerate(self._planned):
            if one.in_force and one.until_us is not None and now_us >= one.until_us:
                self._end(number, one, now_us)
                changed = True
        for number, one in enumerate(self._planned):
            if one.start_us is None and one.due_us is not None and now_us >= one.due_us:
                self._begin(number, one, now_us)
                changed = True
        dues = [one.due_us for one in self._planned if one.start_us is None and one.due_us is not None]
        untils = [one.until_us for one in self._planned if one.in_force and one.until_us is not None]
        self._next_us = min([*dues, *untils], default=math.inf)
        if changed:
            self._show(now_us * 1e-6, ", ".join(one.fault.text for one in self._planned if one.in_force))

    def _begin(self, number: int, one: _Planned, now_us: int) -> None:
        fault = one.fault
        lasts_s: Any = fault.settings.get("boot_s", fault.duration_s)
        one.start_us = now_us
        one.until_us = None if lasts_s is None else now_us + round(lasts_s * 1e6)
        self._targets[fault.where].begin(number, fault)
        self._say(now_us * 1e-6, WARNING, f"{BEGINS}: {fault.text}")

    def _end(self, number: int, one: _Planned, now_us: int) -> None:
        one.end_us = now_us
        self._targets[one.fault.where].end(number)
        self._say(now_us * 1e-6, NOTICE, f"{ENDS}: {one.fault.text}")
