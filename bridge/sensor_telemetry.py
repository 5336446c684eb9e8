"""The fields of the messages about sensors, actuators, the estimator and time. See telemetry.py."""

from __future__ import annotations

import math

from bridge.px4_modes import ARMED, CUSTOM
from bridge.telemetry import (
    Fields,
    Source,
    int16,
    int32,
    uint16,
    whole,
)
from sitl.sensors import geodetic

_G = 9.80665
_NAN = math.nan
_ESTIMATOR_GOOD = 831  # attitude, velocities, positions and their predictions; no height above ground
_HIGHRES_ALL_BUT_AIRSPEED = 0x1BFF
_PWM_DISARMED_US = 900.0
_TEMPERATURE_C = 15.0
_MILLI_G = 1000.0 / _G
_UTC_2001_US = 978_307_200_000_000


def highres_imu(source: Source) -> Fields:
    """HIGHRES_IMU: specific force (m/s^2), filtered gyro (rad/s), field (gauss), pressure (hPa)."""
    estimate = source.vehicle.estimate
    ax, ay, az = estimate.accel_body()
    p, q, r = estimate.rates()
    mx, my, mz = estimate.mag_body()
    return {
        "time_usec": source.time_us,
        "xacc": ax,
        "yacc": ay,
        "zacc": az,
        "xgyro": p,
        "ygyro": q,
        "zgyro": r,
        "xmag": mx,
        "ymag": my,
        "zmag": mz,
        "abs_pressure": estimate.pressure_hpa(),
        "pressure_alt": estimate.altitude_m(),
        "temperature": _TEMPERATURE_C,
        "fields_updated": _HIGHRES_ALL_BUT_AIRSPEED,
    }


def scaled_imu(source: Source) -> Fields:
    """SCALED_IMU: the same in milli-g, mrad/s and milligauss."""
    estimate = source.vehicle.estimate
    ax, ay, az = estimate.accel_body()
    p, q, r = estimate.rates()
    mx, my, mz = estimate.mag_body()
    return {
        "time_boot_ms": source.time_ms,
        "xacc": int16(ax * 1000.0 / _G),
        "yacc": int16(ay * 1000.0 / _G),
        "zacc": int16(az * 1000.0 / _G),
        "xgyro": int16(p * 1000.0),
        "ygyro": int16(q * 1000.0),
        "zgyro": int16(r * 1000.0),
        "xmag": int16(mx * 1000.0),
        "ymag": int16(my * 1000.0),
        "zmag": int16(mz * 1000.0),
        "temperature": int16(_TEMPERATURE_C * 100.0),
    }


def scaled_pressure(source: Source) -> Fields:
    """SCALED_PRESSURE: hPa."""
    return {
        "time_boot_ms": source.time_ms,
        "press_abs": source.vehicle.estimate.pressure_hpa(),
        "temperature": int16(_TEMPERATURE_C * 100.0),
    }


def odometry(source: Source) -> Fields:
    """ODOMETRY: position and velocity in local NED, body rates; covariances are unknown (NaN first)."""
    estimate = source.vehicle.estimate
    x, y, z = estimate.position_ned()
    vx, vy, vz = estimate.velocity_ned()
    p, q, r = estimate.rates()
    unknown = [_NAN] + [0.0] * 20
    return {
        "time_usec": source.time_us,
        "frame_id": 1,
        "child_frame_id": 1,
        "x": x,
        "y": y,
        "z": z,
        "q": estimate.quat(),
        "vx": vx,
        "vy": vy,
        "vz": vz,
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
        "pose_covariance": unknown,
        "velocity_covariance": unknown,
        "estimator_type": 8,
    }


def estimator_status(source: Source) -> Fields:
    """ESTIMATOR_STATUS: the estimate is the truth plus sensor delay, so every ratio is quiet."""
    gps = source.vehicle.gps()
    return {
        "time_usec": source.time_us,
        "flags": _ESTIMATOR_GOOD,
        "hagl_ratio": _NAN,
        "tas_ratio": _NAN,
        "pos_horiz_accuracy": gps.eph_m,
        "pos_vert_accuracy": gps.epv_m,
    }


def vibration(source: Source) -> Fields:
    """VIBRATION: none is modelled."""
    return {"time_usec": source.time_us}


def battery_status(source: Source) -> Fields:
    """BATTERY_STATUS: the pack's voltage in the first cell's place, as PX4 does without cell sensing."""
    battery = source.vehicle.battery()
    return {
        "battery_function": 1,
        "type": 1,
        "temperature": 32767,
        "voltages": [uint16(battery.voltage_v * 1000.0), *[65535] * 9],
        "current_battery": int16(battery.current_a * 100.0),
        "energy_consumed": -1,
        "battery_remaining": whole(battery.remaining * 100.0, 0, 100),
        "charge_state": 1,
    }


def servo_output_raw(source: Source) -> Fields:
    """SERVO_OUTPUT_RAW: motor commands as PWM, 1000 to 2000 us, 900 disarmed."""
    autopilot = source.vehicle.autopilot
    fields: Fields = {"time_usec": source.time_us & 0xFFFFFFFF}
    for index, motor in enumerate(autopilot.motors, start=1):
        fields[f"servo{index}_raw"] = uint16(_pwm_us(motor, armed=autopilot.armed))
    return fields


def _pwm_us(motor: float, *, armed: bool) -> float:
    """Pulse width of a motor's signal; disarmed only a motor under test turns."""
    return 1000.0 + 1000.0 * motor if armed or motor > 0.0 else _PWM_DISARMED_US


def actuator_output_status(source: Source) -> Fields:
    """ACTUATOR_OUTPUT_STATUS: the same PWM values with a mask of those in use."""
    autopilot = source.vehicle.autopilot
    pwm = [_pwm_us(motor, armed=autopilot.armed) for motor in autopilot.motors]
    return {
        "time_usec": source.time_us,
        "active": (1 << len(pwm)) - 1,
        "actuator": pwm + [0.0] * (32 - len(pwm)),
    }


def hil_actuator_controls(source: Source) -> Fields:
    """HIL_ACTUATOR_CONTROLS: motor commands 0 to 1 in PX4's motor order; time_usec is the tick's."""
    autopilot = source.vehicle.autopilot
    motors = autopilot.motors
    return {
        "time_usec": source.vehicle.time_us,
        "controls": [*motors, *[0.0] * (16 - len(motors))],
        "mode": CUSTOM | ARMED if autopilot.armed else CUSTOM,
        "flags": 0,
    }


def hil_state_quaternion(source: Source) -> Fields:
    """HIL_STATE_QUATERNION: the true state: attitude, rates, place, velocity (cm/s), force (milli-g)."""
    vehicle = source.vehicle
    truth = vehicle.truth
    lat, lon, altitude_m = geodetic(truth.position_ned(), vehicle.origin)
    p, q, r = truth.rates()
    vx, vy, vz = truth.velocity_ned()
    ax, ay, az = truth.accel_body()
    speed_cm_s = uint16(math.hypot(vx, vy, vz) * 100.0)
    return {
        "time_usec": vehicle.time_us,
        "attitude_quaternion": truth.quat(),
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
        "lat": int32(lat * 1e7),
        "lon": int32(lon * 1e7),
        "alt": int32(altitude_m * 1000.0),
        "vx": int16(vx * 100.0),
        "vy": int16(vy * 100.0),
        "vz": int16(vz * 100.0),
        "ind_airspeed": speed_cm_s,
        "true_airspeed": speed_cm_s,
        "xacc": int16(ax * _MILLI_G),
        "yacc": int16(ay * _MILLI_G),
        "zacc": int16(az * _MILLI_G),
    }


def current_mode(source: Source) -> Fields:
    """CURRENT_MODE: the mode flown and the mode asked for."""
    return {"custom_mode": source.custom_mode, "intended_custom_mode": source.custom_mode}


def system_time(source: Source) -> Fields | None:
    """SYSTEM_TIME: only when the vehicle knows UTC (it never does in simulated time)."""
    unix_us = source.utc_boot_us + source.time_us
    if unix_us < _UTC_2001_US:
        return None
    return {"time_unix_usec": unix_us, "time_boot_ms": source.time_ms}


def timesync(source: Source) -> Fields:
    """TIMESYNC: a request, nanoseconds of vehicle time."""
    return {"tc1": 0, "ts1": source.time_us * 1000}


def ping(source: Source) -> Fields:
    """PING: to everybody."""
    source.ping_seq = source.ping_seq + 1 & 0xFFFFFFFF
    return {"time_usec": source.time_us, "seq": source.ping_seq}
