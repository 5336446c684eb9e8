"""A point's nominal model flown once more and looked at through the telemetry that a flight has: late, and no quicker.

The batch measures the roll angle itself, at every tick. A flight is measured by what the vehicle reports.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scenarios.flight import Segment
from scenarios.monte_carlo import Traces, monte_carlo
from scenarios.roll_set import roll_set
from scenarios.sampler import FAST_INTERVAL_US
from scenarios.score import flight_metrics
from scenarios.sweep.best_flights import gain_set_of
from scenarios.sweep.plan import Plan
from scenarios.telemetry import Telemetry
from sitl.profile import Profile

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AsFlown:
    """What a flight without noise, of the roll axis alone, would report.

    Attributes:
        telemetry: its manoeuvres one after the other, from 0 s on. metrics: measured on it, as flights are.
        starts_s: when each manoeuvre begins there.
    """

    telemetry: Telemetry
    metrics: Mapping[str, float | None]
    starts_s: Mapping[str, float]

    def roll(self, manoeuvre: str, since_s: npt.NDArray[Any]) -> FloatArray:
        """Roll angle, rad.

        Args:
            manoeuvre: its name. since_s: times since its start.
        """
        at = self.starts_s[manoeuvre] + since_s
        return np.asarray(np.interp(at, self.telemetry["t_s"], self.telemetry["phi_rad"]))


def lateness_s(profile: Profile) -> float:
    """How late the roll angle of a flight comes behind the set-point of the same telemetry, beyond what the loop makes.

    The set-point acts a tick after it was taken up, and the angle is the estimate's. Where telemetry is slower than
    the loop, its set-point is a part of its period younger than its angle.

    Args:
        profile: that is flown.
    """
    return (1.0 + profile.attitude_late_ticks) * profile.dt_s + 0.5 * (_period_s(profile) - profile.dt_s)


def _period_s(profile: Profile) -> float:
    return max(profile.dt_s, FAST_INTERVAL_US * 1e-6)


def as_flown(plan: Plan, number: int, row: Mapping[str, Any]) -> AsFlown:
    """A point as a flight would show it.

    Args:
        plan: of the sweep. number: of the case. row: of the point.
    """
    case, sweep = plan.cases[number], plan.sweep
    gains = roll_set(case.model, case.profile, gain_set_of(plan, number, row).parameters)
    found = monte_carlo(
        case.model, {"": gains}, case.profile, sweep.manoeuvres,
        samples=0, trace_every=1, margins=False, setpoint_rate_hz=sweep.setpoint_rate_hz, threads=1,
    )  # fmt: skip
    assert found.traces is not None
    starts_s, segments, begin = {}, [], 0.0
    for manoeuvre in sweep.manoeuvres:
        starts_s[manoeuvre.name] = begin
        for k, one in enumerate(manoeuvre.windows):
            segments.append(
                Segment(
                    f"{manoeuvre.name}/{k}", one.kind, manoeuvre.name, begin + one.start_s, begin + one.end_s,
                    one.phi_to_rad - one.phi_from_rad, one.phi_from_rad,
                )
            )  # fmt: skip
        begin += manoeuvre.duration_s
    telemetry = _telemetry(found.traces, case.profile, list(starts_s.values()))
    metrics = {one.name: one.value for one in flight_metrics(telemetry, segments) if not one.segment}
    return AsFlown(telemetry, metrics, starts_s)


def _telemetry(traces: Traces, profile: Profile, starts_s: list[float]) -> Telemetry:
    late_s = lateness_s(profile)
    t = traces.t_s
    first = np.searchsorted(t, np.array(starts_s) - 1e-9)
    late = np.empty((2, len(t)))
    for a, b in zip(first, [*first[1:], len(t)], strict=True):
        # every manoeuvre begins from rest, and so does what is seen of it
        for into, flown in zip(late, (traces.phi_rad[0, 0], traces.p_rad_s[0, 0]), strict=True):
            into[a:b] = np.interp(t[a:b] - late_s, t[a:b], flown[a:b], left=0.0)
    every = slice(None, None, max(1, round(_period_s(profile) / profile.dt_s)))
    level = np.zeros(len(t[every]))
    return Telemetry.from_columns(
        {
            "t_s": t[every],
            "phi_rad": late[0, every],
            "p_rad_s": late[1, every],
            "q_rad_s": level,
            "r_rad_s": level,
            "phi_sp_rad": traces.phi_sp_rad[every],
            "delta_lat": traces.delta_lat[0, 0, every],
        }
    )
