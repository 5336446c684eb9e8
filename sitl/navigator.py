"""Where the guiding modes want to be: NED set-points for the position controller, leg by leg.

A leg (`sitl.legs`) is held, climbed, gone, circled or landed; what sticks or an offboard computer ask for is passed
on. On and off the ground PX4's take-off states count (`sitl.takeoff`). Ways are flown at limited speed, acceleration
and jerk (`sitl.goto`).
"""

from __future__ import annotations

import math

import numpy as np

from sitl.control_settings import reader
from sitl.filters import constrain
from sitl.legs import Leg, LegKind, Vec3, bounded, wrap
from sitl.modes import Mode, Severity, Text
from sitl.orbit import Orbit, sane_radius
from sitl.parameters import ParameterTable
from sitl.position_control import POSITION_INPUT
from sitl.sensors import ORIGIN, local_position
from sitl.setpoints import Reposition
from sitl.stick_motion import MotionSetpoint
from sitl.takeoff import Takeoff, TakeoffState
from sitl.track import Track

_MOVING = (LegKind.GO, LegKind.CIRCLE)
_HOLD = Leg(LegKind.HOLD)
_HERE = (math.nan, math.nan, math.nan)


class Navigator:
    """Set-points of the modes that the position controller flies.

    Args:
        parameters: MPC_*, MIS_TAKEOFF_ALT, NAV_ACC_RAD, COM_SPOOLUP_TIME.

    Attributes:
        hold_ned: where Hold is or goes, m. track: the way there, with the heading set-point.
        target_down: height of the take-off under way, m (down).
        descending: it means to go down, or to stay down.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._get = reader(parameters)
        self.takeoff = Takeoff(self._get)
        self.request = np.zeros(1, POSITION_INPUT)
        # views: writing through them costs a tenth of writing a field of a structured array
        self._idle = self.request["idle"]
        self._yaw_sp = self.request["yaw_sp"]
        self._position_sp = self.request["position_sp"][0]
        self._velocity_sp = self.request["velocity_sp"][0]
        self._acceleration_sp = self.request["acceleration_sp"][0]
        self._idle[0] = True
        self.hold_ned = [0.0, 0.0, 0.0]
        self.track = Track(self._get)
        self.target_down: float | None = None
        self.descending = False
        self._flown = LegKind.HOLD
        self._goal: Leg | None = None
        self._orbit: Orbit | None = None
        self._climb = 0.0

    # -- what it is told ---------------------------------------------------------------------------------------

    @property
    def state(self) -> TakeoffState:
        """Where between ground and flight."""
        return self.takeoff.state

    def on_arm(self, now_us: int) -> None:
        """Start the spool-up clock."""
        self.takeoff.arm(now_us)
        self._climb = 0.0

    def on_disarm(self) -> None:
        """Stop."""
        self.takeoff.state = TakeoffState.DISARMED
        self.target_down = None
        self.cruise_m_s = math.nan
        self._goal = self._orbit = None

    def airborne(self) -> None:
        """Another mode brought it into the air: skip spool-up and ramp."""
        self.takeoff.airborne()

    def enter(self, position: Vec3, velocity: Vec3, yaw: float) -> None:
        """A mode of this navigator begins: hold where the vehicle can stop.

        Args:
            position: NED, m. velocity: NED, m/s. yaw: rad.
        """
        brake = 2.0 * self._get("MPC_ACC_HOR")
        reach = math.hypot(velocity[0], velocity[1]) / brake if brake > 0.0 else 0.0
        self.hold_ned = [position[0] + velocity[0] * reach, position[1] + velocity[1] * reach, position[2]]
        self.track.face(yaw)
        self._climb = velocity[2]
        self._goal = self._orbit = None
        self._flown = LegKind.HOLD
        self.descending = self.state not in (TakeoffState.RAMPUP, TakeoffState.FLIGHT)

    def aim(self, target_down: float | None) -> list[Text]:
        """Choose the height of a take-off that begins where this navigator was entered.

        Args:
            target_down: wanted height in the local frame, m (down); None or not finite for MIS_TAKEOFF_ALT above here.

        Returns:
            texts to say.
        """
        here, texts = self.hold_ned[2], []
        if target_down is None or not math.isfinite(target_down):
            height = self._get("MIS_TAKEOFF_ALT")
            target_down = here - height
            texts.append(Text(Severity.INFO, f"Using default takeoff altitude: {height:.1f} m\t"))
        if target_down > here:
            target_down = here
            texts.append(Text(Severity.CRITICAL, "Already higher than takeoff altitude\t"))
        self.target_down = target_down
        return texts

    def reached(self, down: float) -> bool:
        """Is the take-off height reached? down: m."""
        return self.target_down is not None and abs(down - self.target_down) < 0.3 and abs(self._climb) < 0.5

    def reposition(self, wish: Reposition) -> None:
        """Hold goes there from now on; call it once Hold is flown. What is NaN stays as it is."""
        self.go(self._place(wish), wrap(wish.yaw) if math.isfinite(wish.yaw) else math.nan)

    def orbit(self, wish: Reposition, radius_m: float) -> None:
        """Go round a place from now on; call it once Orbit is flown.

        Args:
            wish: the centre, height and speed; NaN is here. radius_m: below 0 is anticlockwise; NaN is NAV_LOITER_RAD.
        """
        n, e, d = self.hold_ned
        centre = Leg(LegKind.GO, self._place(wish))
        self._orbit = Orbit(centre, sane_radius(radius_m, self._get("NAV_LOITER_RAD")), (n, e, d))

    def _place(self, wish: Reposition) -> Vec3:
        """Where a wish is, m; the speed it names is taken over."""
        ned = local_position(wish.lat_deg, wish.lon_deg, wish.alt_m, ORIGIN)
        if not (math.isfinite(ned[0]) and math.isfinite(ned[1])):
            ned = (math.nan, math.nan, ned[2])
        if math.isfinite(wish.speed_m_s) and wish.speed_m_s > 0.0:
            self.cruise_m_s = wish.speed_m_s
        n, e, d = self.hold_ned
        return bounded(ned, (n, e, d))

    def go(self, ned: Vec3, yaw: float = math.nan) -> None:
        """Hold there from now on. ned: m. yaw: rad; NaN faces the way."""
        self._goal = Leg(LegKind.GO, ned, yaw)

    @property
    def cruise_m_s(self) -> float:
        """Horizontal speed of the ways, m/s; NaN for MPC_XY_CRUISE."""
        return self.track.cruise_m_s

    @cruise_m_s.setter
    def cruise_m_s(self, speed_m_s: float) -> None:
        self.track.cruise_m_s = speed_m_s

    @property
    def target_ned(self) -> Vec3 | None:
        """Where it is going or holding, NED, m; None while the motors are off."""
        if self.state is TakeoffState.DISARMED:
            return None
        n, e, d = self.hold_ned
        down = self.target_down if self._flown is LegKind.TAKEOFF else None
        return n, e, d if down is None else down

    def leg(self, mode: Mode, position: Vec3) -> Leg:
        """What a mode without a plan of its own flies. position: NED, m."""
        if mode is Mode.TAKEOFF:
            return Leg(
                LegKind.TAKEOFF, (math.nan, math.nan, math.nan if self.target_down is None else self.target_down)
            )
        if mode is Mode.LAND:
            return Leg(LegKind.LAND, _HERE)
        if mode is Mode.DESCEND:
            return Leg(LegKind.DESCEND)
        if self._orbit is not None:
            return self._orbit.leg(position)
        return self._goal or _HOLD

    # -- every run of the position controller ------------------------------------------------------------------

    def fly(
        self,
        now_us: int,
        dt_s: float,
        leg: Leg,
        position: Vec3,
        velocity: Vec3,
        *,
        ground_contact: bool,
        landed: bool,
        home_down: float,
    ) -> None:
        """Set-points of a leg for the next run of the position controller.

        Args:
            now_us: vehicle time. dt_s: time since the last run.
            leg: what to fly. position: NED, m. velocity: NED, m/s.
            ground_contact: from the land detector. landed: likewise.
            home_down: height of home in the local frame, m (down).
        """
        position_sp, velocity_sp = self._position_sp, self._velocity_sp
        self.track.yaw_rate = math.nan
        position_sp[0] = self.hold_ned[0]
        position_sp[1] = self.hold_ned[1]
        velocity_sp[:] = 0.0
        self._acceleration_sp[:] = math.nan
        self.descending = leg.kind in (LegKind.LAND, LegKind.DESCEND)
        up = leg.kind is LegKind.TAKEOFF and leg.ned[2] < position[2] - 0.01
        if self.takeoff.update(now_us, landed=landed, wanted=up):
            self._climb = 0.0
        if self.takeoff.grounded:
            self._yaw_sp[0] = self.track.yaw
            self._stay_down(position)
            return
        self._idle[0] = ground_contact and self.state is TakeoffState.FLIGHT and self.descending
        before, self._flown = self._flown, leg.kind
        if self.state is TakeoffState.RAMPUP and leg.kind in _MOVING and not landed:
            self.airborne()
        if leg.kind in _MOVING or (math.isfinite(leg.ned[0]) and leg.kind is LegKind.LAND):
            if before not in _MOVING and not (before is LegKind.LAND and leg.kind is LegKind.LAND):
                self.track.way.start(position, velocity)
            if leg.kind is LegKind.LAND and before is not LegKind.LAND:
                self._climb = self.track.way.velocity[2]
            self._move(dt_s, leg, position, fresh=before is not leg.kind)
        self._yaw_sp[0] = self.track.yaw
        if self.descending:
            position_sp[2] = math.nan
            velocity_sp[2] = self._speed_up_to(self._landing_speed(home_down - position[2]), dt_s)
            self._acceleration_sp[2] = math.nan
            if leg.kind is LegKind.DESCEND:
                position_sp[:2] = math.nan
        elif leg.kind is LegKind.TAKEOFF and math.isfinite(leg.ned[2]):
            self.target_down = leg.ned[2]
            towards = self._get("MPC_Z_P") * (leg.ned[2] - position[2])
            towards = constrain(towards, -self._get("MPC_TKO_SPEED"), self._get("MPC_Z_V_AUTO_DN"))
            climb = self._speed_up_to(towards, dt_s)
            position_sp[2] = math.nan
            velocity_sp[2] = self._ramped(climb, dt_s)
        elif leg.kind not in _MOVING:
            position_sp[2] = self.hold_ned[2]

    def pass_on(
        self,
        now_us: int,
        dt_s: float,
        wish: MotionSetpoint,
        position: Vec3,
        yaw: float,
        *,
        up: bool,
        ground_contact: bool,
        landed: bool,
    ) -> None:
        """Set-points from sticks or from outside for the next run of the position controller.

        Args:
            now_us: vehicle time. dt_s: time since the last run.
            wish: what is asked for; a NaN heading keeps turning with the vehicle.
            position: NED, m. yaw: heading now, rad. up: it may leave the ground.
            ground_contact: from the land detector. landed: likewise.
        """
        self.track.face(wish.yaw if math.isfinite(wish.yaw) else yaw)
        self.track.yaw_rate = wish.yaw_rate
        self._yaw_sp[0] = self.track.yaw
        self._position_sp[:] = wish.position
        self._velocity_sp[:] = wish.velocity
        self._acceleration_sp[:] = wish.acceleration
        self._flown = LegKind.HOLD
        self.takeoff.update(now_us, landed=landed, wanted=up)
        if self.takeoff.grounded:
            self.track.yaw_rate = math.nan
            self._stay_down(position)
            return
        self.hold_ned = [w if math.isfinite(w) else p for w, p in zip(wish.position, position, strict=True)]
        sinking = wish.velocity[2]
        self.descending = sinking > 0.9 * self._get("MPC_LAND_CRWL")
        if self.state is TakeoffState.RAMPUP:
            sinking = sinking if math.isfinite(sinking) else 0.0
            if math.isfinite(wish.position[2]):
                sinking += self._get("MPC_Z_P") * (wish.position[2] - position[2])
            elif math.isfinite(wish.acceleration[2]) and math.isnan(wish.velocity[2]):
                sinking = math.copysign(self._get("MPC_TKO_SPEED"), wish.acceleration[2])
            sinking = constrain(sinking, -self._get("MPC_Z_VEL_MAX_UP"), self._get("MPC_Z_VEL_MAX_DN"))
            self._position_sp[2] = math.nan
            self._velocity_sp[2] = self._ramped(sinking, dt_s)
        self._idle[0] = ground_contact and self.state is TakeoffState.FLIGHT and self.descending

    def _move(self, dt_s: float, leg: Leg, position: Vec3, *, fresh: bool) -> None:
        """One step of the way of a leg."""
        self.track.move(dt_s, leg, position, fresh=fresh)
        way = self.track.way
        self.hold_ned = list(self.track.goal)
        self._position_sp[:] = way.position
        self._velocity_sp[:] = way.velocity
        self._acceleration_sp[:] = way.acceleration
        if leg.kind is not LegKind.LAND:
            self.descending = way.velocity[2] > 0.9 * self._get("MPC_LAND_CRWL")

    def _stay_down(self, position: Vec3) -> None:
        self._idle[0] = True
        self.hold_ned = list(position)
        self._flown = LegKind.HOLD
        self._goal = self._orbit = None
        self.descending = True

    def _ramped(self, climb: float, dt_s: float) -> float:
        if self.state is not TakeoffState.RAMPUP:
            return climb
        ramped = self.takeoff.ramped(climb, dt_s)
        if self.state is TakeoffState.RAMPUP:
            self.descending = ramped > 0.0
        return ramped

    def _speed_up_to(self, wanted: float, dt_s: float) -> float:
        rise = self._get("MPC_ACC_UP_MAX") * dt_s
        fall = self._get("MPC_ACC_DOWN_MAX") * dt_s
        self._climb = min(self._climb + fall, max(self._climb - rise, wanted))
        return self._climb

    def _landing_speed(self, height: float) -> float:
        fast, slow = self._get("MPC_Z_V_AUTO_DN"), self._get("MPC_LAND_SPEED")
        top, bottom = self._get("MPC_LAND_ALT1"), self._get("MPC_LAND_ALT2")
        share = min(1.0, max(0.0, (height - bottom) / max(1e-3, top - bottom)))
        return slow + share * (fast - slow)
