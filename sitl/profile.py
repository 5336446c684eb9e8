"""Profile: how faithfully the loop around the study's model is flown: rates, delays, filters, limits, noise.

`study` is the bare 3-state model that the study computed with; `sitl` is what a PX4 flies in lockstep with
a simulator; `board` is PX4's rate on flight hardware. Timing decides: gains of the study that fly on one
profile limit-cycle on another, so every item can be overridden alone and all are printed with the results.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from sitl.errors import UsageError
from sitl.keyed_table import nearest


@dataclass(frozen=True)
class Profile:
    """One fidelity profile; see `get_profile`."""

    name: str
    rate_hz: int
    """Ticks per second of gyro, rate loop, attitude loop and allocator alike."""
    motor_lag_s: float | None
    """Time constant of the motors' first-order lag; None takes the airframe's assumption."""
    transport_delay_ticks: int
    """d: the torque of sample k acts on ticks [k + d, k + d + 1)."""
    attitude_late_ticks: float
    """Age of the attitude estimate that the attitude law sees; fractions are interpolated."""
    rate_sp_late_ticks: int
    """1: the rate law uses the rate set-point of the tick before, as PX4 does; 0: of the same tick."""
    gyro_cutoff_hz: float
    """IMU_GYRO_CUTOFF, 2nd-order Butterworth; 0 is off, and so is half the rate or more, as in PX4."""
    dgyro_cutoff_hz: float
    """IMU_DGYRO_CUTOFF, first-order low-pass on the differentiated rate; 0 is off."""
    limits: bool
    """Motor saturation with desaturation, body-rate limits, integrator limit."""
    linear: bool
    """The roll axis alone, as the study's 3-state model."""
    gyro_noise_rad_s: float
    gyro_quantum_rad_s: float
    """Gyro resolution, truncated; 0 is exact."""
    accel_noise_m_s2: float
    mag_noise_gauss: float
    baro_noise_hpa: float
    gps_noise_m: float
    gps_noise_m_s: float

    @property
    def tick_us(self) -> int:
        """One tick in microseconds, exactly."""
        return 1_000_000 // self.rate_hz

    @property
    def dt_s(self) -> float:
        """One tick in seconds."""
        return 1.0 / self.rate_hz

    def motor_lag(self, airframe_lag_s: float) -> float:
        """The motor lag in force, s: the profile's own, or else the airframe's assumption."""
        return airframe_lag_s if self.motor_lag_s is None else self.motor_lag_s

    def describe(self) -> list[tuple[str, str | float | bool, str]]:
        """(item, value, unit) of every item, to be printed with the results."""
        rows: list[tuple[str, str | float | bool, str]] = []
        for field in fields(self):
            value = getattr(self, field.name)
            item = _ITEMS.get(field.name)
            rows.append((field.name, "airframe" if value is None else value, item.unit if item else ""))
        return rows


@dataclass(frozen=True)
class _Item:
    """Type, range and unit of one overridable item."""

    kind: type
    low: float = 0.0
    high: float = 0.0
    unit: str = ""
    optional: bool = False


_ITEMS = {
    "rate_hz": _Item(int, 50, 8000, "Hz"),
    "motor_lag_s": _Item(float, 0.0, 0.5, "s", optional=True),
    "transport_delay_ticks": _Item(int, 0, 64, "ticks"),
    "attitude_late_ticks": _Item(float, 0.0, 6.0, "ticks"),
    "rate_sp_late_ticks": _Item(int, 0, 1, "ticks"),
    "gyro_cutoff_hz": _Item(float, 0.0, 1000.0, "Hz"),
    "dgyro_cutoff_hz": _Item(float, 0.0, 1000.0, "Hz"),
    "limits": _Item(bool),
    "linear": _Item(bool),
    "gyro_noise_rad_s": _Item(float, 0.0, 1.0, "rad/s"),
    "gyro_quantum_rad_s": _Item(float, 0.0, 0.1, "rad/s"),
    "accel_noise_m_s2": _Item(float, 0.0, 10.0, "m/s^2"),
    "mag_noise_gauss": _Item(float, 0.0, 1.0, "gauss"),
    "baro_noise_hpa": _Item(float, 0.0, 10.0, "hPa"),
    "gps_noise_m": _Item(float, 0.0, 50.0, "m"),
    "gps_noise_m_s": _Item(float, 0.0, 10.0, "m/s"),
}

_STUDY = Profile(
    name="study",
    rate_hz=1000,
    motor_lag_s=0.0,
    transport_delay_ticks=0,
    attitude_late_ticks=0.0,
    rate_sp_late_ticks=0,
    gyro_cutoff_hz=0.0,
    dgyro_cutoff_hz=0.0,
    limits=False,
    linear=True,
    gyro_noise_rad_s=0.0,
    gyro_quantum_rad_s=0.0,
    accel_noise_m_s2=0.0,
    mag_noise_gauss=0.0,
    baro_noise_hpa=0.0,
    gps_noise_m=0.0,
    gps_noise_m_s=0.0,
)

# Timing measured on a PX4 v1.17 in lockstep at 250 Hz: its logs show no tick between gyro and motor, the
# rate set-point of the tick before, and an attitude estimate half a tick old (1.5 ticks in all).
_SITL = Profile(
    name="sitl",
    rate_hz=250,
    motor_lag_s=None,
    transport_delay_ticks=0,
    attitude_late_ticks=0.5,
    rate_sp_late_ticks=1,
    gyro_cutoff_hz=40.0,
    dgyro_cutoff_hz=20.0,
    limits=True,
    linear=False,
    gyro_noise_rad_s=0.003,
    gyro_quantum_rad_s=1.065e-3,
    accel_noise_m_s2=0.05,
    mag_noise_gauss=0.002,
    baro_noise_hpa=0.02,
    gps_noise_m=0.2,
    gps_noise_m_s=0.05,
)

# IMU_GYRO_RATEMAX of multicopters; hardware needs a tick from sample to motor.
_BOARD = replace(_SITL, name="board", rate_hz=800, transport_delay_ticks=1)

PROFILES: dict[str, Profile] = {profile.name: profile for profile in (_STUDY, _SITL, _BOARD)}


def get_profile(name: str, /, **overrides: object) -> Profile:
    """A profile by name, with single items replaced.

    Args:
        name: one of PROFILES.
        overrides: item -> value, such as `motor_lag_s=0.01`; `motor_lag_s=None` takes the airframe's.

    Raises:
        UsageError: unknown profile or item, or a value of the wrong type or out of range; names all three.
    """
    if name not in PROFILES:
        raise UsageError(f'unknown profile "{name}"{nearest(name, PROFILES)}; profiles are {", ".join(PROFILES)}')
    checked = {key: _check(name, key, value) for key, value in overrides.items()}
    return replace(PROFILES[name], **checked)  # type: ignore[arg-type]  # each value has passed _check


def _check(profile: str, key: str, value: object) -> float | bool | None:
    item = _ITEMS.get(key)
    if item is None:
        raise UsageError(
            f'profile {profile}: unknown item "{key}"{nearest(key, _ITEMS)}; items are {", ".join(_ITEMS)}'
        )
    if value is None and item.optional:
        return None
    if item.kind is bool:
        if isinstance(value, bool):
            return value
        raise UsageError(f"profile {profile}: {key} = {value!r}: it must be true or false")
    allowed = f"a number from {item.low:g} to {item.high:g} {item.unit}"
    if item.kind is int:
        allowed = allowed.replace("a number", "a whole number")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UsageError(f"profile {profile}: {key} = {value!r}: it must be {allowed}")
    if not math.isfinite(value) or not item.low <= value <= item.high or item.kind(value) != value:
        raise UsageError(f"profile {profile}: {key} = {value:g}: it must be {allowed}")
    if key == "rate_hz" and 1_000_000 % value:
        near = [rate for rate in range(int(item.low), int(item.high) + 1) if 1_000_000 % rate == 0]
        best = sorted(sorted(near, key=lambda rate: abs(rate - value))[:2])
        raise UsageError(
            f"profile {profile}: rate_hz = {value:g}: a tick must be a whole number of microseconds, "
            f"try {best[0]} or {best[1]}"
        )
    return item.kind(value)  # type: ignore[no-any-return]
