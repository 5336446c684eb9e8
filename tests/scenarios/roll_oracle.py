"""The roll loop of the tuning tests, written down once more from its difference equations.

Nothing here is shared with the package but the numbers of a profile: one tick is a Python function of numbers, and the
matrices of the loop are that function's answers to unit vectors.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg
import scipy.signal

from sitl.profile import Profile
from sitl.sampled_loop import RollGains

GRAVITY = 9.81  # as the study
NAMES = ("v", "p", "phi", "motor", "p1", "p2", "y1", "y2", "slope", "integral", "phi1", "rate_sp", "u1")


class RollOracle:
    """One model with one gain set under one profile."""

    def __init__(self, derivatives: np.ndarray, gains: RollGains, profile: Profile, lag_s: float) -> None:
        Yv, Yp, Yd, Lv, Lp, Ld = (float(value) for value in derivatives)
        self.dt = 1.0 / profile.rate_hz
        self.gains, self.profile, self.lag_s = gains, profile, lag_s
        a = np.zeros((5, 5))  # v, p, phi, torque, command
        a[0, :4] = Yv, Yp, GRAVITY, Yd
        a[1, :4] = Lv, Lp, 0.0, Ld
        a[2, 1] = 1.0
        if lag_s:
            a[3, 3:] = -1.0 / lag_s, 1.0 / lag_s
        self.hold = scipy.linalg.expm(a * self.dt)
        if profile.gyro_cutoff_hz and profile.gyro_cutoff_hz < profile.rate_hz / 2:
            self.b, self.a = scipy.signal.butter(2, profile.gyro_cutoff_hz, fs=profile.rate_hz)
        else:
            self.b, self.a = np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
        cut = profile.dgyro_cutoff_hz
        self.share = self.dt / (self.dt + 1.0 / (2.0 * math.pi * cut)) if cut else 1.0
        assert profile.transport_delay_ticks in (0, 1)
        assert profile.attitude_late_ticks <= 1.0

        size = len(NAMES)
        self.A, self.B = np.zeros((size, size)), np.zeros(size)
        self.delta, self.phi = np.zeros(size), np.eye(size)[NAMES.index("phi")]
        for n in range(size):
            self.A[:, n], self.delta[n] = self.tick(np.eye(size)[n], 0.0)
        self.B, self.direct = self.tick(np.zeros(size), 1.0)
        # the loop cut at delta: what a command does to the next command
        self.open_A = np.stack([self.tick(row, 0.0, 0.0)[0] for row in np.eye(size)], axis=1)
        self.open_B = self.tick(np.zeros(size), 0.0, 1.0)[0]

    def tick(self, state: np.ndarray, phi_sp: float, command: float | None = None) -> tuple[np.ndarray, float]:
        """The state a tick later and delta_lat of this one; `command` flies instead of it."""
        s = dict(zip(NAMES, state.tolist(), strict=True))
        g, b, a = self.gains, self.b, self.a
        y = b[0] * s["p"] + b[1] * s["p1"] + b[2] * s["p2"] - a[1] * s["y1"] - a[2] * s["y2"]
        slope = s["slope"] + self.share * ((y - s["y1"]) / self.dt - s["slope"])
        late = self.profile.attitude_late_ticks
        wanted = g.k_phi * (phi_sp - (1.0 - late) * s["phi"] - late * s["phi1"])
        used = s["rate_sp"] if self.profile.rate_sp_late_ticks else wanted
        delta = g.kp * (used - y) + s["integral"] - g.kd * slope
        u = delta if command is None else command
        acts = s["u1"] if self.profile.transport_delay_ticks else u
        body = self.hold @ np.array([s["v"], s["p"], s["phi"], s["motor"] if self.lag_s else acts, acts])
        after = {
            "v": body[0],
            "p": body[1],
            "phi": body[2],
            "motor": body[3] if self.lag_s else 0.0,
            "p1": s["p"],
            "p2": s["p1"],
            "y1": y,
            "y2": s["y1"],
            "slope": slope,
            "integral": s["integral"] + g.ki * (used - y) * self.dt,
            "phi1": s["phi"],
            "rate_sp": wanted,
            "u1": u,
        }
        return np.array([after[name] for name in NAMES]), delta

    def channels(self, omega: np.ndarray) -> np.ndarray:
        """(3, F) of S = 1 - F, Q and F at e^(j omega dt)."""
        z = np.exp(1j * omega * self.dt)
        whole = z[:, None, None] * np.eye(len(NAMES)) - self.A
        state = np.linalg.solve(whole, np.broadcast_to(self.B[:, None], (len(omega), len(NAMES), 1)))[..., 0]
        f = state @ self.phi
        return np.stack([1.0 - f, state @ self.delta + self.direct, f])

    def loop(self, omega: np.ndarray) -> np.ndarray:
        """(F,) of L, the loop cut at delta_lat."""
        z = np.exp(1j * omega * self.dt)
        whole = z[:, None, None] * np.eye(len(NAMES)) - self.open_A
        state = np.linalg.solve(whole, np.broadcast_to(self.open_B[:, None], (len(omega), len(NAMES), 1)))[..., 0]
        return np.asarray(-(state @ self.delta))

    def step(self, amplitude: float, seconds: float) -> np.ndarray:
        """Roll angle of every tick of a step from rest."""
        state, flown = np.zeros(len(NAMES)), []
        for _ in range(round(seconds / self.dt)):
            flown.append(state @ self.phi)
            state = self.A @ state + self.B * amplitude
        return np.array(flown)


def weight_at(weight: object, omega: np.ndarray, dt: float) -> np.ndarray:
    """(a s + b) / (c s + d) where Tustin's rule puts a frequency."""
    s = 2j / dt * np.tan(0.5 * omega * dt)
    return np.asarray((weight.a * s + weight.b) / (weight.c * s + weight.d))  # type: ignore[attr-defined]
