"""Why a vehicle would not arm."""

from __future__ import annotations

from sitl.modes import MODE_NAMES, NEVER_ARM, Mode


def health_problem(healthy: bool, terminated: bool, motor_count: int) -> str:
    """Why the vehicle cannot fly at all; PX4 says it before it denies arming. Empty if it can.

    Args:
        healthy: sensors and estimator are. terminated: the flight was. motor_count: rotors in the parameters.
    """
    if not healthy:
        return "heading estimate invalid"
    if terminated:
        return "flight terminated"
    if motor_count == 0:
        return "no usable rotor geometry (CA_ROTOR_COUNT, CA_ROTORn_*)"
    return ""


def mode_problem(mode: Mode, offboard_fresh: bool) -> str:
    """Why it cannot arm in this mode; PX4 keeps that to itself. Empty if it can.

    Args:
        mode: the flight mode. offboard_fresh: set-points come.
    """
    if mode in NEVER_ARM:
        return f"mode not suitable for arming: {MODE_NAMES[mode]}"
    if mode is Mode.OFFBOARD and not offboard_fresh:
        return "no offboard signal"
    return ""
