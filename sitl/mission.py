"""A mission under way: which item is flown, when it is reached, what comes next.

Source: PX4 ``navigator`` (Mission, MissionBlock). A multicopter hovers where PX4 loiters; NAV_LOITER_TURNS, which PX4
does not fly, goes round in a circle.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum

from sitl.control_settings import reader
from sitl.goto import corner_speed
from sitl.legs import Here, Leg, LegKind, Vec3, bounded, wrap
from sitl.mission_check import PLACES, mission_problem
from sitl.modes import Home, Mode, Severity, Text
from sitl.orbit import Orbit, sane_radius
from sitl.parameters import ParameterTable
from sitl.plan import (
    CONDITION_YAW,
    DO_CHANGE_SPEED,
    DO_JUMP,
    NAV_DELAY,
    NAV_LAND,
    NAV_LOITER_TIME,
    NAV_LOITER_TURNS,
    NAV_LOITER_UNLIM,
    NAV_RETURN_TO_LAUNCH,
    NAV_TAKEOFF,
    NAV_WAYPOINT,
    MissionItem,
)
from sitl.sensors import ORIGIN, local_position

_KEPT_TEXTS = 32
_LIFTS = PLACES - {NAV_LAND}
"""Items that begin with a take-off when they are met on the ground."""


class _Stage(Enum):
    """How far an item is."""

    MET = 0
    LIFTING = 1
    GOING = 2
    THERE = 3


class MissionRun:
    """The mission of one vehicle.

    Args:
        parameters: NAV_ACC_RAD, NAV_MC_ALT_RAD, NAV_LOITER_RAD, MIS_*, MPC_ACC_HOR.

    Attributes:
        items: as loaded. current: number of the item flown or to be flown next.
        finished: all items are done. reached_seq: the item reached last, -1 for none; reached_serial counts them.
        speed_m_s: what DO_CHANGE_SPEED asked for; NaN for the default.
        texts: what there is to say. wish: the mode it wants next.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._get = reader(parameters)
        self.texts: deque[Text] = deque(maxlen=_KEPT_TEXTS)
        self.home: Home | None = None
        self.landed = True
        self.reached_seq = -1
        self.reached_serial = 0
        self.load(())

    # -- what it is told ---------------------------------------------------------------------------------------

    def load(self, items: tuple[MissionItem, ...]) -> None:
        """Take a new mission; it begins at its first item."""
        self.items = tuple(items)
        self.current = 0
        self.finished = False
        self.wish: Mode | None = None
        self._running = False
        self._jumps: dict[int, int] = {}
        self.reached_seq = -1
        self.speed_m_s = math.nan
        self._last: Leg | None = None
        self._heading = math.nan
        self._armings = -1
        self._meet()

    @property
    def problem(self) -> str:
        """Why it can not be flown, in PX4's words; empty if it can."""
        return mission_problem(self.items, self.home, self.landed)

    @property
    def valid(self) -> bool:
        """Can it be flown?"""
        return not self.problem

    def set_current(self, seq: int) -> bool:
        """Go on with another item; False if there is no such item."""
        if not 0 <= seq < len(self.items):
            return False
        self.current = seq
        self.finished = False
        self.wish = None
        self._meet()
        return True

    def start(self, armings: int = 0) -> None:
        """Mission begins or goes on, at the current item; after a flight that finished it, at the first.

        Args:
            armings: how often the vehicle has been armed; another number than at the last start means another flight.
        """
        if self.finished and armings != self._armings:
            self.current = 0
            self._jumps.clear()
        self._armings = armings
        self.finished = False
        self.wish = None
        self._running = False
        self._last = None
        self._meet()

    def pause(self) -> None:
        """Another mode flies; the speed a mission chose does not outlast it."""
        self.speed_m_s = math.nan
        self._heading = math.nan

    # -- every run of the position controller ------------------------------------------------------------------

    def leg(self, here: Here) -> Leg:
        """What to fly now."""
        self.home, self.landed = here.home, here.landed
        if not self._running and not self.finished:
            self._begin(here)
        item = None if self.finished else self._item()
        if item is None:
            self._end(here)
            return self._rest()
        done, leg = self._fly(item, here)
        self._last = leg or self._last
        if done:
            self.reached_seq = self.current
            self.reached_serial += 1
            if item.autocontinue:
                self._advance(here)
        return leg or self._rest()

    def _begin(self, here: Here) -> None:
        self._running = True
        if self.valid:
            self._say(Severity.INFO, "Executing Mission")
            return
        doing = "refusing takeoff" if here.landed else "loitering"
        self._say(Severity.CRITICAL, f"No valid mission available, {doing}")
        self._finish(here)

    def _rest(self) -> Leg:
        """Stay where the last leg led."""
        if self._last is None or self._last.kind not in (LegKind.GO, LegKind.LAND):
            return Leg(LegKind.HOLD)
        return self._last._replace(exit_m_s=0.0)

    def _say(self, severity: Severity, text: str) -> None:
        self.texts.append(Text(severity, f"{text}\t"))

    def _meet(self) -> None:
        """The current item has not been looked at yet."""
        self._stage = _Stage.MET
        self._since_us: int | None = None
        self._orbit: Orbit | None = None

    def _advance(self, here: Here) -> None:
        self.current += 1
        self._meet()
        if self._item() is None:
            self.current = max(0, len(self.items) - 1)
            self._say(Severity.INFO, f"Mission finished, {'landed' if here.landed else 'loitering'}")
            self._jumps.clear()
            self._finish(here)

    def _end(self, here: Here) -> None:
        """Nothing is left to fly: the end was met by jumping there."""
        if not self.finished:
            self._finish(here)

    def _finish(self, here: Here) -> None:
        self.finished = True
        # landed, PX4 stays in Mission until it disarms
        if not here.landed and self.wish is None:
            self.wish = Mode.LOITER

    def _item(self) -> MissionItem | None:
        """The current item, jumps followed; None behind the last."""
        for _ in range(2 * len(self.items) + 1):
            if self.current >= len(self.items):
                return None
            item = self.items[self.current]
            if item.command != DO_JUMP:
                return item
            target, repeats = item.params[0], item.params[1]
            done = self._jumps.get(self.current, 0)
            follow = math.isfinite(target) and 0 <= target < len(self.items) and (repeats < 0 or done < repeats)
            if follow:
                self._jumps[self.current] = min(done + 1, 1 << 16)
            self.current = int(target) if follow else self.current + 1
        self._say(Severity.CRITICAL, "Mission item could not be set.")
        self.current = len(self.items)
        return None

    # -- items -------------------------------------------------------------------------------------------------

    def _fly(self, item: MissionItem, here: Here) -> tuple[bool, Leg | None]:
        """Is it done, and what is to be flown for it? None: whatever was flown before."""
        if self._stage is _Stage.MET and item.command in _LIFTS:
            self._stage = _Stage.LIFTING if here.landed else _Stage.GOING
            if here.landed:
                self._lift_down = self._lift_to(item, here)
                height = here.home_ned[2] - self._lift_down
                self._say(Severity.INFO, f"Takeoff to {height:.1f} meters above home")
        if self._stage is _Stage.LIFTING:
            if here.landed or here.position_ned[2] > self._lift_down + 0.5 * self._get("NAV_MC_ALT_RAD"):
                return False, Leg(LegKind.TAKEOFF, (math.nan, math.nan, self._lift_down))
            self._stage = _Stage.GOING
        if item.command in PLACES:
            return self._fly_place(item, here)
        return self._do(item, here), None

    def _do(self, item: MissionItem, here: Here) -> bool:
        """An item without a place; is it done?"""
        first = item.params[0]
        if item.command == NAV_DELAY:
            return self._waited(here.now_us, first)
        if item.command == DO_CHANGE_SPEED:
            self.speed_m_s = item.params[1] if item.params[1] > 0.0 else math.nan
        elif item.command == CONDITION_YAW and math.isfinite(first):
            turn = math.radians(math.remainder(first, 360.0))
            if item.params[3]:
                turn = here.yaw + math.copysign(turn, item.params[2] or 1.0)
            self._heading = wrap(turn)
        elif item.command == NAV_RETURN_TO_LAUNCH:
            self.wish = Mode.RTL
        return True

    def _fly_place(self, item: MissionItem, here: Here) -> tuple[bool, Leg | None]:
        if self._stage is _Stage.GOING and self._since_us is None and self._last is None:
            self._last = Leg(LegKind.GO, here.position_ned, here.yaw)
        ned = self._place(item, here)
        if item.command == NAV_LAND:
            return self._land(item, ned, here)
        yaw = self._heading
        if item.command != NAV_TAKEOFF and math.isfinite(item.params[3]):
            yaw = math.radians(math.remainder(item.params[3], 360.0))
        leg = Leg(LegKind.GO, ned, yaw, self.speed_m_s, self._exit_speed(item, ned, here))
        if item.command == NAV_LOITER_TURNS:
            return self._round(item, leg, here)
        if self._stage is not _Stage.THERE and self._is_there(item, ned, yaw, here):
            self._stage = _Stage.THERE
        done = self._stage is _Stage.THERE and item.command != NAV_LOITER_UNLIM
        if done and item.command in (NAV_WAYPOINT, NAV_LOITER_TIME):
            done = self._waited(here.now_us, item.params[0])
        return done, leg

    def _is_there(self, item: MissionItem, ned: Vec3, yaw: float, here: Here) -> bool:
        radius = self._get("NAV_ACC_RAD")
        if item.command == NAV_WAYPOINT and math.isfinite(item.params[1]) and item.params[1] > 0.0:
            radius = item.params[1]
        near = here.flat_distance_m(ned) <= radius
        high = abs(here.position_ned[2] - ned[2]) <= self._get("NAV_MC_ALT_RAD")
        ahead = math.isnan(yaw) or abs(wrap(yaw - here.yaw)) < math.radians(self._get("MIS_YAW_ERR"))
        return near and high and ahead

    def _land(self, item: MissionItem, ned: Vec3, here: Here) -> tuple[bool, Leg | None]:
        if here.landed:
            return True, Leg(LegKind.LAND, ned)
        if self._stage is not _Stage.THERE:
            # as PX4: there at the height it has, then down
            last = self._last
            down = last.ned[2] if last is not None and last.kind is LegKind.GO else here.position_ned[2]
            go = Leg(LegKind.GO, (ned[0], ned[1], down), self._heading, self.speed_m_s)
            if here.flat_distance_m(ned) > self._get("NAV_ACC_RAD"):
                return False, go
            self._stage = _Stage.THERE
        return False, Leg(LegKind.LAND, ned)

    def _round(self, item: MissionItem, leg: Leg, here: Here) -> tuple[bool, Leg | None]:
        """Circle a place; param1 turns at radius param3 (negative: anticlockwise)."""
        if self._orbit is None:
            radius = sane_radius(item.params[2], self._get("NAV_LOITER_RAD"))
            self._orbit = Orbit(leg, radius, here.position_ned)
        if not self._orbit.entered:
            return False, self._orbit.leg(here.position_ned)
        turns = item.params[0] if math.isfinite(item.params[0]) else 1.0
        return here.turned_rad >= math.tau * abs(turns), self._orbit.leg(here.position_ned)

    def _waited(self, now_us: int, wait_s: float) -> bool:
        if self._since_us is None:
            self._since_us = now_us
        return not wait_s > 0.0 or now_us - self._since_us >= wait_s * 1e6

    # -- places ------------------------------------------------------------------------------------------------

    def _place(self, item: MissionItem, here: Here) -> Vec3:
        """Where an item is, NED, m; what it leaves open stays as the last leg had it."""
        last = self._last.ned if self._last is not None else here.position_ned
        n, e, _ = local_position(item.lat_deg, item.lon_deg, 0.0)
        if not item.placed or (item.command == NAV_TAKEOFF and item.lat_deg == 0.0 and item.lon_deg == 0.0):
            n, e = math.nan, math.nan
        down = here.home_ned[2] - item.alt_m if item.relative else ORIGIN[2] - item.alt_m
        return bounded((n, e, down), bounded(last, here.position_ned))

    def _lift_to(self, item: MissionItem, here: Here) -> float:
        """Height of the take-off before an item, m (down): its own, MIS_TAKEOFF_ALT above here at least."""
        return min(self._place(item, here)[2], here.position_ned[2] - self._get("MIS_TAKEOFF_ALT"))

    def _exit_speed(self, item: MissionItem, ned: Vec3, here: Here) -> float:
        """Speed at which a waypoint may be passed on the way to the next, m/s."""
        hold, yaw = item.params[0], item.params[3]
        following = self.items[self.current + 1] if self.current + 1 < len(self.items) else None
        stops = item.command != NAV_WAYPOINT or hold > 0.0 or math.isfinite(yaw) or not item.autocontinue
        if stops or following is None or following.command != NAV_WAYPOINT or not following.placed:
            return 0.0
        after = self._place(following, here)
        position = here.position_ned
        radius = self._get("NAV_ACC_RAD")
        if here.flat_distance_m(ned) < radius:
            return 0.0
        return corner_speed(
            (position[0] - ned[0], position[1] - ned[1]),
            (after[0] - ned[0], after[1] - ned[1]),
            max(0.1, self._get("MPC_ACC_HOR")),
            radius,
        )
