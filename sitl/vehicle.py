"""Plant, sensors and autopilot as one vehicle that moves tick by tick."""

from __future__ import annotations

from dataclasses import dataclass

from sitl.autopilot import Autopilot
from sitl.control_settings import mix_of
from sitl.faults import Faults
from sitl.filters import constrain
from sitl.parameters import ParameterTable
from sitl.plant import Plant
from sitl.profile import Profile
from sitl.rotation import to_euler
from sitl.sensors import ORIGIN, Gps, Sensors
from sitl.vehicle_spec import VehicleModel

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

_READY_WITHIN_US = 20_000_000
_TICKS_IN_FLIGHT = 50


@dataclass(frozen=True)
class Battery:
    """Terminal voltage (V), current (A), remaining charge (0..1)."""

    voltage_v: float
    current_a: float
    remaining: float


class Truth:
    """What the plant really does."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def quat(self) -> Quat:
        """Attitude, body to world."""
        w, x, y, z = self._plant.quat.tolist()
        return w, x, y, z

    def euler(self) -> Vec3:
        """(phi, theta, psi), rad."""
        return self._plant.euler()

    def rates(self) -> Vec3:
        """Body rates p, q, r, rad/s."""
        p, q, r = self._plant.rates.tolist()
        return p, q, r

    def velocity_ned(self) -> Vec3:
        """m/s."""
        return self._plant.velocity_ned()

    def velocity_body(self) -> Vec3:
        """(u, v, w), m/s."""
        u, v, w = self._plant.x[3:6].tolist()
        return u, v, w

    def position_ned(self) -> Vec3:
        """From where the vehicle booted, m."""
        return self._plant.position_ned()

    def accel_body(self) -> Vec3:
        """Mean specific force of the last tick, m/s^2."""
        x, y, z = self._plant.force.tolist()
        return x, y, z

    def altitude_m(self) -> float:
        """Above mean sea level, m."""
        return ORIGIN[2] - float(self._plant.x[2])

    def delta(self) -> Quat:
        """(delta_lat, delta_lon, delta_yaw, thrust) that the motors give now."""
        lat, lon, yaw, thrust = self._plant.delta.tolist()
        return lat, lon, yaw, thrust


class Estimate(Truth):
    """What the autopilot believes: attitude a fraction of a tick late, filtered rates, noisy sensors."""

    def __init__(self, plant: Plant, autopilot: Autopilot, sensors: Sensors) -> None:
        super().__init__(plant)
        self._attitude = autopilot.state["attitude"][0]
        self._rates = autopilot.state["rates"][0]
        self._sensors = sensors

    def quat(self) -> Quat:
        """Attitude, body to world."""
        w, x, y, z = self._attitude.tolist()
        return w, x, y, z

    def euler(self) -> Vec3:
        """(phi, theta, psi), rad."""
        euler: Vec3 = to_euler(tuple(self._attitude.tolist()))
        return euler

    def rates(self) -> Vec3:
        """Filtered gyro p, q, r, rad/s."""
        p, q, r = self._rates.tolist()
        return p, q, r

    def accel_body(self) -> Vec3:
        """Accelerometer, m/s^2."""
        return self._sensors.accel()

    def gyro_body(self) -> Vec3:
        """Gyro before any filter, rad/s."""
        p, q, r = self._sensors.gyro.tolist()
        return p, q, r

    def mag_body(self) -> Vec3:
        """Magnetometer, gauss."""
        return self._sensors.mag()

    def pressure_hpa(self) -> float:
        """Barometer, hPa."""
        return self._sensors.pressure()


class Vehicle:
    """A simulated multirotor: the model that flies and the autopilot that flies it.

    Args:
        model: derivatives, body, assumptions.
        profile: rates, delays, filters, limits, noise.
        seed: of the sensor noise.
        parameters: a table to start from; by default PX4's defaults with the airframe's geometry and the profile's
            filter cutoffs.

    Attributes:
        faults: what is wrong with plant, battery and sensors.
    """

    def __init__(
        self,
        model: VehicleModel,
        profile: Profile,
        *,
        seed: int = 0,
        parameters: ParameterTable | None = None,
    ) -> None:
        self.model = model
        self.profile = profile
        self.seed = seed
        self.parameters = parameters or ParameterTable(airframe_parameters(model, profile))
        self.tick = 0
        self.tick_us = profile.tick_us
        self.origin = ORIGIN
        self.plant = Plant(
            model.derivatives,
            model.assumptions,
            mix_of(ParameterTable(airframe_parameters(model, profile))),
            tick_us=self.tick_us,
            motor_lag_s=profile.motor_lag(model.assumptions.motor_lag_s),
            delay_ticks=profile.transport_delay_ticks,
            linear=profile.linear,
        )
        self._sensors = Sensors(self.plant, profile, seed)
        self.autopilot = Autopilot(self.parameters, profile, self.plant, self._sensors)
        self.truth = Truth(self.plant)
        self.estimate = Estimate(self.plant, self.autopilot, self._sensors)
        self.faults = Faults(self.plant, self._sensors, seed)
        self._commands = self.autopilot.tick(0)

    @property
    def time_us(self) -> int:
        """Vehicle time since boot, us."""
        return self.tick * self.tick_us

    def step(self) -> None:
        """One tick: the plant moves with the motors of the last sample, then a new sample is flown on."""
        self.plant.step(self._commands)
        self.tick += 1
        now_us = self.time_us
        self._sensors.sample(now_us)
        self._commands = self.autopilot.tick(now_us)

    def gps(self) -> Gps:
        """Last position fix."""
        return self._sensors.gps()

    def battery(self) -> Battery:
        """A battery that never empties."""
        load = sum(self.autopilot.motors)
        return Battery(voltage_v=(16.2 - 0.05 * load) * self.faults.voltage, current_a=5.0 * load, remaining=1.0)


def warm_up(model: VehicleModel, profile: Profile) -> None:
    """Let another vehicle take off, so that every law is compiled, or loaded, before one flies by a clock.

    A law is compiled when it is first called, for up to ten seconds, and those of the position first when a vehicle is
    armed: it would stand still then, with its motors on.

    Args:
        model, profile: of the vehicle that will fly; others need the same laws.
    """
    vehicle = Vehicle(model, profile)
    commander = vehicle.autopilot
    while not commander.ready and vehicle.time_us < _READY_WITHIN_US:
        vehicle.step()
    commander.command_arm(True, force=True)
    commander.command_takeoff(None)
    for _ in range(_TICKS_IN_FLIGHT):
        vehicle.step()
    constrain(0.0, -1.0, 1.0)  # which the navigator calls by itself, in other modes


def airframe_parameters(model: VehicleModel, profile: Profile) -> dict[str, float | int]:
    """Parameters that differ from PX4's defaults on this airframe, as a PX4 airframe file would set them.

    Args:
        model: rotors and hover thrust. profile: gyro filter cutoffs.

    Returns:
        name -> value: CA_ROTOR_COUNT, CA_ROTORn_PX/PY/PZ/KM, MAV_TYPE, MPC_THR_HOVER, IMU_*_CUTOFF,
        SDLOG_*.
    """
    rotors = model.airframe.rotors
    values: dict[str, float | int] = {
        "CA_ROTOR_COUNT": len(rotors),
        "MAV_TYPE": {4: 2, 6: 13, 8: 14, 3: 15, 12: 29}.get(len(rotors), 2),
        "MPC_THR_HOVER": model.assumptions.hover_thrust,
        "IMU_GYRO_CUTOFF": profile.gyro_cutoff_hz,
        "IMU_DGYRO_CUTOFF": profile.dgyro_cutoff_hz,
        "MC_YAW_TQ_CUTOFF": 0.0 if profile.linear else 2.0,
        # what PX4's start-up script for simulators sets: log from boot, keep a few days of logs
        "SDLOG_MODE": 1,
        "SDLOG_DIRS_MAX": 7,
    }
    for i, rotor in enumerate(rotors):
        for what, value in (("PX", rotor.px_m), ("PY", rotor.py_m), ("PZ", rotor.pz_m), ("KM", rotor.km)):
            values[f"CA_ROTOR{i}_{what}"] = value
    return values
