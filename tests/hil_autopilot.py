"""Our own autopilot behind a real one's wires: it flies on what HIL_SENSOR and HIL_GPS tell, and on nothing else.

`WiredVehicle` is a vehicle whose plant is only what its autopilot believes. `AutopilotOnWire` flies one as a brain of
`px4_stand_in.StandIn`, in lockstep, and there takes HIL_STATE_QUATERNION for its estimate as a simulator offers it.
`hil_board.Board` flies one in wall-clock time on a serial line, where there is no truth.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from hil_estimator import Estimator
from px4_rules import Sample

from bridge.connection import Connection, Message
from bridge.link import Link, open_link
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.autopilot import Autopilot
from sitl.parameters import ParameterTable
from sitl.profile import Profile, get_profile
from sitl.sensors import ORIGIN, Gps, Sensors
from sitl.vehicle import Estimate, Vehicle
from sitl.vehicle_spec import VehicleModel, resolve_vehicle

Vec3 = tuple[float, float, float]


_FIRST_MOTOR = 101


@cache
def warm() -> None:
    """Compile whatever a flight needs: a board that stops for that in the air falls down."""
    vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"))
    while not vehicle.autopilot.healthy:
        vehicle.step()
    vehicle.autopilot.command_arm(True)
    vehicle.autopilot.command_takeoff(None)
    for _ in range(1000):
        vehicle.step()


class WireSensors(Sensors):
    """The last readings that came over the wire."""

    def __init__(self) -> None:
        self.gyro = np.zeros(3)
        self.accel_read: Vec3 = (0.0, 0.0, -9.81)
        self.mag_read: Vec3 = (0.2, 0.0, 0.4)
        self.pressure_read = 955.0
        self.fix = Gps(0, *ORIGIN, (0.0, 0.0, 0.0), fix_type=0)

    def gps(self) -> Gps:
        return self.fix

    def accel(self) -> Vec3:
        return self.accel_read

    def mag(self) -> Vec3:
        return self.mag_read

    def pressure(self) -> float:
        return self.pressure_read


class WiredVehicle(Vehicle):
    """What flies on samples: `take` them, then `step`.

    Args:
        model, profile, parameters: as of a vehicle; the model tells rotors and hover thrust, and moves nothing.

    Attributes:
        estimator: where it believes it is. now_us: its time.
    """

    def __init__(self, model: VehicleModel, profile: Profile, *, parameters: ParameterTable | None = None) -> None:
        super().__init__(model, profile, parameters=parameters)
        self.now_us = 0
        self.estimator = Estimator()
        self.wire = WireSensors()
        self._sensors = self.wire
        self.autopilot = Autopilot(self.parameters, profile, self.plant, self.wire)
        self.estimate = Estimate(self.plant, self.autopilot, self.wire)
        self.truth = self.estimate
        self.outputs: tuple[float, ...] = ()
        self._next: deque[tuple[Sample, float]] = deque()
        self._truth: Message | None = None

    @property
    def time_us(self) -> int:
        return self.now_us

    def take(self, sample: Sample, dt_s: float) -> None:
        """The sample that the next `step` flies on; so long after the one before."""
        self._next.append((sample, dt_s))

    def take_fix(self, message: Message) -> None:
        """A HIL_GPS."""
        lat, lon, alt = message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3
        velocity = (message.vn * 0.01, message.ve * 0.01, message.vd * 0.01)
        self.wire.fix = Gps(
            int(message.time_usec), lat, lon, alt, velocity, message.eph * 0.01, message.epv * 0.01,
            message.satellites_visible, message.fix_type,
        )  # fmt: skip
        self.estimator.fix(lat, lon, alt, velocity)

    def take_truth(self, message: Message) -> None:
        """A HIL_STATE_QUATERNION: attitude, place and velocity as they are at the sample that follows."""
        self._truth = message

    def step(self) -> None:
        """Fly on the sample that was taken."""
        sample, dt_s = self._next.popleft()
        wire, estimator = self.wire, self.estimator
        if sample.mag is not None:
            wire.mag_read = sample.mag
            estimator.compass(sample.mag)
        if sample.pressure_hpa is not None:
            wire.pressure_read = sample.pressure_hpa
        if sample.gyro is not None and sample.accel is not None:
            wire.gyro[:] = sample.gyro
            wire.accel_read = sample.accel
            estimator.inertial(sample.gyro, sample.accel, dt_s)
        if self._truth is not None:
            m, self._truth = self._truth, None
            w, x, y, z = m.attitude_quaternion
            velocity = (m.vx * 0.01, m.vy * 0.01, m.vz * 0.01)
            estimator.truth((w, x, y, z), m.lat * 1e-7, m.lon * 1e-7, m.alt * 1e-3, velocity)
        self._believe()
        self.tick += 1
        if estimator.ready:
            self._commands = self.autopilot.tick(self.now_us)
        self.outputs = self.autopilot.motors

    def _believe(self) -> None:
        plant, estimator = self.plant, self.estimator
        plant.quat[:] = estimator.quat
        plant.x[0:3] = estimator.position
        plant.x[6:10] = estimator.quat
        plant.x[10:13] = self.wire.gyro
        plant.velocity[:] = estimator.velocity
        plant.force[:] = self.wire.accel_read


class AutopilotOnWire:
    """A brain that flies, and serves MAVLink to programs.

    Args:
        connect: link where programs are, or one that is open already.
        vehicle: whose rotors and flight gains. sysid: MAVLink system.

    Attributes:
        vehicle, server: the moving parts.
    """

    TRUTH_US = 4000
    """Interval at which it asks for truth."""

    def __init__(
        self,
        connect: str | Link,
        *,
        vehicle: str | VehicleModel = "ant-x",
        sysid: int = 1,
        profile: Profile | None = None,
    ) -> None:
        model = resolve_vehicle(vehicle) if isinstance(vehicle, str) else vehicle
        self.vehicle = WiredVehicle(model, profile or get_profile("sitl"))
        self.link = open_link(connect) if isinstance(connect, str) else connect
        # as the start script of a PX4's simulated quadrotor leaves them
        for n in range(4):
            self.vehicle.parameters.set(f"PWM_MAIN_FUNC{n + 1}", _FIRST_MOTOR + n)
        served = ServerLink(self.link, Connection(sysid, 1, datagram=self.link.datagram), 0, "onboard")
        self.server = VehicleServer(self.vehicle, [served], strict=True)
        self._last_us = 0

    @property
    def armed(self) -> bool:
        return self.vehicle.autopilot.armed

    def sample(self, sample: Sample) -> Sequence[float]:
        dt_s = (sample.time_us - self._last_us) * 1e-6 if self._last_us else 0.004
        self._last_us = sample.time_us
        self.vehicle.now_us = sample.time_us
        self.vehicle.take(sample, dt_s)
        self.server.listen()
        self.server.advance()
        return [
            motor if self.vehicle.parameters.get(f"PWM_MAIN_FUNC{n + 1}") == _FIRST_MOTOR + n else 0.0
            for n, motor in enumerate(self.vehicle.outputs)
        ]

    def gps(self, message: Message) -> None:
        self.vehicle.take_fix(message)

    def truth(self, message: Message) -> None:
        self.vehicle.take_truth(message)

    def close(self) -> None:
        self.server.close()
        self.link.close()


def facts(autopilot: AutopilotOnWire) -> dict[str, Any]:
    """Where it believes to be, for a failed test's report."""
    vehicle = autopilot.vehicle
    return {
        "mode": vehicle.autopilot.mode.name,
        "armed": vehicle.autopilot.armed,
        "position": vehicle.estimate.position_ned(),
        "euler": vehicle.estimate.euler(),
    }
