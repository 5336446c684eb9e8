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
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sitl.airframe import Derivatives, FlightGains
from sitl.filters import PASS_THROUGH, alpha_of, low_pass_2p
from sitl.lateral import LateralModel
from sitl.profile import Profile

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


class SampledLoop:
    """The sampled roll loop of one model, one gain set and one profile.

    Args:
        derivatives: the lateral model.
        gains: of the roll axis.
        profile: rate, delays and filters; its `motor_lag_s` is not used.
        motor_lag_s: time constant of the motors, 0 for none.
        transport_delay_s: further delay between command and motor, beyond the profile's ticks.

    Raises:
        ValueError: a lag or delay is negative.
    """

    def __init__(
        self,
        derivatives: Derivatives,
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
        self.phi, self.held, self.previous = _discretise(derivatives, motor_lag_s, dt, fraction_s)
        self.delay_s = self.delay_ticks * dt + fraction_s + dt / 2.0 + motor_lag_s + _low_pass_delay(profile)
        """Delay at low frequency of the rate loop's own elements: transport, half a tick of hold, motor lag,
        gyro filter. The attitude's lateness and the D filter are not in it: they delay part of the signal."""

    @property
    def finite_at_zero(self) -> bool:
        """Whether L has a value at frequency 0: no integrator, no pole of the airframe at rest (Lv = 0)."""
        at_rest = np.abs(np.linalg.eigvals(self.phi) - 1.0).min() < 1e-12
        return self.gains.k * self.gains.ki == 0.0 and not bool(at_rest)

    def transfer(self, omega_rad_s: npt.ArrayLike) -> ComplexArray:
        """L(e^(j omega dt)), the loop cut at delta_lat, negative feedback: closed loop where 1 + L = 0.

        Args:
            omega_rad_s: any shape, in [0, pi/dt]; 0 only if `finite_at_zero`.

        Returns:
            The same shape.
        """
        omega = np.asarray(omega_rad_s, dtype=float)
        z = np.exp(1j * omega * self.dt_s)
        lag = 1.0 / z
        g = self.gains

        resolvent = z[..., None, None] * np.eye(len(self.phi)) - self.phi
        forcing = (self.held + self.previous * lag[..., None]) * lag[..., None] ** self.delay_ticks
        plant = np.linalg.solve(resolvent, forcing[..., None])[..., 0]

        b0, b1, b2, a1, a2 = self.biquad
        gyro = (b0 + (b1 + b2 * lag) * lag) / (1.0 + (a1 + a2 * lag) * lag)
        a = self.dgyro_alpha
        slope = (1.0 - lag) / self.dt_s * a / (1.0 - (1.0 - a) * lag)
        error = g.k * g.kp + (g.k * g.ki * self.dt_s / (z - 1.0) if g.k * g.ki else 0.0)
        attitude = g.k_phi * np.polynomial.polynomial.polyval(lag, self.late)
        loop: ComplexArray = (error + g.k * g.kd * slope) * gyro * plant[..., P] + (error + g.kff) * attitude * plant[
            ..., PHI
        ]
        return loop

    def closed_loop_matrix(self, loop_gain: float = 1.0) -> FloatArray:
        """One tick of the whole closed loop: state_k+1 = M state_k, without set-point.

        The state is the plant's x_k (v, p, phi and, with lag, the motor), then as far as they exist: commands
        u_k-1, u_k-2, ...; the gyro filter's two; y_k-1; alpha_k-1; I_k; angles phi_k-1, phi_k-2, ...

        Args:
            loop_gain: factor on delta_lat where the loop is cut.
        """
        g = self.gains
        n = len(self.phi)
        commands = self.delay_ticks + (1 if np.any(self.previous) else 0)
        filtered = self.biquad != PASS_THROUGH
        integrates = g.k * g.ki != 0.0
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
        rate_sp = -g.k_phi * (
            self.late[0] * phi + sum(self.late[j] * unit[angle_at + j - 1] for j in range(1, len(self.late)))
        )
        integral = unit[integral_at] if integrates else np.zeros(size)
        delta = g.k * g.kp * (rate_sp - y) + integral - g.k * g.kd * alpha + g.kff * rate_sp
        u = [loop_gain * delta, *(unit[command_at + i] for i in range(commands))]

        rows = np.zeros((size, size))
        rows[:n, :n] = self.phi
        rows[:n] += np.outer(self.held, u[self.delay_ticks])
        if np.any(self.previous):
            rows[:n] += np.outer(self.previous, u[self.delay_ticks + 1])
        for i in range(commands):
            rows[command_at + i] = u[i]
        if filtered:  # transposed direct form II
            rows[filter_at] = b1 * p - a1 * y + unit[filter_at + 1]
            rows[filter_at + 1] = b2 * p - a2 * y
        rows[y_at], rows[y_at + 1] = y, alpha
        if integrates:
            rows[integral_at] = integral + g.k * g.ki * self.dt_s * (rate_sp - y)
        for i in range(angles):
            rows[angle_at + i] = phi if i == 0 else unit[angle_at + i - 1]
        return rows

    def eigenvalues(self, loop_gain: float = 1.0) -> ComplexArray:
        """Eigenvalues of one tick of the closed loop; stable if all lie inside the unit circle."""
        values: ComplexArray = np.linalg.eigvals(self.closed_loop_matrix(loop_gain)).astype(complex)
        return values


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
    derivatives: Derivatives, motor_lag_s: float, dt: float, late_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(Phi, held, previous) of x_k+1 = Phi x_k + held u_k + previous u_k-1: exact for a held input.

    The input of tick k arrives `late_s` after the tick begins; until then the one before acts.
    """
    import scipy.linalg  # slow to import, and only an analysis needs it

    model = LateralModel.from_derivatives(derivatives)
    n = 4 if motor_lag_s > 0.0 else 3
    generator = np.zeros((n + 1, n + 1))  # of [x, u] with u' = 0
    generator[:3, :3] = model.A
    generator[:3, 3] = model.B[:, 0]
    if motor_lag_s > 0.0:
        generator[3, 3:] = -1.0 / motor_lag_s, 1.0 / motor_lag_s
    rest: FloatArray = scipy.linalg.expm(generator * (dt - late_s))
    if late_s == 0.0:
        return rest[:n, :n], rest[:n, n], np.zeros(n)
    first: FloatArray = scipy.linalg.expm(generator * late_s)
    return rest[:n, :n] @ first[:n, :n], rest[:n, n], rest[:n, :n] @ first[:n, n]
