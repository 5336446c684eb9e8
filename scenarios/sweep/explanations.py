"""Why a flight is not what the batch flew: what is known of the flight, and the two roll angles beside each other."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from scenarios.limits import LIMIT_CYCLE_RAD_S, TITLES
from scenarios.run_reader import StoredRun
from scenarios.stored_flight import StoredFlight
from scenarios.sweep.as_flown import AsFlown
from scenarios.sweep.evaluation import limits_of
from scenarios.sweep.flight_comparison import Comparison
from scenarios.sweep.plan import Plan

FloatArray = npt.NDArray[np.float64]

NOISY_RAD_S = 0.01
"""So much more motion at the end of a hold than in the batch is told to be the gyro's noise."""

CLOSE_DEG = 0.3
"""Roll angles no further apart than this are one flight: what differs then is how a metric is read off."""

_NOT_STILL = re.compile(r": not level, still and at height within \S+ s")


def explained(plan: Plan, made: Comparison, seen: AsFlown, run: StoredRun, flight: StoredFlight) -> Comparison:
    """A comparison with the difference of the roll angles and, if the two do not agree, what is known of why.

    Args:
        plan: of the sweep. made: of `compare`. seen: the same point by the batch. run: the flight's. flight: as stored.
    """
    apart = _roll_apart(seen, run, flight)
    joined = np.concatenate(list(apart.values())) if apart else np.empty(0)
    rms = math.degrees(math.sqrt(float(np.mean(joined**2)))) if len(joined) else None
    made = replace(made, roll_rms_deg=rms)
    return made if made.agrees else replace(made, reasons=tuple(_reasons(plan, made, flight, apart)))


def _roll_apart(seen: AsFlown, run: StoredRun, flight: StoredFlight) -> dict[str, FloatArray]:
    """Segment -> the flight's roll angle minus the batch's, rad, at the times of its telemetry."""
    telemetry = run.telemetry(flight)
    if telemetry is None:
        return {}
    begun: dict[str, float] = {}
    found = {}
    for segment in flight.data["segments"]:
        start = begun.setdefault(segment["manoeuvre"], segment["start_s"])
        rows = telemetry.between(segment["start_s"], segment["end_s"])
        found[segment["name"]] = np.asarray(rows["phi_rad"] - seen.roll(segment["manoeuvre"], rows["t_s"] - start))
    return found


def _reasons(plan: Plan, made: Comparison, flight: StoredFlight, apart: Mapping[str, FloatArray]) -> Iterator[str]:
    data = flight.data
    if not data["segments"]:
        yield f"the flight came to no manoeuvre: {made.reason or 'it was broken off'}"
        return
    moving = [_NOT_STILL.sub("", one.partition(";")[0]) for one in data["warnings"] if _NOT_STILL.search(one)]
    if moving:
        yield f"it was not still when these began, and the batch begins from rest: {', '.join(moving)}"
    shake = {axis: _value(flight, f"{axis}_std_rad_s") for axis in "pqr"}
    worst = max(shake, key=lambda axis: shake[axis])
    if worst != "p" and shake[worst] > LIMIT_CYCLE_RAD_S:
        axis = {"q": "pitch", "r": "yaw"}[worst]
        yield f"it shakes in {axis}, {shake[worst]:.2g} rad/s: the batch flies the roll axis alone"
    values = {one.metric: one for one in made.compared}
    if not made.verdicts_agree:
        for limit in limits_of(plan):
            one = values.get(limit.metric)
            if one is None or one.batch is None or one.flight is None or one.within is False:
                continue
            if limit.holds(one.batch) != limit.holds(one.flight):
                yield (
                    f"{TITLES[limit.metric]} is {one.batch:.4g} in the batch and {one.flight:.4g} in flight: within "
                    f"the tolerance, and on either side of the limit {limit}"
                )
    largest = math.degrees(max((float(np.abs(one).max()) for one in apart.values() if len(one)), default=math.inf))
    if made.outside and largest <= CLOSE_DEG:
        yield (
            f"the two roll angles are never more than {largest:.2f} deg apart: a swing ends just inside of a band or a "
            "level in one and just outside of it in the other"
        )
    noise = plan.cases[made.point.case].profile.gyro_noise_rad_s
    quiet = values.get("oscillation_rad_s")
    if quiet is None or quiet.batch is None or quiet.flight is None or not noise:
        return
    if quiet.flight - quiet.batch > NOISY_RAD_S and quiet.batch <= LIMIT_CYCLE_RAD_S:
        yield (
            f"gyro noise of {noise:g} rad/s, which the batch has not, keeps it moving: {quiet.flight:.2g} rad/s at the "
            f"end of the hold instead of {quiet.batch:.2g}"
        )


def _value(flight: StoredFlight, name: str) -> float:
    metric = flight.metric(name)
    return 0.0 if metric is None or metric["value"] is None else float(metric["value"])
