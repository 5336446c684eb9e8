"""From a vehicle's messages to telemetry: one row per ATTITUDE, the other messages held until their next."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bridge.client import Client
from bridge.connection import Message
from scenarios.flight import Segment
from scenarios.telemetry import NO_SEGMENT, Telemetry

Columns = dict[str, npt.NDArray[Any]]

ATTITUDE = 30
LOCAL_POSITION_NED = 32
ATTITUDE_TARGET = 83
HIL_ACTUATOR_CONTROLS = 93
HIL_STATE_QUATERNION = 115
CURRENT_MODE = 436

SAMPLED = (ATTITUDE, ATTITUDE_TARGET, HIL_ACTUATOR_CONTROLS, HIL_STATE_QUATERNION)
"""What a row is made of, streamed fast while something is measured and slower on the way there and back."""
SIMULATORS = (HIL_ACTUATOR_CONTROLS, HIL_STATE_QUATERNION)
"""Those of them that only a simulated vehicle has."""

FAST_INTERVAL_US = 4_000
CRUISE_INTERVAL_US = 20_000

ROWS_PER_BATCH = 1000
_MOTORS_SHOWN = 8
_FIXED_VALUES = 7 + 8 + 6 + 2 + 4
_NAN3 = (float("nan"),) * 3
_NAN4 = (float("nan"),) * 4
_NAN8 = (float("nan"),) * 8


class Truth(NamedTuple):
    """What the plant really did in a tick.

    Attributes:
        quat: body to world, w first. rates: p, q, r, rad/s. motors: commands, 0 to 1.
    """

    quat: tuple[float, float, float, float]
    rates: tuple[float, float, float]
    motors: tuple[float, ...]


class Sampler:
    """Collects rows while a client pumps.

    A row is finished when the next ATTITUDE comes, so that everything the vehicle sends in the same tick is in it.
    Body rates are the simulator's truth where the vehicle passes it on (HIL_STATE_QUATERNION): ATTITUDE carries the
    gyro behind its low pass, which at 40 Hz hides a fifth of a limit cycle at 35 Hz.

    Args:
        client: whose messages.
        inverse: (2, n) delta_lat and delta_lon per unit of motor command: the pseudo-inverse of the airframe's
            normalised mix.
        on_batch: called with every `rows_per_batch` finished rows, in order; with fewer after `batch_s` of vehicle
            time.
    """

    def __init__(
        self,
        client: Client,
        inverse: npt.NDArray[np.float64],
        on_batch: Callable[[Columns], object] | None = None,
        *,
        rows_per_batch: int = ROWS_PER_BATCH,
        batch_s: float = math.inf,
    ) -> None:
        self._rows_per_batch = rows_per_batch
        self._batch_s = batch_s
        self._due_s = batch_s
        self._state = client.state
        self._inverse = inverse
        self._motor_count = inverse.shape[1]
        self._values = _FIXED_VALUES + self._motor_count
        self._on_batch = on_batch
        self._attitude: tuple[float, ...] | None = None
        self._rates: tuple[float, ...] = _NAN3
        self._target: tuple[float, ...] = _NAN8
        self._position: tuple[float, ...] = _NAN3 + _NAN3
        self._motors: Sequence[float] = (float("nan"),) * self._motor_count
        self._true_rates: tuple[float, ...] | None = None
        self._true_quat: tuple[float, ...] = _NAN4
        self.truth_at: Callable[[int], Truth | None] | None = None
        """Where the plant is ours and the autopilot is not: what it did at a vehicle time in ms."""
        # flat numbers, not a list of rows: nothing for the garbage collector to walk through while flying
        self._rows = array("d")
        self._batches: list[Columns] = []
        self.last_s = -1.0
        client.subscribe("ATTITUDE", self._on_attitude)
        client.subscribe("ATTITUDE_TARGET", self._on_target)
        client.subscribe("LOCAL_POSITION_NED", self._on_position)
        client.subscribe("HIL_ACTUATOR_CONTROLS", self._on_motors)
        client.subscribe("HIL_STATE_QUATERNION", self._on_truth)

    def _on_attitude(self, m: Message) -> None:
        self._finish_row()
        t_s = m.time_boot_ms * 1e-3
        if t_s <= self.last_s:
            return
        self.last_s = t_s
        self._attitude = (t_s, m.roll, m.pitch, m.yaw)
        self._rates = (m.rollspeed, m.pitchspeed, m.yawspeed)

    def _on_target(self, m: Message) -> None:
        self._target = (*m.q, m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate, m.thrust)

    def _on_position(self, m: Message) -> None:
        self._position = (m.x, m.y, m.z, m.vx, m.vy, m.vz)

    def _on_truth(self, m: Message) -> None:
        self._true_rates = (m.rollspeed, m.pitchspeed, m.yawspeed)
        self._true_quat = tuple(m.attitude_quaternion)

    def _on_motors(self, m: Message) -> None:
        self._motors = m.controls[: self._motor_count]

    def _finish_row(self) -> None:
        if self._attitude is None:
            return
        state, t_s = self._state, self._attitude[0]
        if self.truth_at is not None:
            self._look_up(self.truth_at(round(t_s * 1e3)))
        rates = self._true_rates or self._rates
        self._true_rates = None
        self._rows.extend(
            (
                *(*self._attitude, *rates, *self._target, *self._position, *self._motors),
                *(state.nav_state, state.armed, *self._true_quat),
            )
        )
        self._true_quat = _NAN4
        self._attitude = None
        if len(self._rows) >= self._rows_per_batch * self._values or t_s >= self._due_s:
            self._due_s = t_s + self._batch_s
            self.flush()

    def _look_up(self, truth: Truth | None) -> None:
        """Take the plant's own word for the tick that the vehicle reports of."""
        if truth is not None:
            self._true_quat, self._true_rates = truth.quat, truth.rates
            self._motors = (*truth.motors, *(0.0 for _ in range(self._motor_count)))[: self._motor_count]

    def flush(self) -> None:
        """Hand over the finished rows."""
        if not self._rows:
            return
        columns = self._columns(np.array(self._rows).reshape(-1, self._values))
        self._rows = array("d")
        self._batches.append(columns)
        if self._on_batch is not None:
            self._on_batch(columns)

    def _columns(self, rows: npt.NDArray[np.float64]) -> Columns:
        names = ("t_s", "phi_rad", "theta_rad", "psi_rad", "p_rad_s", "q_rad_s", "r_rad_s")
        columns: Columns = {name: rows[:, i] for i, name in enumerate(names)}
        columns["phi_sp_rad"], columns["theta_sp_rad"], columns["psi_sp_rad"] = _euler(rows[:, 7:11])
        for i, name in enumerate(("p_sp_rad_s", "q_sp_rad_s", "r_sp_rad_s", "thrust_sp")):
            columns[name] = rows[:, 11 + i]
        for i, name in enumerate(("north_m", "east_m", "down_m", "v_north_m_s", "v_east_m_s", "v_down_m_s")):
            columns[name] = rows[:, 15 + i]
        count = self._motor_count
        motors = rows[:, 21 : 21 + count]
        for i in range(_MOTORS_SHOWN):
            columns[f"motor{i + 1}"] = motors[:, i] if i < count else np.full(len(rows), np.nan)
        delta = motors @ self._inverse.T
        columns["delta_lat"], columns["delta_lon"] = delta[:, 0], delta[:, 1]
        columns["nav_state"] = rows[:, 21 + count].astype(np.int16)
        columns["armed"] = rows[:, 22 + count].astype(np.bool_)
        true = _euler(rows[:, 23 + count : 27 + count])
        columns["phi_true_rad"], columns["theta_true_rad"], columns["psi_true_rad"] = true
        return columns

    def telemetry(self, segments: Sequence[Segment]) -> Telemetry:
        """Everything so far, with the column `segment` filled in.

        Args:
            segments: of the flight, in order; a row belongs to the one with start_s <= t_s < end_s.
        """
        self._finish_row()
        self.flush()
        if not self._batches:
            return Telemetry.empty()
        columns = {name: np.concatenate([batch[name] for batch in self._batches]) for name in self._batches[0]}
        t_s = columns["t_s"]
        segment = np.full(len(t_s), NO_SEGMENT, dtype=np.int16)
        for index, part in enumerate(segments):
            segment[(t_s >= part.start_s - 1e-9) & (t_s < part.end_s - 1e-9)] = index
        return Telemetry.from_columns({**columns, "segment": segment})


def _euler(quat: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], ...]:
    """(phi, theta, psi), rad, of (n, 4) quaternions, w first; NaN stays NaN."""
    w, x, y, z = quat.T
    phi = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    theta = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    psi = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return phi, theta, psi
