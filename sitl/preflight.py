"""Why a vehicle would not arm or switch. Source: PX4 ``commander/HealthAndArmingChecks``."""

from __future__ import annotations

from sitl.failsafe import Links
from sitl.modes import CLIMB_MODES, STICK_MODES, Mode
from sitl.setpoints import Sticks

_LOW_THROTTLE, _CENTRED_THROTTLE = -0.8, 0.2


def health_problem(healthy: bool, terminated: bool, motor_count: int, no_gcs: bool) -> str:
    """Why the vehicle cannot fly at all; PX4 says it before it denies arming. Empty if it can.

    Args:
        healthy: sensors and estimator are. terminated: the flight was. motor_count: rotors in the parameters.
        no_gcs: no ground station is there and NAV_DLL_ACT wants one.
    """
    if not healthy:
        return "heading estimate invalid"
    if terminated:
        return "flight terminated"
    if motor_count == 0:
        return "no usable rotor geometry (CA_ROTOR_COUNT, CA_ROTORn_*)"
    return "No connection to the ground control station" if no_gcs else ""


def mode_problem(mode: Mode, links: Links, mission: str) -> str:
    """Why this mode cannot run; PX4 keeps that to itself. Empty if it can.

    Args:
        mode: the flight mode. links: what is silent. mission: what is wrong with the mission, if that is flown.
    """
    if mode in STICK_MODES and links.manual_lost:
        return "no manual control"
    if mode is Mode.OFFBOARD and links.offboard_lost:
        return "no offboard signal"
    return mission


def stick_problem(mode: Mode, sticks: Sticks | None) -> str:
    """Why the throttle stick forbids arming, in PX4's words; empty if it does not."""
    if sticks is None or mode not in STICK_MODES:
        return ""
    if mode in CLIMB_MODES:
        return "throttle above center" if sticks.throttle > _CENTRED_THROTTLE else ""
    return "throttle not in safe position" if sticks.throttle > _LOW_THROTTLE else ""
