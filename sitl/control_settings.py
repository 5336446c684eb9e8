"""From PX4 parameters and a fidelity profile to the numbers the compiled loops run on."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sitl.actuators import MAX_MOTORS, Mix, RotorEffect, normalised_mix
from sitl.control_loop import CONTROL_SETTINGS
from sitl.filters import alpha_of, low_pass_2p, notch
from sitl.parameters import ParameterTable
from sitl.position_control import PERIOD_S, POSITION_SETTINGS
from sitl.profile import Profile

_AXES = (("ROLL", "RR"), ("PITCH", "PR"), ("YAW", "YR"))
_STATUS_PERIOD_S = 0.005
_LARGEST = 3.4e38
"""Stands for a limit that someone set to infinity: infinity means the study's loop, which has no limits at all."""


def reader(parameters: ParameterTable) -> Callable[[str], float]:
    """The value of a parameter by name, as a float."""

    def get(name: str) -> float:
        return float(parameters.get(name))

    return get


def mix_of(parameters: ParameterTable) -> Mix:
    """Normalised mix of the rotor geometry in the parameters (CA_ROTOR_COUNT, CA_ROTORn_*)."""
    count = min(MAX_MOTORS, max(0, int(parameters.get("CA_ROTOR_COUNT"))))

    def number(rotor: int, what: str) -> float:
        return float(parameters.get(f"CA_ROTOR{rotor}_{what}"))

    return normalised_mix(
        [
            RotorEffect(
                position_m=(number(i, "PX"), number(i, "PY"), number(i, "PZ")),
                axis=(number(i, "AX"), number(i, "AY"), number(i, "AZ")),
                ct=number(i, "CT"),
                km=number(i, "KM"),
            )
            for i in range(count)
        ]
    )


def control_settings(parameters: ParameterTable, profile: Profile, mix: Mix) -> NDArray[np.void]:
    """Settings of the control loop.

    Args:
        parameters: the table. profile: rate, lateness, limits. mix: from ``mix_of``.

    Returns:
        (1,) of CONTROL_SETTINGS.
    """

    def get(name: str) -> float:
        return float(parameters.get(name))

    rate_hz = float(profile.rate_hz)
    dt_s = 1.0 / rate_hz
    settings = np.zeros(1, CONTROL_SETTINGS)
    settings["dt_s"] = dt_s
    settings["low_pass"] = low_pass_2p(get("IMU_GYRO_CUTOFF"), rate_hz)
    notches = [
        notch(get(f"IMU_GYRO_NF{i}_FRQ"), get(f"IMU_GYRO_NF{i}_BW"), rate_hz)
        for i in (0, 1)
        if get(f"IMU_GYRO_NF{i}_FRQ") > 0.0
    ]
    for i, coefficients in enumerate(notches):
        settings["notches"][0, i] = coefficients
    settings["notch_count"] = len(notches)
    settings["dgyro_alpha"] = alpha_of(get("IMU_DGYRO_CUTOFF"), dt_s)
    settings["att_gain"] = [get("MC_ROLL_P"), get("MC_PITCH_P"), get("MC_YAW_P")]
    settings["yaw_weight"] = min(1.0, max(0.0, get("MC_YAW_WEIGHT")))
    for i, (axis, short) in enumerate(_AXES):
        limit = math.radians(get(f"MC_{axis}RATE_MAX"))
        settings["rate_max"][0, i] = limit if profile.limits else math.inf
        for field, suffix in (("k", "K"), ("kp", "P"), ("ki", "I"), ("kd", "D"), ("kff", "FF")):
            settings[field][0, i] = get(f"MC_{axis}RATE_{suffix}")
        settings["int_lim"][0, i] = min(get(f"MC_{short}_INT_LIM"), _LARGEST) if profile.limits else math.inf
    settings["yaw_torque_alpha"] = alpha_of(get("MC_YAW_TQ_CUTOFF"), dt_s)
    settings["mix"][0, : mix.motors] = mix.columns
    settings["inverse"][0, :, : mix.motors] = mix.inverse
    settings["motor_count"] = mix.motors
    settings["method"] = int(parameters.get("CA_METHOD"))
    settings["airmode"] = int(parameters.get("MC_AIRMODE"))
    for i in range(MAX_MOTORS):
        slew_s = get(f"CA_R{i}_SLEW")
        settings["slew_per_tick"][0, i] = dt_s / slew_s if slew_s > 0.0 else math.inf
    settings["thr_mdl_fac"] = get("THR_MDL_FAC")
    settings["status_ticks"] = math.ceil(_STATUS_PERIOD_S * rate_hz - 1e-9)
    settings["attitude_late_ticks"] = profile.attitude_late_ticks
    settings["rate_sp_late"] = profile.rate_sp_late_ticks == 1
    settings["limits"] = profile.limits
    settings["linear"] = profile.linear
    return settings


def position_ticks(profile: Profile) -> int:
    """Ticks between two runs of the position controller."""
    return max(1, round(PERIOD_S * profile.rate_hz))


def position_settings(parameters: ParameterTable, profile: Profile) -> NDArray[np.void]:
    """Settings of the position controller.

    Args:
        parameters: the table (MPC_*). profile: rate.

    Returns:
        (1,) of POSITION_SETTINGS.
    """

    def get(name: str) -> float:
        return float(parameters.get(name))

    dt_s = position_ticks(profile) / profile.rate_hz
    settings = np.zeros(1, POSITION_SETTINGS)
    settings["dt_s"] = dt_s
    settings["pos_p"] = [get("MPC_XY_P"), get("MPC_XY_P"), get("MPC_Z_P")]
    for field, suffix in (("vel_p", "P"), ("vel_i", "I"), ("vel_d", "D")):
        xy, z = get(f"MPC_XY_VEL_{suffix}_ACC"), get(f"MPC_Z_VEL_{suffix}_ACC")
        settings[field] = [xy, xy, z]
    settings["veld_alpha"] = alpha_of(get("MPC_VELD_LP"), dt_s)
    settings["vel_xy_max"] = get("MPC_XY_VEL_MAX")
    settings["vel_up_max"] = get("MPC_Z_VEL_MAX_UP")
    settings["vel_down_max"] = get("MPC_Z_VEL_MAX_DN")
    settings["hover_thrust"] = max(0.05, get("MPC_THR_HOVER"))
    settings["thr_min"] = get("MPC_THR_MIN")
    settings["thr_max"] = get("MPC_THR_MAX")
    settings["thr_xy_marg"] = get("MPC_THR_XY_MARG")
    settings["tilt_max"] = math.radians(get("MPC_TILTMAX_AIR"))
    return settings
