"""SampledLoop: the roll axis exactly as it is flown, linear, as a transfer function and as a matrix.

Tick k of length dt, cut at delta_lat (everything right of "=" is of tick k unless indexed):

    y      = gyro low-pass of p                          2nd-order Butterworth, bilinear, prewarped
    alpha  = D low-pass of (y_k - y_k-1) / dt            first order
    r      = k_phi (phi_sp - phi)                        phi late by attitude_late + rate_sp_late ticks
    delta  = k kp (r - y) + I - k kd alpha + kff r
    I_k+1  = I_k + k ki (r - y) dt                       after the output
    torque = delta held over [k + d, k + d + 1) dt + T   through the motors' first-order lag

Limits, noise and quantisation are left out: this is the loop around hover. d is the profile's transport delay
in ticks, T a further one in seconds that need not be whole ticks; both enter exactly, by splitting the hold.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sitl.airframe import Derivatives, FlightGains
from sitl.filters import PASS_THROUGH, alpha_of, low_pass_2p
from sitl.profile import Profile
from sitl.roll_loop import step_matrices

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

P, PHI = 1, 2
"""Where the plant's state holds roll rate and roll angle."""


@dataclass(frozen=True)
class RollGains:
    """Gains of the roll axis by the PX4 parameter that holds them; SI and radians."""

    k_phi: float  # MC_ROLL_P, 1/s
    k: float  # MC_ROLLRATE_K
    kp: float  # MC_ROLLRATE_P, normalised torque per rad/s
    ki: float  # MC_ROLLRATE_I, per rad
    kd: float  # MC_ROLLRATE_D, per rad/s^2
    kff: float = 0.0  # MC_ROLLRATE_FF, per rad/s; not multiplied by k

    @classmethod
    def from_flight_gains(cls, gains: FlightGains) -> RollGains:
        """The study's parallel form: k = 1, kff = 0."""
        return cls(k_phi=gains.k_phi, k=1.0, kp=gains.kp, ki=gains.ki, kd=gains.kd)


class Tick(NamedTuple):
    """One tick of the closed loop as matrices; S in front if the loop holds samples.

    Attributes:
        matrix: (N, N). setpoint: (N,) what the roll set-point of this tick adds, as the rate law uses it.
        delta: (N,) the command of this tick over the state, and `direct` over the set-point, before the cut.
    """

    matrix: FloatArray
    setpoint: FloatArray
    delta: FloatArray
    direct: float


class SampledLoop:
    """The sampled roll loop of one gain set and one profile, on one model or on many at once.

    Args:
        derivatives: the lateral model, or an array (S, 6) of samples in the order of DERIVATIVE_NAMES; everything
            that depends on the model then has S as its first dimension.
        gains: of the roll axis; fields that are arrays are a set's of each sample (`with_gains`).
        profile: rate, delays and filters; its `motor_lag_s` is not used.
        motor_lag_s: time constant of the motors, 0 for none.
        transport_delay_s: further delay between command and motor, beyond the profile's ticks.

    Raises:
        ValueError: a lag or delay is negative.
    """

    def __init__(
        self,
        derivatives: Derivatives | FloatArray,
        gains: RollGains,
        profile: Profile,
        motor_lag_s: float,
        transport_delay_s: float = 0.0,
    ) -> None:
        if not (motor_lag_s >= 0.0 and transport_delay_s >= 0.0):
            raise ValueError(f"motor lag {motor_lag_s} s, transport delay {transport_delay_s} s: must be 0 or more")
        dt = profile.dt_s
        self.dt_s = dt
        self.gains = gains
        self.motor_lag_s = motor_lag_s
        self.biquad = low_pass_2p(profile.gyro_cutoff_hz, profile.rate_hz)
        self.dgyro_alpha = alpha_of(profile.dgyro_cutoff_hz, dt)
        self.late = _late_weights(profile)
        """Weight of phi_k, phi_k-1, ... in the angle that the rate law's set-point rests on."""
        whole = math.floor(transport_delay_s / dt + 1e-9)
        fraction_s = max(0.0, transport_delay_s - whole * dt)
        self.delay_ticks = profile.transport_delay_ticks + whole
        rows = derivatives.as_array() if isinstance(derivatives, Derivatives) else np.asarray(derivatives)
        self.phi, self.held, self.previous = _discretise(rows, motor_lag_s, dt, fraction_s)
        self._den, self._num = _rational(self.phi, (self.held, self.previous))
        self.delay_s = self.delay_ticks * dt + fraction_s + dt / 2.0 + motor_lag_s + _low_pass_delay(profile)
        """Delay at low frequency of the rate loop's own elements: transport, half a tick of hold, motor lag,
        gyro filter. The attitude's lateness and the D filter are not in it: they delay part of the signal."""

    def with_gains(self, gains: RollGains) -> SampledLoop:
        """The same models and profile with other gains."""
        other = copy(self)
        other.gains = gains
        return other

    def as_samples(self) -> SampledLoop:
        """The loop of one model as one of one sample."""
        other = copy(self)
        other.phi, other.held, other.previous = self.phi[None], self.held[None], self.previous[None]
        other._den, other._num = self._den[None], self._num[:, :, None]
        return other

    def sample(self, row: int | slice | npt.NDArray[np.intp]) -> SampledLoop:
        """The loop of one of the samples, or of some."""
        other = copy(self)
        other.phi, other.held, other.previous = self.phi[row], self.held[row], self.previous[row]
        other._den, other._num = self._den[row], self._num[:, :, row]
        return other

    @property
    def integrates(self) -> bool:
        """Whether there is an integrator; where the gains are arrays, all of them have one or none has."""
        return bool(np.any(self.gains.k * self.gains.ki))

    @property
    def finite_at_zero(self) -> bool:
        """Whether L has a value at frequency 0: no integrator, no pole of an airframe at rest (Lv = 0)."""
        at_rest = np.abs(np.linalg.eigvals(self.phi) - 1.0).min() < 1e-12
        return not self.integrates and not bool(at_rest)

    def transfer(self, omega_rad_s: npt.ArrayLike) -> ComplexArray:
        """L(e^(j omega dt)), the loop cut at delta_lat, negative feedback: closed loop where 1 + L = 0.

        Args:
            omega_rad_s: any shape, in [0, pi/dt]; 0 only if `finite_at_zero`.

        Returns:
            The same shape, behind S if the loop holds samples.
        """
        omega = np.asarray(omega_rad_s, dtype=float)
        p, phi = self.plant(omega.ravel())
        on_p, on_phi = self.controller(omega.ravel())
        loop: ComplexArray = on_p * p + on_phi * phi
        return loop.reshape((*loop.shape[:-1], *omega.shape))

    def plant(
        self, omega_rad_s: FloatArray, rows: npt.NDArray[np.intp] | None = None
    ) -> tuple[ComplexArray, ComplexArray]:
        """Roll rate and roll angle per command, from the motors' side of the cut to the sensors.

        Args:
            omega_rad_s: (F,). rows: (F,) the sample that each frequency belongs to; None for all of them.

        Returns:
            two arrays (F,), behind S if the loop holds samples and `rows` is None.
        """
        half = 0.5 * omega_rad_s * self.dt_s
        w = 2j * np.sin(half) * np.exp(1j * half)  # z - 1 without the cancellation near z = 1
        lag = np.exp(-2j * half)
        den, num = self._den, self._num
        if rows is not None:
            den, num = den[rows], num[:, :, rows]
        elif den.ndim == 2:
            den, num = den[:, None, :], num[:, :, :, None, :]
        both = []
        shift = (np.exp(-2j * self.delay_ticks * half) if self.delay_ticks else 1.0) / _horner(den, w)
        for signal in (0, 1):
            value = _horner(num[0, signal], w)
            if np.any(self.previous):
                value = value + _horner(num[1, signal], w) * lag
            both.append(value * shift)
        return both[0], both[1]

    def controller(self, omega_rad_s: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """What multiplies roll rate and roll angle in L: filters and gains.

        Args:
            omega_rad_s: (F,); with gains that are arrays what is returned has the shape that those make with it.
        """
        half = 0.5 * omega_rad_s * self.dt_s
        w = 2j * np.sin(half) * np.exp(1j * half)
        lag = np.exp(-2j * half)
        g = self.gains
        b0, b1, b2, a1, a2 = self.biquad
        gyro = (b0 + (b1 + b2 * lag) * lag) / (1.0 + (a1 + a2 * lag) * lag)
        a = self.dgyro_alpha
        slope = w * lag / self.dt_s * a / (1.0 - (1.0 - a) * lag)
        error = g.k * g.kp + (g.k * g.ki * self.dt_s / w if self.integrates else 0.0)
        attitude = g.k_phi * np.polynomial.polynomial.polyval(lag, self.late)
        return (error + g.k * g.kd * slope) * gyro, (error + g.kff) * attitude

    def closed_loop_matrix(self, loop_gain: float | FloatArray = 1.0) -> FloatArray:
        """One tick of the whole closed loop without set-point: the matrix of `tick`.

        Args:
            loop_gain: factor on delta_lat where the loop is cut; (S,) for a factor of each sample.

        Returns:
            (N, N), behind S if the loop holds samples.
        """
        return self.tick(loop_gain).matrix

    def tick(self, loop_gain: float | FloatArray = 1.0) -> Tick:
        """One tick of the whole closed loop: state_k+1 = matrix state_k + setpoint phi_sp.

        The state is the plant's x_k (v, p, phi and, with lag, the motor), then as far as they exist: commands
        u_k-1, u_k-2, ...; the gyro filter's two; y_k-1; alpha_k-1; I_k; angles phi_k-1, phi_k-2, ...

        Args:
            loop_gain: factor on delta_lat where the loop is cut; (S,) for a factor of each sample.
        """
        g = self.gains
        n = self.phi.shape[-1]
        lead = self.phi.shape[:-2]
        commands = self.delay_ticks + (1 if np.any(self.previous) else 0)
        filtered = self.biquad != PASS_THROUGH
        integrates = self.integrates
        angles = len(self.late) - 1
        size = n + commands + 2 * filtered + 2 + integrates + angles
        unit = np.eye(size)
        command_at, filter_at = n, n + commands
        y_at = filter_at + 2 * filtered
        integral_at = y_at + 2
        angle_at = integral_at + integrates

        # Each signal of tick k as a row over the state at k.
        b0, b1, b2, a1, a2 = self.biquad
        p, phi = unit[P], unit[PHI]
        y = b0 * p + (unit[filter_at] if filtered else 0.0)
        a = self.dgyro_alpha
        alpha = (1.0 - a) * unit[y_at + 1] + a * (y - unit[y_at]) / self.dt_s
        rate_sp = -_column(g.k_phi) * (
            self.late[0] * phi + sum(self.late[j] * unit[angle_at + j - 1] for j in range(1, len(self.late)))
        )
        integral = unit[integral_at] if integrates else np.zeros(size)
        delta = _column(g.k * g.kp) * (rate_sp - y) + integral - _column(g.k * g.kd) * alpha + _column(g.kff) * rate_sp
        direct = (g.k * g.kp + g.kff) * g.k_phi
        now = np.broadcast_to(np.asarray(loop_gain)[..., None] * delta, (*lead, size))
        u = [now, *(unit[command_at + i] for i in range(commands))]

        rows = np.zeros((*lead, size, size))
        rows[..., :n, :n] = self.phi
        rows[..., :n, :] += self.held[..., :, None] * u[self.delay_ticks][..., None, :]
        if np.any(self.previous):
            rows[..., :n, :] += self.previous[..., :, None] * u[self.delay_ticks + 1][..., None, :]
        for i in range(commands):
            rows[..., command_at + i, :] = u[i]
        if filtered:  # transposed direct form II
            rows[..., filter_at, :] = b1 * p - a1 * y + unit[filter_at + 1]
            rows[..., filter_at + 1, :] = b2 * p - a2 * y
        rows[..., y_at, :], rows[..., y_at + 1, :] = y, alpha
        if integrates:
            rows[..., integral_at, :] = integral + _column(g.k * g.ki * self.dt_s) * (rate_sp - y)
        for i in range(angles):
            rows[..., angle_at + i, :] = phi if i == 0 else unit[angle_at + i - 1]
        setpoint = np.zeros((*lead, size))
        if commands:
            setpoint[..., command_at] = direct * np.asarray(loop_gain)
        if self.delay_ticks == 0:
            setpoint[..., :n] = self.held * (direct * np.asarray(loop_gain))[..., None]
        if integrates:
            setpoint[..., integral_at] = g.k * g.ki * self.dt_s * g.k_phi
        return Tick(rows, setpoint, delta, direct)

    def eigenvalues(self, loop_gain: float | FloatArray = 1.0) -> ComplexArray:
        """Eigenvalues of one tick of the closed loop; stable if all lie inside the unit circle."""
        return np.asarray(np.linalg.eigvals(self.closed_loop_matrix(loop_gain)).astype(complex))


def _column(gain: float | FloatArray) -> FloatArray:
    return np.asarray(gain)[..., None]  # a factor of rows over the state


def _horner(coefficients: FloatArray, w: ComplexArray) -> ComplexArray:
    """Polynomial with the highest power first in the last dimension, at w."""
    value = coefficients[..., 0] + np.zeros_like(w)
    for k in range(1, coefficients.shape[-1]):
        value *= w
        value += coefficients[..., k]
    return value


def _rational(phi: FloatArray, inputs: tuple[FloatArray, ...]) -> tuple[FloatArray, FloatArray]:
    """Denominator and numerators of (wI - (phi - I))^-1 b by Faddeev and LeVerrier, w = z - 1, highest power first.

    In w instead of z nothing cancels where it matters: slow poles lie near z = 1.

    Returns:
        (..., n + 1) and (inputs, signals p and phi, ..., n).
    """
    n = phi.shape[-1]
    unit = np.eye(n)
    a = phi - unit
    den, num = [np.ones(phi.shape[:-2])], []
    m = np.broadcast_to(unit, phi.shape)
    for k in range(1, n + 1):
        num.append([[(m[..., signal, :] * b).sum(axis=-1) for signal in (P, PHI)] for b in inputs])
        moved = a @ m
        c = -np.trace(moved, axis1=-2, axis2=-1) / k
        den.append(c)
        m = moved + c[..., None, None] * unit
    return np.stack(den, axis=-1), np.moveaxis(np.array(num), 0, -1)


def _late_weights(profile: Profile) -> FloatArray:
    """Linear interpolation between the two angles around the estimate's age, in whole ticks from now."""
    age = profile.rate_sp_late_ticks + profile.attitude_late_ticks
    whole = math.floor(age)
    fraction = age - whole
    weights = np.zeros(whole + 2)
    weights[whole], weights[whole + 1] = 1.0 - fraction, fraction
    return weights[: whole + 1] if fraction == 0.0 else weights


def _low_pass_delay(profile: Profile) -> float:
    """Group delay of the gyro filter at zero frequency, s."""
    if low_pass_2p(profile.gyro_cutoff_hz, profile.rate_hz) == PASS_THROUGH:
        return 0.0
    return profile.dt_s / math.sqrt(2.0) / math.tan(math.pi * profile.gyro_cutoff_hz * profile.dt_s)


def _discretise(
    derivatives: FloatArray, motor_lag_s: float, dt: float, late_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(Phi, held, previous) of x_k+1 = Phi x_k + held u_k + previous u_k-1: exact for a held input.

    The input of tick k arrives `late_s` after the tick begins; until then the one before acts.
    """
    n = 4 if motor_lag_s > 0.0 else 3
    rows = derivatives.reshape(-1, 6)
    shape = derivatives.shape[:-1]
    rest = step_matrices(rows, motor_lag_s, dt - late_s)
    phi, held = rest[:, :n, :n], rest[:, :n, 4]
    previous = np.zeros_like(held)
    if late_s > 0.0:
        first = step_matrices(rows, motor_lag_s, late_s)
        phi, previous = phi @ first[:, :n, :n], (phi @ first[:, :n, 4, None])[..., 0]
    return phi.reshape(*shape, n, n), held.reshape(*shape, n), previous.reshape(*shape, n)
