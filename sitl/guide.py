"""Which set-point a mode wants: the half of flight control that knows modes.

It owns what the modes fly (`navigator`, `mission`, `home_run`, the stick laws) and asks the right one for every run
of the position controller.
"""

from __future__ import annotations

import math

from sitl.control_settings import reader
from sitl.legs import Here, Vec3
from sitl.mission import MissionRun
from sitl.modes import Home, Mode, Text
from sitl.navigator import Navigator
from sitl.offboard_motion import offboard_motion, wants_up
from sitl.parameters import ParameterTable
from sitl.return_home import ReturnHome
from sitl.setpoints import PositionRequest, Sticks
from sitl.stick_motion import StickMotion
from sitl.sticks import TAKEOFF_THROTTLE, AttitudeSticks, clean
from sitl.takeoff import TakeoffState

ATTITUDE_BY_STICK = frozenset({Mode.MANUAL, Mode.STABILIZED, Mode.ACRO})
"""Modes in which sticks are attitude or rates."""
_MOTION_BY_STICK = frozenset({Mode.ALTCTL, Mode.POSCTL})
_UNGUIDED = ATTITUDE_BY_STICK | {Mode.OFFBOARD, Mode.TERMINATION}
"""Modes in which the position controller does not run (in Offboard it may)."""


class Guide:
    """What the modes fly.

    Args:
        parameters: the table.

    Attributes:
        navigator: set-points of the position controller. mission: what Mission flies. home_run: what Return flies.
        by_stick: Stabilized and Acro. request: the external set-point of position, if that is what Offboard flies.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._get = reader(parameters)
        self.navigator = Navigator(parameters)
        self.mission = MissionRun(parameters)
        self.home_run = ReturnHome(parameters)
        self.by_stick = AttitudeSticks(parameters)
        self._motion = StickMotion(parameters)
        self.request: PositionRequest | None = None
        self._taken_over = self._by_position = False
        self._mode: Mode | None = None

    def take(self, request: PositionRequest) -> bool:
        """Take an external set-point; is it the first after another kind?"""
        first = self.request is None
        self._taken_over = self._taken_over or first
        self.request = request
        return first

    def drop(self) -> None:
        """An external set-point of attitude or rates counts instead."""
        self.request = None
        self._by_position = False

    def begin(
        self,
        mode: Mode,
        before: Mode,
        position: Vec3,
        velocity: Vec3,
        yaw: float,
        *,
        home: Home | None,
        landed: bool,
        stopped: bool,
    ) -> bool:
        """A mode begins; does the position controller begin anew?

        Args:
            mode: to be flown from now on. before: flown until now.
            position: NED, m. velocity: m/s. yaw: heading, rad.
            home: where Return goes and heights are counted from.
            landed: from the land detector. stopped: the motors were off.
        """
        guided = before not in _UNGUIDED or (before is Mode.OFFBOARD and self._by_position)
        self._by_position = False
        there = mode is Mode.LOITER and self.wish(position[2]) is Mode.LOITER
        self._mode = mode
        self.mission.home, self.mission.landed = home, landed
        if before is Mode.MISSION and mode is not Mode.MISSION:
            self.mission.pause()
        if before is not mode and not landed and mode is not Mode.OFFBOARD:
            self.navigator.airborne()
        if mode in ATTITUDE_BY_STICK:
            self.by_stick.begin(flying=not landed and not stopped)
        if mode in _UNGUIDED:
            return False
        navigator = self.navigator
        target, height, heading = navigator.target_ned, navigator.target_down, navigator.track.yaw
        navigator.enter(position, velocity, yaw)
        if there and before is Mode.TAKEOFF and height is not None:
            navigator.hold_ned[2] = height
        elif there and before is Mode.MISSION and target is not None:
            navigator.go(target, heading)
        if mode in _MOTION_BY_STICK:
            self._motion.begin(velocity)
        elif mode is Mode.MISSION:
            self.mission.start(navigator.takeoff.armings)
        elif mode is Mode.RTL:
            navigator.cruise_m_s = math.nan
            self.home_run.start()
        return stopped or not guided

    def choose(
        self,
        now_us: int,
        dt_s: float,
        mode: Mode,
        sticks: Sticks | None,
        position: Vec3,
        velocity: Vec3,
        yaw: float,
        *,
        home: Home | None,
        ground_contact: bool,
        landed: bool,
    ) -> None:
        """Put what a mode wants into the navigator's request.

        Args:
            now_us: vehicle time. dt_s: time since the last run of the position controller.
            mode: a guided one, or Offboard with a request. sticks: of a pilot, if there is one.
            position: NED, m. velocity: m/s. yaw: heading, rad.
            home: where Return goes and heights are counted from.
            ground_contact: from the land detector. landed: likewise.
        """
        navigator = self.navigator
        home_down = home.position_ned[2] if home else 0.0
        if mode is Mode.OFFBOARD and self.request is not None:
            if self._taken_over and not landed:
                navigator.airborne()
            self._taken_over, self._by_position = False, True
            wish, up = offboard_motion(self.request, self._get), wants_up(self.request, position[2])
        elif mode in _MOTION_BY_STICK:
            held, motion = clean(sticks), self._motion
            if navigator.takeoff.grounded:
                motion.begin((0.0, 0.0, 0.0))
            law = motion.altitude if mode is Mode.ALTCTL else motion.position
            wish, up = (
                law(held, position, velocity, yaw, home_down - position[2], dt_s),
                held.throttle > TAKEOFF_THROTTLE,
            )
        else:
            leg = navigator.leg(mode, position)
            if mode in (Mode.MISSION, Mode.RTL):
                here = Here(now_us, position, yaw, landed, home, navigator.track.turned_rad)
                leg = self.mission.leg(here) if mode is Mode.MISSION else self.home_run.leg(here)
            navigator.fly(
                now_us, dt_s, leg, position, velocity, ground_contact=ground_contact, landed=landed, home_down=home_down
            )
            return
        navigator.pass_on(now_us, dt_s, wish, position, yaw, up=up, ground_contact=ground_contact, landed=landed)

    def runs(self, mode: Mode) -> bool:
        """Does the position controller fly a mode now?"""
        return mode not in _UNGUIDED or (mode is Mode.OFFBOARD and self.request is not None)

    def wish(self, down: float) -> Mode | None:
        """The mode that what is flown wants next. down: where the vehicle is, m."""
        if self._mode is Mode.TAKEOFF:
            flying = self.navigator.state is TakeoffState.FLIGHT
            return Mode.LOITER if flying and self.navigator.reached(down) else None
        return self.mission.wish if self._mode is Mode.MISSION else None

    @property
    def climb_controlled(self) -> bool:
        """Does the mode that `begin` was told of control vertical speed?"""
        return self._mode is not None and self.runs(self._mode)

    def take_texts(self) -> list[Text]:
        """What mission and return have said since the last call."""
        if not self.mission.texts and not self.home_run.texts:
            return []
        texts = [*self.mission.texts, *self.home_run.texts]
        self.mission.texts.clear()
        self.home_run.texts.clear()
        return texts
