"""The topics of every control tick: what the loops saw and did, kept for a moment and written at once.

A tick costs a few copies of arrays; the samples are made from many ticks together, topic by topic. A log is therefore
ordered in time within each topic, and within that moment not between topics, which readers do not mind.

PX4's simulator logs the truth as well, as the `_groundtruth` topics: so does this.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bridge.ulog import Layout
from bridge.ulog_topics import Profile
from sitl.control_loop import CONTROL_STATE
from sitl.vehicle import Vehicle

Floats = NDArray[np.float64]
Rows = NDArray[np.void]

_G_M_S2 = 9.80665
_MOTORS = 12

_ATTITUDE: Final = (
    "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;float[4] delta_q_reset;uint8_t quat_reset_counter"
)
_ANGULAR_VELOCITY: Final = "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;float[3] xyz_derivative"
_LOCAL_POSITION: Final = (
    "uint64_t timestamp;uint64_t timestamp_sample;uint64_t ref_timestamp;double ref_lat;double ref_lon;float x;"
    "float y;float z;float[2] delta_xy;float delta_z;float vx;float vy;float vz;float z_deriv;float[2] delta_vxy;"
    "float delta_vz;float ax;float ay;float az;float heading;float heading_var;float unaided_heading;"
    "float delta_heading;float tilt_var;float ref_alt;float dist_bottom;float dist_bottom_var;"
    "float delta_dist_bottom;float eph;float epv;float evh;float evv;float vxy_max;float vz_max;float hagl_min;"
    "float hagl_max_z;float hagl_max_xy;bool xy_valid;bool z_valid;bool v_xy_valid;bool v_z_valid;"
    "uint8_t xy_reset_counter;uint8_t z_reset_counter;uint8_t vxy_reset_counter;uint8_t vz_reset_counter;"
    "uint8_t heading_reset_counter;bool heading_good_for_control;bool xy_global;bool z_global;"
    "bool dist_bottom_valid;uint8_t dist_bottom_reset_counter;uint8_t dist_bottom_sensor_bitfield;"
    "bool dead_reckoning"
)
_SET_POINT: Final = "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz"

_FULL = 0


@dataclass(frozen=True)
class FastTopic:
    """A topic of every tick.

    Attributes:
        layout: its fields. fill: puts the ticks of these numbers into the rows; the time stamps are there already.
        default_us, high_us, identification_us: between two samples under each bit of SDLOG_PROFILE, us; 0 is every
            tick, -1 not at all.
    """

    layout: Layout
    fill: Callable[[Ring, Rows, NDArray[np.intp]], None]
    default_us: int
    high_us: int = -1
    identification_us: int = -1

    def period_us(self, profile: Profile) -> int:
        """The shortest interval that the profile asks for, us; -1 for none."""
        asked = (
            (Profile.DEFAULT, self.default_us),
            (Profile.HIGH_RATE, self.high_us),
            (Profile.SYSTEM_IDENTIFICATION, self.identification_us),
        )
        return min((period for bit, period in asked if profile & bit and period >= 0), default=-1)


class Ring:
    """The last ticks of one vehicle.

    Args:
        vehicle: what is logged. profile: bits of SDLOG_PROFILE. capacity: ticks that fit.
    """

    def __init__(self, vehicle: Vehicle, profile: Profile, capacity: int) -> None:
        self._vehicle = vehicle
        self._control = vehicle.autopilot.control
        plant = vehicle.plant
        self._state_bytes = vehicle.autopilot.state.view(np.uint8)
        self._x, self._quat, self._velocity, self._force = plant.x, plant.quat, plant.velocity, plant.force
        self._gyro, self._accel = vehicle.estimate.gyro_body, vehicle.estimate.accel_body
        self.capacity = capacity
        self.count = 0
        self.time_us = np.zeros(capacity, np.uint64)
        self.state = np.zeros(capacity, CONTROL_STATE)
        self._states = self.state.view(np.uint8).reshape(capacity, -1)
        self.x = np.zeros((capacity, plant.x.shape[0]))
        self.quat = np.zeros((capacity, 4))
        self.velocity = np.zeros((capacity, 3))
        self.force = np.zeros((capacity, 3))
        self.imu = np.zeros((capacity, 6))
        self.thrust = np.zeros(capacity)
        self.origin: tuple[float, float, float] = vehicle.origin
        self.tick_us = vehicle.tick_us
        self.motor_count = vehicle.autopilot.motor_count
        self.topics = tuple((topic, period) for topic in FAST_TOPICS if (period := topic.period_us(profile)) >= 0)
        self._last_slots: dict[int, int] = {period: -1 for _, period in self.topics if period}

    @property
    def full(self) -> bool:
        """No further tick fits until it is drained."""
        return self.count >= self.capacity

    def take(self, now_us: int) -> None:
        """Remember the tick that was flown just now. now_us: vehicle time."""
        i = self.count
        self.count = i + 1
        self.time_us[i] = now_us
        self._states[i] = self._state_bytes
        self.x[i] = self._x
        self.quat[i] = self._quat
        self.velocity[i] = self._velocity
        self.force[i] = self._force
        self.imu[i] = self._gyro() + self._accel()
        self.thrust[i] = self._control.thrust_sp

    def drain(self, first_id: int) -> bytes:
        """Data messages of all ticks kept, and forget them.

        Args:
            first_id: message id of the first topic; the others follow in order.
        """
        count, self.count = self.count, 0
        if not count:
            return b""
        self.motor_count = self._vehicle.autopilot.motor_count
        chosen = {_FULL: np.arange(count)}
        for period, last in self._last_slots.items():
            slots = (self.time_us[:count] // np.uint64(period)).astype(np.int64)
            chosen[period] = np.flatnonzero(np.diff(slots, prepend=last))
            self._last_slots[period] = int(slots[-1])
        parts = []
        # what a float32 cannot hold becomes infinite: a vehicle that diverges is logged, not refused
        with np.errstate(over="ignore", invalid="ignore"):
            for number, (topic, period) in enumerate(self.topics, start=first_id):
                picked = chosen[period]
                if not picked.size:
                    continue
                rows = topic.layout.rows(number, picked.size)
                rows["timestamp"] = self.time_us[picked]
                topic.fill(self, rows, picked)
                parts.append(rows.tobytes())
        return b"".join(parts)


def _sampled(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    rows["timestamp_sample"] = ring.time_us[at]


def _attitude(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    _sampled(ring, rows, at)
    rows["q"] = ring.state["attitude"][at]
    rows["delta_q_reset"] = (1.0, 0.0, 0.0, 0.0)


def _true_attitude(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    _sampled(ring, rows, at)
    rows["q"] = ring.quat[at]
    rows["delta_q_reset"] = (1.0, 0.0, 0.0, 0.0)


def _angular_velocity(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    _sampled(ring, rows, at)
    rows["xyz"] = ring.state["rates"][at]
    rows["xyz_derivative"] = ring.state["accel"][at]


def _true_angular_velocity(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    _sampled(ring, rows, at)
    rows["xyz"] = ring.x[at, 10:13]


def _rates_sp(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    rates = ring.state["rates_sp"][at]
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        rows[name] = rates[:, axis]
    rows["thrust_body"][:, 2] = -ring.thrust[at]


def _torque_sp(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    _sampled(ring, rows, at)
    rows["xyz"] = ring.state["torque_sp"][at]


def _thrust_sp(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    _sampled(ring, rows, at)
    rows["xyz"][:, 2] = -ring.thrust[at]


def _integrators(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    integral = ring.state["integral"][at]
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        rows[f"{name}speed_integ"] = integral[:, axis]


def _motors(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    """Commands in thrust space, before THR_MDL_FAC; NaN for motors that do not exist, as in PX4."""
    _sampled(ring, rows, at)
    control = rows["control"]
    control[:] = ring.state["motors"][at, :_MOTORS]
    control[:, ring.motor_count :] = np.nan


def _sensor_combined(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    rows["gyro_rad"] = ring.imu[at, :3]
    rows["accelerometer_m_s2"] = ring.imu[at, 3:]
    rows["gyro_integral_dt"] = rows["accelerometer_integral_dt"] = ring.tick_us


def _position(ring: Ring, rows: Rows, at: NDArray[np.intp], quat: Floats) -> None:
    _sampled(ring, rows, at)
    position, velocity, accel = ring.x[at, :3], ring.velocity[at], _to_world(quat, ring.force[at])
    accel[:, 2] += _G_M_S2
    for axis, name in enumerate(("x", "y", "z")):
        rows[name], rows[f"v{name}"], rows[f"a{name}"] = position[:, axis], velocity[:, axis], accel[:, axis]
    rows["z_deriv"] = velocity[:, 2]
    w, x, y, z = quat.T
    rows["heading"] = rows["unaided_heading"] = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    rows["ref_lat"], rows["ref_lon"], rows["ref_alt"] = ring.origin
    for name in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "xy_global", "z_global", "heading_good_for_control"):
        rows[name] = True
    rows["dist_bottom"] = np.nan
    for name in ("vxy_max", "vz_max", "hagl_min", "hagl_max_z", "hagl_max_xy"):
        rows[name] = np.inf  # no limit


def _local_position(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    _position(ring, rows, at, ring.state["attitude"][at])
    rows["eph"], rows["epv"], rows["evh"], rows["evv"] = 0.3, 0.4, 0.1, 0.1


def _true_local_position(ring: Ring, rows: Rows, at: NDArray[np.intp]) -> None:
    _position(ring, rows, at, ring.quat[at])


def _to_world(quat: Floats, vectors: Floats) -> Any:
    """Body vectors (n, 3) in the world's axes. quat: (n, 4), body to world."""
    w, u = quat[:, :1], quat[:, 1:]
    turn = 2.0 * np.cross(u, vectors)
    return vectors + w * turn + np.cross(u, turn)


FAST_TOPICS: Final = (
    FastTopic(Layout("vehicle_attitude", _ATTITUDE), _attitude, 10_000, _FULL),
    FastTopic(Layout("vehicle_angular_velocity", _ANGULAR_VELOCITY), _angular_velocity, 10_000, _FULL, _FULL),
    FastTopic(
        Layout(
            "vehicle_rates_setpoint",
            "uint64_t timestamp;float roll;float pitch;float yaw;float[3] thrust_body;bool reset_integral",
        ),
        _rates_sp,
        20_000,
        _FULL,
    ),
    FastTopic(Layout("vehicle_torque_setpoint", _SET_POINT), _torque_sp, 20_000, _FULL, _FULL),
    FastTopic(Layout("vehicle_thrust_setpoint", _SET_POINT), _thrust_sp, 20_000, _FULL),
    FastTopic(
        Layout(
            "rate_ctrl_status", "uint64_t timestamp;float rollspeed_integ;float pitchspeed_integ;float yawspeed_integ"
        ),
        _integrators,
        200_000,
        20_000,
    ),
    FastTopic(
        Layout(
            "actuator_motors",
            "uint64_t timestamp;uint64_t timestamp_sample;float[12] control;uint16_t reversible_flags",
        ),
        _motors,
        100_000,
        _FULL,
        _FULL,
    ),
    FastTopic(
        Layout(
            "sensor_combined",
            "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;int32_t accelerometer_timestamp_relative;"
            "float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;uint8_t accelerometer_clipping;"
            "uint8_t gyro_clipping;uint8_t accel_calibration_count;uint8_t gyro_calibration_count",
        ),
        _sensor_combined,
        _FULL,
        _FULL,
        _FULL,
    ),
    FastTopic(Layout("vehicle_local_position", _LOCAL_POSITION), _local_position, 20_000),
    FastTopic(Layout("vehicle_attitude_groundtruth", _ATTITUDE), _true_attitude, 10_000, _FULL),
    FastTopic(Layout("vehicle_angular_velocity_groundtruth", _ANGULAR_VELOCITY), _true_angular_velocity, 10_000, _FULL),
    FastTopic(Layout("vehicle_local_position_groundtruth", _LOCAL_POSITION), _true_local_position, 20_000),
)
