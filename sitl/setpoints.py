"""What the autopilot is flying after: attitude and rates, or position and velocity."""

from __future__ import annotations

from typing import NamedTuple


class AttitudeSetpoint(NamedTuple):
    """The attitude and rate set-points in force.

    Attributes:
        time_us: when it came. quat: body to world. rates: (p, q, r) set-points, rad/s. thrust: 0..1.
        serial: grows by one with every new set-point.
    """

    time_us: int = 0
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thrust: float = 0.0
    serial: int = 0


class PositionSetpoint(NamedTuple):
    """The position controller's set-points, NED, m, m/s, m/s^2, rad, rad/s; NaN where unused."""

    time_us: int
    position_ned: tuple[float, float, float]
    velocity_ned: tuple[float, float, float]
    acceleration_ned: tuple[float, float, float]
    yaw: float
    yaw_rate: float
    serial: int


class Sticks(NamedTuple):
    """Where a pilot's sticks are, each -1..1: roll right, pitch forward (nose down), yaw right, throttle up."""

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    throttle: float = 0.0


class PositionRequest(NamedTuple):
    """A set-point from outside for Offboard, NED; NaN where an axis is left free.

    Attributes:
        position_ned: m, from where the vehicle booted. velocity_ned: m/s. acceleration_ned: m/s^2.
        yaw: heading, rad. yaw_rate: rad/s.
    """

    position_ned: tuple[float, float, float]
    velocity_ned: tuple[float, float, float]
    acceleration_ned: tuple[float, float, float]
    yaw: float
    yaw_rate: float


class Reposition(NamedTuple):
    """Where Hold is asked to go; NaN keeps what is.

    Attributes:
        lat_deg, lon_deg: place, deg. alt_m: above mean sea level, m. yaw: rad. speed_m_s: cruise speed.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float
    yaw: float
    speed_m_s: float
