"""Modes, arming, failsafes and commands of one vehicle, as PX4's commander decides them 100 times a second.

Texts are PX4's; one that ends with a TAB also goes out as an event, and ground stations that know events drop it.
"""

from __future__ import annotations

import math

from sitl.failsafe import Action, Failsafe, Links
from sitl.failure_detector import TiltDetector
from sitl.flight_control import FlightControl
from sitl.ground_contact import GroundContact
from sitl.land_detector import LandDetector, Motion
from sitl.landing_watch import LandingWatch, land_limits
from sitl.manual_input import ManualInput
from sitl.modes import EXTERNAL_MODES, MODE_NAMES, NEVER_ARM, STICK_MODES, Home, Mode, Result, Severity, Text
from sitl.parameters import ParameterTable
from sitl.plant import Plant
from sitl.preflight import health_problem, mode_problem, stick_problem
from sitl.sensors import ORIGIN, geodetic, local_position
from sitl.setpoints import Reposition

READY_US = 2_000_000
"""Time from boot until sensors and estimator count as healthy, us."""

_WISHFUL = frozenset({Mode.TAKEOFF, Mode.VTOL_TAKEOFF, Mode.MISSION})
"""Modes that want another when they are done."""

_TELL_WHY_US = 400_000
_STICKS_OVER_AUTO, _STICKS_OVER_OFFBOARD = 1, 2


class Commander:
    """Who decides what the vehicle flies.

    Args:
        parameters: the table it obeys.
        plant: what it flies; read only through what an estimator gives.
        control: the fast half, which flies what is decided here.

    Attributes:
        mode: the mode flown. intended: the mode the user chose, which a failsafe may overrule.
        armed, failsafe, terminated, healthy: as they say.
        home: where Return goes, None before the first position.
        rejection: why the last command was refused.
        manual: the sticks.
    """

    def __init__(self, parameters: ParameterTable, plant: Plant, control: FlightControl) -> None:
        self.parameters = parameters
        self.control = control
        self.land_detector = LandDetector()
        self.manual = ManualInput(parameters)
        self.mode = Mode.LOITER
        self.intended = Mode.LOITER
        self.armed = False
        self.failsafe = False
        self.terminated = False
        self.healthy = False
        self.home: Home | None = None
        self.rejection = ""
        self._plant = plant
        self._landing = LandingWatch(parameters)
        self._tilt = TiltDetector(parameters)
        self._failsafe = Failsafe(parameters)
        self._now_us = self._booted_us = self._armed_us = 0
        self._after_disarming = Mode.LOITER
        self._texts: list[Text] = []
        self._offboard_us: int | None = None
        self._gcs = GroundContact(parameters)
        self._action = Action.NONE
        self._takeoff_amsl_m: float | None = None
        self._tilt_warned = False
        self._home_here = True
        self._told_why = False
        self._land_limits = land_limits(parameters)

    @property
    def ready(self) -> bool:
        """Would it arm, here and in this mode? In flight: is it healthy?"""
        return self.healthy and (self.armed or not (self._health_problem() or self._mode_problem(self.mode)))

    def take_texts(self) -> list[Text]:
        """Texts since the last call."""
        texts, self._texts = self._texts, []
        return texts

    def say(self, severity: Severity, text: str) -> None:
        """Queue a text for the ground."""
        self._texts.append(Text(severity, text))

    def gcs_heard(self) -> None:
        """A ground station is there."""
        self._gcs.heard(self._now_us)

    # -- commands ----------------------------------------------------------------------------------------------

    def command_arm(self, arm: bool, *, force: bool = False) -> Result:
        """Arm or disarm; PX4's texts, PX4's rules (force does not skip the checks of arming)."""
        if not arm:
            if not self.armed:
                return Result.ACCEPTED
            if not self.land_detector.landed and not force:
                return self._refuse("Disarming denied: not landed\t")
            self._disarm("Disarmed by external command\t")
            return Result.ACCEPTED
        if self.armed:
            return Result.ACCEPTED
        sticks = stick_problem(self.mode, self.manual.sticks)
        if sticks:
            return self._refuse(f"Arming denied: {sticks}\t")
        health = self._health_problem()
        if health and (self.healthy or not self._told_why):
            self.say(Severity.CRITICAL, f"Preflight Fail: {health}")
            self._told_why = True
        problem = health or self._mode_problem(self.mode)
        if problem:
            return self._refuse("Arming denied: Resolve system health failures first\t", problem)
        self.armed = True
        self._armed_us = self._now_us
        self._action = Action.NONE
        self._failsafe.on_arm(self._now_us, self._links())
        self._landing.on_arm(self._now_us)
        if self._home_here:
            self._set_home()
        self.control.navigator.on_arm(self._now_us)
        self.say(Severity.INFO, "Armed by external command\t")
        self._begin(self.mode, self.mode)
        return Result.ACCEPTED

    def command_mode(self, mode: Mode, *, explain: bool = True) -> Result:
        """Switch the mode; disarmed every mode is accepted, armed only one that can run. explain: say a refusal."""
        if self.terminated:
            return self._refuse("Switching modes denied: flight terminated")
        if mode is Mode.TERMINATION:
            return self._refuse("Switching to Termination is currently not available\t")
        if self.armed:
            problem = self._mode_problem(mode, arming=False)
            if problem:
                self.rejection = problem
                if explain:
                    self.say(Severity.CRITICAL, f"Switching to {MODE_NAMES[mode]} is currently not available\t")
                return Result.TEMPORARILY_REJECTED
        self._takeoff_amsl_m = None
        self._choose(mode)
        return Result.ACCEPTED

    def command_takeoff(self, altitude_amsl_m: float | None) -> Result:
        """Take off to a height, m AMSL, or to MIS_TAKEOFF_ALT above here; flies once armed."""
        if self.terminated:
            return self._refuse("Takeoff denied: flight terminated")
        self._takeoff_amsl_m = altitude_amsl_m
        self._choose(Mode.TAKEOFF)
        return Result.ACCEPTED

    def command_land(self) -> Result:
        """Land here; accepted unless the flight was terminated."""
        if self.terminated:
            return self._refuse("Landing denied: flight terminated")
        self.say(Severity.INFO, "Landing at current position\t")
        self._choose(Mode.LAND)
        return Result.ACCEPTED

    def command_return(self) -> Result:
        """Return home and land."""
        result = self.command_mode(Mode.RTL)
        if result is Result.ACCEPTED:
            self.say(Severity.INFO, "Returning to launch\t")
        return result

    def command_reposition(self, where: Reposition) -> Result:
        """Hold, and go to a place first. where: NaN keeps what is."""
        result = self.command_mode(Mode.LOITER)
        if result is Result.ACCEPTED and self.armed:
            self.control.navigator.reposition(where)
        return result

    def command_orbit(self, where: Reposition, *, radius_m: float, speed_m_s: float) -> Result:
        """Fly a circle round a place, or round here. radius_m: below 0 is anticlockwise; NaN takes NAV_LOITER_RAD."""
        result = self.command_mode(Mode.ORBIT, explain=False)
        if result is Result.ACCEPTED and self.armed:
            self.control.navigator.orbit(where._replace(speed_m_s=speed_m_s), radius_m)
        return result

    def command_mission_start(self) -> Result:
        """Arm and fly the mission."""
        self.rejection = self._mission_problem()
        if self.rejection:
            self.say(Severity.CRITICAL, "Mission start denied! No valid mission\t")
            return Result.DENIED
        if self.command_mode(Mode.MISSION) is not Result.ACCEPTED or self.command_arm(True) is not Result.ACCEPTED:
            self.say(Severity.CRITICAL, "Mission start denied\t")
            return Result.DENIED
        return Result.ACCEPTED

    def command_set_home_here(self) -> Result:
        """Home is where the vehicle is now."""
        if not self.healthy:
            return self._refuse("Set home denied: no position yet")
        self._set_home()
        return Result.ACCEPTED

    def command_set_home(self, lat_deg: float, lon_deg: float, alt_m: float) -> Result:
        """Home is a place on the globe, deg, m AMSL; denied if it is none."""
        if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and math.isfinite(alt_m)):
            return Result.DENIED
        w, x, y, z = self._plant.quat.tolist()
        self.home = Home(lat_deg, lon_deg, alt_m, local_position(lat_deg, lon_deg, alt_m), (w, x, y, z))
        self.control.mission.home = self.home
        self._home_here = False
        return Result.ACCEPTED

    def command_terminate(self, on: bool) -> Result:
        """Stop all motors until disarmed, also by landing; denied while disarmed or when off is asked."""
        if not on or not self.armed:
            return Result.DENIED
        self._terminate()
        return Result.ACCEPTED

    # -- 100 Hz ------------------------------------------------------------------------------------------------

    def think(self, now_us: int) -> None:
        """Look at everything once and decide. now_us: vehicle time, us."""
        self._now_us = now_us
        if not self.healthy:
            self._start_up()
        self._detect_landing()
        self._detect_tilt()
        said = self._gcs.update(now_us)
        if said:
            self.say(Severity.INFO, said)
        self.manual.update(now_us)
        self.control.sticks = self.manual.sticks
        if not self.armed:
            return
        for said in self._landing.update(now_us, self.land_detector.landed):
            self.say(Severity.INFO, said)
        if self._landing.disarm:
            self._disarm(self._landing.disarm)
            return
        self._texts += self.control.take_texts()
        if self.manual.moving:
            self._sticks_take_over()
        if self.mode in _WISHFUL and self.mode is self.intended:
            wish = self.control.wish
            if wish is not None:
                self._choose(wish)
        if not self.terminated:
            self._act()

    def _start_up(self) -> None:
        """Wait for the estimator; why one has to is said once."""
        if self.home is None:
            self._set_home()
        running_us = self._now_us - self._booted_us
        if not self._told_why and running_us >= _TELL_WHY_US:
            self._told_why = True
            self.say(Severity.CRITICAL, f"Preflight Fail: {self._health_problem()}")
        if running_us >= READY_US:
            self.healthy = True
            self._set_home()

    def _detect_landing(self) -> None:
        if self.land_detector.flies(self.control.thrust_sp, self._land_limits):
            return
        self.land_detector.update(self._now_us, self._motion(), self._land_limits, self.armed)
        self.control.set_landed(self.land_detector.maybe_landed)

    def _motion(self) -> Motion:
        fx, fy, fz = self._plant.force.tolist()
        p, q, r = self.control.state["rates"][0].tolist()
        n, e, d = self.control.velocity.tolist()
        held = self.control.climb_controlled
        descending = held and self.control.navigator.descending
        return Motion(self.control.thrust_sp, (n, e, d), (p, q, r), (fx, fy, fz), held, descending)

    def _detect_tilt(self) -> None:
        phi, theta, _ = self._plant.euler()
        self._tilt.update(self._now_us, phi, theta, not self.control.stopped)
        if not self._tilt.failed or self.terminated:
            self._tilt_warned = self._tilt_warned and self._tilt.failed
            return
        action = self._tilt.action(self._now_us - self._armed_us)
        if action is Action.DISARM:
            self.say(Severity.CRITICAL, "Attitude failure detected\t")
            self._disarm("Disarmed by failsafe\t")
        elif action is Action.TERMINATE:
            self.say(Severity.EMERGENCY, "Attitude failure detected: flight terminated")
            self._terminate()
        elif not self._tilt_warned:
            self._tilt_warned = True
            self.say(Severity.CRITICAL, "Attitude failure detected\t")

    def _sticks_take_over(self) -> None:
        """A pilot who moves the sticks in a mode that flies by itself gets Position (COM_RC_OVERRIDE)."""
        if self.mode in STICK_MODES or self.terminated:
            return
        bit = _STICKS_OVER_OFFBOARD if self.mode is Mode.OFFBOARD else _STICKS_OVER_AUTO
        if int(self.parameters.get("COM_RC_OVERRIDE")) & bit:
            self.say(Severity.INFO, "Pilot took over using sticks\t")
            self._choose(Mode.POSCTL)

    def _act(self) -> None:
        """Fly the user's mode or what a failsafe wants."""
        links = self._links()
        quiet = self.mode is self.intended and self._action is Action.NONE
        if quiet and self._failsafe.calm(self._now_us, self.mode, links):
            self.failsafe = self._tilt_warned
            return
        choice = self._failsafe.choose(self._now_us, self.intended, links)
        if choice.action > max(self._action, Action.WARN):
            hold = f"Failsafe activated: entering Hold for {choice.delayed_s:.0f} seconds\t"
            self.say(Severity.CRITICAL, hold if choice.delayed_s else "Failsafe activated\t")
        self._action = choice.action
        self.failsafe = choice.action > Action.WARN or self._tilt_warned
        if choice.action is Action.DISARM:
            self._disarm("Disarmed by failsafe\t")
        elif choice.action is Action.TERMINATE:
            self._terminate()
        elif choice.mode is not self.mode:
            self._begin(choice.mode, self.mode)

    def _links(self) -> Links:
        return Links(self._gcs.lost, self.manual.sticks is None, not self.offboard_fresh())

    def offboard_fresh(self) -> bool:
        """Are Offboard's set-points coming (COM_OF_LOSS_T)?"""
        if self._offboard_us is None:
            return False
        return self._now_us - self._offboard_us <= float(self.parameters.get("COM_OF_LOSS_T")) * 1e6

    # -- transitions -------------------------------------------------------------------------------------------

    def _health_problem(self) -> str:
        return health_problem(self.healthy, self.terminated, self.control.motor_count, self._gcs.missed)

    def _mode_problem(self, mode: Mode, *, arming: bool = True) -> str:
        if arming and mode in NEVER_ARM:
            return f"mode not suitable for arming: {MODE_NAMES[mode]}"
        if mode in EXTERNAL_MODES:
            return "no such external mode is registered"
        return mode_problem(mode, self._links(), self._mission_problem() if mode is Mode.MISSION else "")

    def _mission_problem(self) -> str:
        mission = self.control.mission
        mission.home, mission.landed = self.home, self.land_detector.landed
        return mission.problem

    def _refuse(self, text: str, reason: str = "") -> Result:
        self.rejection = reason or text.rstrip("\t")
        self.say(Severity.CRITICAL, text)
        return Result.TEMPORARILY_REJECTED

    def _choose(self, mode: Mode) -> None:
        """The user's (or the flight's own) choice of mode."""
        if mode not in NEVER_ARM:
            self._after_disarming = mode
        if mode is not self.mode:
            self.control.forget_setpoint()
        self.intended = mode
        self._action = Action.NONE
        self._failsafe.on_mode_change()
        self.failsafe = self._tilt_warned
        self._begin(mode, self.mode)

    def _begin(self, mode: Mode, before: Mode) -> None:
        self.mode = mode
        if not self.armed:
            return
        self.control.begin(self._now_us, mode, before, home=self.home, landed=self.land_detector.landed)
        if mode is Mode.TAKEOFF:
            wish_m = self._takeoff_amsl_m
            self._texts += self.control.navigator.aim(None if wish_m is None else ORIGIN[2] - wish_m)

    def _disarm(self, text: str) -> None:
        self.armed = False
        self.terminated = False
        self.failsafe = False
        self._tilt_warned = False
        self._home_here = True
        self._action = Action.NONE
        self.control.stop()
        self.control.navigator.on_disarm()
        self.say(Severity.INFO, text)
        self.mode = self.intended = self._after_disarming

    def _terminate(self) -> None:
        self.terminated = True
        self.failsafe = True
        self.intended = Mode.TERMINATION
        # so that nothing flown before asks for a next mode, and landing is judged without a climb rate
        self._begin(Mode.TERMINATION, self.mode)
        self.control.stop()

    def _set_home(self) -> None:
        position = self._plant.position_ned()
        w, x, y, z = self._plant.quat.tolist()
        self.home = Home(*geodetic(position), position, (w, x, y, z))
        self.control.mission.home = self.home
