"""The fast half of the autopilot: set-points in, motor signals out, every tick.

It owns the compiled loops and what they run on, and knows nothing of arming or failsafes: `sitl.autopilot` tells it
what to control and which mode to fly. The position controller runs every 8 ms, on a velocity one tick old.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl import control_loop
from sitl.control_loop import CONTROL_INPUT, CONTROL_SETTINGS, CONTROL_STATE, control_tick, settle_filters
from sitl.control_settings import control_settings, mix_of, position_settings, position_ticks
from sitl.guide import ATTITUDE_BY_STICK, Guide
from sitl.land_detector import LandDetector
from sitl.modes import Home, Mode, Text, flown_as
from sitl.parameters import ParameterTable
from sitl.plant import Plant
from sitl.position_control import POSITION_STATE, position_tick
from sitl.profile import Profile
from sitl.rotation import to_euler
from sitl.sensors import Sensors
from sitl.setpoints import AttitudeSetpoint, PositionRequest, PositionSetpoint, Sticks
from sitl.sticks import clean
from sitl.takeoff import TakeoffState

Quat = tuple[float, float, float, float]
Vec3 = tuple[float, float, float]


class FlightControl:
    """Attitude, rate and position control of one vehicle.

    Args:
        parameters: gains, filters, geometry; taken over with `load`.
        profile: rates and lateness of the loops.
        plant: what it flies; read only through what an estimator gives.
        sensors: the gyro.

    Attributes:
        state: (1,) of CONTROL_STATE.
        navigator: where the guiding modes want to be. mission: what Mission flies.
        velocity: (3,) NED, m/s, of this tick.
        sticks: where a pilot's sticks are; None if there are none, which counts as centred.
    """

    def __init__(self, parameters: ParameterTable, profile: Profile, plant: Plant, sensors: Sensors) -> None:
        self._parameters = parameters
        self._profile = profile
        self._plant = plant
        self._sensors = sensors
        self._guide = Guide(parameters)
        self.navigator = self._guide.navigator
        self.mission = self._guide.mission
        self.sticks: Sticks | None = None
        self._dt_s = 1.0 / profile.rate_hz
        self.state = np.zeros(1, CONTROL_STATE)
        self._settings: NDArray[np.void] = np.zeros(1, CONTROL_SETTINGS)
        self._input = np.zeros(1, CONTROL_INPUT)
        # one-element views: writing through them costs a tenth of writing a field of a structured array
        self._level = self._input["level"]
        self._thrust_sp = self._input["thrust_sp"]
        self._landed = self._input["landed"]
        self._yaw_rate_sp = self._input["yaw_rate_sp"]
        self._rates_sp = self._input["rates_sp"][0]
        self._quat_sp = self._input["quat_sp"][0]
        self._quat_sp[0] = 1.0
        self._landed[0] = True
        self._outputs: NDArray[np.float64] = self.state["outputs"][0]
        self._position_ticks = position_ticks(profile)
        self._ticks = 0
        self.velocity = np.zeros(3)
        self._velocity_late = np.zeros(3)
        self._attitude_sp = AttitudeSetpoint()
        self._waiting_level = control_loop.OFF
        self.forget_position()
        self.load()

    # -- what it runs on ---------------------------------------------------------------------------------------

    def load(self) -> None:
        """Take the parameters over, as PX4's modules do on a parameter update."""
        table = self._parameters
        before = self._settings
        self._settings = control_settings(table, self._profile, mix_of(table))
        changed = any((self._settings[name] != before[name]).any() for name in ("low_pass", "notches", "notch_count"))
        if changed and self.state["started"][0]:
            settle_filters(self._settings, self.state)
        self.motor_count = int(self._settings["motor_count"][0])
        self._position_settings = position_settings(table, self._profile)
        self._tilt_max = self._position_settings["tilt_max"]
        self._tilt_max_air = math.radians(float(table.get("MPC_TILTMAX_AIR")))
        self._tilt_max_ground = math.radians(float(table.get("MPC_TILTMAX_LND")))
        self._position_dt_s = float(self._position_settings["dt_s"][0])

    def forget_position(self) -> None:
        """The position controller begins anew: another mode flew meanwhile."""
        self._position_state = np.zeros(1, POSITION_STATE)
        self._held_quat = self._position_state["quat_sp"][0]
        self._held_thrust = self._position_state["thrust_sp"]

    def restart(self) -> None:
        """Begin anew, motors off: filters, integrators and set-points are as at boot."""
        self.state[:] = np.zeros(1, CONTROL_STATE)
        self.stop()
        self.set_landed(True)
        self.forget_setpoint()
        self.forget_position()
        self.navigator.on_disarm()

    # -- what it is told ---------------------------------------------------------------------------------------

    @property
    def stopped(self) -> bool:
        """Are the motors off?"""
        return bool(self._level[0] == control_loop.OFF)

    @property
    def thrust_sp(self) -> float:
        """Collective thrust set-point, 0..1."""
        return float(self._thrust_sp[0])

    def stop(self) -> None:
        """Motors off, integrators reset."""
        self._level[0] = control_loop.OFF
        self._thrust_sp[0] = 0.0

    def set_landed(self, landed: bool) -> None:
        """On the ground the integrators are frozen."""
        self._landed[0] = landed

    def take_setpoint(self, now_us: int, quat: Quat | None, rates: Vec3, thrust: float, *, fly: bool) -> None:
        """Take an external set-point.

        Args:
            now_us: vehicle time. quat: attitude, or None for rates alone.
            rates: body rates, rad/s; with an attitude only the yaw rate counts.
            thrust: 0..1. fly: at once; otherwise it waits for `fly_setpoint`.
        """
        shown = quat if quat is not None else (1.0, 0.0, 0.0, 0.0)
        self._guide.drop()
        self._attitude_sp = AttitudeSetpoint(now_us, shown, rates, thrust, self._attitude_sp.serial + 1)
        self._waiting_level = control_loop.RATES if quat is None else control_loop.ATTITUDE
        self._rates_sp[:] = rates
        self._yaw_rate_sp[0] = rates[2]
        self._quat_sp[:] = shown
        if fly:
            self.fly_setpoint()

    def take_position(self, now_us: int, request: PositionRequest, *, fly: bool) -> None:
        """Take an external set-point of position, velocity or acceleration; `guide` flies it in Offboard.

        Args:
            now_us: vehicle time. request: NED. fly: at once; otherwise it waits for `fly_setpoint`.
        """
        if self._guide.take(request) and fly:
            self.forget_position()

    @property
    def by_position(self) -> bool:
        """Is the external set-point taken last one of position, velocity or acceleration?"""
        return self._guide.request is not None

    def fly_setpoint(self) -> None:
        """Fly the external set-point taken last; without one hold still, without thrust."""
        if self._guide.request is not None:
            self.forget_position()
        elif self._waiting_level != control_loop.OFF:
            self._level[0] = self._waiting_level
            self._thrust_sp[0] = self._attitude_sp.thrust
        else:
            self._level[0] = control_loop.RATES
            self._rates_sp[:] = 0.0
            self._thrust_sp[0] = 0.0

    def forget_setpoint(self) -> None:
        """What an earlier Offboard was asked for counts no more."""
        self._waiting_level = control_loop.OFF
        self._guide.request = None

    def begin(self, now_us: int, mode: Mode, before: Mode, *, home: Home | None, landed: bool) -> None:
        """A mode begins while armed; at arming `before` is the mode itself.

        Args:
            now_us: vehicle time. mode: to be flown from now on. before: flown until now.
            home: where Return goes and heights are counted from. landed: from the land detector.
        """
        mode, before = flown_as(mode), flown_as(before)
        stopped = self.stopped
        place = self._plant.position_ned(), self._plant.velocity_ned(), self._yaw()
        if self._guide.begin(mode, before, *place, home=home, landed=landed, stopped=stopped):
            self.forget_position()
        if mode is Mode.OFFBOARD and (stopped or self.by_position):
            self.fly_setpoint()

    # -- every tick --------------------------------------------------------------------------------------------

    def run(self) -> NDArray[np.float64]:
        """One tick of gyro filter, attitude, rate and allocation; (12,) motor signals."""
        self._ticks += 1
        self._velocity_late[:] = self.velocity
        self.velocity[:] = self._plant.velocity
        control_tick(self._settings, self._input, self.state, self._sensors.gyro, self._plant.quat)
        return self._outputs

    def guide(self, now_us: int, mode: Mode, landing: LandDetector, home: Home | None) -> None:
        """Let a mode choose the set-point that is flown from the next tick on.

        Args:
            now_us: vehicle time. mode: any; Offboard by attitude or rates is left alone. landing: is it on the ground?
            home: where Return goes and heights are counted from.
        """
        if mode is Mode.OFFBOARD and self._guide.request is None:
            return
        mode = flown_as(mode)
        if mode in ATTITUDE_BY_STICK:
            self._fly_sticks(now_us, mode, landing.landed)
            return
        if self._ticks % self._position_ticks or not self._guide.runs(mode):
            return
        flying = self.navigator.state is TakeoffState.FLIGHT
        self._tilt_max[0] = self._tilt_max_air if flying else self._tilt_max_ground
        self._guide.choose(
            now_us,
            self._position_dt_s,
            mode,
            self.sticks,
            self._plant.position_ned(),
            self._plant.velocity_ned(),
            self._yaw(),
            home=home,
            ground_contact=landing.ground_contact,
            landed=landing.landed,
        )
        self._run_position(now_us)

    def _yaw(self) -> float:
        yaw: float = to_euler(tuple(self._plant.quat.tolist()))[2]
        return yaw

    def _run_position(self, now_us: int) -> None:
        """Run the position controller and take what it wants."""
        position_tick(
            self._position_settings,
            self.navigator.request,
            self._position_state,
            self._plant.position,
            self._velocity_late,
        )
        self._quat_sp[:] = self._held_quat
        thrust = float(self._held_thrust[0])
        self._thrust_sp[0] = thrust
        self._yaw_rate_sp[0] = self.navigator.track.yaw_rate
        self._level[0] = control_loop.ATTITUDE
        w, x, y, z = self._held_quat.tolist()
        serial = self._attitude_sp.serial + 1
        self._attitude_sp = AttitudeSetpoint(now_us, (w, x, y, z), (0.0, 0.0, 0.0), thrust, serial)

    def _fly_sticks(self, now_us: int, mode: Mode, landed: bool) -> None:
        """Stabilized and Acro."""
        sticks, law = clean(self.sticks), self._guide.by_stick
        if mode is Mode.ACRO:
            rates, thrust = law.rates(sticks)
            self._level[0] = control_loop.RATES
            self._rates_sp[:] = rates
            quat = (1.0, 0.0, 0.0, 0.0)
        else:
            spooled_up = self.navigator.takeoff.spooled_up(now_us)
            quat, rate, thrust = law.attitude(sticks, self._yaw(), self._dt_s, landed=landed, spooled_up=spooled_up)
            rates = (0.0, 0.0, rate)
            self._level[0] = control_loop.ATTITUDE
            self._quat_sp[:] = quat
            self._yaw_rate_sp[0] = rate or math.nan
        self._thrust_sp[0] = thrust
        self._attitude_sp = AttitudeSetpoint(now_us, quat, rates, thrust, self._attitude_sp.serial + 1)

    # -- what it shows -----------------------------------------------------------------------------------------

    @property
    def wish(self) -> Mode | None:
        """The mode that what is flown wants next, until `begin` is told of another mode."""
        return self._guide.wish(self._plant.position_ned()[2])

    @property
    def climb_controlled(self) -> bool:
        """Does the mode that `begin` was told of control vertical speed?"""
        return self._guide.climb_controlled

    def take_texts(self) -> list[Text]:
        """What mission and return have said since the last call."""
        return self._guide.take_texts()

    @property
    def motors(self) -> tuple[float, ...]:
        """Signals sent to the motors, 0..1."""
        return tuple(self._outputs[: self.motor_count].tolist())

    @property
    def attitude_sp_count(self) -> int:
        """How many attitude set-points there have been: cheap to watch for a new one."""
        return self._attitude_sp.serial

    @property
    def attitude_sp(self) -> AttitudeSetpoint:
        """Attitude set-point with the rate set-point that the attitude law now makes of it."""
        p, q, r = self.state["rates_sp"][0].tolist()
        sp = self._attitude_sp
        return AttitudeSetpoint(sp.time_us, sp.quat, (p, q, r), sp.thrust, sp.serial)

    def position_sp(self, now_us: int, *, used: bool) -> PositionSetpoint:
        """What the position controller was asked for last. used: a mode that holds a position is flown."""
        request, state = self.navigator.request[0], self._position_state[0]
        n, e, d = request["position_sp"].tolist()
        vn, ve, vd = state["vel_sp"].tolist()
        an, ae, ad = state["acc_sp"].tolist()
        yaw = float(request["yaw_sp"]) if used else math.nan
        turn = self.navigator.track.yaw_rate
        rate = (turn if math.isfinite(turn) else 0.0) if used else math.nan
        return PositionSetpoint(now_us, (n, e, d), (vn, ve, vd), (an, ae, ad), yaw, rate, self._ticks)
